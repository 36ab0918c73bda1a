/* The regressors' values sample by sample, and of each axis two reports: without regressors, and with all that the axis
 * has. The likelier of both stands. */
#include "imu.h"

#include "report_inside.h"

static selfcal_status_t begin_columns(selfcal_imu_t *imu) {
    selfcal_imu_columns_t *self = imu->columns;
    memset(self, 0, sizeof *self);
    for (size_t axis = 0; axis < SELFCAL_AXES_MAX; axis++) {
        for (size_t k = 0; k < SELFCAL_REGRESSORS_MAX; k++) {
            self->sent[axis][k].mean = NAN;
        }
    }
    return selfcal_former_resume(&self->former, &imu->bank);
}

static void skip_columns(selfcal_imu_t *imu, uint64_t count) {
    const uint64_t skipped = imu->columns->skipped + count;
    imu->columns->skipped = (uint32_t)(skipped < UINT32_MAX ? skipped : UINT32_MAX);
}

static const float *form(selfcal_imu_t *imu, const float reading[], const float channels[]) {
    selfcal_imu_columns_t *self = imu->columns;
    selfcal_form(&self->former, self->skipped, reading, channels, self->values);
    self->skipped = 0U;
    return self->values;
}

/* ln evidence of a report over its laws, weighed by their priors. */
static selfcal_wide_t ln_evidence(const selfcal_model_t *model, const selfcal_report_t *report) {
    selfcal_wide_t top = -(selfcal_wide_t)INFINITY, sum = 0.0, each[SELFCAL_HYPOTHESES_MAX] = {0.0};
    for (uint8_t h = 0; h < model->hypotheses; h++) {
        each[h] = report->hypothesis[h].ln_evidence + (selfcal_wide_t)model->hypothesis[h].ln_probability;
        top = each[h] > top ? each[h] : top;
    }
    for (uint8_t h = 0; h < model->hypotheses; h++) {
        sum += isfinite(top) && each[h] > top - 700.0 ? exp(each[h] - top) : 0.0;
    }
    return top + log(sum);
}

static bool is_used(const selfcal_sent_coefficient_t *sent) {
    return sent->probability > 0.5F && isfinite(sent->mean);
}

/* The report without regressors is whole; whether the one with them has begun, on the same sums. */
static bool begin_with(selfcal_imu_t *imu, selfcal_t *bank, uint8_t mask) {
    selfcal_imu_columns_t *self = imu->columns;
    const uint8_t axis = imu->report.axis;
    const uint32_t batches = imu->work.batches;
    self->ln_without = ln_evidence(imu->bank.model, &imu->report);
    self->with = mask != 0U && selfcal_report_begin_subset(&imu->work, bank, axis, mask, self->coefficients,
                                                           &self->report_with) == SELFCAL_OK;
    if (self->with) {
        selfcal_again(&imu->work, batches);
    }
    for (size_t k = 0; k < SELFCAL_REGRESSORS_MAX; k++) {
        self->sent[axis][k].mean = NAN;
    }
    return self->with;
}

/* Both are whole. */
static void weigh_columns(selfcal_imu_t *imu, selfcal_wide_t odds) {
    selfcal_imu_columns_t *self = imu->columns;
    const selfcal_model_t *model = imu->bank.model;
    const uint8_t axis = imu->report.axis;
    const selfcal_wide_t gain = odds + ln_evidence(model, &self->report_with) - self->ln_without;
    const float probability = isnan(gain) ? 0.0F : (float)(1.0 / (1.0 + exp(gain < -700.0 ? 700.0 : -gain)));
    selfcal_widest_coefficients(&self->report_with, model, self->coefficients, probability, self->sent[axis]);
    if (probability > 0.5F) {
        imu->report = self->report_with;
    }
    for (uint8_t k = 0; k < model->regressors->count; k++) {
        self->rested[axis][k] = selfcal_regressor_last(&imu->bank, k);
    }
}

static selfcal_status_t step_columns(selfcal_imu_t *imu) {
    selfcal_imu_columns_t *self = imu->columns;
    const selfcal_regressors_t *regressors = imu->bank.model->regressors;
    const bool with = self->with;
    selfcal_t *bank = imu->work.bank;
    const selfcal_status_t status = selfcal_report_step(&imu->work, with ? &self->report_with : &imu->report);
    if (status == SELFCAL_BUSY) {
        return status;
    }
    self->with = false;
    if (status != SELFCAL_OK) {
        return status;
    }
    const size_t row = (size_t)imu->report.axis * regressors->count;
    uint8_t mask = 0;
    selfcal_wide_t odds = 0.0;
    for (uint8_t k = 0; k < regressors->count; k++) {
        if (regressors->coefficient_sd[row + k] > 0.0F) {
            mask |= (uint8_t)(1U << k);
            odds += (selfcal_wide_t)regressors->ln_odds[row + k];
        }
    }
    if (!with) {
        return begin_with(imu, bank, mask) ? SELFCAL_BUSY : SELFCAL_OK;
    }
    weigh_columns(imu, odds);
    return SELFCAL_OK;
}

static void used(const selfcal_imu_t *imu, uint8_t axis, float coefficient[]) {
    for (size_t k = 0; k < SELFCAL_REGRESSORS_MAX; k++) {
        const selfcal_sent_coefficient_t *sent = &imu->columns->sent[axis][k];
        coefficient[k] = is_used(sent) ? sent->mean : 0.0F;
    }
}

static float moved(const selfcal_imu_t *imu, uint8_t axis, float bias) {
    const selfcal_imu_columns_t *self = imu->columns;
    for (uint8_t k = 0; k < imu->bank.model->regressors->count; k++) {
        const selfcal_sent_coefficient_t *sent = &self->sent[axis][k];
        bias += (is_used(sent) ? sent->mean : 0.0F) * (self->values[k] - self->rested[axis][k]);
    }
    return bias;
}

const selfcal_columns_code_t selfcal_columns_code = {begin_columns, skip_columns, form, step_columns, used, moved};
