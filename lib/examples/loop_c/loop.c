/* The main loop of a product: samples, reports, telemetry and saved state side by side. None of them waits for another.
 * For any C99 or C++17 compiler: the tables decide the axes and the rate. Here twenty minutes of rest are simulated,
 * with a power cut in the middle. The frames go to stdout as candump logs them:
 *     loop > loop.log; selfcal monitor --read loop.log */
#include "selfcal_model.h"

#include <stdio.h>
#include <string.h>

#define WORK_A_SAMPLE 4U /* calls of selfcal_imu_work() */
#if !SELFCAL_MODEL_KEEPS_UP(WORK_A_SAMPLE)
#error "samples may overtake reports: more work a sample, or selfcal codegen --hold"
#endif

#define REPORT_S 60.0F
#define SAVE_S 240.0F

static selfcal_imu_t imu;
static selfcal_kept_t kept;
static double memory[(SELFCAL_MODEL_IMU_BYTES + sizeof(double) - 1U) / sizeof(double)]; /* aligned to 8 bytes */
static selfcal_telemetry_t telemetry;
static bool sending;
static uint32_t sent_n[SELFCAL_MODEL_AXES];
static uint64_t now; /* samples since power-on, the missing ones too */
static uint64_t report_at, save_at;
static uint64_t before; /* samples before the last power-on: for the log alone */

/* --- what a board brings --- */

/* White noise of N = 0.01 unit/sqrt(Hz) around a bias of 0.5: the sum of twelve uniform numbers is nearly Gaussian. Now
 * and then samples are missing before this one. */
static void read_sensor(float reading[], uint32_t *missing) {
    static uint32_t state = 1U;
    float root = 1.0F;
    for (int i = 0; i < 20; i++) { /* Newton's square root of the rate */
        root = 0.5F * (root + SELFCAL_MODEL_RATE_HZ / root);
    }
    for (unsigned axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        float sum = -6.0F;
        for (int i = 0; i < 12; i++) {
            state = 1664525U * state + 1013904223U;
            sum += (float)(state >> 8) / 16777216.0F;
        }
        reading[axis] = 0.5F + 0.01F * root * sum;
    }
    *missing = now % 5000U == 4999U ? 3U : 0U;
}

/* Two slots of flash, written in turn: a cut leaves the other one whole. */
typedef struct {
    unsigned char bytes[SELFCAL_MODEL_SNAPSHOT_MAX];
    size_t length; /* 0: nothing is in it */
    uint32_t number;
} slot_t;
static slot_t slots[2];

static bool program(void *context, const void *bytes, size_t count) {
    slot_t *slot = (slot_t *)context;
    if (count > sizeof slot->bytes - slot->length) {
        return false;
    }
    memcpy(slot->bytes + slot->length, bytes, count);
    slot->length += count;
    return true;
}

/* A frame on the wire; false: no room, offer it again. */
static bool put_frame(const selfcal_frame_t *frame) {
    printf("(%.6f) can0 %03X#", (double)(before + now) / (double)SELFCAL_MODEL_RATE_HZ, (unsigned)frame->id);
    for (unsigned i = 0; i < frame->length; i++) {
        printf("%02X", (unsigned)frame->data[i]);
    }
    putchar('\n');
    return true;
}

/* --- parts of the loop --- */

static uint32_t time_ms(void) {
    return (uint32_t)((double)now * 1000.0 / (double)SELFCAL_MODEL_RATE_HZ);
}

static uint64_t in(float seconds) {
    return now + (uint64_t)(seconds * SELFCAL_MODEL_RATE_HZ);
}

/* Power-on: the newer of the slots that are sound, else an empty bank. How long ago it was saved is not known here: as
 * long as between two saves. */
