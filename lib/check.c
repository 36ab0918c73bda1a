/* Invariants of a bank: what every push, skip and report leaves true, whatever came in. */
#include "kernel.h"

/* The prices that selfcal.h states. */
#ifndef SELFCAL_REAL_DOUBLE
SELFCAL_STATIC_ASSERT(bytes_a_node, SELFCAL_SIZE(1, 0) == 56);
#endif
#if SELFCAL_TERMS_MAX > 1 && !defined(SELFCAL_REAL_DOUBLE) && !defined(SELFCAL_FIXED)
SELFCAL_STATIC_ASSERT(bytes_a_node_of_a_sum, SELFCAL_TERMS_SIZE(2, 0, 2) - SELFCAL_TERMS_SIZE(1, 0, 2) == 104 + 24 * 2);
SELFCAL_STATIC_ASSERT(bytes_an_axis_of_a_sum, SELFCAL_TERMS_SIZE(1, 1, 2) - SELFCAL_TERMS_SIZE(1, 0, 2) == 24);
#endif
#ifndef SELFCAL_REAL_DOUBLE
SELFCAL_STATIC_ASSERT(bytes_a_node_and_axis, SELFCAL_SIZE(1, 1) - SELFCAL_SIZE(1, 0) == 20);
SELFCAL_STATIC_ASSERT(bytes_a_node_of_two_regressors,
                      SELFCAL_REGRESSORS_SIZE(2, 0, 2) - SELFCAL_REGRESSORS_SIZE(1, 0, 2) == 72); /* 4 (p + 1) (p + 4) */
#ifdef SELFCAL_FIXED
SELFCAL_STATIC_ASSERT(bytes_an_axis_of_two_regressors,
                      SELFCAL_REGRESSORS_SIZE(1, 1, 2) - SELFCAL_REGRESSORS_SIZE(1, 0, 2) == 40); /* 8 p + 24 */
#else
SELFCAL_STATIC_ASSERT(bytes_an_axis_of_two_regressors,
                      SELFCAL_REGRESSORS_SIZE(1, 1, 2) - SELFCAL_REGRESSORS_SIZE(1, 0, 2) == 20); /* 8 p + 4 */
#endif
#endif

/* No drift's variance per interval is greater, see LN_RHO_MAX. */
#define Q_MAX R(1e12)

/* No drift forgets more, see ALPHA_DT_MAX: 1 - e^-6.9. */
#define BETA_MAX R(0.999)

/* Beneath it a float is a denormal, whose rounding is not relative. */
#define LEAST R(1.2e-38)

/* No prior of drift and white noise, and no interval, puts a node lower. */
#define LN_RHO_MIN R(-120.0)

/* Room for rounding in quantities that are bounded by 1 or by each other. */
#define SLACK R(1e-5)

static bool flags_are_bools(const selfcal_t *self) {
#ifdef SELFCAL_FIXED
    if (!is_bool(&self->step_floored)) {
        return false;
    }
#endif
    return is_bool(&self->batch[0].part) && is_bool(&self->batch[1].part) && is_bool(&self->started) && is_bool(&self->dropped) &&
           is_bool(&self->in_gap);
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
    return self->b != NULL && self->c == self->b + cells && (const void *)self->node == (const void *)(self->c + cells) &&
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

/* What the samples count for: one each, or less where they are forgotten. */
static bool weight_is_sound(const selfcal_t *self) {
    if (self->model->forgetting != NULL) {
        return self->weight <= (selfcal_wide_t)self->n && (self->n > 0U || self->keep == 1.0); /* nothing to forget yet */
    }
    return self->keep == 1.0 && self->beginning == 1.0 && self->weight < 9e15 && (uint32_t)(uint64_t)self->weight == self->n;
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
        !(self->beginning >= 0.0) || !(self->beginning <= 1.0) ||
        (self->n > 0U && !(self->weight > 0.0)) || !weight_is_sound(self)) {
        return false;
    }
    /* time before the first sample is no gap */
    if (self->n == 0U && (waits->count > 0U ? waits->gap[0] : gathered->count > 0U ? gathered->gap[0] : self->pending_gap) > 0U) {
        return false;
    }
    return batch_is_sound(self, gathered) && batch_is_sound(self, waits);
}

