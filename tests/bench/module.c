/* Counts the instructions of the firmware application on a Cortex-M, the stationary gate before the bank: what a sample
 * costs at the sensor's full rate, between reports and while one is worked out, and how long samples wait then; the
 * gate by itself. Time is the instructions' own, at MHZ of them a second. Prints as bench.c does. Reading the sensor
 * and writing the wire are not in it. */
#include <math.h>

#include "app.h"
#include "count.h"
#include "record.h"

#define AXES SELFCAL_MODEL_AXES
/* Samples that lie ready; a power of two. */
#define RING 32U
/* Reports are due when 33 bank samples are in: 2 batches, so that pushes carry the nodes' work, and one for the gate to
 * see rest. Meanwhile the gate takes the noise that it has measured twice, after 30 and 60 windows of a third of a
 * second. */
#define REPORT_MS 34000U
/* One sample is missing before this one, so that the gate judges a window by thresholds of its own. */
#define GAP_AT 20000U
/* SysTick counts 16 (M0) or 168 (M4F) ticks a us, an instruction is 64 ns: see bench.py. Of 1 / 819.2 Hz. */
#ifdef __ARM_FP
#define MHZ 168U
#define PERIOD_TICKS 2205000U
#else
#define MHZ 48U
#define PERIOD_TICKS 60000U
#endif

static record_t record;
static float ring[RING][AXES];
static uint32_t made;      /* samples put into the ring */
static uint32_t samples;   /* taken */
static uint64_t now_ticks; /* idle time too */
static uint32_t most_waiting;
static app_t app;

static uint32_t board_time_ms(void *context) {
    (void)context;
    return (uint32_t)((uint64_t)samples * 1250U / 1024U); /* 819.2 Hz */
}

static port_sample_t board_sample(void *context, float reading[], uint32_t *missing) {
    (void)context;
    if ((uint64_t)samples * PERIOD_TICKS > now_ticks) {
        return PORT_EMPTY;
    }
    for (unsigned axis = 0; axis < AXES; axis++) {
        reading[axis] = ring[samples % RING][axis];
    }
    for (unsigned side = 0; side < PORT_SIDE; side++) {
        reading[AXES + SELFCAL_MODEL_CHANNELS + side] = NAN;
    }
    *missing = samples == GAP_AT ? 1U : 0U;
    samples++;
    return PORT_SAMPLE;
}

static bool board_send(void *context, const selfcal_frame_t *frame) {
    (void)context;
    (void)frame;
    return true;
}

static void board_idle(void *context) {
    (void)context;
    now_ticks = (uint64_t)samples * PERIOD_TICKS;
}

static void fill(void) {
    while ((int32_t)(made - samples) < (int32_t)RING) {
        record_next(&record, ring[made % RING]);
        made++;
    }
}

static taken_t turn(void) {
    fill();
    const uint32_t waiting = (uint32_t)(now_ticks / PERIOD_TICKS) + 1U - samples;
    most_waiting = waiting > most_waiting ? waiting : most_waiting;
    const image_time_t start = image_now();
    (void)app_step(&app);
    const taken_t taken = count_since(start);
    now_ticks += taken.ticks;
    return taken;
}

/* One sample into the gate of the application, which is not in use any more. */
static taken_t push_gate(void) {
    samples++;
    fill();
    const image_time_t start = image_now();
    (void)selfcal_gate_push(&app.imu.gate->gate, ring[samples % RING]);
    return count_since(start);
}

static void keep_worst(taken_t *worst, taken_t taken) {
    if (taken.ticks > worst->ticks) {
        *worst = taken;
    }
}

/* A sample's share while thresholds are worked out, while none is, at a whole window's end, and at that of one with a
 * sample missing. */
static void print_gate(void) {
    taken_t step = {0, 0, 0}, sum = {0, 0, 0}, judged = {0, 0, 0}, part = {0, 0, 0};
    uint32_t steps = 0;
    (void)app_gate(&app);
    const uint32_t window = app.imu.gate->gate.config.window;
    for (uint32_t i = 0; i < 4U * window; i++) {
        const bool working = app.imu.gate->gate.work != 0U;
        const taken_t taken = push_gate();
        if (working) {
            steps++;
            keep_worst(&step, taken);
        } else if (i >= window) {
            count_add(&sum, taken);
            keep_worst(&judged, taken);
        }
    }
    (void)selfcal_gate_skip(&app.imu.gate->gate, 1U);
    for (uint32_t i = 1; i < window; i++) {
        keep_worst(&part, push_gate());
    }
    count_print("gate", sum, 3U * window);
    count_print("gate.judge", judged, 1U);
    count_print("gate.step", step, 1U);
    count_print("gate.part", part, 1U);
    count_print_value("gate.steps", steps);
}

int main(void) {
    static const port_t port = {NULL, board_time_ms, board_sample, board_send, board_idle};
    image_start_clock();
    record_init(&record);
    if (app_init(&app, &port, REPORT_MS) != SELFCAL_OK || !app_gate(&app)) {
        return 2;
    }
    count_print_empty();

    taken_t between = {0, 0, 0}, worst_between = {0, 0, 0}, worst_report = {0, 0, 0};
    while (app.report_number == 0U) {
        const taken_t taken = turn();
        count_add(&between, taken);
        keep_worst(&worst_between, taken);
    }
    count_print("sample", between, samples);
    count_print("sample.worst", worst_between, 1U);

    if (app.imu.gate->gate.counters.alarms != 0U || app.imu.gate->gate.measured < 60U) {
        return 4; /* the record is one of rest */
    }
    const uint32_t before = samples;
    const uint64_t begun = now_ticks;
    while (!app.imu.computing) {
        (void)turn(); /* the status */
    }
    count_print_value("sample.most_waiting", most_waiting);
    most_waiting = 0;
    while (app.imu.computing) {
        const taken_t taken = turn();
        keep_worst(&worst_report, taken);
    }
    count_print("sample.report.worst", worst_report, 1U);
    count_print_value("mhz", MHZ);
    count_print_value("report.samples", samples - before);
    count_print_value("report.most_waiting", most_waiting);
    print_gate();
    count_print_value("place.imu", sizeof app.imu);
    count_print_value("place.kept", sizeof(selfcal_kept_t));
    count_print_value("place.memory", SELFCAL_MODEL_IMU_BYTES);
    count_print_value("place.held", SELFCAL_HELD_SIZE(SELFCAL_MODEL_NODES, 0U, 0U));
    count_print_value("report.ms", (now_ticks - begun) * 1250U / 1024U / PERIOD_TICKS);
    return 0;
}
