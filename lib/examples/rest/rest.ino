// A simulated sensor at rest: a report of the first axis each minute, by the serial monitor.
// Put the tables into a library beside this one, libraries/selfcal_tables: README.md, "In your build system".
#include <selfcal_model.h>

static selfcal_t bank;
static selfcal_work_t work;
static selfcal_report_t report;
static double memory[(SELFCAL_MODEL_BYTES + sizeof(double) - 1U) / sizeof(double)];
static uint32_t samples;

// White noise of 0.3 around a bias of 0.5. Your driver comes here, at SELFCAL_MODEL_RATE_HZ.
static void readSensor(float sample[]) {
    for (uint8_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        float sum = -6.0F;
        for (int i = 0; i < 12; i++) {
            sum += (float)random(1000000L) / 1000000.0F;
        }
        sample[axis] = 0.5F + 0.3F * sum;
    }
}

void setup() {
    Serial.begin(115200);
    if (selfcal_init(&bank, &selfcal_model, memory, sizeof memory) != SELFCAL_OK) {
        Serial.println("the model and the build do not go together");
        while (true) {
        }
    }
}

void loop() {
    float sample[SELFCAL_MODEL_AXES];
    readSensor(sample);
    selfcal_push(&bank, sample);
    samples++;
    if (samples % (uint32_t)(60.0F * SELFCAL_MODEL_RATE_HZ) != 0U) {
        return;
    }
    if (selfcal_report_begin(&work, &bank, 0, &report) != SELFCAL_OK) {
        return;
    }
    while (selfcal_report_step(&work, &report) == SELFCAL_BUSY) {
        // One slice of the report is done: samples may be pushed here while selfcal_room() is above 0.
    }
    Serial.print("bias ");
    Serial.print(report.bias_mean, 4);
    Serial.print(" +- ");
    Serial.println(report.bias_sd, 4);
}
