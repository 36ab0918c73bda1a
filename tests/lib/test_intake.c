/* What reaches the bank and what does not: bad samples, gaps, partly filled blocks. */
#include <float.h>
#include <math.h>
#include <string.h>

#include "noise.h"
#include "selfcal_model.h"
#include "unity.h"

#define AXES SELFCAL_MODEL_AXES
#define BLOCK 10U

static selfcal_t bank;
static selfcal_model_t model;
static selfcal_axis_t axes[AXES];
static selfcal_wide_t memory[SELFCAL_SIZE(SELFCAL_MODEL_NODES, AXES) / sizeof(selfcal_wide_t) + 1U];
static selfcal_t other; /* to compare with */
static selfcal_model_t other_model;
static selfcal_axis_t other_axes[AXES];
static selfcal_wide_t other_memory[SELFCAL_SIZE(SELFCAL_MODEL_NODES, AXES) / sizeof(selfcal_wide_t) + 1U];
static selfcal_work_t work;

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

/* Blocks stay on the even grid of sample instants: 3 before the gap, 24 missing, so the next full block starts 3
 * later. */
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

/* The bound of intake.c, driven to it: whatever the range says, sums stay finite and would for 2^32 bank samples. */
static void huge_samples_cannot_overflow_a_sum(void) {
    for (unsigned axis = 0; axis < AXES; axis++) {
        axes[axis].range = 0.0F;
    }
    push(FLT_MAX); /* as the origin it would swallow all that follows */
    push(-1e38F);
    push(SELFCAL_SAMPLE_MAX);
    TEST_ASSERT_EQUAL(0, selfcal_counters(&bank)->samples);
    TEST_ASSERT_EQUAL(3, selfcal_counters(&bank)->saturated[0]);
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_rate(&bank, BLOCK, 1.0F / SELFCAL_VARIANCE_RATIO_MAX));
    const float most = nextafterf(SELFCAL_SAMPLE_MAX, 0.0F);
    for (unsigned i = 0; i < 100U * BLOCK; i++) {
        push(i / BLOCK % 2U == 0U ? most : -most);
        if (i % 3U == 0U) {
            push(i % 2U == 0U ? FLT_MAX : -FLT_MAX);
        }
    }
    TEST_ASSERT_TRUE(selfcal_count(&bank) > 80U);
    for (uint16_t j = 0; j < model.nodes; j++) {
        selfcal_node_view_t view;
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_node(&bank, 0, j, &view));
        const double most_samples = 4294967296.0 / selfcal_count(&bank);
        TEST_ASSERT_TRUE(view.c > 0.0 && view.c * most_samples < (double)FLT_MAX);
        TEST_ASSERT_TRUE(fabs(view.b) * most_samples < (double)FLT_MAX);
        TEST_ASSERT_TRUE(isfinite(view.drift));
    }
    selfcal_report_t report;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report(&work, &bank, 0, &report)); /* far beyond the priors, but an answer */
    for (unsigned h = 0; h < model.hypotheses; h++) {
        TEST_ASSERT_FALSE(isnan(report.hypothesis[h].ln_evidence));
    }
}

#define DEAD 2U /* the axis that dies */

/* A bank without that axis, fed the rest. */
static void init_other(void) {
    other_model = model;
    other_model.axes = AXES - 1U;
    other_model.axis = other_axes;
    for (unsigned axis = 0; axis < AXES - 1U; axis++) {
        other_axes[axis] = axes[axis < DEAD ? axis : axis + 1U];
    }
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_init(&other, &other_model, other_memory, sizeof other_memory));
}

static void without_dead(const float sample[AXES], float rest[AXES]) {
    for (unsigned axis = 0; axis < AXES - 1U; axis++) {
        rest[axis] = sample[axis < DEAD ? axis : axis + 1U];
    }
}

/* Noise on all axes, the dead one a twin of its neighbour, so that it draws the nodes nowhere else. */
static void rest_sample(float sample[AXES]) {
    for (unsigned axis = 0; axis < AXES; axis++) {
        sample[axis] = (axis < 3U ? 0.1F : 0.01F) * noise() + (float)axis;
    }
    sample[DEAD] = sample[DEAD - 1U];
}

