/* Laws that are sums: nodes whose drift, or whose coloured noise, has several states.
 *
 * A reading is y_i = x0 + sum_j x_j + w_i, the states scaled so that each is read with a factor of 1. All variances are
 * relative to sigma_v^2, r that of a sample's white noise (1 for a whole block):
 *   x_j' = phi_j x_j + noise of variance q_j,   w_i ~ N(0, r/(1 + theta)^2).
 * A moving average (e_i + theta e_(i-1))/(1 + theta) is w_i = e_i/(1 + theta) and a last state theta e_(i-1)/(1 +
 * theta), whose phi is 0 and whose noise is theta w_i. The filter with noise of reading and state correlated (Anderson
 * & Moore, Optimal Filtering, 1979, section 5.4), one step from prediction to prediction, with S = theta r/(1 +
 * theta)^2 in the last place and else 0:
 *   nu = y - sum x_j    s = r/(1 + theta)^2 + sum P    kappa = (phi_j sum_i P_ij + S_j)/s
 *   x_j' = phi_j x_j + kappa_j nu                      P' = phi P phi + Q - kappa kappa' s
 * An oscillation is x'' + 2 d w x' + w^2 x = noise. Its states are (x + x'/w)/2 and (x - x'/w)/2: they add to x, do not
 * correlate, and each has half of its variance. With e = exp(-d w t), s = sqrt(1 - d^2), over a time t
 *   x_1' = m x_1 + (n - b) x_2   x_2' = (n + b) x_1 + m x_2   m = e cos(w s t)   b = e sin(w s t)/s   n = d b
 * P and the gains are in selfcal_wide_t, until P has converged; a sample then costs the filter alone. The bias and
 * sigma_v are integrated out from the same sums as for every node (bank.c), which are here taken to twice the digits,
 * the regressors' columns among them (regressors.c says why). */
#include "bank_inside.h"

/* P has converged when no variance moves by this part of itself within a sample: at a gain of 1e-4 it then is within
 * 1e-8. */
#define CONVERGED 1e-12

/* Products of s are so far from 0 and infinity that the next s cannot reach either. */
#define PRODUCT_MAX 1e200

/* States: one a term, and e_(i-1) of coloured noise. */
static size_t order_of(const selfcal_law_t *law) {
    return (size_t)law->terms + (law->coloured_noise ? 1U : 0U);
}

static size_t series_of(const selfcal_t *self) {
    return 1U + regressors_of(self->model) + axes_in(self);
}

/* Node `j` among those of sums, and its law. */
typedef struct {
    size_t index, order;
} term_t;

static term_t term_of(const selfcal_t *self, size_t j) {
    const selfcal_hypothesis_t *hypothesis = self->model->hypothesis;
    const node_of_t node = node_of(self->model, j);
    term_t term = {node.index, order_of(hypothesis[node.hypothesis].law)};
    for (uint8_t h = 0; h < node.hypothesis; h++) {
        term.index += is_sum(hypothesis[h].law) ? hypothesis_nodes(&hypothesis[h]) : 0U;
    }
    return term;
}

/* States of one series. */
static selfcal_sum_t *states(const selfcal_t *self, size_t index, size_t series) {
    return &self->terms->x[(index * series_of(self) + series) * SELFCAL_TERMS_MAX];
}

/* Behind the memory of the bank and its regressors; what SELFCAL_TERMS_SIZE() adds includes the room to align it. */
static void init_states(selfcal_t *self, unsigned char *memory) {
    const size_t nodes = sum_nodes(self->model);
    memory += (8U - ((uintptr_t)memory & 7U)) & 7U;
    self->terms = (selfcal_terms_t *)(void *)memory;
    memory += (sizeof *self->terms + 7U) / 8U * 8U;
    self->terms->node = (selfcal_term_node_t *)(void *)memory;
    self->terms->x = (selfcal_sum_t *)(void *)(self->terms->node + nodes);
    self->terms->bc = self->terms->x + nodes * series_of(self) * SELFCAL_TERMS_MAX;
}

/* --- gains --- */

/* Whether two of the states are an oscillation's: never in a build without room for them. */
static bool has_pair(const selfcal_term_node_t *node) {
    return SELFCAL_TERMS_MAX > 1 && node->pair != 0U;
}

/* Both states of an oscillation have one: the first one's. */
static selfcal_real_t beta_of(const selfcal_term_node_t *node, size_t a) {
    return node->beta[has_pair(node) && a == node->pair ? a - 1U : a];
}

static selfcal_wide_t phi_of(const selfcal_term_node_t *node, size_t a) {
    return 1.0 - (selfcal_wide_t)beta_of(node, a);
}

/* 1/(1 + theta)^2. */
static selfcal_wide_t white_of(const selfcal_term_node_t *node) {
    const selfcal_wide_t whole = 1.0 + (selfcal_wide_t)node->theta;
    return 1.0 / (whole * whole);
}

/* Transition of an oscillation's two states over a time, see above. */
typedef struct {
    selfcal_wide_t m, up, down;
} swing_t;

