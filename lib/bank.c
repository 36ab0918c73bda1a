/* Bank sums: one scalar filter per node over every axis, and the sums its likelihood needs.
 *
 * Each node runs the zero-bias filter over the measurement and over the regressor "1" (innovations nu and u); the bias
 * and sigma_v are integrated out afterwards from A = sum u^2/s, B = sum u nu/s, C = sum nu^2/s and D = sum ln s
 * (generalised least squares; de Jong, Biometrika 78 (1991) 143-151). Everything is relative to sigma_v.
 *
 *   nu = y - x        s = r + P        K = P/s        x' = phi (x + K nu)        P' = phi^2 r P/(r + P) + q
 *
 * Two rearrangements keep float exact enough:
 * - With beta = 1 - phi and g = phi K + beta, x' = x + g nu - beta y: beta down to 1e-7 keeps its digits, and a sample
 *   costs one subtraction and two fused multiply-adds besides its two sums.
 * - The Riccati recursion runs on d = P - p_inf, d' = phi^2 (r d + (r - 1) P p_inf) / ((1 + p_inf) (r + P)): its
 *   rounding is relative to d, which dies out, whereas P' itself would settle some 1e-7/g off (3e-4 relative at
 *   g = 1e-4). So does u, u' = u - g u + beta, on e = u - u_inf, u_inf = beta/g_inf:
 *   e' = (1 - g) e - (g - g_inf) u_inf, where g - g_inf = phi (d + (1 - r) p_inf) / ((1 + p_inf) (r + P)).
 */
#include "bank_inside.h"

#include <float.h>

/* A node counts as converged when d falls to this part of p_inf: what is left of the gain's error moves a ln-likelihood
 * by less than that many nats. */
#define CONVERGED R(1e-6)

/* u has settled when e falls to this part of u_inf; where u_inf is 0 (random walk) at U_ZERO: denormals are slow. */
#define SETTLED R(1e-7)
#define U_ZERO R(1e-20)

/* s; a bank interval of a microsecond or of ten days is no sensor's. */
#define DT_MIN 1e-6F
#define DT_MAX 1e6F

/* Rounding alone would carry wider limits out of a float's range. False for NaN. */
static bool valid_prior(const selfcal_prior_t *prior) {
    const float limit = (float)SELFCAL_LN_LIMIT;
    return prior->ln_min >= -limit && prior->ln_max <= limit && prior->ln_min < prior->ln_max;
}

static bool valid_priors(const selfcal_prior_t prior[], size_t axes) {
    for (size_t p = 0; p < axes * SELFCAL_PARAMETERS; p++) {
        if (!valid_prior(&prior[p])) {
            return false;
        }
    }
    return true;
}

static bool valid_grid(const selfcal_grid_t *grid, uint16_t most) {
    return grid->nodes >= SELFCAL_GRID_MIN && grid->nodes <= most && grid->fit != NULL;
}

selfcal_place_t selfcal_bank_place(const selfcal_t *self, uint16_t index) {
    const selfcal_hypothesis_t *hypothesis = self->model->hypothesis;
    const node_of_t node = node_of(self->model, index);
    const uint8_t h = node.hypothesis;
    const uint16_t columns = grid_nodes(hypothesis[h].alpha);
    const uint16_t row = (uint16_t)(node.index / columns), column = (uint16_t)(node.index % columns);
    selfcal_place_t place = {h, NAN, NAN};
    if (hypothesis[h].rho != NULL) {
        place.ln_rho = r_fma((selfcal_real_t)row, self->rho_step[h], self->rho_lo[h]);
    }
    if (hypothesis[h].alpha != NULL) {
        place.ln_alpha = r_fma((selfcal_real_t)column, self->alpha_step[h], self->alpha_lo[h]);
    }
    return place;
}

static bool valid_law(const selfcal_law_t *law, const selfcal_states_code_t *states, float dt_s) {
    if (law == NULL || law->terms > SELFCAL_LAW_TERMS || !is_bool(&law->coloured_noise)) {
        return false;
    }
    return is_plain(law) || (states != NULL && states->valid(law, dt_s));
}

bool selfcal_law_is_sum(const selfcal_law_t *law) {
    return !is_plain(law);
}