/* Every report of the other axes, bit for bit. */
static void others_equal(void) {
    TEST_ASSERT_EQUAL(selfcal_count(&other), selfcal_count(&bank));
    for (uint8_t axis = 0; axis < AXES - 1U; axis++) {
        selfcal_report_t with, without;
        memset(&with, 0, sizeof with);
        memset(&without, 0, sizeof without);
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report(&work, &bank, (uint8_t)(axis < DEAD ? axis : axis + 1U), &with));
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report(&work, &other, axis, &without));
        without.axis = with.axis;
        TEST_ASSERT_EQUAL_MEMORY(&without, &with, sizeof with);
    }
}

static void a_dead_axis_is_retired_and_the_others_go_on(void) {
    const float signs_of_death[] = {NAN, 1000.0F, INFINITY};
    for (unsigned trial = 0; trial < 6U; trial++) {
        setUp();
        init_other();
        const bool from_the_start = trial >= 3U;
        const unsigned sound = from_the_start ? 0U : 20U * BLOCK + 3U;
        unsigned out = 0;
        for (unsigned i = 0; i < (SELFCAL_RETIRE_BLOCKS + 100U) * BLOCK; i++) {
            float sample[AXES], rest[AXES];
            rest_sample(sample);
            without_dead(sample, rest);
            if (i >= sound) {
                sample[DEAD] = signs_of_death[trial % 3U];
            }
            const bool kept_out = i >= sound && !selfcal_retired(&bank, DEAD);
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push(&bank, sample));
            TEST_ASSERT_EQUAL(SELFCAL_OK, kept_out ? selfcal_skip(&other, 1) : selfcal_push(&other, rest));
            out += kept_out;
        }
        /* RETIRE_BLOCKS whole blocks, and up to one more in which it was sound for a part */
        TEST_ASSERT_TRUE(out >= SELFCAL_RETIRE_BLOCKS * BLOCK - BLOCK / 2U &&
                         out <= (SELFCAL_RETIRE_BLOCKS + 1U) * BLOCK);
        others_equal();
        selfcal_report_t report;
        selfcal_node_view_t view;
        TEST_ASSERT_EQUAL(SELFCAL_AXIS_RETIRED, selfcal_report(&work, &bank, DEAD, &report));
        TEST_ASSERT_EQUAL(SELFCAL_AXIS_RETIRED, selfcal_node(&bank, DEAD, 0, &view));
        TEST_ASSERT_TRUE(isnan(selfcal_within_sd(&bank, DEAD)));
        for (uint8_t axis = 0; axis < AXES; axis++) {
            TEST_ASSERT_EQUAL(axis == DEAD, selfcal_retired(&bank, axis));
        }
        /* It comes back: it stays out, and still nobody else notices. */
        for (unsigned i = 0; i < 100U * BLOCK; i++) {
            float sample[AXES], rest[AXES];
            rest_sample(sample);
            without_dead(sample, rest);
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push(&bank, sample));
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push(&other, rest));
        }
        TEST_ASSERT_TRUE(selfcal_retired(&bank, DEAD));
        others_equal();
    }
}

/* Pushes blocks in each of which `bad` samples of BLOCK fail on the axes of the mask. */
static void push_failing(unsigned bad, unsigned mask, unsigned blocks) {
    for (unsigned i = 0; i < blocks * BLOCK; i++) {
        float sample[AXES];
        rest_sample(sample);
        for (unsigned axis = 0; axis < AXES; axis++) {
            if ((mask >> axis & 1U) != 0U && i % BLOCK >= BLOCK - bad) {
                sample[axis] = NAN;
            }
        }
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push(&bank, sample));
    }
}

