/* Front end: keeps bad samples out and averages `block` samples into one bank sample.
 *
 * A boxcar turns white noise of variance V into V/block and leaves slow drift as it is; drift faster than the block is
 * smoothed. Sums are taken about the block's first sample, so that gravity or a turn-on bias costs no digits. */
#include "internal.h"

static void start_block(selfcal_t *self) {
    self->position = 0;
    self->used = 0;
    memset(self->sum, 0, sizeof self->sum);
    memset(self->sum_sq, 0, sizeof self->sum_sq);
}

static void close_block(selfcal_t *self) {
    const uint32_t block = self->model->block;
    if (self->used * 2U < block) {
        self->counters.blocks_lost++;
        selfcal_bank_gap(self, 1U);
        start_block(self);
        return;
    }
    selfcal_real_t y[SELFCAL_AXES_MAX];
    const bool first = selfcal_count(self) == 0U;
    for (uint8_t axis = 0; axis < self->model->axes; axis++) {
        const selfcal_real_t mean = self->sum[axis] / (selfcal_real_t)self->used;
        const selfcal_real_t level = (selfcal_real_t)(self->first[axis] - self->origin[axis]) + mean;
        if (first) {
            self->offset[axis] = level;
        }
        y[axis] = level - self->offset[axis];
        self->within[axis] += (selfcal_wide_t)r_fmax(r_fma(-self->sum[axis], mean, self->sum_sq[axis]), R(0.0));
    }
    self->within_dof += self->used - 1U;
    if (self->used < block) {
        self->counters.blocks_part++;
    }
    selfcal_bank_sample(self, y, (selfcal_real_t)block / (selfcal_real_t)self->used);
    start_block(self);
}

/* Time passes by `count` samples without a value. */
static void pass(selfcal_t *self, uint64_t count) {
    if (!self->started || count == 0U) {
        return;
    }
    if (!self->in_gap) {
        self->counters.gaps++;
        self->in_gap = true;
    }
    const uint32_t block = self->model->block;
    const uint32_t left = block - self->position;
    if (count < left) {
        self->position += (uint32_t)count;
        return;
    }
    close_block(self);
    count -= left;
    const uint64_t whole = count / block;
    self->counters.blocks_lost += (uint32_t)whole;
    selfcal_bank_gap(self, whole);
    self->position = (uint32_t)(count % block);
}

selfcal_status_t selfcal_skip(selfcal_t *self, uint64_t count) {
    if (self == NULL) {
        return SELFCAL_BAD_ARGUMENT;
    }
    self->counters.missing += count;
    pass(self, count);
    return SELFCAL_OK;
}

/* Counts what is wrong with a sample; true if nothing is. */
static bool usable(selfcal_t *self, const float sample[]) {
    bool good = true;
    for (uint8_t axis = 0; axis < self->model->axes; axis++) {
        const selfcal_axis_t *limits = &self->model->axis[axis];
        const float value = sample[axis];
        if (!isfinite(value)) {
            self->counters.not_finite[axis]++;
            good = false;
            continue;
        }
        if (limits->range > 0.0F && fabsf(value) >= limits->range) {
            self->counters.saturated[axis]++;
            good = false;
        }
        self->equal[axis] = value == self->last[axis] ? self->equal[axis] + 1U : 1U;
        self->last[axis] = value;
        if (limits->stuck_limit > 0U && self->equal[axis] >= limits->stuck_limit) {
            self->counters.stuck[axis]++;
            good = false;
        }
    }
    return good;
}

selfcal_status_t selfcal_push(selfcal_t *self, const float sample[]) {
    if (self == NULL || sample == NULL) {
        return SELFCAL_BAD_ARGUMENT;
    }
    (void)selfcal_bank_run(self, self->push_nodes);
    if (!usable(self, sample)) {
        pass(self, 1U);
        return SELFCAL_OK;
    }
    const uint8_t axes = self->model->axes;
    self->in_gap = false;
    if (!self->started) {
        self->started = true;
        memcpy(self->origin, sample, axes * sizeof sample[0]);
    }
    if (self->used == 0U) {
        memcpy(self->first, sample, axes * sizeof sample[0]);
    }
    for (uint8_t axis = 0; axis < axes; axis++) {
        const selfcal_real_t from_first = (selfcal_real_t)sample[axis] - (selfcal_real_t)self->first[axis];
        self->sum[axis] += from_first;
        self->sum_sq[axis] = r_fma(from_first, from_first, self->sum_sq[axis]);
    }
    self->counters.samples++;
    self->used++;
    self->position++;
    if (self->position == self->model->block) {
        close_block(self);
    }
    return SELFCAL_OK;
}

const selfcal_counters_t *selfcal_counters(const selfcal_t *self) {
    return &self->counters;
}

float selfcal_within_sd(const selfcal_t *self, uint8_t axis) {
    SELFCAL_ASSERT(axis < self->model->axes);
    return self->within_dof > 0U ? (float)sqrt(self->within[axis] / (selfcal_wide_t)self->within_dof) : NAN;
}
