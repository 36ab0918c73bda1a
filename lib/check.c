/* Invariants of a bank. Every push, skip and report leaves them true, whatever came in. */
#include "bank_inside.h"

/* Sizes of selfcal_config.h that the code can do with. */
SELFCAL_STATIC_ASSERT(axes, SELFCAL_AXES_MAX >= 1 && SELFCAL_AXES_MAX <= 16);
SELFCAL_STATIC_ASSERT(hypotheses, SELFCAL_HYPOTHESES_MAX >= 1 && SELFCAL_HYPOTHESES_MAX <= 16);
SELFCAL_STATIC_ASSERT(grid_has_a_spline, SELFCAL_GRID_MAX >= SELFCAL_GRID_MIN && SELFCAL_GRID_MAX <= 64);
SELFCAL_STATIC_ASSERT(alpha, SELFCAL_ALPHA_MAX >= SELFCAL_GRID_MIN && SELFCAL_ALPHA_MAX <= SELFCAL_GRID_MAX);
SELFCAL_STATIC_ASSERT(nodes_of_one,
                      SELFCAL_HYPOTHESIS_NODES_MAX >= SELFCAL_GRID_MAX && SELFCAL_HYPOTHESIS_NODES_MAX <= 65535);
SELFCAL_STATIC_ASSERT(nodes_of_all, SELFCAL_NODES_MAX >= SELFCAL_HYPOTHESIS_NODES_MAX && SELFCAL_NODES_MAX <= 65535);
SELFCAL_STATIC_ASSERT(regressors, SELFCAL_REGRESSORS_MAX >= 1 && SELFCAL_REGRESSORS_MAX <= 6);
SELFCAL_STATIC_ASSERT(terms, SELFCAL_TERMS_MAX == 1 || SELFCAL_TERMS_MAX == 3);
SELFCAL_STATIC_ASSERT(a_batch_places_the_nodes, SELFCAL_BATCH >= 8 && SELFCAL_BATCH <= SELFCAL_BATCH_ROOM);
SELFCAL_STATIC_ASSERT(push_nodes, SELFCAL_PUSH_NODES >= 1 && SELFCAL_PUSH_NODES <= 65535);
SELFCAL_STATIC_ASSERT(push_every, SELFCAL_PUSH_EVERY >= 1 && SELFCAL_PUSH_EVERY <= 256 &&
                                      (SELFCAL_PUSH_EVERY & (SELFCAL_PUSH_EVERY - 1)) == 0);
SELFCAL_STATIC_ASSERT(lines, SELFCAL_LINES >= 8 && SELFCAL_LINES <= 64 && SELFCAL_LINES % 2 == 0);
SELFCAL_STATIC_ASSERT(retire, SELFCAL_RETIRE_BLOCKS >= 0 && SELFCAL_RETIRE_BLOCKS < 65535);
SELFCAL_STATIC_ASSERT(quality, SELFCAL_REPORT_QUALITY >= 0 && SELFCAL_REPORT_QUALITY <= 3);

/* The prices that selfcal_layout.h states, of the float build and the integer one. */
#define PRICED(condition) (sizeof(selfcal_real_t) != sizeof(float) || (condition))
SELFCAL_STATIC_ASSERT(bytes_a_node, PRICED(SELFCAL_SIZE(1, 0) == 56));
SELFCAL_STATIC_ASSERT(bytes_a_node_and_axis, PRICED(SELFCAL_SIZE(1, 1) - SELFCAL_SIZE(1, 0) == 20));
SELFCAL_STATIC_ASSERT(bytes_a_node_of_two_regressors, /* 4 (p + 1) (p + 4) */
                      PRICED(SELFCAL_REGRESSORS_SIZE(2, 0, 2) - SELFCAL_REGRESSORS_SIZE(1, 0, 2) == 72));