static swing_t swing_of(const selfcal_term_t *first, selfcal_wide_t time_s) {
    const selfcal_wide_t w = (selfcal_wide_t)first[0].bandwidth, rate = (selfcal_wide_t)first[1].bandwidth;
    const selfcal_wide_t d = rate / w, s = sqrt(1.0 - d * d), e = exp(-rate * time_s);
    const selfcal_wide_t b = e * sin(w * s * time_s) / s;
    const swing_t swing = {e * cos(w * s * time_s), (d - 1.0) * b, (d + 1.0) * b};
    return swing;
}

/* All transitions of one oscillation commute. */
static swing_t after(swing_t x, swing_t y) {
    const swing_t both = {x.m * y.m + x.up * y.down, x.m * y.up + x.up * y.m, x.down * y.m + x.m * y.down};
    return both;
}

/* The stationary variance of each state is the first one's q. */
static swing_t turn_of(const selfcal_term_node_t *node) {
    const swing_t turn = {phi_of(node, node->pair), -(selfcal_wide_t)node->beta[node->pair],
                          (selfcal_wide_t)node->q[node->pair]};
    return turn;
}

/* How the states go into another moment: a row for each. */
typedef struct {
    selfcal_wide_t of[SELFCAL_TERMS_MAX][SELFCAL_TERMS_MAX];
} matrix_t;

static void put_swing(matrix_t *matrix, size_t pair, swing_t swing) {
    matrix->of[pair - 1U][pair - 1U] = matrix->of[pair][pair] = swing.m;
    matrix->of[pair - 1U][pair] = swing.up;
    matrix->of[pair][pair - 1U] = swing.down;
}

/* Variance that an oscillation gains as it turns so, v the stationary one of each state. */
static selfcal_wide_t turned_var(swing_t swing, selfcal_wide_t v, bool first) {
    const selfcal_wide_t off = first ? swing.up : swing.down;
    return v * (1.0 - swing.m * swing.m - off * off);
}

static selfcal_wide_t turned_both(swing_t swing, selfcal_wide_t v) {
    return -v * swing.m * (swing.up + swing.down);
}

/* P goes to A P A'. */
static void transform(selfcal_wide_t p[SELFCAL_TERM_PAIRS], size_t order, const matrix_t *a) {
    selfcal_wide_t half[SELFCAL_TERMS_MAX][SELFCAL_TERMS_MAX] = {{0.0}};
    for (size_t i = 0; i < order; i++) {
        for (size_t j = 0; j < order; j++) {
            half[i][j] = 0.0;
            for (size_t k = 0; k < order; k++) {
                half[i][j] += a->of[i][k] * p[k >= j ? term_pair(k, j) : term_pair(j, k)];
            }
        }
    }
    for (size_t i = 0; i < order; i++) {
        for (size_t j = 0; j <= i; j++) {
            selfcal_wide_t sum = 0.0;
            for (size_t k = 0; k < order; k++) {
                sum += half[i][k] * a->of[j][k];
            }
            p[term_pair(i, j)] = sum;
        }
    }
}

/* Adds to P what the states gain as an oscillation turns. */
static void add_turned(selfcal_wide_t p[SELFCAL_TERM_PAIRS], size_t pair, swing_t swing, selfcal_wide_t v) {
    p[term_pair(pair - 1U, pair - 1U)] += turned_var(swing, v, true);
    p[term_pair(pair, pair)] += turned_var(swing, v, false);
    p[term_pair(pair, pair - 1U)] += turned_both(swing, v);
}

/* The mean of a block over that of a point, for its slow turn w: right to (w dt)^4. */
static selfcal_wide_t mean_of_swing(const selfcal_term_t *first, selfcal_wide_t dt_s, uint32_t block) {
    const selfcal_wide_t turn = (selfcal_wide_t)first->bandwidth * dt_s, m = (selfcal_wide_t)block;
    return 1.0 - turn * turn * (1.0 - 1.0 / (m * m)) / 24.0;
}

static void start_swing(const selfcal_model_t *model, selfcal_term_node_t *node, size_t a, const selfcal_term_t *first,
                        selfcal_wide_t variance) {
    const selfcal_wide_t dt_s = (selfcal_wide_t)model->dt_s, mean = mean_of_swing(first, dt_s, model->block);
    const swing_t swing = swing_of(first, dt_s);
    node->pair = (uint8_t)(a + 1U);
    node->beta[a] = (selfcal_real_t)(1.0 - swing.m);
    node->beta[a + 1U] = (selfcal_real_t)-swing.up;
    node->q[a] = (selfcal_real_t)(mean * mean * variance);
    node->q[a + 1U] = (selfcal_real_t)swing.down;
    node->p[term_pair(a, a)] = node->p[term_pair(a + 1U, a + 1U)] = (selfcal_wide_t)node->q[a];
}

