/* The bank's inside: what all axes share (bank.c: variances, gains, sums A and D), the work of each axis (a kernel:
 * drift x, sums B and C), and the code that a model may name. Not for users. */
#ifndef SELFCAL_BANK_INSIDE_H
#define SELFCAL_BANK_INSIDE_H

#include "averages.h"
#include "twofold.h"

/* ln of the largest drift over white noise, 1e6: after the longest gap, 2^32 intervals, the recursion of d multiplies
 * variances of 2^32 rho^2, rho^2 and a part of r, which must remain a float. Beyond it only sigma_w is known: a node
 * more would say nothing. */
#define LN_RHO_MAX R(13.8)
/* No drift's variance is greater: the longest gap makes it 4.3e21. Of several such gaps without a sample between them,
 * the last adds less. */
#define P_MAX R(1e22)
/* One bank sample per axis, about the offset, with `r` times the white-noise variance of a whole block. */
void selfcal_bank_sample(selfcal_t *self, const selfcal_real_t y[], selfcal_real_t r);
/* `count` bank intervals without a sample. */
void selfcal_bank_gap(selfcal_t *self, uint64_t count);
/* From now on `block` samples make a bank interval: how many nodes a push has to run follows. */
void selfcal_bank_pace(selfcal_t *self, uint32_t block);
/* Runs up to `nodes` nodes over the batch that waits; false with none waiting. */
bool selfcal_bank_run(selfcal_t *self, uint16_t nodes);
/* Hands over the gathered bank samples: a batch that is not yet full, or a gap after it. False: there are none. No
 * batch may wait. */
bool selfcal_bank_hand_over(selfcal_t *self);
/* Both, to the end. */
void selfcal_bank_flush(selfcal_t *self);

/* Lays the bank's nodes, sums, regressors and states over the memory. */
void selfcal_bank_lay_out(selfcal_t *self, void *memory);

/* A node at the instant of its first sample. */
void selfcal_bank_start_node(selfcal_t *self, uint16_t index);
/* A level node is no longer so. What its constant u added to A comes due. */
void selfcal_bank_leave_level(selfcal_t *self, size_t j);

/* selfcal_offset() less the mean of the bias's prior, which moves with selfcal_shift(). */
selfcal_wide_t selfcal_bank_from_prior(const selfcal_t *self, uint8_t axis);
/* Where a node lies: its hypothesis, and ln of its rho and alpha; NaN where the law has none. */
typedef struct {
    uint8_t hypothesis;
    selfcal_real_t ln_rho, ln_alpha;
} selfcal_place_t;
selfcal_place_t selfcal_bank_place(const selfcal_t *self, uint16_t index);
/* selfcal_node() of the sums as they are, without the gathered bank samples. */
void selfcal_bank_view(const selfcal_t *self, uint8_t axis, uint16_t index, selfcal_node_view_t *view);
/* Parts of that: A, B, C and, as its drift, the prediction; D; then from the first all but D. Of a sum's nodes the
 * first is the whole. */
void selfcal_bank_sums(const selfcal_t *self, uint8_t axis, uint16_t index, selfcal_node_view_t *view);
/* ln x of a positive, finite x; else log(). */
selfcal_wide_t selfcal_bank_ln(selfcal_wide_t x);
/* Over a filter's prediction for the next interval: the drift at the end of the last one. Of a plain law's node. */
selfcal_wide_t selfcal_bank_per_prediction(const selfcal_t *self, uint16_t index);
void selfcal_bank_ln_s(const selfcal_t *self, uint16_t index, selfcal_node_view_t *view);
void selfcal_bank_now(const selfcal_t *self, uint16_t index, selfcal_node_view_t *view);

/* Forgetting leaves so much of a column's sum of squares. In a filter that has let go of the column nothing comes
 * after. B and A would shrink far below their sizes then, where neither a float nor an integer holds them. */
#define SELFCAL_KEPT_MIN 1e-9