static bool valid_model(const selfcal_model_t *model) {
    if ((model->forgetting != NULL && (model->forgetting->code == NULL ||
                                       !(model->forgetting->half_life_s >= (float)SELFCAL_BATCH * model->dt_s))) ||
        !(model->dt_s >= DT_MIN) || !(model->dt_s <= DT_MAX) || model->block == 0U || model->axes == 0U ||
        model->axes > SELFCAL_AXES_MAX || model->hypotheses == 0U || model->hypotheses > SELFCAL_HYPOTHESES_MAX ||
        model->axis == NULL || model->hypothesis == NULL) {
        return false;
    }
    for (uint8_t a = 0; a < model->axes; a++) {
        if (!valid_priors(model->axis[a].prior, 1) || !(model->axis[a].bias_sd > 0.0F) ||
            !isfinite(model->axis[a].bias_sd)) {
            return false;
        }
    }
    uint32_t nodes = 0;
    for (uint8_t h = 0; h < model->hypotheses; h++) {
        const selfcal_hypothesis_t *hypothesis = &model->hypothesis[h];
        if (!valid_law(hypothesis->law, model->states, model->dt_s) ||
            (hypothesis->prior != NULL && !valid_priors(hypothesis->prior, model->axes))) {
            return false;
        }
        const bool rho = has_drift(hypothesis->law), ratio = has_ratio(hypothesis->law);
        const bool alpha = ratio || has_alpha(hypothesis->law);
        for (uint8_t a = 0; ratio && a < model->axes; a++) {
            const selfcal_prior_t *prior = &priors_of(model, hypothesis, a)[SELFCAL_RATIO];
            if (prior->ln_min < -LN_RATIO_MAX || prior->ln_max > LN_RATIO_MAX) {
                return false;
            }
        }
        if (rho != (hypothesis->rho != NULL) || alpha != (hypothesis->alpha != NULL) ||
            (rho && !valid_grid(hypothesis->rho, SELFCAL_GRID_MAX)) ||
            (alpha && !valid_grid(hypothesis->alpha, SELFCAL_ALPHA_MAX)) ||
            hypothesis_nodes(hypothesis) > SELFCAL_HYPOTHESIS_NODES_MAX) {
            return false;
        }
        nodes += hypothesis_nodes(hypothesis);
    }
    const selfcal_regressors_t *regressors = model->regressors;
    const selfcal_handling_t *handling = model->handling;
    if (handling != NULL && (!(handling->outlier_sd >= 0.0F) || !isfinite(handling->outlier_sd) ||
                             ((handling->steps || handling->variance_changes) && regressors != NULL))) {
        return false;
    }
    return nodes == model->nodes && nodes <= SELFCAL_NODES_MAX &&
           (regressors == NULL || (regressors->code != NULL && regressors->code->valid(model)));
}

void selfcal_bank_start_node(selfcal_t *self, uint16_t index) {
    const selfcal_place_t place = selfcal_bank_place(self, index);
    const selfcal_law_t *law = self->model->hypothesis[place.hypothesis].law;
    selfcal_node_t *node = &self->node[index];
    if (is_sum(law)) {
        memset(node, 0, sizeof *node);
        self->model->states->start(self, index, place);
        return;
    }
    const selfcal_wide_t variance = has_drift(law) ? exp(2.0 * (selfcal_wide_t)place.ln_rho) : 0.0; /* rho^2 */
    selfcal_wide_t beta = 0.0;
    if (has_decay(law)) {
        beta = -expm1(
            -fmin(exp((selfcal_wide_t)place.ln_alpha) * (selfcal_wide_t)self->model->dt_s, SELFCAL_ALPHA_DT_MAX));
    }
    const selfcal_wide_t one_less_phi_sq = beta * (2.0 - beta);
    selfcal_wide_t q = 0.0;       /* drift variance per interval */
    selfcal_wide_t p_first = 0.0; /* predicted drift variance at the first sample */
    if (has_walk(law)) {
        q = variance;
        p_first = q; /* x_0 = 0 */
    } else if (has_decay(law)) {
        p_first = variance; /* stationary */
        q = p_first * one_less_phi_sq;
    }
    /* Fixed point of P' = phi^2 P/(1 + P) + q: P^2 + b P - q = 0, in the form without cancellation. */
    const selfcal_wide_t b = one_less_phi_sq - q;
    const selfcal_wide_t root = sqrt(b * b + 4.0 * q);
    const selfcal_wide_t p_inf = b > 0.0 ? 2.0 * q / (b + root) : 0.5 * (root - b);
    memset(node, 0, sizeof *node);
    node->beta = (selfcal_real_t)beta;
    node->q = (selfcal_real_t)q;
    node->p_inf = (selfcal_real_t)p_inf;
    node->gains.moving.c = (selfcal_real_t)((1.0 - one_less_phi_sq) / (1.0 + p_inf));
    node->gains.moving.d = (selfcal_real_t)(p_first - p_inf);
    const selfcal_wide_t g_inf = (1.0 - beta) * p_inf / (1.0 + p_inf) + beta;
    node->u_inf = g_inf > 0.0 ? (selfcal_real_t)(beta / g_inf) : R(1.0);
    node->gains.moving.e = R(1.0) - node->u_inf;
}

/* Between what ln of an axis's sigma_v lies, as its first batch shows it: with D_i the differences of neighbours,
 * E D_i^2 / 2 = sigma_v^2 + sigma_w^2 / 2 and -E D_i D_(i+1) = sigma_v^2. The first is the upper end. The second is not
 * raised by drift but scatters more: where drift is evident (the batch spreads twice as wide as its differences,
 * sigma_w above some 0.8 sigma_v) it is the lower end, but not below a hundredth of the first. Few neighbours, among
 * gaps, scatter too much: then the steps across the gaps are the upper end, and a hundredth of it the lower. Both
 * within the prior's limits. */
