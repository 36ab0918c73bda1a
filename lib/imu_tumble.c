/* The calibration by rests in several positions, in the pipe (tumble.h).
 *
 * A rest is the mean of the whole windows in which the gate sees rest from begin to end: the window in which motion
 * begins is dropped, and one with a reading that is no number or beyond its range. Sums are taken about a rest's first
 * sample. Gyros may rest at another level in each position, by their g-sensitivity: the gate forgets the last one.
 *
 * The result corrects accelerometers by f = T K (a - b), whose variance is J C J' of its covariance C. Residuals beyond
 * their sd widen it. A gyro's bias is the bank's. It holds where the gate saw rest last, at the specific force f0, so
 * G (f - f0) is taken off as well.
 *
 * Saved: magic, format and bytes, selfcal_tumbled_t as it lies in memory, CRC-32 of all before. */
#include "tumble.h"

#include "imu.h"
#include "selfcal_frames.h"

/* rad/s per m/s^2 */
#define DEG_PER_S_PER_G (57.29577951F * 9.80665F)
#define SAVED_FORMAT 1U

typedef struct {
    uint8_t magic[4];
    uint32_t format; /* and the size */
    selfcal_tumbled_t used;
    uint32_t crc;
} saved_t;

static const uint8_t magic[4] = {'S', 'F', 'T', 'B'};
enum { FORMAT = (int)(SAVED_FORMAT << 16) + (int)sizeof(saved_t) };

static bool begin(selfcal_imu_t *imu) {
    const selfcal_tumbling_t *table = imu->pipe->tumbling;
    memset(imu->tumble, 0, sizeof *imu->tumble);
    imu->tumble->progress.next = SELFCAL_TUMBLE_POSITIONS;
    bool sound = table->accel_unit > 0.0F && table->gyro_unit > 0.0F;
    for (unsigned i = 0; i < 6U; i++) {
        sound = sound && table->axis[i] < imu->bank.model->axes;
    }
    return sound;
}

/* --- rests --- */

static void end_rest(selfcal_imu_tumble_t *self) {
    self->resting = self->counted = self->spoilt = false;
    self->window = self->kept = 0U;
}

static void skip(selfcal_imu_t *imu, uint64_t count) {
    selfcal_imu_tumble_t *self = imu->tumble;
    self->passed += (uint32_t)count;
    if (imu->gate->gate.state != SELFCAL_RESTING) {
        end_rest(self);
    }
}

static float unit_of(const selfcal_tumbling_t *table, size_t i) {
    return i < 3U ? table->accel_unit : table->gyro_unit;
}

/* Means of the rest under way. It counts once it is long enough. */
static void count_rest(selfcal_imu_t *imu) {
    selfcal_imu_tumble_t *self = imu->tumble;
    const selfcal_tumbling_t *table = imu->pipe->tumbling;
    const float rate = imu->pipe->rate_hz;
    if ((float)self->kept < (float)SELFCAL_TUMBLE_REST_S * rate ||
        (!self->counted && self->progress.rests == SELFCAL_TUMBLE_MAX)) {
        return;
    }
    if (!self->counted) {
        self->counted = self->due = true;
        self->progress.rests++;
    }
    selfcal_tumble_rest_t *rest = &self->rest[self->progress.rests - 1U];
    rest->begin_s = (float)self->begun / rate;
    rest->end_s = (float)self->passed / rate;
    for (size_t i = 0; i < 6U; i++) {
        const selfcal_wide_t mean = (selfcal_wide_t)self->origin[i] + self->sum[i] / (selfcal_wide_t)self->kept;
        rest->mean[i] = (float)((mean - (selfcal_wide_t)selfcal_shifted(&imu->bank, table->axis[i])) *
                                (selfcal_wide_t)unit_of(table, i));
    }
}

