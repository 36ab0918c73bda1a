/* The seam between what all axes share (bank.c: variances, gains, sums A and D) and the work of each axis (a kernel: drift x,
 * sums B and C). Not for users. */
#ifndef SELFCAL_KERNEL_H
#define SELFCAL_KERNEL_H

#include "internal.h"

/* Part of the batch without a gap inside. */
typedef struct span {
    uint32_t from, to;
} span_t;

/* The gain side of a batch, shared by the axes. */
struct gains {
    span_t span;
    selfcal_real_t g[SELFCAL_BATCH];     /* phi K + beta */
    selfcal_real_t u[SELFCAL_BATCH];     /* innovation of "1" over s */
    selfcal_real_t inv_s[SELFCAL_BATCH]; /* 1 where s is constant and left to the scales */
    selfcal_sum_t scale;                 /* what the span's sums of nu and nu^2 are still to be multiplied by */
};

/* The order in which a kernel takes the nodes: this is the index of the `i`-th. */
#ifdef SELFCAL_FIXED
size_t kernel_node(const selfcal_t *self, size_t i);
#else
static inline size_t kernel_node(const selfcal_t *self, size_t i) {
    (void)self;
    return i;
}
#endif

/* The batch that the nodes run over. */
static inline selfcal_batch_t *waiting(selfcal_t *self) {
    return &self->batch[1U - self->gathering];
}

/* Every axis of node `j` through the span. */
void selfcal_kernel_run(selfcal_t *self, size_t j, const gains_t *gains);

/* The same for the level ones of the nodes `from` to `to` - 1 in the kernel's order: g, u and 1/s are constant. */
void selfcal_kernel_level(selfcal_t *self, span_t span, size_t from, size_t to);

/* A gap: the drift of every axis of node `j` loses the part `less` (1 - phi^count). */
void selfcal_kernel_gap(selfcal_t *self, size_t j, selfcal_wide_t less);

/* Forgetting: sums B and C of every axis of node `j`, times what is kept of each. */
void selfcal_kernel_fade(selfcal_t *self, size_t j, selfcal_wide_t keep_b, selfcal_wide_t keep_c);

#ifdef SELFCAL_FIXED
/* The nodes have been placed: chooses an axis's step by ln of its white noise per bank sample. */
void selfcal_kernel_start(selfcal_t *self, uint8_t axis, selfcal_real_t ln_sigma);

/* A batch begins. */
void selfcal_kernel_load(selfcal_t *self);

#endif

/* Node `j` has become level, is about to be no longer so. */
void selfcal_kernel_settle(selfcal_t *self, size_t j);
void selfcal_kernel_unsettle(selfcal_t *self, size_t j);

#ifdef SELFCAL_FIXED
/* Whether the steps of the span that they were made for are those of its readings, which are within their limits. */
bool selfcal_kernel_steps_sound(const selfcal_t *self);

/* g, u/s and 1/s of a level node as the integer kernels take them, in place of how they moved. */
void selfcal_kernel_mantissas(selfcal_node_t *node);
#endif

/* Sums B and C of `k` = node * axes + axis, and its predicted drift. */
void selfcal_kernel_view(const selfcal_t *self, size_t k, selfcal_wide_t *b, selfcal_wide_t *c, selfcal_wide_t *x);

/* ------------------------------------------------------------------------------------------------------- long sums */

/* Adds hi + lo, |lo| far below |hi| (Knuth's two-sum, then renormalised). */
static inline void sum_add(selfcal_sum_t *sum, selfcal_real_t hi, selfcal_real_t lo) {
    const selfcal_real_t total = sum->hi + hi;
    const selfcal_real_t part = total - sum->hi;
    const selfcal_real_t error = ((sum->hi - (total - part)) + (hi - part)) + (sum->lo + lo);
    sum->hi = total + error;
    sum->lo = error - (sum->hi - total);
}

/* Adds a single number: no lo to add. */
static inline void sum_add_value(selfcal_sum_t *sum, selfcal_real_t value) {
    const selfcal_real_t total = sum->hi + value;
    const selfcal_real_t part = total - sum->hi;
    const selfcal_real_t error = ((sum->hi - (total - part)) + (value - part)) + sum->lo;
    sum->hi = total + error;
    sum->lo = error - (sum->hi - total);
}

