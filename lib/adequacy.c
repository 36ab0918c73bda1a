/* Whether the model of the last report explains the readings after it: tests on the innovations of one filter an axis.
 *
 * Time is cut into epochs of half the record before them, within SELFCAL_EPOCH_MIN and SELFCAL_EPOCH_MAX bank samples.
 * The first one has SELFCAL_EPOCH_MIN, and none is more than twice as long as the one before. At its start some axes
 * may have no report yet, as after a restart with a long record.
 * At the start of an epoch each axis takes a law from its last report. A filter begins without a prior for the bias. It
 * goes on from epoch to epoch where changes are looked for and the law has as many states; else it begins anew.
 * The report leaves the drift open, and this doubt must not look like a fault of the model. So the filter allows the
 * most drift that is plausible: the 95 % quantile of the drift parameter, under a law with a walk if one has 1 % of the
 * probability, else under one with a drift. Too much drift makes z negatively correlated: only positive correlation
 * counts. A slow effect of a channel has widened that quantile as well: its score is far below the score under the
 * true drift, and a warm-up may pass (tests/ACCURACY.md has the power).
 *
 * State of the filter, relative to sigma_v: the level (the bias, with the walk if there is one), then the Gauss-Markov
 * terms. The innovation nu has variance S. If the model holds, z = nu / sqrt(S) is white with variance 1.
 * A channel c that the bias may follow passes through the same filter; its innovation over sqrt(S) is w.
 * With n samples in the epoch:
 *
 *   channel     sum z w / sqrt(sum w^2)                       temperature, supply, time
 *   other axis  sum z z' / sqrt(sum z'^2)                    so what the other one did accuses this one of nothing
 *   step        (S_k - S_(k-2)) / sqrt(2 RISE), S_k the sum of z, held at 4, over the k-th window of RISE: the greatest
 *   lag 1       sum z_t z_(t-1) / sqrt(n)
 *   slow        sum z_t e_(t-1) / sqrt(n v), e the mean of past z with weights (1 - l)^k l, v = l / (2 - l)
 *   variance    sum (z^2 - 1) / sqrt(2 n), and its difference between the second half and the first
 *   kurtosis    sum (z^4 - 6 z^2 + 3) / sqrt(24 n)
 *   line        the strongest tone of z (tones.c), over all epochs
 *
 * A coarse bank (coarse.c) looks for channels, a ramp and a warm-up as well, and levels.c for a bias of two levels, by
 * no law of a report.
 * All but the step, the variance and the kurtosis are also summed over all epochs, which finds an effect that is small
 * and lasts.
 * A step pulls at the channels as well, so it goes before them, unless a channel itself has such a step at that time.
 * Steps of several axes at one time are motion.
 * Each is normal with variance 1 for large n. The doubt about the parameters widens it by sqrt(1 + n / n_before), which
 * is taken off. Limits: SELFCAL_ADEQUACY_LIMIT; for the skewed ones what simulation gives (tests/ACCURACY.md). */
#include "bank_inside.h"

#define SLOW R(0.0625)          /* l: a mean over some 16 bank samples */
#define ALL_KNOWN R(0.70710678) /* over all epochs the doubt about the parameters adds as much as the noise, at most */
#define LARGEST R(30.0)         /* |z| is held there: one wild sample says all that it can, and z^4 stays a float */
#define RISE 32U                /* bank samples of a window that a step is looked for in */
#define RISE_HELD R(4.0)        /* |z| is held there: an outlier is no step */
#define RISE_LIMIT R(6.0)       /* 2e-9 of a normal number, of which 1000 h of six axes at 1 Hz have 7e5 */

selfcal_status_t selfcal_adequacy_init(selfcal_adequacy_t *self, const selfcal_t *bank) {
    if (self == NULL || bank == NULL) {
        return SELFCAL_BAD_ARGUMENT;
    }
    memset(self, 0, sizeof *self);
    self->seen = selfcal_count(bank);
    self->coldest = self->warmest = NAN;
    for (uint8_t axis = 0; axis < bank->model->axes; axis++) {
        self->watch[axis].reason = SELFCAL_REASON_NO_REPORT;
    }
    return SELFCAL_OK;
}

/* The likeliest of the laws that allow most drift, of those with 1 % of the probability. */
static uint8_t widest(const selfcal_model_t *model, const selfcal_report_t *report) {
    uint8_t found = 0;
    int most = -1;
    for (uint8_t h = 0; h < model->hypotheses; h++) {
        const selfcal_law_t *law = model->hypothesis[h].law;
        const float probability = report->hypothesis[h].probability;
        const int width = probability < 0.01F ? -1 : has_walk(law) ? 2 : has_drift(law) ? 1 : 0;
        if (width > most || (width == most && probability > report->hypothesis[found].probability)) {
            most = width;
            found = h;
        }
    }
    return found;
}