static void start_node(selfcal_t *self, size_t j, selfcal_place_t place) {
    const selfcal_law_t *law = self->model->hypothesis[place.hypothesis].law;
    const selfcal_wide_t square = exp(2.0 * (selfcal_wide_t)place.ln_rho), second = exp((selfcal_wide_t)place.ln_alpha);
    const selfcal_wide_t dt_s = (selfcal_wide_t)self->model->dt_s;
    selfcal_term_node_t *node = &self->terms->node[term_of(self, j).index];
    memset(node, 0, sizeof *node);
    for (size_t a = 0; a < law->terms; a++) {
        const selfcal_term_t *term = &law->term[a];
        if (term->kind == SELFCAL_WALK) {
            const selfcal_wide_t deviation = (selfcal_wide_t)term->deviation;
            node->q[a] = (selfcal_real_t)(deviation * deviation * square);
            node->p[term_pair(a, a)] = deviation * deviation * square; /* x_0 = 0 */
        } else if (term->kind == SELFCAL_OSCILLATION && a + 1U < SELFCAL_TERMS_MAX) {
            start_swing(self->model, node, a, term, markov_variance(law, term, square, second, dt_s));
        } else if (term->kind == SELFCAL_MARKOV) {
            const selfcal_wide_t rate = bandwidth_of(term, second) * dt_s; /* of an interval */
            const selfcal_averaged_t of = selfcal_averaged((selfcal_real_t)rate, self->model->block);
            const selfcal_wide_t variance =
                (selfcal_wide_t)of.gain * markov_variance(law, term, square, second, dt_s); /* stationary */
            node->beta[a] = (selfcal_real_t)-expm1(-fmin(rate, SELFCAL_ALPHA_DT_MAX));
            const selfcal_wide_t beta = (selfcal_wide_t)node->beta[a];
            node->q[a] = (selfcal_real_t)(variance * beta * (2.0 - beta));
            node->p[term_pair(a, a)] = variance;
        }
    }
    if (law->coloured_noise) {
        const size_t last = law->terms;
        /* White noise that the drift leaves out is missing at all frequencies. */
        const selfcal_wide_t out = selfcal_white_left_out(law, second, dt_s, self->model->block) * square;
        const selfcal_wide_t per_ratio_sq =
            fmax((1.0 + out) / (second * second) - out, exp(-2.0 * (selfcal_wide_t)LN_RATIO_MAX));
        node->theta = (selfcal_real_t)tanh(-0.25 * log(per_ratio_sq)); /* (ratio - 1)/(ratio + 1) */
        node->beta[last] = R(1.0);
        node->p[term_pair(last, last)] = (selfcal_wide_t)node->theta * (selfcal_wide_t)node->theta * white_of(node);
    }
}

/* The gain side of a span. */
typedef struct {
    gains_t sums; /* of which inv_s and scale are used */
    selfcal_real_t kappa[SELFCAL_TERMS_MAX][SELFCAL_BATCH];
} term_gains_t;

/* One sample's, and P for the next one. */
typedef struct {
    selfcal_wide_t s, kappa[SELFCAL_TERMS_MAX];
} gain_t;

static gain_t gain_of(const selfcal_term_node_t *node, size_t order, selfcal_wide_t r) {
    const selfcal_wide_t white = r * white_of(node);
    gain_t gain;
    gain.s = white;
    for (size_t a = 0; a < order; a++) {
        gain.kappa[a] = 0.0;
        for (size_t b = 0; b < order; b++) {
            gain.kappa[a] += node->p[a >= b ? term_pair(a, b) : term_pair(b, a)];
        }
        gain.s += gain.kappa[a];
    }
    if (has_pair(node)) { /* m is the phi below */
        const swing_t turn = turn_of(node);
        selfcal_wide_t *x = &gain.kappa[node->pair - 1U];
        const selfcal_wide_t more[2] = {turn.up * x[1], turn.down * x[0]};
        for (size_t a = 0; a < 2U; a++) {
            x[a] += more[a] / turn.m;
        }
    }
    for (size_t a = 0; a < order; a++) {
        gain.kappa[a] =
            (phi_of(node, a) * gain.kappa[a] + (a + 1U == order ? (selfcal_wide_t)node->theta * white : 0.0)) / gain.s;
    }
    return gain;
}

static bool in_pair(const selfcal_term_node_t *node, size_t a) {
    return has_pair(node) && (a == node->pair || a + 1U == node->pair);
}

/* P of the next sample before its reading, less the noise of plain terms: the states go through an interval. */
static void carry(const selfcal_term_node_t *node, size_t order, selfcal_wide_t p[SELFCAL_TERM_PAIRS]) {
    matrix_t whole;
    memset(&whole, 0, sizeof whole);
    for (size_t a = 0; a < order; a++) {
        whole.of[a][a] = phi_of(node, a);
    }
    put_swing(&whole, node->pair, turn_of(node));
    memcpy(p, node->p, sizeof node->p);
    transform(p, order, &whole);
    add_turned(p, node->pair, turn_of(node), (selfcal_wide_t)node->q[node->pair - 1U]);
}

