/* The cells of the report's integral (lib/report_integral.c) over a likelihood in closed form, whole and cut by the
 * priors' limits; and the part of a cell that a limit leaves. */
#include "../../lib/report_integral.c"
#include "known_posterior.h"

/* In the middle of what the nodes cover. */
static known_t known;

void setUp(void) {
    const known_t about = {-1.5, 0.35, -4.5, 0.5, 0.0, -2.5};
    known = about;
}

void tearDown(void) {}

#define TWO_PI 6.283185307179586

/* Of the sums over the cells. */
static double mass(void) {
    known_values(&known, 400);
    known_run(WEIGHTS);
    return work.sum.mass * exp((double)work.search.best + (double)work.peak);
}

static double of_both(void) {
    return TWO_PI * known.rho_sd * known.alpha_sd * sqrt(1.0 - known.correlation * known.correlation);
}

/* The midpoint rule leaves nothing of a normal shape; what lies below e^-12 of the peak is left out, 6e-6 in two
 * dimensions. */
static void nothing_cuts(void) {
    static const double correlations[] = {0.0, 0.6, -0.95};
    for (unsigned i = 0; i < 3U; i++) {
        known.correlation = correlations[i];
        known_priors(-8.0, 2.0, -9.0, 2.0, -8.0, -1.0);
        const double got = mass();
        TEST_ASSERT_TRUE(close_to(of_both() * sigma_mass((double)work.n_eff), got, 1e-5));
    }
}

/* A limit of alpha ends the rows: at either side of the peak, and beyond it. The rows' ends are weighed to the third
 * order of a row, of which there are 40 over 10 sd: 1e-4. */
static void a_limit_cuts_alpha(void) {
    static const double at[] = {-1.5, 0.0, 1.2};
    for (unsigned i = 0; i < 3U; i++) {
        known_priors(-8.0, 2.0, -9.0, 2.0, -8.0, known.alpha + at[i] * known.alpha_sd);
        const double got = mass();
        TEST_ASSERT_TRUE(close_to(of_both() * below(at[i]) * sigma_mass((double)work.n_eff), got, 1e-4));
    }
}

/* ln N = ln sigma_v here. sigma_v's cells are 0.2 sd wide. The one that is cut has the density of its own middle, up to
 * 0.05 sd from the middle of the part that is left, on a flank of 1 sd^-1: 0.05 of the part's mass, a tenth of all. */
static void a_limit_cuts_the_noise(void) {
    static const double at[] = {-0.03, 0.0, 0.04};
    for (unsigned i = 0; i < 3U; i++) {
        known_priors(-8.0, known.ln_sigma + at[i], -9.0, 2.0, -8.0, -1.0);
        const double got = mass();
        TEST_ASSERT_TRUE(close_to(of_both() * over_sigma((double)work.n_eff, at[i], NULL), got, 6e-3));
    }
}

static double cut_at;

static double m_below(double delta) {
    return below((cut_at - delta) / known.rho_sd);
}

/* ln sigma_m = ln rho + ln sigma_v: the limit runs across the cells. */
static void a_limit_cuts_the_drift(void) {
    static const double at[] = {-0.5, 0.0, 0.4};
    for (unsigned i = 0; i < 3U; i++) {
        cut_at = at[i];
        known_priors(-8.0, 2.0, -9.0, known.ln_sigma + known.rho + at[i], -8.0, -1.0);
        const double got = mass();
        TEST_ASSERT_TRUE(close_to(of_both() * over_sigma((double)work.n_eff, INFINITY, m_below), got, 1e-3));
    }
}

/* A cell inside counts whole and stays where it is; of one that the limit halves the half; beyond nothing is left. */
static void the_part_that_a_limit_leaves(void) {
    const selfcal_prior_t prior = {-1.37F, 2.21F, SELFCAL_LOG_UNIFORM, false};
    selfcal_real_t middle = R(0.0);
    TEST_ASSERT_EQUAL_FLOAT(1.0F, (float)permitted(&prior, &middle, R(0.5)));
    TEST_ASSERT_EQUAL_FLOAT(0.0F, (float)middle);
    middle = (selfcal_real_t)2.21F;
    TEST_ASSERT_FLOAT_WITHIN(1e-6F, 0.5F, (float)permitted(&prior, &middle, R(0.5)));
    TEST_ASSERT_FLOAT_WITHIN(1e-6F, 2.21F - 0.125F, (float)middle);
    middle = R(3.0);
    TEST_ASSERT_EQUAL_FLOAT(0.0F, (float)permitted(&prior, &middle, R(0.5)));
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(nothing_cuts);
    RUN_TEST(a_limit_cuts_alpha);
    RUN_TEST(a_limit_cuts_the_noise);
    RUN_TEST(a_limit_cuts_the_drift);
    RUN_TEST(the_part_that_a_limit_leaves);
    return UNITY_END();
}