typedef struct {
    selfcal_real_t lo, hi;
} ln_range_t;

/* Differences of neighbours from which on they show the noise: ln sigma_v to 0.25, half of the nodes' margin. */
#define NEIGHBOURS_MIN 8U

static ln_range_t first_ln_sigma(selfcal_t *self, uint8_t axis) {
    const selfcal_batch_t *batch = waiting(self);
    const selfcal_real_t *y = batch->y[axis];
    selfcal_real_t square = R(0.0), product = R(0.0), mean = R(0.0), spread = R(0.0), across = R(0.0);
    uint32_t squares = 0, products = 0;
    for (uint32_t i = 0; i < batch->count; i++) {
        const selfcal_real_t off = y[i] - mean; /* Welford's recursion */
        mean += off / (selfcal_real_t)(i + 1U);
        spread = r_fma(off, y[i] - mean, spread);
        if (i == 0U) {
            continue;
        }
        const selfcal_real_t step = y[i] - y[i - 1U];
        across += R(0.5) * step * step;
        if (batch->gap[i] > 0U) {
            continue;
        }
        square += R(0.5) * step * step;
        squares++;
        if (i > 1U && batch->gap[i - 1U] == 0U) {
            product -= step * (y[i - 1U] - y[i - 2U]);
            products++;
        }
    }
    const selfcal_prior_t *prior = &self->model->axis[axis].prior[SELFCAL_N];
    const selfcal_real_t half_ln_dt = R(0.5) * r_log((selfcal_real_t)self->model->dt_s);
    const selfcal_real_t least = (selfcal_real_t)prior->ln_min - half_ln_dt,
                         most = (selfcal_real_t)prior->ln_max - half_ln_dt;
    ln_range_t range = {least, least};
    const bool gappy = squares < NEIGHBOURS_MIN && squares + 1U < batch->count;
    if (gappy) {
        square = across;
        squares = batch->count - 1U;
    }
    if (square > R(0.0)) {
        square /= (selfcal_real_t)squares;
        spread /= (selfcal_real_t)(batch->count - 1U);
        product = products > 0U && spread > R(2.0) * square ? product / (selfcal_real_t)products : square;
        product = gappy ? R(0.0) : product;
        range.hi = r_fmin(r_fmax(R(0.5) * r_log(square), least), most);
        range.lo = r_fmin(r_fmax(R(0.5) * r_log(r_fmax(product, R(0.01) * square)), least), range.hi);
    } else if (squares == 0U) {
        range.lo = range.hi = R(0.5) * (least + most);
    }
    return range;
}

/* ln of sqrt(E D_i^2 / 2) over sigma_v for a moving average: E D_i^2 / 2 = sigma_v^2 (1 - theta + theta^2) / (1 +
 * theta)^2, which in the spectral ratio is sigma_v^2 (1 + 3 / ratio^2) / 4. */
static inline selfcal_real_t ln_difference_gain(selfcal_real_t ln_ratio) {
    return R(0.5) * r_log(r_fma(R(0.75), r_exp(R(-2.0) * ln_ratio), R(0.25)));
}

/* Places the rho nodes of every hypothesis for the axes' white noise. */
static void place_nodes(selfcal_t *self) {
    const selfcal_model_t *model = self->model;
    const selfcal_real_t half_ln_dt = R(0.5) * r_log((selfcal_real_t)model->dt_s);
    ln_range_t sigma[SELFCAL_AXES_MAX];
    for (uint8_t axis = 0; axis < model->axes; axis++) {
        sigma[axis] = first_ln_sigma(self, axis);
        selfcal_kernel_start(self, axis, sigma[axis].hi);
    }
    for (uint8_t h = 0; h < model->hypotheses; h++) {
        const selfcal_hypothesis_t *hypothesis = &model->hypothesis[h];
        selfcal_real_t rho_lo = INFINITY, rho_hi = -INFINITY, alpha_lo = INFINITY, alpha_hi = -INFINITY;
        for (uint8_t axis = 0; axis < model->axes; axis++) {
            if (selfcal_retired(self, axis)) {
                continue; /* dead before the first batch: it must not draw the nodes away from the others */
            }
            const selfcal_prior_t *prior = priors_of(model, hypothesis, axis);
            const bool markov = has_deviation(hypothesis->law);
            const selfcal_prior_t *drift = &prior[drift_parameter(hypothesis->law)];
            /* sigma_w = K sqrt(dt) */
            const selfcal_real_t shift = markov ? R(0.0) : half_ln_dt;
            /* Where the drift hides the white noise a deviation beyond the last node may still count. A sum's
             * likelihood, off which the report takes no expectation, must be level there. */
            const selfcal_real_t above = is_sum(hypothesis->law) ? R(3.0) : markov ? R(1.25) : R(0.5);
            ln_range_t ln_sigma = sigma[axis];
            if (hypothesis->law->coloured_noise) {
                ln_sigma.hi -= ln_difference_gain((selfcal_real_t)prior[SELFCAL_RATIO].ln_max);
                ln_sigma.lo -= ln_difference_gain((selfcal_real_t)prior[SELFCAL_RATIO].ln_min);
            }
            rho_lo = r_fmin(rho_lo, (selfcal_real_t)drift->ln_min + shift - ln_sigma.hi - R(0.5));
            rho_hi = r_fmax(rho_hi, (selfcal_real_t)drift->ln_max + shift - ln_sigma.lo + above);
            alpha_lo = r_fmin(alpha_lo, (selfcal_real_t)prior[SELFCAL_ALPHA].ln_min);
            alpha_hi = r_fmax(alpha_hi, (selfcal_real_t)prior[SELFCAL_ALPHA].ln_max);
        }
        const uint16_t rows = grid_nodes(hypothesis->rho), columns = grid_nodes(hypothesis->alpha);
        rho_lo = r_fmin(rho_lo, LN_RHO_MAX - R(1.0));
        rho_hi = r_fmin(rho_hi, LN_RHO_MAX);
        self->rho_lo[h] = rho_lo;
        self->rho_step[h] = rows > 1U ? (rho_hi - rho_lo) / (selfcal_real_t)(rows - 1U) : R(0.0);
        self->alpha_lo[h] = alpha_lo;
        self->alpha_step[h] = columns > 1U ? (alpha_hi - alpha_lo) / (selfcal_real_t)(columns - 1U) : R(0.0);
    }
}

