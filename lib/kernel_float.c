/* The kernel in selfcal_real_t: every axis of one node through a span. Sums of a span are short enough for selfcal_real_t; they
 * go into the long ones scaled in full. */
#include "kernel.h"

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

/* Nearly all samples of a long record go through here: five arithmetic instructions an axis and sample. By fours, which also
 * keeps the sums short: squares of lattice values would round to one side (1e-7 of C, seen with 64 in a row). */
static inline void run_level(selfcal_t *self, span_t span, size_t j) {
    const selfcal_node_t *node = &self->node[j];
    const selfcal_batch_t *batch = waiting(self);
    const selfcal_real_t u = node->u_inf;
    const selfcal_sum_t inv_s = steady_inv_s(node);
    const selfcal_real_t product = inv_s.hi * u;
    const selfcal_sum_t u_inv_s = {product, r_fma_exact(inv_s.lo, u, r_fma_exact(inv_s.hi, u, -product))};
    const selfcal_real_t minus_beta = -node->beta;
    const selfcal_real_t g = steady_g(node);
    const size_t count = span.to - span.from;
    const size_t axes = self->model->axes;
    for (size_t axis = 0; axis < axes; axis++) {
        const size_t k = j * axes + axis;
        const selfcal_real_t *y = &batch->y[axis][span.from];
        const selfcal_real_t *const end = y + count, *const fours = y + count / 4U * 4U;
        selfcal_real_t x = self->x[k], b = R(0.0), c = R(0.0);
        for (; y < fours; y += 4) {
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
        sum_add_scaled(&self->b[k], u_inv_s, b);
        sum_add_scaled(&self->c[k], inv_s, c);
    }
}

void selfcal_kernel_level(selfcal_t *self, span_t span, size_t from, size_t to) {
    for (size_t j = from; j < to; j++) {
        if (self->node[j].level) {
            run_level(self, span, j);
        }
    }
}

void selfcal_kernel_gap(selfcal_t *self, size_t j, selfcal_wide_t less) {
    const size_t axes = self->model->axes;
    for (size_t k = j * axes; k < (j + 1U) * axes; k++) {
        self->x[k] = (selfcal_real_t)((selfcal_wide_t)self->x[k] * (1.0 - less));
    }
}

void selfcal_kernel_view(const selfcal_t *self, size_t k, selfcal_wide_t *b, selfcal_wide_t *c, selfcal_wide_t *x) {
    *b = sum_value(self->b[k]);
    *c = sum_value(self->c[k]);
    *x = (selfcal_wide_t)self->x[k];
}

#endif
