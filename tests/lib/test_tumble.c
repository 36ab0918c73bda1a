/* The calibration from rests, through its public header: a part without noise, and hostile input. Its numbers under
 * noise and drift are compared with the host's in tests/lib/test_tumble_host.py. */
#include <math.h>
#include <string.h>

#include "tumble.h"
#include "unity.h"

enum { TWELVE = 12 };

/* The truth: T K and the bias by hand, a = (T K)^-1 f + b. */
static const double matrix[3][3] = {{1.01, -0.0099, 0.02}, {0.0, 0.99, -0.015}, {0.0, 0.0, 1.02}};
static const double bias[3] = {0.3, -0.2, 0.1}, gyro_bias[3] = {0.02, -0.01, 0.03};
static const double G[3][3] = {{1e-5, -2e-5, 3e-5}, {0.0, 4e-5, 1e-5}, {-3e-5, 2e-5, 0.0}};
static const double gravity = 9.81;

static selfcal_tumble_part_t part;
static selfcal_tumble_rest_t rests[TWELVE];
static selfcal_tumble_work_t work;
static selfcal_tumble_t found;

static void turn_to(selfcal_tumble_rest_t *rest, double x, double y, double z) {
    const double size = gravity / sqrt(x * x + y * y + z * z), f[3] = {x * size, y * size, z * size};
    double a[3];
    for (int i = 2; i >= 0; i--) { /* back substitution */
        a[i] = f[i];
        for (int j = i + 1; j < 3; j++) {
            a[i] -= matrix[i][j] * a[j];
        }
        a[i] /= matrix[i][i];
    }
    for (int i = 0; i < 3; i++) {
        rest->mean[i] = (float)(a[i] + bias[i]);
        rest->mean[3 + i] = (float)(gyro_bias[i] + G[i][0] * f[0] + G[i][1] * f[1] + G[i][2] * f[2]);
    }
}

void setUp(void) {
    static const signed char up[TWELVE][3] = {{0, 0, 1}, {0, 1, 0},  {1, 0, 0}, {0, 0, -1}, {0, -1, 0}, {-1, 0, 0},
                                              {1, 1, 0}, {1, -1, 0}, {1, 0, 1}, {-1, 0, 1}, {0, 1, 1},  {0, -1, 1}};
    memset(&part, 0, sizeof part);
    part.gravity = (float)gravity;
    for (unsigned axis = 0; axis < 6U; axis++) {
        part.noise[axis] = (selfcal_tumble_noise_t){axis < 3U ? 1e-3F : 1e-4F, axis < 3U ? 1e-5F : 1e-6F, 0.0F, 0.0F};
    }
    for (unsigned n = 0; n < TWELVE; n++) {
        turn_to(&rests[n], up[n][0], up[n][1], up[n][2]);
        rests[n].begin_s = 20.0F * (float)n;
        rests[n].end_s = rests[n].begin_s + 15.0F;
    }
}

void tearDown(void) {}

/* Refused with a reason, and no number is left of the calibration before. */
static void refused(selfcal_tumble_status_t reason, uint8_t count) {
    found.accel_identified = 0x1FFU;
    found.bias[0] = 1.0F;
    TEST_ASSERT_EQUAL(reason, selfcal_tumble(&found, &part, rests, count, &work));
    TEST_ASSERT_EQUAL(0, found.accel_identified);
    TEST_ASSERT_EQUAL(0, found.gyro_identified);
    for (unsigned k = 0; k < SELFCAL_TUMBLE_ACCEL; k++) {
        TEST_ASSERT_TRUE(isnan(found.accel[k]) && isnan(selfcal_tumble_accel_sd(&found, (uint8_t)k)));
    }
    for (unsigned i = 0; i < 3U; i++) {
        TEST_ASSERT_TRUE(isnan(found.bias[i]) && isnan(found.gyro_bias[i]) && isnan(found.gyro[i][0]));
        for (unsigned j = 0; j < 3U; j++) {
            TEST_ASSERT_TRUE(isnan(found.matrix[i][j]) && isnan(found.G[i][j]));
        }
    }
    TEST_ASSERT_TRUE(isnan(found.ratio));
}

