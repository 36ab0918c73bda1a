/* Front end: keeps bad samples and dead axes out and averages a block of samples into one bank sample.
 *
 * A boxcar turns white noise of variance V into V/block and leaves slow drift as it is; drift faster than the block is
 * smoothed. Sums are taken about the block's first sample, so that gravity or a turn-on bias costs no digits.
 *
 * Why no sum overflows a float while |sample| < L = SELFCAL_SAMPLE_MAX = 2^40: a block sums at most 2^32 squares of at
 * most 2 L about its first sample, 2^114 in all. Bank samples are differences of block means, |y| <= 2 L; the
 * prediction x is a weighted mean of such values and 0, so |nu| <= 4 L; s >= r >= 2^-10 (SELFCAL_VARIANCE_RATIO_MAX); a
 * record has at most 2^32 bank samples. So C = sum nu^2/s <= 2^(32 + 84 + 10) = 2^126 < FLT_MAX = 2^128, and B = sum u
 * nu/s is less (|u| <= 1). */
#include "bank_inside.h"

/* --- blocks --- */

/* Samples that tell an axis's scatter well enough, and how many outliers in a row are so: more are a step or a motion,
 * which is not for a sample to decide. */
#define OUTLIER_DOF 64U
#define OUTLIER_RUN 4U

static void start_block(selfcal_t *self) {
    self->position = 0;
    self->used = 0;
    self->dropped = false;
    selfcal_intake_start(self);
}

/* `count` bank intervals without a value. A counter that is at its end stays there. */
COLD static void lose_blocks(selfcal_t *self, uint64_t count) {
    const uint32_t room = UINT32_MAX - self->counters.blocks_lost;
    self->counters.blocks_lost += count < room ? (uint32_t)count : room;
    selfcal_bank_gap(self, count);
}

/* How far a sample of the next block may be from the level of this one, whose mean is uncertain too. */
static void set_limits(selfcal_t *self, const selfcal_real_t y[]) {
    const float sds = self->model->handling->outlier_sd * sqrtf(1.0F + 1.0F / (float)self->used);
    for (uint8_t axis = 0; axis < self->model->axes && self->within_dof >= OUTLIER_DOF; axis++) {
        self->usual.level[axis] = self->origin[axis] + (float)(self->offset[axis] + y[axis]);
        const float limit = sds * selfcal_within_sd(self, axis);
        self->usual.limit[axis] = limit > 0.0F ? limit : 0.0F; /* NaN of a retired axis: none */
    }
}

static void close_block(selfcal_t *self) {
    const uint32_t block = self->block;
    if (self->used < block - self->used) {
        lose_blocks(self, 1U);
        start_block(self);
        return;
    }
    selfcal_real_t y[SELFCAL_AXES_MAX];
    const bool first = selfcal_count(self) == 0U;
    for (uint8_t axis = 0; axis < self->model->axes; axis++) {
        if (selfcal_retired(self, axis)) {
            y[axis] = R(0.0); /* harmless to its filters, unseen by the others */
            continue;
        }
        selfcal_wide_t scatter;
        const selfcal_real_t level = selfcal_intake_level(self, axis, &scatter);
        if (first) {
            self->offset[axis] = level;
        }
        y[axis] = level - self->offset[axis];
        self->within[axis] += scatter;
    }
    self->within_dof += self->used - 1U;
    if (self->model->handling != NULL && self->model->handling->outlier_sd > 0.0F) {
        set_limits(self, y);
    }
    if (self->used < block) {
        self->counters.blocks_part++;
    }
    if (self->columns != NULL) {
        self->model->regressors->code->close(self);
    }
    selfcal_bank_sample(self, y, self->variance_ratio * ((selfcal_real_t)block / (selfcal_real_t)self->used));
    start_block(self);
}

static void open_gap(selfcal_t *self) {
    if (!self->in_gap) {
        self->counters.gaps++;
        self->in_gap = true;
    }
}

/* Time passes by `count` samples without a value: missing ones, or one at fault. */
COLD static void pass(selfcal_t *self, bool missing, uint64_t count) {
    if (missing) {
        const uint64_t room = UINT64_MAX - self->counters.missing;
        self->counters.missing += count < room ? count : room;
    }
    if (!self->started || count == 0U) {
        return;
    }
    open_gap(self);
    const uint32_t block = self->block;
    const uint32_t left = block - self->position;
    if (count < left) {
        self->position += (uint32_t)count;
        return;
    }
    close_block(self);
    count -= left;
    const uint64_t whole = count / block;
    lose_blocks(self, whole);
    self->position = (uint32_t)(count % block);
}

