/* Stationary gate: a generalised likelihood-ratio test over windows of samples: does the sensor rest?
 *
 * After Skog, Haendel, Nilsson & Rantakokko, "Zero-velocity detection: an algorithm evaluation", IEEE Trans. Biomed.
 * Eng. 57 (2010) 2657-2666, with two differences. Their detector (SHOE) knows gyros without bias and gravity's
 * magnitude; here every axis has an unknown level of its own, for a bias is just what the bank is to find, and an
 * accelerometer's spoils |g|. And what their detector gains from a known level, a second test gains from the level of
 * the rest before.
 *
 * A window holds n samples y_i of each of A axes. At rest y_i = m + v_i, v_i ~ N(0, sigma^2) white, with an
 * unknown level m.
 *
 * (i)  Shaken? H0: one level m per axis for the window. H1: any signal. Twice the ln of the ratio of the maximised
 *      likelihoods is
 *          T1 = sum over axes, samples of (y_i - mean)^2 / sigma^2
 *      and at rest chi-square with A (n - 1) degrees of freedom.
 * (ii) Moved? H0: the window has the level of the rest before, whose estimate has the variance gamma sigma^2. H1: any
 *      levels. The same is then
 *          T2 = sum over axes of (mean - level)^2 / (sigma^2 (1/n + gamma))
 *      and at rest chi-square with A degrees of freedom.
 * Mean and scatter of normal samples are independent, so T1 and T2 are: each test gets half of the stated false alarm
 * rate p, and a window of rest is taken for motion with probability p - p^2/4.
 *
 * A sensor's filter colours its noise; vibration adds to it. With factors measured at rest on each axis, the scatter of
 * a window has the mean `within` sigma^2 (n - 1) and `spread` times the variance that goes with it, and the window's
 * mean has the variance `level` sigma^2/n. Then T1, its terms over `within`, is taken as c chi-square with nu degrees
 * of freedom of the same mean and variance (Satterthwaite, Biometrics Bull. 2 (1946) 110-114): nu = A^2 (n - 1)/sum of
 * spread, c = A (n - 1)/nu. White: nu = A (n - 1), c = 1. */
#include "bank_inside.h"

/* ln Gamma(a), a > 0, to 1e-10: Stirling's series above 8. lgamma() has a global, signgam. */
static selfcal_wide_t ln_gamma(selfcal_wide_t a) {
    selfcal_wide_t below = 1.0; /* Gamma(a + k)/Gamma(a) = a (a + 1) .. (a + k - 1) */
    while (a < 8.0) {
        below *= a;
        a += 1.0;
    }
    const selfcal_wide_t sq = 1.0 / (a * a);
    return 0.5 * SELFCAL_LN_2PI - log(below) + (a - 0.5) * log(a) - a +
           (1.0 / 12.0 - sq * (1.0 / 360.0 - sq * (1.0 / 1260.0 - sq / 1680.0))) / a;
}

/* What a chi-square variable of `nu` degrees of freedom exceeds with the probability p <= 0.1, in steps: Newton's
 * iteration on the ln of the upper tail of the gamma distribution
 *     Q(a, x) = e^-x x^a / Gamma(a) h,   a = nu/2,   x half the threshold, above a,   slope of ln Q: -1/(x h),
 * from Wilson & Hilferty's cube root of a normal variable; h by Legendre's continued fraction (Abramowitz & Stegun
 * 6.5.31, even part) from its first term on (modified Lentz). To 1e-9 of the threshold: its tolerances are what float
 * keeps, with a margin. */
enum { AT_START, AT_GAMMA, AT_FRACTION, AT_NEWTON, AT_END };
enum { TERMS_A_STEP = 4, TERMS_MOST = 1000, NEWTON_MOST = 20 };

static void begin_quantile(selfcal_quantile_t *q, selfcal_wide_t nu, selfcal_wide_t p) {
    q->a = 0.5 * nu;
    q->ln_p = log(p);
    q->rounds = 0;
    q->at = AT_START;
}

