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
#define r_sin sin
#define r_cos cos
#else
#define R(x) (x##F)
#define r_fma_exact fmaf
#define r_exp expf
#define r_expm1 expm1f
#define r_log logf
#define r_log1p log1pf
#define r_sqrt sqrtf
#define r_fabs fabsf
#define r_sin sinf
#define r_cos cosf
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

/* By value, so that a compiler that fears odd addresses copies no bytes. */
static inline uint32_t float_bits(float value) {
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    return bits;
}

/* Whether the byte is one that a bool has: to read another as a bool, from memory that was overwritten, is undefined. */
static inline bool is_bool(const bool *flag) {
    uint8_t byte;
    memcpy(&byte, flag, sizeof byte);
    return byte <= 1U;
}

#ifdef SELFCAL_FIXED
/* value * 2^shift, rounded to nearest; held at +-INT32_MAX. Bit by bit: a tenth of what software floating point takes. */
static inline int32_t to_fixed(float value, int shift) {
    const uint32_t bits = float_bits(value);
    const int exponent = (int)((bits >> 23) & 0xFFU);
    if (exponent == 0) {
        return 0; /* zero, or denormal */
    }
    const uint32_t mantissa = (bits & 0x7FFFFFU) | 0x800000U;
    const int left = exponent - 150 + shift; /* value = mantissa 2^(exponent - 150) */
    uint32_t magnitude = INT32_MAX;
    if (left < -24) {
        magnitude = 0;
    } else if (left < 0) {
        magnitude = (mantissa + (1U << (-left - 1))) >> -left;
    } else if (left <= 7) {
        magnitude = mantissa << left;
    }
    return (bits >> 31) != 0U ? -(int32_t)magnitude : (int32_t)magnitude;
}
#endif

#define SELFCAL_LN_2PI 1.8378770664093454836
#define SELFCAL_LN_2 0.69314718055994530942

/* C99 has no _Static_assert. `name` says what holds. */
#define SELFCAL_STATIC_ASSERT(name, condition) typedef char selfcal_assert_##name[(condition) ? 1 : -1]

/* Where a pair (a, b) of terms, b <= a, lies. */
static inline size_t term_pair(size_t a, size_t b) {
    return a * (a + 1U) / 2U + b;
}

/* What a law has. Terms that this build has room for: a law with more is refused. */
static inline size_t terms_of(const selfcal_law_t *law) {
    return law->terms < SELFCAL_TERMS_MAX ? law->terms : SELFCAL_TERMS_MAX;
}

static inline bool has_drift(const selfcal_law_t *law) {
    return law->terms > 0U;
}

static inline bool has_term(const selfcal_law_t *law, selfcal_term_kind_t kind) {
    for (size_t a = 0; a < terms_of(law); a++) {
        if (law->term[a].kind == kind) {
            return true;
        }
    }
    return false;
}

/* The drift parameter is K; else sigma_m, if the law has a drift. */
static inline bool has_walk(const selfcal_law_t *law) {
    return has_term(law, SELFCAL_WALK);
}

static inline bool has_deviation(const selfcal_law_t *law) {
    return has_drift(law) && !has_walk(law);
}

/* The place of the parameter that goes with rho. */
static inline selfcal_parameter_t drift_parameter(const selfcal_law_t *law) {
    return has_deviation(law) ? SELFCAL_SIGMA_M : SELFCAL_K;
}

static inline bool has_decay(const selfcal_law_t *law) {
    return has_term(law, SELFCAL_MARKOV);
}

static inline bool has_alpha(const selfcal_law_t *law) {
    for (size_t a = 0; a < terms_of(law); a++) {
        if (law->term[a].kind == SELFCAL_MARKOV && !law->term[a].stated) {
            return true;
        }
    }
    return false;
}

static inline bool has_ratio(const selfcal_law_t *law) {
    for (size_t a = 0; a < terms_of(law); a++) {
        if (law->term[a].by_ratio) {
            return true;
        }
    }
    return law->coloured_noise;
}

/* One plain term, or none: the filters of bank.c. All others are sums (terms.c). */
static inline bool is_plain(const selfcal_law_t *law) {
    const selfcal_term_t *term = &law->term[0];
    const bool walk = term->kind == SELFCAL_WALK, markov = term->kind == SELFCAL_MARKOV && term->bandwidth == 1.0F && !term->stated;
    return !law->coloured_noise &&
           (law->terms == 0U || (law->terms == 1U && term->deviation == 1.0F && !term->by_ratio && (walk || markov)));
}

static inline bool is_sum(const selfcal_law_t *law) {
    return SELFCAL_TERMS_MAX > 1 && !is_plain(law);
}

