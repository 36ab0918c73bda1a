/* Numbers as hi + lo, with twice the digits of selfcal_real_t. Not for users. */
#ifndef SELFCAL_TWOFOLD_H
#define SELFCAL_TWOFOLD_H

#include "arithmetic.h"

/* a + b = sum + error (Knuth). */
static inline selfcal_sum_t two_sum(selfcal_real_t a, selfcal_real_t b) {
    const selfcal_real_t sum = a + b, part = sum - a;
    const selfcal_sum_t result = {sum, (a - (sum - part)) + (b - part)};
    return result;
}

/* Adds hi + lo, |lo| far below |hi| (Knuth's two-sum, then renormalised). */
static inline void sum_add(selfcal_sum_t *sum, selfcal_real_t hi, selfcal_real_t lo) {
    const selfcal_sum_t total = two_sum(sum->hi, hi);
    const selfcal_real_t error = total.lo + (sum->lo + lo);
    sum->hi = total.hi + error;
    sum->lo = error - (sum->hi - total.hi);
}

/* Adds a single number: no lo to add. */
static inline void sum_add_value(selfcal_sum_t *sum, selfcal_real_t value) {
    const selfcal_sum_t total = two_sum(sum->hi, value);
    const selfcal_real_t error = total.lo + sum->lo;
    sum->hi = total.hi + error;
    sum->lo = error - (sum->hi - total.hi);
}

/* Adds scale * value, the product in full. */
static inline void sum_add_scaled(selfcal_sum_t *sum, selfcal_sum_t scale, selfcal_real_t value) {
    const selfcal_real_t product = scale.hi * value;
    sum_add(sum, product, r_fma_exact(scale.lo, value, r_fma_exact(scale.hi, value, -product)));
}

/* 1/(1 + x) */
static inline selfcal_sum_t one_over_1_and(selfcal_real_t x) {
    const selfcal_sum_t whole = two_sum(R(1.0), x);
    const selfcal_real_t hi = R(1.0) / whole.hi;
    const selfcal_sum_t result = {hi, hi * r_fma_exact(-hi, whole.lo, r_fma_exact(-hi, whole.hi, R(1.0)))};
    return result;
}

static inline selfcal_sum_t two_product(selfcal_sum_t a, selfcal_sum_t b) {
    const selfcal_real_t product = a.hi * b.hi;
    const selfcal_sum_t result = {product,
                                  r_fma_exact(a.hi, b.lo, r_fma_exact(a.lo, b.hi, r_fma_exact(a.hi, b.hi, -product)))};
    return result;
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

#endif