/* Readings in float are off by 5e-7 m/s^2, and the priors pull by less. */
static void a_part_without_noise_is_found(void) {
    TEST_ASSERT_EQUAL(SELFCAL_TUMBLE_OK, selfcal_tumble(&found, &part, rests, TWELVE, &work));
    TEST_ASSERT_EQUAL(0x1FF, found.accel_identified);
    TEST_ASSERT_EQUAL(0xFFF, found.gyro_identified);
    for (unsigned i = 0; i < 3U; i++) {
        TEST_ASSERT_FLOAT_WITHIN(2e-6F, (float)bias[i], found.bias[i]);
        TEST_ASSERT_FLOAT_WITHIN(1e-7F, (float)gyro_bias[i], found.gyro_bias[i]);
        for (unsigned j = 0; j < 3U; j++) {
            TEST_ASSERT_FLOAT_WITHIN(1e-6F, (float)matrix[i][j], found.matrix[i][j]);
            TEST_ASSERT_FLOAT_WITHIN(1e-8F, (float)G[i][j], found.G[i][j]);
        }
        TEST_ASSERT_TRUE(selfcal_tumble_accel_sd(&found, (uint8_t)i) > 0.0F);
        TEST_ASSERT_TRUE(selfcal_tumble_gyro_sd(&found, (uint8_t)i, 1) > 0.0F);
    }
    TEST_ASSERT_TRUE(found.ratio < 0.1F);
}

static void a_reading_is_corrected(void) {
    TEST_ASSERT_EQUAL(SELFCAL_TUMBLE_OK, selfcal_tumble(&found, &part, rests, TWELVE, &work));
    selfcal_tumble_rest_t other;
    turn_to(&other, 1.0, 2.0, -2.0);
    float corrected[6];
    selfcal_tumble_apply(&found, other.mean, corrected);
    const float f[3] = {3.27F, 6.54F, -6.54F};
    for (unsigned i = 0; i < 3U; i++) {
        TEST_ASSERT_FLOAT_WITHIN(1e-5F, f[i], corrected[i]);
        TEST_ASSERT_FLOAT_WITHIN(3e-7F, 0.0F, corrected[3U + i]);
    }
}

static void six_flats_have_no_angles(void) {
    TEST_ASSERT_EQUAL(SELFCAL_TUMBLE_OK, selfcal_tumble(&found, &part, rests, 6, &work));
    TEST_ASSERT_EQUAL(0x3F, found.accel_identified);
    TEST_ASSERT_EQUAL(0xFFF, found.gyro_identified);
    TEST_ASSERT_TRUE(isnan(found.accel[6]) && isnan(selfcal_tumble_accel_sd(&found, 8)));
    TEST_ASSERT_TRUE(isnan(found.ratio)); /* no rest to spare */
    TEST_ASSERT_FALSE(isnan(found.matrix[0][1]));
}

static void edges_without_the_yz_plane_leave_its_angle(void) {
    TEST_ASSERT_EQUAL(SELFCAL_TUMBLE_OK, selfcal_tumble(&found, &part, rests, 10, &work));
    TEST_ASSERT_EQUAL(0xFF, found.accel_identified);
}

static void rests_that_say_nothing(void) {
    refused(SELFCAL_TUMBLE_TOO_FEW, 0);
    refused(SELFCAL_TUMBLE_TOO_FEW, 2);
    for (unsigned axis = 0; axis < 6U; axis++) {
        part.noise[axis].N = 1e5F; /* the priors are all that is known */
    }
    refused(SELFCAL_TUMBLE_NOTHING, TWELVE);
}

