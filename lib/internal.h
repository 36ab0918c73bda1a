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
/* Nodes of a hypothesis: those of rho times those of alpha, which changes fastest. */
static inline uint16_t grid_nodes(const selfcal_grid_t *grid) {
    return grid != NULL ? grid->nodes : 1U;
}

static inline uint16_t hypothesis_nodes(const selfcal_hypothesis_t *hypothesis) {
    return (uint16_t)(grid_nodes(hypothesis->rho) * grid_nodes(hypothesis->alpha));
}

/* From now on `block` samples make a bank interval: how many nodes a push has to run follows. */
void selfcal_bank_pace(selfcal_t *self, uint32_t block);
/* Runs up to `nodes` nodes over the batch that waits; false with none waiting. */
bool selfcal_bank_run(selfcal_t *self, uint16_t nodes);
/* Hands over what has been gathered, a batch that is not yet full or a gap after it; false if that is nothing. None may wait. */
bool selfcal_bank_hand_over(selfcal_t *self);
/* Both, to the end. */
void selfcal_bank_flush(selfcal_t *self);

/* selfcal_offset() less the mean of the bias's prior, which moves with selfcal_shift(). */
selfcal_wide_t selfcal_bank_from_prior(const selfcal_t *self, uint8_t axis);
/* Where a node lies: its hypothesis, and ln of its rho and alpha; NaN where the law has none. */
typedef struct {
    uint8_t hypothesis;
    selfcal_real_t ln_rho, ln_alpha;
} selfcal_place_t;
selfcal_place_t selfcal_bank_place(const selfcal_t *self, uint16_t index);
/* selfcal_node() of the sums as they are, without what has only been gathered. */
void selfcal_bank_view(const selfcal_t *self, uint8_t axis, uint16_t index, selfcal_node_view_t *view);

/* Forgetting leaves so much of a column's sum of squares: in a filter that has let go of the column nothing comes after, and neither a
 * float nor an integer could hold what B and A are then far below their sizes. */
#define SELFCAL_KEPT_MIN 1e-9

/* What is read now at one node, given sigma_v: its mean less the offset, the drift's part of that, and its variance over sigma_v^2
 * without that of the drift given the bias (and the coefficients): as it is now, and with d of the drift gone
 * own[0] + 2 d own[1] + d^2 own[2]. */
typedef struct {
    selfcal_wide_t mean, drift, own[3];
} selfcal_now_t;

/* forgetting.c, for a model that forgets. */
struct selfcal_forgetting_code {
    /* Of the sums, as the batch that waits comes after what they hold. */
    selfcal_wide_t (*part_kept)(selfcal_t *self);
    /* All sums of node `j` fade to self->keep. */
    void (*fade)(selfcal_t *self, size_t j);
};

/* regressors.c, for a model with regressors. */
typedef struct gains gains_t; /* kernel.h */
struct selfcal_regressors_code {
    bool (*valid)(const selfcal_model_t *model);
    /* In the memory that follows the bank's. */
    void (*init)(selfcal_t *self, unsigned char *memory);
    /* selfcal_check() of its part. */
    bool (*sound)(const selfcal_t *self);
    /* A sample's values: whether all are finite (else counted); into the block; the block's means into the batch. */
    bool (*usable)(selfcal_t *self, const float values[]);
    void (*add)(selfcal_t *self, const float values[]);
    void (*close)(selfcal_t *self);
    /* The batch that waits is about to enter the sums. */
    void (*hand_over)(selfcal_t *self);
    /* selfcal_kernel_run() and selfcal_kernel_gap(), columns and all. */
    void (*run)(selfcal_t *self, size_t j, const gains_t *gains);
    void (*gap)(selfcal_t *self, size_t j, selfcal_wide_t less);
    /* Forgetting, of its own sums: the readings times `part`, the column "1" times `part_of_one`. */
    void (*fade)(selfcal_t *self, size_t j, selfcal_wide_t part, selfcal_wide_t part_of_one);
    /* With the regressors of a report in use: ln of sigma_v's mode, profile ln-likelihood and the share of samples that went into the
     * bias and the coefficients, of one node; the residual is `least` at least. */
    void (*field)(const selfcal_work_t *work, uint16_t index, selfcal_wide_t n_eff, selfcal_wide_t least, selfcal_wide_t *ln_sigma,
                  selfcal_wide_t *profile, selfcal_wide_t *share);
    /* Node k of the hypothesis at sigma_v^2 = variance; the coefficients' moments are gathered. */
    void (*now)(const selfcal_work_t *work, uint16_t k, selfcal_wide_t variance, selfcal_now_t *now);
    void (*finish)(const selfcal_work_t *work);
};

/* Regressors that an axis has, a bit each. */
uint8_t selfcal_regressors_mask(const selfcal_model_t *model, uint8_t axis);

#endif