/* Adds scale * value, the product in full. */
static inline void sum_add_scaled(selfcal_sum_t *sum, selfcal_sum_t scale, selfcal_real_t value) {
    const selfcal_real_t product = scale.hi * value;
    sum_add(sum, product, r_fma_exact(scale.lo, value, r_fma_exact(scale.hi, value, -product)));
}

static inline selfcal_wide_t sum_value(selfcal_sum_t sum) {
    return (selfcal_wide_t)sum.hi + (selfcal_wide_t)sum.lo;
}

static inline bool finite_sum(selfcal_sum_t sum) {
    return isfinite(sum.hi) && isfinite(sum.lo);
}

static inline selfcal_sum_t make_sum(selfcal_wide_t value) {
    const selfcal_real_t hi = (selfcal_real_t)value;
    const selfcal_sum_t sum = {hi, (selfcal_real_t)(value - (selfcal_wide_t)hi)};
    return sum;
}

static inline void sum_fade(selfcal_sum_t *sum, selfcal_wide_t keep) {
    *sum = make_sum(keep * sum_value(*sum));
}

/* ---------------------------------------------------------------------------------------- innovations of several series */

/* One series through a span. */
typedef struct {
    selfcal_real_t nu[SELFCAL_BATCH];
    selfcal_real_t weighted[SELFCAL_BATCH], low[SELFCAL_BATCH]; /* nu/s and what it was rounded by */
} innovations_t;

/* Where a node has the sums B and C of an axis's readings. */
typedef struct {
    selfcal_sum_t *b, *c;
} reading_sums_t;

/* a + b = sum + error (Knuth). */
static inline selfcal_sum_t two_sum(selfcal_real_t a, selfcal_real_t b) {
    const selfcal_real_t sum = a + b, part = sum - a;
    const selfcal_sum_t result = {sum, (a - (sum - part)) + (b - part)};
    return result;
}

/* Sum of nu of one over s times nu of the other, to twice the digits (Ogita, Rump & Oishi, SIAM J. Sci. Comput. 26 (2005) 1955-1988,
 * algorithm 5.3), added to `sum`. */
void selfcal_add_products(selfcal_sum_t *sum, const gains_t *gains, const innovations_t *one, const innovations_t *other);

/* ------------------------------------------------------------------------------------------------- converged nodes */

/* 1/(1 + p_inf) to twice the digits: one Newton step on the residual of the quotient. */
static inline selfcal_sum_t steady_inv_s(const selfcal_node_t *node) {
    const selfcal_real_t s = R(1.0) + node->p_inf;
    const selfcal_real_t s_lo = node->p_inf >= R(1.0) ? R(1.0) - (s - node->p_inf) : node->p_inf - (s - R(1.0));
    const selfcal_real_t inv = R(1.0) / s;
    const selfcal_sum_t result = {inv, inv * r_fma_exact(-inv, s_lo, r_fma_exact(-inv, s, R(1.0)))};
    return result;
}

/* The gain of a converged node, phi K + beta. */
static inline selfcal_real_t steady_g(const selfcal_node_t *node) {
    const selfcal_real_t gain = node->p_inf / (R(1.0) + node->p_inf);
    return r_fma(gain, -node->beta, gain) + node->beta;
}

/* A level node of the integer kernels keeps no room for these: its gains do not move. */
static inline selfcal_moving_t moving_of(const selfcal_node_t *node) {
#ifdef SELFCAL_FIXED
    if (node->level) {
        const selfcal_real_t phi = R(1.0) - node->beta;
        const selfcal_moving_t still = {phi * phi / (R(1.0) + node->p_inf), R(0.0), R(0.0)};
        return still;
    }
#endif
    return node->gains.moving;
}

/* What a level node's samples have added to A since it became level. */
static inline selfcal_wide_t level_a(const selfcal_node_t *node) {
    const selfcal_wide_t u = (selfcal_wide_t)node->u_inf;
    return node->level ? (selfcal_wide_t)(node->steady - node->level_from) * u * u / (1.0 + (selfcal_wide_t)node->p_inf) : 0.0;
}

#endif
