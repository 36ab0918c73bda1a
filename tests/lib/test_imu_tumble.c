/* The calibration by rests in the pipe: a simulated part that is put as the progress says. Truth: its T K, biases and G
 * by hand, a = (T K)^-1 f + b, y = b + G f. Noise is the model's median N, so the told sd is the true one. */
#include "noise.h"
#include "selfcal_model.h"
#include "unity.h"

#include <math.h>
#include <string.h>

enum { BLOCK = 15, WINDOW = 5, AXES = SELFCAL_MODEL_AXES, REST = 400, SAVED_MOST = 100000 };

static const double matrix[3][3] = {{0.985, 0.021, -0.017}, {0.0, 1.012, 0.013}, {0.0, 0.0, 1.006}};
static const double bias[3] = {-0.22, 0.31, 0.14}, gyro_bias[3] = {0.7, -0.4, 0.3}, g0 = 9.80665;
static const double G[3][3] = {{0.03, -0.02, 0.01}, {0.0, 0.04, 0.02}, {-0.01, 0.02, -0.03}}; /* deg/s per m/s^2 */
static const signed char sides[SELFCAL_TUMBLE_POSITIONS][3] = {{0, 0, 1},  {0, 1, 0},  {1, 0, 0}, {0, 0, -1},
                                                               {0, -1, 0}, {-1, 0, 0}, {1, 1, 0}, {1, -1, 0},
                                                               {1, 0, 1},  {-1, 0, 1}, {0, 1, 1}, {0, -1, 1}};

static selfcal_gate_config_t gate_config;
static selfcal_pipe_t pipe;
static selfcal_model_t model;
static selfcal_wide_t
    memory[(SELFCAL_MODEL_IMU_BYTES + sizeof(selfcal_imu_tumble_t) + 8U) / sizeof(selfcal_wide_t) + 1U];
static selfcal_imu_t imu;
static selfcal_kept_t kept;
static float shifted[AXES];
static unsigned char saved[SAVED_MOST];
static size_t length;

static void begin(void) {
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_imu_init(&imu, &pipe, memory, sizeof memory));
    selfcal_imu_keep(&imu, &kept);
}

void setUp(void) {
    state = 20261128U;
    gate_config = selfcal_model_gate;
    gate_config.window = WINDOW;
    for (unsigned axis = 0; axis < AXES; axis++) {
        gate_config.sigma[axis] = axis < 3U ? 0.2F : 0.02F;
    }
    pipe = selfcal_model_pipe;
    pipe.model = &model;
    pipe.rate_hz = (float)BLOCK;
    pipe.gate = &gate_config;
    pipe.tumbling = &selfcal_model_tumbling;
    pipe.tumbling_code = &selfcal_tumbling_code;
    model = selfcal_model;
    model.block = BLOCK;
    model.dt_s = 1.0F;
    memset(shifted, 0, sizeof shifted);
    begin();
}

void tearDown(void) {}

/* Force of an attitude, by the side that is up. */
static void force_at(double x, double y, double z, double f[3]) {
    const double size = g0 / sqrt(x * x + y * y + z * z);
    f[0] = x * size;
    f[1] = y * size;
    f[2] = z * size;
}

/* One sample under a force; `shaken`: in the hand. */
static void sample(const double f[3], double noisy, bool shaken) {
    double a[3];
    float reading[AXES];
    for (int i = 2; i >= 0; i--) { /* back substitution */
        a[i] = f[i];
        for (int j = i + 1; j < 3; j++) {
            a[i] -= matrix[i][j] * a[j];
        }
        a[i] /= matrix[i][i];
    }
    const selfcal_tumble_noise_t *N = pipe.tumbling->part.noise;
    for (int i = 0; i < 3; i++) {
        const double rate = gyro_bias[i] + G[i][0] * f[0] + G[i][1] * f[1] + G[i][2] * f[2];
        const double accel_sd = noisy * sqrt(BLOCK) * (double)N[i].N;
        const double gyro_sd = noisy * sqrt(BLOCK) * (double)N[3 + i].N * 57.29577951;
        reading[i] = (float)(rate + gyro_sd * (double)noise() + (shaken ? 30.0 * (double)noise() : 0.0)) + shifted[i];
        reading[3 + i] = (float)(a[i] + bias[i] + accel_sd * (double)noise()) + shifted[3 + i];
    }
    (void)selfcal_imu_sample(&imu, reading, NULL, NULL);
}

static void rest_at(const double f[3], unsigned samples) {
    for (unsigned k = 0; k < samples; k++) {
        sample(f, 1.0, k < BLOCK);
    }
}