/* Whether P has come to rest. */
static bool step(selfcal_term_node_t *node, size_t order, selfcal_wide_t r, const gain_t *gain) {
    const selfcal_wide_t theta = (selfcal_wide_t)node->theta;
    bool rests = true;
    selfcal_wide_t carried[SELFCAL_TERM_PAIRS] = {0.0};
    if (has_pair(node)) {
        carry(node, order, carried);
    }
    for (size_t a = 0; a < order; a++) {
        for (size_t b = 0; b <= a; b++) {
            selfcal_wide_t *p = &node->p[term_pair(a, b)];
            const selfcal_wide_t before = *p;
            *p = (has_pair(node) ? carried[term_pair(a, b)] : phi_of(node, a) * phi_of(node, b) * before) -
                 gain->kappa[a] * gain->kappa[b] * gain->s;
            if (a == b) {
                *p += (in_pair(node, a) ? 0.0 : (selfcal_wide_t)node->q[a]) +
                      (a + 1U == order ? theta * theta * r * white_of(node) : 0.0);
                *p = fmax(*p, 0.0); /* a moving average's, once its e_(i-1) is known */
                /* a moving average's is what is left of two numbers of the size of the last term */
                const selfcal_wide_t rounding = a + 1U == order ? 1e-15 * theta * theta * white_of(node) : 0.0;
                rests = rests && fabs(*p - before) <= CONVERGED * before + rounding;
            }
        }
    }
    return rests;
}

/* The constant s of a converged node goes into D with the count of its samples. */
static void settle(selfcal_node_t *node, const selfcal_term_node_t *term, size_t order) {
    if (term->steady) {
        const selfcal_sum_t ln_s = make_sum((selfcal_wide_t)node->steady * log(gain_of(term, order, 1.0).s));
        sum_add(&node->ln_s, ln_s.hi, ln_s.lo);
        node->steady = 0;
    }
}

static void settle_node(selfcal_t *self, size_t j) {
    const term_t term = term_of(self, j);
    settle(&self->node[j], &self->terms->node[term.index], term.order);
}

static void fade_states(selfcal_t *self, size_t j, selfcal_wide_t keep_b, selfcal_wide_t keep_c) {
    for (size_t axis = 0; SELFCAL_STATE_SUMS > 0U && axis < self->model->axes; axis++) {
        const reading_sums_t sums = selfcal_kernel_state_sums(self, j, term_of(self, j).index, axis);
        sum_fade(sums.b, keep_b);
        sum_fade(sums.c, keep_c);
    }
}

static void restart_states(selfcal_t *self, size_t j, const selfcal_wide_t c[], selfcal_wide_t keep) {
    const size_t index = term_of(self, j).index;
    settle_node(self, j);
    const selfcal_sum_t ln_s = make_sum(keep * sum_value(self->node[j].ln_s));
    selfcal_bank_start_node(self, (uint16_t)j);
    self->node[j].ln_s = ln_s;
    memset(states(self, index, 0), 0, series_of(self) * SELFCAL_TERMS_MAX * sizeof(selfcal_sum_t));
    for (size_t axis = 0; axis < self->model->axes; axis++) {
        const reading_sums_t sums = selfcal_kernel_state_sums(self, j, index, axis);
        *sums.b = make_sum(0.0);
        *sums.c = make_sum(c[axis]);
    }
}

static void state_gains_steady(const selfcal_term_node_t *term, size_t order, term_gains_t *gains) {
    const gain_t gain = gain_of(term, order, 1.0);
    gains->sums.scale = make_sum(1.0 / gain.s);
    for (uint32_t i = gains->sums.span.from; i < gains->sums.span.to; i++) {
        gains->sums.inv_s[i] = R(1.0);
        for (size_t a = 0; a < order; a++) {
            gains->kappa[a][i] = (selfcal_real_t)gain.kappa[a];
        }
    }
}

/* What the rounding of 1/s loses on the mean of the span goes into the scale, as in bank.c. */
static void state_gains_varying(const selfcal_batch_t *batch, selfcal_node_t *node, selfcal_term_node_t *term,
                                size_t order, uint32_t block, term_gains_t *gains) {
    const span_t span = gains->sums.span;
    selfcal_wide_t product = 1.0, ln_s = 0.0, short_of = 0.0;
    selfcal_real_t lost = R(0.0);
    bool rests = false;
    for (size_t a = 0; a < order && batch->part; a++) {
        lost += in_pair(term, a) ? R(0.0) : selfcal_averaged_lost(term->q[a], term->beta[a], block);
    }
    for (uint32_t i = span.from; i < span.to; i++) {
        const selfcal_wide_t r = (selfcal_wide_t)averaged_noise(batch->r[i], lost);
        const gain_t gain = gain_of(term, order, r);
        const selfcal_real_t inv_s = (selfcal_real_t)(1.0 / gain.s);
        gains->sums.inv_s[i] = inv_s;
        short_of += 1.0 - (selfcal_wide_t)inv_s * gain.s;
        for (size_t a = 0; a < order; a++) {
            gains->kappa[a][i] = (selfcal_real_t)gain.kappa[a];
        }
        product *= gain.s;
        if (product > PRODUCT_MAX || product < 1.0 / PRODUCT_MAX) {
            ln_s += log(product);
            product = 1.0;
        }
        rests = step(term, order, r, &gain) && r == 1.0;
    }
    const selfcal_sum_t more = make_sum(ln_s + log(product));
    sum_add(&node->ln_s, more.hi, more.lo);
    gains->sums.scale.hi = R(1.0);
    gains->sums.scale.lo = (selfcal_real_t)(short_of / (selfcal_wide_t)(span.to - span.from));
    term->steady = rests;
}