/* Of a law at its true parameters, the points that its filters take a block mean of its drift for: sigma_v^2, and the
 * drift parameter's square over it, which is rho^2 but for a plain Gauss-Markov drift. */
typedef struct {
    selfcal_wide_t variance, square;
} points_t;

/* Least part of N^2/dt that remains, where the nodes end as well. */
#define WHITE_LEAST 0.1

static points_t points_of(const selfcal_model_t *model, const selfcal_law_t *law, selfcal_wide_t N,
                          selfcal_wide_t drift, selfcal_wide_t second) {
    const selfcal_wide_t dt = (selfcal_wide_t)model->dt_s, white = N * N / dt;
    const selfcal_wide_t square = drift * drift * (has_walk(law) ? dt : 1.0);
    const selfcal_wide_t variance =
        fmax(white - selfcal_white_left_out(law, second, dt, model->block) * square, WHITE_LEAST * white);
    const points_t points = {variance, square / variance};
    return points;
}

/* Where the likeliest law lies among the nodes. */
static selfcal_reopening_t likely_place(const selfcal_model_t *model, const selfcal_report_t *report) {
    uint8_t best = 0;
    for (uint8_t h = 1; h < model->hypotheses; h++) {
        best = report->hypothesis[h].probability > report->hypothesis[best].probability ? h : best;
    }
    const selfcal_law_t *law = model->hypothesis[best].law;
    const selfcal_estimate_t *parameter = report->hypothesis[best].parameter;
    const bool has_second = has_alpha(law) || has_ratio(law);
    const selfcal_wide_t second = has_second ? (selfcal_wide_t)parameter[SELFCAL_ALPHA].median : 1.0;
    const selfcal_wide_t drift = has_drift(law) ? (selfcal_wide_t)parameter[drift_parameter(law)].median : 0.0;
    const points_t points = points_of(model, law, (selfcal_wide_t)parameter[SELFCAL_N].median, drift, second);
    selfcal_reopening_t at = {.hypothesis = best, .sigma_v = (float)sqrt(points.variance)};
    if (has_drift(law)) {
        const bool pole = has_alpha(law) && !is_sum(law);
        const selfcal_real_t x = (selfcal_real_t)(second * (selfcal_wide_t)model->dt_s);
        const selfcal_wide_t gain = pole ? (selfcal_wide_t)selfcal_averaged(x, model->block).gain : 1.0;
        at.ln_rho = (float)(0.5 * log(points.square * gain));
    }
    if (has_second) {
        at.ln_second = (float)log(second);
    }
    return at;
}

void selfcal_adequacy_report(selfcal_adequacy_t *self, const selfcal_model_t *model, const selfcal_report_t *report,
                             const float coefficient[]) {
    selfcal_watch_t *watch = &self->watch[report->axis];
    const uint8_t best = widest(model, report);
    const selfcal_law_t *law = model->hypothesis[best].law;
    const selfcal_estimate_t *parameter = report->hypothesis[best].parameter;
    const selfcal_wide_t dt = (selfcal_wide_t)model->dt_s;
    const selfcal_wide_t drift = has_drift(law) ? (selfcal_wide_t)parameter[drift_parameter(law)].q95 : 0.0;
    const bool decays = has_decay(law) && (has_alpha(law) || has_ratio(law));
    const selfcal_wide_t second = decays ? (selfcal_wide_t)parameter[SELFCAL_ALPHA].median : 1.0;
    const points_t points = points_of(model, law, (selfcal_wide_t)parameter[SELFCAL_N].median, drift, second);
    const selfcal_wide_t variance = points.variance, square = points.square;
    const bool watched = !law->coloured_noise && !has_oscillation(law);
    watch->known = watched && isfinite(square) && isfinite(second) && variance > 0.0 && second > 0.0;
    if (self->changes != NULL) {
        watch->likely = likely_place(model, report);
    }
    watch->reason = watched ? SELFCAL_REASON_OUTSIDE_PRIORS : SELFCAL_REASON_LAW_NOT_WATCHED;
    if (!watch->known) {
        return;
    }
    const size_t columns = regressors_of(model);
    for (size_t k = 0; k < columns; k++) {
        watch->next.coefficient[k] = coefficient != NULL ? (selfcal_real_t)coefficient[k] : R(0.0);
    }
    watch->next.sigma = (selfcal_real_t)sqrt(variance);
    watch->next.states = 1;
    watch->next.pole[0] = R(1.0);
    watch->next.noise[0] = watch->next.variance[0] = R(0.0);
    for (size_t a = 0; a < terms_of(law); a++) {
        const selfcal_term_t *term = &law->term[a];
        if (term->kind == SELFCAL_WALK) {
            const selfcal_wide_t deviation = (selfcal_wide_t)term->deviation;
            watch->next.noise[0] += (selfcal_real_t)(deviation * deviation * square);
            continue;
        }
        const size_t at = watch->next.states++;
        const selfcal_wide_t rate = bandwidth_of(term, second) * dt, pole = exp(-fmin(rate, SELFCAL_ALPHA_DT_MAX));
        const selfcal_wide_t stationary = (selfcal_wide_t)selfcal_averaged((selfcal_real_t)rate, model->block).gain *
                                          markov_variance(law, term, square, second, dt);
        watch->next.pole[at] = (selfcal_real_t)pole;
        watch->next.variance[at] = (selfcal_real_t)stationary;
        watch->next.noise[at] = (selfcal_real_t)(stationary * (1.0 - pole * pole));
    }
}

