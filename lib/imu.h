/* What the parts of the pipe (imu.c) that a model may name do for it. Not for users. */
#ifndef SELFCAL_IMU_INSIDE_H
#define SELFCAL_IMU_INSIDE_H

#include "bank_inside.h"

/* imu_gate.c: tells rest from motion. */
struct selfcal_gate_code {
    bool (*begin)(selfcal_imu_t *imu);
    /* `count` samples are missing. */
    void (*skip)(selfcal_imu_t *imu, uint64_t count);
    /* Whether the bank may have the sample. */
    bool (*rests)(selfcal_imu_t *imu, const float reading[]);
    void (*shift)(selfcal_imu_t *imu, uint8_t axis, float amount);
};

/* imu_columns.c: forms the regressors' values, and weighs a report with them against one without. */
struct selfcal_columns_code {
    /* Goes on from the samples that the bank has seen. */
    selfcal_status_t (*begin)(selfcal_imu_t *imu);
    void (*skip)(selfcal_imu_t *imu, uint64_t count);
    /* The values at a sample. */
    const float *(*form)(selfcal_imu_t *imu, const float reading[], const float channels[]);
    /* A step of the report under way. */
    selfcal_status_t (*step)(selfcal_imu_t *imu);
    /* Of an axis's last report: coefficients in use, 0 of the others. */
    void (*used)(const selfcal_imu_t *imu, uint8_t axis, float coefficient[]);
    /* The bias at the newest sample, of that for the columns at the end of the last report. */
    float (*moved)(const selfcal_imu_t *imu, uint8_t axis, float bias);
};

/* imu_judge.c: judges the model. */
struct selfcal_judging_code {
    void (*begin)(selfcal_imu_t *imu);
    void (*sample)(selfcal_imu_t *imu, const float side[], const float values[]);
    /* A report is whole. */
    selfcal_adequacy_state_t (*report)(selfcal_imu_t *imu);
};

/* imu_changes.c: handles steps of the bias and changes of the noise. */
struct selfcal_changes_code {
    selfcal_status_t (*begin)(selfcal_imu_t *imu);
    /* A bit for each axis that has changed. */
    uint32_t (*handle)(selfcal_imu_t *imu);
};

/* imu_hold.c: keeps samples from overtaking a report. */
struct selfcal_holding_code {
    /* A step of a report has been taken. */
    void (*follow)(selfcal_imu_t *imu);
};

/* imu_tumble.c: rests in several positions give scale and misalignment of the accelerometers. */
struct selfcal_tumbling_code {
    size_t bytes; /* of selfcal_imu_tumble_t */
    /* Nothing is known. */
    void (*begin)(selfcal_imu_t *imu);
    void (*skip)(selfcal_imu_t *imu, uint64_t count);
    /* Behind the gate. Whether it has taken the sample, which is motion to the bank. */
    bool (*take)(selfcal_imu_t *imu, const float reading[]);
    void (*correct)(const selfcal_imu_t *imu, selfcal_corrected_t *corrected);
    /* Behind a snapshot. */
    bool (*save)(const selfcal_imu_t *imu, selfcal_write_t write, void *context);
    /* Takes its bytes off the end. */
    selfcal_status_t (*restore)(selfcal_imu_t *imu, const void *bytes, size_t *length);
};

/* Whether an axis has a report that is not of the past. */
static inline bool has_report(const selfcal_imu_t *imu, uint8_t axis) {
    return (imu->reported >> axis & 1U) != 0U;
}

#endif
