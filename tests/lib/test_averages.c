/* Block means of a drift (lib/averages.c). Truth: covariances of the readings of a block, summed one by one. */
#include "averages.h"
#include "unity.h"

void setUp(void) {}

void tearDown(void) {}

/* Covariance of the means of two blocks of M readings, `apart` blocks from each other, of a Gauss-Markov drift of
 * variance 1 whose neighbours a block apart correlate by e^-x. */
static double of_means(double x, unsigned m, unsigned apart) {
    double sum = 0.0;
    for (unsigned i = 0; i < m; i++) {
        for (unsigned j = 0; j < m; j++) {
            sum += exp(-x * fabs((double)(apart * m + j) - (double)i) / (double)m);
        }
    }
    return sum / ((double)m * (double)m);
}

/* Covariance of a block's last reading and the mean of the block `before` blocks earlier. */
static double of_last(double x, unsigned m, unsigned before) {
    double sum = 0.0;
    for (unsigned j = 0; j < m; j++) {
        sum += exp(-x * (double)(before * m + m - 1U - j) / (double)m);
    }
    return sum / (double)m;
}

static const double widths[] = {2e-3, 0.03, 0.4, 2.0, 5.0};
static const unsigned blocks[] = {2, 5, 30};
#define EACH(table) (unsigned i = 0; i < sizeof(table) / sizeof *(table); i++)

/* Float: beta and b are right to some units of 6e-8, and so is their quotient. */
static void the_points_covary_as_the_means_do(void) {
    for
        EACH(widths) {
            for (unsigned k = 0; k < 3U; k++) {
                const double x = widths[i];
                const unsigned m = blocks[k];
                const selfcal_averaged_t of = selfcal_averaged((selfcal_real_t)x, m);
                for (unsigned apart = 1; apart <= 2U; apart++) {
                    const double point = (double)of.gain * exp(-x * (double)apart);
                    TEST_ASSERT_TRUE(fabs(point / of_means(x, m, apart) - 1.0) < 2e-6);
                    TEST_ASSERT_TRUE(fabs((double)of.now * point / of_last(x, m, apart) - 1.0) < 2e-6);
                }
                /* the last reading's variance is 1 */
                TEST_ASSERT_TRUE(fabs((double)of.now * (double)of.now * (double)of.gain + (double)of.after - 1.0) <
                                 2e-6);
            }
        }
}

/* The points have more variance than the means: by the white noise that they leave out. Below x = 1e-3 a series to
 * x^2/20; above it doubles. */
static void the_rest_is_what_the_means_lack(void) {
    static const selfcal_law_t markov = {1U, false, {{SELFCAL_MARKOV, 1.0F, 1.0F, false, false}}};
    for
        EACH(widths) {
            for (unsigned k = 0; k < 3U; k++) {
                const double x = widths[i];
                const unsigned m = blocks[k];
                const double gain = of_means(x, m, 1) * exp(x), rest = selfcal_white_left_out(&markov, x, 1.0, m);
                TEST_ASSERT_TRUE(fabs(rest - (gain - of_means(x, m, 0))) < 1e-9 + 1e-3 * x * x);
                TEST_ASSERT_TRUE(fabs(rest - (gain - of_means(x, m, 0))) < 1e-9 * gain + (x < 1e-3 ? x * x : 0.0));
            }
        }
}

/* A walk of steps of variance 1/M: variance of a mean less its points', and of a mean over some readings about the mean
 * over all: (r - 1)/M times the sample variance, M (M + 1)/6 steps (Cochran, Sampling Techniques, 2.2). */
static void a_walk(void) {
    static const selfcal_law_t walk = {1U, false, {{SELFCAL_WALK, 1.0F, 0.0F, false, false}}};
    for
        EACH(blocks) {
            const double m = (double)blocks[i];
            double own = 0.0, next = 0.0; /* increments of a block's mean: a triangle over two blocks */
            for (unsigned j = 1; j <= 2U * blocks[i]; j++) {
                const double height = (j <= blocks[i] ? (double)j - 0.0 : 2.0 * m - (double)j) / m;
                own += height * height / m;
                next += j <= blocks[i] ? height * (1.0 - height) / m : 0.0;
            }
            /* variance q of a point's step and white noise -rest: own = q - 2 rest, next = rest's negative */
            const double rest = selfcal_white_left_out(&walk, 0.0, 1.0, blocks[i]);
            TEST_ASSERT_TRUE(fabs(own - (1.0 - 2.0 * rest)) < 1e-12);
            TEST_ASSERT_TRUE(fabs(next - rest) < 1e-12);
            const double scatter = (m + 1.0) / (6.0 * m * m);
            TEST_ASSERT_TRUE(fabs((double)selfcal_averaged_lost(R(1.0), R(0.0), blocks[i]) - (rest + scatter)) < 1e-6);
        }
}

/* lost of a Gauss-Markov drift: the rest and the sample variance over M. The header states 0.6 % for M = 10. */
static void readings_lost_beside_a_drift_that_decays(void) {
    static const selfcal_law_t markov = {1U, false, {{SELFCAL_MARKOV, 1.0F, 1.0F, false, false}}};
    for
        EACH(widths) {
            const double x = widths[i], beta = -expm1(-x);
            const double gain = (double)selfcal_averaged((selfcal_real_t)x, 10).gain;
            const double scatter = (1.0 - of_means(x, 10, 0)) / 9.0; /* (M/(M-1)) (1 - own) over M */
            const double truth = selfcal_white_left_out(&markov, x, 1.0, 10) + scatter;
            const double q = gain * beta * (2.0 - beta);
            const double lost = (double)selfcal_averaged_lost((selfcal_real_t)q, (selfcal_real_t)beta, 10);
            TEST_ASSERT_TRUE(fabs(lost / truth - 1.0) < 6e-3);
        }
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(the_points_covary_as_the_means_do);
    RUN_TEST(the_rest_is_what_the_means_lack);
    RUN_TEST(a_walk);
    RUN_TEST(readings_lost_beside_a_drift_that_decays);
    return UNITY_END();
}