/* The reading now at one node, given sigma_v: its mean less the offset, the drift's part of it, and its variance
 * over sigma_v^2. The variance is without the drift's own, given the bias (and the coefficients).
 * As it is now it is own[0]. With a part d of the drift gone it is own[0] + 2 d own[1] + d^2 own[2]. With d_a of
 * each of several terms gone it is own[0] + 2 sum d_a own[1 + a] + sum d_a d_b own[..], all pairs as selfcal_decay_t
 * has them. */
typedef struct {
    selfcal_wide_t mean;
    selfcal_real_t drift[SELFCAL_TERMS_MAX], own[1 + SELFCAL_TERMS_MAX + SELFCAL_TERM_PAIRS];
} selfcal_now_t;

/* sigma_v's mode at a node is found by turns, to this part of its square. */
#define SELFCAL_MODE_TURNS 20U
#define SELFCAL_MODE_LEFT R(1e-5)
/* One node for a report: its view; variance of the residuals; the mode of sigma_v^2 over that variance. `share`:
 * half the curvature in ln sigma_v is n less this, a sample for the bias and each coefficient that the data tell,
 * none for those that their priors tell. `extra`: added to -2 ln p by these priors. */
typedef struct {
    selfcal_node_view_t node;
    selfcal_wide_t var;
    selfcal_real_t ratio, share, extra;
} selfcal_field_t;

/* selfcal_push_with() but for its arguments' check, or for a sample taken in motion, without regressors: some of the
 * work that waits, a judgement of the axes, and the sample into its block or passed by. */
void selfcal_take(selfcal_t *self, const float sample[], const float regressors[], bool moving);

/* Regressors that an axis has, a bit each. */
uint8_t selfcal_regressors_mask(const selfcal_model_t *model, uint8_t axis);

/* --- a block's sums ---
 * intake_float.c and intake_fixed.c: of every axis, cleared; with a sample of the axes in `live`; the mean of the block
 * less the origin, with the sum of squares about that mean; whether they can be what samples made of them. */
void selfcal_intake_start(selfcal_t *self);
void selfcal_intake_add(selfcal_t *self, const float sample[], uint32_t live);
selfcal_real_t selfcal_intake_level(const selfcal_t *self, uint8_t axis, selfcal_wide_t *scatter);
bool selfcal_intake_sound(const selfcal_t *self, uint8_t axis);

/* --- kernels --- */

/* Part of the batch without a gap inside. */
typedef struct {
    uint32_t from, to;
} span_t;

/* The gain side of a batch, shared by the axes. */
typedef struct {
    span_t span;
    selfcal_real_t g[SELFCAL_BATCH];     /* phi K + beta */
    selfcal_real_t u[SELFCAL_BATCH];     /* innovation of "1" over s */
    selfcal_real_t inv_s[SELFCAL_BATCH]; /* 1 where s is constant and left to the scales */
    selfcal_sum_t scale;                 /* what the span's sums of nu and nu^2 are still to be multiplied by */
} gains_t;

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

/* Forgetting: sums B and C of every axis of node `j`, times the part that is kept of each. */
void selfcal_kernel_fade(selfcal_t *self, size_t j, selfcal_wide_t keep_b, selfcal_wide_t keep_c);

/* The record begins anew for cell `k` = node * axes + axis, whose node is not level: C is `c`, B and the drift are
 * 0. */
void selfcal_kernel_restart(selfcal_t *self, size_t k, selfcal_wide_t c);

/* The nodes have been placed: chooses an axis's step by ln of its white noise per bank sample. */
void selfcal_kernel_start(selfcal_t *self, uint8_t axis, selfcal_real_t ln_sigma);

/* A batch begins. */
void selfcal_kernel_load(selfcal_t *self);

/* Node `j` has become level, is about to be no longer so. */
void selfcal_kernel_settle(selfcal_t *self, size_t j);
void selfcal_kernel_unsettle(selfcal_t *self, size_t j);

/* selfcal_check() of the batch, and of node `j`. */
bool selfcal_kernel_sound(const selfcal_t *self);
bool selfcal_kernel_node_sound(const selfcal_t *self, size_t j);

