/* A bias of two levels (popcorn noise): do filters that let the bias jump explain the readings better than linear ones?
 *
 * Readings are in units of sigma_v, by the likeliest walk of the coarse bank (coarse.c) at its 256th bank sample.
 * Switching filter a: a walk, and a level of +A_a/2 or -A_a/2 that changes with the rate 1/DWELL. w is the probability
 * of the upper one. After each sample the two are merged into one Gaussian of their mean and variance (a generalized
 * pseudo-Bayesian filter of order 1), as `diagnose` does. Linear filters are walks, from none to a fast one, and of
 * each switching filter the Kalman filter of the same covariance: a Gauss-Markov drift of variance A^2/4 and rate
 * 2/DWELL. A linear law that is true beats every switching filter. The score is sqrt(2 gain), the gain that of the
 * likeliest switching filter over the likeliest linear one.
 *
 * An innovation is held at HELD, from the nearer level: an outlier is no jump. Fewer than JUMPS jumps are steps.
 * Likelihoods are summed over RUN bank samples, and their score stands while the next ones are summed. */
#include "bank_inside.h"

#define DWELL R(90.0) /* bank samples */
#define WALK_SQ R(1.44e-4)
#define FASTEST R(4.0) /* rho of the first walk; each next one is a quarter of it, the last is 0 */
#define HELD R(4.0)
#define CLOSE R(0.8) /* a level is taken above this probability */
#define LEAST R(1e-6)
#define JUMPS 4U
#define RUN 4096U

static const selfcal_real_t apart[SELFCAL_SWITCHING] = {R(1.0), R(1.6), R(2.6)};

/* What begins is as good as 256 samples of the mean of both levels. */
static selfcal_real_t first_variance(selfcal_real_t a) {
    return r_fmax(a * a / R(16.0), R(1.0) / (selfcal_real_t)SELFCAL_EPOCH_MIN);
}

static void begin_filters(selfcal_levels_t *self, const selfcal_coarse_t *coarse, uint8_t axes) {
    selfcal_real_t rho = FASTEST;
    self->begun = true;
    for (size_t f = 0; f < SELFCAL_LINEAR; f++) {
        selfcal_linear_t *filter = &self->linear[f];
        const selfcal_real_t a = f < SELFCAL_SWITCHING ? apart[f] : R(0.0);
        const bool walk = f >= SELFCAL_SWITCHING, last = f + 1U == SELFCAL_LINEAR;
        filter->walk = !walk ? WALK_SQ : last ? R(0.0) : rho * rho;
        filter->stationary = R(0.25) * a * a;
        filter->level = first_variance(a);
        filter->drift = filter->stationary;
        rho *= walk ? R(0.25) : R(1.0);
    }
    for (uint8_t axis = 0; axis < axes; axis++) {
        selfcal_levels_axis_t *own = &self->axis[axis];
        const selfcal_real_t sigma = selfcal_coarse_sigma(coarse, axis);
        own->per_sigma = sigma > R(0.0) ? R(1.0) / sigma : R(0.0);
        const selfcal_real_t level = coarse->cell[axis][SELFCAL_COARSE_FILTERS - 1].level * own->per_sigma;
        for (size_t f = 0; f < SELFCAL_LINEAR; f++) {
            own->linear[f].level = level;
        }
        for (size_t f = 0; f < SELFCAL_SWITCHING; f++) {
            own->switching[f].level = level;
            own->switching[f].variance = first_variance(apart[f]);
            own->switching[f].upper = R(0.5);
        }
    }
}

/* Gains of a linear filter for a sample of noise r, `count` intervals after the last one. `stays`: of the drift. */
static void predict_linear(selfcal_linear_t *filter, selfcal_real_t r, selfcal_real_t count, selfcal_real_t stays) {
    const selfcal_real_t left = filter->drift - filter->stationary;
    filter->level = r_fma(filter->walk, count, filter->level);
    filter->both *= stays;
    filter->drift = r_fma(stays * stays, left, filter->stationary);
    const selfcal_real_t a = filter->level + filter->both, b = filter->both + filter->drift, s = a + b + r;
    filter->gain[0] = a / s;
    filter->gain[1] = b / s;
    filter->ln_s = r_log(s);
    filter->per_s = R(1.0) / s;
    filter->level -= filter->gain[0] * a;
    filter->both -= filter->gain[0] * b;
    filter->drift -= filter->gain[1] * b;
}

static selfcal_real_t held_within(selfcal_real_t innovation, selfcal_real_t most) {
    return r_fmin(r_fmax(innovation, -most), most);
}