/* Until the rest counts, if there is room. The gate's false alarms may begin it anew. */
static void rest_on(uint8_t side) {
    double f[3];
    const uint8_t before = selfcal_imu_tumble_progress(&imu)->rests;
    force_at(sides[side][0], sides[side][1], sides[side][2], f);
    rest_at(f, BLOCK);
    for (unsigned k = 0; k < 10U * REST && selfcal_imu_tumble_progress(&imu)->rests == before; k++) {
        sample(f, 1.0, false);
        selfcal_imu_skip(&imu, k % 31U == 30U ? 2U : 0U); /* lost samples, also across the end of a window */
    }
}

/* As the progress says, to its end; the rests. */
static unsigned follow(void) {
    unsigned rests = 0;
    TEST_ASSERT_TRUE(selfcal_imu_tumble_start(&imu));
    while (selfcal_imu_tumble_progress(&imu)->next < SELFCAL_TUMBLE_POSITIONS) {
        rest_on(selfcal_imu_tumble_progress(&imu)->next);
        rests++;
        TEST_ASSERT_EQUAL(rests, selfcal_imu_tumble_progress(&imu)->rests);
        TEST_ASSERT_EQUAL(SELFCAL_TUMBLE_TURN, selfcal_imu_tumble_progress(&imu)->phase);
    }
    return rests;
}

/* A corrected sample without noise is the true force, within 5 of its sd, which is below a tenth of the errors. */
static void assert_corrects(void) {
    double f[3];
    selfcal_corrected_t corrected;
    force_at(0.4, -0.7, 0.5, f);
    sample(f, 0.0, false);
    TEST_ASSERT_TRUE(selfcal_imu_corrected(&imu, &corrected));
    for (int i = 0; i < 3; i++) {
        TEST_ASSERT_EQUAL(SELFCAL_REASON_NONE, corrected.reason[3 + i]);
        TEST_ASSERT_TRUE(corrected.sd[3 + i] < 0.015F);
        TEST_ASSERT_FLOAT_WITHIN(5.0F * corrected.sd[3 + i], (float)f[i], corrected.value[3 + i]);
    }
}

static void assert_corrects_nothing(void) {
    double f[3];
    selfcal_corrected_t corrected;
    force_at(0.4, -0.7, 0.5, f);
    sample(f, 0.0, false);
    TEST_ASSERT_NULL(selfcal_imu_tumbled(&imu));
    TEST_ASSERT_TRUE(selfcal_imu_corrected(&imu, &corrected));
    TEST_ASSERT_TRUE(isnan(corrected.sd[3]) && isnan(corrected.sd[4]) && isnan(corrected.sd[5]));
}

static bool put(void *context, const void *bytes, size_t count) {
    (void)context;
    TEST_ASSERT_TRUE(length + count <= sizeof saved);
    memcpy(saved + length, bytes, count);
    length += count;
    return true;
}

static void save(void) {
    length = 0;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_imu_save(&imu, put, NULL));
}

/* The six faces first, then edges, twelve in all; the part is found within 5 sd, and the bank has taken nothing. */
static void test_the_part_is_found(void) {
    uint32_t faces = 0, word_there = 0;
    TEST_ASSERT_TRUE(selfcal_imu_tumble_start(&imu));
    for (unsigned k = 0; k < 6U; k++) {
        const uint8_t next = selfcal_imu_tumble_progress(&imu)->next;
        faces |= 1U << next;
        rest_on(next);
    }
    TEST_ASSERT_EQUAL_HEX(0x3F, faces);
    TEST_ASSERT_EQUAL(12U, follow()); /* anew */
    TEST_ASSERT_EQUAL(12U, selfcal_imu_tumble_progress(&imu)->wanted);
    TEST_ASSERT_EQUAL(0U, imu.bank.counters.samples);
    TEST_ASSERT_EQUAL(SELFCAL_TUMBLE_OK, selfcal_imu_tumble_stop(&imu));
    const selfcal_tumbled_t *found = selfcal_imu_tumbled(&imu);
    TEST_ASSERT_NOT_NULL(found);
    const double angle[3] = {matrix[0][1] / matrix[1][1], matrix[0][2] / matrix[2][2], matrix[1][2] / matrix[2][2]};
    for (unsigned i = 0; i < 9U; i++) {
        const double truth = i < 3U ? bias[i] : i < 6U ? matrix[i - 3U][i - 3U] - 1.0 : angle[i - 6U];
        const float sd = sqrtf(found->covariance[i * (i + 3U) / 2U]);
        TEST_ASSERT_FLOAT_WITHIN(5.0F * sd, (float)truth, found->accel[i]);
        /* sd of G: N / sqrt(15 s) over the root of 4 g^2, the sum of squares along an axis */
        const double N = (double)pipe.tumbling->part.noise[3].N / sqrt(15.0) / (2.0 * g0);
        TEST_ASSERT_FLOAT_WITHIN((float)(5.0 * N), (float)(G[i / 3U][i % 3U] / 57.29577951), found->G[i]);
    }
    TEST_ASSERT_EQUAL_HEX(0x1FF, found->accel_identified);
    assert_corrects();
    (void)selfcal_imu_tumble_words(&imu, &word_there);
    TEST_ASSERT_EQUAL_HEX((1UL << SELFCAL_TUMBLE_WORDS) - 1UL, word_there);
    rest_at((const double[3]){0.0, 0.0, 9.8}, REST);
    TEST_ASSERT_TRUE(imu.bank.counters.samples > 0U);
}

