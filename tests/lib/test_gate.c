/* The stationary gate through the public header: arguments and extremes. Its statistics are tested in
 * tests/lib/test_gate.py. */
#include <float.h>
#include <math.h>

#include "selfcal.h"
#include "unity.h"

static selfcal_gate_t gate;
static selfcal_gate_config_t config;

void setUp(void) {
    const selfcal_gate_config_t two = {.axes = 2,
                                       .window = 10,
                                       .false_alarm = 1e-3F,
                                       .hold = 1,
                                       .memory = 10,
                                       .sigma = {1.0F, 1.0F},
                                       .is_rate = {true, false}};
    config = two;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_gate_init(&gate, &config));
}

void tearDown(void) {}

/* A window of rest about a level: +-1 in turn. */
static selfcal_motion_t window(float x, float y) {
    selfcal_motion_t state = SELFCAL_MOVING;
    for (unsigned i = 0; i < config.window; i++) {
        const float off = i % 2U == 0U ? 1.0F : -1.0F;
        state = selfcal_gate_push(&gate, (const float[2]){x + off, y - off});
    }
    return state;
}

static void bad_arguments_are_refused(void) {
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_gate_init(NULL, &config));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_gate_init(&gate, NULL));
    config.axes = SELFCAL_AXES_MAX + 1;
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_gate_init(&gate, &config));
    const selfcal_gate_noise_t white = {1.0F, 1.0F, 1.0F, 1.0F};
    selfcal_gate_noise_t noise;
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_gate_noise(NULL, 0, &white));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_gate_noise(&gate, 2, &white));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_gate_noise(&gate, 0, NULL));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_gate_measured(&gate, 2, &noise));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_gate_measured(&gate, 0, NULL));
    TEST_ASSERT_EQUAL(SELFCAL_TOO_SHORT, selfcal_gate_measured(&gate, 0, &noise));
}

static void rest_motion_and_rest_again(void) {
    TEST_ASSERT_EQUAL(SELFCAL_MOVING, window(5.0F, 9.8F));
    TEST_ASSERT_EQUAL(SELFCAL_RESTING, window(5.0F, 9.8F));
    TEST_ASSERT_EQUAL(SELFCAL_MOVING, window(10.0F, 9.8F));
    TEST_ASSERT_EQUAL(SELFCAL_MOVING, window(10.0F, 9.8F)); /* the gyro has not come back */
    TEST_ASSERT_EQUAL(SELFCAL_MOVING, window(10.0F, 9.8F));
    TEST_ASSERT_EQUAL(SELFCAL_MOVING, window(5.0F, -9.8F)); /* off what it was just before */
    TEST_ASSERT_EQUAL(SELFCAL_MOVING, window(5.0F, -9.8F));
    TEST_ASSERT_EQUAL(SELFCAL_RESTING, window(5.0F, -9.8F)); /* turned over */
    TEST_ASSERT_EQUAL(8, gate.counters.windows);
    TEST_ASSERT_EQUAL(1, gate.counters.alarms);
}

/* What the sensor itself adds is no motion: half of a window before, half after. */
static void a_shift_by_the_sensor_is_no_motion(void) {
    for (unsigned i = 0; i < 5U; i++) {
        (void)window(5.0F, 9.8F);
    }
    for (unsigned i = 0; i < 10U; i++) {
        const float off = i % 2U == 0U ? 1.0F : -1.0F, level = i < 5U ? 5.0F : -1.0F;
        if (i == 5U) {
            selfcal_gate_shift(&gate, 0, -6.0F);
        }
        TEST_ASSERT_EQUAL(SELFCAL_RESTING, selfcal_gate_push(&gate, (const float[2]){level + off, 9.8F - off}));
    }
    TEST_ASSERT_EQUAL(SELFCAL_RESTING, window(-1.0F, 9.8F));
    TEST_ASSERT_EQUAL(SELFCAL_MOVING, window(5.0F, 9.8F));
}