/* A window of rest has ended. */
static void close_window(selfcal_imu_t *imu) {
    selfcal_imu_tumble_t *self = imu->tumble;
    if (self->window > 0U && !self->spoilt) {
        if (self->kept == 0U) {
            self->begun = self->passed - self->window;
            memset(self->sum, 0, sizeof self->sum);
        }
        for (size_t i = 0; i < 6U; i++) {
            self->sum[i] += (selfcal_wide_t)self->window_sum[i];
        }
        self->kept += self->window;
        count_rest(imu);
    }
    self->window = 0U;
    self->spoilt = false;
}

static void add(selfcal_imu_t *imu, const float reading[]) {
    selfcal_imu_tumble_t *self = imu->tumble;
    for (size_t i = 0; i < 6U; i++) {
        const uint8_t axis = imu->pipe->tumbling->axis[i];
        self->spoilt = self->spoilt || is_wrong(&imu->bank, axis, reading[axis]) || is_stuck(&imu->bank, axis);
        if (self->window == 0U) {
            self->origin[i] = self->kept == 0U ? reading[axis] : self->origin[i];
            self->window_sum[i] = 0.0F;
        }
        self->window_sum[i] += reading[axis] - self->origin[i];
    }
    self->window++;
}

static bool take(selfcal_imu_t *imu, const float reading[]) {
    selfcal_imu_tumble_t *self = imu->tumble;
    selfcal_gate_t *gate = &imu->gate->gate;
    if (self->progress.phase == SELFCAL_TUMBLE_OFF) {
        return false;
    }
    self->passed++;
    if (gate->state != SELFCAL_RESTING) {
        gate->rested = false;
        end_rest(self);
        self->progress.phase = SELFCAL_TUMBLE_PLACE;
        return true;
    }
    if (self->resting) { /* else this sample belongs to the window that told so */
        add(imu, reading);
    }
    self->resting = true;
    if (gate->position == 0U) {
        close_window(imu);
    }
    self->progress.phase = self->counted ? SELFCAL_TUMBLE_TURN : SELFCAL_TUMBLE_HOLD;
    return true;
}

/* --- commands --- */

bool selfcal_imu_tumble_start(selfcal_imu_t *imu) {
    selfcal_imu_tumble_t *self = imu->tumble;
    bool able = self != NULL && imu->watching;
    for (size_t i = 0; able && i < 6U; i++) {
        able = !selfcal_retired(&imu->bank, imu->pipe->tumbling->axis[i]);
    }
    if (able) {
        end_rest(self);
        self->passed = 0U;
        self->progress.rests = 0U;
        self->progress.status = SELFCAL_TUMBLE_OK;
        self->progress.phase = SELFCAL_TUMBLE_PLACE;
        self->due = true;
    }
    return able;
}

/* The result in use from here on. */
static void use(selfcal_imu_tumble_t *self) {
    const selfcal_tumble_t *found = &self->found;
    selfcal_tumbled_t *used = &self->used;
    memcpy(used->bias, found->bias, sizeof used->bias);
    memcpy(used->matrix, found->matrix, sizeof used->matrix);
    memcpy(used->G, found->G, sizeof used->G);
    memcpy(used->covariance, found->accel_covariance, sizeof used->covariance);
    used->ratio = isfinite(found->ratio) ? found->ratio : 0.0F;
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
        selfcal_tumble(&self->found, &imu->pipe->tumbling->part, self->rest, progress->rests, &self->work);
    if (progress->status == SELFCAL_TUMBLE_OK) {
        use(self);
    }
    progress->phase = SELFCAL_TUMBLE_OFF;
    progress->next = SELFCAL_TUMBLE_POSITIONS;
    self->due = false;
    return progress->status;
}

selfcal_tumble_progress_t selfcal_imu_tumble_progress(selfcal_imu_t *imu) {
    selfcal_imu_tumble_t *self = imu->tumble;
    selfcal_tumble_progress_t *progress = &self->progress;
    if (self->due) {
        uint16_t known = 0;
        const uint8_t rests = progress->rests,
                      next = selfcal_tumble_next(&imu->pipe->tumbling->part, self->rest, rests, &self->work, &known);
        const bool all = known == (1U << SELFCAL_TUMBLE_ACCEL) - 1U, full = rests == SELFCAL_TUMBLE_MAX;
        const bool enough = full || (all && rests >= SELFCAL_TUMBLE_POSITIONS);
        progress->wanted = rests < SELFCAL_TUMBLE_POSITIONS ? (uint8_t)SELFCAL_TUMBLE_POSITIONS
                                                            : (uint8_t)(rests + (enough ? 0U : 1U));
        progress->next = enough ? (uint8_t)SELFCAL_TUMBLE_POSITIONS : next;
        self->due = false;
    }
    return *progress;
}