selfcal_status_t selfcal_skip(selfcal_t *self, uint64_t count) {
    if (self == NULL) {
        return SELFCAL_BAD_ARGUMENT;
    }
    pass(self, true, count);
    return SELFCAL_OK;
}

/* Forgets what the block in progress holds; the rest of it will pass without a value. False where nothing of it has
 * passed, or that has been done. */
static bool drop_block(selfcal_t *self) {
    const uint32_t position = self->position;
    memset(&self->usual, 0, sizeof self->usual); /* the level may have changed */
    if (position == 0U || self->dropped) {
        return false;
    }
    open_gap(self);
    start_block(self);
    self->position = position;
    self->dropped = true;
    return true;
}

selfcal_status_t selfcal_moving(selfcal_t *self) {
    if (self == NULL) {
        return SELFCAL_BAD_ARGUMENT;
    }
    if (drop_block(self)) {
        self->counters.blocks_moving++;
    }
    return SELFCAL_OK;
}

selfcal_status_t selfcal_rate(selfcal_t *self, uint32_t block, float variance_ratio) {
    if (self == NULL || block == 0U || !(variance_ratio >= 1.0F / SELFCAL_VARIANCE_RATIO_MAX) ||
        !(variance_ratio <= SELFCAL_VARIANCE_RATIO_MAX)) {
        return SELFCAL_BAD_ARGUMENT;
    }
    (void)drop_block(self);
    /* the same part of the interval has passed */
    self->position = (uint32_t)((uint64_t)self->position * block / self->block);
    selfcal_bank_pace(self, block);
    self->variance_ratio = (selfcal_real_t)variance_ratio;
    memset(self->within, 0, sizeof self->within);
    self->within_dof = 0;
    return SELFCAL_OK;
}

selfcal_status_t selfcal_shift(selfcal_t *self, uint8_t axis, float amount) {
    if (self == NULL || axis >= self->model->axes || !(fabsf(amount) < SELFCAL_SAMPLE_MAX) ||
        !(fabsf(self->shifted[axis] + amount) < SELFCAL_SAMPLE_MAX)) {
        return SELFCAL_BAD_ARGUMENT;
    }
    self->shifted[axis] += amount;
    self->prior_mean[axis] += amount;
    if (selfcal_retired(self, axis)) {
        return SELFCAL_OK;
    }
    (void)drop_block(self);
    if (self->started) {
        const float before = self->origin[axis], sum = before + amount;
        const float part = sum - before;
        /* of the sum's rounding, exactly (Knuth's TwoSum) */
        const float lost = (before - (sum - part)) + (amount - part);
        self->origin[axis] = sum;
        self->offset[axis] += (selfcal_real_t)lost;
    }
    return SELFCAL_OK;
}

float selfcal_shifted(const selfcal_t *self, uint8_t axis) {
    SELFCAL_ASSERT(axis < self->model->axes);
    return self->shifted[axis];
}

/* Bits of a float without its sign: they order as the numbers do, infinity and not-a-number at the top. */
#define MAGNITUDE 0x7FFFFFFFU
#define INFINITE 0x7F800000U

/* Counts what is wrong with a sample; a bit for each axis at fault. By the bits of the values, since a comparison in
 * software floating point is a call. */
static uint32_t faults(selfcal_t *self, const float sample[]) {
    uint32_t bad = 0;
    for (uint8_t axis = 0; axis < self->model->axes; axis++) {
        const selfcal_axis_t *limits = &self->model->axis[axis];
        const uint32_t value = float_bits(sample[axis]), last = float_bits(self->last[axis]),
                       range = float_bits(limits->range);
        const uint32_t magnitude = value & MAGNITUDE;
        /* range > 0 */
        if (magnitude >= float_bits(SELFCAL_SAMPLE_MAX) || (range - 1U < INFINITE && magnitude >= range)) {
            bad |= 1U << axis;
            if (magnitude >= INFINITE) {
                self->counters.not_finite[axis]++;
                continue;
            }
            self->counters.saturated[axis]++;
        }
        const bool equal = value == last || ((value | last) & MAGNITUDE) == 0U; /* -0 is 0 */
        self->equal[axis] = equal ? self->equal[axis] + 1U : 1U;
        self->last[axis] = sample[axis];
        if (limits->stuck_limit > 0U && self->equal[axis] >= limits->stuck_limit) {
            self->counters.stuck[axis]++;
            bad |= 1U << axis;
        }
    }
    return bad;
}