/* A block's sums, see averager.c. */
#ifdef SELFCAL_FIXED
static bool sums_are_sound(const selfcal_t *self, uint8_t axis) {
    const selfcal_block_t *sums = &self->sums[axis];
    const int64_t most = (int64_t)self->used << 30;
    return sums->sum_sq >= 0 && sums->sum_sq <= most && sums->sum <= most && sums->sum >= -most && sums->first <= 1L << 26 &&
           sums->first >= -(1L << 26) && sums->shift <= 15U && sums->exponent >= -151 && sums->exponent <= 100;
}
#else
static bool sums_are_sound(const selfcal_t *self, uint8_t axis) {
    return isfinite(self->first[axis]) && isfinite(self->sum[axis]) && self->sum_sq[axis] >= R(0.0) && isfinite(self->sum_sq[axis]);
}
#endif

static bool averager_is_sound(const selfcal_t *self) {
    const selfcal_counters_t *count = &self->counters;
    const selfcal_real_t ratio_max = (selfcal_real_t)SELFCAL_VARIANCE_RATIO_MAX;
    if (self->position >= self->block || self->used > self->position || self->started != (count->samples > 0U) ||
        (!self->started && (self->position > 0U || self->in_gap)) || count->samples < self->used ||
        selfcal_count(self) > count->samples - self->used || count->samples - self->used < self->within_dof ||
        count->blocks_part > selfcal_count(self) || (self->in_gap && count->gaps == 0U) || (self->dropped && self->used > 0U) ||
        !within(self->variance_ratio, R(1.0) / ratio_max, ratio_max) ||
        self->retired >= (1UL << self->model->axes) - 1U) { /* the last axis is never retired */
        return false;
    }
    for (uint8_t axis = 0; axis < self->model->axes; axis++) {
        if (self->bad[axis] > self->watched || !isfinite(self->last[axis]) || !isfinite(self->shifted[axis])) {
            return false;
        }
        if (!selfcal_retired(self, axis) &&
            (!isfinite(self->origin[axis]) || !isfinite(self->offset[axis]) || !sums_are_sound(self, axis) ||
             !(self->within[axis] >= 0.0) || !isfinite(self->within[axis]))) {
            return false;
        }
    }
    return true;
}

/* What the kernel keeps, see kernel_float.c and kernel_fixed.c. */
#ifdef SELFCAL_FIXED

#define ROOM ((int64_t)1 << 62)
#define X_MAX (SELFCAL_FIXED_LIMIT + (1L << 24))

static bool scales_are_sound(const selfcal_t *self) {
    for (uint8_t axis = 0; axis < self->model->axes; axis++) {
        const selfcal_scale_t *scale = &self->scale[axis];
        if (scale->exponent < -200 || scale->exponent > 200 || scale->most_y < 0 || scale->most_sum < 0) {
            return false;
        }
        for (uint32_t i = 0; i < SELFCAL_BATCH; i++) {
            if (self->y_fixed[axis][i] > SELFCAL_FIXED_LIMIT || self->y_fixed[axis][i] < -SELFCAL_FIXED_LIMIT) {
                return false;
            }
        }
    }
    return selfcal_kernel_steps_sound(self);
}

