/* The expected likelihood of a filter (lib/report_expected.c). Truth: the textbook's recursion and integral. */
#include "../../lib/report_expected.c"
#include "unity.h"

void setUp(void) {}

void tearDown(void) {}

#define PI 3.14159265358979323846

/* Predicted variance of the Riccati recursion, run until it stands. */
static double settled_by_recursion(double phi, double q) {
    double p = q;
    for (unsigned i = 0; i < 200000U; i++) {
        p = phi * phi * p / (1.0 + p) + q;
    }
    return p;
}

/* Mean over omega of the data's spectrum times |1 - phi e^(i omega)|^2 / |1 - psi e^(i omega)|^2. All is periodic and
 * smooth: the rule of even steps leaves (1 - pole)^steps. */
static double variance_by_integral(double phi, double psi, double variance, double rate) {
    enum { STEPS = 20000 };
    double sum = 0.0;
    for (unsigned k = 0; k < STEPS; k++) {
        const double distance = 2.0 - 2.0 * cos(2.0 * PI * ((double)k + 0.5) / STEPS), c = rate;
        const double spectrum = 1.0 + variance * c * (2.0 - c) / (c * c + (1.0 - c) * distance);
        sum += spectrum * ((1.0 - phi) * (1.0 - phi) + phi * distance) / ((1.0 - psi) * (1.0 - psi) + psi * distance);
    }
    return sum / STEPS;
}

static const double rhos[] = {0.01, 0.1, 1.0, 30.0}, betas[] = {0.0, 0.004, 0.1, 0.9};

/* Of a random walk beta is 0. In double 1e-9; float 1e-6. */
static void a_filter_settles_where_its_recursion_does(void) {
    for (unsigned i = 0; i < 4U; i++) {
        for (unsigned j = 0; j < 4U; j++) {
            const double rho_sq = rhos[i] * rhos[i], phi = 1.0 - betas[j];
            const double want = settled_by_recursion(phi, j == 0U ? rho_sq : rho_sq * (1.0 - phi * phi));
            TEST_ASSERT_TRUE(fabs(settled_wide(rho_sq, betas[j]) / want - 1.0) < 1e-9);
            const double got = (double)settled((selfcal_real_t)rho_sq, (selfcal_real_t)betas[j]);
            TEST_ASSERT_TRUE(fabs(got / want - 1.0) < 1e-6);
        }
    }
}

/* Every filter over data of another drift. */
static void the_innovations_have_the_variance_of_their_spectrum(void) {
    static const double variances[] = {0.3, 20.0}, rates[] = {0.004, 0.3};
    for (unsigned i = 0; i < 64U; i++) {
        selfcal_truth_t truth;
        memset(&truth, 0, sizeof truth);
        truth.variance = (selfcal_real_t)variances[i / 16U % 2U];
        truth.rate = (selfcal_real_t)rates[i / 32U];
        const double rho_sq = rhos[i % 4U] * rhos[i % 4U], beta = betas[i / 4U % 4U];
        const expected_t_wide e = expected_wide(rho_sq, beta, &truth);
        const double want = variance_by_integral(1.0 - beta, 1.0 - e.p, (double)truth.variance, (double)truth.rate);
        TEST_ASSERT_TRUE(fabs((1.0 + e.v_less_1) / want - 1.0) < 1e-9);
        const expected_t real = expected((selfcal_real_t)rho_sq, (selfcal_real_t)beta, &truth);
        TEST_ASSERT_TRUE(fabs((1.0 + (double)real.v_less_1) / want - 1.0) < 2e-6);
    }
}

/* A filter over its own process: the innovations have the variance that it takes them to have. */
static void a_filter_knows_the_innovations_of_its_own_process(void) {
    for (unsigned i = 0; i < 4U; i++) {
        for (unsigned j = 1; j < 4U; j++) {
            selfcal_truth_t truth;
            memset(&truth, 0, sizeof truth);
            truth.variance = (selfcal_real_t)(rhos[i] * rhos[i]);
            truth.rate = (selfcal_real_t)betas[j];
            const expected_t_wide e = expected_wide((double)truth.variance, (double)truth.rate, &truth);
            TEST_ASSERT_TRUE(fabs((1.0 + e.v_less_1) / (1.0 + e.s_less_1) - 1.0) < 1e-12);
        }
    }
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(a_filter_settles_where_its_recursion_does);
    RUN_TEST(the_innovations_have_the_variance_of_their_spectrum);
    RUN_TEST(a_filter_knows_the_innovations_of_its_own_process);
    return UNITY_END();
}
