/* The calibration by rests in several positions, in the pipe (tumble.h).
 *
 * A rest is the mean of the gate's windows that are at rest from begin to end: the window in which motion begins is
 * dropped, and one with a reading that the bank's intake finds wrong. Gyros may rest at another level in each position,
 * by their g-sensitivity: the gate forgets the last one.
 *
 * The result corrects accelerometers by f = T K (a - b), whose variance is J C J' of its covariance C. Residuals beyond
 * their sd widen it. A gyro's bias is the bank's, learned at rest under a specific force f0: the accelerometers' biases
 * of the last reports. So G (f - f0) is taken off as well. After a new attitude at rest both follow in their own time.
 *
 * Saved: magic with its format, selfcal_tumbled_t as it lies in memory, CRC-32 of all before. */
#include "tumble.h"

#include "imu.h"
#include "selfcal_frames.h"

SELFCAL_STATIC_ASSERT(there_is_room_for_every_position,
                      (unsigned)SELFCAL_TUMBLE_MAX >= (unsigned)SELFCAL_TUMBLE_POSITIONS);

/* rad/s per m/s^2 */
#define DEG_PER_S_PER_G (57.29577951F * 9.80665F)
#define MAGIC 0x31425446U /* "FTB1" */

typedef struct {
    uint32_t magic; /* and format */
    selfcal_tumbled_t used;
    uint32_t crc;
} saved_t;

static void begin_tumble(selfcal_imu_t *imu) {
    memset(imu->tumble, 0, sizeof *imu->tumble);
    imu->tumble->progress.next = SELFCAL_TUMBLE_POSITIONS;
}

/* --- rests --- */

static void end_rest(selfcal_imu_tumble_t *self) {
    self->ended = self->progress.rests;
    self->resting = self->counted = false;
    self->window = self->kept = 0U;
}

/* The window in progress is dropped: the gate may have begun another one. The next sample tells if rest has ended. */
static void skip(selfcal_imu_t *imu, uint64_t count) {
    imu->tumble->passed += (uint32_t)count;
    imu->tumble->resting = false;
    imu->tumble->window = 0U;
}

/* A window of rest has ended: the gate's sums still have it. */
static void keep_window(selfcal_imu_t *imu) {
    selfcal_imu_tumble_t *self = imu->tumble;
    const selfcal_tumbling_t *table = imu->pipe->tumbling;
    const selfcal_gate_t *gate = &imu->gate->gate;
    const float n = (float)self->window, rate = imu->pipe->rate_hz;
    self->kept += self->window;
    selfcal_tumble_rest_t *rest = &self->rest[self->ended];
    rest->begin_s = (float)(self->passed - self->kept) / rate;
    rest->end_s = (float)self->passed / rate;
    for (size_t i = 0; i < 6U; i++) {
        const uint8_t axis = table->axis[i];
        const float mean = gate->origin[axis] + gate->first[axis] + (float)gate->sum[axis] / n;
        const float own = (mean - imu->bank.shifted[axis]) * (i < 3U ? table->accel_unit : table->gyro_unit);
        rest->mean[i] += (own - rest->mean[i]) * (n / (float)self->kept);
    }
    if (!self->counted && (float)self->kept >= SELFCAL_TUMBLE_REST_S * rate) {
        self->counted = self->due = true;
        self->progress.rests++;
    }
}

static bool take_sample(selfcal_imu_t *imu, const float reading[]) {
    selfcal_imu_tumble_t *self = imu->tumble;
    selfcal_gate_t *gate = &imu->gate->gate;
    if (self->progress.phase == SELFCAL_TUMBLE_OFF) {
        return false;
    }
    (void)selfcal_push_moving(&imu->bank, reading);
    self->passed++;
    if (gate->state != SELFCAL_RESTING) {
        gate->rested = false;
        end_rest(self);
        self->progress.phase = SELFCAL_TUMBLE_PLACE;
        return true;
    }
    self->window += self->resting ? 1U : 0U;
    if (gate->position == 0U) {
        /* what passes is missing to the bank, but for wrong readings */
        const uint32_t faults = self->passed - (uint32_t)imu->bank.counters.missing;
        if (self->window > 0U && faults == self->faults && self->ended < SELFCAL_TUMBLE_MAX) {
            keep_window(imu);
        }
        self->window = 0U;
        self->faults = faults;
        self->resting = true; /* from a window's begin on */
    }
    self->progress.phase = self->counted ? SELFCAL_TUMBLE_TURN : SELFCAL_TUMBLE_HOLD;
    return true;
}