/* Each with its reason, and what was known before stays. */
static void test_what_comes_to_nothing(void) {
    TEST_ASSERT_EQUAL(SELFCAL_TUMBLE_BAD_ARGUMENT, selfcal_imu_tumble_stop(&imu));
    TEST_ASSERT_TRUE(selfcal_imu_tumble_start(&imu));
    TEST_ASSERT_EQUAL(SELFCAL_TUMBLE_TOO_FEW, selfcal_imu_tumble_stop(&imu));
    assert_corrects_nothing();
    (void)follow();
    TEST_ASSERT_EQUAL(SELFCAL_TUMBLE_OK, selfcal_imu_tumble_stop(&imu));
    TEST_ASSERT_TRUE(selfcal_imu_tumble_start(&imu));
    rest_on(0);
    rest_on(3);
    TEST_ASSERT_EQUAL(SELFCAL_TUMBLE_TOO_FEW, selfcal_imu_tumble_stop(&imu));
    TEST_ASSERT_EQUAL(SELFCAL_TUMBLE_TOO_FEW, selfcal_imu_tumble_progress(&imu)->status);
    assert_corrects();
    TEST_ASSERT_TRUE(selfcal_imu_tumble_start(&imu)); /* three rests tell the gyros' bias, and less than is known */
    rest_on(0);
    rest_on(1);
    rest_on(2);
    TEST_ASSERT_EQUAL(SELFCAL_TUMBLE_NOTHING, selfcal_imu_tumble_stop(&imu));
    assert_corrects();
    TEST_ASSERT_TRUE(selfcal_imu_tumble_start(&imu));
    for (unsigned k = 0; k < 4U; k++) {
        rest_on(1);
    }
    TEST_ASSERT_EQUAL(SELFCAL_TUMBLE_NOTHING, selfcal_imu_tumble_stop(&imu));
    assert_corrects();
    imu.bank.retired = 2U;
    TEST_ASSERT_FALSE(selfcal_imu_tumble_start(&imu));
    imu.bank.retired = 0U;
    (void)selfcal_imu_watch(&imu, false);
    TEST_ASSERT_FALSE(selfcal_imu_tumble_start(&imu));
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_imu_forget(&imu));
    assert_corrects_nothing();
    pipe.tumbling_code = NULL;
    begin();
    TEST_ASSERT_FALSE(selfcal_imu_tumble_start(&imu));
    TEST_ASSERT_EQUAL(SELFCAL_TUMBLE_BAD_ARGUMENT, selfcal_imu_tumble_stop(&imu));
    pipe.tumbling_code = &selfcal_tumbling_code;
    pipe.tumbling = NULL;
    TEST_ASSERT_EQUAL(SELFCAL_BAD_MODEL, selfcal_imu_init(&imu, &pipe, memory, sizeof memory));
}

/* A rest below ten seconds does not count, nor one that a wrong reading or a gap breaks; beyond 24 there is no room.
 * While angles are not identified, more than twelve are wanted. */