/* --- filter --- */

/* One series, `y` [SELFCAL_BATCH] or all 1 if NULL, through a span; `x` are its states. Sums are taken to twice the
 * digits. */
static void filter_states(const selfcal_term_node_t *term, size_t order, const term_gains_t *gains,
                          const selfcal_real_t *y, selfcal_sum_t x[], innovations_t *out) {
    const uint32_t from = gains->sums.span.from, count = gains->sums.span.to - from;
    for (uint32_t i = 0; i < count; i++) {
        selfcal_sum_t rest = {y != NULL ? y[from + i] : R(1.0), R(0.0)};
        for (size_t a = 0; a < order; a++) {
            const selfcal_sum_t less = two_sum(rest.hi, -x[a].hi);
            rest.hi = less.hi;
            rest.lo += less.lo - x[a].lo;
        }
        const selfcal_real_t nu = rest.hi + rest.lo, inv_s = gains->sums.inv_s[from + i];
        out->nu[i] = nu;
        out->weighted[i] = nu * inv_s;
        out->low[i] = r_fma_exact(nu, inv_s, -out->weighted[i]);
        selfcal_real_t turned[2] = {R(0.0), R(0.0)};
        if (has_pair(term)) {
            const selfcal_sum_t *first = &x[term->pair - 1U], *second = &x[term->pair];
            turned[0] = -term->beta[term->pair] * (second->hi + second->lo);
            turned[1] = term->q[term->pair] * (first->hi + first->lo);
        }
        for (size_t a = 0; a < order; a++) {
            const selfcal_real_t beta = beta_of(term, a);
            selfcal_real_t change = r_fma_exact(gains->kappa[a][from + i], nu, -beta * x[a].hi);
            change += in_pair(term, a) ? turned[a + 1U - term->pair] : R(0.0);
            x[a] = two_sum(x[a].hi, change + (R(1.0) - beta) * x[a].lo);
        }
    }
}

static void run_states(selfcal_t *self, size_t j, const span_t *span) {
    const selfcal_batch_t *batch = waiting(self);
    const term_t at_node = term_of(self, j);
    const size_t p = regressors_of(self->model), axes = self->model->axes, order = at_node.order;
    selfcal_node_t *node = &self->node[j];
    selfcal_term_node_t *term = &self->terms->node[at_node.index];
    bool whole = true;
    for (uint32_t i = span->from; i < span->to && batch->part; i++) {
        whole = whole && batch->r[i] == R(1.0);
    }
    term_gains_t gains;
    gains.sums.span = *span;
    if (whole && term->steady) {
        state_gains_steady(term, order, &gains);
        node->steady += span->to - span->from;
    } else {
        settle(node, term, order);
        state_gains_varying(batch, node, term, order, self->model->block, &gains);
    }
    innovations_t column[1 + SELFCAL_REGRESSORS_MAX], reading;
    selfcal_sum_t *a = p > 0U ? &self->columns->a[j * SELFCAL_REGRESSORS_ROWS(p + 1U)] : NULL;
    for (size_t k = 0; k <= p; k++) {
        const selfcal_real_t *y = k == 0U ? NULL : self->columns->column[k - 1U].z[1U - self->gathering];
        filter_states(term, order, &gains, y, states(self, at_node.index, k), &column[k]);
        for (size_t l = 0; p > 0U && l <= k; l++) {
            selfcal_add_products(a++, &gains.sums, &column[l], &column[k]);
        }
    }
    selfcal_add_products(&node->a, &gains.sums, &column[0], &column[0]);
    for (size_t axis = 0; axis < axes; axis++) {
        const reading_sums_t sums = selfcal_kernel_state_sums(self, j, at_node.index, axis);
        filter_states(term, order, &gains, batch->y[axis], states(self, at_node.index, 1U + p + axis), &reading);
        selfcal_add_products(sums.c, &gains.sums, &reading, &reading);
        selfcal_add_products(sums.b, &gains.sums, &column[0], &reading);
        for (size_t k = 0; k < p; k++) {
            selfcal_add_products(&self->columns->b[(j * axes + axis) * p + k], &gains.sums, &column[k + 1U], &reading);
        }
    }
}

static swing_t power(swing_t swing, uint32_t count) {
    swing_t all = {1.0, 0.0, 0.0};
    for (; count != 0U; count >>= 1U) {
        all = (count & 1U) != 0U ? after(all, swing) : all;
        swing = after(swing, swing);
    }
    return all;
}