/* --- commands --- */

bool selfcal_imu_tumble_start(selfcal_imu_t *imu) {
    selfcal_imu_tumble_t *self = imu->tumble;
    const bool able = self != NULL && imu->watching && imu->bank.retired == 0U;
    if (able) {
        self->passed = 0U;
        self->progress.rests = 0U;
        end_rest(self);
        self->progress.status = SELFCAL_TUMBLE_OK;
        self->progress.phase = SELFCAL_TUMBLE_PLACE;
        self->due = true;
    }
    return able;
}

/* The result in use from here on. A parameter that is not identified has error 0. */
static void use(selfcal_imu_tumble_t *self) {
    const selfcal_tumble_t *found = &self->found;
    selfcal_tumbled_t *used = &self->used;
    /* The lines that come nearest at 1 g: where a scale has a square, `accel` is its slope at 0 g. */
    const float straight[SELFCAL_TUMBLE_ACCEL] = {
        found->bias[0],
        found->bias[1],
        found->bias[2],
        found->matrix[0][0] - 1.0F,
        found->matrix[1][1] - 1.0F,
        found->matrix[2][2] - 1.0F,
        found->matrix[0][1] / found->matrix[1][1],
        found->matrix[0][2] / found->matrix[2][2],
        found->matrix[1][2] / found->matrix[2][2],
    };
    for (size_t i = 0; i < SELFCAL_TUMBLE_ACCEL; i++) {
        used->accel[i] = (found->accel_identified >> i & 1U) != 0U ? straight[i] : 0.0F;
    }
    memcpy(used->covariance, found->accel_covariance, sizeof used->covariance);
    memcpy(used->G, found->G, sizeof used->G);
    used->ratio = found->ratio > 0.0F ? found->ratio : 0.0F; /* NAN: 0 */
    used->accel_identified = found->accel_identified;
    used->gyro_identified = found->gyro_identified;
    self->progress.applied = true;
}

selfcal_tumble_status_t selfcal_imu_tumble_stop(selfcal_imu_t *imu) {
    selfcal_imu_tumble_t *self = imu->tumble;
    if (self == NULL || self->progress.phase == SELFCAL_TUMBLE_OFF) {
        return SELFCAL_TUMBLE_BAD_ARGUMENT;
    }
    selfcal_tumble_progress_t *progress = &self->progress;
    progress->status =
        selfcal_tumble(&self->found, &imu->pipe->tumbling->part, self->rest, progress->rests, &self->by.work);
    /* Fewer positions, or positions alike, are no reason to lose what is known. */
    const uint16_t before = progress->applied ? self->used.accel_identified : 1U;
    if (progress->status == SELFCAL_TUMBLE_OK && (before & ~(unsigned)self->found.accel_identified) != 0U) {
        progress->status = SELFCAL_TUMBLE_NOTHING;
    }
    if (progress->status == SELFCAL_TUMBLE_OK) {
        use(self);
    }
    progress->phase = SELFCAL_TUMBLE_OFF;
    progress->next = SELFCAL_TUMBLE_POSITIONS;
    self->due = false;
    return progress->status;
}

/* By how much residuals beyond their sd widen an sd. */
static float widening(const selfcal_tumbled_t *used) {
    return used->ratio > 1.0F ? used->ratio : 1.0F;
}

/* Variance of `w` f by the covariance of the parameters: x is a - b, u K (a - b). */
static float variance_of(const float accel[], const float *covariance, const float x[3], const float u[3],
                         const float w[3]) {
    float slope[SELFCAL_TUMBLE_ACCEL] = {0.0F}, sum = 0.0F;
    for (size_t i = 0; i < 3U; i++) {
        for (size_t j = i; j < 3U; j++) {
            const float part = i == j ? w[i] : w[i] * accel[5U + i + j]; /* xy xz yz */
            slope[j] -= part * (1.0F + accel[3U + j]);
            slope[3U + j] += part * x[j];
            if (i != j) {
                slope[5U + i + j] = w[i] * u[j];
            }
        }
    }
    for (size_t a = 0; a < SELFCAL_TUMBLE_ACCEL; a++) {
        for (size_t b = 0; b <= a; b++) {
            sum += (a == b ? 1.0F : 2.0F) * slope[a] * slope[b] * *covariance++;
        }
    }
    return sum;
}

