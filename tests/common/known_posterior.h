/* A report whose likelihood is given: every node has the values of a function in closed form, and the report's own
 * stages make of them what they make of a record's.
 *
 * The law is a Gauss-Markov drift of twice the bandwidth: a sum by the table (bank_states.c), so that no expectation is
 * taken off, and splines hold all. A quintic spline reproduces a quadratic function exactly. */
#ifndef KNOWN_POSTERIOR_H
#define KNOWN_POSTERIOR_H

#include "one_axis.h"

/* ln-likelihood (ln rho, ln alpha) of a normal shape, and ln of sigma_v's mode, the same at every node. */
typedef struct {
    double rho, rho_sd, alpha, alpha_sd, correlation, ln_sigma;
} known_t;

static const selfcal_law_t twice_as_fast = {1U, false, {{SELFCAL_MARKOV, 1.0F, 2.0F, false, false}}};
static selfcal_axis_t axis;
static selfcal_work_t work;
static selfcal_report_t report;

static inline double known_height(const known_t *known, double ln_rho, double ln_alpha) {
    const double x = (ln_rho - known->rho) / known->rho_sd, y = (ln_alpha - known->alpha) / known->alpha_sd,
                 r = known->correlation;
    return -0.5 * (x * x - 2.0 * r * x * y + y * y) / (1.0 - r * r);
}

/* Priors, log-uniform: of N, sigma_m and alpha. */
static inline void known_priors(double n_lo, double n_hi, double m_lo, double m_hi, double a_lo, double a_hi) {
    const double limits[SELFCAL_PARAMETERS][2] = {{n_lo, n_hi}, {-10.0, -4.0}, {m_lo, m_hi}, {a_lo, a_hi}};
    choose(MARKOV_LAW);
    hypothesis.law = &twice_as_fast;
    hypothesis.prior = NULL;
    axis = selfcal_model.axis[0];
    for (unsigned p = 0; p < SELFCAL_PARAMETERS; p++) {
        const selfcal_prior_t prior = {(float)limits[p][0], (float)limits[p][1], SELFCAL_LOG_UNIFORM, false};
        axis.prior[p] = prior;
    }
    model.axis = &axis;
    model.states = &selfcal_states_code;
}

/* A record of `samples`, whose report is stopped where the nodes' values are whole; then it has those of `known`. */
static inline void known_values(const known_t *known, unsigned samples) {
    begin();
    for (unsigned i = 0; i < samples; i++) {
        push(0.1F * noise());
    }
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report_begin(&work, &bank, 0, &report));
    while (work.stage != SIGMA) {
        TEST_ASSERT_EQUAL(SELFCAL_BUSY, selfcal_report_step(&work, &report));
    }
    for (uint16_t k = 0; k < model.nodes; k++) {
        const selfcal_place_t place = selfcal_bank_place(&bank, k);
        work.field[0][k] = (selfcal_real_t)known_height(known, (double)place.ln_rho, (double)place.ln_alpha);
        work.field[1][k] = (selfcal_real_t)(known->ln_sigma - 0.5 * work.ln_top);
    }
}

/* Up to the first step of a later stage. */
static inline void known_run(unsigned stage) {
    while (work.stage < stage) {
        TEST_ASSERT_EQUAL(SELFCAL_BUSY, selfcal_report_step(&work, &report));
    }
}

/* With delta = ln sigma_v from its mode, the mass of e^(-n (delta + e^(-2 delta)/2 - 1/2)): u = e^(-2 delta) is a gamma
 * density of shape n/2, over its value at the mode. */
static inline double sigma_mass(double n) {
    return 0.5 * exp(0.5 * n + lgamma(0.5 * n) - 0.5 * n * log(0.5 * n));
}

/* Integral of `of` (NULL: of 1) over delta up to `to` with that density, by Simpson's rule. Its ends are e^-60 of the
 * mode. */
static inline double over_sigma(double n, double to, double (*of)(double delta)) {
    enum { PARTS = 4000 };
    const double from = -11.0 / sqrt(n), step = (fmin(to, 19.0 / sqrt(n)) - from) / (double)PARTS;
    double sum = 0.0;
    for (int i = 0; i <= PARTS; i++) {
        const double delta = from + step * (double)i;
        const double weight = i == 0 || i == PARTS ? 1.0 : i % 2 == 1 ? 4.0 : 2.0;
        sum += weight * (of == NULL ? 1.0 : of(delta)) * exp(-n * (delta + 0.5 * exp(-2.0 * delta) - 0.5));
    }
    return sum * step / 3.0;
}

/* P(z < x) of a normal. */
static inline double below(double x) {
    return 0.5 * erfc(-0.70710678118654752 * x);
}

/* Mean of e^(power delta). */
static inline double sigma_moment(double n, double power) {
    return exp(lgamma(0.5 * (n - power)) - lgamma(0.5 * n) + 0.5 * power * log(0.5 * n));
}

#endif
