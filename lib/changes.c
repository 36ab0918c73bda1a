/* Steps of the bias and changes of the noise, found on the innovations z of the adequacy's filters (adequacy.c).
 *
 * STEP A step of the bias by d at some onset adds d w_k / sigma_v to z_k, where w is the innovation of a step of 1 over
 * sqrt(S). For SELFCAL_ONSETS onsets, SPACING bank samples apart, the likelihood ratio of a step there is
 *     exp(T^2 / 2),   T = sum z w / sqrt(sum w^2),   d = sigma_v sum z w / sum w^2.
 * It is told where |T| has been beyond STEP_LIMIT for HOLD bank samples and the last samples confirm it. |z| is held
 * at HELD there. So neither an outlier nor a burst of up to ten bank samples is a step: after it z is as before, or of
 * the other sign. Where the noise is louder than it was, T is measured by it. Steps of several axes at once are motion.
 * With the drift's gain g, T ends at d / (sigma_v sqrt(2 g)): a walk hides a step of less than some 10 sd of its own
 * bias.
 *
 * VARIANCE The mean square of the innovations, z^2 held at 4, over windows of WINDOW bank samples, against that of the
 * windows before. It is told where two windows in a row are LOUDER or QUIETER. So held, eight samples of a burst do not
 * tell.
 *
 * tests/ACCURACY.md has the rates of false alarms and the delays as measured. */
#include "bank_inside.h"

#define SPACING 16U
#define STEP_LIMIT R(7.0)
#define CALM_LIMIT R(4.0) /* below it what was learned is kept for a step to come */
#define HELD R(4.0)
#define HOLD 24U
#define SETTLE 8U /* of HOLD: what comes after them must bear the step out */
#define LATE_LIMIT R(2.0)
#define GAP_MAX 64U /* bank intervals; a step after a longer gap begins with the first sample after it */
#define WINDOW 64U
#define LOUDER R(1.75)  /* a window of normal z is so with probability 2e-6 ... */
#define QUIETER R(0.55) /* ... and so with 4e-4 (4e6 windows simulated) */
#define SQUARE_MAX R(4.0)
#define WINDOWS_MIN 8U   /* before a change can be told */
#define WINDOWS_MAX 64U  /* that the mean before remembers */
#define WEIGHT_KEPT 16.0 /* bank samples that what was learned of the noise counts for after it has changed */

/* The filters begin anew: what the onsets follow is no more. */
static void clear_onsets(selfcal_changes_t *self) {
    for (size_t axis = 0; axis < SELFCAL_AXES_MAX; axis++) {
        memset(self->watch[axis].onset, 0, sizeof self->watch[axis].onset);
    }
}

/* How loud the innovations are now about their mean, 1 if no louder than before. */
static selfcal_real_t loudness(const selfcal_changes_t *self, const selfcal_change_watch_t *watch) {
    selfcal_real_t loud = R(1.0);
    if (watch->level > R(0.0)) {
        loud = r_fmax(loud, watch->odd / watch->level);
        if (self->in_window >= SPACING) {
            const selfcal_real_t n = (selfcal_real_t)self->in_window, mean = watch->sum / n;
            loud = r_fmax(loud, r_fma(-mean, mean, watch->power / n) / watch->level);
        }
    }
    return loud;
}

