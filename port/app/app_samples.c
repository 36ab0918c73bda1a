/* Samples: from the port through the gate into the bank. */
#include "app_parts.h"

#include <math.h>
#include <string.h>

void app_begin_columns(app_t *app)
{
#if SELFCAL_MODEL_REGRESSORS > 0
    (void)selfcal_former_resume(&app->former, &app->bank);
    memset(app->used, 0, sizeof app->used);
#endif
#if APP_ADEQUACY
    (void)selfcal_adequacy_init(&app->adequacy, &app->bank);
#if SELFCAL_MODEL_CHANGES
    (void)selfcal_changes_init(&app->changes, &app->adequacy, &app->bank, app->learned);
#endif
#endif
    for (uint8_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        app->reason[axis] = SELFCAL_REASON_NO_REPORT;
    }
}

void app_pass(app_t *app, uint32_t count)
{
#if SELFCAL_MODEL_GATE
    if (app->gated && selfcal_gate_skip(&app->gate, count) == SELFCAL_MOVING) {
        (void)selfcal_moving(&app->bank);
    }
#endif
    (void)selfcal_skip(&app->bank, count);
}

uint32_t app_absent(app_t *app)
{
    const uint32_t now = app_now(app);
    const double passed = 1e-3 * (double)(now - app->absent_ms) * (double)SELFCAL_MODEL_RATE_HZ;
    app->absent_ms = now;
    return (uint32_t)passed;
}

#if SELFCAL_MODEL_GATE
/* Gives the gate the noise that it has measured at rest: after SELFCAL_GATE_MEASURED_MIN windows, and whenever there
 * are twice as many. */
static void learn_noise(app_t *app)
{
    if (app->gate.measured == 0U) { /* at the start, and when the noise has become another */
        app->learn_at = SELFCAL_GATE_MEASURED_MIN;
    }
    if (app->gate.measured < app->learn_at) {
        return;
    }
    app->learn_at *= 2U;
    for (uint8_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        selfcal_gate_noise_t noise;
        if (isfinite(app->gate.axis[axis].sigma) && selfcal_gate_measured(&app->gate, axis, &noise) == SELFCAL_OK) {
            (void)selfcal_gate_noise(&app->gate, axis, &noise); /* refused if a factor is 0: a record without noise */
        }
    }
}

/* An axis that is retired says nothing of motion. */
static void leave_out_retired(app_t *app)
{
    const selfcal_gate_noise_t nothing = {INFINITY, 1.0F, 1.0F, 1.0F};
    for (uint8_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        if (selfcal_retired(&app->bank, axis) && isfinite(app->gate.axis[axis].sigma)) {
            (void)selfcal_gate_noise(&app->gate, axis, &nothing);
        }
    }
}
#endif

#if APP_ADEQUACY && SELFCAL_MODEL_CHANGES
/* Where something has changed the last reports are of the past: there is no corrected sample until the next ones, which
 * are due at once. */
static void handle_changes(app_t *app)
{
    const uint32_t changed = selfcal_changes_handle(&app->adequacy, &app->bank);
    if (changed == 0U) {
        return;
    }
    app->due_ms = app_now(app);
    for (uint8_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        if ((changed >> axis & 1U) != 0U) {
            app->reason[axis] = SELFCAL_REASON_NO_REPORT;
        }
    }
}
#endif

/* By the rule at selfcal_push_moving(). */
static void give(app_t *app, const float reading[], const float values[])
{
#if SELFCAL_MODEL_GATE
    if (app->gated) {
        if (app->bank.retired != 0U) { /* also from the saved state */
            leave_out_retired(app);
        }
        const bool in_step = app->gate.position == 0U || selfcal_counters(&app->bank)->samples > 0U;
        const selfcal_motion_t before = app->gate.state;
        const selfcal_motion_t now = selfcal_gate_push(&app->gate, reading);
        learn_noise(app);
        if (before == SELFCAL_MOVING || now == SELFCAL_MOVING || !in_step) {
            (void)selfcal_push_moving(&app->bank, reading);
            return;
        }
    }
#endif
    (void)selfcal_push_with(&app->bank, reading, values); /* what it rejects it counts */
}

bool app_take_sample(app_t *app)
{
    float reading[SELFCAL_MODEL_AXES + SELFCAL_MODEL_CHANNELS + PORT_SIDE];
    const float *values = NULL;
    uint32_t missing = 0;
    switch (app->port->sample(app->port->context, reading, &missing)) {
    case PORT_SAMPLE:
        if (app->restored) { /* the driver's first: the samples since the start are missing as well */
            app->restored = false;
            missing += app_absent(app);
        }
        if (missing > 0) {
            app_pass(app, missing);
        }
#if SELFCAL_MODEL_REGRESSORS > 0
        float formed[SELFCAL_MODEL_REGRESSORS];
        selfcal_form(&app->former, missing, reading, reading + SELFCAL_MODEL_AXES, formed);
        values = formed;
#if APP_CORRECTED_MS
        memcpy(app->values, formed, sizeof formed);
#endif
#endif
        give(app, reading, values);
#if APP_ADEQUACY
        const float *side = reading + SELFCAL_MODEL_AXES + SELFCAL_MODEL_CHANNELS;
        selfcal_adequacy_push(&app->adequacy, &app->bank, side, values);
#if SELFCAL_MODEL_CHANGES
        handle_changes(app);
#endif
#endif
        app->fresh = true;
#if APP_CORRECTED_MS
        app_keep_sample(app, reading, missing);
#endif
        return true;
    case PORT_END: app->ended = true; return false;
    default: return false;
    }
}