static void begin_fraction(selfcal_quantile_t *q) {
    q->b = q->x + 1.0 - q->a;
    q->c = 1e300;
    q->d = 1.0 / q->b;
    q->h = q->d;
    q->term = 1;
    q->at = AT_FRACTION;
}

/* One step; false: it was the last one. */
static bool step_quantile(selfcal_quantile_t *q) {
    switch (q->at) {
    case AT_START: {
        /* Normal quantile to 4.5e-4 (Abramowitz & Stegun 26.2.23). */
        const selfcal_wide_t t = sqrt(-2.0 * q->ln_p), width = 1.0 / (9.0 * q->a);
        const selfcal_wide_t z =
            t - (2.515517 + t * (0.802853 + t * 0.010328)) / (1.0 + t * (1.432788 + t * (0.189269 + t * 0.001308)));
        const selfcal_wide_t root = 1.0 - width + z * sqrt(width);
        q->x = fmax(q->a * root * root * root, q->a + 0.5);
        q->at = AT_GAMMA;
        break;
    }
    case AT_GAMMA:
        q->ln_gamma = ln_gamma(q->a);
        begin_fraction(q);
        break;
    case AT_FRACTION:
        for (int i = 0; i < TERMS_A_STEP && q->at == AT_FRACTION; i++) {
            const selfcal_wide_t an = -(selfcal_wide_t)q->term * ((selfcal_wide_t)q->term - q->a);
            q->b += 2.0;
            q->d = 1.0 / (an * q->d + q->b);
            q->c = q->b + an / q->c;
            q->h *= q->d * q->c;
            q->term++;
            if (fabs(q->d * q->c - 1.0) < 1e-9 || q->term == TERMS_MOST) {
                q->at = AT_NEWTON;
            }
        }
        break;
    case AT_NEWTON: {
        const selfcal_wide_t step = (q->a * log(q->x) - q->x - q->ln_gamma + log(q->h) - q->ln_p) * q->x * q->h;
        q->x = fmax(q->x + step, q->a + 0.5 * (q->x - q->a));
        q->rounds++;
        if (fabs(step) < 1e-5 * q->x || q->rounds == NEWTON_MOST) { /* the next one would be the square of it */
            q->at = AT_END;
        } else {
            begin_fraction(q);
        }
        break;
    }
    default: break;
    }
    return q->at != AT_END;
}

/* By how much the distances T2 of many windows from a level may be greater in all than noise has them, beside 4 sd: the
 * level's noise is measured to 10 % on six axes and 30 windows. */
#define OFF_MOST 1.25F

/* An axis of infinite sigma is left out. */
static bool present(const selfcal_gate_t *gate, uint8_t axis) {
    return isfinite(gate->axis[axis].sigma);
}

/* Thresholds are worked out a step with each sample, from the start and from a change of noise on, those of T1 for
 * whole windows; they depend on the noise by `spread` alone, those of T2 on the axes present. */
enum { THRESHOLDS_KNOWN, WORK_BEGIN, WORK_SHAKEN, WORK_MOVED, WORK_RATE_MOVED };

/* T1 of a window of `n` samples: degrees of freedom, and by what to multiply the chi-square threshold. */
static selfcal_wide_t freedom(const selfcal_gate_t *gate, uint32_t n, selfcal_wide_t *scale) {
    selfcal_wide_t axes = 0.0, spread = 0.0;
    for (uint8_t axis = 0; axis < gate->config.axes; axis++) {
        if (present(gate, axis)) {
            axes += 1.0;
            spread += (selfcal_wide_t)gate->axis[axis].spread;
        }
    }
    *scale = spread / axes;
    return axes * axes * (selfcal_wide_t)(n - 1U) / spread;
}

static uint8_t count_present(const selfcal_gate_t *gate, bool rates) {
    uint8_t count = 0;
    for (uint8_t axis = 0; axis < gate->config.axes; axis++) {
        count = (uint8_t)(count + (present(gate, axis) && (gate->config.is_rate[axis] || !rates)));
    }
    return count;
}