/* Of a term, 1/s, at an alpha; 0 of a walk, which does not decay. */
static inline selfcal_wide_t bandwidth_of(const selfcal_term_t *term, selfcal_wide_t alpha) {
    return term->kind == SELFCAL_WALK ? 0.0 : (selfcal_wide_t)term->bandwidth * (term->stated ? 1.0 : alpha);
}

/* Stationary variance of a Gauss-Markov term over sigma_v^2, at a node of rho^2 = `square` and of the law's second parameter. */
static inline selfcal_wide_t markov_variance(const selfcal_law_t *law, const selfcal_term_t *term, selfcal_wide_t square,
                                             selfcal_wide_t second, selfcal_wide_t dt_s) {
    const selfcal_wide_t deviation = (selfcal_wide_t)term->deviation * (term->by_ratio ? second : 1.0);
    const selfcal_wide_t variance = deviation * deviation * square;
    return has_walk(law) ? variance / (bandwidth_of(term, second) * dt_s) : variance; /* rho^2 = K^2 dt / sigma_v^2 */
}

/* Priors of an axis under a hypothesis. */
static inline const selfcal_prior_t *priors_of(const selfcal_model_t *model, const selfcal_hypothesis_t *hypothesis, uint8_t axis) {
    if (hypothesis->prior != NULL) {
        return &hypothesis->prior[(size_t)axis * SELFCAL_PARAMETERS];
    }
    return model->axis[axis].prior;
}

/* bank.c */
/* ln of the largest drift over white noise, 1e6: after the longest gap, 2^32 intervals, the recursion of d multiplies variances of
 * 2^32 rho^2, rho^2 and a part of r, which must remain a float. Beyond it only sigma_w is known: a node more would say nothing. */
#define LN_RHO_MAX R(13.8)
/* No drift's variance is greater: the longest gap makes it 4.3e21. Of several such gaps without a sample between them, the last adds
 * less. */
#define P_MAX R(1e22)
/* One bank sample per axis, about the offset, with `r` times the white-noise variance of a whole block. */
void selfcal_bank_sample(selfcal_t *self, const selfcal_real_t y[], selfcal_real_t r);
/* Drift that forgets within an interval is held at phi = e^-6.9 = 1e-3: the drift now is the prediction over phi, and neighbours
 * correlated by 1e-3 are beyond telling from white ones. */
#define ALPHA_DT_MAX 6.9
/* `count` bank intervals without a sample. */
void selfcal_bank_gap(selfcal_t *self, uint64_t count);
/* Nodes of a hypothesis: those of rho times those of alpha, which changes fastest. */
static inline uint16_t grid_nodes(const selfcal_grid_t *grid) {
    return grid != NULL ? grid->nodes : 1U;
}

static inline uint16_t hypothesis_nodes(const selfcal_hypothesis_t *hypothesis) {
    return (uint16_t)(grid_nodes(hypothesis->rho) * grid_nodes(hypothesis->alpha));
}

/* Node `index` of the bank is node `index` of a hypothesis. */
typedef struct {
    uint8_t hypothesis;
    uint16_t index;
} node_of_t;