SELFCAL_STATIC_ASSERT(bytes_an_axis_of_two_regressors, /* 8 p + 4, in integers 8 p + 24 */
                      PRICED(SELFCAL_REGRESSORS_SIZE(1, 1, 2) - SELFCAL_REGRESSORS_SIZE(1, 0, 2) ==
                             (SELFCAL_STATE_SUMS > 0U ? 40 : 20)));
SELFCAL_STATIC_ASSERT(bytes_a_node_of_a_sum,
                      SELFCAL_TERMS_MAX != 3 ||
                          PRICED(SELFCAL_TERMS_SIZE(2, 0, 2) - SELFCAL_TERMS_SIZE(1, 0, 2) == 104 + 24 * 2));
SELFCAL_STATIC_ASSERT(bytes_an_axis_of_a_sum,
                      SELFCAL_TERMS_MAX != 3 || SELFCAL_STATE_SUMS > 0U ||
                          PRICED(SELFCAL_TERMS_SIZE(1, 1, 2) - SELFCAL_TERMS_SIZE(1, 0, 2) == 24));

/* No drift's variance per interval is greater, see LN_RHO_MAX. */
#define Q_MAX R(1e12)

/* No drift forgets more, see SELFCAL_ALPHA_DT_MAX: 1 - e^-6.9. */
#define BETA_MAX R(0.999)

/* Beneath it a float is a denormal, whose rounding is not relative. */
#define LEAST R(1.2e-38)

/* No prior of drift and white noise, and no interval, puts a node lower. */
#define LN_RHO_MIN R(-120.0)

/* Room for rounding in quantities that are bounded by 1 or by each other. */
#define SLACK R(1e-5)

static bool flags_are_bools(const selfcal_t *self) {
    return is_bool(&self->batch[0].part) && is_bool(&self->batch[1].part) && is_bool(&self->started) &&
           is_bool(&self->dropped) && is_bool(&self->in_gap) && is_bool(&self->held);
}

/* False for NaN. */
static bool within(selfcal_real_t value, selfcal_real_t lo, selfcal_real_t hi) {
    return value >= lo && value <= hi;
}

static bool memory_is_laid_out(const selfcal_t *self) {
    const selfcal_model_t *model = self->model;
    if (model == NULL || model->axes == 0U || model->axes > SELFCAL_AXES_MAX || model->hypotheses == 0U ||
        model->hypotheses > SELFCAL_HYPOTHESES_MAX || model->block == 0U) {
        return false;
    }
    const size_t cells = (size_t)model->nodes * model->axes;
    return self->b != NULL && !self->held && self->c == self->b + cells &&
           (const void *)self->node == (const void *)(self->c + cells) &&
           (const void *)self->x == (const void *)(self->node + model->nodes);
}

static bool batch_is_sound(const selfcal_t *self, const selfcal_batch_t *batch) {
    const selfcal_real_t ratio_max = (selfcal_real_t)SELFCAL_VARIANCE_RATIO_MAX;
    for (uint32_t i = 0; i < batch->count; i++) {
        /* a block counts from half of its samples on */
        if (!within(batch->r[i], R(1.0) / ratio_max, R(2.0) * ratio_max) || (batch->r[i] != R(1.0) && !batch->part)) {
            return false;
        }
        for (uint8_t axis = 0; axis < self->model->axes; axis++) {
            if (!isfinite(batch->y[axis][i])) {
                return false;
            }
        }
    }
    return true;
}

/* Weight of the samples: one each, or less where they are forgotten or selfcal_reopen() has kept a part. */
static bool weight_is_sound(const selfcal_t *self) {
    if (self->model->forgetting == NULL && (self->keep != 1.0 || self->beginning != 1.0)) {
        return false; /* there is no code that fades */
    }
    if (self->model->forgetting != NULL || self->model->handling != NULL) {
        /* nothing to forget yet */
        return self->weight <= (selfcal_wide_t)self->n && (self->n > 0U || self->keep == 1.0);
    }
    return self->weight < 9e15 && (uint32_t)(uint64_t)self->weight == self->n;
}