static void test_rests_that_do_not_count(void) {
    double f[3];
    force_at(0.0, 0.0, 1.0, f);
    TEST_ASSERT_TRUE(selfcal_imu_tumble_start(&imu));
    rest_at(f, BLOCK + 17U * WINDOW + 9U * BLOCK);
    TEST_ASSERT_EQUAL(SELFCAL_TUMBLE_HOLD, selfcal_imu_tumble_progress(&imu)->phase);
    const float wrong[AXES] = {NAN, NAN, NAN, NAN, NAN, NAN};
    (void)selfcal_imu_sample(&imu, wrong, NULL, NULL);
    TEST_ASSERT_EQUAL(SELFCAL_TUMBLE_PLACE, selfcal_imu_tumble_progress(&imu)->phase);
    selfcal_imu_skip(&imu, 5000U);
    rest_at(f, BLOCK + 17U * WINDOW + 9U * BLOCK);
    TEST_ASSERT_EQUAL(0U, selfcal_imu_tumble_progress(&imu)->rests);
    for (unsigned k = 0; k < SELFCAL_TUMBLE_MAX + 3U; k++) {
        const selfcal_tumble_progress_t *progress = selfcal_imu_tumble_progress(&imu);
        TEST_ASSERT_EQUAL(k < 12U ? 12U : k < SELFCAL_TUMBLE_MAX ? k + 1U : SELFCAL_TUMBLE_MAX, progress->wanted);
        rest_on((uint8_t)(k % 6U));
    }
    TEST_ASSERT_EQUAL(SELFCAL_TUMBLE_MAX, selfcal_imu_tumble_progress(&imu)->rests);
    TEST_ASSERT_EQUAL(SELFCAL_TUMBLE_POSITIONS, selfcal_imu_tumble_progress(&imu)->next);
    TEST_ASSERT_EQUAL(SELFCAL_TUMBLE_OK, selfcal_imu_tumble_stop(&imu));
    TEST_ASSERT_EQUAL_HEX(0x3F, selfcal_imu_tumbled(&imu)->accel_identified);
}

/* The result comes back with the state. With any bit of it wrong, or cut short, it does not, and nothing is applied. */
static void test_saved_state(void) {
    static unsigned char without[SAVED_MOST];
    save();
    const size_t plain = length;
    memcpy(without, saved, plain);
    (void)follow();
    TEST_ASSERT_EQUAL(SELFCAL_TUMBLE_OK, selfcal_imu_tumble_stop(&imu));
    const selfcal_tumbled_t found = *selfcal_imu_tumbled(&imu);
    save();
    TEST_ASSERT_EQUAL(plain + SELFCAL_TUMBLE_SAVED, length);
    for (size_t at = plain; at < length; at++) {
        begin();
        saved[at] ^= 0x10U;
        TEST_ASSERT_NOT_EQUAL(SELFCAL_OK, selfcal_imu_restore(&imu, saved, length, 0));
        TEST_ASSERT_NULL(selfcal_imu_tumbled(&imu));
        saved[at] ^= 0x10U;
    }
    for (size_t cut = 1; cut < length - plain; cut += 7U) {
        begin();
        TEST_ASSERT_NOT_EQUAL(SELFCAL_OK, selfcal_imu_restore(&imu, saved, length - cut, 0));
        TEST_ASSERT_NULL(selfcal_imu_tumbled(&imu));
    }
    begin();
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_imu_restore(&imu, without, plain, 0)); /* of an image before */
    assert_corrects_nothing();
    begin();
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_imu_restore(&imu, saved, length, 0));
    TEST_ASSERT_EQUAL_MEMORY(&found, selfcal_imu_tumbled(&imu), sizeof found);
    assert_corrects();
    /* a bank of another model is refused; the part is the same one */
    begin();
    saved[16] ^= 1U;
    TEST_ASSERT_NOT_EQUAL(SELFCAL_OK, selfcal_imu_restore(&imu, saved, length, 0));
    assert_corrects();
}

/* The sensor itself adds to its readings, before and after. */
static void test_offsets_of_the_sensor(void) {
    for (uint8_t axis = 0; axis < (uint8_t)AXES; axis++) {
        shifted[axis] = 0.5F - 0.2F * (float)axis;
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_imu_shift(&imu, axis, shifted[axis]));
    }
    (void)follow();
    TEST_ASSERT_EQUAL(SELFCAL_TUMBLE_OK, selfcal_imu_tumble_stop(&imu));
    assert_corrects();
    TEST_ASSERT_FLOAT_WITHIN(0.02F, (float)bias[1], selfcal_imu_tumbled(&imu)->accel[1]); /* of the bare part */
    shifted[4] += 1.5F;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_imu_shift(&imu, 4, 1.5F));
    assert_corrects();
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(test_the_part_is_found);
    RUN_TEST(test_what_comes_to_nothing);
    RUN_TEST(test_rests_that_do_not_count);
    RUN_TEST(test_saved_state);
    RUN_TEST(test_offsets_of_the_sensor);
    return UNITY_END();
}
