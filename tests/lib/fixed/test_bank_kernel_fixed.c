/* The number formats of bank_kernel_fixed.c, built with SELFCAL_FIXED under UBSan: what would overflow stops the
 * test. */
#include <math.h>
#include <string.h>

#include "noise.h"
#include "selfcal_model.h"
#include "unity.h"

#define AXES SELFCAL_MODEL_AXES

static selfcal_t bank;
static selfcal_model_t model;
static selfcal_axis_t axis_table[AXES];
static selfcal_wide_t memory[SELFCAL_SIZE(SELFCAL_MODEL_NODES, AXES) / sizeof(selfcal_wide_t) + 1U];

void setUp(void) {
    model = selfcal_model;
    model.block = 1;
    model.dt_s = 1.0F;
    for (unsigned axis = 0; axis < AXES; axis++) {
        axis_table[axis] = selfcal_model.axis[axis];
        axis_table[axis].range = 0.0F;
        axis_table[axis].stuck_limit = 0;
    }
    model.axis = axis_table;
    state = 12345U;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_init(&bank, &model, memory, sizeof memory));
}

void tearDown(void) {}

static void push(float value) {
    float sample[AXES];
    for (unsigned axis = 0; axis < AXES; axis++) {
        sample[axis] = value;
    }
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push(&bank, sample));
}

static selfcal_node_view_t view(uint16_t node) {
    selfcal_node_view_t v;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_node(&bank, 0, node, &v));
    return v;
}

static float step(void) {
    return ldexpf(1.0F, selfcal_scale(&bank, 0)->exponent);
}

static void start(float sd) {
    for (int i = 0; i < SELFCAL_BATCH; i++) {
        push(sd * noise());
    }
    (void)view(0);
}

/* The white noise of the first batch is 2^20 to 2^21 steps; here its sample sd over 15 differences, hence a factor 2
 * more. */
static void the_first_batch_sets_the_step(void) {
    start(0.04F);
    TEST_ASSERT_TRUE(0.04F / step() > 524288.0F && 0.04F / step() < 4194304.0F);
}

/* Every node at the bound of |y|, at random and then as it hurts most: the innovation doubles when the sign turns after
 * a node has followed. 20 000 samples pass all times 1/g that settle. The values are judged in
 * tests/agree/test_long.py. */
static void nothing_overflows_at_the_bound(void) {
    start(0.04F);
    const float bound = (float)SELFCAL_FIXED_LIMIT * step() * 0.99999F - 0.2F;
    for (int i = 0; i < 4000; i++) {
        push(noise() > 0.0F ? bound : -bound);
    }
    for (int half = 1; half < 8000; half *= 3) {
        for (int i = 0; i < 4 * half; i++) {
            push(i / half % 2 == 0 ? bound : -bound);
        }
    }
    for (uint16_t j = 0; j < model.nodes; j++) {
        TEST_ASSERT_TRUE(view(j).c > 0.0 && isfinite(view(j).c));
    }
    TEST_ASSERT_EQUAL(0, selfcal_scale(&bank, 0)->coarser);
}

/* Node 0 is the constant law, whose C is the sum of y^2 about the offset: a leap of 10^6 sigma changes the step and
 * nothing else. */
static void a_leap_coarsens_the_step_and_keeps_the_sums(void) {
    start(0.04F);
    for (int i = 0; i < 160; i++) {
        push(0.04F * noise());
    }
    const selfcal_wide_t before = view(0).c;
    const selfcal_wide_t from = selfcal_offset(&bank, 0);
    const selfcal_wide_t leap = (selfcal_wide_t)40000.0F - from;
    push(40000.0F);
    const selfcal_wide_t after = view(0).c;
    TEST_ASSERT_EQUAL(1, selfcal_scale(&bank, 0)->coarser);
    TEST_ASSERT_TRUE(fabs(after - leap * leap - before) < 1e-6 * after);
    TEST_ASSERT_TRUE(40000.0F / step() <= (float)SELFCAL_FIXED_LIMIT);
}

/* From the finest step the largest sample: 80 doublings. */
static void any_leap_fits(void) {
    for (unsigned axis = 0; axis < AXES; axis++) {
        axis_table[axis].prior[SELFCAL_N].ln_min = -40.0F;
    }
    start(1e-12F);
    const float largest = SELFCAL_SAMPLE_MAX * 0.999F;
    push(largest);
    const selfcal_wide_t c = view(0).c;
    TEST_ASSERT_TRUE(fabs(c / ((selfcal_wide_t)largest * (selfcal_wide_t)largest) - 1.0) < 1e-6);
    TEST_ASSERT_TRUE(selfcal_scale(&bank, 0)->most_y > SELFCAL_FIXED_LIMIT / 2 &&
                     selfcal_scale(&bank, 0)->most_y <= SELFCAL_FIXED_LIMIT);
}

/* A first batch that was shaken makes the step too coarse by 1000; once the readings are small it shrinks again. */
static void small_readings_make_the_step_finer(void) {
    axis_table[0].prior[SELFCAL_N].ln_max = 10.0F;
    start(400.0F);
    const float coarse = step();
    const float quiet = (float)selfcal_offset(&bank, 0); /* y = 0 there */
    for (int i = 0; i < 40000; i++) {
        push(quiet + 0.4F * noise());
    }
    (void)view(0);
    TEST_ASSERT_TRUE(selfcal_scale(&bank, 0)->finer > 0);
    TEST_ASSERT_TRUE(step() < coarse);
}