static void begin_thresholds(selfcal_gate_t *gate) {
    const uint8_t axes = count_present(gate, false);
    if (axes == 0U || gate->config.false_alarm == 0.0F) {
        /* Without an axis there is no rest to be seen. */
        gate->whole_above = gate->moved_above = gate->rate_moved_above = axes > 0U ? INFINITY : -1.0F;
        gate->judged_axes = gate->judged_rates = 0;
        gate->work = THRESHOLDS_KNOWN;
        return;
    }
    selfcal_wide_t scale;
    begin_quantile(&gate->quantile, freedom(gate, gate->config.window, &scale),
                   0.5 * (selfcal_wide_t)gate->config.false_alarm);
    gate->work = WORK_SHAKEN;
}

/* Those of T2 only if their axes are others than before. */
static void step_thresholds(selfcal_gate_t *gate) {
    if (gate->work == WORK_BEGIN) {
        begin_thresholds(gate);
        return;
    }
    if (step_quantile(&gate->quantile)) {
        return;
    }
    const selfcal_wide_t p = 0.5 * (selfcal_wide_t)gate->config.false_alarm, found = 2.0 * gate->quantile.x;
    const uint8_t axes = count_present(gate, false), rates = count_present(gate, true);
    if (gate->work == WORK_SHAKEN) {
        selfcal_wide_t scale;
        (void)freedom(gate, gate->config.window, &scale);
        gate->whole_above = (float)(scale * found);
    } else if (gate->work == WORK_MOVED) {
        gate->moved_above = (float)found;
        gate->judged_axes = axes;
    } else {
        gate->rate_moved_above = (float)found;
        gate->judged_rates = rates;
    }
    if (gate->judged_axes != axes) {
        begin_quantile(&gate->quantile, (selfcal_wide_t)axes, p);
        gate->work = WORK_MOVED;
    } else if (gate->judged_rates != rates && rates > 0U) {
        begin_quantile(&gate->quantile, (selfcal_wide_t)rates, p);
        gate->work = WORK_RATE_MOVED;
    } else {
        gate->rate_moved_above = rates > 0U ? gate->rate_moved_above : INFINITY;
        gate->judged_rates = rates;
        gate->work = THRESHOLDS_KNOWN;
    }
}

/* Those for a window of `n` samples. What is not known yet is worked out at once: T1's for a window with missing
 * samples, and all where windows are shorter than the steps are many. */
static void set_thresholds(selfcal_gate_t *gate, uint32_t n) {
    gate->at_once += gate->work != THRESHOLDS_KNOWN || n != gate->config.window;
    while (gate->work != THRESHOLDS_KNOWN) {
        step_thresholds(gate);
    }
    gate->shaken_above = gate->whole_above;
    if (n != gate->config.window && gate->judged_axes > 0U) {
        selfcal_wide_t scale;
        const selfcal_wide_t nu = freedom(gate, n, &scale);
        begin_quantile(&gate->quantile, nu, 0.5 * (selfcal_wide_t)gate->config.false_alarm);
        while (step_quantile(&gate->quantile)) {
        }
        gate->shaken_above = (float)(scale * 2.0 * gate->quantile.x);
    }
}

static void start_window(selfcal_gate_t *gate) {
    gate->position = 0;
    gate->used = 0;
    gate->blind = false;
}

selfcal_status_t selfcal_gate_init(selfcal_gate_t *gate, const selfcal_gate_config_t *config) {
    if (gate == NULL || config == NULL || config->axes == 0U || config->axes > SELFCAL_AXES_MAX ||
        config->window < 2U || !(config->false_alarm >= 0.0F) || !(config->false_alarm <= 0.1F) || config->hold == 0U ||
        config->memory == 0U) {
        return SELFCAL_BAD_ARGUMENT;
    }
    for (uint8_t axis = 0; axis < config->axes; axis++) {
        if (!(config->sigma[axis] > 0.0F)) {
            return SELFCAL_BAD_ARGUMENT;
        }
    }
    memset(gate, 0, sizeof *gate);
    gate->config = *config;
    gate->state = SELFCAL_MOVING;
    for (uint8_t axis = 0; axis < config->axes; axis++) {
        const selfcal_gate_noise_t white = {config->sigma[axis], 1.0F, 1.0F, 1.0F};
        gate->axis[axis] = white;
    }
    gate->work = WORK_BEGIN;
    start_window(gate);
    return SELFCAL_OK;
}