/* Counts samples far from the level of the block before; a bit for each axis with one. */
static uint32_t outliers(selfcal_t *self, const float sample[], uint32_t live) {
    uint32_t odd = 0;
    for (uint8_t axis = 0; axis < self->model->axes; axis++) {
        selfcal_usual_t *usual = &self->usual;
        const bool far = (live >> axis & 1U) != 0U && usual->limit[axis] > 0.0F &&
                         fabsf(sample[axis] - usual->level[axis]) > usual->limit[axis];
        if (!far) {
            usual->run[axis] = 0;
        } else if (usual->run[axis] < OUTLIER_RUN) {
            usual->run[axis]++;
            if (self->counters.outliers[axis] < UINT16_MAX) {
                self->counters.outliers[axis]++;
            }
            odd |= 1U << axis;
        }
    }
    return odd;
}

/* Retires the axes that keep the others waiting. `bad`, `live`: axes at fault, and not yet retired. Only samples in
 * which some live axis is sound are counted: where all fail (the sensor unplugged) nobody is kept waiting by
 * anybody. */
static void retire(selfcal_t *self, uint32_t bad, uint32_t live) {
    if (bad == live) {
        return;
    }
    const uint8_t axes = self->model->axes;
    for (uint8_t axis = 0; bad != 0U && axis < axes; axis++) {
        self->bad[axis] += bad >> axis & 1U;
    }
    self->watched++;
    if (self->watched < self->block) {
        return;
    }
    for (uint8_t axis = 0; axis < axes; axis++) {
        const bool mostly = self->bad[axis] > self->watched - self->bad[axis];
        self->bad_blocks[axis] = (uint16_t)(mostly ? self->bad_blocks[axis] + 1U : 0U);
        if (SELFCAL_RETIRE_BLOCKS > 0 && self->bad_blocks[axis] >= SELFCAL_RETIRE_BLOCKS && live != 1U << axis) {
            live &= ~(1U << axis); /* but never the last one */
            self->retired |= 1U << axis;
        }
        self->bad[axis] = 0;
    }
    self->watched = 0;
}

/* Whether this push runs some nodes: every one, or every SELFCAL_PUSH_EVERY-th if that is in time twice over. */
static bool nodes_are_due(const selfcal_t *self) {
    return (self->position & (SELFCAL_PUSH_EVERY - 1U)) == 0U || self->block < SELFCAL_PUSH_EVERY ||
           (uint64_t)self->block * SELFCAL_BATCH < (uint64_t)2U * SELFCAL_PUSH_EVERY * self->model->nodes;
}

void selfcal_take(selfcal_t *self, const float sample[], const float regressors[], bool moving) {
    if (nodes_are_due(self)) {
        (void)selfcal_bank_run(self, self->push_nodes);
    }
    const uint8_t axes = self->model->axes;
    const uint32_t live = ((1U << axes) - 1U) & ~self->retired;
    const uint32_t bad = faults(self, sample) & live;
    retire(self, bad, live);
    const bool known = moving || self->columns == NULL || self->model->regressors->code->usable(self, regressors);
    const bool handles = self->model->handling != NULL && !moving && bad == 0U;
    const bool sound = bad == 0U && known && (!handles || outliers(self, sample, live) == 0U);
    if (!sound || moving || self->dropped) {
        pass(self, sound, 1U);
        return;
    }
    self->in_gap = false;
    if (!self->started) {
        self->started = true;
        for (uint8_t axis = 0; axis < axes; axis++) {
            self->origin[axis] = selfcal_retired(self, axis) ? 0.0F : sample[axis];
        }
    }
    selfcal_intake_add(self, sample, live);
    if (self->columns != NULL) {
        self->model->regressors->code->add(self, regressors);
    }
    self->counters.samples++;
    self->used++;
    self->position++;
    if (self->position == self->block) {
        close_block(self);
    }
}

selfcal_status_t selfcal_push(selfcal_t *self, const float sample[]) {
    return selfcal_push_with(self, sample, NULL);
}

selfcal_status_t selfcal_push_with(selfcal_t *self, const float sample[], const float regressors[]) {
    if (self == NULL || sample == NULL || (self->columns != NULL && regressors == NULL)) {
        return SELFCAL_BAD_ARGUMENT;
    }
    selfcal_take(self, sample, regressors, false);
    return SELFCAL_OK;
}

const selfcal_counters_t *selfcal_counters(const selfcal_t *self) {
    return &self->counters;
}

float selfcal_within_sd(const selfcal_t *self, uint8_t axis) {
    SELFCAL_ASSERT(axis < self->model->axes);
    return self->within_dof > 0U && !selfcal_retired(self, axis)
               ? (float)sqrt(self->within[axis] / (selfcal_wide_t)self->within_dof)
               : NAN;
}