/* The gyros' bias is a mean, but for 0.1 deg/s of an unknown G: three rests and equal positions have it. */
static void few_positions_have_the_bias_of_the_gyros(void) {
    for (unsigned k = 0; k < 2U; k++) {
        const uint8_t count = k == 0U ? 3U : TWELVE;
        for (unsigned n = 1; k == 1U && n < TWELVE; n++) {
            memcpy(rests[n].mean, rests[0].mean, sizeof rests[n].mean);
        }
        TEST_ASSERT_EQUAL(SELFCAL_TUMBLE_OK, selfcal_tumble(&found, &part, rests, count, &work));
        TEST_ASSERT_EQUAL(0, found.accel_identified);
        TEST_ASSERT_EQUAL(0x111, found.gyro_identified & 0x111);
        for (unsigned i = 0; i < 3U; i++) {
            const float sd = selfcal_tumble_gyro_sd(&found, (uint8_t)i, 0);
            TEST_ASSERT_TRUE(sd > 0.0F && sd < 2e-3F);
            TEST_ASSERT_FLOAT_WITHIN(3.0F * sd, (float)gyro_bias[i], (float)found.gyro[i][0]);
            TEST_ASSERT_TRUE(isnan(found.accel[i]) && isnan(selfcal_tumble_accel_sd(&found, (uint8_t)i)));
        }
    }
}

/* Squares of 0.5 mg at 1 g: the intervals of the bias hold them, and corrected flats are near 1 g. */
static void a_square_is_in_the_intervals(void) {
    for (unsigned n = 0; n < TWELVE; n++) {
        for (unsigned i = 0; i < 3U; i++) {
            const float x = rests[n].mean[i] - (float)bias[i];
            rests[n].mean[i] += (i == 1U ? -5e-5F : 5e-5F) * x * x;
        }
    }
    TEST_ASSERT_EQUAL(SELFCAL_TUMBLE_OK, selfcal_tumble(&found, &part, rests, TWELVE, &work));
    for (unsigned i = 0; i < 3U; i++) {
        const float sd = selfcal_tumble_accel_sd(&found, (uint8_t)i);
        TEST_ASSERT_FLOAT_WITHIN(2.0F * sd, (float)bias[i], (float)found.accel[i]);
        TEST_ASSERT_TRUE(sd < 5e-3F);
    }
    for (unsigned n = 0; n < 6U; n++) { /* 5e-5 x^2 is 4.8e-3 */
        float corrected[6];
        selfcal_tumble_apply(&found, rests[n].mean, corrected);
        const float *f = corrected;
        TEST_ASSERT_FLOAT_WITHIN(2.4e-3F, (float)gravity, sqrtf(f[0] * f[0] + f[1] * f[1] + f[2] * f[2]));
    }
}

/* In a plane the axis across it has neither scale nor angle, and no gyro a sensitivity along it. */
static void rests_in_a_plane_identify_what_they_can(void) {
    for (unsigned n = 0; n < TWELVE; n++) {
        turn_to(&rests[n], cos(0.5 * n), sin(0.5 * n), 0.0);
    }
    TEST_ASSERT_EQUAL(SELFCAL_TUMBLE_OK, selfcal_tumble(&found, &part, rests, TWELVE, &work));
    TEST_ASSERT_EQUAL(0, found.accel_identified & 1U << 5); /* scale of z */
    TEST_ASSERT_EQUAL(1U << 3 | 1U << 4, found.accel_identified & (1U << 3 | 1U << 4));
    TEST_ASSERT_TRUE(isnan(found.accel[5]));
    TEST_ASSERT_EQUAL(0, found.gyro_identified & 1U << 3); /* of x along z */
    TEST_ASSERT_EQUAL(1U << 1 | 1U << 2, found.gyro_identified & (1U << 1 | 1U << 2));
}

static void hostile_rests(void) {
    static const float bad[] = {NAN, INFINITY, -INFINITY, 3e38F, -1e7F};
    for (unsigned k = 0; k < sizeof bad / sizeof bad[0]; k++) {
        for (unsigned axis = 0; axis < 6U; axis++) {
            setUp();
            rests[axis + k].mean[axis] = bad[k];
            refused(SELFCAL_TUMBLE_BAD_REST, TWELVE);
        }
        setUp();
        rests[k].begin_s = bad[k];
        refused(SELFCAL_TUMBLE_BAD_REST, TWELVE);
        setUp();
        rests[k].end_s = bad[k];
        refused(SELFCAL_TUMBLE_BAD_REST, TWELVE);
    }
    setUp();
    rests[4].end_s = rests[4].begin_s; /* no length */
    refused(SELFCAL_TUMBLE_BAD_REST, TWELVE);
    setUp();
    rests[4].begin_s = rests[3].begin_s; /* into the one before */
    refused(SELFCAL_TUMBLE_BAD_REST, TWELVE);
}