static void run_states_gap(selfcal_t *self, size_t j, uint32_t count) {
    const term_t at_node = term_of(self, j);
    const size_t order = at_node.order;
    const selfcal_wide_t intervals = (selfcal_wide_t)count;
    selfcal_term_node_t *term = &self->terms->node[at_node.index];
    settle(&self->node[j], term, order);
    term->steady = false;
    selfcal_wide_t less[SELFCAL_TERMS_MAX] = {0.0}; /* 1 - phi^count */
    for (size_t a = 0; a < order; a++) {
        less[a] = term->beta[a] < R(1.0) ? -expm1(intervals * log1p(-(selfcal_wide_t)term->beta[a])) : 1.0;
    }
    matrix_t whole;
    memset(&whole, 0, sizeof whole);
    for (size_t a = 0; a < order; a++) {
        whole.of[a][a] = 1.0 - less[a];
    }
    if (has_pair(term)) {
        put_swing(&whole, term->pair, power(turn_of(term), count));
    }
    transform(term->p, order, &whole);
    if (has_pair(term)) {
        add_turned(term->p, term->pair, power(turn_of(term), count), (selfcal_wide_t)term->q[term->pair - 1U]);
    }
    for (size_t a = 0; a < order; a++) {
        const selfcal_wide_t beta = (selfcal_wide_t)term->beta[a], q = (selfcal_wide_t)term->q[a],
                             theta = (selfcal_wide_t)term->theta;
        if (!in_pair(term, a)) {
            term->p[term_pair(a, a)] +=
                beta > 0.0 ? q / (beta * (2.0 - beta)) * less[a] * (2.0 - less[a]) : intervals * q;
        }
        term->p[term_pair(a, a)] += a + 1U == order ? theta * theta * white_of(term) : 0.0;
    }
    for (size_t series = 0; series < series_of(self); series++) {
        selfcal_sum_t *x = states(self, at_node.index, series);
        selfcal_wide_t before[SELFCAL_TERMS_MAX];
        for (size_t a = 0; a < order; a++) {
            before[a] = sum_value(x[a]);
        }
        for (size_t a = 0; a < order; a++) {
            selfcal_wide_t now = 0.0;
            for (size_t b = 0; b < order; b++) {
                now += whole.of[a][b] * before[b];
            }
            x[a] = make_sum(now);
        }
    }
}

/* --- views --- */

/* The terms now, from the filter's prediction for the next interval: over that, and covariance beside it. */
typedef struct {
    matrix_t per_prediction;
    selfcal_wide_t after[SELFCAL_TERM_PAIRS];
} terms_now_t;

/* The end of a block is so much later than its middle, over its interval, whose prediction is for the next middle. */
static void swing_now(const selfcal_model_t *model, const selfcal_term_t *first, size_t a, selfcal_wide_t variance,
                      terms_now_t *now) {
    const selfcal_wide_t dt_s = (selfcal_wide_t)model->dt_s, mean = mean_of_swing(first, dt_s, model->block);
    const selfcal_wide_t late_s = 0.5 * dt_s * (1.0 - 1.0 / (selfcal_wide_t)model->block);
    const swing_t back = swing_of(first, late_s - dt_s);
    const swing_t of_point = {back.m / mean, back.up / mean, back.down / mean};
    put_swing(&now->per_prediction, a + 1U, of_point);
    add_turned(now->after, a + 1U, swing_of(first, late_s), variance);
}

/* The filter holds predictions, phi times the states now; a state of phi 0 is noise, no drift. */
static void terms_now(const selfcal_t *self, size_t j, terms_now_t *now) {
    const selfcal_place_t place = selfcal_bank_place(self, (uint16_t)j);
    const selfcal_law_t *law = self->model->hypothesis[place.hypothesis].law;
    const selfcal_term_node_t *node = &self->terms->node[term_of(self, j).index];
    const selfcal_wide_t dt_s = (selfcal_wide_t)self->model->dt_s, second = exp((selfcal_wide_t)place.ln_alpha);
    const selfcal_wide_t square = exp(2.0 * (selfcal_wide_t)place.ln_rho);
    const uint32_t block = self->model->block;
    memset(now, 0, sizeof *now);
    for (size_t a = 0; a < terms_of(law); a++) {
        const selfcal_term_t *term = &law->term[a];
        if (term->kind == SELFCAL_WALK) {
            now->per_prediction.of[a][a] = 1.0;
            now->after[term_pair(a, a)] = (selfcal_wide_t)(node->q[a] * averaged_walk_after(block));
        } else if (term->kind == SELFCAL_OSCILLATION && a + 1U < SELFCAL_TERMS_MAX) {
            swing_now(self->model, term, a, markov_variance(law, term, square, second, dt_s), now);
        } else if (term->kind == SELFCAL_MARKOV) {
            const selfcal_averaged_t of = selfcal_averaged((selfcal_real_t)(bandwidth_of(term, second) * dt_s), block);
            now->per_prediction.of[a][a] = (selfcal_wide_t)of.now / phi_of(node, a);
            now->after[term_pair(a, a)] = markov_variance(law, term, square, second, dt_s) * (selfcal_wide_t)of.after;
        }
    }
}

