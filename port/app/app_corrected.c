/* Corrected samples: the newest sample less the bias predicted for its time. Built in with APP_CORRECTED_MS. */
#include "app_parts.h"

#include <math.h>
#include <string.h>

#if APP_CORRECTED_MS

void app_keep_sample(app_t *app, const float reading[], uint32_t missing)
{
    app->passed += (uint64_t)missing + 1U;
    memcpy(app->reading, reading, sizeof app->reading);
    app->reading_ms = app_now(app);
    app->newer = true;
}

void app_keep_report(app_t *app)
{
    const uint8_t axis = app->report.axis;
    app->last_report[axis] = app->report;
    app->rests_on[axis] = app->gathered_at;
}

/* True if the bank keeps this sample out for a fault of the sensor's. */
static bool faulty(const app_t *app, const float reading[])
{
    for (uint8_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        const float range = selfcal_model.axis[axis].range;
        const bool bad = !isfinite(reading[axis]) || (range > 0.0F && fabsf(reading[axis]) >= range);
        if (bad && !selfcal_retired(&app->bank, axis)) {
            return true;
        }
    }
    return false;
}

static bool stuck(const app_t *app, uint8_t axis)
{
    const uint32_t limit = selfcal_model.axis[axis].stuck_limit;
    return limit > 0U && app->bank.equal[axis] >= limit;
}

/* Why there is no corrected sample of an axis, or why it is not to be relied on. */
static selfcal_reason_t reason_of(const app_t *app, uint8_t axis, bool is_faulty)
{
    const selfcal_reason_t known = app_reason(app, axis);
    if (known == SELFCAL_REASON_RETIRED) {
        return known;
    }
    return is_faulty ? SELFCAL_REASON_BAD_SAMPLE : stuck(app, axis) ? SELFCAL_REASON_STUCK : known;
}

/* The newest sample less the bias predicted for its time. */
static void correct(app_t *app)
{
    const bool is_faulty = faulty(app, app->reading);
    for (uint8_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        const uint64_t since = app->passed - app->rests_on[axis];
        const selfcal_reason_t reason = reason_of(app, axis, is_faulty);
        float bias = NAN, sd = NAN;
        if (reason == SELFCAL_REASON_NONE || reason == SELFCAL_REASON_INADEQUATE ||
            reason == SELFCAL_REASON_NOT_IDENTIFIED) {
            const float elapsed_s = (float)since / SELFCAL_MODEL_RATE_HZ;
            (void)selfcal_predict(&app->last_report[axis], &selfcal_model, elapsed_s, &bias, &sd);
        }
#if SELFCAL_MODEL_REGRESSORS > 0
        for (uint8_t k = 0; k < SELFCAL_MODEL_REGRESSORS; k++) { /* the report's bias holds for the values at its end */
            bias += app->used[axis][k] * (app->values[k] - app->rested[axis][k]);
        }
#endif
        app->corrected.value[axis] = app->reading[axis] - bias;
        app->corrected.sd[axis] = sd;
        app->corrected.reason[axis] = reason;
    }
    app->corrected.motion = app_motion(app);
}

bool app_begin_corrected(app_t *app)
{
    const uint32_t now = app_now(app);
    const bool due = app->newer && now - app->corrected_ms >= APP_CORRECTED_MS && !app->corrupt;
    if (due) {
        app->newer = false;
        app->corrected_ms = now;
        correct(app);
        (void)selfcal_telemetry_corrected(&app->telemetry, &app->corrected, app->reading_ms);
    }
    return due;
}

#endif