static inline node_of_t node_of(const selfcal_model_t *model, size_t index) {
    node_of_t node = {0, (uint16_t)index};
    while (node.index >= hypothesis_nodes(&model->hypothesis[node.hypothesis])) {
        node.index = (uint16_t)(node.index - hypothesis_nodes(&model->hypothesis[node.hypothesis]));
        node.hypothesis++;
    }
    return node;
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
/* Parts of that: A, B, C and, as its drift, the prediction; D; then from the first all but D. Of a sum's nodes the first is the whole. */
void selfcal_bank_sums(const selfcal_t *self, uint8_t axis, uint16_t index, selfcal_node_view_t *view);
/* ln x of a positive, finite x; else log(). */
selfcal_wide_t selfcal_bank_ln(selfcal_wide_t x);
void selfcal_bank_ln_s(const selfcal_t *self, uint16_t index, selfcal_node_view_t *view);
void selfcal_bank_now(const selfcal_t *self, uint16_t index, selfcal_node_view_t *view);

/* Forgetting leaves so much of a column's sum of squares: in a filter that has let go of the column nothing comes after, and neither a
 * float nor an integer could hold what B and A are then far below their sizes. */
#define SELFCAL_KEPT_MIN 1e-9

/* What is read now at one node, given sigma_v: its mean less the offset, the drift's part of that, and its variance over sigma_v^2
 * without that of the drift given the bias (and the coefficients): as it is now, and with d of the drift gone
 * own[0] + 2 d own[1] + d^2 own[2]. With several terms, d_a of each gone, that is own[0] + 2 sum d_a own[1 + a] + sum d_a d_b own[..]: all
 * pairs, as selfcal_decay_t has them. */
typedef struct {
    selfcal_wide_t mean, drift[SELFCAL_TERMS_MAX], own[1 + SELFCAL_TERMS_MAX + SELFCAL_TERM_PAIRS];
} selfcal_now_t;

/* sigma_v's mode at a node is found by turns, to this part of its square. */
#define SELFCAL_MODE_TURNS 20U
#define SELFCAL_MODE_LEFT R(1e-5)
/* What a report takes of one node: its view; variance of the residuals; the mode of sigma_v^2 over that; what half the curvature in
 * ln sigma_v lacks of n: a sample for the bias and each coefficient that the data tell, none for those that their priors tell; and what these
 * priors add to -2 ln p. */
typedef struct {
    selfcal_node_view_t node;
    selfcal_wide_t var;
    selfcal_real_t ratio, share, extra;
} selfcal_field_t;

/* forgetting.c, for a model that forgets. */
struct selfcal_forgetting_code {
    /* Of the sums, as the batch that waits comes after what they hold. */
    selfcal_wide_t (*part_kept)(selfcal_t *self);
    /* All sums of node `j` fade to self->keep. */
    void (*fade)(selfcal_t *self, size_t j);
};
#ifdef SELFCAL_FIXED
/* averager_fixed.c: one axis of a block, cleared before. Its first sample; another, finite as all are. */
void selfcal_block_open(selfcal_block_t *sums, float value);
void selfcal_block_add(selfcal_block_t *sums, float value);
/* Mean of its `used` samples less `origin`; `scatter`: sum of squares about the mean. */
selfcal_real_t selfcal_block_level(const selfcal_block_t *sums, uint32_t used, float origin, selfcal_wide_t *scatter);
#endif

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
    /* Of one node, with the regressors of a report in use; the residual is `least` at least. */
    void (*field)(const selfcal_work_t *work, uint16_t index, selfcal_wide_t least, selfcal_field_t *field);
    /* Node k of the hypothesis at sigma_v^2 = variance; the coefficients' moments are gathered. */
    void (*now)(const selfcal_work_t *work, uint16_t k, selfcal_wide_t variance, selfcal_now_t *now);
    void (*finish)(const selfcal_work_t *work);
#ifdef SELFCAL_FIXED
    /* selfcal_kernel_view(). */
    void (*view)(const selfcal_t *self, size_t k, selfcal_wide_t *b, selfcal_wide_t *c, selfcal_wide_t *x);
#endif
};

#if SELFCAL_TERMS_MAX > 1
/* terms.c, for the nodes of sums: what bank.c does for the others. */
struct span; /* kernel.h */
size_t selfcal_terms_nodes(const selfcal_model_t *model);
void selfcal_terms_init(selfcal_t *self, unsigned char *memory);
bool selfcal_terms_sound(const selfcal_t *self);
/* Node `j` belongs to a sum. */
static inline bool selfcal_is_term_node(const selfcal_node_t *node) {
    return !node->level && node->gains.moving.c == R(0.0); /* never of another law */
}
void selfcal_terms_start(selfcal_t *self, size_t j, selfcal_place_t place);
void selfcal_terms_run(selfcal_t *self, size_t j, const struct span *span);
void selfcal_terms_gap(selfcal_t *self, size_t j, uint32_t count);
/* What of D has only been counted comes due. */
void selfcal_terms_settle(selfcal_t *self, size_t j);
#ifdef SELFCAL_FIXED
/* selfcal_kernel_fade() of its own sums. */
void selfcal_terms_fade(selfcal_t *self, size_t j, selfcal_wide_t keep_b, selfcal_wide_t keep_c);
#endif
/* All but the node's place. */
void selfcal_terms_view(const selfcal_t *self, uint8_t axis, uint16_t index, selfcal_node_view_t *view);
/* Covariance of the terms of the drift at the last interval, given x0, over sigma_v^2. */
void selfcal_terms_spread(const selfcal_t *self, size_t j, selfcal_wide_t spread[SELFCAL_TERM_PAIRS]);
/* The drift of each term at the last interval over one series: "1" is 0, regressor k is 1 + k, and the readings of an axis. */
size_t selfcal_terms_series(const selfcal_t *self, uint8_t axis);
void selfcal_terms_drift(const selfcal_t *self, size_t j, size_t series, selfcal_wide_t drift[SELFCAL_TERMS_MAX]);
#endif

/* Kept apart from what every sample runs through, whose registers and bytes it would take. */
#ifdef __GNUC__
#define COLD __attribute__((noinline))
#else
#define COLD
#endif

/* selfcal_push_with() but for its arguments' check, or for a sample taken in motion, without regressors: some of the work that waits, a judgement
 * of the axes, and the sample into its block or passed by. */
void selfcal_take(selfcal_t *self, const float sample[], const float regressors[], bool moving);

/* Regressors that an axis has, a bit each. */
uint8_t selfcal_regressors_mask(const selfcal_model_t *model, uint8_t axis);

#endif