/* --- filter --- */

/* The filter goes on under a new law: in units of its sigma_v. What a channel was before counts for its value now. */
static void carry_over(selfcal_watch_t *watch) {
    const selfcal_real_t ratio = watch->law.sigma / watch->next.sigma;
    for (size_t a = 0; a < SELFCAL_FILTER_STATES; a++) {
        watch->state[0][a] *= ratio;
        for (size_t b = 0; b <= a; b++) {
            watch->covariance[term_pair(a, b)] *= ratio * ratio;
        }
    }
    memset(watch->state[1], 0, sizeof watch->state - sizeof watch->state[0]);
}

static void begin_epoch(selfcal_adequacy_t *self, const selfcal_t *bank) {
    const uint32_t before = bank->weight > 1.0 ? (uint32_t)bank->weight : 1U, half = before / 2U;
    const uint32_t twice = 2U * self->length, most = twice < SELFCAL_EPOCH_MAX ? twice : SELFCAL_EPOCH_MAX;
    const uint32_t length = half < most ? half : most;
    self->length = length < SELFCAL_EPOCH_MIN ? SELFCAL_EPOCH_MIN : length;
    self->before = before;
    self->count = 0;
    for (uint8_t axis = 0; axis < bank->model->axes; axis++) {
        selfcal_watch_t *watch = &self->watch[axis];
        watch->running = watch->known && !selfcal_retired(bank, axis);
        watch->begun =
            watch->begun && watch->running && watch->next.states == watch->law.states && self->changes != NULL;
        if (watch->begun) {
            carry_over(watch);
        }
        watch->law = watch->next;
        memset(&watch->epoch, 0, sizeof watch->epoch);
        memset(watch->rise.sum, 0, sizeof watch->rise.sum);
        watch->rise.most = R(0.0);
        watch->last = watch->slow = watch->fourth = watch->square[0] = watch->square[1] = R(0.0);
    }
}

/* The first sample: the level is known from it, but for the white noise and the Gauss-Markov terms. */
static void first_sample(selfcal_watch_t *watch, selfcal_real_t y, selfcal_real_t r, const selfcal_real_t channel[]) {
    const selfcal_filter_law_t *law = &watch->law;
    memset(watch->state, 0, sizeof watch->state);
    memset(watch->covariance, 0, sizeof watch->covariance);
    watch->state[0][0] = y;
    watch->covariance[0] = r;
    for (size_t a = 1; a < law->states; a++) {
        watch->covariance[0] += law->variance[a];
        watch->covariance[term_pair(a, 0)] = -law->variance[a];
        watch->covariance[term_pair(a, a)] = law->variance[a];
    }
    for (size_t k = 0; k < SELFCAL_ADEQUACY_COLUMNS; k++) {
        watch->state[1U + k][0] = channel[k];
    }
    watch->begun = true;
}

