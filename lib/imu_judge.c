/* The judgement of the model, report by report. */
#include "imu.h"

static void begin_judging(selfcal_imu_t *imu) {
    selfcal_imu_judge_t *self = imu->judge;
    (void)selfcal_adequacy_init(&self->adequacy, &imu->bank);
    memset(self->judged, 0, sizeof self->judged);
    for (uint8_t axis = 0; axis < imu->bank.model->axes; axis++) {
        self->judged[axis] = selfcal_judgement(&self->adequacy, &imu->bank, axis);
    }
}

static void sample(selfcal_imu_t *imu, const float side[], const float values[]) {
    selfcal_adequacy_push(&imu->judge->adequacy, &imu->bank, side, values);
}

/* The next epoch goes by this report. */
static selfcal_adequacy_state_t report(selfcal_imu_t *imu) {
    selfcal_imu_judge_t *self = imu->judge;
    const selfcal_model_t *model = imu->bank.model;
    const uint8_t axis = imu->report.axis;
    float used[SELFCAL_REGRESSORS_MAX] = {0.0F};
    if (imu->columns != NULL) {
        imu->pipe->columns->used(imu, axis, used);
    }
    selfcal_adequacy_report(&self->adequacy, model, &imu->report, used);
    self->judged[axis] = selfcal_judgement(&self->adequacy, &imu->bank, axis);
    return self->judged[axis].state;
}

const selfcal_judging_code_t selfcal_judging_code = {begin_judging, sample, report};