void selfcal_bank_pace(selfcal_t *self, uint32_t block) {
    /* Twice what would do, since the blocks of a batch may have lost up to half of their samples. */
    const uint64_t pushes = (uint64_t)block * SELFCAL_BATCH;
    const uint64_t needed = (2U * (uint64_t)self->model->nodes + pushes - 1U) / pushes;
    self->block = block;
    self->push_nodes = (uint16_t)(needed > SELFCAL_PUSH_NODES ? needed : SELFCAL_PUSH_NODES);
}

void selfcal_bank_lay_out(selfcal_t *self, void *memory) {
    const selfcal_model_t *model = self->model;
    const size_t axes = axes_in(self), cells = (size_t)model->nodes * axes, regressors = regressors_of(model);
    unsigned char *behind = (unsigned char *)memory + SELFCAL_SIZE(model->nodes, axes);
    self->b = memory; /* first, since they may need 8-byte alignment */
    self->c = self->b + cells;
    self->node = (selfcal_node_t *)(void *)(self->c + cells);
    self->x = (selfcal_drift_t *)(void *)(self->node + model->nodes);
    if (regressors > 0U) {
        model->regressors->code->init(self, behind);
    }
    if (sum_nodes(model) > 0U) {
        model->states->init(self, behind + SELFCAL_REGRESSORS_SIZE(model->nodes, axes, regressors));
    }
}

selfcal_status_t selfcal_init_as(uint32_t layout, selfcal_t *self, const selfcal_model_t *model, void *memory,
                                 size_t size) {
    if (layout != SELFCAL_LAYOUT) {
        return SELFCAL_BAD_BUILD;
    }
    if (self == NULL || model == NULL || memory == NULL) {
        return SELFCAL_BAD_ARGUMENT;
    }
    if (!valid_model(model)) {
        return SELFCAL_BAD_MODEL;
    }
    const size_t regressors = regressors_of(model);
    const size_t needed = SELFCAL_SIZE(model->nodes, model->axes) +
                          SELFCAL_REGRESSORS_SIZE(model->nodes, model->axes, regressors) +
                          SELFCAL_TERMS_SIZE(sum_nodes(model), model->axes, regressors);
    if (size < needed || ((uintptr_t)memory & 7U) != 0U) {
        return SELFCAL_BAD_MEMORY;
    }
    memset(self, 0, sizeof *self);
    memset(memory, 0, needed);
    self->model = model;
    self->variance_ratio = R(1.0);
    self->keep = 1.0;
    self->beginning = 1.0;
    for (uint8_t axis = 0; axis < model->axes; axis++) {
        self->prior_sd[axis] = model->axis[axis].bias_sd;
    }
    selfcal_bank_lay_out(self, memory);
    selfcal_bank_pace(self, model->block);
    return SELFCAL_OK;
}

void selfcal_add_products(selfcal_sum_t *sum, const gains_t *gains, const innovations_t *one,
                          const innovations_t *other) {
    selfcal_sum_t value = {R(0.0), R(0.0)};
    const uint32_t count = gains->span.to - gains->span.from;
    for (uint32_t i = 0; i < count; i++) {
        const selfcal_real_t product = one->weighted[i] * other->nu[i];
        const selfcal_sum_t total = two_sum(value.hi, product);
        value.hi = total.hi;
        value.lo +=
            r_fma_exact(one->low[i], other->nu[i], r_fma_exact(one->weighted[i], other->nu[i], -product)) + total.lo;
    }
    const selfcal_sum_t scale = gains->scale;
    const selfcal_real_t product = scale.hi * value.hi;
    const selfcal_real_t rest =
        r_fma_exact(scale.hi, value.lo, r_fma_exact(scale.lo, value.hi, r_fma_exact(scale.hi, value.hi, -product)));
    sum_add(sum, product, rest);
}