static void predict(selfcal_watch_t *watch, uint32_t intervals) {
    const selfcal_filter_law_t *law = &watch->law;
    selfcal_real_t pole[SELFCAL_FILTER_STATES], noise[SELFCAL_FILTER_STATES];
    for (size_t a = 0; a < law->states; a++) {
        pole[a] = law->pole[a];
        noise[a] = law->noise[a];
        if (intervals > 1U) { /* a gap */
            const selfcal_real_t count = (selfcal_real_t)intervals;
            pole[a] = a == 0U ? R(1.0) : r_exp(count * r_log(law->pole[a]));
            noise[a] = a == 0U ? law->noise[0] * count : law->variance[a] * (R(1.0) - pole[a] * pole[a]);
        }
    }
    for (size_t a = 0; a < law->states; a++) {
        for (size_t b = 0; b <= a; b++) {
            watch->covariance[term_pair(a, b)] *= pole[a] * pole[b];
        }
        watch->covariance[term_pair(a, a)] += noise[a];
        for (size_t k = 0; k < 1U + SELFCAL_ADEQUACY_COLUMNS; k++) {
            watch->state[k][a] *= pole[a];
        }
    }
}

/* Its own prediction taken off `value`, and the state of that series moved by the gain. */
static selfcal_real_t innovate(selfcal_real_t state[], size_t states, selfcal_real_t value,
                               const selfcal_real_t gain[]) {
    selfcal_real_t innovation = value;
    for (size_t a = 0; a < states; a++) {
        innovation -= state[a];
    }
    for (size_t a = 0; a < states; a++) {
        state[a] = r_fma(gain[a], innovation, state[a]);
    }
    return innovation;
}

/* White noise of a bank sample whose block has lost readings, over sigma_v^2. */
static selfcal_real_t noise_of(const selfcal_filter_law_t *law, selfcal_real_t r, uint32_t block) {
    selfcal_real_t lost = R(0.0);
    for (size_t a = 0; a < law->states && r != R(1.0); a++) {
        lost += selfcal_averaged_lost(law->noise[a], R(1.0) - law->pole[a], block);
    }
    return averaged_noise(r, lost);
}

/* One bank sample of noise r; z, or 0 for the first. `w`: of the channels. */
static selfcal_real_t filter(selfcal_watch_t *watch, selfcal_real_t y, selfcal_real_t r, uint32_t gap,
                             const selfcal_real_t channel[], selfcal_real_t w[]) {
    const size_t states = watch->law.states;
    const selfcal_real_t reading = y / watch->law.sigma;
    if (!watch->begun) {
        first_sample(watch, reading, r, channel);
        memset(w, 0, SELFCAL_ADEQUACY_COLUMNS * sizeof w[0]);
        return R(0.0);
    }
    predict(watch, gap + 1U);
    selfcal_real_t with[SELFCAL_FILTER_STATES], *gain = watch->gain, s = r;
    for (size_t a = 0; a < states; a++) {
        with[a] = R(0.0);
        for (size_t b = 0; b < states; b++) {
            with[a] += watch->covariance[a < b ? term_pair(b, a) : term_pair(a, b)];
        }
        s += with[a];
    }
    for (size_t a = 0; a < states; a++) {
        gain[a] = with[a] / s;
        for (size_t b = 0; b <= a; b++) {
            watch->covariance[term_pair(a, b)] -= gain[a] * with[b];
        }
    }
    const selfcal_real_t root = watch->root = R(1.0) / r_sqrt(s);
    const selfcal_real_t z = innovate(watch->state[0], states, reading, gain) * root;
    for (size_t k = 0; k < SELFCAL_ADEQUACY_COLUMNS; k++) {
        w[k] = innovate(watch->state[1U + k], states, channel[k], gain) * root;
    }
    watch->z = z;
    return r_fmin(r_fmax(z, -LARGEST), LARGEST);
}

/* One bank sample, the `count`-th of the epoch from 0. */
static void follow_rise(selfcal_rise_t *rise, selfcal_real_t z, const selfcal_real_t w[], uint32_t count) {
    rise->sum[0][0] += r_fmin(r_fmax(z, -RISE_HELD), RISE_HELD);
    for (size_t k = 0; k < SELFCAL_ADEQUACY_COLUMNS; k++) {
        rise->sum[1U + k][0] += w[k];
    }
    if ((count + 1U) % RISE != 0U) {
        return;
    }
    const selfcal_real_t found = rise->sum[0][0] - rise->sum[0][2];
    if (count + 1U >= SELFCAL_RISE_WINDOWS * RISE && r_fabs(found) > r_fabs(rise->most)) {
        rise->most = found;
        rise->at = count;
        for (size_t k = 0; k < SELFCAL_ADEQUACY_COLUMNS; k++) {
            rise->along[k] = rise->sum[1U + k][0] - rise->sum[1U + k][2];
        }
    }
    for (size_t k = 0; k <= SELFCAL_ADEQUACY_COLUMNS; k++) {
        rise->sum[k][2] = rise->sum[k][1];
        rise->sum[k][1] = rise->sum[k][0];
        rise->sum[k][0] = R(0.0);
    }
}

