/* A block's sums in float (lib/intake_float.c): mean and scatter, against sums in double. */
#include "one_axis.h"

void setUp(void) {
    choose(CONSTANT_LAW);
    model.block = 50;
    begin();
}

void tearDown(void) {}

/* About the block's first sample, so that a level of 1000 times the noise costs no digits: 50 roundings of 6e-8 of the
 * scatter, and one of the level. */
static void mean_and_scatter(void) {
    const float levels[] = {0.0F, 9.81F, -500.0F};
    for (unsigned l = 0; l < 3U; l++) {
        double sum = 0.0, square = 0.0;
        const unsigned used = 50U - 10U * l; /* of a block with missing samples the rest */
        bank.origin[0] = levels[l] + 0.25F;
        bank.used = 0;
        selfcal_intake_start(&bank);
        for (unsigned i = 0; i < used; i++) {
            const float sample = levels[l] + 0.5F * noise();
            selfcal_intake_add(&bank, &sample, 1U);
            bank.used++;
            const double y = (double)sample - (double)levels[l];
            sum += y;
            square += y * y;
        }
        TEST_ASSERT_TRUE(selfcal_intake_sound(&bank, 0));
        selfcal_wide_t scatter = 0.0;
        const double mean = (double)selfcal_intake_level(&bank, 0, &scatter);
        TEST_ASSERT_TRUE(fabs(mean - (sum / used - 0.25)) < 1e-6 + 6e-8 * fabs((double)levels[l]));
        TEST_ASSERT_TRUE(close_to(square - sum * sum / used, scatter, 1e-5));
    }
}

/* An axis that is not live adds nothing. */
static void an_axis_that_is_retired(void) {
    const float sample = 7.0F;
    selfcal_intake_start(&bank);
    selfcal_intake_add(&bank, &sample, 0U);
    TEST_ASSERT_TRUE(bank.sums[0].sum == R(0.0) && bank.sums[0].sum_sq == R(0.0));
}

/* Pooled over the blocks: sqrt(sum of squares about the block means / (samples - blocks)). */
static void the_sd_within_blocks(void) {
    enum { BLOCKS = 40 };
    double within = 0.0;
    for (unsigned k = 0; k < BLOCKS; k++) {
        double sum = 0.0, square = 0.0;
        for (unsigned i = 0; i < 50U; i++) {
            const float sample = 0.1F * (float)k + 0.04F * noise();
            push(sample);
            sum += (double)sample;
            square += (double)sample * (double)sample;
        }
        within += square - sum * sum / 50.0;
    }
    const double want = sqrt(within / (BLOCKS * 49.0));
    TEST_ASSERT_FLOAT_WITHIN(1e-5F * (float)want, (float)want, selfcal_within_sd(&bank, 0));
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(mean_and_scatter);
    RUN_TEST(an_axis_that_is_retired);
    RUN_TEST(the_sd_within_blocks);
    return UNITY_END();
}