selfcal_status_t selfcal_gate_noise(selfcal_gate_t *gate, uint8_t axis, const selfcal_gate_noise_t *noise) {
    if (gate == NULL || noise == NULL || axis >= gate->config.axes || !(noise->sigma > 0.0F) ||
        !(noise->within > 0.0F) || !(noise->spread > 0.0F) || !(noise->level > 0.0F) || !isfinite(noise->within) ||
        !isfinite(noise->spread) || !isfinite(noise->level)) {
        return SELFCAL_BAD_ARGUMENT;
    }
    gate->axis[axis] = *noise;
    gate->work = WORK_BEGIN;
    return SELFCAL_OK;
}

/* Here, with what is compiled for size: only a gate calls for it, and the averager is for speed (port/arm.mk). */
selfcal_status_t selfcal_push_moving(selfcal_t *self, const float sample[]) {
    if (sample == NULL || selfcal_moving(self) != SELFCAL_OK) {
        return SELFCAL_BAD_ARGUMENT;
    }
    selfcal_take(self, sample, NULL, true);
    return SELFCAL_OK;
}

void selfcal_gate_shift(selfcal_gate_t *gate, uint8_t axis, float amount) {
    SELFCAL_ASSERT(gate != NULL && axis < gate->config.axes && isfinite(amount));
    gate->origin[axis] += amount; /* 0 before the first sample, which then sets it */
}

selfcal_status_t selfcal_gate_measured(const selfcal_gate_t *gate, uint8_t axis, selfcal_gate_noise_t *noise) {
    if (gate == NULL || noise == NULL || axis >= gate->config.axes) {
        return SELFCAL_BAD_ARGUMENT;
    }
    if (gate->measured < SELFCAL_GATE_MEASURED_MIN) {
        return SELFCAL_TOO_SHORT;
    }
    const selfcal_wide_t count = (selfcal_wide_t)gate->measured;
    const selfcal_wide_t scatter = gate->sum_scatter[axis] / count;
    const selfcal_wide_t variance = (gate->sum_scatter_sq[axis] / count - scatter * scatter) * count / (count - 1.0);
    const selfcal_wide_t sigma_sq = (selfcal_wide_t)gate->axis[axis].sigma * (selfcal_wide_t)gate->axis[axis].sigma;
    /* A scatter of mean s over d = n - 1 degrees of freedom has the variance 2 s^2/d when white. */
    noise->sigma = gate->axis[axis].sigma;
    noise->within = (float)(scatter / sigma_sq);
    noise->spread = (float)(variance * (selfcal_wide_t)(gate->config.window - 1U) / (2.0 * scatter * scatter));
    noise->level = (float)(gate->sum_level_sq[axis] / count / sigma_sq);
    return SELFCAL_OK;
}

/* sum over axes of (mean - level)^2 / (sigma^2 (1/n + gamma)); `rates`: of the gyros only; `times`: by how much an
 * axis's variance is greater than was measured, NULL: by nothing. */
static float distance(const selfcal_gate_t *gate, const float mean[], selfcal_real_t inv_n,
                      const selfcal_level_t *level, bool rates, const float times[]) {
    float sum = 0.0F;
    for (uint8_t axis = 0; axis < gate->config.axes; axis++) {
        if (present(gate, axis) && (gate->config.is_rate[axis] || !rates)) {
            const float off = (mean[axis] - level->mean[axis]) / gate->axis[axis].sigma;
            sum += off * off / (times != NULL ? gate->axis[axis].level * times[axis] : gate->axis[axis].level);
        }
    }
    return sum / (float)(inv_n + level->gamma);
}

