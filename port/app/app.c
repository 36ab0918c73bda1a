/* The main loop: a turn takes the samples that wait, one slice of a report, and as many frames as the wire takes. */
#include "app_parts.h"

#include <string.h>

enum { SAMPLES_A_TURN = 64 };

/* A Cortex-M0 at 16 MHz takes half a minute over an axis's report, and a port takes a frame or drops it within a
 * second. After so long neither will ever come about. */
#define PATIENCE_MS 300000U

selfcal_status_t app_init(app_t *app, const port_t *port, uint32_t period_ms) {
    memset(app, 0, sizeof *app);
    app->port = port;
    app->period_ms = period_ms;
    app->due_ms = period_ms;
    const selfcal_status_t status = selfcal_imu_init(&app->imu, &selfcal_model_pipe, app->memory, sizeof app->memory);
    if (status != SELFCAL_OK) {
        return status;
    }
    (void)selfcal_imu_watch(&app->imu, false);
#if APP_CORRECTED_MS
    selfcal_imu_keep(&app->imu, &app->kept);
#endif
    const selfcal_status_t wire = selfcal_telemetry_init(&app->telemetry, &selfcal_model, selfcal_model_axis_name);
    selfcal_telemetry_module(&app->telemetry, &app->told);
    return wire == SELFCAL_OK ? app_node(app, SELFCAL_NODE) : wire;
}

selfcal_status_t app_node(app_t *app, uint8_t node) {
    return selfcal_telemetry_node(&app->telemetry, node);
}

void app_power_on(app_t *app, uint64_t samples) {
    (void)selfcal_imu_power_on(&app->imu, samples);
}

bool app_gate(app_t *app) {
    return selfcal_imu_watch(&app->imu, true);
}

void app_module(app_t *app, const port_module_t *module) {
    app->module = module;
    app_restore(app);
    app->saved_ms = app_now(app);
}

bool app_healthy(const app_t *app) {
    const uint32_t now = app_now(app);
    return !app->corrupt && (!app->imu.computing || now - app->begun_ms < PATIENCE_MS) &&
           (!app->refused || now - app->refused_ms < PATIENCE_MS);
}

/* A corrected sample, if one is due, of a sample that none was sent of. After all else: on a wire too slow for
 * corrected samples one would always be due. */
static bool begin_corrected(app_t *app) {
#if APP_CORRECTED_MS
    const uint32_t now = app_now(app);
    if (now - app->corrected_ms >= APP_CORRECTED_MS && !app->corrupt &&
        selfcal_imu_corrected(&app->imu, &app->corrected)) {
        app->corrected_ms = now;
        return selfcal_telemetry_corrected(&app->telemetry, &app->corrected, app->reading_ms) == SELFCAL_OK;
    }
#endif
    (void)app;
    return false;
}

/* Takes the oldest waiting sample; false: there is none. `dear`: it took as long as a slice of a report. */
static bool take_sample(app_t *app, bool *dear) {
    float reading[SELFCAL_MODEL_AXES + SELFCAL_MODEL_CHANNELS + PORT_SIDE];
    uint32_t missing = 0;
    const port_sample_t came = app->port->sample(app->port->context, reading, &missing);
    if (came != PORT_SAMPLE) {
        app->ended = app->ended || came == PORT_END;
        return false;
    }
    if (app->restored) { /* the driver's first: the samples since the start are missing as well */
        app->restored = false;
        missing += app_absent(app);
    }
    selfcal_imu_skip(&app->imu, missing);
    const float *channels = reading + SELFCAL_MODEL_AXES;
    const uint32_t found = selfcal_imu_sample(&app->imu, reading, channels, channels + SELFCAL_MODEL_CHANNELS);
    if ((found & SELFCAL_ALL_AXES) != 0U) { /* what has changed is told at once */
        app->due_ms = app_now(app);
    }
    *dear = *dear || (found & SELFCAL_IMU_DEAR) != 0U;
    app->fresh = true;
#if APP_CORRECTED_MS
    app->reading_ms = app_now(app);
#endif
    return true;
}

bool app_step(app_t *app) {
    /* Samples go on during a report as long as there is room for them beside its sums. Then they wait in the port's
     * queue. On a slow core several come during one slice. */
    bool dear = false;
    unsigned taken = 0;
    while (taken < SAMPLES_A_TURN && selfcal_imu_room(&app->imu) && take_sample(app, &dear)) {
        taken++;
    }
    /* The end of a dear window and a slice do not add up in one turn. But a report is not put off twice in a row. */
    app->put_off = dear && !app->put_off;
    if (app->put_off) {
        return true;
    }
    bool busy = taken > 0U;
    if (app->imu.computing) {
        app_compute(app);
        busy = true;
    }
    busy = app_send_frames(app) || busy;
    if (!app->waiting) {
        busy = app_begin_frames(app) || (!app->imu.computing && app_advance(app)) || begin_corrected(app) || busy;
    }
    if (!busy) {
        if (app->finished && !app->waiting) {
            return false;
        }
        app->port->idle(app->port->context);
    }
    return true;
}