static void only_an_axis_that_starves_the_others_is_retired(void) {
    const unsigned long_enough = SELFCAL_RETIRE_BLOCKS + 10U;
    push_failing(BLOCK / 2U, 1U << DEAD, long_enough); /* leaves half of each block: a value each time */
    TEST_ASSERT_FALSE(selfcal_retired(&bank, DEAD));
    TEST_ASSERT_EQUAL(long_enough, selfcal_count(&bank));
    push_failing(BLOCK, 1U << DEAD, SELFCAL_RETIRE_BLOCKS - 1U); /* not long enough */
    push_failing(0, 0, 1);
    push_failing(BLOCK, 1U << DEAD, SELFCAL_RETIRE_BLOCKS - 1U);
    TEST_ASSERT_FALSE(selfcal_retired(&bank, DEAD));
    push_failing(BLOCK, (1U << AXES) - 1U, long_enough); /* the sensor is unplugged: nobody's fault */
    for (uint8_t axis = 0; axis < AXES; axis++) {
        TEST_ASSERT_FALSE(selfcal_retired(&bank, axis));
    }
    push_failing(0, 0, 1);
    push_failing(BLOCK, 7U, long_enough); /* the gyro chip dies */
    for (uint8_t axis = 0; axis < AXES; axis++) {
        TEST_ASSERT_EQUAL(axis < 3U, selfcal_retired(&bank, axis));
    }
    /* The others take turns, each failing in more than half of all samples: one is left. */
    for (unsigned i = 0; i < 3U * long_enough * BLOCK; i++) {
        float sample[AXES];
        rest_sample(sample);
        sample[3U + i % 3U] = NAN;
        sample[3U + (i + 1U) % 3U] = NAN;
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push(&bank, sample));
    }
    TEST_ASSERT_EQUAL(1, !selfcal_retired(&bank, 3) + !selfcal_retired(&bank, 4) + !selfcal_retired(&bank, 5));
}

/* One in three samples beyond the range, as in a swing, or all of them: in motion as at rest the axis is judged by the
 * sound ones too. */
static void motion_retires_only_an_axis_that_is_mostly_at_fault(void) {
    for (unsigned every = 1; every <= 3U; every += 2U) {
        setUp();
        for (unsigned i = 0; i < (SELFCAL_RETIRE_BLOCKS + 10U) * 3U * BLOCK; i++) {
            float sample[AXES];
            rest_sample(sample);
            if (i % every == 0U) {
                sample[DEAD] = -300.0F;
            }
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push_moving(&bank, sample));
        }
        TEST_ASSERT_EQUAL(every == 1U, selfcal_retired(&bank, DEAD));
    }
}

/* To the bank a sample in motion is one that is missing, whatever it holds. */
static void a_sample_in_motion_passes_by(void) {
    init_other();
    for (unsigned i = 0; i < 300U * BLOCK; i++) {
        float sample[AXES], rest[AXES];
        rest_sample(sample);
        without_dead(sample, rest);
        const bool moves = i < 7U || i % 137U < 25U;
        if (moves) {
            sample[i % AXES] = i % 5U == 0U ? 300.0F : 50.0F;
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push_moving(&bank, sample));
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_moving(&other));
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_skip(&other, 1));
        } else {
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push(&bank, sample));
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push(&other, rest));
        }
    }
    others_equal();
    const selfcal_counters_t *mine = selfcal_counters(&bank), *its = selfcal_counters(&other);
    uint64_t saturated = 0;
    for (unsigned axis = 0; axis < AXES; axis++) {
        saturated += mine->saturated[axis];
    }
    TEST_ASSERT_TRUE(saturated > 0U);
    TEST_ASSERT_TRUE(its->missing == mine->missing + saturated);
    /* each in one counter: one axis fails at a time */
    TEST_ASSERT_TRUE(mine->samples + mine->missing + saturated == 300U * BLOCK);
    TEST_ASSERT_TRUE(its->samples == mine->samples && its->blocks_moving == mine->blocks_moving &&
                     its->blocks_moving > 10U);
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_push_moving(NULL, &axes[0].range));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_push_moving(&bank, NULL));
}

/* Readings that the sensor shifts, in the middle of a block and between two, against the same unshifted ones with the
 * block lost: on a lattice on which no sum rounds every report is the same to the bit, but for the bias, which has
 * moved by that. Kept by a snapshot. */
