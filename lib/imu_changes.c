/* Steps of the bias and changes of the noise, handled as they are found. */
#include "imu.h"

/* What was learned before a change lies behind them. */
static selfcal_status_t begin_changes(selfcal_imu_t *imu) {
    return selfcal_changes_init(imu->changes, &imu->judge->adequacy, &imu->bank, (float *)(imu->changes + 1));
}

static uint32_t handle(selfcal_imu_t *imu) {
    return selfcal_changes_handle(&imu->judge->adequacy, &imu->bank);
}

const selfcal_changes_code_t selfcal_changes_code = {begin_changes, handle};