/* z of all axes into the sums of one. */
static void add(selfcal_watch_t *watch, const selfcal_real_t z[], size_t axis, uint8_t axes, uint32_t gap,
                const selfcal_real_t w[], bool second_half) {
    selfcal_sums_t *sums = &watch->epoch;
    const selfcal_real_t own = z[axis], square = own * own;
    sums->n += R(1.0);
    sums->lag += gap == 0U ? own * watch->last : R(0.0);
    sums->slow += own * watch->slow;
    for (size_t k = 0; k < SELFCAL_ADEQUACY_COLUMNS; k++) {
        sums->along[k] = r_fma(own, w[k], sums->along[k]);
        sums->weight[k] = r_fma(w[k], w[k], sums->weight[k]);
    }
    for (size_t other = 0; other < axes; other++) {
        sums->product[other] = r_fma(own, z[other], sums->product[other]);
    }
    sums->power += square;
    watch->square[second_half] += square - R(1.0);
    watch->fourth += r_fma(square, square - R(6.0), R(3.0));
    selfcal_tones_take(&watch->tones, own);
    watch->last = own;
    watch->slow = r_fma(SLOW, own - watch->slow, watch->slow);
}

static void add_epoch(selfcal_sums_t *all, const selfcal_sums_t *epoch) {
    all->n += epoch->n;
    all->lag += epoch->lag;
    all->slow += epoch->slow;
    all->power += epoch->power;
    for (size_t k = 0; k < SELFCAL_ADEQUACY_COLUMNS; k++) {
        all->along[k] += epoch->along[k];
        all->weight[k] += epoch->weight[k];
    }
    for (size_t other = 0; other < SELFCAL_AXES_MAX; other++) {
        all->product[other] += epoch->product[other];
    }
}

/* --- judgement --- */

typedef struct {
    selfcal_judgement_t *judgement;
    selfcal_real_t most; /* the score found over its limit */
} finding_t;

static void suspect(finding_t *found, selfcal_suspect_t suspect, selfcal_real_t score, selfcal_real_t limit) {
    const selfcal_real_t over = r_fabs(score) / limit;
    if (over > found->most) {
        found->most = over;
        found->judgement->suspect = suspect;
        found->judgement->score = (float)score;
    }
}

/* Of what looks like drift: while the drift is hardly known, a normal score is not normal enough. */
static selfcal_real_t limit_of_drift(const selfcal_sums_t *sums) {
    const bool early = sums->n < (selfcal_real_t)SELFCAL_ADEQUACY_EARLY;
    return (selfcal_real_t)(early ? SELFCAL_ADEQUACY_LIMIT_EARLY : SELFCAL_ADEQUACY_LIMIT);
}

/* What names a cause: a channel, another axis. `known`: 1 / sqrt(1 + n / n_before). `power`: of the other axes. */
static void weigh_causes(finding_t *found, const selfcal_sums_t *sums, const selfcal_real_t power[],
                         selfcal_real_t known) {
    static const selfcal_suspect_t of_column[SELFCAL_ADEQUACY_COLUMNS] = {
        SELFCAL_SUSPECT_RAMP, SELFCAL_SUSPECT_TEMPERATURE, SELFCAL_SUSPECT_SUPPLY};
    const selfcal_real_t limit = (selfcal_real_t)SELFCAL_ADEQUACY_LIMIT;
    for (size_t k = 0; k < SELFCAL_ADEQUACY_COLUMNS; k++) {
        if (sums->weight[k] > R(0.0)) {
            suspect(found, of_column[k], known * sums->along[k] / r_sqrt(sums->weight[k]),
                    k == 0U ? limit_of_drift(sums) : limit);
        }
    }
    for (size_t other = 0; other < SELFCAL_AXES_MAX; other++) {
        if (power[other] > R(0.0)) {
            suspect(found, SELFCAL_SUSPECT_CROSS_AXIS, known * sums->product[other] / r_sqrt(power[other]), limit);
        }
    }
}