/* The position whose |f| is least known: w is its direction. */
static uint8_t next_of(const selfcal_imu_tumble_t *self, const float *covariance, float gravity) {
    static const int8_t up[SELFCAL_TUMBLE_POSITIONS][3] = {{0, 0, 1},  {0, 1, 0},  {1, 0, 0}, {0, 0, -1},
                                                           {0, -1, 0}, {-1, 0, 0}, {1, 1, 0}, {1, -1, 0},
                                                           {1, 0, 1},  {-1, 0, 1}, {0, 1, 1}, {0, -1, 1}};
    float most = 0.0F;
    uint8_t next = 0;
    for (unsigned p = 0; p < SELFCAL_TUMBLE_POSITIONS; p++) {
        float w[3], f[3];
        for (size_t i = 0; i < 3U; i++) {
            w[i] = (float)up[p][i] * (p < 6U ? 1.0F : 0.70710678F);
            f[i] = gravity * w[i];
        }
        const float variance = variance_of(self->used.accel, covariance, f, f, w);
        if (variance > 1.0001F * most) { /* of equal ones the first */
            most = variance;
            next = (uint8_t)p;
        }
    }
    return next;
}

const selfcal_tumble_progress_t *selfcal_imu_tumble_progress(selfcal_imu_t *imu) {
    selfcal_imu_tumble_t *self = imu->tumble;
    selfcal_tumble_progress_t *progress = &self->progress;
    if (self->due) {
        const selfcal_tumble_part_t *part = &imu->pipe->tumbling->part;
        const uint8_t rests = progress->rests;
        float *const covariance = self->found.accel_covariance; /* free until the end */
        const uint16_t known = selfcal_tumble_known(part, self->rest, rests, &self->by.work, covariance);
        const bool all = known == (1U << SELFCAL_TUMBLE_ACCEL) - 1U, most = rests == SELFCAL_TUMBLE_MAX;
        progress->wanted = SELFCAL_TUMBLE_POSITIONS;
        progress->next = next_of(self, covariance, part->gravity);
        if (rests >= SELFCAL_TUMBLE_POSITIONS) {
            progress->wanted = all || most ? rests : (uint8_t)(rests + 1U);
            progress->next = all || most ? (uint8_t)SELFCAL_TUMBLE_POSITIONS : progress->next;
        }
        self->due = false;
    }
    return progress;
}

const uint32_t *selfcal_imu_tumble_words(selfcal_imu_t *imu, uint32_t *there) {
    const selfcal_tumble_progress_t *p = selfcal_imu_tumble_progress(imu);
    const selfcal_tumbled_t *used = &imu->tumble->used;
    uint32_t *const word = imu->tumble->by.word;
    *there = 1U;
    word[0] = (uint32_t)p->phase << SELFCAL_TUMBLE_PHASE_SHIFT | (uint32_t)p->applied << SELFCAL_TUMBLE_APPLIED_SHIFT |
              (uint32_t)p->status << SELFCAL_TUMBLE_RESULT_SHIFT | (uint32_t)p->rests << SELFCAL_TUMBLE_RESTS_SHIFT |
              (uint32_t)p->wanted << SELFCAL_TUMBLE_WANTED_SHIFT | (uint32_t)p->next << SELFCAL_TUMBLE_NEXT_SHIFT;
    if (!p->applied) {
        return word;
    }
    const float wider = widening(used);
    memcpy(&word[SELFCAL_TUMBLE_BIAS_X - 1], used->accel, sizeof used->accel);
    for (size_t i = 0; i < SELFCAL_TUMBLE_ACCEL; i++) {
        word[SELFCAL_TUMBLE_BIAS_X_SD - 1U + i] = float_bits(sqrtf(used->covariance[i * (i + 3U) / 2U]) * wider);
    }
    const uint32_t known = used->accel_identified;
    *there |= known << (SELFCAL_TUMBLE_BIAS_X - 1) | known << (SELFCAL_TUMBLE_BIAS_X_SD - 1);
    for (size_t i = 0; i < 9U; i++) {
        word[SELFCAL_TUMBLE_G_XX - 1U + i] = float_bits(used->G[i] * DEG_PER_S_PER_G);
    }
    for (unsigned axis = 0; axis < 3U; axis++) {
        *there |= (used->gyro_identified >> (SELFCAL_TUMBLE_GYRO * axis + 1U) & 7U)
                  << (SELFCAL_TUMBLE_G_XX - 1U + 3U * axis);
    }
    word[SELFCAL_TUMBLE_RESIDUALS - 1] = float_bits(used->ratio);
    *there |= 1UL << (SELFCAL_TUMBLE_RESIDUALS - 1);
    return word;
}

