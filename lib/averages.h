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
 * DESIGN.md derives this. A reading that is a bank sample by itself (M = 1) counts as a point.
 *
 * A block with r times fewer readings has r times the white noise, and no more of the rest is missing. The mean over
 * some of the block also scatters about the mean over all. In all it has r + (r - 1) lost times sigma_v^2. */
#ifndef SELFCAL_AVERAGES_H
#define SELFCAL_AVERAGES_H

#include "arithmetic.h"
#include "laws.h"

/* Drift that forgets within an interval is held at phi = exp(-SELFCAL_ALPHA_DT_MAX) = 1e-3: the drift now is the
 * prediction over phi, and neighbours correlated by 1e-3 are beyond telling from white ones. */

/* Of a Gauss-Markov drift, as above; `after`: the variance that it has more at the interval's end. */
typedef struct {
    selfcal_real_t gain, now, after;
} selfcal_averaged_t;

selfcal_averaged_t selfcal_averaged(selfcal_real_t x, uint32_t block);

/* Variance that a walk has more at the interval's end, over q. */
static inline selfcal_real_t averaged_walk_after(uint32_t block) {
    return R(0.5) - R(0.5) / (selfcal_real_t)block;
}

/* lost, see above, of a drift of variance q an interval and a pole of 1 - beta: of a walk q (1 + 1/M)/6. The readings
 * of a block are lost at random. With P the rest over q for many readings, the scatter is q 1.2 P (1 - P)/M, exact for
 * a walk. P is a fit, 0.2 % off at most; for M = 10 the sum is within 0.6 %. */
selfcal_real_t selfcal_averaged_lost(selfcal_real_t q, selfcal_real_t beta, uint32_t block);

/* r + (r - 1) lost. A block of more readings than the model's has an r below 1: beside a drift near the edge of the
 * nodes nothing would be left, so a tenth of r remains. */
static inline selfcal_real_t averaged_noise(selfcal_real_t r, selfcal_real_t lost) {
    return r_fmax(r_fma(r - R(1.0), lost, r), R(0.1) * r);
}

/* White noise that the points of a law's drift leave out, over the square of its drift parameter (of a K: of
 * K sqrt(dt)). `second`: the law's second parameter. */
selfcal_wide_t selfcal_white_left_out(const selfcal_law_t *law, selfcal_wide_t second, selfcal_wide_t dt_s,
                                      uint32_t block);

#endif