static void weigh_memory(finding_t *found, const selfcal_sums_t *sums, selfcal_real_t known) {
    const selfcal_real_t limit = limit_of_drift(sums), root = known / r_sqrt(sums->n);
    suspect(found, SELFCAL_SUSPECT_COLORED_NOISE, r_fmax(sums->lag * root, R(0.0)), limit);
    suspect(found, SELFCAL_SUSPECT_FLICKER, r_fmax(sums->slow * root / r_sqrt(SLOW / (R(2.0) - SLOW)), R(0.0)), limit);
}

static selfcal_real_t known_of(const selfcal_adequacy_t *self, const selfcal_watch_t *watch) {
    return R(1.0) / r_sqrt(R(1.0) + watch->epoch.n / (selfcal_real_t)self->before);
}

/* Of the greatest rise; 0 if the channel that bends the readings most brings half of it, held as it is. */
static selfcal_real_t step_score(const selfcal_adequacy_t *self, const selfcal_watch_t *watch) {
    const selfcal_rise_t *rise = &watch->rise;
    const selfcal_sums_t *sums = &watch->epoch;
    selfcal_real_t most = R(0.0), brought = R(0.0);
    for (size_t k = 1; k < SELFCAL_ADEQUACY_COLUMNS; k++) {
        const selfcal_real_t weight = sums->weight[k], along = sums->along[k];
        if (weight > R(0.0) && along * along > most * weight) {
            most = along * along / weight;
            brought = along / weight * rise->along[k];
        }
    }
    const bool explained = R(2.0) * brought * rise->most > rise->most * rise->most;
    return explained ? R(0.0) : known_of(self, watch) * rise->most / r_sqrt((selfcal_real_t)(2U * RISE));
}

void selfcal_adequacy_forget(selfcal_adequacy_t *self, uint8_t axis) {
    memset(&self->watch[axis].all, 0, sizeof self->watch[axis].all);
    memset(&self->watch[axis].tones, 0, sizeof self->watch[axis].tones);
    memset(&self->levels, 0, sizeof self->levels);
    self->watch[axis].rise.told = R(0.0);
    for (uint8_t other = 0; other < SELFCAL_AXES_MAX; other++) {
        self->watch[other].all.product[axis] = R(0.0);
    }
    selfcal_coarse_restart(&self->coarse);
    self->coarse.before[axis].score = R(0.0);
}

/* A step of this epoch; with it another of `others`, all of them have moved. What went before it has been told then.
 * Else one of an epoch before: it is still in the report, among ever more samples. */
static bool weigh_step(finding_t *found, selfcal_adequacy_t *self, uint8_t axis, uint32_t others) {
    selfcal_watch_t *watch = &self->watch[axis];
    selfcal_rise_t *rise = &watch->rise;
    const selfcal_real_t score = step_score(self, watch), root = r_sqrt((selfcal_real_t)self->before);
    if (r_fabs(score) <= RISE_LIMIT) {
        suspect(found, SELFCAL_SUSPECT_STEP, score, RISE_LIMIT);
        suspect(found, rise->cause, rise->told / root, RISE_LIMIT);
        return false;
    }
    rise->cause = SELFCAL_SUSPECT_STEP;
    for (uint8_t other = 0; other < SELFCAL_AXES_MAX; other++) {
        const bool looks = (others >> other & 1U) != 0U && self->watch[other].rise.at == rise->at;
        if (looks && r_fabs(step_score(self, &self->watch[other])) > RISE_LIMIT) {
            rise->cause = SELFCAL_SUSPECT_MOTION;
        }
    }
    selfcal_adequacy_forget(self, axis);
    rise->told = score * root;
    suspect(found, rise->cause, score, RISE_LIMIT);
    return true;
}