static void hostile_parts(void) {
    static const float bad[] = {NAN, INFINITY, -1.0F, 0.0F, 1e7F};
    for (unsigned k = 0; k < sizeof bad / sizeof bad[0]; k++) {
        setUp();
        part.gravity = bad[k];
        refused(SELFCAL_TUMBLE_BAD_PART, TWELVE);
        setUp();
        part.noise[k].N = bad[k];
        refused(SELFCAL_TUMBLE_BAD_PART, TWELVE);
        if (bad[k] != 0.0F) { /* no drift is one */
            setUp();
            part.noise[5].K = bad[k];
            refused(SELFCAL_TUMBLE_BAD_PART, TWELVE);
            setUp();
            part.level = bad[k];
            refused(SELFCAL_TUMBLE_BAD_PART, TWELVE);
        }
    }
}

static void bad_arguments(void) {
    TEST_ASSERT_EQUAL(SELFCAL_TUMBLE_BAD_ARGUMENT, selfcal_tumble(NULL, &part, rests, TWELVE, &work));
    TEST_ASSERT_EQUAL(SELFCAL_TUMBLE_BAD_ARGUMENT, selfcal_tumble(&found, NULL, rests, TWELVE, &work));
    TEST_ASSERT_EQUAL(SELFCAL_TUMBLE_BAD_ARGUMENT, selfcal_tumble(&found, &part, NULL, TWELVE, &work));
    TEST_ASSERT_EQUAL(SELFCAL_TUMBLE_BAD_ARGUMENT, selfcal_tumble(&found, &part, rests, TWELVE, NULL));
    refused(SELFCAL_TUMBLE_BAD_ARGUMENT, SELFCAL_TUMBLE_MAX + 1);
    TEST_ASSERT_TRUE(isnan(selfcal_tumble_accel_sd(&found, 9)) && isnan(selfcal_tumble_gyro_sd(&found, 3, 0)));
}

/* Readings of another unit, zeros, and lengths that no part has: a reason or numbers, never a NaN among the numbers. */
static void no_answer_has_a_silent_nan(void) {
    static const float scale[] = {0.0F, 1e-6F, 0.1F, 3.0F, 1000.0F, 1e5F};
    for (unsigned k = 0; k < sizeof scale / sizeof scale[0]; k++) {
        setUp();
        for (unsigned n = 0; n < TWELVE; n++) {
            for (unsigned axis = 0; axis < 6U; axis++) {
                rests[n].mean[axis] *= scale[k];
            }
        }
        if (selfcal_tumble(&found, &part, rests, TWELVE, &work) == SELFCAL_TUMBLE_OK) {
            TEST_ASSERT_TRUE(found.ratio > 2.0F);
            for (unsigned i = 0; i < SELFCAL_TUMBLE_ACCEL; i++) {
                TEST_ASSERT_EQUAL((found.accel_identified >> i & 1U) != 0U, isfinite(found.accel[i]) != 0);
            }
        } else {
            TEST_ASSERT_EQUAL(0, found.accel_identified);
        }
    }
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(a_part_without_noise_is_found);
    RUN_TEST(a_reading_is_corrected);
    RUN_TEST(six_flats_have_no_angles);
    RUN_TEST(edges_without_the_yz_plane_leave_its_angle);
    RUN_TEST(rests_that_say_nothing);
    RUN_TEST(few_positions_have_the_bias_of_the_gyros);
    RUN_TEST(a_square_is_in_the_intervals);
    RUN_TEST(rests_in_a_plane_identify_what_they_can);
    RUN_TEST(hostile_rests);
    RUN_TEST(hostile_parts);
    RUN_TEST(bad_arguments);
    RUN_TEST(no_answer_has_a_silent_nan);
    return UNITY_END();
}