/* The largest samples that count, and the smallest noise: nothing becomes rest by way of a NaN. */
static void extremes_are_motion(void) {
    const float most = nextafterf(SELFCAL_SAMPLE_MAX, 0.0F);
    const selfcal_gate_noise_t tiny = {FLT_MIN, FLT_MIN, 1.0F, FLT_MIN};
    for (uint8_t axis = 0; axis < 2U; axis++) {
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_gate_noise(&gate, axis, &tiny));
    }
    for (unsigned i = 0; i < 1000U; i++) {
        TEST_ASSERT_EQUAL(SELFCAL_MOVING,
                          selfcal_gate_push(&gate, (const float[2]){i % 2U == 0U ? most : -most, -most}));
        TEST_ASSERT_EQUAL(SELFCAL_MOVING, selfcal_gate_push(&gate, (const float[2]){FLT_MAX, NAN}));
    }
    TEST_ASSERT_EQUAL(200, gate.counters.blind);
    for (unsigned i = 0; i < 1000U; i++) {
        TEST_ASSERT_EQUAL(SELFCAL_MOVING,
                          selfcal_gate_push(&gate, (const float[2]){i % 2U == 0U ? most : -most, -most}));
    }
    TEST_ASSERT_EQUAL(100, gate.counters.shaken);
    TEST_ASSERT_EQUAL(SELFCAL_MOVING, selfcal_gate_skip(&gate, UINT64_MAX));
    TEST_ASSERT_EQUAL(SELFCAL_MOVING, selfcal_gate_skip(&gate, 0));
}

/* Samples of noise 1 until the thresholds are known; how many it took. */
static unsigned settle(void) {
    unsigned steps = 0;
    while (gate.work != 0U) {
        (void)selfcal_gate_push(&gate, (const float[2]){steps % 2U == 0U ? 1.0F : -1.0F, 0.0F});
        steps++;
    }
    return steps;
}

/* Thresholds come in steps, as many as the header says at most, over false alarm rates and windows; those worked out at
 * once, for a window of as many samples with one missing, are the same to the last bit: it is one computation, cut. */
static void thresholds_in_steps_are_those_at_once(void) {
    static const float rates[] = {0.1F, 1e-2F, 1e-4F, 1e-8F};
    static const uint32_t windows[] = {100, 273, 2000, 100000};
    for (unsigned i = 0; i < 16U; i++) {
        const selfcal_gate_noise_t coloured = {1.0F, 1.1F, 1.4F, 1.2F};
        config.false_alarm = rates[i / 4U];
        config.window = windows[i % 4U];
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_gate_init(&gate, &config));
        TEST_ASSERT_LESS_OR_EQUAL(60, settle());
        const float white = gate.whole_above;
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_gate_noise(&gate, 0, &coloured));
        TEST_ASSERT_LESS_OR_EQUAL(30, settle());
        const float whole = gate.whole_above, moved = gate.moved_above, rate_moved = gate.rate_moved_above;
        TEST_ASSERT_TRUE(whole > white);

        config.window++;
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_gate_init(&gate, &config));
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_gate_noise(&gate, 0, &coloured));
        for (uint32_t k = 1; k < config.window; k++) {
            (void)selfcal_gate_push(&gate, (const float[2]){0.0F, 0.0F});
        }
        (void)selfcal_gate_skip(&gate, 1);
        TEST_ASSERT_EQUAL_MEMORY(&whole, &gate.shaken_above, sizeof whole);
        TEST_ASSERT_EQUAL_MEMORY(&moved, &gate.moved_above, sizeof moved);
        TEST_ASSERT_EQUAL_MEMORY(&rate_moved, &gate.rate_moved_above, sizeof rate_moved);
    }
}

/* A change of noise just before a window's end is in force at that end, and a gyro left out is out of the gyros'
 * threshold. */
static void a_late_change_of_noise_counts(void) {
    const selfcal_gate_noise_t none = {INFINITY, 1.0F, 1.0F, 1.0F};
    (void)window(5.0F, 9.8F);
    const float two = gate.moved_above;
    for (unsigned i = 0; i < 9U; i++) {
        (void)selfcal_gate_push(&gate, (const float[2]){5.0F, 9.8F});
    }
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_gate_noise(&gate, 0, &none));
    (void)selfcal_gate_push(&gate, (const float[2]){5.0F, 9.8F});
    TEST_ASSERT_TRUE(gate.moved_above < two);
    TEST_ASSERT_TRUE(isinf(gate.rate_moved_above));
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_gate_noise(&gate, 1, &none));
    (void)window(5.0F, 9.8F);
    TEST_ASSERT_TRUE(gate.moved_above < 0.0F);
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(bad_arguments_are_refused);
    RUN_TEST(rest_motion_and_rest_again);
    RUN_TEST(a_shift_by_the_sensor_is_no_motion);
    RUN_TEST(extremes_are_motion);
    RUN_TEST(thresholds_in_steps_are_those_at_once);
    RUN_TEST(a_late_change_of_noise_counts);
    return UNITY_END();
}