/* Mean of the samples so far with those of a window, but a window weighs at least 1/memory. */
static void merge(const selfcal_gate_t *gate, selfcal_level_t *level, const float mean[], selfcal_real_t inv_n) {
    const selfcal_real_t least = R(1.0) / (selfcal_real_t)gate->config.memory;
    const selfcal_real_t w = r_fmax(level->gamma / (level->gamma + inv_n), least);
    level->gamma = (R(1.0) - w) * (R(1.0) - w) * level->gamma + w * w * inv_n;
    for (uint8_t axis = 0; axis < gate->config.axes; axis++) {
        level->mean[axis] = (float)r_fma(w, (selfcal_real_t)mean[axis] - (selfcal_real_t)level->mean[axis],
                                         (selfcal_real_t)level->mean[axis]);
    }
}

static void set_level(const selfcal_gate_t *gate, selfcal_level_t *level, const float mean[], selfcal_real_t inv_n) {
    memcpy(level->mean, mean, gate->config.axes * sizeof mean[0]);
    level->gamma = inv_n;
}

/* Sums for selfcal_gate_measured(), of a whole window of rest. */
static void measure(selfcal_gate_t *gate, const float scatter[], const float mean[], selfcal_real_t inv_n) {
    for (uint8_t axis = 0; axis < gate->config.axes; axis++) {
        const selfcal_wide_t variance = (selfcal_wide_t)scatter[axis] / (selfcal_wide_t)(gate->config.window - 1U);
        const selfcal_wide_t off = (selfcal_wide_t)mean[axis] - (selfcal_wide_t)gate->rest.mean[axis];
        gate->sum_scatter[axis] += variance;
        gate->sum_scatter_sq[axis] += variance * variance;
        gate->sum_level_sq[axis] += off * off / (selfcal_wide_t)(inv_n + gate->rest.gamma);
    }
    gate->measured++;
}

/* Rest ends, for want of samples to tell: if the next window is one of that rest, it goes on with that. */
static void look_away(selfcal_gate_t *gate) {
    gate->unseen = gate->unseen || gate->state == SELFCAL_RESTING;
    gate->state = SELFCAL_MOVING;
}

/* A window has nothing to go by: too few samples, or one that is no number. It neither is one of those in a row nor
 * ends them. */
static void blind_window(selfcal_gate_t *gate) {
    gate->counters.blind++;
    look_away(gate);
}

/* What a chi-square variable of `nu` degrees of freedom exceeds once in 30 000 times: 4 sd of its cube root (Wilson &
 * Hilferty). */
static float seldom(float nu) {
    const float variance = 2.0F / (9.0F * nu), root = 1.0F - variance + 4.0F * sqrtf(variance);
    return nu * root * root * root;
}

/* Whether windows are too far off a level in all, though none of them is: a rotation or a swing that is too slow for
 * one window. `sum`: of their T2, chi-square with `nu` degrees of freedom but for `scale`. Never, without a rate of
 * false alarms. */
static bool off_in_all(const selfcal_gate_t *gate, float sum, float nu, float scale) {
    return gate->judged_axes > 0U && !(sum <= OFF_MOST * scale * seldom(nu));
}

/* The same of the windows at rest: a sum that forgets, T2 weighing (1 - 1/m)^k after k windows with m = `memory`, has
 * the mean m and the variance 2 m^2/(2 m - 1) per axis: that of m/(2 m - 1) chi-square with 2 m - 1 degrees of
 * freedom. */
static bool drifts_off(selfcal_gate_t *gate) {
    const float memory = (float)gate->config.memory, twice = 2.0F * memory - 1.0F;
    gate->off_sum += gate->t2 - gate->off_sum / memory;
    return off_in_all(gate, gate->off_sum, twice * (float)gate->judged_axes, memory / twice);
}