/* a + b - fl(a + b). */
static selfcal_real_t sum_error(selfcal_real_t a, selfcal_real_t b, selfcal_real_t sum) {
    return r_fabs(a) > r_fabs(b) ? b - (sum - a) : a - (sum - b);
}

/* Gains while the variance still moves. 1/s is rounded to the same side for thousands of samples where P changes
 * slowly, and would tilt n/2 nats by 3e-8: the mean of what it is short of goes into the scale of the span's sums. */
static void gains_varying(const selfcal_batch_t *batch, selfcal_node_t *node, uint32_t block, gains_t *gains) {
    const span_t span = gains->span;
    const selfcal_real_t lost = batch->part ? selfcal_averaged_lost(node->q, node->beta, block) : R(0.0);
    selfcal_real_t product_less_1 = R(0.0); /* of all s: ln s of a small P keeps its digits */
    selfcal_real_t a = R(0.0), short_of = R(0.0);
    selfcal_moving_t *now = &node->gains.moving;
    const selfcal_real_t pull = now->c / (R(1.0) - node->beta) * node->u_inf; /* phi u_inf / (1 + p_inf) */
    for (uint32_t i = span.from; i < span.to; i++) {
        const selfcal_real_t r = batch->part ? averaged_noise(batch->r[i], lost) : R(1.0);
        const selfcal_real_t r_less_1 = r - R(1.0);
        const selfcal_real_t p = r_fmax(node->p_inf + now->d, R(0.0));
        const selfcal_real_t s = r + p;
        const selfcal_real_t inv_s = R(1.0) / s;
        const selfcal_real_t gain = p * inv_s;
        const selfcal_real_t g = r_fma(gain, -node->beta, gain) + node->beta;
        gains->g[i] = g;
        gains->inv_s[i] = inv_s;
        const selfcal_real_t u = node->u_inf + now->e;
        gains->u[i] = u * inv_s;
        short_of += r_fma_exact(-inv_s, s, R(1.0)) - inv_s * sum_error(r, p, s);
        a = r_fma(u, gains->u[i], a);
        now->e = r_fma(-g, now->e, now->e) - pull * inv_s * r_fma(-r_less_1, node->p_inf, now->d);
        now->d = now->c * r_fma(r * inv_s, now->d, r_less_1 * gain * node->p_inf); /* no product leaves a float */
        /* selfcal_rate() made samples better than the model's: 1 + (s - 1) would lose the digits of s */
        if (r < R(0.5)) {
            const selfcal_wide_t ln_s = log((selfcal_wide_t)r + (selfcal_wide_t)p);
            const selfcal_real_t hi = (selfcal_real_t)ln_s;
            sum_add(&node->ln_s, hi, (selfcal_real_t)(ln_s - (selfcal_wide_t)hi));
            continue;
        }
        const selfcal_real_t s_less_1 = r_less_1 + p;
        product_less_1 = r_fma(product_less_1, s_less_1, product_less_1 + s_less_1);
        if (product_less_1 > R(1e15)) {
            sum_add(&node->ln_s, r_log1p(product_less_1), R(0.0));
            product_less_1 = R(0.0);
        }
    }
    sum_add(&node->ln_s, r_log1p(product_less_1), R(0.0));
    gains->scale.hi = R(1.0);
    gains->scale.lo = short_of / (selfcal_real_t)(span.to - span.from);
    sum_add_scaled(&node->a, gains->scale, a);
}

/* A converged node while u still moves (selfcal_kernel_level() once it does not). s is constant and kept out of the
 * sums until they are added. */
static void gains_steady(selfcal_node_t *node, gains_t *gains) {
    const span_t span = gains->span;
    const selfcal_real_t g = steady_g(node);
    selfcal_real_t a = R(0.0);
    selfcal_moving_t *now = &node->gains.moving;
    gains->scale = steady_inv_s(node);
    for (uint32_t i = span.from; i < span.to; i++) {
        const selfcal_real_t u = node->u_inf + now->e;
        gains->g[i] = g;
        gains->inv_s[i] = R(1.0);
        gains->u[i] = u;
        a = r_fma(u, u, a);
        now->e = r_fma(-g, now->e, now->e);
    }
    sum_add_scaled(&node->a, gains->scale, a);
}

void selfcal_bank_leave_level(selfcal_t *self, size_t j) {
    selfcal_node_t *node = &self->node[j];
    if (node->level) {
        selfcal_kernel_unsettle(self, j);
        const selfcal_sum_t a = make_sum(level_a(node));
        sum_add(&node->a, a.hi, a.lo);
        node->level = false;
        node->level_from = 0;
    }
}

