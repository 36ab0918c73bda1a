/* Marginals of the report (lib/report_marginal.c) of a likelihood in closed form: moments and quantiles of each
 * parameter. */
#include "known_posterior.h"

static const known_t known = {-1.5, 0.35, -4.5, 0.5, 0.6, -2.5};

void setUp(void) {
    known_priors(-8.0, 2.0, -9.0, 2.0, -8.0, -1.0);
    known_values(&known, 400);
    known_run(EVIDENCE);
}

void tearDown(void) {}

static const selfcal_estimate_t *of(selfcal_parameter_t parameter) {
    return &report.hypothesis[0].parameter[parameter];
}

/* sd of a product of a log-normal factor e^(sd z) and sigma_v, over its mean. */
static double spread(double sd, double sigma_sq_over_mean_sq) {
    return sqrt(exp(sd * sd) * sigma_sq_over_mean_sq - 1.0);
}

/* The sums of the cells are right to 1e-5, as their mass is (test_report_integral.c). A sd of 4 % of the mean takes
 * off 600 times the digits. */
static void moments(void) {
    const double n = (double)work.n_eff, one = sigma_moment(n, 1.0), ratio = sigma_moment(n, 2.0) / (one * one);
    const double white = exp(known.ln_sigma) * one;
    TEST_ASSERT_TRUE(close_to(white, (double)of(SELFCAL_N)->mean, 1e-5));
    TEST_ASSERT_TRUE(close_to(white * spread(0.0, ratio), (double)of(SELFCAL_N)->sd, 2e-3));
    const double drift = white * exp(known.rho + 0.5 * known.rho_sd * known.rho_sd);
    TEST_ASSERT_TRUE(close_to(drift, (double)of(SELFCAL_SIGMA_M)->mean, 1e-4));
    TEST_ASSERT_TRUE(close_to(drift * spread(known.rho_sd, ratio), (double)of(SELFCAL_SIGMA_M)->sd, 1e-3));
    const double alpha = exp(known.alpha + 0.5 * known.alpha_sd * known.alpha_sd);
    TEST_ASSERT_TRUE(close_to(alpha, (double)of(SELFCAL_ALPHA)->mean, 1e-4));
    TEST_ASSERT_TRUE(close_to(alpha * spread(known.alpha_sd, 1.0), (double)of(SELFCAL_ALPHA)->sd, 1e-3));
}

static double at;

static double m_below(double delta) {
    return below((at - known.ln_sigma - delta - known.rho) / known.rho_sd);
}

/* Probability below a quantile. A histogram of 128 bins over 10 sd holds a distribution to some 1e-3. */
static void quantiles(void) {
    const double n = (double)work.n_eff, whole = sigma_mass(n);
    const selfcal_parameter_t parameters[] = {SELFCAL_N, SELFCAL_SIGMA_M, SELFCAL_ALPHA};
    for (unsigned p = 0; p < 3U; p++) {
        const selfcal_estimate_t *e = of(parameters[p]);
        const double wanted[3] = {0.05, 0.5, 0.95}, values[3] = {(double)e->q05, (double)e->median, (double)e->q95};
        for (unsigned i = 0; i < 3U; i++) {
            at = log(values[i]);
            const double got = p == 0U   ? over_sigma(n, at - known.ln_sigma, NULL) / whole
                               : p == 1U ? over_sigma(n, INFINITY, m_below) / whole
                                         : below((at - known.alpha) / known.alpha_sd);
            TEST_ASSERT_TRUE(fabs(got - wanted[i]) < 2e-3);
        }
    }
}

/* All are known to within half of their prior, and lie far from its limits. */
static void all_are_identified(void) {
    TEST_ASSERT_EQUAL(SELFCAL_IDENTIFIED, of(SELFCAL_N)->flags);
    TEST_ASSERT_EQUAL(SELFCAL_IDENTIFIED, of(SELFCAL_SIGMA_M)->flags);
    TEST_ASSERT_EQUAL(SELFCAL_IDENTIFIED, of(SELFCAL_ALPHA)->flags);
    TEST_ASSERT_TRUE(isnan(of(SELFCAL_K)->mean));
}

/* The shape of sigma_v about its mode: mass and moments of the cells where nothing cuts. */
static void the_cells_of_sigma(void) {
    const double n = (double)work.n_eff;
    TEST_ASSERT_TRUE(close_to(sigma_mass(n), (double)work.sigma.mass, 1e-5));
    TEST_ASSERT_TRUE(close_to(sigma_moment(n, 1.0), 1.0 + (double)work.sigma.first, 1e-6));
    const double second = sigma_moment(n, 2.0) - 2.0 * sigma_moment(n, 1.0) + 1.0;
    TEST_ASSERT_TRUE(close_to(second, (double)work.sigma.second, 1e-4));
}

/* Mass that a deposit spreads evenly: by bins, and what would lie outside is pushed in. */
static void a_deposit_is_spread_evenly(void) {
    selfcal_real_t bins[SELFCAL_HISTOGRAM + 2] = {R(0.0)};
    const spread_t even = {bins, R(1.0), R(2.0), R(1.5), R(1.0) / R(3.0)}; /* bins of 1/2 from 1 on, 3 bins wide */
    selfcal_histogram_deposit(&even, R(3.25), R(6.0));                     /* bins 3 to 5, whole */
    selfcal_histogram_deposit(&even, R(1.0), R(3.0));                      /* half of it below the first */
    selfcal_real_t mass = R(0.0), total = R(0.0);
    for (unsigned bin = 0; bin < SELFCAL_HISTOGRAM; bin++) {
        mass += bins[bin];
        total += mass;
        const float want = bin == 0U ? 2.0F : bin == 1U ? 1.0F : bin >= 3U && bin <= 5U ? 2.0F : 0.0F;
        TEST_ASSERT_FLOAT_WITHIN(1e-5F, want, (float)mass);
    }
    TEST_ASSERT_FLOAT_WITHIN(1e-4F, 9.0F, (float)total);
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(moments);
    RUN_TEST(quantiles);
    RUN_TEST(all_are_identified);
    RUN_TEST(the_cells_of_sigma);
    RUN_TEST(a_deposit_is_spread_evenly);
    return UNITY_END();
}
