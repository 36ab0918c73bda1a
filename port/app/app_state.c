/* Saved state: restored at the start, saved between reports. */
#include "app_parts.h"

/* Tells the sensor again the offsets that the bank knows of: it may have forgotten them. */
static bool tell_sensor(app_t *app) {
    float wanted[SELFCAL_MODEL_AXES], got[SELFCAL_MODEL_AXES];
    bool any = false;
    for (uint8_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        wanted[axis] = selfcal_shifted(&app->imu.bank, axis);
        any = any || wanted[axis] != 0.0F;
    }
    return !any || app->module->write_offsets(app->module->context, wanted, got);
}

void app_restore(app_t *app) {
    const port_module_t *module = app->module;
    for (int older = 0; older < 2; older++) {
        size_t length = 0;
        const void *bytes = module->stored(module->context, older != 0, &length);
        if (bytes == NULL) {
            break;
        }
        const selfcal_status_t status = selfcal_imu_restore(&app->imu, bytes, length, module->save_gap);
        if (status == SELFCAL_OK) {
            module->tell(module->context, &app->told);
            if (app->told.reset_cause == SELFCAL_STATUS_RESET_CAUSE_POWER_ON) {
                (void)selfcal_imu_power_on(&app->imu, 0);
            }
            (void)tell_sensor(app);
            app->told.state_found = older == 0 ? SELFCAL_STATUS_STATE_FOUND_NEWEST : SELFCAL_STATUS_STATE_FOUND_OLDER;
            app->restored = true;
            return;
        }
        app->told.state_refused = (uint32_t)-status;
        app->told.state_found = SELFCAL_STATUS_STATE_FOUND_REFUSED;
    }
}

uint32_t app_absent(app_t *app) {
    const uint32_t now = app_now(app);
    const double passed = 1e-3 * (double)(now - app->absent_ms) * (double)SELFCAL_MODEL_RATE_HZ;
    app->absent_ms = now;
    return (uint32_t)passed;
}

void app_save(app_t *app, uint32_t now) {
    const port_module_t *module = app->module;
    if (app->restored) {
        selfcal_imu_skip(&app->imu, app_absent(app));
    }
    app->saved_ms = now;
    /* The state in use is kept, even if the newest is whole: start-up may have refused that as another model's. */
    const bool keep_older = app->told.state_found == SELFCAL_STATUS_STATE_FOUND_OLDER && app->told.state_saves == 0U;
    const bool whole = module->save_begin(module->context, keep_older) &&
                       selfcal_imu_save(&app->imu, module->save_put, module->context) == SELFCAL_OK;
    if (module->save_end(module->context, whole)) {
        app->told.state_saves++;
    } else {
        app->told.state_save_failures++;
    }
}