uint32_t selfcal_imu_tumble_words(selfcal_imu_t *imu, uint32_t word[SELFCAL_TUMBLE_WORDS]) {
    const selfcal_tumble_progress_t p = selfcal_imu_tumble_progress(imu);
    const selfcal_tumbled_t *used = &imu->tumble->used;
    word[0] = (uint32_t)p.phase << SELFCAL_TUMBLE_PHASE_SHIFT | (uint32_t)p.applied << SELFCAL_TUMBLE_APPLIED_SHIFT |
              (uint32_t)p.status << SELFCAL_TUMBLE_RESULT_SHIFT | (uint32_t)p.rests << SELFCAL_TUMBLE_RESTS_SHIFT |
              (uint32_t)p.wanted << SELFCAL_TUMBLE_WANTED_SHIFT | (uint32_t)p.next << SELFCAL_TUMBLE_NEXT_SHIFT;
    if (!p.applied) {
        return 1U;
    }
    uint32_t there = 1U;
    for (size_t i = 0; i < SELFCAL_TUMBLE_ACCEL; i++) {
        const size_t row = i == 8U ? 1U : 0U, column = i == 6U ? 1U : 2U; /* of the angles xy xz yz */
        const size_t at = SELFCAL_TUMBLE_BIAS_X - 1U + i, at_sd = SELFCAL_TUMBLE_BIAS_X_SD - 1U + i;
        const float scale = used->matrix[i % 3U][i % 3U];
        const float angle = used->matrix[row][column] / used->matrix[column][column];
        word[at] = float_bits(i < 3U ? used->bias[i] : i < 6U ? scale - 1.0F : angle);
        word[at_sd] = float_bits(sqrtf(used->covariance[i * (i + 3U) / 2U]) * fmaxf(used->ratio, 1.0F));
        const uint32_t known = used->accel_identified >> i & 1U;
        there |= known << at | known << at_sd;
    }
    for (size_t i = 0; i < 9U; i++) {
        const size_t axis = i / 3U, along = i % 3U, at = SELFCAL_TUMBLE_G_XX - 1U + i;
        word[at] = float_bits(used->G[axis][along] * DEG_PER_S_PER_G);
        there |= (uint32_t)(used->gyro_identified >> (SELFCAL_TUMBLE_GYRO * axis + 1U + along) & 1U) << at;
    }
    word[SELFCAL_TUMBLE_RESIDUALS - 1] = float_bits(used->ratio);
    return there | 1UL << (SELFCAL_TUMBLE_RESIDUALS - 1);
}

const selfcal_tumbled_t *selfcal_imu_tumbled(const selfcal_imu_t *imu) {
    return imu->tumble != NULL && imu->tumble->progress.applied ? &imu->tumble->used : NULL;
}

/* --- correction --- */

/* f = T K (a - b) of the accelerometers among `reading`; `x` gets a - b. */
static void force_of(const selfcal_imu_t *imu, const float reading[], float x[3], float f[3]) {
    const selfcal_tumbling_t *table = imu->pipe->tumbling;
    const selfcal_tumbled_t *used = &imu->tumble->used;
    for (size_t i = 0; i < 3U; i++) {
        const uint8_t axis = table->axis[i];
        x[i] = (reading[axis] - selfcal_shifted(&imu->bank, axis)) * table->accel_unit - used->bias[i];
    }
    for (size_t i = 0; i < 3U; i++) {
        f[i] = used->matrix[i][0] * x[0] + used->matrix[i][1] * x[1] + used->matrix[i][2] * x[2];
    }
}