/* One bank sample of one axis, `gap` intervals after the last one, into one onset; whether a step there is told. */
static bool follow_onset(selfcal_onset_t *onset, const selfcal_watch_t *filter, selfcal_real_t z, uint32_t gap,
                         selfcal_real_t loud) {
    selfcal_real_t innovation = R(1.0);
    for (size_t a = 0; a < filter->law.states; a++) {
        for (uint32_t i = 0; i <= gap; i++) {
            onset->state[a] *= filter->law.pole[a];
        }
        innovation -= onset->state[a];
    }
    for (size_t a = 0; a < filter->law.states; a++) {
        onset->state[a] = r_fma(filter->gain[a], innovation, onset->state[a]);
    }
    const selfcal_real_t w = innovation * filter->root;
    onset->along = r_fma(r_fmin(r_fmax(z, -HELD), HELD), w, onset->along);
    onset->size = r_fma(filter->z, w, onset->size);
    onset->weight = r_fma(w, w, onset->weight);
    onset->age++;
    if (onset->along * onset->along <= STEP_LIMIT * STEP_LIMIT * loud * onset->weight) {
        onset->held = 0;
        return false;
    }
    onset->held++;
    if (onset->held == SETTLE) {
        onset->late = onset->along;
        onset->late_weight = onset->weight;
    }
    if (onset->held < HOLD) {
        return false;
    }
    const selfcal_real_t late = (onset->along > R(0.0) ? R(1.0) : R(-1.0)) * (onset->along - onset->late);
    const selfcal_real_t weight = onset->weight - onset->late_weight;
    const selfcal_real_t expected = r_fabs(onset->along) / onset->weight * weight; /* if the step is there */
    onset->held = 0;
    return late > R(0.5) * expected && (late > LATE_LIMIT * r_sqrt(loud * weight) || weight < R(0.05) * onset->weight);
}

/* The bias after a step: the filter's level and what is left of the step. The onset may be SPACING samples off, and so
 * the size by a quarter. */
static void settle_bias(selfcal_changes_t *self, const selfcal_watch_t *filter, uint8_t axis, selfcal_real_t left) {
    selfcal_real_t level = R(0.0), variance = R(0.0);
    for (size_t a = 0; a < filter->law.states; a++) {
        level += filter->state[0][a];
        for (size_t b = 0; b <= a; b++) {
            variance += (a == b ? R(1.0) : R(2.0)) * filter->covariance[term_pair(a, b)];
        }
    }
    const selfcal_real_t doubt = R(0.25) * left;
    self->bias[axis] = (float)r_fma(level, filter->law.sigma, left);
    self->bias_sd[axis] = (float)r_sqrt(r_fma(doubt, doubt, variance * filter->law.sigma * filter->law.sigma));
}

static selfcal_real_t score_sq(const selfcal_onset_t *onset) {
    return onset->weight > R(0.0) ? onset->along * onset->along / onset->weight : R(0.0);
}

/* The likeliest step of an axis becomes a change. */
static void tell_step(selfcal_changes_t *self, const selfcal_watch_t *filter, uint8_t axis, selfcal_suspect_t cause,
                      float dt_s) {
    const selfcal_onset_t *best = &self->watch[axis].onset[0];
    for (size_t i = 1; i < SELFCAL_ONSETS; i++) {
        const selfcal_onset_t *onset = &self->watch[axis].onset[i];
        best = score_sq(onset) > score_sq(best) ? onset : best;
    }
    const selfcal_real_t size = best->size / best->weight * filter->law.sigma;
    selfcal_real_t left = R(1.0);
    for (size_t a = 0; a < filter->law.states; a++) {
        left -= best->state[a];
    }
    const selfcal_change_t change = {cause, (float)size, (float)(best->age - 1U) * dt_s};
    self->change[axis] = change;
    self->found |= 1U << axis;
    settle_bias(self, filter, axis, size * left);
}

/* One bank sample of one axis; whether a step is told. */
static bool look_for_step(selfcal_changes_t *self, const selfcal_watch_t *filter, uint8_t axis, selfcal_real_t z,
                          uint32_t gap) {
    selfcal_change_watch_t *watch = &self->watch[axis];
    const selfcal_real_t loud = loudness(self, watch);
    bool told = false;
    for (size_t i = 0; i < SELFCAL_ONSETS; i++) {
        selfcal_onset_t *onset = &watch->onset[i];
        if (onset->age > 0U && follow_onset(onset, filter, z, gap, loud)) {
            told = true;
        }
    }
    return told;
}

/* Whether the score of some onset is beyond its limit. */
static bool steps(const selfcal_changes_t *self, uint8_t axis) {
    bool any = false;
    for (size_t i = 0; i < SELFCAL_ONSETS; i++) {
        any = any || self->watch[axis].onset[i].held > 0U;
    }
    return any;
}

