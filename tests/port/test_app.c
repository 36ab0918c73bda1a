/* Samples that come while a report is worked out, on a core so slow that more come than there is room for. */
#include "app.h"
#include "noise.h"
#include "selfcal_frames.h"
#include "unity.h"

#include <math.h>
#include <string.h>

/* A sensor that always has a sample, a clock of the samples, and a wire that takes every frame. */
static app_t app;
static uint64_t time_samples;
static bool gaps; /* while a report is worked out: a whole bank interval is missing, before one sample of 300 */
static unsigned frames[PORT_AXES + 1], most_in_a_report, in_a_report; /* in_a_report: samples since it began */

static uint32_t time_ms(void *context) {
    (void)context;
    return (uint32_t)((double)time_samples * 1e3 / (double)SELFCAL_MODEL_RATE_HZ);
}

static port_sample_t sample(void *context, float reading[], uint32_t *missing) {
    (void)context;
    for (unsigned axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        reading[axis] = 0.1F * noise();
    }
    for (unsigned side = 0; side < PORT_SIDE; side++) {
        reading[SELFCAL_MODEL_AXES + SELFCAL_MODEL_CHANNELS + side] = NAN;
    }
    *missing = gaps && app.imu.computing && draw() % 300U == 0U ? app.imu.bank.block : 0U;
    time_samples += 1U + *missing;
    in_a_report++;
    return PORT_SAMPLE;
}

static bool take_frame(void *context, const selfcal_frame_t *frame) {
    (void)context;
    if (frame->id > SELFCAL_FRAME_STATUS_ID && frame->id <= SELFCAL_FRAME_STATUS_ID + PORT_AXES) {
        frames[frame->id - SELFCAL_FRAME_STATUS_ID]++;
    }
    return true;
}

static void idle(void *context) {
    (void)context;
}

static const port_t port = {NULL, time_ms, sample, take_frame, idle};

void setUp(void) {
    state = 20260408U;
    time_samples = 0;
    most_in_a_report = 0;
    memset(frames, 0, sizeof frames);
    TEST_ASSERT_EQUAL(SELFCAL_OK, app_init(&app, &port, 60000U));
}

void tearDown(void) {}

/* The truth is the rule at selfcal_room(): while it is kept each axis has its report. */
static void each_axis_has_its_report(void) {
    while (app.report_number == 0U || app.stage != 0U || app.imu.computing || app.worked_out) {
        if (!app.imu.computing) {
            in_a_report = 0;
        }
        TEST_ASSERT_TRUE(app_step(&app));
        most_in_a_report = app.imu.computing && in_a_report > most_in_a_report ? in_a_report : most_in_a_report;
    }
    for (unsigned axis = 1; axis <= PORT_AXES; axis++) {
        TEST_ASSERT_GREATER_THAN_MESSAGE(0U, frames[axis], "an axis has no report");
    }
}

/* Room for 15 bank intervals, and half of the next; the first of them may have begun. */
static void test_samples_go_on_in_a_report_as_long_as_there_is_room(void) {
    gaps = false;
    each_axis_has_its_report();
    TEST_ASSERT_GREATER_OR_EQUAL(14U * app.imu.bank.block + app.imu.bank.block / 2U - 1U, most_in_a_report);
    TEST_ASSERT_LESS_THAN(15U * app.imu.bank.block + app.imu.bank.block / 2U + 1U, most_in_a_report);
}

/* A gap ends an interval with what it has, which would be the one sample too many in the second half of the last. */
static void test_gaps_do_not_overtake_a_report(void) {
    gaps = true;
    each_axis_has_its_report();
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(test_samples_go_on_in_a_report_as_long_as_there_is_room);
    RUN_TEST(test_gaps_do_not_overtake_a_report);
    return UNITY_END();
}