/* The windows since motion that are on one level: calm are those that scatter no more than the noise that the gate
 * started from, the most that there is at rest; quiet are the last of them that do not by the noise that was measured
 * since. How far means may be off a level goes by the noise measured, and where windows scatter more, by as much more:
 * a slow swing is no level because the model's noise would cover it. */
static void follow(selfcal_gate_t *gate, const float mean[], const float scatter[], selfcal_real_t inv_n, bool shaken) {
    const float memory = (float)gate->config.memory, weight = (float)gate->calm + 1.0F;
    float bound = 0.0F, axes = 0.0F, times[SELFCAL_AXES_MAX] = {0.0F};
    for (uint8_t axis = 0; axis < gate->config.axes; axis++) {
        if (present(gate, axis)) {
            const selfcal_gate_noise_t *noise = &gate->axis[axis];
            const float ratio = scatter[axis] / noise->sigma / noise->sigma / noise->within / (float)(gate->used - 1U);
            gate->grown[axis] += (ratio - gate->grown[axis]) / (weight < memory ? weight : memory);
            times[axis] = gate->grown[axis] > 1.0F ? gate->grown[axis] : 1.0F;
            bound += scatter[axis] / gate->config.sigma[axis] / gate->config.sigma[axis];
            axes += 1.0F;
        }
    }
    bool moved = false;
    if (gate->calm > 0U) {
        gate->t2 = distance(gate, mean, inv_n, &gate->found, false, times);
        gate->off_sum += gate->t2;
        moved = !(gate->t2 <= gate->moved_above);
        gate->counters.moved += moved;
    }
    if (moved || (shaken && !(bound <= seldom(axes * (float)(gate->used - 1U)))) ||
        (gate->calm > 0U && off_in_all(gate, gate->off_sum, axes * (float)gate->calm, 1.0F))) {
        gate->calm = gate->quiet = 0;
        return;
    }
    if (gate->calm == 0U) {
        set_level(gate, &gate->found, mean, inv_n);
        gate->off_sum = 0.0F;
    } else {
        merge(gate, &gate->found, mean, inv_n);
    }
    gate->calm++;
    gate->quiet = shaken ? 0U : gate->quiet + 1U;
}

/* The noise has become another: the gate starts from the model's again. */
static void start_noise(selfcal_gate_t *gate) {
    for (uint8_t axis = 0; axis < gate->config.axes; axis++) {
        if (present(gate, axis)) {
            const selfcal_gate_noise_t white = {gate->config.sigma[axis], 1.0F, 1.0F, 1.0F};
            gate->axis[axis] = white;
        }
        gate->sum_scatter[axis] = gate->sum_scatter_sq[axis] = gate->sum_level_sq[axis] = 0.0;
    }
    gate->measured = 0;
    gate->work = WORK_BEGIN;
}