/* An axis has a step. Those that seem to have one as well are told with it: all of them have moved. */
static void tell_steps(selfcal_changes_t *self, const selfcal_adequacy_t *adequacy, uint32_t told, uint8_t axes,
                       float dt_s) {
    uint32_t stepping = told;
    for (uint8_t axis = 0; axis < axes; axis++) {
        stepping |= steps(self, axis) ? 1U << axis : 0U;
    }
    const bool several = (stepping & (stepping - 1U)) != 0U;
    for (uint8_t axis = 0; axis < axes; axis++) {
        if ((stepping >> axis & 1U) != 0U) {
            const selfcal_suspect_t cause = several ? SELFCAL_SUSPECT_MOTION : SELFCAL_SUSPECT_STEP;
            tell_step(self, &adequacy->watch[axis], axis, cause, dt_s);
        }
    }
}

/* A window has ended. */
static void look_for_variance(selfcal_changes_t *self, uint8_t axis, float dt_s) {
    selfcal_change_watch_t *watch = &self->watch[axis];
    const selfcal_real_t power = watch->power / (selfcal_real_t)WINDOW, square = watch->square / (selfcal_real_t)WINDOW;
    watch->power = watch->square = watch->sum = R(0.0);
    const bool judged = watch->windows >= WINDOWS_MIN && watch->level > R(0.0);
    const bool up = judged && power > LOUDER * watch->level, down = judged && power < QUIETER * watch->level;
    if ((up && watch->odd > watch->level) || (down && watch->odd > R(0.0) && watch->odd < watch->level)) {
        const selfcal_real_t ratio = r_sqrt((square + watch->odd_square) / (R(2.0) * watch->whole));
        const selfcal_change_t change = {SELFCAL_SUSPECT_VARIANCE_CHANGE, (float)ratio, (float)(2U * WINDOW) * dt_s};
        self->change[axis] = change;
        self->found |= 1U << axis;
        return;
    }
    if (up || down) {
        watch->odd = power;
        watch->odd_square = square;
        return;
    }
    watch->odd = R(0.0);
    watch->windows = (uint16_t)(watch->windows < WINDOWS_MAX ? watch->windows + 1U : WINDOWS_MAX);
    watch->level += (power - watch->level) / (selfcal_real_t)watch->windows;
    watch->whole += (square - watch->whole) / (selfcal_real_t)watch->windows;
}

/* Nothing looks like a change so far. */
static bool calm(const selfcal_changes_t *self, uint8_t axes) {
    for (uint8_t axis = 0; axis < axes; axis++) {
        const selfcal_change_watch_t *watch = &self->watch[axis];
        for (size_t i = 0; i < SELFCAL_ONSETS; i++) {
            const selfcal_onset_t *onset = &watch->onset[i];
            if (onset->along * onset->along > CALM_LIMIT * CALM_LIMIT * onset->weight) {
                return false;
            }
        }
        if (watch->odd > R(0.0)) {
            return false;
        }
    }
    return true;
}