static bool begin(void) {
    before += now;
    now = 0U;
    sending = false;
    memset(sent_n, 0, sizeof sent_n);
    if (selfcal_imu_init(&imu, &selfcal_model_pipe, memory, sizeof memory) != SELFCAL_OK ||
        selfcal_telemetry_init(&telemetry, &selfcal_model, selfcal_model_axis_name) != SELFCAL_OK) {
        return false; /* the model and the build do not go together */
    }
    selfcal_imu_keep(&imu, &kept);
    const uint64_t gap = in(SAVE_S);
    const unsigned newer = slots[1].number > slots[0].number ? 1U : 0U;
    for (unsigned i = 0; i < 2U; i++) {
        const slot_t *slot = &slots[(newer + i) % 2U];
        if (slot->length > 0U && selfcal_imu_restore(&imu, slot->bytes, slot->length, gap) == SELFCAL_OK) {
            break;
        }
    }
    report_at = in(REPORT_S);
    save_at = in(SAVE_S);
    return true;
}

/* Every sample, at once: a queue of the driver's holds those that come meanwhile. */
static void take_sample(void) {
    float reading[SELFCAL_MODEL_AXES];
    uint32_t missing = 0;
    read_sensor(reading, &missing);
    selfcal_imu_skip(&imu, missing);
    now += missing + 1U;
    if ((selfcal_imu_sample(&imu, reading, NULL, NULL) & SELFCAL_ALL_AXES) != 0U) {
        report_at = now; /* something has changed: ask at once */
    }
}

/* A few slices of the reports that are due. */
static void work(void) {
    if (now >= report_at && !sending) { /* the report that is being sent must stay */
        (void)selfcal_imu_ask(&imu, SELFCAL_ALL_AXES);
        report_at = in(REPORT_S);
    }
    for (unsigned i = 0; i < WORK_A_SAMPLE; i++) {
        (void)selfcal_imu_work(&imu);
    }
}

/* One frame, of the report that is newer than what was sent of its axis. It stays as it is while it is sent: work()
 * does not ask for another one meanwhile, and the axis's next one takes hundreds of calls. */
static void send(void) {
    static selfcal_frame_t frame;
    static bool waits;
    for (unsigned axis = 0; !sending && axis < SELFCAL_MODEL_AXES; axis++) {
        const selfcal_report_t *report = selfcal_imu_report(&imu, (uint8_t)axis);
        if (report != NULL && report->n != sent_n[axis]) {
            sent_n[axis] = report->n;
            selfcal_telemetry_adequacy(&telemetry, selfcal_imu_judgement(&imu, (uint8_t)axis));
            selfcal_telemetry_coefficients(&telemetry, selfcal_imu_coefficients(&imu, (uint8_t)axis));
            sending =
                selfcal_telemetry_report(&telemetry, report, selfcal_counters(&imu.bank), time_ms()) == SELFCAL_OK;
        }
    }
    if (sending && !waits) {
        sending = waits = selfcal_telemetry_next(&telemetry, &frame);
    }
    waits = waits && !put_frame(&frame);
}

/* A report under way goes on. The older slot is empty until the last byte is in. */
static void save(void) {
    if (now < save_at) {
        return;
    }
    slot_t *slot = &slots[slots[1].number < slots[0].number ? 1U : 0U];
    const uint32_t newest = slots[0].number > slots[1].number ? slots[0].number : slots[1].number;
    slot->length = 0U;
    slot->number = selfcal_imu_save(&imu, program, slot) == SELFCAL_OK ? newest + 1U : 0U;
    save_at = in(SAVE_S);
}

static void run(float seconds) {
    const uint64_t end = in(seconds);
    while (now < end) {
        take_sample();
        work();
        send();
        save();
    }
}

int main(void) {
    if (!begin()) {
        return 1;
    }
    run(600.0F);
    if (!begin()) { /* the power has failed */
        return 1;
    }
    run(600.0F);
    for (unsigned axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        const selfcal_reason_t reason = selfcal_imu_reason(&imu, (uint8_t)axis);
        fprintf(stderr, "%s: bias %.4f, reason %d\n", selfcal_model_axis_name[axis],
                (double)selfcal_imu_bias(&imu, (uint8_t)axis), (int)reason);
    }
    return 0;
}