static void drift_of(const selfcal_t *self, size_t j, size_t series, selfcal_wide_t drift[SELFCAL_TERMS_MAX]) {
    const size_t index = term_of(self, j).index;
    terms_now_t now;
    terms_now(self, j, &now);
    for (size_t a = 0; a < SELFCAL_TERMS_MAX; a++) {
        drift[a] = 0.0;
        for (size_t b = 0; b < SELFCAL_TERMS_MAX; b++) {
            drift[a] += now.per_prediction.of[a][b] * sum_value(states(self, index, series)[b]);
        }
    }
}

static void spread_of(const selfcal_t *self, size_t j, selfcal_wide_t spread[SELFCAL_TERM_PAIRS]) {
    const term_t at_node = term_of(self, j);
    const selfcal_term_node_t *term = &self->terms->node[at_node.index];
    terms_now_t now;
    terms_now(self, j, &now);
    /* P' = phi P(now) phi + Q */
    memcpy(spread, term->p, sizeof term->p);
    for (size_t a = 0; a < SELFCAL_TERMS_MAX; a++) {
        spread[term_pair(a, a)] -= in_pair(term, a) ? 0.0 : (selfcal_wide_t)term->q[a];
    }
    if (has_pair(term)) {
        add_turned(spread, term->pair, turn_of(term), -(selfcal_wide_t)term->q[term->pair - 1U]);
    }
    transform(spread, SELFCAL_TERMS_MAX, &now.per_prediction);
    for (size_t k = 0; k < SELFCAL_TERM_PAIRS; k++) {
        spread[k] += now.after[k];
    }
}

static void view_states(const selfcal_t *self, uint8_t axis, uint16_t index, selfcal_node_view_t *view) {
    const term_t at_node = term_of(self, index);
    const selfcal_node_t *node = &self->node[index];
    const selfcal_term_node_t *term = &self->terms->node[at_node.index];
    const reading_sums_t sums = selfcal_kernel_state_sums(self, index, at_node.index, axis);
    view->a = sum_value(node->a);
    view->b = sum_value(*sums.b);
    view->c = sum_value(*sums.c);
    view->ln_s = sum_value(node->ln_s);
    if (term->steady) {
        view->ln_s += (selfcal_wide_t)node->steady * log(gain_of(term, at_node.order, 1.0).s);
    }
    selfcal_wide_t of_one[SELFCAL_TERMS_MAX], of_reading[SELFCAL_TERMS_MAX];
    drift_of(self, index, 0, of_one);
    drift_of(self, index, series_of_readings(self, axis), of_reading);
    view->drift = 0.0;
    view->bias_left = 1.0;
    view->drift_var = 0.0;
    selfcal_wide_t spread[SELFCAL_TERM_PAIRS];
    spread_of(self, index, spread);
    for (size_t a = 0; a < SELFCAL_TERMS_MAX; a++) {
        view->drift += of_reading[a];
        view->bias_left -= of_one[a];
        for (size_t b = 0; b <= a; b++) {
            view->drift_var += (a == b ? 1.0 : 2.0) * spread[term_pair(a, b)];
        }
    }
    /* after the longest gap it is what is left of numbers 10^16 times as large */
    view->drift_var = fmax(view->drift_var, 0.0);
}

static bool states_sound(const selfcal_t *self) {
    const size_t nodes = sum_nodes(self->model);
    const selfcal_terms_t *terms = self->terms;
    const size_t values = nodes * series_of(self) * SELFCAL_TERMS_MAX;
    const uintptr_t after = ((uintptr_t)(terms + 1) + 7U) & ~(uintptr_t)7U;
    if ((uintptr_t)terms->node != after || terms->x != (const void *)(terms->node + nodes)) {
        return false;
    }
    for (size_t k = 0; k < values; k++) {
        if (!finite_sum(terms->x[k])) {
            return false;
        }
    }
    if (terms->bc != terms->x + values) {
        return false;
    }
    const size_t sums = nodes * self->model->axes * SELFCAL_STATE_SUMS;
    for (size_t k = 0; k < sums; k++) {
        if (!finite_sum(terms->bc[k]) || (k % 2U == 1U && !(terms->bc[k].hi >= R(0.0)))) {
            return false;
        }
    }
    for (size_t k = 0; k < nodes; k++) {
        const selfcal_term_node_t *node = &terms->node[k];
        if (!is_bool(&node->steady) || node->pair >= SELFCAL_TERMS_MAX || !(node->theta > R(-1.0)) ||
            !(node->theta < R(1.0))) {
            return false;
        }
        for (size_t a = 0; a < SELFCAL_TERMS_MAX; a++) {
            if (!(node->beta[a] >= R(0.0)) || !(node->beta[a] <= R(1.0)) || !(node->q[a] >= R(0.0)) ||
                !isfinite(node->q[a]) || !(node->p[term_pair(a, a)] >= 0.0)) {
                return false;
            }
        }
        for (size_t a = 0; a < SELFCAL_TERM_PAIRS; a++) {
            if (!isfinite(node->p[a])) {
                return false;
            }
        }
    }
    return true;
}