/* With regressors no node counts as level: their columns always move. */
static void run_span(selfcal_t *self, span_t span, size_t from, size_t to) {
    const selfcal_regressors_t *regressors = self->model->regressors;
    void (*const run)(selfcal_t *, size_t, const gains_t *) =
        regressors != NULL ? regressors->code->run : selfcal_kernel_run;
    const selfcal_batch_t *batch = waiting(self);
    bool whole = true;
    for (uint32_t i = span.from; i < span.to && batch->part; i++) {
        whole = whole && batch->r[i] == R(1.0);
    }
    if (whole) {
        selfcal_kernel_level(self, span, from, to);
    }
    gains_t gains;
    gains.span = span;
    for (size_t i = from; i < to; i++) {
        const size_t j = kernel_node(self, i);
        selfcal_node_t *node = &self->node[j];
        selfcal_moving_t *now = &node->gains.moving;
        if (is_state_node(self, node)) {
            self->model->states->run(self, j, &span);
            continue;
        }
        if (whole && node->level) {
            node->steady += span.to - span.from;
            continue;
        }
        if (whole && now->d == R(0.0)) {
            gains_steady(node, &gains);
            run(self, j, &gains);
            node->steady += span.to - span.from;
            if (r_fabs(now->e) <= r_fmax(SETTLED * node->u_inf, U_ZERO)) {
                now->e = R(0.0);
                node->level = self->columns == NULL;
                if (node->level) {
                    node->level_from = node->steady;
                    selfcal_kernel_settle(self, j);
                }
            }
        } else {
            selfcal_bank_leave_level(self, j);
            gains_varying(batch, node, self->model->block, &gains);
            run(self, j, &gains);
            if (r_fabs(now->d) <= CONVERGED * node->p_inf) {
                now->d = R(0.0);
            }
        }
    }
}

/* Predicts nodes over `count` intervals without a sample: exact, whatever the count. */
static void run_gap(selfcal_t *self, uint32_t count, size_t from, size_t to) {
    const selfcal_wide_t intervals = (selfcal_wide_t)count;
    for (size_t i = from; i < to; i++) {
        const size_t j = kernel_node(self, i);
        selfcal_node_t *node = &self->node[j];
        selfcal_moving_t *now = &node->gains.moving;
        if (is_state_node(self, node)) {
            self->model->states->gap(self, j, count);
            continue;
        }
        if (node->q == R(0.0)) {
            continue; /* the constant law: nothing changes */
        }
        selfcal_bank_leave_level(self, j);
        const selfcal_wide_t beta = (selfcal_wide_t)node->beta, d = (selfcal_wide_t)now->d, e = (selfcal_wide_t)now->e;
        if (node->beta == R(0.0)) {
            now->d = r_fmin((selfcal_real_t)(d + intervals * (selfcal_wide_t)node->q), P_MAX);
            continue; /* the prediction x stays */
        }
        const selfcal_wide_t less = -expm1(intervals * log(1.0 - beta)); /* 1 - phi^count */
        const selfcal_wide_t less_sq = less * (2.0 - less);
        const selfcal_wide_t stationary = (selfcal_wide_t)node->q / (beta * (2.0 - beta));
        now->d = r_fmin((selfcal_real_t)(d + less_sq * (stationary - (selfcal_wide_t)node->p_inf - d)), P_MAX);
        now->e = (selfcal_real_t)(e + less * (1.0 - (selfcal_wide_t)node->u_inf - e));
        if (self->columns != NULL) {
            self->model->regressors->code->gap(self, j, less);
        } else {
            selfcal_kernel_gap(self, j, less);
        }
    }
}

/* The nodes `from` to `to` - 1, in the kernel's order, over the batch that waits. */
static void run_batch(selfcal_t *self, uint16_t from, uint16_t to) {
    const selfcal_batch_t *batch = waiting(self);
    for (uint16_t i = from; self->keep < 1.0 && i < to; i++) {
        self->model->forgetting->code->fade(self, kernel_node(self, i));
    }
    for (uint16_t i = from; self->n == 0U && i < to; i++) {
        selfcal_bank_start_node(self, (uint16_t)kernel_node(self, i));
    }
    span_t span = {0, 0};
    while (span.from < batch->count) {
        if (batch->gap[span.from] > 0U) {
            run_gap(self, batch->gap[span.from], from, to);
        }
        span.to = span.from + 1U;
        while (span.to < batch->count && batch->gap[span.to] == 0U) {
            span.to++;
        }
        run_span(self, span, from, to);
        span.from = span.to;
    }
    if (batch->gap_after > 0U) {
        run_gap(self, batch->gap_after, from, to);
    }
}

bool selfcal_bank_run(selfcal_t *self, uint16_t nodes) {
    selfcal_batch_t *batch = waiting(self);
    if (batch->count == 0U && batch->gap_after == 0U) {
        return false;
    }
    const uint16_t all = self->model->nodes;
    const uint16_t to = all - self->ran > nodes ? (uint16_t)(self->ran + nodes) : all;
    run_batch(self, self->ran, to);
    self->ran = to;
    if (to == all) {
        self->n += batch->count;
        self->weight = self->keep * self->weight + (selfcal_wide_t)batch->count;
        batch->count = 0;
        batch->part = false;
        batch->gap_after = 0;
        self->ran = 0;
    }
    return true;
}