/* A statistic of the innovations alone is told where no cause is beyond its limit, for each cause bends it too. */
static void judge_axis(selfcal_adequacy_t *self, uint8_t axis, uint32_t others) {
    selfcal_watch_t *watch = &self->watch[axis];
    selfcal_judgement_t *told = &self->judgement[axis];
    const selfcal_real_t n = watch->epoch.n, known = known_of(self, watch);
    selfcal_real_t now[SELFCAL_AXES_MAX] = {R(0.0)}, ever[SELFCAL_AXES_MAX] = {R(0.0)};
    finding_t found = {told, R(0.0)};
    told->samples = self->count;
    for (uint8_t other = 0; other < SELFCAL_AXES_MAX; other++) {
        if ((others >> other & 1U) != 0U) {
            now[other] = self->watch[other].epoch.power;
            ever[other] = self->watch[other].all.power;
        }
    }
    if (!weigh_step(&found, self, axis, others)) {
        weigh_causes(&found, &watch->epoch, now, known);
        weigh_causes(&found, &watch->all, ever, R(1.0));
        selfcal_suspect_t cause = SELFCAL_SUSPECT_NONE;
        const selfcal_real_t score = selfcal_coarse_score(&self->coarse, axis, &cause);
        suspect(&found, cause, score, (selfcal_real_t)SELFCAL_ADEQUACY_LIMIT);
    }
    if (found.most <= R(1.0)) {
        const selfcal_real_t limit = (selfcal_real_t)SELFCAL_ADEQUACY_LIMIT_VARIANCE;
        const selfcal_real_t change = watch->square[1] - watch->square[0];
        const selfcal_real_t variance = watch->square[1] + watch->square[0];
        weigh_memory(&found, &watch->epoch, known);
        weigh_memory(&found, &watch->all, ALL_KNOWN);
        suspect(&found, SELFCAL_SUSPECT_PERIODIC, selfcal_tones_score(&watch->tones),
                (selfcal_real_t)SELFCAL_ADEQUACY_LIMIT_TONE);
        suspect(&found, SELFCAL_SUSPECT_TWO_LEVEL, selfcal_levels_score(&self->levels, axis),
                (selfcal_real_t)SELFCAL_ADEQUACY_LIMIT);
        suspect(&found, SELFCAL_SUSPECT_VARIANCE_CHANGE, r_fmax(known * variance / r_sqrt(R(2.0) * n), R(0.0)), limit);
        suspect(&found, SELFCAL_SUSPECT_VARIANCE_CHANGE, change / r_sqrt(R(2.0) * n), limit);
        suspect(&found, SELFCAL_SUSPECT_OUTLIERS, watch->fourth / r_sqrt(R(24.0) * n),
                (selfcal_real_t)SELFCAL_ADEQUACY_LIMIT_KURTOSIS);
    }
    told->state = found.most > R(1.0) ? SELFCAL_INADEQUATE : SELFCAL_ADEQUATE;
}

/* --- bank samples --- */

static selfcal_real_t mean_of(const selfcal_adequacy_t *self, size_t k) {
    return self->used > 0U ? self->sum[k] / (selfcal_real_t)self->used : R(0.0);
}

/* The means of the interval's inputs less their values at the start of the epoch. */
static void inputs_of(selfcal_adequacy_t *self, size_t inputs, selfcal_real_t mean[]) {
    for (size_t k = 0; k < inputs; k++) {
        mean[k] = mean_of(self, k);
        if (self->count == 0U) {
            self->base[k] = mean[k];
        }
        mean[k] -= self->base[k];
    }
}

static void judge_axes(selfcal_adequacy_t *self, const selfcal_t *bank) {
    uint32_t judged = 0;
    for (uint8_t axis = 0; axis < bank->model->axes; axis++) {
        judged |= self->watch[axis].running && !selfcal_retired(bank, axis) ? 1U << axis : 0U;
    }
    for (uint8_t axis = 0; axis < bank->model->axes; axis++) {
        self->judgement[axis].state = SELFCAL_NOT_JUDGED;
        add_epoch(&self->watch[axis].all, &self->watch[axis].epoch);
    }
    for (uint8_t axis = 0; axis < bank->model->axes; axis++) {
        if ((judged >> axis & 1U) != 0U) {
            judge_axis(self, axis, judged & ~(1U << axis));
        }
    }
}

static void take(selfcal_adequacy_t *self, const selfcal_t *bank, const selfcal_batch_t *batch, uint32_t at) {
    if (self->length == 0U && bank->weight < (selfcal_wide_t)SELFCAL_EPOCH_MIN) {
        return; /* nothing is known yet */
    }
    if (self->count == self->length) { /* the last one is over, or there has been none */
        begin_epoch(self, bank);
    }
    const uint8_t axes = bank->model->axes;
    const size_t columns = regressors_of(bank->model);
    const uint32_t gap = batch->gap[at];
    selfcal_real_t input[SELFCAL_ADEQUACY_INPUTS], channel[SELFCAL_ADEQUACY_COLUMNS];
    selfcal_real_t z[SELFCAL_AXES_MAX] = {R(0.0)}, w[SELFCAL_AXES_MAX][SELFCAL_ADEQUACY_COLUMNS];
    inputs_of(self, SELFCAL_ADEQUACY_CHANNELS + columns, input);
    self->elapsed = self->count == 0U ? 0U : self->elapsed + gap + 1U;
    channel[0] = (selfcal_real_t)self->elapsed;
    memcpy(&channel[1], input, SELFCAL_ADEQUACY_CHANNELS * sizeof input[0]);
    for (uint8_t axis = 0; axis < axes; axis++) {
        selfcal_watch_t *watch = &self->watch[axis];
        selfcal_real_t y = batch->y[axis][at];
        for (size_t k = 0; k < columns; k++) {
            y = r_fma(-watch->law.coefficient[k], input[SELFCAL_ADEQUACY_CHANNELS + k], y);
        }
        const selfcal_real_t noise = noise_of(&watch->law, batch->r[at], bank->model->block);
        z[axis] = watch->running ? filter(watch, y, noise, gap, channel, w[axis]) : R(0.0);
    }
    for (uint8_t axis = 0; axis < axes && self->count > 0U; axis++) {
        if (self->watch[axis].running) {
            add(&self->watch[axis], z, axis, axes, gap, w[axis], self->count >= self->length / 2U);
            follow_rise(&self->watch[axis].rise, z[axis], w[axis], self->count);
        }
    }
    if (self->look != NULL) {
        self->look(self, bank, z, gap);
    }
    self->count++;
    if (self->count == self->length) {
        judge_axes(self, bank);
    }
}

