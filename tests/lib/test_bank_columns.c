/* Regressors in the bank and in a report (lib/bank_columns.c): least squares in closed form, of a law without drift. */
#include "one_axis.h"

enum { COLUMNS = 2, SAMPLES = 400, FREE = SAMPLES - COLUMNS - 1 };

static const float reference[COLUMNS] = {20.0F, 0.0F};
static float coefficient_sd[COLUMNS], ln_odds[COLUMNS];
static selfcal_regressors_t regressors;
static selfcal_work_t work;
static selfcal_report_t report;
static selfcal_coefficients_t coefficients;

static double y[SAMPLES], z[SAMPLES][COLUMNS];

void setUp(void) {
    choose(CONSTANT_LAW);
    coefficient_sd[0] = coefficient_sd[1] = 10.0F;
    regressors.code = &selfcal_regressors_code;
    regressors.count = COLUMNS;
    regressors.reference = reference;
    regressors.coefficient_sd = coefficient_sd;
    regressors.ln_odds = ln_odds;
    model.regressors = &regressors;
    begin();
    for (unsigned i = 0; i < SAMPLES; i++) {
        /* 0.3 + 0.02 (z1 - 20) - 0.05 z2 and noise; the columns correlate */
        const float value[COLUMNS] = {20.0F + 3.0F * sinf(0.02F * (float)i), 2.0F * sinf(0.02F * (float)i) + noise()};
        const float sample = 0.3F + 0.02F * (value[0] - 20.0F) - 0.05F * value[1] + 0.04F * noise();
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push_with(&bank, &sample, value));
        y[i] = (double)sample;
        z[i][0] = (double)value[0] - 20.0;
        z[i][1] = (double)value[1];
    }
}

void tearDown(void) {}

static double covariance(unsigned a, unsigned b) { /* COLUMNS: of the readings */
    double mean_a = 0.0, mean_b = 0.0, sum = 0.0;
    for (unsigned pass = 0; pass < 2U; pass++) {
        for (unsigned i = 0; i < SAMPLES; i++) {
            const double of_a = a < COLUMNS ? z[i][a] : y[i], of_b = b < COLUMNS ? z[i][b] : y[i];
            if (pass == 0U) {
                mean_a += of_a / SAMPLES;
                mean_b += of_b / SAMPLES;
            } else {
                sum += (of_a - mean_a) * (of_b - mean_b);
            }
        }
    }
    return sum;
}

/* Coefficients of least squares, with their inverse normal matrix and what is left. */
static void least_squares(double c[COLUMNS], double inverse[COLUMNS], double *left) {
    const double a = covariance(0, 0), b = covariance(0, 1), d = covariance(1, 1), det = a * d - b * b;
    const double of_y[COLUMNS] = {covariance(0, COLUMNS), covariance(1, COLUMNS)};
    c[0] = (d * of_y[0] - b * of_y[1]) / det;
    c[1] = (a * of_y[1] - b * of_y[0]) / det;
    inverse[0] = d / det;
    inverse[1] = a / det;
    *left = covariance(COLUMNS, COLUMNS) - c[0] * of_y[0] - c[1] * of_y[1];
}

static void make_report(uint8_t mask) {
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report_begin_subset(&work, &bank, 0, mask, &coefficients, &report));
    selfcal_status_t status;
    do {
        status = selfcal_report_step(&work, &report);
    } while (status == SELFCAL_BUSY);
    TEST_ASSERT_EQUAL(SELFCAL_OK, status);
}

/* Under wide priors Student densities of n - 3 degrees of freedom: variance left / (n - 5) (Box & Tiao, Bayesian
 * Inference, 2.7). The prior's sd of 10 takes 1e-7 off. */
static void coefficients_are_those_of_least_squares(void) {
    double c[COLUMNS], inverse[COLUMNS], left = 0.0;
    least_squares(c, inverse, &left);
    make_report(3U);
    for (unsigned k = 0; k < COLUMNS; k++) {
        const double sd = sqrt(inverse[k] * left / (FREE - 2.0));
        TEST_ASSERT_TRUE(fabs((double)coefficients.mean[k] - c[k]) < 1e-3 * sd);
        TEST_ASSERT_TRUE(close_to(sd, (double)coefficients.sd[k], 2e-3));
    }
}

/* Evidence with both columns less that without: the integrals over both coefficients and sigma_v,
 *   -ln det(prior)/2 - ln det(normal)/2 + (n-1)/2 ln S0 - (n-3)/2 ln S + ln Gamma's.
 * Float sums of 400 squares: 1e-3 nat. */
static void the_gain_is_the_ratio_of_integrals(void) {
    double c[COLUMNS], inverse[COLUMNS], left = 0.0;
    least_squares(c, inverse, &left);
    const double a = covariance(0, 0), b = covariance(0, 1), d = covariance(1, 1), free = FREE;
    const double of_prior = -0.5 * (c[0] * c[0] + c[1] * c[1]) / 100.0 - log(100.0);
    const double want = of_prior - 0.5 * log(a * d - b * b) + lgamma(0.5 * free) - lgamma(0.5 * (free + 2.0)) +
                        0.5 * (free + 2.0) * log(0.5 * covariance(COLUMNS, COLUMNS)) - 0.5 * free * log(0.5 * left);
    make_report(0U);
    const double without = report.hypothesis[0].ln_evidence;
    make_report(3U);
    TEST_ASSERT_TRUE(want > 20.0);
    TEST_ASSERT_TRUE(fabs(report.hypothesis[0].ln_evidence - without - want) < 5e-3);
}

/* x0 + c' (z - reference) at the last sample. */
static void the_bias_stands_at_the_last_value(void) {
    double c[COLUMNS], inverse[COLUMNS], left = 0.0, level = 0.0;
    least_squares(c, inverse, &left);
    for (unsigned i = 0; i < SAMPLES; i++) {
        level += (y[i] - c[0] * z[i][0] - c[1] * z[i][1]) / SAMPLES;
    }
    make_report(3U);
    const double want = level + c[0] * z[SAMPLES - 1][0] + c[1] * z[SAMPLES - 1][1];
    TEST_ASSERT_TRUE(fabs((double)report.bias_mean - want) < 1e-2 * (double)report.bias_sd);
    TEST_ASSERT_FLOAT_WITHIN(1e-5F, (float)z[SAMPLES - 1][1], selfcal_regressor_last(&bank, 1));
}

/* A prior of sd 0 leaves the column out of the axis. */
static void an_axis_may_lack_a_column(void) {
    coefficient_sd[1] = 0.0F;
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_report_begin_subset(&work, &bank, 0, 3U, &coefficients, &report));
    make_report(1U);
    TEST_ASSERT_TRUE(isfinite(coefficients.mean[0]) && isnan(coefficients.mean[1]));
    /* the other column is noise beside it: the slope alone */
    TEST_ASSERT_TRUE(close_to(covariance(0, COLUMNS) / covariance(0, 0), (double)coefficients.mean[0], 1e-4));
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(coefficients_are_those_of_least_squares);
    RUN_TEST(the_gain_is_the_ratio_of_integrals);
    RUN_TEST(the_bias_stands_at_the_last_value);
    RUN_TEST(an_axis_may_lack_a_column);
    return UNITY_END();
}