/* One sample y of noise r under one switching filter, of levels `a` apart. */
static void follow_levels(selfcal_switching_t *filter, selfcal_real_t a, selfcal_real_t y, selfcal_real_t r,
                          selfcal_real_t count, selfcal_real_t stays) {
    const selfcal_real_t p = r_fma(WALK_SQ, count, filter->variance), s = p + r, gain = p / s;
    const selfcal_real_t before = r_fma(stays, filter->upper - R(0.5), R(0.5));
    const selfcal_real_t e = held_within(y - filter->level, HELD + R(0.5) * a), lower = e + R(0.5) * a;
    const selfcal_real_t odds = before * r_exp(e * a / s), both = R(1.0) - before + odds;
    const selfcal_real_t upper = r_fmin(r_fmax(odds / both, LEAST), R(1.0) - LEAST);
    filter->ln_p += r_log(both / r_sqrt(s)) - R(0.5) * lower * lower / s;
    filter->upper = upper;
    filter->level = r_fma(gain, lower - a * upper, filter->level);
    filter->variance = r_fma(gain * a * gain * a, upper * (R(1.0) - upper), p * (R(1.0) - gain));
    if (upper > CLOSE || upper < R(1.0) - CLOSE) {
        const int8_t side = upper > CLOSE ? 1 : -1;
        filter->jumps = (uint16_t)(filter->jumps + (side == -filter->side ? 1U : 0U));
        filter->side = side;
    }
}

/* The filters go on. */
static void end_run(selfcal_levels_t *self, uint8_t axis) {
    selfcal_levels_axis_t *own = &self->axis[axis];
    own->before = R(0.0);
    own->before = selfcal_levels_score(self, axis);
    for (size_t f = 0; f < SELFCAL_LINEAR; f++) {
        own->linear[f].ln_p = R(0.0);
    }
    for (size_t f = 0; f < SELFCAL_SWITCHING; f++) {
        own->switching[f].ln_p = R(0.0);
        own->switching[f].jumps = 0U;
    }
}

void selfcal_levels_take(selfcal_levels_t *self, const selfcal_coarse_t *coarse, const selfcal_batch_t *batch,
                         uint32_t at, uint8_t axes) {
    if (!self->begun) {
        if (coarse->n != SELFCAL_EPOCH_MIN) {
            return;
        }
        begin_filters(self, coarse, axes);
    }
    if (self->n == RUN) {
        for (uint8_t axis = 0; axis < axes; axis++) {
            end_run(self, axis);
        }
        self->n = 0U;
    }
    const selfcal_real_t count = (selfcal_real_t)batch->gap[at] + R(1.0), r = batch->r[at];
    const selfcal_real_t stays = r_exp(R(-2.0) / DWELL * count);
    for (size_t f = 0; f < SELFCAL_LINEAR; f++) {
        predict_linear(&self->linear[f], r, count, stays);
    }
    for (uint8_t axis = 0; axis < axes; axis++) {
        selfcal_levels_axis_t *own = &self->axis[axis];
        const selfcal_real_t y = batch->y[axis][at] * own->per_sigma;
        for (size_t f = 0; f < SELFCAL_LINEAR; f++) {
            const selfcal_linear_t *filter = &self->linear[f];
            selfcal_linear_cell_t *cell = &own->linear[f];
            cell->drift *= stays;
            const selfcal_real_t e = held_within(y - cell->level - cell->drift, HELD);
            cell->level = r_fma(filter->gain[0], e, cell->level);
            cell->drift = r_fma(filter->gain[1], e, cell->drift);
            cell->ln_p -= R(0.5) * r_fma(e * e, filter->per_s, filter->ln_s);
        }
        for (size_t f = 0; f < SELFCAL_SWITCHING; f++) {
            follow_levels(&own->switching[f], apart[f], y, r, count, stays);
        }
    }
    self->n++;
}

selfcal_real_t selfcal_levels_score(const selfcal_levels_t *self, uint8_t axis) {
    const selfcal_levels_axis_t *own = &self->axis[axis];
    selfcal_real_t linear = own->linear[0].ln_p, most = R(0.0);
    for (size_t f = 1; f < SELFCAL_LINEAR; f++) {
        linear = r_fmax(linear, own->linear[f].ln_p);
    }
    for (size_t f = 0; f < SELFCAL_SWITCHING; f++) {
        most = own->switching[f].jumps >= JUMPS ? r_fmax(most, own->switching[f].ln_p - linear) : most;
    }
    return r_fmax(r_sqrt(R(2.0) * most), own->before);
}
