/* What reaches the bank and what does not: bad samples, gaps, partly filled blocks. */
#include <math.h>
#include <string.h>

#include "selfcal_model.h"
#include "unity.h"

#define AXES SELFCAL_MODEL_AXES
#define BLOCK 10U

static selfcal_t bank;
static selfcal_model_t model;
static selfcal_axis_t axes[AXES];
static selfcal_wide_t memory[SELFCAL_SIZE(SELFCAL_MODEL_NODES, AXES) / sizeof(selfcal_wide_t) + 1U];

void setUp(void) {
    model = selfcal_model;
    memcpy(axes, selfcal_model.axis, sizeof axes);
    for (unsigned axis = 0; axis < AXES; axis++) {
        axes[axis].range = 300.0F;
        axes[axis].stuck_limit = 0;
    }
    model.axis = axes;
    model.block = BLOCK;
    model.dt_s = 1.0F;
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

static void push_on(unsigned axis, float value, float others) {
    float sample[AXES];
    for (unsigned k = 0; k < AXES; k++) {
        sample[k] = k == axis ? value : others;
    }
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push(&bank, sample));
}

/* B of the constant law: the sum of bank samples about the first, over their variance factors. */
static selfcal_node_view_t constant(void) {
    selfcal_node_view_t view;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_node(&bank, 0, 0, &view));
    return view;
}

static void a_block_is_averaged(void) {
    for (unsigned i = 0; i < 3U * BLOCK; i++) {
        push((float)i);
    }
    /* means 4.5, 14.5, 24.5: about the first 0, 10, 20 */
    TEST_ASSERT_EQUAL(3, selfcal_count(&bank));
    TEST_ASSERT_FLOAT_WITHIN(1e-5F, 4.5F, (float)selfcal_offset(&bank, 0));
    const selfcal_node_view_t view = constant();
    TEST_ASSERT_FLOAT_WITHIN(1e-4F, 30.0F, (float)view.b);
    TEST_ASSERT_FLOAT_WITHIN(1e-3F, 500.0F, (float)view.c);
    /* 0..9 about their mean: sum of squares 82.5 over 9 degrees of freedom */
    TEST_ASSERT_FLOAT_WITHIN(1e-4F, sqrtf(82.5F / 9.0F), selfcal_within_sd(&bank, 0));
}

static void samples_that_are_no_number_stay_out(void) {
    const float bad[] = {NAN, INFINITY, -INFINITY};
    for (unsigned i = 0; i < 4U * BLOCK; i++) {
        push(1.0F);
        if (i % 13U == 5U) {
            push_on(2, bad[i % 3U], 1.0F);
        }
    }
    const selfcal_counters_t *counters = selfcal_counters(&bank);
    TEST_ASSERT_EQUAL(40, counters->samples);
    TEST_ASSERT_EQUAL(3, counters->not_finite[2]);
    TEST_ASSERT_EQUAL(0, counters->not_finite[0]);
    TEST_ASSERT_EQUAL(3, counters->gaps);
    const selfcal_node_view_t view = constant();
    TEST_ASSERT_TRUE(isfinite(view.c) && fabs(view.c) < 1e-12); /* all the rest is one level */
}

static void saturated_samples_stay_out(void) {
    for (unsigned i = 0; i < 2U * BLOCK; i++) {
        push(1.0F);
    }
    push_on(1, 300.0F, 1.0F);
    push_on(1, -301.0F, 1.0F);
    push_on(1, 299.9F, 1.0F);
    const selfcal_counters_t *counters = selfcal_counters(&bank);
    TEST_ASSERT_EQUAL(2, counters->saturated[1]);
    TEST_ASSERT_EQUAL(21, counters->samples);
    TEST_ASSERT_EQUAL(1, counters->gaps);
}

static void stuck_samples_stay_out(void) {
    axes[0].stuck_limit = 5;
    for (unsigned i = 0; i < 20U; i++) {
        push_on(0, 7.0F, (float)i);
    }
    push_on(0, 8.0F, 0.0F);
    const selfcal_counters_t *counters = selfcal_counters(&bank);
    TEST_ASSERT_EQUAL(16, counters->stuck[0]); /* the 5th to the 20th */
    TEST_ASSERT_EQUAL(0, counters->stuck[1]);
    TEST_ASSERT_EQUAL(5, counters->samples);
}

static void half_a_block_is_enough_and_weighs_half(void) {
    for (unsigned i = 0; i < BLOCK; i++) {
        push(1.0F);
    }
    for (unsigned i = 0; i < BLOCK / 2U; i++) {
        push(3.0F);
    }
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_skip(&bank, BLOCK / 2U));
    TEST_ASSERT_EQUAL(2, selfcal_count(&bank));
    TEST_ASSERT_EQUAL(1, selfcal_counters(&bank)->blocks_part);
    const selfcal_node_view_t view = constant();
    TEST_ASSERT_FLOAT_WITHIN(1e-6F, 1.5F, (float)view.a); /* 1 + 1/2 */
    TEST_ASSERT_FLOAT_WITHIN(1e-6F, 1.0F, (float)view.b); /* 0 + 2/2 */
    TEST_ASSERT_FLOAT_WITHIN(1e-6F, 2.0F, (float)view.c); /* 0 + 4/2 */
}

static void less_than_half_a_block_is_dropped(void) {
    for (unsigned i = 0; i < BLOCK + 4U; i++) {
        push(1.0F);
    }
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_skip(&bank, BLOCK - 4U));
    TEST_ASSERT_EQUAL(1, selfcal_count(&bank));
    TEST_ASSERT_EQUAL(1, selfcal_counters(&bank)->blocks_lost);
}

/* Blocks stay on the even grid of sample instants: 3 before the gap, 24 missing, so the next full block starts 3 later. */
static void a_gap_keeps_the_grid(void) {
    for (unsigned i = 0; i < 2U * BLOCK + 3U; i++) {
        push(1.0F);
    }
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_skip(&bank, 24));
    TEST_ASSERT_EQUAL(2, selfcal_counters(&bank)->blocks_lost); /* 3 of 10, then none of 10 */
    for (unsigned i = 0; i < 3U; i++) {
        push(1.0F); /* the rest of a block that lacks 7 */
    }
    TEST_ASSERT_EQUAL(3, selfcal_counters(&bank)->blocks_lost);
    for (unsigned i = 0; i < BLOCK; i++) {
        push(1.0F);
    }
    TEST_ASSERT_EQUAL(3, selfcal_count(&bank));
}

static void time_before_the_first_sample_does_not_count(void) {
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_skip(&bank, 123456));
    push_on(0, NAN, 1.0F);
    for (unsigned i = 0; i < BLOCK; i++) {
        push(1.0F);
    }
    TEST_ASSERT_EQUAL(1, selfcal_count(&bank));
    TEST_ASSERT_EQUAL(0, selfcal_counters(&bank)->gaps);
    TEST_ASSERT_EQUAL(123456, selfcal_counters(&bank)->missing);
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(a_block_is_averaged);
    RUN_TEST(samples_that_are_no_number_stay_out);
    RUN_TEST(saturated_samples_stay_out);
    RUN_TEST(stuck_samples_stay_out);
    RUN_TEST(half_a_block_is_enough_and_weighs_half);
    RUN_TEST(less_than_half_a_block_is_dropped);
    RUN_TEST(a_gap_keeps_the_grid);
    RUN_TEST(time_before_the_first_sample_does_not_count);
    return UNITY_END();
}
