#include "app.h"

#include <string.h>

enum { STAGE_NONE = 0, STAGE_STATUS = 1, STAGE_AXES = 2, STAGE_END = STAGE_AXES + SELFCAL_MODEL_AXES };

selfcal_status_t app_init(app_t *app, const port_t *port, uint32_t period_ms)
{
    memset(app, 0, sizeof *app);
    app->port = port;
    app->period_ms = period_ms;
    app->due_ms = period_ms;
    const selfcal_status_t status = selfcal_init(&app->bank, &selfcal_model, app->memory, sizeof app->memory);
    if (status != SELFCAL_OK) {
        return status;
    }
    return selfcal_telemetry_init(&app->telemetry, &selfcal_model, selfcal_model_axis_name);
}

static bool take_sample(app_t *app)
{
    float reading[SELFCAL_MODEL_AXES];
    uint32_t missing = 0;
    switch (app->port->sample(app->port->context, reading, &missing)) {
    case PORT_SAMPLE:
        if (missing > 0) {
            (void)selfcal_skip(&app->bank, missing);
        }
        (void)selfcal_push(&app->bank, reading); /* what it rejects it counts */
        app->fresh = true;
        return true;
    case PORT_END: app->ended = true; return false;
    default: return false;
    }
}

static bool send_frames(app_t *app)
{
    bool sent = false;
    for (;;) {
        if (!app->waiting) {
            app->waiting = selfcal_telemetry_next(&app->telemetry, &app->frame);
        }
        if (!app->waiting || !app->port->send(app->port->context, &app->frame)) {
            return sent;
        }
        app->waiting = false;
        sent = true;
    }
}

/* Begins a report when one is due, and goes from its status over the axes to its end. Only with all frames out. */
static bool advance(app_t *app)
{
    const uint32_t now = app->port->time_ms(app->port->context);
    const selfcal_counters_t *counters = selfcal_counters(&app->bank);
    if (app->stage == STAGE_NONE) {
        const bool due = (int32_t)(now - app->due_ms) >= 0;
        if (app->fresh && (due || app->ended)) {
            app->due_ms += due ? (now - app->due_ms) / app->period_ms * app->period_ms + app->period_ms : 0U;
            app->fresh = false;
            app->report_number++;
            app->stage = STAGE_STATUS;
        } else if (app->ended && !app->finished) {
            app->finished = true;
            (void)selfcal_telemetry_status(&app->telemetry, counters, SELFCAL_FINISHED, app->report_number, now);
            return true;
        } else {
            return false;
        }
    }
    if (app->stage == STAGE_STATUS) {
        (void)selfcal_telemetry_status(&app->telemetry, counters, SELFCAL_RUNNING, app->report_number, now);
    } else if (app->stage < STAGE_END) {
        app->begun_ms = now;
        app->computing = selfcal_report_begin(&app->work, &app->bank, (uint8_t)(app->stage - STAGE_AXES),
                                              &app->report) == SELFCAL_OK; /* else too short: no report yet */
    }
    app->stage = (uint8_t)(app->stage < STAGE_END ? app->stage + 1 : STAGE_NONE);
    return true;
}

static bool compute(app_t *app)
{
    const selfcal_status_t status = selfcal_report_step(&app->work, &app->report);
    if (status != SELFCAL_BUSY) {
        app->computing = false;
        if (status == SELFCAL_OK) {
            (void)selfcal_telemetry_report(&app->telemetry, &app->report, selfcal_counters(&app->bank), app->begun_ms);
        }
    }
    return true;
}

bool app_step(app_t *app)
{
    /* Samples go on during a report, until one more could overtake it: then they wait in the port's queue. */
    bool busy = app->computing && compute(app);
    busy = ((!app->computing || selfcal_room(&app->bank) > 0U) && take_sample(app)) || busy;
    busy = send_frames(app) || busy;
    if (!app->computing && !app->waiting) {
        busy = advance(app) || busy;
    }
    if (!busy) {
        if (app->finished && !app->waiting) {
            return false;
        }
        app->port->idle(app->port->context);
    }
    return true;
}