/* Sums B and C of an axis at node `j`, and its predicted drift. */
void selfcal_kernel_view(const selfcal_t *self, size_t j, uint8_t axis, selfcal_wide_t *b, selfcal_wide_t *c,
                         selfcal_wide_t *x);

/* --- innovations of several series --- */

/* One series through a span. */
typedef struct {
    selfcal_real_t nu[SELFCAL_BATCH];
    selfcal_real_t weighted[SELFCAL_BATCH], low[SELFCAL_BATCH]; /* nu/s and what it was rounded by */
} innovations_t;

/* Where a node has the sums B and C of an axis's readings. */
typedef struct {
    selfcal_sum_t *b, *c;
} reading_sums_t;

/* Sum of nu of one over s times nu of the other, to twice the digits (Ogita, Rump & Oishi, SIAM J. Sci. Comput. 26
 * (2005) 1955-1988, algorithm 5.3), added to `sum`. */
void selfcal_add_products(selfcal_sum_t *sum, const gains_t *gains, const innovations_t *one,
                          const innovations_t *other);

/* Beside regressors, of `at` = node * axes + axis: sums B of "1" and C of the readings, and their predicted drift. */
reading_sums_t selfcal_kernel_reading(const selfcal_t *self, size_t at);
selfcal_sum_t selfcal_kernel_reading_drift(const selfcal_t *self, size_t at);
void selfcal_kernel_set_reading_drift(selfcal_t *self, size_t at, selfcal_sum_t x);
bool selfcal_kernel_readings_sound(const selfcal_t *self);

/* The same sums of a node of several states, `index` among those and `j` among all. */
reading_sums_t selfcal_kernel_state_sums(const selfcal_t *self, size_t j, size_t index, size_t axis);

/* --- what a model may name --- */

/* bank_forget.c, for a model that forgets. */
struct selfcal_forgetting_code {
    /* Of the sums, as the batch that waits comes after what they hold. */
    selfcal_wide_t (*part_kept)(selfcal_t *self);
    /* All sums of node `j` fade to self->keep. */
    void (*fade)(selfcal_t *self, size_t j);
};

/* bank_columns.c, for a model with regressors. */
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
    /* Of one node, with the regressors of a report in use; the residual is `least` at least. */
    void (*field)(const selfcal_work_t *work, uint16_t index, selfcal_wide_t least, selfcal_field_t *field);
    /* Node k of the hypothesis at sigma_v^2 = variance; the coefficients' moments are gathered. */
    void (*now)(const selfcal_work_t *work, uint16_t k, selfcal_wide_t variance, selfcal_now_t *now);
    void (*finish)(const selfcal_work_t *work);
    /* Copies its part for one axis into a bank that is held. */
    void (*hold)(selfcal_t *held, const selfcal_t *self, uint8_t axis);
};

/* bank_states.c: does for the nodes of laws that are sums as bank.c does for the others. */
struct selfcal_states_code {
    /* Whether there are filters for a law that is not plain. */
    bool (*valid)(const selfcal_law_t *law, float dt_s);
    /* In the memory that follows the bank's and its regressors'. */
    void (*init)(selfcal_t *self, unsigned char *memory);
    /* selfcal_check() of its part. */
    bool (*sound)(const selfcal_t *self);
    void (*start)(selfcal_t *self, size_t j, selfcal_place_t place);
    void (*run)(selfcal_t *self, size_t j, const span_t *span);
    void (*gap)(selfcal_t *self, size_t j, uint32_t count);
    /* Forgetting: the samples of D that were only counted come due. Then selfcal_kernel_fade() of its own sums. */
    void (*settle)(selfcal_t *self, size_t j);
    void (*fade)(selfcal_t *self, size_t j, selfcal_wide_t keep_b, selfcal_wide_t keep_c);
    /* selfcal_reopen(): begins anew with the sums C of each axis, and the part of D that is kept. */
    void (*restart)(selfcal_t *self, size_t j, const selfcal_wide_t c[], selfcal_wide_t keep);
    /* All but the node's place. */
    void (*view)(const selfcal_t *self, uint8_t axis, uint16_t index, selfcal_node_view_t *view);
    /* Covariance of the terms of the drift at the last interval, given x0, over sigma_v^2. */
    void (*spread)(const selfcal_t *self, size_t j, selfcal_wide_t spread[SELFCAL_TERM_PAIRS]);
    /* The drift of each term at the last interval over one series, see series_of_readings(). */
    void (*drift)(const selfcal_t *self, size_t j, size_t series, selfcal_wide_t drift[SELFCAL_TERMS_MAX]);
    /* Of the two states of an oscillation from `first` on: 1 - what is read of each after a time. */
    void (*fall)(const selfcal_term_t *first, selfcal_real_t elapsed_s, selfcal_real_t psi[2]);
    /* Copies its part for one axis into a bank that is held. */
    void (*hold)(selfcal_t *held, const selfcal_t *self, uint8_t axis);
};