bool selfcal_bank_hand_over(selfcal_t *self) {
    selfcal_batch_t *batch = &self->batch[self->gathering];
    if (batch->count == 0U && self->pending_gap == 0U) {
        return false;
    }
    batch->gap_after = self->pending_gap;
    self->pending_gap = 0;
    self->gathering = (uint8_t)(1U - self->gathering);
    self->batches++;
    self->keep = self->model->forgetting != NULL && self->n > 0U ? self->model->forgetting->code->part_kept(self) : 1.0;
    if (self->columns != NULL) {
        self->model->regressors->code->hand_over(self);
    }
    if (self->n == 0U) {
        place_nodes(self);
    }
    selfcal_kernel_load(self);
    return true;
}

void selfcal_bank_flush(selfcal_t *self) {
    do {
        while (selfcal_bank_run(self, self->model->nodes)) {
        }
    } while (selfcal_bank_hand_over(self));
}

void selfcal_bank_sample(selfcal_t *self, const selfcal_real_t y[], selfcal_real_t r) {
    selfcal_batch_t *batch = &self->batch[self->gathering];
    for (uint8_t axis = 0; axis < self->model->axes; axis++) {
        batch->y[axis][batch->count] = y[axis];
    }
    batch->r[batch->count] = r;
    batch->part = batch->part || r != R(1.0);
    batch->gap[batch->count] = self->pending_gap;
    self->pending_gap = 0;
    batch->count++;
    if (batch->count == SELFCAL_BATCH) {
        while (selfcal_bank_run(self, self->model->nodes)) {
            /* late: samples were skipped that would have run the nodes */
        }
        (void)selfcal_bank_hand_over(self);
    }
}

void selfcal_bank_gap(selfcal_t *self, uint64_t count) {
    if (selfcal_count(self) == 0U) {
        return; /* time before the first sample changes nothing */
    }
    const uint64_t room = UINT32_MAX - (uint64_t)self->pending_gap;
    self->pending_gap += (uint32_t)(count < room ? count : room);
}

bool selfcal_retired(const selfcal_t *self, uint8_t axis) {
    SELFCAL_ASSERT(axis < self->model->axes);
    return (self->retired >> axis & 1U) != 0U;
}

uint32_t selfcal_count(const selfcal_t *self) {
    return self->n + self->batch[0].count + self->batch[1].count;
}

uint32_t selfcal_room(const selfcal_t *self) {
    return SELFCAL_BATCH - 1U - self->batch[self->gathering].count;
}

selfcal_wide_t selfcal_offset(const selfcal_t *self, uint8_t axis) {
    SELFCAL_ASSERT(axis < self->model->axes);
    return (selfcal_wide_t)self->origin[axis] + (selfcal_wide_t)self->offset[axis];
}

selfcal_wide_t selfcal_bank_from_prior(const selfcal_t *self, uint8_t axis) {
    return selfcal_offset(self, axis) - (selfcal_wide_t)self->prior_mean[axis];
}

void selfcal_bank_sums(const selfcal_t *self, uint8_t axis, uint16_t index, selfcal_node_view_t *view) {
    const selfcal_node_t *node = &self->node[index];
    if (is_state_node(self, node)) {
        self->model->states->view(self, axis, index, view);
        return;
    }
    view->a = sum_value(node->a) + level_a(node);
    selfcal_kernel_view(self, index, axis, &view->b, &view->c, &view->drift);
}

/* ln x to 1e-11, in a third of the time that log() takes in software: x = 2^k m, and m q/64 is so near 1 that its ln
 * needs few digits. */
selfcal_wide_t selfcal_bank_ln(selfcal_wide_t x) {
    /* clang-format off */
    static const selfcal_wide_t ln_q[] = { /* ln(q/64) from q = 43 on */
        -0.39768296766610944, -0.3746934494414107, -0.3522205935893521, -0.33024168687057687, -0.3087354816496133,
        -0.2876820724517809, -0.26706278524904525, -0.24686007793152578, -0.22705745063534608, -0.2076393647782445,
        -0.18859116980755003, -0.16989903679539747, -0.15154989812720093, -0.13353139262452263, -0.1158318155251217,
        -0.09844007281325252, -0.0813456394539524, -0.06453852113757118, -0.048009219186360606, -0.0317486983145803,
        -0.015748356968139168, 0.0, 0.015504186535965254, 0.030771658666753687, 0.0458095360312942, 0.06062462181643484,
        0.07522342123758753, 0.08961215868968714, 0.10379679368164356, 0.11778303565638346, 0.13157635778871926,
        0.1451820098444979, 0.15860503017663857, 0.17185025692665923, 0.184922338494012, 0.19782574332991987,
        0.21056476910734964, 0.22314355131420976, 0.2355660713127669, 0.24783616390458127, 0.25995752443692605,
        0.27193371548364176, 0.2837681731306446, 0.2954642128938359};
    /* clang-format on */
    if (!(x > 0.0 && x <= DBL_MAX)) {
        return log(x);
    }
    int k;
    selfcal_wide_t m = frexp(x, &k);
    if (m < 0.75) {
        m += m;
        k--;
    }
    const int q = (int)(R(64.0) / (selfcal_real_t)m + R(0.5)); /* m is 0.75 to 1.5 */
    const selfcal_wide_t wide = m * (selfcal_wide_t)q * 0.015625 - 1.0;
    const selfcal_real_t t = (selfcal_real_t)wide; /* 0.012 at most */
    const selfcal_real_t rest = t * t * r_fma(t, r_fma(t, r_fma(t, R(0.2), R(-0.25)), R(1.0) / R(3.0)), R(-0.5));
    return (selfcal_wide_t)k * SELFCAL_LN_2 - ln_q[q - 43] + (wide + (selfcal_wide_t)rest);
}

