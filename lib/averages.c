/* Block means of a drift. The names are those of the equations in averages.h. */
#include "averages.h"

/* 1 - 1/M^2, six times the rest of a walk. */
static selfcal_wide_t averaged_walk(uint32_t block) {
    const selfcal_wide_t m = (selfcal_wide_t)block;
    return 1.0 - 1.0 / (m * m);
}

selfcal_averaged_t selfcal_averaged(selfcal_real_t x, uint32_t block) {
    selfcal_averaged_t of = {R(1.0), R(1.0), R(0.0)};
    if (block > 1U) {
        const selfcal_real_t m = (selfcal_real_t)block, held = r_fmin(x, (selfcal_real_t)SELFCAL_ALPHA_DT_MAX),
                             of_sample = r_fmin(x / m, (selfcal_real_t)SELFCAL_ALPHA_DT_MAX);
        const selfcal_real_t beta = -r_expm1(-held), b = -m * r_expm1(-of_sample);
        of.now = (R(1.0) - beta) * b / (beta * (R(1.0) - b / m));
        of.gain = beta / (b * of.now);
        of.after = -r_expm1(of_sample - held);
    }
    return of;
}

/* The rest, in selfcal_wide_t: it is the small difference of two numbers near 1. */
static selfcal_wide_t averaged_rest(selfcal_wide_t x, uint32_t block) {
    if (block == 1U || x < 1e-3) {
        return averaged_walk(block) * x / 3.0; /* right to x^2/20 */
    }
    const selfcal_wide_t m = (selfcal_wide_t)block, beta = -expm1(-fmin(x, SELFCAL_ALPHA_DT_MAX)),
                         b = -m * expm1(-fmin(x / m, SELFCAL_ALPHA_DT_MAX)), of_sample = 1.0 - b / m;
    const selfcal_wide_t gain = beta * beta * of_sample / ((1.0 - beta) * b * b);
    return fmax(gain - (1.0 + of_sample - 2.0 * of_sample * beta / b) / b, 0.0);
}

selfcal_wide_t selfcal_white_left_out(const selfcal_law_t *law, selfcal_wide_t second, selfcal_wide_t dt_s,
                                      uint32_t block) {
    selfcal_wide_t sum = 0.0;
    for (size_t a = 0; a < terms_of(law) && block > 1U; a++) {
        const selfcal_term_t *term = &law->term[a];
        if (term->kind == SELFCAL_WALK) {
            sum += averaged_walk(block) / 6.0 * (selfcal_wide_t)term->deviation * (selfcal_wide_t)term->deviation;
        } else if (term->kind == SELFCAL_MARKOV) { /* an oscillation turns little within a block */
            sum +=
                averaged_rest(bandwidth_of(term, second) * dt_s, block) * markov_variance(law, term, 1.0, second, dt_s);
        }
    }
    return sum;
}

selfcal_real_t selfcal_averaged_lost(selfcal_real_t q, selfcal_real_t beta, uint32_t block) {
    if (block == 1U) {
        return R(0.0);
    }
    const selfcal_real_t p = r_fma(beta, r_fma(beta, R(-0.24333), R(-0.71527)), R(1.0)) /
                             r_fma(beta, r_fma(beta, R(4.406458), R(-10.364797)), R(6.0));
    return q * p * r_fma(R(1.2) - R(1.2) * p, R(1.0) / (selfcal_real_t)block, R(1.0));
}
