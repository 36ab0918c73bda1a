/* Frames: reports, statuses and answers, one after the other, out to the port. */
#include "app_parts.h"

/* Between statuses of a module, at most. */
#define STATUS_MS 10000U

bool app_send_frames(app_t *app)
{
    bool sent = false;
    for (;;) {
        if (!app->waiting) {
            app->waiting = selfcal_telemetry_next(&app->telemetry, &app->frame);
        }
        if (!app->waiting) {
            return sent;
        }
        if (!app->port->send(app->port->context, &app->frame)) {
            if (!app->refused) {
                app->refused_ms = app_now(app);
            }
            app->refused = true;
            return sent;
        }
        app->refused = false;
        app->waiting = false;
        sent = true;
    }
}

uint32_t app_motion(const app_t *app)
{
#if SELFCAL_MODEL_GATE
    if (app->gated) {
        return app->gate.state == SELFCAL_RESTING ? SELFCAL_STATUS_MOTION_RESTING : SELFCAL_STATUS_MOTION_MOVING;
    }
#endif
    (void)app;
    return SELFCAL_STATUS_MOTION_NOT_WATCHED;
}

selfcal_reason_t app_reason(const app_t *app, uint8_t axis)
{
    if (selfcal_retired(&app->bank, axis)) {
        return SELFCAL_REASON_RETIRED;
    }
    const bool kept_waiting = app->reason[axis] == SELFCAL_REASON_NO_REPORT;
    return kept_waiting && app_motion(app) == SELFCAL_STATUS_MOTION_MOVING ? SELFCAL_REASON_MOVING : app->reason[axis];
}

void app_tell(app_t *app)
{
    selfcal_module_t *told = &app->told;
    if (app->module != NULL) {
        app->module->tell(app->module->context, told);
    }
    told->motion = app_motion(app);
#if SELFCAL_MODEL_GATE
    told->gate_alarm_count = (uint32_t)app->gate.counters.alarms;
#endif
    told->retired = app->bank.retired;
    for (uint8_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        told->offset[axis] = selfcal_shifted(&app->bank, axis);
        told->reason[axis] = app_reason(app, axis);
    }
}

void app_tell_status(app_t *app, uint32_t now)
{
    app_tell(app);
    (void)selfcal_telemetry_status(&app->telemetry, selfcal_counters(&app->bank), SELFCAL_RUNNING, app->report_number,
                                   now);
    app->told_ms = now;
}

bool app_status_due(const app_t *app, uint32_t now)
{
    return app->module != NULL && now - app->told_ms >= STATUS_MS;
}

bool app_begin_frames(app_t *app)
{
    const uint32_t now = app_now(app);
    if (app->worked_out) {
        app->worked_out = false;
        (void)selfcal_telemetry_report(&app->telemetry, &app->report, selfcal_counters(&app->bank), app->begun_ms);
        return true;
    }
#if APP_COMMANDS
    if (app_begin_answer(app, now)) {
        return true;
    }
#endif
    if (app->stage != STAGE_NONE && app_status_due(app, now)) { /* between reports app_advance() looks */
        app_tell_status(app, now);
        return true;
    }
    return false;
}

