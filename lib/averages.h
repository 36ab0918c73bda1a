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

/* Of a Gauss-Markov drift, as above; `after`: the variance that it has more at the interval's end. */
typedef struct {
    selfcal_real_t gain, now, after;
} selfcal_averaged_t;

selfcal_averaged_t selfcal_averaged(selfcal_real_t x, uint32_t block);

/* Variance that a walk has more at the interval's end, over q. */
static inline selfcal_real_t averaged_walk_after(uint32_t block) {
    return R(0.5) - R(0.5) / (selfcal_real_t)block;
}

/* White noise that the points of a law's drift leave out, over the square of its drift parameter (of a K: of
 * K sqrt(dt)). `second`: the law's second parameter. */
selfcal_wide_t selfcal_white_left_out(const selfcal_law_t *law, selfcal_wide_t second, selfcal_wide_t dt_s,
                                      uint32_t block);

#endif
