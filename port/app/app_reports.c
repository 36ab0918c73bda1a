/* Reports: when one is due, each axis in turn, in slices. */
#include "app_parts.h"

void app_compute(app_t *app) {
    const selfcal_status_t status = selfcal_imu_work(&app->imu);
    const uint8_t axis = app->imu.report.axis;
    app->worked_out = status == SELFCAL_OK;
    if (app->worked_out) {
        selfcal_telemetry_coefficients(&app->telemetry, selfcal_imu_coefficients(&app->imu, axis));
        selfcal_telemetry_adequacy(&app->telemetry, selfcal_imu_judgement(&app->imu, axis));
    }
}

bool app_begin_frames(app_t *app) {
    const uint32_t now = app_now(app);
    if (app->worked_out) {
        app->worked_out = false;
        (void)selfcal_telemetry_report(&app->telemetry, &app->imu.report, selfcal_counters(&app->imu.bank),
                                       app->begun_ms);
        return true;
    }
    if (app_begin_answer(app, now)) {
        return true;
    }
    if (app_begin_tumble(app, now)) {
        return true;
    }
    if (app->stage != STAGE_NONE && app_status_due(app, now)) { /* between reports app_advance() looks */
        app_tell_status(app, now);
        return true;
    }
    return false;
}

/* Between reports: saves, obeys, and begins the next report or a status if one is due. */
static bool between_reports(app_t *app, uint32_t now) {
    const bool due = (int32_t)(now - app->due_ms) >= 0;
    if (app->module != NULL && now - app->saved_ms >= app->module->save_period_ms) {
        app_save(app, now);
    }
    if (app_obey(app, now)) {
        return true; /* its answer is next, and nothing else */
    }
    app->corrupt = app->corrupt || (due && selfcal_check(&app->imu.bank) != SELFCAL_OK);
    if (app->corrupt) {
        return false;
    }
    if ((app->fresh || (due && app->module != NULL)) && (due || app->ended)) {
        app->due_ms += due ? (now - app->due_ms) / app->period_ms * app->period_ms + app->period_ms : 0U;
        app->report_number += app->fresh ? 1U : 0U;
        app->stage = STAGE_STATUS;
        return true;
    }
    if (app->ended && !app->finished) {
        app->finished = true;
        app_tell(app);
        (void)selfcal_telemetry_status(&app->telemetry, selfcal_counters(&app->imu.bank), SELFCAL_FINISHED,
                                       app->report_number, now);
        return true;
    }
    if (app_status_due(app, now)) {
        app_tell_status(app, now);
        return true;
    }
    return false;
}

bool app_advance(app_t *app) {
    const uint32_t now = app_now(app);
    if (app->stage == STAGE_NONE) {
        const bool busy = between_reports(app, now);
        if (app->stage == STAGE_NONE) {
            return busy;
        }
    }
    if (app->stage == STAGE_STATUS) {
        app_tell_status(app, now);
        if (!app->fresh) { /* no sample since the last report: the status alone */
            app->stage = STAGE_END;
        }
        app->fresh = false;
    } else if (app->stage < STAGE_END) {
        app->begun_ms = now; /* too short: no report yet */
        (void)selfcal_imu_ask(&app->imu, 1U << (app->stage - STAGE_AXES));
    }
    app->stage = (uint8_t)(app->stage < STAGE_END ? app->stage + 1 : STAGE_NONE);
    return true;
}