static void judge(selfcal_gate_t *gate) {
    const uint32_t n = gate->used;
    float mean[SELFCAL_AXES_MAX] = {0.0F}, scatter[SELFCAL_AXES_MAX] = {0.0F}, t1 = 0.0F;
    const selfcal_real_t inv_n = R(1.0) / (selfcal_real_t)n;
    for (uint8_t axis = 0; axis < gate->config.axes; axis++) {
        const selfcal_real_t about_first = gate->sum[axis] * inv_n;
        mean[axis] = (float)((selfcal_real_t)gate->first[axis] + about_first);
        scatter[axis] = (float)r_fmax(r_fma(-gate->sum[axis], about_first, gate->sum_sq[axis]), R(0.0));
        if (present(gate, axis)) {
            t1 += scatter[axis] / gate->axis[axis].sigma / gate->axis[axis].sigma / gate->axis[axis].within;
        }
    }
    set_thresholds(gate, n);
    const bool shaken = !(t1 <= gate->shaken_above);
    gate->t1 = t1;
    gate->counters.shaken += shaken;
    if (gate->state == SELFCAL_RESTING || gate->unseen) {
        gate->t2 = distance(gate, mean, inv_n, &gate->rest, false, NULL);
        const bool moved = !(gate->t2 <= gate->moved_above) || drifts_off(gate);
        gate->counters.moved += moved;
        gate->unseen = false;
        if (!shaken && !moved) {
            if (n == gate->config.window) {
                measure(gate, scatter, mean, inv_n);
            }
            merge(gate, &gate->rest, mean, inv_n);
            gate->state = SELFCAL_RESTING;
            return;
        }
        gate->counters.alarms++;
        gate->state = SELFCAL_MOVING;
        /* Not even the first of the calm ones: picked for its odd mean, it would make a bad level. */
        gate->calm = gate->quiet = 0;
        return;
    }
    follow(gate, mean, scatter, inv_n, shaken);
    const uint32_t hold = gate->config.hold, settle = gate->config.settle;
    const bool back = !gate->rested || distance(gate, gate->found.mean, gate->found.gamma, &gate->rest, true, NULL) <=
                                           gate->rate_moved_above;
    const bool settled = settle >= hold && gate->calm > settle;
    if (settled && gate->quiet < gate->calm) {
        start_noise(gate);
    } else if (!settled && !(gate->quiet > hold && back)) {
        return;
    }
    gate->rest = gate->found;
    gate->rested = true;
    gate->off_sum = (float)gate->config.memory * (float)gate->judged_axes; /* its mean */
    gate->state = SELFCAL_RESTING;
}

static void close_window(selfcal_gate_t *gate) {
    gate->counters.windows++;
    if (gate->blind || gate->used < 2U || gate->used < gate->config.window - gate->used) {
        blind_window(gate);
    } else {
        judge(gate);
    }
    start_window(gate);
}

selfcal_motion_t selfcal_gate_push(selfcal_gate_t *gate, const float sample[]) {
    SELFCAL_ASSERT(gate != NULL && sample != NULL);
    const uint8_t axes = gate->config.axes;
    bool sound = true;
    if (gate->work != THRESHOLDS_KNOWN) {
        step_thresholds(gate);
    }
    for (uint8_t axis = 0; axis < axes; axis++) {
        sound = sound && (!present(gate, axis) || fabsf(sample[axis]) < SELFCAL_SAMPLE_MAX); /* false for a NaN */
    }
    if (sound && !gate->started) {
        gate->started = true;
        for (uint8_t axis = 0; axis < axes; axis++) {
            gate->origin[axis] = present(gate, axis) ? sample[axis] : 0.0F;
        }
    }
    if (!sound) {
        gate->blind = true;
        look_away(gate);
    } else {
        for (uint8_t axis = 0; axis < axes; axis++) {
            const float value = present(gate, axis) ? sample[axis] - gate->origin[axis] : 0.0F;
            if (gate->used == 0U) {
                gate->first[axis] = value;
                gate->sum[axis] = R(0.0);
                gate->sum_sq[axis] = R(0.0);
            }
            const selfcal_real_t off = (selfcal_real_t)value - (selfcal_real_t)gate->first[axis];
            gate->sum[axis] += off;
            gate->sum_sq[axis] = r_fma(off, off, gate->sum_sq[axis]);
        }
        gate->used++;
    }
    gate->position++;
    if (gate->position == gate->config.window) {
        close_window(gate);
    }
    return gate->state;
}

selfcal_motion_t selfcal_gate_skip(selfcal_gate_t *gate, uint64_t count) {
    SELFCAL_ASSERT(gate != NULL);
    const uint32_t window = gate->config.window;
    const uint32_t left = window - gate->position;
    if (count < left) {
        gate->position += (uint32_t)count;
        return gate->state;
    }
    close_window(gate);
    count -= left;
    const uint64_t whole = count / window;
    if (whole > 0U) {
        gate->counters.windows += whole;
        gate->counters.blind += whole - 1U;
        blind_window(gate);
    }
    gate->position = (uint32_t)(count % window);
    return gate->state;
}