/* Either sum near the end of its 64 bits: the step doubles before it overflows. */
static void a_full_sum_coarsens_the_step(selfcal_total_t *sum, int64_t full) {
    start(0.04F);
    const float before = step();
    *sum = full;
    const selfcal_node_view_t v = view(0);
    for (int i = 0; i < 2 * SELFCAL_BATCH; i++) {
        push(0.04F * noise());
    }
    TEST_ASSERT_TRUE(fabs(view(0).b / v.b - 1.0) < 1e-9 || sum != bank.b);
    TEST_ASSERT_TRUE(fabs(view(0).c / v.c - 1.0) < 1e-9 || sum != bank.c);
    TEST_ASSERT_TRUE(step() == 2.0F * before);
}

static void a_full_c_coarsens_the_step(void) {
    a_full_sum_coarsens_the_step(bank.c, INT64_C(1) << 61);
}

static void a_full_b_coarsens_the_step(void) {
    a_full_sum_coarsens_the_step(bank.b, -(INT64_C(1) << 61) - 1);
}

static int32_t most_sum(void) {
    return selfcal_scale(&bank, 0)->most_sum;
}

/* The most that a sample can weigh, 1/s = 2^10 by selfcal_rate(), at the bound of |y|, with and without the longest
 * gaps (which open every gain), from full sums on: they turn back at 2^61, the mark within a factor 2 of it. Only the
 * constant law can be told its sums: C of all of y^2/r. */
static void the_heaviest_samples_make_room(void) {
    start(0.04F);
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_rate(&bank, 1, 1.0F / SELFCAL_VARIANCE_RATIO_MAX));
    const size_t cells = (size_t)model.nodes * AXES;
    for (size_t k = 0; k < cells; k++) {
        bank.c[k] = (INT64_C(1) << 61) - 1;
        bank.b[k] = (k / AXES) % 2U == 0U ? (INT64_C(1) << 61) - 1 : 1 - (INT64_C(1) << 61);
    }
    selfcal_wide_t c = view(0).c;
    int32_t most = 0;
    const float from = (float)selfcal_offset(&bank, 0);
    for (int i = 0; i < 64 * SELFCAL_BATCH; i++) {
        const float bound = (float)SELFCAL_FIXED_LIMIT * step() * 0.999F - fabsf(from);
        const float value = (i / 40) % 2 == 0 ? bound : -bound;
        push(value);
        const selfcal_wide_t y = (selfcal_wide_t)value - selfcal_offset(&bank, 0);
        c += y * y * (selfcal_wide_t)SELFCAL_VARIANCE_RATIO_MAX;
        if (i % 7 == 0) {
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_skip(&bank, UINT64_MAX));
        }
        most = most_sum() > most ? most_sum() : most;
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_check(&bank));
    }
    TEST_ASSERT_TRUE(selfcal_scale(&bank, 0)->coarser > 0);
    TEST_ASSERT_TRUE(most >= 1 << 29 && most < (1 << 29) + (1 << 22)); /* 2^61 + 2^54 */
    TEST_ASSERT_TRUE(fabs(view(0).c / c - 1.0) < 1e-4);
}

/* Drives every axis over its range, as far as no sample counts as saturated, after a quiet first batch or from the
 * start. */
static void full_scale(bool at_once) {
    static const int bound[AXES] = SELFCAL_MODEL_EXPONENTS;
    model.axis = selfcal_model.axis;
    model.dt_s = selfcal_model.dt_s;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_init(&bank, &model, memory, sizeof memory));
    for (int i = 0; i < 6 * SELFCAL_BATCH; i++) {
        float sample[AXES];
        for (unsigned axis = 0; axis < AXES; axis++) {
            const float far = 0.99999F * model.axis[axis].range * (i % 2 == 0 ? 1.0F : -1.0F);
            sample[axis] = at_once || i >= SELFCAL_BATCH ? far : 0.9999F * model.axis[axis].range + 1e-3F * noise();
        }
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push(&bank, sample));
    }
    (void)view(0);
    for (uint8_t axis = 0; axis < AXES; axis++) {
        TEST_ASSERT_EQUAL(0, selfcal_counters(&bank)->saturated[axis]);
        TEST_ASSERT_TRUE(selfcal_scale(&bank, axis)->exponent <= bound[axis]);
        TEST_ASSERT_TRUE(selfcal_scale(&bank, axis)->exponent >= bound[axis] - 1);
    }
}

/* SELFCAL_MODEL_EXPONENTS: no reading within the range makes a step coarser, and some make it so within a factor 2.
 * (Where the prior lets a first batch from end to end pass for noise: tests/agree/test_long.py.) */
static void the_models_exponents_bound_the_steps(void) {
    full_scale(true);
    full_scale(false);
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(the_first_batch_sets_the_step);
    RUN_TEST(nothing_overflows_at_the_bound);
    RUN_TEST(a_leap_coarsens_the_step_and_keeps_the_sums);
    RUN_TEST(any_leap_fits);
    RUN_TEST(small_readings_make_the_step_finer);
    RUN_TEST(a_full_c_coarsens_the_step);
    RUN_TEST(a_full_b_coarsens_the_step);
    RUN_TEST(the_heaviest_samples_make_room);
    RUN_TEST(the_models_exponents_bound_the_steps);
    return UNITY_END();
}
