/* The main loop: a turn takes the samples that wait, one slice of a report, and as many frames as the wire takes. */
#include "app_parts.h"

#include <string.h>

enum { SAMPLES_A_TURN = 64 };

/* A Cortex-M0 at 16 MHz takes half a minute over an axis's report, and a port takes a frame or drops it within a
 * second. After so long neither will ever come about. */
#define PATIENCE_MS 300000U

unsigned port_axis(const char *name)
{
    static const char *const names[PORT_AXES] = {"gx", "gy", "gz", "ax", "ay", "az"};
    unsigned at = 0;
    while (at < PORT_AXES && strcmp(name, names[at]) != 0) {
        at++;
    }
    return at;
}

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
    app_begin_columns(app);
#if APP_COMMANDS
    app_begin_commands(app);
#endif
    const selfcal_status_t wire = selfcal_telemetry_init(&app->telemetry, &selfcal_model, selfcal_model_axis_name);
    selfcal_telemetry_module(&app->telemetry, &app->told);
    return wire == SELFCAL_OK ? app_node(app, SELFCAL_NODE) : wire;
}

selfcal_status_t app_node(app_t *app, uint8_t node)
{
    return selfcal_telemetry_node(&app->telemetry, node);
}

void app_power_on(app_t *app, uint64_t samples)
{
    (void)selfcal_power_on(&app->bank, samples);
    app_begin_columns(app);
}

bool app_gate(app_t *app)
{
#if SELFCAL_MODEL_GATE
    app->learn_at = SELFCAL_GATE_MEASURED_MIN;
    app->gated = selfcal_gate_init(&app->gate, &selfcal_model_gate) == SELFCAL_OK;
    return app->gated;
#else
    (void)app;
    return false;
#endif
}

void app_module(app_t *app, const port_module_t *module)
{
    app->module = module;
    app_restore(app);
    app->saved_ms = app_now(app);
}

bool app_healthy(const app_t *app)
{
    const uint32_t now = app_now(app);
    return !app->corrupt && (!app->computing || now - app->begun_ms < PATIENCE_MS) &&
           (!app->refused || now - app->refused_ms < PATIENCE_MS);
}

static bool begin_corrected(app_t *app)
{
#if APP_CORRECTED_MS
    return app_begin_corrected(app);
#else
    (void)app;
    return false;
#endif
}

/* Windows so far whose end was dear. */
static uint32_t dear_windows(const app_t *app)
{
#if SELFCAL_MODEL_GATE
    return app->gate.at_once;
#else
    (void)app;
    return 0;
#endif
}

/* True if one more sample, or a gap before it, cannot overtake a report under way. With no room for a bank sample an
 * interval may still end without one: less than half of its samples are usable then. */
static bool has_room(const app_t *app)
{
    const uint32_t block = app->bank.block, used = app->bank.used + 1U;
    return !app->computing || selfcal_room(&app->bank) > 0U || used < block - used;
}

bool app_step(app_t *app)
{
    /* Samples go on during a report as long as there is room for them beside its sums. Then they wait in the port's
     * queue. On a slow core several come during one slice. */
    const uint32_t dear = dear_windows(app);
    bool busy = false;
    for (unsigned taken = 0; taken < SAMPLES_A_TURN && has_room(app) && app_take_sample(app); taken++) {
        busy = true;
    }
    /* The end of a dear window and a slice do not add up in one turn. But a report is not put off twice in a row. */
    app->put_off = dear_windows(app) != dear && !app->put_off;
    if (app->put_off) {
        return true;
    }
    busy = (app->computing && app_compute(app)) || busy;
    busy = app_send_frames(app) || busy;
    if (!app->waiting) {
        busy = app_begin_frames(app) || (!app->computing && app_advance(app)) || begin_corrected(app) || busy;
    }
    if (!busy) {
        if (app->finished && !app->waiting) {
            return false;
        }
        app->port->idle(app->port->context);
    }
    return true;
}
