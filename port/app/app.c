#include "app.h"

#include <string.h>

enum { SAMPLES_A_TURN = 64 };
enum { STAGE_NONE = 0, STAGE_STATUS = 1, STAGE_AXES = 2, STAGE_END = STAGE_AXES + SELFCAL_MODEL_AXES };

/* A report takes some seconds on any wire; one that has not ended after so long never will. */
#define REPORT_MOST_MS 60000U

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

static void restore(app_t *app)
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
            (void)selfcal_skip(&app->bank, module->save_gap);
            app->told.state_found = older == 0 ? 1U : 2U;
            return;
        }
        app->told.state_refused = (uint32_t)-status;
        app->told.state_found = 3U;
    }
}

void app_module(app_t *app, const port_module_t *module)
{
    app->module = module;
    restore(app);
    app->saved_ms = app->port->time_ms(app->port->context);
    selfcal_telemetry_module(&app->telemetry, &app->told);
}

bool app_healthy(const app_t *app)
{
    const uint32_t now = app->port->time_ms(app->port->context);
    return !app->corrupt && (app->stage == STAGE_NONE || now - app->report_ms < REPORT_MOST_MS);
}

/* Saves when it is time to; between reports, because the bank must stand still. */
static void save_when_due(app_t *app, uint32_t now)
{
    const port_module_t *module = app->module;
    if (module == NULL || now - app->saved_ms < module->save_period_ms) {
        return;
    }
    app->saved_ms = now;
    if (module->save_begin(module->context) &&
        selfcal_save(&app->bank, module->save_put, module->context) == SELFCAL_OK && module->save_end(module->context)) {
        app->told.state_saves++;
    } else {
        app->told.state_save_failures++;
    }
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
        save_when_due(app, now);
        app->corrupt = app->corrupt || (due && selfcal_check(&app->bank) != SELFCAL_OK);
        if (app->corrupt) {
            return false;
        }
        if ((app->fresh || (due && app->module != NULL)) && (due || app->ended)) {
            app->due_ms += due ? (now - app->due_ms) / app->period_ms * app->period_ms + app->period_ms : 0U;
            app->report_number += app->fresh ? 1U : 0U;
            app->report_ms = now;
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
        if (app->module != NULL) {
            app->module->tell(app->module->context, &app->told);
        }
        (void)selfcal_telemetry_status(&app->telemetry, counters, SELFCAL_RUNNING, app->report_number, now);
        if (!app->fresh) { /* no sample since the last report: the status alone */
            app->stage = STAGE_END;
        }
        app->fresh = false;
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
    /* Samples go on during a report, until one more could overtake it: then they wait in the port's queue. On a slow core
     * several come during one slice. */
    bool busy = app->computing && compute(app);
    for (unsigned taken = 0; taken < SAMPLES_A_TURN && (!app->computing || selfcal_room(&app->bank) > 0U) && take_sample(app);
         taken++) {
        busy = true;
    }
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