/* One batch is gathered and never full: then it is handed over. The other waits for the nodes or is empty. */
static bool batches_are_sound(const selfcal_t *self) {
    if (self->gathering > 1U) {
        return false;
    }
    const selfcal_batch_t *gathered = &self->batch[self->gathering], *waits = &self->batch[1U - self->gathering];
    if (gathered->count >= SELFCAL_BATCH || gathered->gap_after > 0U || waits->count > SELFCAL_BATCH ||
        self->ran >= self->model->nodes || (self->ran > 0U && waits->count == 0U && waits->gap_after == 0U) ||
        self->push_nodes == 0U || !(self->keep > 0.0) || !(self->keep <= 1.0) || !(self->weight >= 0.0) ||
        !(self->beginning >= 0.0) || !(self->beginning <= 1.0) || (self->n > 0U && !(self->weight > 0.0)) ||
        !weight_is_sound(self)) {
        return false;
    }
    /* time before the first sample is no gap */
    if (self->n == 0U && (waits->count > 0U      ? waits->gap[0]
                          : gathered->count > 0U ? gathered->gap[0]
                                                 : self->pending_gap) > 0U) {
        return false;
    }
    return batch_is_sound(self, gathered) && batch_is_sound(self, waits);
}

static bool intake_is_sound(const selfcal_t *self) {
    const selfcal_counters_t *count = &self->counters;
    const selfcal_real_t ratio_max = (selfcal_real_t)SELFCAL_VARIANCE_RATIO_MAX;
    if (self->position >= self->block || self->used > self->position || self->started != (count->samples > 0U) ||
        (!self->started && (self->position > 0U || self->in_gap)) || count->samples < self->used ||
        selfcal_count(self) > count->samples - self->used || count->samples - self->used < self->within_dof ||
        count->blocks_part > selfcal_count(self) || (self->in_gap && count->gaps == 0U) ||
        (self->dropped && self->used > 0U) || !within(self->variance_ratio, R(1.0) / ratio_max, ratio_max) ||
        self->retired >= (1UL << self->model->axes) - 1U) { /* the last axis is never retired */
        return false;
    }
    for (uint8_t axis = 0; axis < self->model->axes; axis++) {
        if (self->bad[axis] > self->watched || !isfinite(self->last[axis]) || !isfinite(self->shifted[axis]) ||
            !isfinite(self->usual.level[axis]) || !(self->usual.limit[axis] >= 0.0F) ||
            !isfinite(self->prior_mean[axis]) || !(self->prior_sd[axis] > 0.0F) || !isfinite(self->prior_sd[axis])) {
            return false;
        }
        if (!selfcal_retired(self, axis) &&
            (!isfinite(self->origin[axis]) || !isfinite(self->offset[axis]) || !selfcal_intake_sound(self, axis) ||
             !(self->within[axis] >= 0.0) || !isfinite(self->within[axis]))) {
            return false;
        }
    }
    return true;
}

/* Both or neither: the model's regressors and their sums. */
static bool regressors_are_sound(const selfcal_t *self) {
    const selfcal_regressors_t *regressors = self->model->regressors;
    return (self->columns == NULL) == (regressors == NULL) && (regressors == NULL || regressors->code->sound(self));
}

/* Likewise of the laws that are sums. */
static bool states_are_sound(const selfcal_t *self) {
    const bool none = sum_nodes(self->model) == 0U;
    return (self->terms == NULL) == none && (none || (self->model->states != NULL && self->model->states->sound(self)));
}

