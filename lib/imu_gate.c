/* The gate before the bank, and the noise that it learns at rest. */
#include "imu.h"

static bool begin_gate(selfcal_imu_t *imu) {
    imu->gate->learn_at = SELFCAL_GATE_MEASURED_MIN;
    imu->gate->at_once = 0U;
    return selfcal_gate_init(&imu->gate->gate, imu->pipe->gate) == SELFCAL_OK;
}

static void skip_gate(selfcal_imu_t *imu, uint64_t count) {
    if (selfcal_gate_skip(&imu->gate->gate, count) == SELFCAL_MOVING) {
        (void)selfcal_moving(&imu->bank);
    }
}

/* Gives the gate the noise that it has measured at rest: after SELFCAL_GATE_MEASURED_MIN windows, and whenever there
 * are twice as many. */
static void learn_noise(selfcal_watched_t *watched, uint8_t axes) {
    selfcal_gate_t *gate = &watched->gate;
    if (gate->measured == 0U) { /* at the start, and when the noise has become another */
        watched->learn_at = SELFCAL_GATE_MEASURED_MIN;
    }
    if (gate->measured < watched->learn_at) {
        return;
    }
    watched->learn_at *= 2U;
    for (uint8_t axis = 0; axis < axes; axis++) {
        selfcal_gate_noise_t noise;
        if (isfinite(gate->axis[axis].sigma) && selfcal_gate_measured(gate, axis, &noise) == SELFCAL_OK) {
            (void)selfcal_gate_noise(gate, axis, &noise); /* refused if a factor is 0: a record without noise */
        }
    }
}

/* An axis that is retired says nothing of motion. */
static void leave_out_retired(selfcal_imu_t *imu) {
    static const selfcal_gate_noise_t nothing = {INFINITY, 1.0F, 1.0F, 1.0F};
    selfcal_gate_t *gate = &imu->gate->gate;
    for (uint8_t axis = 0; axis < imu->bank.model->axes; axis++) {
        if (selfcal_retired(&imu->bank, axis) && isfinite(gate->axis[axis].sigma)) {
            (void)selfcal_gate_noise(gate, axis, &nothing);
        }
    }
}

/* By the rule at selfcal_push_moving(). */
static bool rests(selfcal_imu_t *imu, const float reading[]) {
    selfcal_gate_t *gate = &imu->gate->gate;
    if (imu->bank.retired != 0U) { /* also from a snapshot */
        leave_out_retired(imu);
    }
    const bool in_step = gate->position == 0U || imu->bank.counters.samples > 0U;
    const selfcal_motion_t before = gate->state;
    const selfcal_motion_t now = selfcal_gate_push(gate, reading);
    learn_noise(imu->gate, imu->bank.model->axes);
    return before == SELFCAL_RESTING && now == SELFCAL_RESTING && in_step;
}

static void shift(selfcal_imu_t *imu, uint8_t axis, float amount) {
    selfcal_gate_shift(&imu->gate->gate, axis, amount);
}

const selfcal_gate_code_t selfcal_gate_code = {begin_gate, skip_gate, rests, shift};
