/* The kernel in selfcal_real_t: every axis of one node through a span. Sums of a span are short enough for
 * selfcal_real_t; they go into the long ones scaled in full. */
#include "bank_inside.h"

#ifndef SELFCAL_FIXED

void selfcal_kernel_run(selfcal_t *self, size_t j, const gains_t *gains) {
    const span_t span = gains->span;
    const selfcal_batch_t *batch = waiting(self);
    const selfcal_real_t minus_beta = -self->node[j].beta;
    const size_t axes = self->model->axes;
    for (size_t axis = 0; axis < axes; axis++) {
        const size_t k = j * axes + axis;
        selfcal_real_t x = self->x[k], b = R(0.0), c = R(0.0);
        for (uint32_t i = span.from; i < span.to; i++) {
            const selfcal_real_t y = batch->y[axis][i];
            const selfcal_real_t nu = y - x;
            b = r_fma(gains->u[i], nu, b);
            c = r_fma(nu, nu * gains->inv_s[i], c);
            x = r_fma(minus_beta, y, r_fma(gains->g[i], nu, x));
        }
        self->x[k] = x;
        sum_add_scaled(&self->b[k], gains->scale, b);
        sum_add_scaled(&self->c[k], gains->scale, c);
    }
}

/* A level node's sums are held as plain sums of nu and nu^2: B over u/s, C over 1/s. Where u is 0 its B stays as it
 * is. */
static selfcal_sum_t times(selfcal_sum_t sum, selfcal_sum_t factor) {
    selfcal_sum_t product = {R(0.0), R(0.0)};
    sum_add_scaled(&product, factor, sum.hi);
    sum_add(&product, factor.hi * sum.lo, R(0.0));
    return product;
}

static void rescale_node(selfcal_t *self, size_t j, bool level) {
    const selfcal_node_t *node = &self->node[j];
    const selfcal_wide_t s = 1.0 + (selfcal_wide_t)node->p_inf, u = (selfcal_wide_t)node->u_inf;
    const selfcal_sum_t of_c = make_sum(level ? s : 1.0 / s);
    const selfcal_sum_t of_b = make_sum(u > 0.0 ? level ? s / u : u / s : 1.0);
    const size_t axes = self->model->axes;
    for (size_t k = j * axes; k < (j + 1U) * axes; k++) {
        self->c[k] = times(self->c[k], of_c);
        self->b[k] = times(self->b[k], of_b);
    }
}

void selfcal_kernel_settle(selfcal_t *self, size_t j) {
    rescale_node(self, j, true);
}

void selfcal_kernel_unsettle(selfcal_t *self, size_t j) {
    rescale_node(self, j, false);
}

/* Four samples: x goes on, sums of nu and nu^2 are added. By fours, which keeps the sums short: squares of lattice
 * values would round to one side (1e-7 of C, seen with 64 in a row). */
typedef struct {
    selfcal_real_t x, b, c;
} track_t;

static inline track_t run_four(track_t t, const selfcal_real_t y[4], selfcal_real_t g, selfcal_real_t minus_beta) {
    const selfcal_real_t y0 = y[0], y1 = y[1], y2 = y[2], y3 = y[3];
    const selfcal_real_t nu0 = y0 - t.x;
    t.x = r_fma(minus_beta, y0, r_fma(g, nu0, t.x));
    const selfcal_real_t nu1 = y1 - t.x;
    t.x = r_fma(minus_beta, y1, r_fma(g, nu1, t.x));
    const selfcal_real_t nu2 = y2 - t.x;
    t.x = r_fma(minus_beta, y2, r_fma(g, nu2, t.x));
    const selfcal_real_t nu3 = y3 - t.x;
    t.x = r_fma(minus_beta, y3, r_fma(g, nu3, t.x));
    t.b += (nu0 + nu1) + (nu2 + nu3);
    t.c += r_fma(nu3, nu3, r_fma(nu2, nu2, r_fma(nu1, nu1, nu0 * nu0)));
    return t;
}

/* Nearly all samples of a long record go through here: five arithmetic instructions an axis and sample. */
static void run_level_node(selfcal_t *self, span_t span, size_t j) {
    const selfcal_batch_t *batch = waiting(self);
    const selfcal_node_t *node = &self->node[j];
    const selfcal_real_t minus_beta = -node->beta;
    const selfcal_real_t g = steady_g(node);
    const size_t count = span.to - span.from;
    const size_t axes = self->model->axes;
    for (size_t axis = 0; axis < axes; axis++) {
        const size_t k = j * axes + axis;
        const selfcal_real_t *y = &batch->y[axis][span.from];
        const selfcal_real_t *const end = y + count;
        track_t t = {self->x[k], R(0.0), R(0.0)};
        for (; end - y >= 16; y += 16) {
            t = run_four(t, y, g, minus_beta);
            t = run_four(t, y + 4, g, minus_beta);
            t = run_four(t, y + 8, g, minus_beta);
            t = run_four(t, y + 12, g, minus_beta);
        }
        for (; end - y >= 4; y += 4) {
            t = run_four(t, y, g, minus_beta);
        }
        for (; y < end; y++) {
            const selfcal_real_t nu = *y - t.x;
            t.b += nu;
            t.c = r_fma(nu, nu, t.c);
            t.x = r_fma(minus_beta, *y, r_fma(g, nu, t.x));
        }
        self->x[k] = t.x;
        if (node->u_inf > R(0.0)) {
            sum_add_value(&self->b[k], t.b);
        }
        sum_add_value(&self->c[k], t.c);
    }
}

