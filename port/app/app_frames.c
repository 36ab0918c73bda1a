/* Frames, one after the other, out to the port; and the status of the module. */
#include "app_parts.h"

/* Between statuses of a module, at most. */
#define STATUS_MS 10000U

bool app_send_frames(app_t *app) {
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

void app_tell(app_t *app) {
    selfcal_module_t *told = &app->told;
    if (app->module != NULL) {
        app->module->tell(app->module->context, told);
    }
    told->motion = selfcal_imu_motion(&app->imu);
    told->gate_alarm_count = app->imu.watching ? (uint32_t)app->imu.gate->gate.counters.alarms : 0U;
    told->retired = app->imu.bank.retired;
    for (uint8_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        told->offset[axis] = selfcal_shifted(&app->imu.bank, axis);
        told->reason[axis] = selfcal_imu_reason(&app->imu, axis);
    }
}

void app_tell_status(app_t *app, uint32_t now) {
    app_tell(app);
    (void)selfcal_telemetry_status(&app->telemetry, selfcal_counters(&app->imu.bank), SELFCAL_RUNNING,
                                   app->report_number, now);
    app->told_ms = now;
}

bool app_tumbles(app_t *app) {
    return SELFCAL_MODEL_TUMBLED && app->imu.tumble->progress.phase != SELFCAL_TUMBLE_OFF;
}

bool app_begin_tumble(app_t *app, uint32_t now) {
    if (!SELFCAL_MODEL_TUMBLED) {
        return false;
    }
    uint32_t there = 0;
    const uint32_t *word = selfcal_imu_tumble_words(&app->imu, &there);
    if (word[0] == app->tumble && now - app->tumble_ms < STATUS_MS) {
        return false;
    }
    app->tumble = word[0];
    app->tumble_ms = now;
    return selfcal_telemetry_words(&app->telemetry, SELFCAL_FRAME_TUMBLE_ID, word, SELFCAL_TUMBLE_WORDS, there, now) ==
           SELFCAL_OK;
}

bool app_status_due(const app_t *app, uint32_t now) {
    return app->module != NULL && now - app->told_ms >= STATUS_MS;
}