static void a_shift_by_the_sensor_moves_the_bias_alone(void) {
    const float amount[2] = {-4.375F, 1.0F / 64.0F};
    float shifted[AXES] = {0.0F};
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_init(&other, &model, other_memory, sizeof other_memory));
    for (unsigned i = 0; i < 200U * BLOCK; i++) {
        if (i == 80U * BLOCK + 4U || i == 150U * BLOCK) {
            for (uint8_t axis = 0; axis < AXES; axis += 2U) {
                TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_shift(&bank, axis, amount[i / (150U * BLOCK)]));
                shifted[axis] += amount[i / (150U * BLOCK)];
            }
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_moving(&other));
        }
        float with[AXES], without[AXES];
        for (unsigned axis = 0; axis < AXES; axis++) {
            without[axis] = 4.0F + floorf(noise() * 8.0F) / 64.0F;
            with[axis] = without[axis] + shifted[axis];
        }
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push(&bank, with));
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push(&other, without));
    }
    for (uint8_t axis = 0; axis < AXES; axis++) {
        selfcal_report_t moved, still;
        memset(&moved, 0, sizeof moved);
        memset(&still, 0, sizeof still);
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report(&work, &bank, axis, &moved));
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report(&work, &other, axis, &still));
        TEST_ASSERT_EQUAL(199, still.n);
        TEST_ASSERT_EQUAL_FLOAT(shifted[axis], selfcal_shifted(&bank, axis));
        TEST_ASSERT_FLOAT_WITHIN(1e-6F, still.bias_mean + shifted[axis], moved.bias_mean);
        moved.bias_mean = still.bias_mean;
        /* of means that are rounded elsewhere */
        TEST_ASSERT_FLOAT_WITHIN(1e-5F * still.bias_sd, still.bias_sd, moved.bias_sd);
        moved.bias_sd = still.bias_sd;
        for (unsigned h = 0; h < SELFCAL_MODEL_HYPOTHESES; h++) {
            TEST_ASSERT_FLOAT_WITHIN(1e-6F, still.hypothesis[h].bias_mean + shifted[axis],
                                     moved.hypothesis[h].bias_mean);
            moved.hypothesis[h].bias_mean = still.hypothesis[h].bias_mean;
        }
        TEST_ASSERT_EQUAL_MEMORY(&still, &moved, sizeof still);
    }
    /* a rounding that the origin cannot hold is kept in the offset: to 1e-9 of 9.8 where a float has 1e-6 */
    const selfcal_wide_t before = selfcal_offset(&bank, 1);
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_shift(&bank, 1, 1.23456789e-4F));
    TEST_ASSERT_TRUE(fabs(selfcal_offset(&bank, 1) - before - (selfcal_wide_t)1.23456789e-4F) < 1e-9);
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_shift(NULL, 0, 1.0F));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_shift(&bank, AXES, 1.0F));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_shift(&bank, 0, NAN));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_shift(&bank, 0, SELFCAL_SAMPLE_MAX));
}

static void motion_drops_the_block_in_progress(void) {
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_moving(NULL));
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_moving(&bank)); /* nothing in progress */
    for (unsigned i = 0; i < BLOCK; i++) {
        push(1.0F);
    }
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_moving(&bank));
    TEST_ASSERT_EQUAL(0, selfcal_counters(&bank)->blocks_moving);
    push(100.0F);
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_moving(&bank));
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_moving(&bank)); /* no more to drop */
    for (unsigned i = 0; i < BLOCK - 1U; i++) {
        push(100.0F); /* nine of ten would be a block */
    }
    const selfcal_counters_t *counters = selfcal_counters(&bank);
    TEST_ASSERT_EQUAL(1, selfcal_count(&bank));
    TEST_ASSERT_EQUAL(1, counters->blocks_moving);
    TEST_ASSERT_EQUAL(1, counters->blocks_lost);
    TEST_ASSERT_EQUAL(1, counters->gaps);
    for (unsigned i = 0; i < BLOCK; i++) {
        push(3.0F); /* and the grid has stayed */
    }
    TEST_ASSERT_EQUAL(2, selfcal_count(&bank));
    TEST_ASSERT_FLOAT_WITHIN(1e-6F, 2.0F, (float)constant().b); /* 0 + 2: the 100s are nowhere */
}

