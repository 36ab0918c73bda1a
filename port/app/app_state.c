/* Saved state: restored at the start, saved between reports. */
#include "app_parts.h"

/* Tells the sensor again the offsets that the bank knows of: it may have forgotten them. */
static bool tell_sensor(app_t *app)
{
    float wanted[SELFCAL_MODEL_AXES], got[SELFCAL_MODEL_AXES];
    bool any = false;
    for (uint8_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        wanted[axis] = selfcal_shifted(&app->bank, axis);
        any = any || wanted[axis] != 0.0F;
    }
    return !any || app->module->write_offsets(app->module->context, wanted, got);
}

void app_restore(app_t *app)
{
    const port_module_t *module = app->module;
    for (int older = 0; older < 2; older++) {
        size_t length = 0;
        const void *bytes = module->stored(module->context, older != 0, &length);
        if (bytes == NULL) {
            break;
        }
        const selfcal_status_t status =
            selfcal_restore(&app->bank, &selfcal_model, app->memory, sizeof app->memory, bytes, length);
        if (status == SELFCAL_OK) {
            /* Up to the start of a bank interval: it holds whole windows of the gate. */
            (void)selfcal_moving(&app->bank);
            const uint64_t block = app->bank.block, past = (app->bank.position + module->save_gap) % block;
            (void)selfcal_skip(&app->bank, module->save_gap + (past > 0U ? block - past : 0U));
            module->tell(module->context, &app->told);
            if (app->told.reset_cause == SELFCAL_STATUS_RESET_CAUSE_POWER_ON) {
                (void)selfcal_power_on(&app->bank, 0);
            }
            (void)tell_sensor(app);
            app_begin_columns(app);
            app->told.state_found = older == 0 ? SELFCAL_STATUS_STATE_FOUND_NEWEST : SELFCAL_STATUS_STATE_FOUND_OLDER;
            app->restored = true;
            return;
        }
        app->told.state_refused = (uint32_t)-status;
        app->told.state_found = SELFCAL_STATUS_STATE_FOUND_REFUSED;
    }
}

void app_save(app_t *app, uint32_t now)
{
    const port_module_t *module = app->module;
    const uint32_t count = app->restored ? app_absent(app) : 0U;
    if (count > 0U) {
        app_pass(app, count);
        app_begin_columns(app);
    }
    app->saved_ms = now;
    /* The state in use is kept, even if the newest is whole: start-up may have refused that as another model's. */
    const bool keep_older = app->told.state_found == SELFCAL_STATUS_STATE_FOUND_OLDER && app->told.state_saves == 0U;
    const bool whole = module->save_begin(module->context, keep_older) &&
                       selfcal_save(&app->bank, module->save_put, module->context) == SELFCAL_OK;
    if (module->save_end(module->context, whole)) {
        app->told.state_saves++;
    } else {
        app->told.state_save_failures++;
    }
}