/* A level node's numbers follow from its gains. */
static bool kernel_is_sound(const selfcal_t *self, size_t j) {
    const selfcal_node_t *node = &self->node[j];
    if (node->level) {
        selfcal_node_t settled = *node;
        selfcal_kernel_mantissas(&settled);
        if (settled.gains.settled.g != node->gains.settled.g || settled.gains.settled.u != node->gains.settled.u ||
            settled.gains.settled.w != node->gains.settled.w || settled.g_shift != node->g_shift || settled.u_shift != node->u_shift ||
            settled.w_shift != node->w_shift) {
            return false;
        }
    }
    const size_t axes = self->model->axes;
    for (size_t k = j * axes; k < (j + 1U) * axes; k++) {
        if (self->b[k] > ROOM || self->b[k] < -ROOM || self->c[k] < 0 || self->c[k] > ROOM ||
            self->x[k] > X_MAX || self->x[k] < -X_MAX) {
            return false;
        }
    }
    return true;
}

#else

static bool scales_are_sound(const selfcal_t *self) {
    (void)self;
    return true;
}

static bool kernel_is_sound(const selfcal_t *self, size_t j) {
    const size_t axes = self->model->axes;
    for (size_t k = j * axes; k < (j + 1U) * axes; k++) {
        if (!finite_sum(self->b[k]) || !finite_sum(self->c[k]) || !(self->c[k].hi >= R(0.0)) || !isfinite(self->x[k])) {
            return false;
        }
    }
    return true;
}

#endif

/* Both or neither: the model's regressors and their sums. */
static bool regressors_are_sound(const selfcal_t *self) {
    const selfcal_regressors_t *regressors = self->model->regressors;
    return (self->columns == NULL) == (regressors == NULL) && (regressors == NULL || regressors->code->sound(self));
}

/* Likewise of the laws that are sums. */
static bool terms_are_sound(const selfcal_t *self) {
#if SELFCAL_TERMS_MAX > 1
    return (self->terms == NULL) == (selfcal_terms_nodes(self->model) == 0U) && (self->terms == NULL || selfcal_terms_sound(self));
#else
    (void)self;
    return true;
#endif
}

/* The node that the kernel takes as the i-th; `sum`: of such a law. */
static bool node_is_sound(const selfcal_t *self, size_t i, bool sum) {
    const size_t j = kernel_node(self, i);
    const selfcal_node_t *node = &self->node[j];
    if (!is_bool(&node->level)) {
        return false;
    }
    const selfcal_moving_t now = moving_of(node);
    if ((self->n > 0U || i < self->ran) && (now.c == R(0.0)) != sum) { /* by that it is known, see selfcal_is_term_node() */
        return false;
    }
    /* Some may have run over the batch that waits. */
    const uint32_t seen = self->n + (self->ran > 0U ? self->batch[1U - self->gathering].count : 0U);
    /* P' = phi^2 r P/(r + P) + q: q <= P at any time, and with r = 1 P' < 1 + q */
    if (!within(node->beta, R(0.0), BETA_MAX) || !within(node->q, R(0.0), Q_MAX) ||
        !within(node->p_inf, node->q * (R(1.0) - SLACK), (R(1.0) + node->q) * (R(1.0) + SLACK)) ||
        !within(now.c, R(0.0), R(1.0)) || !within(now.d, -P_MAX, P_MAX) ||
        node->p_inf + now.d < node->q - SLACK * node->p_inf - LEAST ||
        !within(node->u_inf, R(0.0), R(1.0)) ||
        !within(node->u_inf + now.e, -SLACK, R(1.0) + SLACK) ||
        (node->level ? now.d != R(0.0) || now.e != R(0.0) : node->level_from > 0U) || node->level_from > node->steady ||
        node->steady > seen || !finite_sum(node->a) || !(node->a.hi >= R(0.0)) || !finite_sum(node->ln_s)) {
        return false;
    }
    return kernel_is_sound(self, j);
}

/* Whether nodes a step apart lie between two limits, but for rounding. */
static bool nodes_within(const selfcal_grid_t *grid, selfcal_real_t first, selfcal_real_t step, selfcal_real_t lo, selfcal_real_t hi) {
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
    if (!flags_are_bools(self) || !memory_is_laid_out(self) || !batches_are_sound(self) || !averager_is_sound(self) || !scales_are_sound(self) ||
        !regressors_are_sound(self) || !terms_are_sound(self)) {
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