/* Axes that the bank has cells of, and where an axis lies among them: a bank that is held has one. */
static inline size_t axes_in(const selfcal_t *self) {
    return self->held ? 1U : self->model->axes;
}
static inline size_t axis_in(const selfcal_t *self, size_t axis) {
    return self->held ? 0U : axis;
}

/* Index of an axis's sums and drift at node `j`. */
static inline size_t cell_of(const selfcal_t *self, size_t j, size_t axis) {
    return j * axes_in(self) + axis_in(self, axis);
}

/* Series of such a node: "1" is 0, regressor k is 1 + k, and the readings of an axis. */
static inline size_t series_of_readings(const selfcal_t *self, uint8_t axis) {
    return 1U + regressors_of(self->model) + axis_in(self, axis);
}

/* Whether the node belongs to a sum. Never of another law. */
static inline bool is_state_node(const selfcal_t *self, const selfcal_node_t *node) {
    return self->terms != NULL && !node->level && node->gains.moving.c == R(0.0);
}

/* adequacy.c: what all epochs have gathered of an axis has been told. */
void selfcal_adequacy_forget(selfcal_adequacy_t *self, uint8_t axis);

/* coarse.c: a bank sample, with the channels' means; the score of the strongest column of an axis, and which it is; the
 * bank begins anew. */
void selfcal_coarse_take(selfcal_coarse_t *self, const selfcal_batch_t *batch, uint32_t at,
                         const selfcal_real_t channel[], const selfcal_model_t *model);
selfcal_real_t selfcal_coarse_score(const selfcal_coarse_t *self, uint8_t axis, selfcal_suspect_t *suspect);
void selfcal_coarse_restart(selfcal_coarse_t *self);
/* sigma_v of the likeliest walk, unit; 0 where the readings have no noise. After the first bank sample. */
selfcal_real_t selfcal_coarse_sigma(const selfcal_coarse_t *self, uint8_t axis);

/* levels.c: a bank sample that the coarse bank has taken; the score of two levels. A memory of zeros begins anew. */
void selfcal_levels_take(selfcal_levels_t *self, const selfcal_coarse_t *coarse, const selfcal_batch_t *batch,
                         uint32_t at, uint8_t axes);
selfcal_real_t selfcal_levels_score(const selfcal_levels_t *self, uint8_t axis);

/* tones.c: an innovation; the score of the strongest tone. */
void selfcal_tones_take(selfcal_tones_t *self, selfcal_real_t z);
selfcal_real_t selfcal_tones_score(const selfcal_tones_t *self);

/* --- converged nodes --- */

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

/* snapshot.c: CRC-32 of bytes after those of `crc`, 0 at the start. */
uint32_t selfcal_crc32(uint32_t crc, const uint8_t *bytes, size_t count);

/* A level node's samples have added this to A since it became level. */
static inline selfcal_wide_t level_a(const selfcal_node_t *node) {
    const selfcal_wide_t u = (selfcal_wide_t)node->u_inf;
    return node->level ? (selfcal_wide_t)(node->steady - node->level_from) * u * u / (1.0 + (selfcal_wide_t)node->p_inf)
                       : 0.0;
}

#endif
