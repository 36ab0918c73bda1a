/* The bias of a report (lib/report_bias.c), against its posterior in closed form. */
#include "one_axis.h"

static selfcal_axis_t axis;
static selfcal_work_t work;
static selfcal_report_t report;
static double mean, scatter;

void setUp(void) {
    choose(CONSTANT_LAW);
    axis = model.axis[0];
    model.axis = &axis;
}

void tearDown(void) {}

static void record(unsigned n, float level, float sd) {
    double sum = 0.0, square = 0.0;
    begin();
    for (unsigned i = 0; i < n; i++) {
        const float sample = level + sd * noise();
        push(sample);
        sum += (double)sample;
        square += (double)sample * (double)sample;
    }
    mean = sum / (double)n;
    scatter = square - sum * mean;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report(&work, &bank, 0, &report));
}

/* Under flat priors of the bias and of ln sigma_v a Student density of n - 1 degrees of freedom, whose variance is
 * S / (n (n - 3)) (Box & Tiao, Bayesian Inference, 2.4). sigma_v's cells hold its second moment to 1e-3 at n = 10. */
static void a_bias_under_a_wide_prior(void) {
    static const unsigned lengths[] = {10, 40, 1000};
    for (unsigned i = 0; i < 3U; i++) {
        const double n = (double)lengths[i];
        record(lengths[i], 0.3F, 0.04F);
        TEST_ASSERT_FLOAT_WITHIN(1e-6F, (float)mean, report.bias_mean);
        TEST_ASSERT_TRUE(close_to(sqrt(scatter / (n * (n - 3.0))), (double)report.bias_sd, 2e-3));
    }
}

/* sigma_v is known well from 4000 samples, sigma_v^2 = S/(n - 1); the prior N(0, P0) counts as samples of its own:
 * mean and precision add. */
static void a_prior_pulls_by_its_precision(void) {
    const double n = 4000.0;
    axis.bias_sd = 1e-3F;
    record(4000, 0.002F, 0.04F);
    const double of_data = n * (n - 1.0) / scatter, of_prior = 1e6, precision = of_data + of_prior;
    TEST_ASSERT_TRUE(of_prior > 0.3 * of_data); /* it does pull */
    TEST_ASSERT_TRUE(fabs((double)report.bias_mean - mean * of_data / precision) < 1e-3 * fabs(mean));
    TEST_ASSERT_TRUE(close_to(1.0 / sqrt(precision), (double)report.bias_sd, 1e-3));
}

/* A walk whose K the prior pins: after n samples the bias is the filter's estimate of the last, whose variance is the
 * gain times sigma_v^2; K and N to 1 % as the prior has them. */
static void a_walk_is_where_its_filter_has_it(void) {
    const double n = 0.04, k = 0.004, rho_sq = (k / n) * (k / n);
    const double p = 0.5 * rho_sq * (1.0 + sqrt(1.0 + 4.0 / rho_sq)), gain = p / (1.0 + p);
    choose(WALK_LAW);
    axis = model.axis[0];
    model.axis = &axis;
    const double limits[2][2] = {{log(0.99 * n), log(1.01 * n)}, {log(0.99 * k), log(1.01 * k)}};
    for (unsigned p_of = 0; p_of < 2U; p_of++) {
        axis.prior[p_of].ln_min = (float)limits[p_of][0];
        axis.prior[p_of].ln_max = (float)limits[p_of][1];
    }
    begin();
    double walk = 0.0, estimate = 0.0;
    for (unsigned i = 0; i < 2000U; i++) {
        walk += k * (double)noise();
        const float sample = (float)(walk + n * (double)noise());
        push(sample);
        estimate += (i == 0U ? 1.0 : gain) * ((double)sample - estimate);
    }
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report(&work, &bank, 0, &report));
    const double sd = n * sqrt(gain);
    TEST_ASSERT_TRUE(fabs((double)report.bias_mean - estimate) < 0.02 * sd);
    TEST_ASSERT_TRUE(close_to(sd, (double)report.bias_sd, 0.015)); /* of K and N, each to 1 % */
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(a_bias_under_a_wide_prior);
    RUN_TEST(a_prior_pulls_by_its_precision);
    RUN_TEST(a_walk_is_where_its_filter_has_it);
    return UNITY_END();
}
