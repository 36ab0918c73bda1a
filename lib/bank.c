/* Bank sums: one scalar filter per node over every axis, and the sums its likelihood needs.
 *
 * Each node runs the zero-bias filter over the measurement and over the regressor "1" (innovations nu and u); the bias and
 * sigma_v are integrated out afterwards from A = sum u^2/s, B = sum u nu/s, C = sum nu^2/s and D = sum ln s (generalised
 * least squares; de Jong, Biometrika 78 (1991) 143-151). Everything is relative to sigma_v.
 *
 *   nu = y - x        s = r + P        K = P/s        x' = phi (x + K nu)        P' = phi^2 r P/(r + P) + q
 *
 * Two rearrangements keep float exact enough:
 * - With beta = 1 - phi and g = phi K + beta, x' = x + g nu - beta y: beta down to 1e-7 keeps its digits, and a sample costs
 *   one subtraction and two fused multiply-adds besides its two sums.
 * - The Riccati recursion runs on d = P - p_inf, d' = phi^2 (r d + (r - 1) P p_inf) / ((1 + p_inf) (r + P)): its rounding is
 *   relative to d, which dies out, whereas P' itself would settle some 1e-7/g off (3e-4 relative at g = 1e-4). So does u,
 *   u' = u - g u + beta, on e = u - u_inf, u_inf = beta/g_inf: e' = (1 - g) e - (g - g_inf) u_inf, where
 *   g - g_inf = phi (d + (1 - r) p_inf) / ((1 + p_inf) (r + P)).
 */
#include "internal.h"

/* A node counts as converged when d falls to this part of p_inf: what is left of the gain's error moves a ln-likelihood by
 * less than that many nats. */
#define CONVERGED R(1e-6)

/* Drift that forgets within an interval is held at phi = e^-6.9 = 1e-3: the drift now is the prediction over phi, and neighbours
 * correlated by 1e-3 are beyond telling from white ones. */
#define ALPHA_DT_MAX 6.9

/* u has settled when e falls to this part of u_inf; where u_inf is 0 (random walk) at U_ZERO: denormals are slow. */
#define SETTLED R(1e-7)
#define U_ZERO R(1e-20)

static bool valid_prior(const selfcal_prior_t *prior) {
    return isfinite(prior->ln_min) && isfinite(prior->ln_max) && prior->ln_min < prior->ln_max;
}

static bool valid_grid(const selfcal_grid_t *grid) {
    return grid->nodes >= 6U && grid->nodes <= SELFCAL_GRID_MAX && grid->fit != NULL;
}

static uint16_t hypothesis_nodes(const selfcal_hypothesis_t *hypothesis) {
    uint32_t nodes = 1U;
    if (hypothesis->rho != NULL) {
        nodes *= hypothesis->rho->nodes;
    }
    if (hypothesis->alpha != NULL) {
        nodes *= hypothesis->alpha->nodes;
    }
    return (uint16_t)nodes;
}

static bool valid_model(const selfcal_model_t *model) {
    if (!(model->dt_s > 0.0F) || !isfinite(model->dt_s) || model->block == 0U || model->axes == 0U ||
        model->axes > SELFCAL_AXES_MAX || model->hypotheses == 0U || model->hypotheses > SELFCAL_HYPOTHESES_MAX ||
        model->axis == NULL || model->hypothesis == NULL) {
        return false;
    }
    for (uint8_t a = 0; a < model->axes; a++) {
        for (int p = 0; p < SELFCAL_PARAMETERS; p++) {
            if (!valid_prior(&model->axis[a].prior[p])) {
                return false;
            }
        }
        if (!(model->axis[a].bias_sd > 0.0F) || !isfinite(model->axis[a].bias_sd)) {
            return false;
        }
    }
    uint32_t nodes = 0;
    for (uint8_t h = 0; h < model->hypotheses; h++) {
        const selfcal_hypothesis_t *hypothesis = &model->hypothesis[h];
        const bool rho = hypothesis->law != SELFCAL_CONSTANT;
        const bool alpha = hypothesis->law == SELFCAL_GAUSS_MARKOV;
        if ((unsigned)hypothesis->law >= SELFCAL_LAWS || rho != (hypothesis->rho != NULL) ||
            alpha != (hypothesis->alpha != NULL) || (rho && !valid_grid(hypothesis->rho)) ||
            (alpha && !valid_grid(hypothesis->alpha))) {
            return false;
        }
        nodes += hypothesis_nodes(hypothesis);
    }
    return nodes == model->nodes;
}