const selfcal_tumbled_t *selfcal_imu_tumbled(const selfcal_imu_t *imu) {
    return imu->tumble != NULL && imu->tumble->progress.applied ? &imu->tumble->used : NULL;
}

/* --- correction --- */

/* f = T K x, u = K x. */
static void turn(const float accel[], const float x[3], float u[3], float f[3]) {
    for (size_t i = 0; i < 3U; i++) {
        f[i] = u[i] = (1.0F + accel[3U + i]) * x[i];
    }
    f[0] += accel[6] * u[1] + accel[7] * u[2];
    f[1] += accel[8] * u[2];
}

static void correct(const selfcal_imu_t *imu, selfcal_corrected_t *corrected) {
    const selfcal_tumbling_t *table = imu->pipe->tumbling;
    const selfcal_tumbled_t *used = &imu->tumble->used;
    const uint32_t spoils = 1U << SELFCAL_REASON_RETIRED | 1U << SELFCAL_REASON_STUCK | 1U << SELFCAL_REASON_BAD_SAMPLE;
    float x[3], u[3], f[3], moved[3], turned[3];
    uint32_t why = 0;
    if (!imu->tumble->progress.applied) {
        return;
    }
    for (size_t i = 0; i < 3U; i++) {
        const uint8_t axis = table->axis[i];
        const float reading = imu->kept->reading[axis];
        x[i] = (reading - imu->bank.shifted[axis]) * table->accel_unit - used->accel[i];
        moved[i] = (reading - imu->bias[axis]) * table->accel_unit;
        why |= 1U << corrected->reason[axis]; /* each force has a part of every reading */
    }
    const float unit = (why & spoils) != 0U ? NAN : 1.0F / table->accel_unit, wide = unit * widening(used);
    turn(used->accel, moved, u, turned);
    turn(used->accel, x, u, f);
    for (size_t i = 0; i < 3U; i++) {
        const uint8_t axis = table->axis[i];
        float w[3] = {0.0F};
        w[i] = wide;
        corrected->value[axis] = f[i] * unit;
        corrected->sd[axis] = sqrtf(variance_of(used->accel, used->covariance, x, u, w));
        if ((why & spoils) == 0U) {
            corrected->reason[axis] = SELFCAL_REASON_NONE;
        }
        for (size_t j = 0; isfinite(turned[0]) && j < 3U; j++) { /* it has a part of all three */
            corrected->value[table->axis[3U + i]] -= used->G[3U * i + j] * turned[j] / table->gyro_unit;
        }
    }
}

/* --- saved state --- */

static bool save(const selfcal_imu_t *imu, selfcal_write_t write, void *context) {
    saved_t saved;
    if (!imu->tumble->progress.applied) {
        return true;
    }
    saved.magic = MAGIC;
    saved.used = imu->tumble->used;
    saved.crc = selfcal_crc32(0, (const uint8_t *)&saved, offsetof(saved_t, crc));
    return write(context, &saved, sizeof saved);
}

/* A result of an earlier call stays: the newest state is asked first. */
static selfcal_status_t restore(selfcal_imu_t *imu, const void *bytes, size_t *length) {
    saved_t saved;
    if (*length < sizeof saved) {
        return SELFCAL_OK;
    }
    memcpy(&saved, (const uint8_t *)bytes + (*length - sizeof saved), sizeof saved);
    if (saved.magic != MAGIC) {
        return SELFCAL_OK;
    }
    if (saved.crc != selfcal_crc32(0, (const uint8_t *)&saved, offsetof(saved_t, crc))) {
        return SELFCAL_SNAPSHOT_DAMAGED;
    }
    *length -= sizeof saved;
    if (!imu->tumble->progress.applied) {
        imu->tumble->used = saved.used;
        imu->tumble->progress.applied = true;
    }
    return SELFCAL_OK;
}

const selfcal_tumbling_code_t selfcal_tumbling_code = {
    sizeof(selfcal_imu_tumble_t), begin_tumble, skip, take_sample, correct, save, restore};
