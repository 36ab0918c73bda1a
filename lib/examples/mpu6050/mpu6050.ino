// An MPU-6050 at rest prints its own data sheet, each minute, by the serial monitor at 115200. For an ESP32, by I2C:
// SDA to pin 21, SCL to pin 22, VCC to 3V3, GND, AD0 to GND or open. Lay it on a table and leave it alone for an hour.
//
// The tables of this part and rate, as a library beside this one (README.md, "In your build system"):
//     selfcal codegen mpu6050 -o libraries/selfcal_tables --rate 100 --target cortex-m4f
//
// Registers: MPU-6000 and MPU-6050 register map, RM-MPU-6000A, revision 4.2.
#include <Wire.h>
#include <selfcal_model.h>

#if SELFCAL_MODEL_RATE_MILLIHZ != 100000UL
#error "the tables are of another rate: selfcal codegen mpu6050 -o libraries/selfcal_tables --rate 100"
#endif

static const uint8_t ADDRESS = 0x68;
static const float DEG_PER_S = 1.0F / 131.0F;      // of a count at +-250 deg/s
static const float M_PER_S2 = 9.80665F / 16384.0F; // of a count at +-2 g
static const uint32_t REPORT_EVERY = 6000UL;       // samples: a minute

static selfcal_t bank;
static selfcal_work_t work;
static selfcal_report_t report;
static double memory[(SELFCAL_MODEL_BYTES + sizeof(double) - 1U) / sizeof(double)];
static uint32_t samples;

static void writeRegister(uint8_t place, uint8_t value) {
    Wire.beginTransmission(ADDRESS);
    Wire.write(place);
    Wire.write(value);
    Wire.endTransmission();
}

// `count` registers from `place` on; false if the sensor does not answer.
static bool readRegisters(uint8_t place, uint8_t *values, uint8_t count) {
    Wire.beginTransmission(ADDRESS);
    Wire.write(place);
    if (Wire.endTransmission(false) != 0 || Wire.requestFrom(ADDRESS, count) != count) {
        return false;
    }
    for (uint8_t i = 0; i < count; i++) {
        values[i] = (uint8_t)Wire.read();
    }
    return true;
}

// The next sample, in deg/s and m/s^2, by the sensor's own clock; false while there is none.
static bool readSensor(float sample[]) {
    uint8_t ready;
    uint8_t raw[14]; // accelerometer, temperature, gyro: two bytes each, the high one first
    if (!readRegisters(0x3A, &ready, 1) || (ready & 1U) == 0U || !readRegisters(0x3B, raw, sizeof raw)) {
        return false;
    }
    for (uint8_t axis = 0; axis < 3U; axis++) {
        const uint8_t *gyro = &raw[8U + 2U * axis];
        const uint8_t *accel = &raw[2U * axis];
        sample[axis] = DEG_PER_S * (float)(int16_t)((uint16_t)gyro[0] << 8 | gyro[1]);
        sample[3U + axis] = M_PER_S2 * (float)(int16_t)((uint16_t)accel[0] << 8 | accel[1]);
    }
    return true;
}

static void printNumber(const char *name, const selfcal_estimate_t &of, float factor, const char *unit) {
    Serial.print(name);
    if ((of.flags & SELFCAL_IDENTIFIED) == 0U) {
        Serial.print(" < ");
        Serial.print(factor * of.q95, 5);
    } else {
        Serial.print(" ");
        Serial.print(factor * of.median, 5);
        Serial.print(" [");
        Serial.print(factor * of.q05, 5);
        Serial.print(", ");
        Serial.print(factor * of.q95, 5);
        Serial.print("]");
    }
    Serial.print(unit);
}

// One axis: random walk of the angle or velocity, rate random walk, and the bias, with 90 % intervals.
static void printAxis(uint8_t axis) {
    if (selfcal_report_begin(&work, &bank, axis, &report) != SELFCAL_OK) {
        return; // too short yet
    }
    while (selfcal_report_step(&work, &report) == SELFCAL_BUSY) {
    }
    uint8_t best = 0;
    uint8_t walk = SELFCAL_MODEL_HYPOTHESES; // the law whose K is known
    for (uint8_t law = 0; law < SELFCAL_MODEL_HYPOTHESES; law++) {
        const selfcal_posterior_t &one = report.hypothesis[law];
        if (one.probability > report.hypothesis[best].probability) {
            best = law;
        }
        if (one.parameter[SELFCAL_K].q95 == one.parameter[SELFCAL_K].q95) { // not NaN
            walk = law;
        }
    }
    const bool gyro = axis < 3U;
    Serial.print(selfcal_model_axis_name[axis]);
    printNumber(gyro ? ": ARW" : ": VRW", report.hypothesis[best].parameter[SELFCAL_N], 60.0F,
                gyro ? " deg/sqrt(h), " : " m/s/sqrt(h), ");
    if (walk < SELFCAL_MODEL_HYPOTHESES) {
        printNumber("RRW", report.hypothesis[walk].parameter[SELFCAL_K], gyro ? 216000.0F : 60.0F,
                    gyro ? " deg/h/sqrt(h), " : " m/s^2/sqrt(h), ");
    }
    Serial.print("bias ");
    Serial.print(report.bias_mean, 5);
    Serial.print(" +- ");
    Serial.print(report.bias_sd, 5);
    Serial.println(gyro ? " deg/s" : " m/s^2");
}

void setup() {
    Serial.begin(115200);
    Wire.begin();
    Wire.setClock(400000);
    writeRegister(0x6B, 0x01); // awake, by the clock of the gyro
    writeRegister(0x1A, 0x03); // filter of 44 Hz: 1000 samples/s
    writeRegister(0x19, 9);    // of which every tenth
    writeRegister(0x1B, 0x00); // +-250 deg/s
    writeRegister(0x1C, 0x00); // +-2 g
    writeRegister(0x38, 0x01); // a bit tells of a new sample
    if (selfcal_init(&bank, &selfcal_model, memory, sizeof memory) != SELFCAL_OK) {
        Serial.println("the model and the build do not go together");
        while (true) {
        }
    }
}

void loop() {
    float sample[SELFCAL_MODEL_AXES];
    if (!readSensor(sample)) {
        return;
    }
    selfcal_push(&bank, sample);
    samples++;
    if (samples % REPORT_EVERY == 0U) {
        for (uint8_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
            printAxis(axis);
        }
    }
}