void selfcal_kernel_level(selfcal_t *self, span_t span, size_t from, size_t to) {
    for (size_t j = from; j < to; j++) {
        if (self->node[j].level) {
            run_level_node(self, span, j);
        }
    }
}

void selfcal_kernel_gap(selfcal_t *self, size_t j, selfcal_wide_t less) {
    const size_t axes = self->model->axes;
    for (size_t k = j * axes; k < (j + 1U) * axes; k++) {
        self->x[k] = (selfcal_real_t)((selfcal_wide_t)self->x[k] * (1.0 - less));
    }
}

void selfcal_kernel_fade(selfcal_t *self, size_t j, selfcal_wide_t keep_b, selfcal_wide_t keep_c) {
    const size_t axes = self->model->axes;
    for (size_t k = j * axes; k < (j + 1U) * axes; k++) {
        sum_fade(&self->b[k], keep_b);
        sum_fade(&self->c[k], keep_c);
    }
}

void selfcal_kernel_restart(selfcal_t *self, size_t k, selfcal_wide_t c) {
    self->x[k] = R(0.0);
    self->b[k] = make_sum(0.0);
    self->c[k] = make_sum(c);
}

void selfcal_kernel_view(const selfcal_t *self, size_t j, uint8_t axis, selfcal_wide_t *b, selfcal_wide_t *c,
                         selfcal_wide_t *x) {
    const selfcal_node_t *node = &self->node[j];
    const size_t k = cell_of(self, j, axis);
    selfcal_sum_t of_b = self->b[k], of_c = self->c[k];
    if (node->level) {
        const selfcal_sum_t per_s = one_over_1_and(node->p_inf), u = {node->u_inf, R(0.0)};
        of_c = two_product(of_c, per_s);
        of_b = u.hi > R(0.0) ? two_product(of_b, two_product(u, per_s)) : of_b;
    }
    *b = sum_value(of_b);
    *c = sum_value(of_c);
    *x = (selfcal_wide_t)self->x[k];
}

reading_sums_t selfcal_kernel_reading(const selfcal_t *self, size_t at) {
    const reading_sums_t sums = {&self->b[at], &self->c[at]};
    return sums;
}

selfcal_sum_t selfcal_kernel_reading_drift(const selfcal_t *self, size_t at) {
    const selfcal_sum_t x = {self->x[at], self->columns->reading[at].low};
    return x;
}

void selfcal_kernel_set_reading_drift(selfcal_t *self, size_t at, selfcal_sum_t x) {
    self->x[at] = x.hi;
    self->columns->reading[at].low = x.lo;
}

bool selfcal_kernel_readings_sound(const selfcal_t *self) {
    const size_t cells = (size_t)self->model->nodes * self->model->axes;
    for (size_t k = 0; k < cells; k++) {
        if (!isfinite(self->columns->reading[k].low)) {
            return false;
        }
    }
    return true;
}

reading_sums_t selfcal_kernel_state_sums(const selfcal_t *self, size_t j, size_t index, size_t axis) {
    (void)index;
    return selfcal_kernel_reading(self, cell_of(self, j, axis));
}

void selfcal_kernel_start(selfcal_t *self, uint8_t axis, selfcal_real_t ln_sigma) {
    (void)self;
    (void)axis;
    (void)ln_sigma;
}

void selfcal_kernel_load(selfcal_t *self) {
    (void)self;
}

bool selfcal_kernel_sound(const selfcal_t *self) {
    (void)self;
    return true;
}

bool selfcal_kernel_node_sound(const selfcal_t *self, size_t j) {
    const size_t axes = self->model->axes;
    for (size_t k = j * axes; k < (j + 1U) * axes; k++) {
        if (!finite_sum(self->b[k]) || !finite_sum(self->c[k]) || !(self->c[k].hi >= R(0.0)) || !isfinite(self->x[k])) {
            return false;
        }
    }
    return true;
}

#else
typedef int selfcal_no_float_kernel_t; /* C99 wants a declaration in every file */
#endif