/* --- laws --- */

#define TWO_PI 6.283185307179586

/* Room for the rounding of a stated number to float. */
#define MORE (1.0 + 1e-6)
#define LESS (1.0 - 1e-6)

static bool valid_factor(float factor) {
    return factor >= (float)(1.0 / SELFCAL_FACTOR_MAX) && factor <= (float)SELFCAL_FACTOR_MAX;
}

/* Of a stated bandwidth: 1 - phi keeps its digits. */
static bool valid_time(const selfcal_term_t *term, float dt_s, selfcal_wide_t most) {
    const selfcal_wide_t interval = (selfcal_wide_t)term->bandwidth * (selfcal_wide_t)dt_s;
    return interval <= most * MORE && interval * SELFCAL_TIME_MAX >= LESS;
}

/* The two terms of an oscillation. */
static bool valid_swing(const selfcal_term_t *term, size_t count, float dt_s) {
    const selfcal_term_t *second = &term[1];
    if (count < 2U || second->kind != SELFCAL_DAMPING || second->deviation != term->deviation ||
        second->by_ratio != term->by_ratio || !term->stated || !second->stated) {
        return false;
    }
    const selfcal_wide_t damping = (selfcal_wide_t)second->bandwidth / (selfcal_wide_t)term->bandwidth;
    return valid_time(term, dt_s, TWO_PI / SELFCAL_PERIOD_MIN) && damping >= SELFCAL_DAMPING_MIN * LESS &&
           damping <= SELFCAL_DAMPING_MAX * MORE;
}

static bool valid_term(const selfcal_term_t *term, float dt_s) {
    const bool swing = term->kind == SELFCAL_OSCILLATION || term->kind == SELFCAL_DAMPING;
    const bool sound = term->stated ? valid_time(term, dt_s, SELFCAL_ALPHA_DT_MAX) : valid_factor(term->bandwidth);
    const bool walk = term->kind == SELFCAL_WALK && term->bandwidth == 0.0F && !term->stated && !term->by_ratio;
    return is_bool(&term->stated) && is_bool(&term->by_ratio) && valid_factor(term->deviation) &&
           (walk || swing || (term->kind == SELFCAL_MARKOV && sound));
}

/* A sum that there are filters for. A ratio belongs to one thing: to the noise, or to terms beside another. */
static bool valid_sum(const selfcal_law_t *law, float dt_s) {
    unsigned by_ratio = 0;
    for (uint8_t a = 0; a < law->terms; a++) {
        const selfcal_term_t *term = &law->term[a];
        const size_t left = (size_t)law->terms - a;
        if (!valid_term(term, dt_s) || (term->kind == SELFCAL_OSCILLATION && !valid_swing(term, left, dt_s)) ||
            (term->kind == SELFCAL_DAMPING && (a == 0U || term[-1].kind != SELFCAL_OSCILLATION))) {
            return false;
        }
        by_ratio += law->term[a].by_ratio ? 1U : 0U;
    }
    return law->terms > 0U && law->terms + (law->coloured_noise ? 1U : 0U) <= SELFCAL_TERMS_MAX &&
           !(has_ratio(law) && has_alpha(law)) && (by_ratio == 0U || (by_ratio < law->terms && !law->coloured_noise));
}

static void fall_of(const selfcal_term_t *first, selfcal_real_t elapsed_s, selfcal_real_t psi[2]) {
    const swing_t swing = swing_of(first, (selfcal_wide_t)elapsed_s);
    psi[0] = (selfcal_real_t)(1.0 - swing.m - swing.down);
    psi[1] = (selfcal_real_t)(1.0 - swing.m - swing.up);
}

/* Float kernels have the sums B and C among those of the bank. */
static void hold_states(selfcal_t *held, const selfcal_t *self, uint8_t axis) {
    const size_t nodes = sum_nodes(self->model), shared = 1U + regressors_of(self->model);
    const selfcal_terms_t *from = self->terms, *to = held->terms;
    memcpy(to->node, from->node, nodes * sizeof to->node[0]);
    for (size_t index = 0; index < nodes; index++) {
        const size_t bc = SELFCAL_STATE_SUMS * sizeof to->bc[0], one = SELFCAL_TERMS_MAX * sizeof to->x[0];
        memcpy(states(held, index, 0), states(self, index, 0), shared * one);
        memcpy(states(held, index, shared), states(self, index, series_of_readings(self, axis)), one);
        memcpy((unsigned char *)to->bc + index * bc, (const unsigned char *)from->bc + cell_of(self, index, axis) * bc,
               bc);
    }
}

const selfcal_states_code_t selfcal_states_code = {
    valid_sum,   init_states,    states_sound, start_node, run_states, run_states_gap, settle_node,
    fade_states, restart_states, view_states,  spread_of,  drift_of,   fall_of,        hold_states,
};