/* A sample's channels and regressors into the means of the bank interval. */
static void gather(selfcal_adequacy_t *self, const float channels[], const float values[], size_t columns) {
    for (size_t k = 0; k < SELFCAL_ADEQUACY_CHANNELS + columns; k++) {
        const bool channel = k < SELFCAL_ADEQUACY_CHANNELS;
        const float *from = channel ? channels : values;
        const float value = from == NULL ? 0.0F : from[channel ? k : k - SELFCAL_ADEQUACY_CHANNELS];
        if (!self->any) {
            self->first[k] = isfinite(value) ? (selfcal_real_t)value : R(0.0); /* sums about it lose no digits */
        }
        if (isfinite(value)) {
            self->held[k] = (selfcal_real_t)value - self->first[k];
        }
        self->sum[k] += self->held[k];
    }
    self->any = true;
    self->used++;
}

void selfcal_adequacy_push(selfcal_adequacy_t *self, const selfcal_t *bank, const float channels[],
                           const float values[]) {
    gather(self, channels, values, regressors_of(bank->model));
    const uint32_t count = selfcal_count(bank);
    if (count != self->seen) { /* the push has ended a bank interval */
        self->seen = count;
        if (channels != NULL && isfinite(channels[0])) {
            const float now = (float)(self->first[0] + self->sum[0] / (selfcal_real_t)self->used);
            self->coldest = fminf(self->coldest, now); /* of NAN and a number that is the number */
            self->warmest = fmaxf(self->warmest, now);
        }
        bool any = false;
        for (uint8_t axis = 0; axis < bank->model->axes; axis++) {
            any = any || self->watch[axis].known;
        }
        const selfcal_batch_t *batch = &bank->batch[bank->gathering];
        if (batch->count == 0U) {
            batch = &bank->batch[1U - bank->gathering];
        }
        if (batch->count > 0U && bank->model->regressors == NULL) {
            const selfcal_real_t channel[SELFCAL_ADEQUACY_CHANNELS] = {mean_of(self, 0), mean_of(self, 1)};
            selfcal_levels_take(&self->levels, &self->coarse, batch, batch->count - 1U, bank->model->axes);
            selfcal_coarse_take(&self->coarse, batch, batch->count - 1U, channel, bank->model);
        }
        if (any && batch->count > 0U) {
            take(self, bank, batch, batch->count - 1U);
        }
    }
    if (bank->position == 0U) {
        memset(self->sum, 0, sizeof self->sum);
        self->used = 0;
    }
}

selfcal_judgement_t selfcal_judgement(const selfcal_adequacy_t *self, const selfcal_t *bank, uint8_t axis) {
    const selfcal_watch_t *watch = &self->watch[axis];
    selfcal_judgement_t told = self->judgement[axis];
    told.temperature_span = self->warmest - self->coldest;
    if (selfcal_retired(bank, axis)) {
        told.state = SELFCAL_NOT_JUDGED;
        told.reason = SELFCAL_REASON_RETIRED;
    } else if (told.state == SELFCAL_NOT_JUDGED) {
        told.reason = watch->known ? SELFCAL_REASON_FIRST_EPOCH : watch->reason;
    }
    if (told.changes > 0U) {
        const uint32_t now = selfcal_count(bank) + bank->counters.blocks_lost;
        told.change.ago_s += (float)(now - self->changes->found_at[axis]) * bank->model->dt_s;
    }
    return told;
}
