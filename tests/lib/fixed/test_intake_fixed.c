/* A block's sums in integers (intake_fixed.c), under UBSan: what would overflow stops the test. */
#include <float.h>
#include <math.h>

#include "noise.h"
#include "selfcal_model.h"
#include "unity.h"

#define AXES SELFCAL_MODEL_AXES
/* Samples of the longest block that is summed here as well. */
#define LONG 100000

static selfcal_t bank;
static selfcal_model_t model;
static selfcal_axis_t axis_table[AXES];
static selfcal_wide_t memory[SELFCAL_SIZE(SELFCAL_MODEL_NODES, AXES) / sizeof(selfcal_wide_t) + 1U];
static float sample[LONG];

static void init(uint32_t block) {
    model = selfcal_model;
    model.block = block;
    for (unsigned axis = 0; axis < AXES; axis++) {
        axis_table[axis] = selfcal_model.axis[axis];
        axis_table[axis].range = 0.0F;
        axis_table[axis].stuck_limit = 0;
    }
    model.axis = axis_table;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_init(&bank, &model, memory, sizeof memory));
}

void setUp(void) {
    state = 12345U;
}

void tearDown(void) {}

static void push(float value) {
    float all[AXES];
    for (unsigned axis = 0; axis < AXES; axis++) {
        all[axis] = axis == 0U ? value : 1.0F;
    }
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push(&bank, all));
    if (bank.position % 64U == 0U) { /* after the last of a block as well; every node is looked at */
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_check(&bank));
    }
}

/* One block of sample[]: mean and scatter against sums in long double (64 bits of mantissa). The mean may be off by a
 * step, 2^-28 of the largest sample, and by its rounding to float, 2^-24 of its distance from the first. The scatter is
 * a difference of float sums about the first sample (2^-22 of the larger); its squares' roots are rounded by 2^-15 of
 * the largest difference at most. */
static void one_block(unsigned count) {
    init(count);
    long double sum = 0.0L, squares = 0.0L, scatter = 0.0L;
    float largest = 0.0F, furthest = 0.0F;
    for (unsigned i = 0; i < count; i++) {
        push(sample[i]);
        const long double off = (long double)sample[i] - (long double)sample[0];
        sum += off;
        squares += off * off;
        largest = fmaxf(largest, fabsf(sample[i]));
        furthest = fmaxf(furthest, fabsf((float)off));
    }
    const long double mean = sum / count;
    for (unsigned i = 0; i < count; i++) {
        const long double off = (long double)sample[i] - (long double)sample[0] - mean;
        scatter += off * off;
    }
    const long double found_mean = selfcal_offset(&bank, 0) - (long double)sample[0];
    TEST_ASSERT_TRUE(fabsl(found_mean - mean) <= ldexpl((long double)largest, -28) + ldexpl(fabsl(mean), -22));
    if (count > 1U) {
        const long double found = (long double)selfcal_within_sd(&bank, 0) * selfcal_within_sd(&bank, 0) * (count - 1);
        const long double rounding = ldexpl((long double)furthest, -15);
        const long double most =
            ldexpl(squares, -21) + 2.0L * rounding * sqrtl(count * squares) + count * rounding * rounding;
        TEST_ASSERT_TRUE(fabsl(found - scatter) <= most);
    }
}

/* Noise about 0, and far from it: gravity, a turn-on bias. */
static void sums_are_those_of_the_samples(void) {
    static const unsigned counts[] = {1, 2, 3, 10, 819, LONG};
    static const float levels[] = {0.0F, 9.81F, -0.3F, 1000.0F, -7.9999F}, sds[] = {1e-12F, 0.01F, 30.0F};
    for (unsigned c = 0; c < sizeof counts / sizeof counts[0]; c++) {
        for (unsigned l = 0; l < sizeof levels / sizeof levels[0]; l++) {
            for (unsigned s = 0; s < sizeof sds / sizeof sds[0]; s++) {
                for (unsigned i = 0; i < counts[c]; i++) {
                    sample[i] = levels[l] + sds[s] * noise();
                }
                one_block(counts[c]);
            }
        }
    }
}

/* The step follows from the least to the largest sample of either sign, after a first of 0 as well. */
static void the_step_follows_any_sample(void) {
    unsigned count = 0;
    sample[count++] = 0.0F;
    for (int e = -149; e < 40; e++) {
        sample[count++] = ldexpf(1.0F, e);
        sample[count++] = -ldexpf(1.5F, e);
        sample[count++] = 0.0F;
    }
    sample[count++] = SELFCAL_SAMPLE_MAX * 0.9999F;
    sample[count++] = FLT_MIN;
    for (unsigned from = 0; from < 4U; from++) {
        for (unsigned i = 0; i + 1U < count; i++) {
            sample[i] = from > 0U && i == 0U ? sample[from] : sample[i];
        }
        one_block(count);
    }
}

/* Head-room: the longest block, in which all samples but the first are `times` the first, the other side of 0; the sums
 * of those that went before are put in their place. 8 times the first is just within ROOM of its step, so that the sum
 * is its greatest; at 7 times the differences are just within 2^15 of the squares' step, so that sum_sq is. */
static const selfcal_block_t *longest(float times) {
    const float first = -ldexpf(1.0F - FLT_EPSILON, 26), other = -times * first;
    init(UINT32_MAX);
    push(first);
    push(other);
    selfcal_block_t *const sums = &bank.sums[0];
    const int64_t so_far = (int64_t)UINT32_MAX - 3;
    sums->sum *= so_far;
    sums->sum_sq *= so_far;
    bank.used = bank.position = UINT32_MAX - 2U;
    bank.counters.samples = bank.used;
    push(other);
    return sums;
}

static void the_longest_block_has_room(void) {
    const selfcal_wide_t bound = ldexp(1.0, 61), sum = (selfcal_wide_t)longest(8.0F)->sum;
    TEST_ASSERT_EQUAL(0, bank.sums[0].exponent);
    TEST_ASSERT_TRUE(sum > 1.124 * bound && sum < 1.125 * bound);
    push(bank.last[0]);
    TEST_ASSERT_EQUAL(1, selfcal_count(&bank));
    TEST_ASSERT_TRUE(fabs(selfcal_offset(&bank, 0) / (selfcal_wide_t)bank.last[0] - 1.0) < 1e-6);
    const selfcal_wide_t squares = (selfcal_wide_t)longest(7.0F)->sum_sq;
    TEST_ASSERT_TRUE(squares > 1.99 * bound && squares <= 2.0 * bound);
    push(bank.last[0]);
    TEST_ASSERT_EQUAL(1, selfcal_count(&bank));
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(sums_are_those_of_the_samples);
    RUN_TEST(the_step_follows_any_sample);
    RUN_TEST(the_longest_block_has_room);
    return UNITY_END();
}
