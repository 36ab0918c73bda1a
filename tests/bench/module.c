/* Counts the instructions of the firmware application on a Cortex-M: what a sample costs at the sensor's full rate, between
 * reports and while one is worked out, and how long samples wait then. Time is the instructions' own, at MHZ of them a second.
 * Prints as bench.c does. Reading the sensor and writing the wire are not in it. */
#include "app.h"
#include "image.h"
#include "record.h"

#define AXES SELFCAL_MODEL_AXES
/* Samples of the record, given over and over; a power of two. */
#define RING 32U
/* Reports are due when 32 bank samples are in: 2 batches, so that pushes carry the nodes' work. */
#define REPORT_MS 32000U
/* SysTick counts 16 (M0) or 168 (M4F) ticks a us, an instruction is 64 ns: see bench.py. Of 1 / 819.2 Hz. */
#ifdef __ARM_FP
#define MHZ 168U
#define PERIOD_TICKS 2205000U
#else
#define MHZ 48U
#define PERIOD_TICKS 60000U
#endif

typedef struct {
    uint64_t ticks;
    uint32_t rounds, parts;
} taken_t;

static float ring[RING][AXES];
static uint32_t samples;  /* taken */
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
    *missing = 0;
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

static taken_t turn(void) {
    const uint32_t waiting = (uint32_t)(now_ticks / PERIOD_TICKS) + 1U - samples;
    most_waiting = waiting > most_waiting ? waiting : most_waiting;
    const image_time_t start = image_now();
    (void)app_step(&app);
    const image_time_t now = image_now();
    const taken_t taken = {now.ticks - start.ticks, now.rounds - start.rounds, 1U};
    now_ticks += taken.ticks;
    return taken;
}

static void add(taken_t *sum, taken_t part) {
    sum->ticks += part.ticks;
    sum->rounds += part.rounds;
    sum->parts += part.parts;
}

static void print_count(const char *name, taken_t taken, uint64_t per) {
    image_print("count ");
    image_print(name);
    image_print(" ");
    image_print_number(taken.ticks);
    image_print(" ");
    image_print_number(taken.parts);
    image_print(" ");
    image_print_number(taken.rounds);
    image_print(" ");
    image_print_number(per);
    image_print("\n");
}

static void print_value(const char *name, uint64_t number) {
    image_print("value ");
    image_print(name);
    image_print(" ");
    image_print_number(number);
    image_print("\n");
}

int main(void) {
    static const port_t port = {NULL, board_time_ms, board_sample, board_send, board_idle};
    record_t record;
    image_start_clock();
    record_init(&record);
    for (unsigned i = 0; i < RING; i++) {
        record_next(&record, ring[i]);
    }
    if (app_init(&app, &port, REPORT_MS) != SELFCAL_OK) {
        return 2;
    }
    const image_time_t start = image_now();
    const image_time_t now = image_now();
    const taken_t empty = {now.ticks - start.ticks, now.rounds - start.rounds, 1U};
    print_count("clock.empty", empty, 1U);

    taken_t between = {0, 0, 0}, worst_between = {0, 0, 0}, worst_report = {0, 0, 0};
    while (app.report_number == 0U) {
        const taken_t taken = turn();
        add(&between, taken);
        if (taken.ticks > worst_between.ticks) {
            worst_between = taken;
        }
    }
    print_count("sample", between, samples);
    print_count("sample.worst", worst_between, 1U);

    const uint32_t before = samples;
    const uint64_t begun = now_ticks;
    while (!app.computing) {
        (void)turn(); /* the status */
    }
    print_value("sample.most_waiting", most_waiting);
    most_waiting = 0;
    while (app.computing) {
        const taken_t taken = turn();
        if (taken.ticks > worst_report.ticks) {
            worst_report = taken;
        }
    }
    print_count("sample.report.worst", worst_report, 1U);
    print_value("mhz", MHZ);
    print_value("report.samples", samples - before);
    print_value("report.most_waiting", most_waiting);
    print_value("report.ms", (now_ticks - begun) * 1250U / 1024U / PERIOD_TICKS);
    return 0;
}
