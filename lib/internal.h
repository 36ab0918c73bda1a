/* Shared by the library's files; not for users. */
#ifndef SELFCAL_INTERNAL_H
#define SELFCAL_INTERNAL_H

#include <math.h>
#include <string.h>

#include "selfcal.h"

/* Arithmetic in selfcal_real_t. The fused multiply-add is written out, so that a host and a target round alike. */
#ifdef SELFCAL_REAL_DOUBLE
#define R(x) (x)
#define r_fma_exact fma
#define r_exp exp
#define r_expm1 expm1
#define r_log log
#define r_log1p log1p
#define r_sqrt sqrt
#define r_fabs fabs
#else
#define R(x) (x##F)
#define r_fma_exact fmaf
#define r_exp expf
#define r_expm1 expm1f
#define r_log logf
#define r_log1p log1pf
#define r_sqrt sqrtf
#define r_fabs fabsf
#endif

/* r_fma() where one rounding less is welcome, r_fma_exact() where the product's error is the point. In software a fused
 * multiply-add is ten times a product and a sum. */
#ifdef SELFCAL_FIXED
static inline selfcal_real_t r_fma(selfcal_real_t a, selfcal_real_t b, selfcal_real_t c) {
    return a * b + c;
}
#else
#define r_fma r_fma_exact
#endif

/* Written out: fminf() and fmaxf() are calls in newlib and were a third of a report. Neither argument may be NaN. */
static inline selfcal_real_t r_fmin(selfcal_real_t a, selfcal_real_t b) {
    return a < b ? a : b;
}

static inline selfcal_real_t r_fmax(selfcal_real_t a, selfcal_real_t b) {
    return a > b ? a : b;
}

#define SELFCAL_LN_2PI 1.8378770664093454836

/* C99 has no _Static_assert. `name` says what holds. */
#define SELFCAL_STATIC_ASSERT(name, condition) typedef char selfcal_assert_##name[(condition) ? 1 : -1]

/* bank.c */
/* One bank sample per axis, about the offset, with `r` times the white-noise variance of a whole block. */
void selfcal_bank_sample(selfcal_t *self, const selfcal_real_t y[], selfcal_real_t r);
/* `count` bank intervals without a sample. */
void selfcal_bank_gap(selfcal_t *self, uint64_t count);
/* From now on `block` samples make a bank interval: how many nodes a push has to run follows. */
void selfcal_bank_pace(selfcal_t *self, uint32_t block);
/* Runs up to `nodes` nodes over the batch that waits; false with none waiting. */
bool selfcal_bank_run(selfcal_t *self, uint16_t nodes);
/* Hands over what has been gathered, a batch that is not yet full or a gap after it; false if that is nothing. None may wait. */
bool selfcal_bank_hand_over(selfcal_t *self);
/* Both, to the end. */
void selfcal_bank_flush(selfcal_t *self);
/* Where a node lies: its hypothesis, and ln of its rho and alpha; NaN where the law has none. */
typedef struct {
    uint8_t hypothesis;
    selfcal_real_t ln_rho, ln_alpha;
} selfcal_place_t;
selfcal_place_t selfcal_bank_place(const selfcal_t *self, uint16_t index);
/* selfcal_node() of the sums as they are, without what has only been gathered. */
void selfcal_bank_view(const selfcal_t *self, uint8_t axis, uint16_t index, selfcal_node_view_t *view);

#endif