/* The node that the kernel takes as the i-th; `sum`: of such a law. */
static bool node_is_sound(const selfcal_t *self, size_t i, bool sum) {
    const size_t j = kernel_node(self, i);
    const selfcal_node_t *node = &self->node[j];
    if (!is_bool(&node->level)) {
        return false;
    }
    const selfcal_moving_t now = moving_of(node);
    if ((self->n > 0U || i < self->ran) && (now.c == R(0.0)) != sum) { /* by that it is known, see is_state_node() */
        return false;
    }
    /* Some may have run over the batch that waits. */
    const uint32_t seen = self->n + (self->ran > 0U ? self->batch[1U - self->gathering].count : 0U);
    /* P' = phi^2 r P/(r + P) + q: q <= P at any time, and with r = 1 P' < 1 + q */
    if (!within(node->beta, R(0.0), BETA_MAX) || !within(node->q, R(0.0), Q_MAX) ||
        !within(node->p_inf, node->q * (R(1.0) - SLACK), (R(1.0) + node->q) * (R(1.0) + SLACK)) ||
        !within(now.c, R(0.0), R(1.0)) || !within(now.d, -P_MAX, P_MAX) ||
        node->p_inf + now.d < node->q - SLACK * node->p_inf - LEAST || !within(node->u_inf, R(0.0), R(1.0)) ||
        !within(node->u_inf + now.e, -SLACK, R(1.0) + SLACK) ||
        (node->level ? now.d != R(0.0) || now.e != R(0.0) : node->level_from > 0U) || node->level_from > node->steady ||
        node->steady > seen || !finite_sum(node->a) || !(node->a.hi >= R(0.0)) || !finite_sum(node->ln_s)) {
        return false;
    }
    return selfcal_kernel_node_sound(self, j);
}

/* Whether nodes a step apart lie between two limits, but for rounding. */
static bool nodes_within(const selfcal_grid_t *grid, selfcal_real_t first, selfcal_real_t step, selfcal_real_t lo,
                         selfcal_real_t hi) {
    const selfcal_real_t last = first + step * (selfcal_real_t)(grid_nodes(grid) - 1U), slack = R(1e-3);
    return grid == NULL || (step > R(0.0) && within(first, lo - slack, hi) && within(last, lo, hi + slack));
}

/* The nodes have a place once the first batch waits for them. */
static bool grid_is_sound(const selfcal_t *self) {
    for (uint8_t h = 0; h < self->model->hypotheses; h++) {
        const selfcal_hypothesis_t *hypothesis = &self->model->hypothesis[h];
        selfcal_real_t lo = INFINITY, hi = -INFINITY; /* of alpha, over the axes */
        for (uint8_t axis = 0; axis < self->model->axes; axis++) {
            const selfcal_prior_t *prior = &priors_of(self->model, hypothesis, axis)[SELFCAL_ALPHA];
            lo = r_fmin(lo, (selfcal_real_t)prior->ln_min);
            hi = r_fmax(hi, (selfcal_real_t)prior->ln_max);
        }
        if (!isfinite(self->rho_lo[h]) || !isfinite(self->alpha_lo[h]) ||
            !nodes_within(hypothesis->rho, self->rho_lo[h], self->rho_step[h], LN_RHO_MIN, LN_RHO_MAX) ||
            !nodes_within(hypothesis->alpha, self->alpha_lo[h], self->alpha_step[h], lo, hi)) {
            return false;
        }
    }
    return true;
}

selfcal_status_t selfcal_check(const selfcal_t *self) {
    if (self == NULL) {
        return SELFCAL_BAD_ARGUMENT;
    }
    if (!flags_are_bools(self) || !memory_is_laid_out(self) || !batches_are_sound(self) || !intake_is_sound(self) ||
        !selfcal_kernel_sound(self) || !regressors_are_sound(self) || !states_are_sound(self)) {
        return SELFCAL_CORRUPT;
    }
    const selfcal_batch_t *waits = &self->batch[1U - self->gathering];
    if ((self->n > 0U || waits->count > 0U || waits->gap_after > 0U) && !grid_is_sound(self)) {
        return SELFCAL_CORRUPT;
    }
    size_t i = 0;
    for (uint8_t h = 0; h < self->model->hypotheses; h++) {
        const selfcal_hypothesis_t *hypothesis = &self->model->hypothesis[h];
        for (const size_t end = i + hypothesis_nodes(hypothesis); i < end; i++) {
            if (!node_is_sound(self, i, is_sum(hypothesis->law))) {
                return SELFCAL_CORRUPT;
            }
        }
    }
    return SELFCAL_OK;
}
