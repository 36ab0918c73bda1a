/* Block means of a drift. Not for users.
 *
 * A bank sample is the mean of M readings, and the drift is a point at each of them. The filters take the drift for a
 * point in each interval, beside white noise. The means are of that kind, with less white noise than the readings have.
 * With x = bandwidth dt, phi = e^-x, b = M (1 - e^(-x/M)), relative to the variance of a Gauss-Markov drift:
 *   variance of the points       gain = (1 - phi)^2 e^(-x/M) / (phi b^2)
 *   variance of the means        (1 + e^(-x/M) - 2 e^(-x/M) (1 - phi)/b)/b, less than the gain by the rest
 *   drift at the interval's end  now = (1 - phi)/(b gain) times the point, and 1 - e^(-x (1 - 1/M)) more variance
 * A walk of variance q an interval has points of the same q, a rest of (1 - 1/M^2) q/6, a now of 1, and
 * (1 - 1/M) q/2 more variance. The white noise of the filters is that of the readings less the rest.
 * DESIGN.md derives this. A reading that is a bank sample by itself (M = 1) counts as a point. */
#ifndef SELFCAL_AVERAGES_H
#define SELFCAL_AVERAGES_H

#include "arithmetic.h"
#include "laws.h"

/* Drift that forgets within an interval is held at phi = e^-6.9 = 1e-3: the drift now is the prediction over phi, and
 * neighbours correlated by 1e-3 are beyond telling from white ones. */
#define ALPHA_DT_MAX 6.9

/* 1 - 1/M^2, six times the rest of a walk. */
static inline selfcal_wide_t averaged_walk(uint32_t block) {
    const selfcal_wide_t m = (selfcal_wide_t)block;
    return 1.0 - 1.0 / (m * m);
}

/* Of a Gauss-Markov drift, as above; `after`: the variance that it has more at the interval's end. */
typedef struct {
    selfcal_real_t gain, now, after;
} selfcal_averaged_t;

static inline selfcal_averaged_t averaged(selfcal_real_t x, uint32_t block) {
    selfcal_averaged_t of = {R(1.0), R(1.0), R(0.0)};
    if (block > 1U) {
        const selfcal_real_t m = (selfcal_real_t)block, held = r_fmin(x, (selfcal_real_t)ALPHA_DT_MAX),
            of_sample = r_fmin(x / m, (selfcal_real_t)ALPHA_DT_MAX);
        const selfcal_real_t beta = -r_expm1(-held), b = -m * r_expm1(-of_sample);
        of.now = (R(1.0) - beta) * b / (beta * (R(1.0) - b / m));
        of.gain = beta / (b * of.now);
        of.after = -r_expm1(of_sample - held);
    }
    return of;
}

/* The rest, in selfcal_wide_t: it is the small difference of two numbers near 1. */
static inline selfcal_wide_t averaged_rest(selfcal_wide_t x, uint32_t block) {
    if (block == 1U || x < 1e-3) {
        return averaged_walk(block) * x / 3.0; /* right to x^2/20 */
    }
    const selfcal_wide_t m = (selfcal_wide_t)block, beta = -expm1(-fmin(x, ALPHA_DT_MAX)),
        b = -m * expm1(-fmin(x / m, ALPHA_DT_MAX)), of_sample = 1.0 - b / m;
    const selfcal_wide_t gain = beta * beta * of_sample / ((1.0 - beta) * b * b);
    return fmax(gain - (1.0 + of_sample - 2.0 * of_sample * beta / b) / b, 0.0);
}

/* Variance that a walk has more at the interval's end, over q. */
static inline selfcal_real_t averaged_walk_after(uint32_t block) {
    return R(0.5) - R(0.5) / (selfcal_real_t)block;
}

/* White noise that the points of a law's drift leave out, over the square of its drift parameter (of a K: of
 * K sqrt(dt)). `second`: the law's second parameter. */
static inline selfcal_wide_t white_left_out(const selfcal_law_t *law, selfcal_wide_t second, selfcal_wide_t dt_s,
                                            uint32_t block) {
    selfcal_wide_t sum = 0.0;
    for (size_t a = 0; a < terms_of(law) && block > 1U; a++) {
        const selfcal_term_t *term = &law->term[a];
        if (term->kind == SELFCAL_WALK) {
            sum += averaged_walk(block) / 6.0 * (selfcal_wide_t)term->deviation * (selfcal_wide_t)term->deviation;
        } else {
            sum += averaged_rest(bandwidth_of(term, second) * dt_s, block) *
                   markov_variance(law, term, 1.0, second, dt_s);
        }
    }
    return sum;
}

#endif