static void a_change_of_rate_changes_the_weight_alone(void) {
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_rate(NULL, 5, 1.0F));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_rate(&bank, 0, 1.0F));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_rate(&bank, 5, 0.0F));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_rate(&bank, 5, NAN));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_rate(&bank, 5, 2.0F * SELFCAL_VARIANCE_RATIO_MAX));
    for (unsigned i = 0; i < BLOCK + 4U; i++) {
        push(1.0F);
    }
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_rate(&bank, BLOCK / 2U, 2.0F)); /* 4 of 10 have passed: 2 of 5 */
    for (unsigned i = 0; i < 3U; i++) {
        push(77.0F);
    }
    TEST_ASSERT_EQUAL(1, selfcal_counters(&bank)->blocks_lost);
    for (unsigned i = 0; i < BLOCK / 2U; i++) {
        push(3.0F);
    }
    TEST_ASSERT_EQUAL(2, selfcal_count(&bank));
    const selfcal_node_view_t view = constant();
    TEST_ASSERT_FLOAT_WITHIN(1e-6F, 1.5F, (float)view.a);          /* 1 + 1/2 */
    TEST_ASSERT_FLOAT_WITHIN(1e-6F, 2.0F, (float)view.c);          /* 0 + 4/2 */
    TEST_ASSERT_FLOAT_WITHIN(1e-6F, logf(2.0F), (float)view.ln_s); /* ln 1 + ln 2 */
    /* the density stays: whole blocks weigh as ever */
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_rate(&bank, 4U * BLOCK, 1.0F));
    for (unsigned i = 0; i < 4U * BLOCK; i++) {
        push(1.0F);
    }
    TEST_ASSERT_EQUAL(3, selfcal_count(&bank));
    TEST_ASSERT_FLOAT_WITHIN(1e-6F, 2.5F, (float)constant().a);
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_skip(&bank, 9U * 4U * BLOCK)); /* gaps are in new samples */
    TEST_ASSERT_EQUAL(10, selfcal_counters(&bank)->blocks_lost);
}

/* Found by fuzzing: a whole batch at a small ratio. The constant law's s is r, so D = n ln r; 1e-12 of it, for the long
 * sum has twice the digits of float. */
static void better_samples_than_the_models_keep_ln_s(void) {
    const float ratio = 1.0F / 768.0F;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_rate(&bank, 1U, ratio));
    for (int i = 0; i < 1000; i++) {
        push(1.0F + 0.01F * noise());
    }
    selfcal_node_view_t view;
    for (uint16_t index = 0; index < model.nodes; index++) {
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_node(&bank, 0, index, &view));
        TEST_ASSERT_TRUE(isfinite(view.ln_s));
    }
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_node(&bank, 0, 0, &view));
    TEST_ASSERT_EQUAL(0, view.hypothesis);
    TEST_ASSERT_TRUE(fabs(view.ln_s - 1000.0 * log((selfcal_wide_t)ratio)) < 1e-12 * 1000.0 * 6.7);
}

/* Found by fuzzing: counts beyond their type stay at its end rather than start anew. */
static void counters_never_run_backwards(void) {
    push(1.0F);
    for (int i = 0; i < 3; i++) {
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_skip(&bank, UINT64_MAX - 5U));
        TEST_ASSERT_TRUE(selfcal_counters(&bank)->missing == (i == 0 ? UINT64_MAX - 5U : UINT64_MAX));
        TEST_ASSERT_TRUE(selfcal_counters(&bank)->blocks_lost == UINT32_MAX);
    }
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
    RUN_TEST(huge_samples_cannot_overflow_a_sum);
    RUN_TEST(a_dead_axis_is_retired_and_the_others_go_on);
    RUN_TEST(only_an_axis_that_starves_the_others_is_retired);
    RUN_TEST(motion_retires_only_an_axis_that_is_mostly_at_fault);
    RUN_TEST(a_sample_in_motion_passes_by);
    RUN_TEST(a_shift_by_the_sensor_moves_the_bias_alone);
    RUN_TEST(motion_drops_the_block_in_progress);
    RUN_TEST(a_change_of_rate_changes_the_weight_alone);
    RUN_TEST(counters_never_run_backwards);
    RUN_TEST(better_samples_than_the_models_keep_ln_s);
    return UNITY_END();
}