/* Node of a law at (rho, alpha), at the instant of its first sample. */
static void init_node(selfcal_node_t *node, selfcal_law_t law, selfcal_real_t ln_rho, selfcal_real_t ln_alpha, float dt_s) {
    selfcal_wide_t q = 0.0;       /* drift variance per interval */
    selfcal_wide_t p_first = 0.0; /* predicted drift variance at the first sample */
    selfcal_wide_t one_less_phi_sq = 0.0;
    selfcal_wide_t beta = 0.0;
    if (law == SELFCAL_RANDOM_WALK) {
        q = exp(2.0 * (selfcal_wide_t)ln_rho);
        p_first = q; /* x_0 = 0 */
    } else if (law == SELFCAL_GAUSS_MARKOV) {
        const selfcal_wide_t alpha_dt = fmin(exp((selfcal_wide_t)ln_alpha) * (selfcal_wide_t)dt_s, ALPHA_DT_MAX);
        beta = -expm1(-alpha_dt);
        one_less_phi_sq = -expm1(-2.0 * alpha_dt);
        p_first = exp(2.0 * (selfcal_wide_t)ln_rho); /* stationary */
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
    node->c = (selfcal_real_t)((1.0 - one_less_phi_sq) / (1.0 + p_inf));
    node->d = (selfcal_real_t)(p_first - p_inf);
    const selfcal_wide_t g_inf = (1.0 - beta) * p_inf / (1.0 + p_inf) + beta;
    node->u_inf = g_inf > 0.0 ? (selfcal_real_t)(beta / g_inf) : R(1.0);
    node->e = R(1.0) - node->u_inf;
}

/* Between what ln of an axis's sigma_v lies, as its first batch shows it: with D_i the differences of neighbours,
 * E D_i^2 / 2 = sigma_v^2 + sigma_w^2 / 2 and -E D_i D_(i+1) = sigma_v^2. The first is the upper end. The second is not raised by
 * drift but scatters more: where drift is evident (the batch spreads twice as wide as its differences, sigma_w above some 0.8
 * sigma_v) it is the lower end, but not below a hundredth of the first. Both within the prior's limits. */
typedef struct {
    selfcal_real_t lo, hi;
} ln_range_t;

static ln_range_t first_ln_sigma(const selfcal_t *self, uint8_t axis) {
    const selfcal_real_t *y = self->y[axis];
    selfcal_real_t square = R(0.0), product = R(0.0), mean = R(0.0), spread = R(0.0);
    uint32_t squares = 0, products = 0;
    for (uint32_t i = 0; i < self->in_batch; i++) {
        const selfcal_real_t off = y[i] - mean; /* Welford's recursion */
        mean += off / (selfcal_real_t)(i + 1U);
        spread = r_fma(off, y[i] - mean, spread);
        if (i == 0U || self->gap[i] > 0U) {
            continue;
        }
        const selfcal_real_t step = y[i] - y[i - 1U];
        square += R(0.5) * step * step;
        squares++;
        if (i > 1U && self->gap[i - 1U] == 0U) {
            product -= step * (y[i - 1U] - y[i - 2U]);
            products++;
        }
    }
    const selfcal_prior_t *prior = &self->model->axis[axis].prior[SELFCAL_N];
    const selfcal_real_t half_ln_dt = R(0.5) * r_log((selfcal_real_t)self->model->dt_s);
    const selfcal_real_t least = (selfcal_real_t)prior->ln_min - half_ln_dt, most = (selfcal_real_t)prior->ln_max - half_ln_dt;
    ln_range_t range = {least, least};
    if (square > R(0.0)) {
        square /= (selfcal_real_t)squares;
        spread /= (selfcal_real_t)(self->in_batch - 1U);
        product = products > 0U && spread > R(2.0) * square ? product / (selfcal_real_t)products : square;
        range.hi = r_fmin(r_fmax(R(0.5) * r_log(square), least), most);
        range.lo = r_fmin(r_fmax(R(0.5) * r_log(r_fmax(product, R(0.01) * square)), least), range.hi);
    } else if (squares == 0U) {
        range.lo = range.hi = R(0.5) * (least + most);
    }
    return range;
}

/* Places the rho nodes of every hypothesis for the axes' white noise, and starts all filters. */
static void place_nodes(selfcal_t *self) {
    const selfcal_model_t *model = self->model;
    const selfcal_real_t half_ln_dt = R(0.5) * r_log((selfcal_real_t)model->dt_s);
    selfcal_node_t *node = self->node;
    for (uint8_t h = 0; h < model->hypotheses; h++) {
        const selfcal_hypothesis_t *hypothesis = &model->hypothesis[h];
        selfcal_real_t rho_lo = INFINITY, rho_hi = -INFINITY, alpha_lo = INFINITY, alpha_hi = -INFINITY;
        for (uint8_t axis = 0; axis < model->axes; axis++) {
            if (selfcal_retired(self, axis)) {
                continue; /* dead before the first batch: it must not draw the nodes away from the others */
            }
            const selfcal_prior_t *prior = model->axis[axis].prior;
            const bool markov = hypothesis->law == SELFCAL_GAUSS_MARKOV;
            const selfcal_prior_t *drift = &prior[markov ? SELFCAL_SIGMA_M : SELFCAL_K];
            /* sigma_w = K sqrt(dt) */
            const selfcal_real_t shift = markov ? R(0.0) : half_ln_dt;
            const ln_range_t sigma = first_ln_sigma(self, axis);
            rho_lo = r_fmin(rho_lo, (selfcal_real_t)drift->ln_min + shift - sigma.hi - R(0.5));
            rho_hi = r_fmax(rho_hi, (selfcal_real_t)drift->ln_max + shift - sigma.lo + R(0.5));
            alpha_lo = r_fmin(alpha_lo, (selfcal_real_t)prior[SELFCAL_ALPHA].ln_min);
            alpha_hi = r_fmax(alpha_hi, (selfcal_real_t)prior[SELFCAL_ALPHA].ln_max);
        }
        const uint16_t rows = hypothesis->rho != NULL ? hypothesis->rho->nodes : 1U;
        const uint16_t columns = hypothesis->alpha != NULL ? hypothesis->alpha->nodes : 1U;
        self->rho_lo[h] = rho_lo;
        self->rho_step[h] = rows > 1U ? (rho_hi - rho_lo) / (selfcal_real_t)(rows - 1U) : R(0.0);
        self->alpha_lo[h] = alpha_lo;
        self->alpha_step[h] = columns > 1U ? (alpha_hi - alpha_lo) / (selfcal_real_t)(columns - 1U) : R(0.0);
        for (uint16_t i = 0; i < rows; i++) {
            for (uint16_t j = 0; j < columns; j++) {
                init_node(node, hypothesis->law, r_fma((selfcal_real_t)i, self->rho_step[h], rho_lo),
                          r_fma((selfcal_real_t)j, self->alpha_step[h], alpha_lo), model->dt_s);
                node++;
            }
        }
    }
}

selfcal_status_t selfcal_init(selfcal_t *self, const selfcal_model_t *model, void *memory, size_t size) {
    if (self == NULL || model == NULL || memory == NULL) {
        return SELFCAL_BAD_ARGUMENT;
    }
    if (!valid_model(model)) {
        return SELFCAL_BAD_MODEL;
    }
    if (size < SELFCAL_SIZE(model->nodes, model->axes) || ((uintptr_t)memory & 7U) != 0U) {
        return SELFCAL_BAD_MEMORY;
    }
    const size_t cells = (size_t)model->nodes * model->axes;
    memset(self, 0, sizeof *self);
    memset(memory, 0, SELFCAL_SIZE(model->nodes, model->axes));
    self->model = model;
    self->block = model->block;
    self->variance_ratio = R(1.0);
    self->node = memory;
    self->b = (selfcal_sum_t *)(void *)(self->node + model->nodes);
    self->c = self->b + cells;
    self->x = (selfcal_real_t *)(void *)(self->c + cells);
    return SELFCAL_OK;
}

/* ------------------------------------------------------------------------------------------------------- long sums */

/* Adds hi + lo, |lo| far below |hi| (Knuth's two-sum, then renormalised). */
static inline void sum_add(selfcal_sum_t *sum, selfcal_real_t hi, selfcal_real_t lo) {
    const selfcal_real_t total = sum->hi + hi;
    const selfcal_real_t part = total - sum->hi;
    const selfcal_real_t error = ((sum->hi - (total - part)) + (hi - part)) + (sum->lo + lo);
    sum->hi = total + error;
    sum->lo = error - (sum->hi - total);
}

/* Adds scale * value, the product in full. */
static inline void sum_add_scaled(selfcal_sum_t *sum, selfcal_sum_t scale, selfcal_real_t value) {
    const selfcal_real_t product = scale.hi * value;
    sum_add(sum, product, r_fma(scale.lo, value, r_fma(scale.hi, value, -product)));
}

static selfcal_wide_t sum_value(selfcal_sum_t sum) {
    return (selfcal_wide_t)sum.hi + (selfcal_wide_t)sum.lo;
}

/* 1/(1 + p_inf) to twice the digits: one Newton step on the residual of the quotient. */
static selfcal_sum_t steady_inv_s(const selfcal_node_t *node) {
    const selfcal_real_t s = R(1.0) + node->p_inf;
    const selfcal_real_t s_lo = node->p_inf >= R(1.0) ? R(1.0) - (s - node->p_inf) : node->p_inf - (s - R(1.0));
    const selfcal_real_t inv = R(1.0) / s;
    const selfcal_sum_t result = {inv, inv * r_fma(-inv, s_lo, r_fma(-inv, s, R(1.0)))};
    return result;
}

/* Part of the batch without a gap inside. */
typedef struct {
    uint32_t from, to;
} span_t;

/* The gain side of a batch, shared by the axes. */
typedef struct {
    selfcal_real_t g[SELFCAL_BATCH];     /* phi K + beta */
    selfcal_real_t u[SELFCAL_BATCH];     /* innovation of "1" over s */
    selfcal_real_t inv_s[SELFCAL_BATCH]; /* 1 where s is constant and left to the scales */
    selfcal_sum_t scale_b, scale_c;      /* what the span's sums of nu and nu^2 are still to be multiplied by */
} gains_t;

/* a + b - fl(a + b). */
static selfcal_real_t sum_error(selfcal_real_t a, selfcal_real_t b, selfcal_real_t sum) {
    return r_fabs(a) > r_fabs(b) ? b - (sum - a) : a - (sum - b);
}

/* Gains while the variance still moves. 1/s is rounded to the same side for thousands of samples where P changes slowly, and would
 * tilt n/2 nats by 3e-8: the mean of what it is short of goes into the scale of the span's sums. */
static void gains_varying(const selfcal_t *self, span_t span, selfcal_node_t *node, gains_t *gains) {
    selfcal_real_t product_less_1 = R(0.0); /* of all s: ln s of a small P keeps its digits */
    selfcal_real_t a = R(0.0), short_of = R(0.0);
    const selfcal_real_t pull = node->c / (R(1.0) - node->beta) * node->u_inf; /* phi u_inf / (1 + p_inf) */
    for (uint32_t i = span.from; i < span.to; i++) {
        const selfcal_real_t r = self->r[i];
        const selfcal_real_t p = r_fmax(node->p_inf + node->d, R(0.0));
        const selfcal_real_t s = r + p;
        const selfcal_real_t inv_s = R(1.0) / s;
        const selfcal_real_t gain = p * inv_s;
        const selfcal_real_t g = r_fma(gain, -node->beta, gain) + node->beta;
        gains->g[i] = g;
        gains->inv_s[i] = inv_s;
        const selfcal_real_t u = node->u_inf + node->e;
        gains->u[i] = u * inv_s;
        short_of += r_fma(-inv_s, s, R(1.0)) - inv_s * sum_error(r, p, s);
        a = r_fma(u, gains->u[i], a);
        node->e = r_fma(-g, node->e, node->e) - pull * inv_s * r_fma(R(1.0) - r, node->p_inf, node->d);
        node->d = node->c * inv_s * r_fma(r, node->d, (r - R(1.0)) * p * node->p_inf);
        const selfcal_real_t s_less_1 = (r - R(1.0)) + p;
        product_less_1 = r_fma(product_less_1, s_less_1, product_less_1 + s_less_1);
        if (product_less_1 > R(1e15)) {
            sum_add(&node->ln_s, r_log1p(product_less_1), R(0.0));
            product_less_1 = R(0.0);
        }
    }
    sum_add(&node->ln_s, r_log1p(product_less_1), R(0.0));
    gains->scale_c.hi = R(1.0);
    gains->scale_c.lo = short_of / (selfcal_real_t)(span.to - span.from);
    gains->scale_b = gains->scale_c;
    sum_add_scaled(&node->a, gains->scale_c, a);
}

/* The gain of a converged node, phi K + beta. */
static selfcal_real_t steady_g(const selfcal_node_t *node) {
    const selfcal_real_t gain = node->p_inf / (R(1.0) + node->p_inf);
    return r_fma(gain, -node->beta, gain) + node->beta;
}

/* A converged node while u still moves. s is constant and kept out of the sums until they are added. */
static void gains_steady(span_t span, selfcal_node_t *node, gains_t *gains) {
    const selfcal_real_t g = steady_g(node);
    selfcal_real_t a = R(0.0);
    gains->scale_b = gains->scale_c = steady_inv_s(node);
    for (uint32_t i = span.from; i < span.to; i++) {
        const selfcal_real_t u = node->u_inf + node->e;
        gains->g[i] = g;
        gains->inv_s[i] = R(1.0);
        gains->u[i] = u;
        a = r_fma(u, u, a);
        node->e = r_fma(-g, node->e, node->e);
    }
    sum_add_scaled(&node->a, gains->scale_c, a);
}

/* ... and once u is constant as well: it stays out, too. */
static void gains_level(span_t span, selfcal_node_t *node, gains_t *gains) {
    const selfcal_real_t u = node->u_inf;
    const selfcal_sum_t inv_s = steady_inv_s(node);
    const selfcal_real_t product = inv_s.hi * u;
    gains->scale_c = inv_s;
    gains->scale_b.hi = product;
    gains->scale_b.lo = r_fma(inv_s.lo, u, r_fma(inv_s.hi, u, -product));
    sum_add_scaled(&node->a, inv_s, (selfcal_real_t)(span.to - span.from) * u * u);
}

static void add_span(selfcal_t *self, size_t k, const gains_t *gains, selfcal_real_t b, selfcal_real_t c) {
    sum_add_scaled(&self->b[k], gains->scale_b, b);
    sum_add_scaled(&self->c[k], gains->scale_c, c);
}

/* The kernels: every axis of one node through the span. Sums of a span are short enough for selfcal_real_t; they go into the
 * long ones scaled in full. */

static void run_axes(selfcal_t *self, span_t span, size_t j, const gains_t *gains) {
    const selfcal_real_t minus_beta = -self->node[j].beta;
    const size_t axes = self->model->axes;
    for (size_t axis = 0; axis < axes; axis++) {
        const size_t k = j * axes + axis;
        selfcal_real_t x = self->x[k], b = R(0.0), c = R(0.0);
        for (uint32_t i = span.from; i < span.to; i++) {
            const selfcal_real_t y = self->y[axis][i];
            const selfcal_real_t nu = y - x;
            b = r_fma(gains->u[i], nu, b);
            c = r_fma(nu, nu * gains->inv_s[i], c);
            x = r_fma(minus_beta, y, r_fma(gains->g[i], nu, x));
        }
        self->x[k] = x;
        add_span(self, k, gains, b, c);
    }
}

/* Nearly all samples of a long record go through here: five arithmetic instructions an axis and sample. By fours, which also
 * keeps the sums short: squares of lattice values would round to one side (1e-7 of C, seen with 64 in a row). */
static void run_axes_level(selfcal_t *self, span_t span, size_t j, const gains_t *gains) {
    const selfcal_real_t minus_beta = -self->node[j].beta;
    const selfcal_real_t g = steady_g(&self->node[j]);
    const size_t axes = self->model->axes;
    for (size_t axis = 0; axis < axes; axis++) {
        const size_t k = j * axes + axis;
        const selfcal_real_t *y = &self->y[axis][span.from];
        const selfcal_real_t *const end = y + (span.to - span.from);
        selfcal_real_t x = self->x[k], b = R(0.0), c = R(0.0);
        for (; end - y >= 4; y += 4) {
            const selfcal_real_t y0 = y[0], y1 = y[1], y2 = y[2], y3 = y[3];
            const selfcal_real_t nu0 = y0 - x;
            x = r_fma(minus_beta, y0, r_fma(g, nu0, x));
            const selfcal_real_t nu1 = y1 - x;
            x = r_fma(minus_beta, y1, r_fma(g, nu1, x));
            const selfcal_real_t nu2 = y2 - x;
            x = r_fma(minus_beta, y2, r_fma(g, nu2, x));
            const selfcal_real_t nu3 = y3 - x;
            x = r_fma(minus_beta, y3, r_fma(g, nu3, x));
            b += (nu0 + nu1) + (nu2 + nu3);
            c += r_fma(nu3, nu3, r_fma(nu2, nu2, r_fma(nu1, nu1, nu0 * nu0)));
        }
        for (; y < end; y++) {
            const selfcal_real_t nu = *y - x;
            b += nu;
            c = r_fma(nu, nu, c);
            x = r_fma(minus_beta, *y, r_fma(g, nu, x));
        }
        self->x[k] = x;
        add_span(self, k, gains, b, c);
    }
}

static void run_span(selfcal_t *self, span_t span) {
    bool whole = true;
    for (uint32_t i = span.from; i < span.to; i++) {
        whole = whole && self->r[i] == R(1.0);
    }
    gains_t gains;
    for (size_t j = 0; j < self->model->nodes; j++) {
        selfcal_node_t *node = &self->node[j];
        if (whole && node->level) {
            gains_level(span, node, &gains);
            run_axes_level(self, span, j, &gains);
            node->steady += span.to - span.from;
        } else if (whole && node->d == R(0.0)) {
            gains_steady(span, node, &gains);
            run_axes(self, span, j, &gains);
            node->steady += span.to - span.from;
            if (r_fabs(node->e) <= r_fmax(SETTLED * node->u_inf, U_ZERO)) {
                node->e = R(0.0);
                node->level = true;
            }
        } else {
            gains_varying(self, span, node, &gains);
            run_axes(self, span, j, &gains);
            node->level = false;
            if (r_fabs(node->d) <= CONVERGED * node->p_inf) {
                node->d = R(0.0);
            }
        }
    }
    self->n += span.to - span.from;
}

/* Predicts every node over `count` intervals without a sample: exact, whatever the count. */
static void run_gap(selfcal_t *self, uint32_t count) {
    const size_t axes = self->model->axes;
    const selfcal_wide_t intervals = (selfcal_wide_t)count;
    for (size_t j = 0; j < self->model->nodes; j++) {
        selfcal_node_t *node = &self->node[j];
        if (node->q == R(0.0)) {
            continue; /* the constant law: nothing changes */
        }
        node->level = false;
        if (node->beta == R(0.0)) {
            node->d = (selfcal_real_t)((selfcal_wide_t)node->d + intervals * (selfcal_wide_t)node->q);
            continue; /* the prediction x stays */
        }
        const selfcal_wide_t ln_phi = log1p(-(selfcal_wide_t)node->beta);
        const selfcal_wide_t less = -expm1(intervals * ln_phi);          /* 1 - phi^count */
        const selfcal_wide_t less_sq = -expm1(2.0 * intervals * ln_phi); /* 1 - phi^(2 count) */
        const selfcal_wide_t stationary = (selfcal_wide_t)node->q / -expm1(2.0 * ln_phi);
        const selfcal_wide_t d = (selfcal_wide_t)node->d;
        node->d = (selfcal_real_t)(d + less_sq * (stationary - (selfcal_wide_t)node->p_inf - d));
        node->e = (selfcal_real_t)((selfcal_wide_t)node->e + less * (1.0 - (selfcal_wide_t)node->u_inf - (selfcal_wide_t)node->e));
        for (size_t k = j * axes; k < (j + 1U) * axes; k++) {
            self->x[k] = (selfcal_real_t)((selfcal_wide_t)self->x[k] * (1.0 - less));
        }
    }
}

void selfcal_bank_flush(selfcal_t *self) {
    if (self->n == 0U && self->in_batch > 0U) {
        place_nodes(self);
    }
    span_t span = {0, 0};
    while (span.from < self->in_batch) {
        if (self->gap[span.from] > 0U) {
            run_gap(self, self->gap[span.from]);
        }
        span.to = span.from + 1U;
        while (span.to < self->in_batch && self->gap[span.to] == 0U) {
            span.to++;
        }
        run_span(self, span);
        span.from = span.to;
    }
    self->in_batch = 0;
    if (self->pending_gap > 0U) {
        run_gap(self, self->pending_gap);
        self->pending_gap = 0;
    }
}

void selfcal_bank_sample(selfcal_t *self, const selfcal_real_t y[], selfcal_real_t r) {
    for (uint8_t axis = 0; axis < self->model->axes; axis++) {
        self->y[axis][self->in_batch] = y[axis];
    }
    self->r[self->in_batch] = r;
    self->gap[self->in_batch] = self->pending_gap;
    self->pending_gap = 0;
    self->in_batch++;
    if (self->in_batch == SELFCAL_BATCH) {
        selfcal_bank_flush(self);
    }
}

void selfcal_bank_gap(selfcal_t *self, uint64_t count) {
    if (selfcal_count(self) == 0U) {
        return; /* time before the first sample changes nothing */
    }
    const uint64_t room = UINT32_MAX - (uint64_t)self->pending_gap;
    self->pending_gap += (uint32_t)(count < room ? count : room);
}

uint32_t selfcal_count(const selfcal_t *self) {
    return self->n + self->in_batch;
}

selfcal_wide_t selfcal_offset(const selfcal_t *self, uint8_t axis) {
    SELFCAL_ASSERT(axis < self->model->axes);
    return (selfcal_wide_t)self->origin[axis] + (selfcal_wide_t)self->offset[axis];
}

/* The hypothesis of a node; `index` becomes its place there. */
static uint8_t locate(const selfcal_model_t *model, uint16_t *index) {
    uint8_t h = 0;
    while (*index >= hypothesis_nodes(&model->hypothesis[h])) {
        *index = (uint16_t)(*index - hypothesis_nodes(&model->hypothesis[h]));
        h++;
    }
    return h;
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
    uint16_t at = index;
    const uint8_t h = locate(self->model, &at);
    const selfcal_hypothesis_t *hypothesis = &self->model->hypothesis[h];
    const uint16_t columns = hypothesis->alpha != NULL ? hypothesis->alpha->nodes : 1U;
    const selfcal_node_t *node = &self->node[index];
    const size_t k = (size_t)index * self->model->axes + axis;
    const selfcal_wide_t beta = (selfcal_wide_t)node->beta;
    const selfcal_wide_t phi = 1.0 - beta;
    const selfcal_wide_t p_next = (selfcal_wide_t)node->p_inf + (selfcal_wide_t)node->d;
    view->law = hypothesis->law;
    const uint16_t row = (uint16_t)(at / columns), column = (uint16_t)(at % columns);
    view->ln_rho = (selfcal_wide_t)NAN;
    view->ln_alpha = (selfcal_wide_t)NAN;
    if (hypothesis->rho != NULL) {
        view->ln_rho = (selfcal_wide_t)r_fma((selfcal_real_t)row, self->rho_step[h], self->rho_lo[h]);
    }
    if (hypothesis->alpha != NULL) {
        view->ln_alpha = (selfcal_wide_t)r_fma((selfcal_real_t)column, self->alpha_step[h], self->alpha_lo[h]);
    }
    view->a = sum_value(node->a);
    view->b = sum_value(self->b[k]);
    view->c = sum_value(self->c[k]);
    view->ln_s = sum_value(node->ln_s) + (selfcal_wide_t)node->steady * log1p((selfcal_wide_t)node->p_inf);
    /* The filter holds the prediction for the next interval, phi times the drift now. */
    view->drift = (selfcal_wide_t)self->x[k] / phi;
    view->bias_left = ((selfcal_wide_t)node->u_inf + (selfcal_wide_t)node->e - beta) / phi;
    if (phi > 0.03) {
        view->drift_var = fmax(p_next - (selfcal_wide_t)node->q, 0.0) / (phi * phi);
    } else {
        /* P' = phi^2 P(now) + q has lost P(now): it is that after a sample, unless a gap has just let it grow. */
        const bool gap = (selfcal_wide_t)node->d > 1e-3 * (selfcal_wide_t)node->p_inf;
        view->drift_var = gap ? p_next : p_next / (1.0 + p_next);
    }
    return SELFCAL_OK;
}

selfcal_status_t selfcal_log_likelihood(selfcal_t *self, uint8_t axis, uint16_t node, selfcal_wide_t sigma_v, selfcal_wide_t *ln_p) {
    selfcal_node_view_t v;
    if (ln_p == NULL || !(sigma_v > 0.0)) {
        return SELFCAL_BAD_ARGUMENT;
    }
    const selfcal_status_t status = selfcal_node(self, axis, node, &v);
    if (status != SELFCAL_OK) {
        return status;
    }
    /* Generalised least squares with x0 about the offset and the square completed: the residual C - B^2/A does not feel the bias, the
     * estimate B/A is weighed against N(-offset, P0). The same number without the cancellation of large terms. */
    const selfcal_wide_t p0 = (selfcal_wide_t)self->model->axis[axis].bias_sd * (selfcal_wide_t)self->model->axis[axis].bias_sd;
    const selfcal_wide_t var = sigma_v * sigma_v;
    const selfcal_wide_t residual = v.c - v.b * v.b / v.a;
    const selfcal_wide_t miss = v.b / v.a + selfcal_offset(self, axis);
    *ln_p = -0.5 * ((selfcal_wide_t)self->n * (SELFCAL_LN_2PI + 2.0 * log(sigma_v)) + v.ln_s + residual / var +
                    log1p(p0 * v.a / var) + miss * miss / (var / v.a + p0));
    return SELFCAL_OK;
}
