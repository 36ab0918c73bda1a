/* Laws, hypotheses and their nodes by the tables. Not for users. */
#ifndef SELFCAL_LAWS_H
#define SELFCAL_LAWS_H

#include "selfcal.h"

/* Where a pair (a, b) of terms, b <= a, lies. */
static inline size_t term_pair(size_t a, size_t b) {
    return a * (a + 1U) / 2U + b;
}

/* Terms that this build has room for. A law with more is refused. */
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

static inline bool has_oscillation(const selfcal_law_t *law) {
    return has_term(law, SELFCAL_OSCILLATION);
}

static inline bool has_decay(const selfcal_law_t *law) {
    return has_term(law, SELFCAL_MARKOV) || has_oscillation(law);
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

/* One plain term, or none: the filters of bank.c. All others are sums (bank_states.c). */
static inline bool is_plain(const selfcal_law_t *law) {
    const selfcal_term_t *term = &law->term[0];
    const bool walk = term->kind == SELFCAL_WALK,
               markov = term->kind == SELFCAL_MARKOV && term->bandwidth == 1.0F && !term->stated;
    return !law->coloured_noise &&
           (law->terms == 0U || (law->terms == 1U && term->deviation == 1.0F && !term->by_ratio && (walk || markov)));
}

static inline bool is_sum(const selfcal_law_t *law) {
    return !is_plain(law);
}

/* Of a term, 1/s, at an alpha; 0 of a walk, which does not decay. */
static inline selfcal_wide_t bandwidth_of(const selfcal_term_t *term, selfcal_wide_t alpha) {
    return term->kind == SELFCAL_WALK ? 0.0 : (selfcal_wide_t)term->bandwidth * (term->stated ? 1.0 : alpha);
}

/* Stationary variance of a Gauss-Markov term over sigma_v^2, at a node of rho^2 = `square` and of the law's second
 * parameter. Of an oscillation half of it, for each of its two states. */
static inline selfcal_wide_t markov_variance(const selfcal_law_t *law, const selfcal_term_t *term,
                                             selfcal_wide_t square, selfcal_wide_t second, selfcal_wide_t dt_s) {
    const selfcal_wide_t deviation = (selfcal_wide_t)term->deviation * (term->by_ratio ? second : 1.0);
    const bool markov = term->kind == SELFCAL_MARKOV;
    const selfcal_wide_t variance = (markov ? 1.0 : 0.5) * deviation * deviation * square;
    const selfcal_term_t *first = term->kind == SELFCAL_DAMPING ? term - 1 : term;
    return has_walk(law) ? variance / (bandwidth_of(first, second) * dt_s) : variance; /* rho^2 = K^2 dt / sigma_v^2 */
}

/* ln of SELFCAL_RATIO_MAX, rounded up: beyond, 1 + theta or 1 - theta of coloured noise is no longer a float. */
#define LN_RATIO_MAX 6.91F

/* Priors of an axis under a hypothesis. */
static inline const selfcal_prior_t *priors_of(const selfcal_model_t *model, const selfcal_hypothesis_t *hypothesis,
                                               uint8_t axis) {
    if (hypothesis->prior != NULL) {
        return &hypothesis->prior[(size_t)axis * SELFCAL_PARAMETERS];
    }
    return model->axis[axis].prior;
}

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

/* Nodes of the hypotheses whose law is a sum. */
static inline size_t sum_nodes(const selfcal_model_t *model) {
    size_t nodes = 0;
    for (uint8_t h = 0; h < model->hypotheses; h++) {
        nodes += is_sum(model->hypothesis[h].law) ? hypothesis_nodes(&model->hypothesis[h]) : 0U;
    }
    return nodes;
}

static inline size_t regressors_of(const selfcal_model_t *model) {
    return model->regressors != NULL ? model->regressors->count : 0U;
}

#endif