void selfcal_bank_ln_s(const selfcal_t *self, uint16_t index, selfcal_node_view_t *view) {
    const selfcal_node_t *node = &self->node[index];
    if (is_state_node(self, node)) {
        return;
    }
    view->ln_s = sum_value(node->ln_s);
    if (node->steady != 0U) {
        view->ln_s += (selfcal_wide_t)node->steady * selfcal_bank_ln(1.0 + (selfcal_wide_t)node->p_inf);
    }
}

static selfcal_averaged_t averaged_at(const selfcal_t *self, selfcal_place_t place) {
    return selfcal_averaged(r_exp(place.ln_alpha) * (selfcal_real_t)self->model->dt_s, self->model->block);
}

selfcal_wide_t selfcal_bank_per_prediction(const selfcal_t *self, uint16_t index) {
    const selfcal_place_t place = selfcal_bank_place(self, index);
    return has_decay(self->model->hypothesis[place.hypothesis].law)
               ? (selfcal_wide_t)averaged_at(self, place).now / (1.0 - (selfcal_wide_t)self->node[index].beta)
               : 1.0;
}

void selfcal_bank_now(const selfcal_t *self, uint16_t index, selfcal_node_view_t *view) {
    const selfcal_place_t place = selfcal_bank_place(self, index);
    const selfcal_node_t *node = &self->node[index];
    view->hypothesis = place.hypothesis;
    view->ln_rho = (selfcal_wide_t)place.ln_rho;
    view->ln_alpha = (selfcal_wide_t)place.ln_alpha;
    if (is_state_node(self, node)) {
        return;
    }
    const selfcal_moving_t now = moving_of(node);
    const selfcal_real_t beta = node->beta, phi = R(1.0) - beta, per_phi = beta > R(0.0) ? R(1.0) / phi : R(1.0);
    const selfcal_real_t p_next = node->p_inf + now.d;
    /* The filter holds the prediction for the next interval, phi times the drift now. */
    selfcal_real_t drift = per_phi, bias_left = (node->u_inf + now.e - beta) * per_phi, drift_var;
    if (phi > R(0.03)) {
        drift_var = r_fmax(p_next - node->q, R(0.0)) * per_phi * per_phi;
    } else {
        /* P' = phi^2 P(now) + q has lost P(now): it is that after a sample, unless a gap has just let it grow. */
        drift_var = now.d > R(1e-3) * node->p_inf ? p_next : p_next / (R(1.0) + p_next);
    }
    /* from the point to the end of the interval */
    if (self->model->block > 1U && beta > R(0.0)) {
        const selfcal_averaged_t of = averaged_at(self, place);
        drift *= of.now;
        bias_left = R(1.0) - of.now * (R(1.0) - bias_left);
        drift_var = of.now * of.now * drift_var + r_exp(R(2.0) * place.ln_rho) * of.after / of.gain;
    } else if (self->model->block > 1U) {
        drift_var += node->q * averaged_walk_after(self->model->block);
    }
    view->drift *= (selfcal_wide_t)drift;
    view->bias_left = (selfcal_wide_t)bias_left;
    view->drift_var = (selfcal_wide_t)drift_var;
}

void selfcal_bank_view(const selfcal_t *self, uint8_t axis, uint16_t index, selfcal_node_view_t *view) {
    selfcal_bank_sums(self, axis, index, view);
    selfcal_bank_ln_s(self, index, view);
    selfcal_bank_now(self, index, view);
}

selfcal_status_t selfcal_node(selfcal_t *self, uint8_t axis, uint16_t index, selfcal_node_view_t *view) {
    if (self == NULL || view == NULL || axis >= self->model->axes || index >= self->model->nodes) {
        return SELFCAL_BAD_ARGUMENT;
    }
    if (selfcal_retired(self, axis)) {
        return SELFCAL_AXIS_RETIRED;
    }
    selfcal_bank_flush(self);
    if (self->n == 0U) {
        return SELFCAL_TOO_SHORT; /* the nodes have no place yet */
    }
    selfcal_bank_view(self, axis, index, view);
    return SELFCAL_OK;
}