static void look(selfcal_adequacy_t *adequacy, const selfcal_t *bank, const selfcal_real_t z[], uint32_t gap) {
    selfcal_changes_t *self = adequacy->changes;
    const selfcal_handling_t *handling = bank->model->handling;
    const uint8_t axes = bank->model->axes;
    const bool apart = gap > GAP_MAX;
    if (adequacy->count == 0U || apart) {
        clear_onsets(self);
    }
    if (adequacy->count == 0U) {
        return; /* its z is 0 */
    }
    uint32_t told = 0;
    const bool begins = handling->steps && (adequacy->count % SPACING == 1U || apart);
    const size_t next = adequacy->count / SPACING % SELFCAL_ONSETS;
    const bool settled = adequacy->count >= SPACING; /* before, S tells of an unknown level */
    const bool ends = settled && ++self->in_window == WINDOW;
    for (uint8_t axis = 0; axis < axes; axis++) {
        selfcal_change_watch_t *watch = &self->watch[axis];
        const selfcal_watch_t *filter = &adequacy->watch[axis];
        if (!filter->running || selfcal_retired(bank, axis)) {
            continue;
        }
        if (begins) {
            memset(&watch->onset[next], 0, sizeof watch->onset[next]);
            watch->onset[next].age = 1U;
        }
        if (settled) { /* in units, which a new law of the filter leaves as they are */
            const selfcal_real_t nu = z[axis] * filter->law.sigma / filter->root, square = nu * nu;
            watch->sum += nu;
            watch->power += r_fmin(R(1.0), SQUARE_MAX / r_fmax(z[axis] * z[axis], R(1.0))) * square;
            watch->square += square;
        }
        if (handling->steps && look_for_step(self, filter, axis, z[axis], gap)) {
            told |= 1U << axis;
        }
        if (ends && handling->variance_changes) {
            look_for_variance(self, axis, bank->model->dt_s);
        }
    }
    self->in_window = ends ? 0U : self->in_window;
    self->due = ends && calm(self, axes);
    if (told != 0U) {
        self->found = 0;
        tell_steps(self, adequacy, told, axes, bank->model->dt_s);
    }
}

selfcal_status_t selfcal_changes_init(selfcal_changes_t *self, selfcal_adequacy_t *adequacy, const selfcal_t *bank,
                                      float learned[]) {
    if (self == NULL || adequacy == NULL || bank == NULL || learned == NULL) {
        return SELFCAL_BAD_ARGUMENT;
    }
    const selfcal_handling_t *handling = bank->model->handling;
    if (handling == NULL || !(handling->steps || handling->variance_changes)) {
        return SELFCAL_BAD_MODEL;
    }
    memset(self, 0, sizeof *self);
    self->learned = learned;
    adequacy->changes = self;
    adequacy->look = look;
    return SELFCAL_OK;
}

uint32_t selfcal_changes_handle(selfcal_adequacy_t *adequacy, selfcal_t *bank) {
    selfcal_changes_t *self = adequacy->changes;
    if (self == NULL) {
        return 0U;
    }
    const uint32_t found = self->found;
    if (found == 0U) {
        if (self->due) {
            selfcal_learned(bank, self->learned);
            self->keeps = true;
        }
        self->due = false;
        return 0U;
    }
    bool step = false;
    selfcal_reopening_t at[SELFCAL_AXES_MAX];
    for (uint8_t axis = 0; axis < bank->model->axes; axis++) {
        at[axis] = adequacy->watch[axis].likely;
        if ((found >> axis & 1U) != 0U && self->change[axis].cause != SELFCAL_SUSPECT_VARIANCE_CHANGE) {
            at[axis].bias = (float)selfcal_offset(bank, axis) + self->bias[axis];
            at[axis].bias_sd = self->bias_sd[axis];
            step = true;
        }
    }
    const selfcal_wide_t part = WEIGHT_KEPT / bank->weight;
    const float keep = step || part > 1.0 ? 1.0F : (float)part;
    const bool done = selfcal_reopen(bank, at, keep, self->keeps ? self->learned : NULL) == SELFCAL_OK;
    for (uint8_t axis = 0; done && axis < bank->model->axes; axis++) {
        if ((found >> axis & 1U) != 0U) {
            adequacy->judgement[axis].changes++;
            adequacy->judgement[axis].change = self->change[axis];
            adequacy->watch[axis].known = adequacy->watch[axis].known && step;
            selfcal_adequacy_forget(adequacy, axis);
            self->found_at[axis] = selfcal_count(bank) + bank->counters.blocks_lost;
        }
    }
    adequacy->count = adequacy->length; /* an epoch begins, and the filters do */
    for (uint8_t axis = 0; axis < bank->model->axes; axis++) {
        adequacy->watch[axis].begun = false;
    }
    self->found = 0;
    self->due = false;
    self->keeps = self->keeps && step; /* a step leaves the noise as it was */
    self->in_window = 0U;
    memset(self->watch, 0, sizeof self->watch);
    return done ? found : 0U;
}
