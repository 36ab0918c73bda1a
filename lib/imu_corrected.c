/* Corrected samples: the newest sample less the bias predicted for its time, or by a calibration. */
#include "imu.h"

/* True if the bank keeps this sample out for a fault of the sensor's. */
static bool faulty(const selfcal_t *bank, const float reading[]) {
    for (uint8_t axis = 0; axis < bank->model->axes; axis++) {
        const float range = bank->model->axis[axis].range;
        const bool bad = !isfinite(reading[axis]) || (range > 0.0F && fabsf(reading[axis]) >= range);
        if (bad && !selfcal_retired(bank, axis)) {
            return true;
        }
    }
    return false;
}

static bool stuck(const selfcal_t *bank, uint8_t axis) {
    const uint32_t limit = bank->model->axis[axis].stuck_limit;
    return limit > 0U && bank->equal[axis] >= limit;
}

/* Why there is no corrected sample of an axis, or why it is not to be relied on. */
static selfcal_reason_t reason_of(const selfcal_imu_t *imu, uint8_t axis, bool is_faulty) {
    const selfcal_reason_t known = selfcal_imu_reason(imu, axis);
    if (known == SELFCAL_REASON_RETIRED) {
        return known;
    }
    return is_faulty ? SELFCAL_REASON_BAD_SAMPLE : stuck(&imu->bank, axis) ? SELFCAL_REASON_STUCK : known;
}

bool selfcal_imu_corrected(selfcal_imu_t *imu, selfcal_corrected_t *corrected) {
    selfcal_kept_t *kept = imu->kept;
    const selfcal_model_t *model = imu->bank.model;
    if (kept == NULL || !kept->newer) {
        return false;
    }
    kept->newer = false;
    const bool is_faulty = faulty(&imu->bank, kept->reading);
    for (uint8_t axis = 0; axis < model->axes; axis++) {
        const selfcal_reason_t reason = reason_of(imu, axis, is_faulty);
        float bias = NAN, sd = NAN;
        const bool rough = reason == SELFCAL_REASON_OVERTAKEN && has_report(imu, axis);
        if (reason == SELFCAL_REASON_NONE || rough || reason == SELFCAL_REASON_INADEQUATE ||
            reason == SELFCAL_REASON_NOT_IDENTIFIED) {
            const float elapsed_s = (float)(kept->passed - kept->rests_on[axis]) / imu->pipe->rate_hz;
            (void)selfcal_predict(&kept->report[axis], model, elapsed_s, &bias, &sd);
        }
        if (imu->columns != NULL) { /* the report's bias holds for the values at its end */
            bias = imu->pipe->columns->moved(imu, axis, bias);
        }
        corrected->value[axis] = kept->reading[axis] - bias;
        corrected->sd[axis] = sd;
        corrected->reason[axis] = reason;
    }
    if (imu->tumble != NULL) {
        imu->pipe->tumbling_code->correct(imu, corrected);
    }
    corrected->motion = selfcal_imu_motion(imu);
    return true;
}
