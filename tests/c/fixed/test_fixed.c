/* The number formats of kernel_fixed.c, built with SELFCAL_FIXED under UBSan: what would overflow stops the test. */
#include <math.h>
#include <string.h>

#include "../noise.h"
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

/* The white noise of the first batch is 2^20 to 2^21 steps; here its sample sd over 15 differences, hence a factor 2 more. */
static void the_first_batch_sets_the_step(void) {
    start(0.04F);
    TEST_ASSERT_TRUE(0.04F / step() > 524288.0F && 0.04F / step() < 4194304.0F);
}

/* Every node at the bound of |y|, at random and then as it hurts most: the innovation doubles when the sign turns after a node has
 * followed. 20 000 samples pass all times 1/g that settle. The values are judged in tests/py/test_long.py. */
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

/* Node 0 is the constant law, whose C is the sum of y^2 about the offset: a leap of 10^6 sigma changes the step and nothing else. */
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
    TEST_ASSERT_TRUE(selfcal_scale(&bank, 0)->most_y > SELFCAL_FIXED_LIMIT / 2 && selfcal_scale(&bank, 0)->most_y <= SELFCAL_FIXED_LIMIT);
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

/* The sum C itself near the end of its 64 bits: the step doubles before it overflows. */
static void a_full_sum_coarsens_the_step(void) {
    start(0.04F);
    const float before = step();
    bank.c[0] = INT64_C(1) << 61;
    const selfcal_wide_t c = view(0).c;
    for (int i = 0; i < 2 * SELFCAL_BATCH; i++) {
        push(0.04F * noise());
    }
    TEST_ASSERT_TRUE(fabs(view(0).c / c - 1.0) < 1e-9);
    TEST_ASSERT_TRUE(step() == 2.0F * before);
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(the_first_batch_sets_the_step);
    RUN_TEST(nothing_overflows_at_the_bound);
    RUN_TEST(a_leap_coarsens_the_step_and_keeps_the_sums);
    RUN_TEST(any_leap_fits);
    RUN_TEST(small_readings_make_the_step_finer);
    RUN_TEST(a_full_sum_coarsens_the_step);
    return UNITY_END();
}