/* sd of f[i] by the parameters' covariance. */
static float force_sd(const selfcal_tumbled_t *used, const float x[3], size_t i) {
    float slope[SELFCAL_TUMBLE_ACCEL] = {0.0F}, sum = 0.0F;
    for (size_t j = i; j < 3U; j++) {
        const float scale = used->matrix[j][j];
        slope[j] = -used->matrix[i][j];
        slope[3U + j] = used->matrix[i][j] / scale * x[j];
        if (j > i) { /* angles xy xz yz */
            slope[5U + i + j] = scale * x[j];
        }
    }
    const float *covariance = used->covariance;
    for (size_t a = 0; a < SELFCAL_TUMBLE_ACCEL; a++) {
        for (size_t b = 0; b <= a; b++) {
            sum += (a == b ? 1.0F : 2.0F) * slope[a] * slope[b] * *covariance++;
        }
    }
    return sqrtf(fmaxf(sum, 0.0F)) * fmaxf(used->ratio, 1.0F);
}

static void correct(const selfcal_imu_t *imu, selfcal_corrected_t *corrected) {
    const selfcal_tumbling_t *table = imu->pipe->tumbling;
    const selfcal_tumbled_t *used = &imu->tumble->used;
    const selfcal_gate_t *gate = &imu->gate->gate;
    if (!imu->tumble->progress.applied) {
        return;
    }
    bool sound = true;
    for (size_t i = 0; i < 3U; i++) { /* each force has a part of every reading */
        const selfcal_reason_t why = corrected->reason[table->axis[i]];
        sound =
            sound && why != SELFCAL_REASON_RETIRED && why != SELFCAL_REASON_STUCK && why != SELFCAL_REASON_BAD_SAMPLE;
    }
    float x[3], f[3], x0[3], f0[3], level[SELFCAL_AXES_MAX] = {0.0F};
    for (uint8_t axis = 0; axis < imu->bank.model->axes; axis++) {
        level[axis] = gate->origin[axis] + gate->rest.mean[axis];
    }
    force_of(imu, imu->kept->reading, x, f);
    force_of(imu, level, x0, f0);
    for (size_t i = 0; i < 3U; i++) {
        const uint8_t axis = table->axis[i], gyro = table->axis[3U + i];
        corrected->value[axis] = f[i] / table->accel_unit;
        corrected->sd[axis] = sound ? force_sd(used, x, i) / table->accel_unit : NAN;
        if (sound) {
            corrected->reason[axis] = SELFCAL_REASON_NONE;
        }
        for (size_t j = 0; sound && gate->rested && j < 3U; j++) {
            corrected->value[gyro] -= used->G[i][j] * (f[j] - f0[j]) / table->gyro_unit;
        }
    }
}

/* --- saved state --- */

static void forget(selfcal_imu_t *imu) {
    (void)begin(imu);
}

static bool save(const selfcal_imu_t *imu, selfcal_write_t write, void *context) {
    saved_t saved;
    if (!imu->tumble->progress.applied) {
        return true;
    }
    memset(&saved, 0, sizeof saved);
    memcpy(saved.magic, magic, sizeof magic);
    saved.format = FORMAT;
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
    if (memcmp(saved.magic, magic, sizeof magic) != 0) {
        return SELFCAL_OK;
    }
    if (saved.crc != selfcal_crc32(0, (const uint8_t *)&saved, offsetof(saved_t, crc))) {
        return SELFCAL_SNAPSHOT_DAMAGED;
    }
    *length -= sizeof saved;
    if (saved.format != FORMAT) {
        return SELFCAL_SNAPSHOT_VERSION;
    }
    if (!imu->tumble->progress.applied) {
        imu->tumble->used = saved.used;
        imu->tumble->progress.applied = true;
    }
    return SELFCAL_OK;
}

const selfcal_tumbling_code_t selfcal_tumbling_code = {
    sizeof(selfcal_imu_tumble_t), begin, skip, take, correct, forget, save, restore};
