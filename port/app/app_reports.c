/* Reports: when one is due, each axis in turn, in slices; with regressors the likelier of two. */
#include "app_parts.h"

#include <math.h>

#if SELFCAL_MODEL_REGRESSORS > 0
/* ln evidence of a report over its laws, weighed by their priors. */
static selfcal_wide_t ln_evidence(const selfcal_report_t *report)
{
    selfcal_wide_t top = -(selfcal_wide_t)INFINITY, sum = 0.0, each[SELFCAL_MODEL_HYPOTHESES];
    for (uint8_t h = 0; h < SELFCAL_MODEL_HYPOTHESES; h++) {
        each[h] = report->hypothesis[h].ln_evidence + (selfcal_wide_t)selfcal_model.hypothesis[h].ln_probability;
        top = each[h] > top ? each[h] : top;
    }
    for (uint8_t h = 0; h < SELFCAL_MODEL_HYPOTHESES; h++) {
        sum += isfinite(top) && each[h] > top - 700.0 ? exp(each[h] - top) : 0.0;
    }
    return top + log(sum);
}

/* The report without regressors is followed by one with all that the axis has. The likelier of both is sent, with the
 * probability of the second. Returns true if the second has begun. */
static bool weigh(app_t *app)
{
    const uint8_t axis = app->report.axis;
    const float *sd = &selfcal_model.regressors->coefficient_sd[(size_t)axis * SELFCAL_MODEL_REGRESSORS];
    const float *ln_odds = &selfcal_model.regressors->ln_odds[(size_t)axis * SELFCAL_MODEL_REGRESSORS];
    uint8_t mask = 0;
    selfcal_wide_t odds = 0.0;
    for (uint8_t k = 0; k < SELFCAL_MODEL_REGRESSORS; k++) {
        if (sd[k] > 0.0F) {
            mask |= (uint8_t)(1U << k);
            odds += (selfcal_wide_t)ln_odds[k];
        }
    }
    if (!app->with) {
        app->ln_without = ln_evidence(&app->report);
        app->with = mask != 0U && selfcal_report_begin_subset(&app->work, &app->bank, axis, mask, app->coefficients,
                                                              &app->report_with) == SELFCAL_OK;
        selfcal_telemetry_coefficients(&app->telemetry, NULL);
        return app->with;
    }
    app->with = false;
    const selfcal_wide_t gain = odds + ln_evidence(&app->report_with) - app->ln_without;
    const float probability = isfinite(gain) ? (float)(1.0 / (1.0 + exp(gain < -700.0 ? 700.0 : -gain))) : 0.0F;
    selfcal_mix_coefficients(&app->report_with, &selfcal_model, app->coefficients, probability, app->sent);
    selfcal_telemetry_coefficients(&app->telemetry, app->sent);
    if (probability > 0.5F) {
        app->report = app->report_with;
    }
    for (uint8_t k = 0; k < SELFCAL_MODEL_REGRESSORS; k++) {
        const bool used = probability > 0.5F && (mask >> k & 1U) != 0U && isfinite(app->sent[k].mean);
        app->used[axis][k] = used ? app->sent[k].mean : 0.0F;
#if APP_CORRECTED_MS
        app->rested[axis][k] = selfcal_regressor_last(&app->bank, k);
#endif
    }
    return false;
}
#endif

/* The judgement goes out with the report, which the next epoch goes by. */
static void judge(app_t *app)
{
    const uint8_t axis = app->report.axis;
    selfcal_adequacy_state_t state = SELFCAL_NOT_JUDGED;
#if APP_ADEQUACY
#if SELFCAL_MODEL_REGRESSORS > 0
    const float *used = app->used[axis];
#else
    const float *used = NULL;
#endif
    selfcal_adequacy_report(&app->adequacy, &selfcal_model, &app->report, used);
    app->judged = selfcal_judgement(&app->adequacy, &app->bank, axis);
    selfcal_telemetry_adequacy(&app->telemetry, &app->judged);
    state = app->judged.state;
#endif
    app->reason[axis] = selfcal_reason(&selfcal_model, &app->report, state);
}

bool app_compute(app_t *app)
{
#if APP_CORRECTED_MS
    if (!app->work.gathered) {
        app->gathered_at = app->passed - app->bank.position;
    }
#endif
#if SELFCAL_MODEL_REGRESSORS > 0
    const selfcal_status_t status = selfcal_report_step(&app->work, app->with ? &app->report_with : &app->report);
#else
    const selfcal_status_t status = selfcal_report_step(&app->work, &app->report);
#endif
    if (status == SELFCAL_BUSY) {
        return true;
    }
#if SELFCAL_MODEL_REGRESSORS > 0
    if (status == SELFCAL_OK && weigh(app)) {
        return true;
    }
    app->with = false;
#endif
    app->computing = false;
    app->worked_out = status == SELFCAL_OK;
    if (app->worked_out) {
        judge(app);
    }
#if APP_CORRECTED_MS
    if (app->worked_out) {
        app_keep_report(app);
    }
#endif
#if APP_COMMANDS
    if (app->worked_out) {
        app->bias[app->report.axis] = app->report.bias_mean;
    }
#endif
    return true;
}

/* Between reports: saves, obeys, and begins the next report or a status if one is due. */
static bool between_reports(app_t *app, uint32_t now)
{
    const bool due = (int32_t)(now - app->due_ms) >= 0;
    if (app->module != NULL && now - app->saved_ms >= app->module->save_period_ms) {
        app_save(app, now);
    }
#if APP_COMMANDS
    app_obey(app, now);
    if (app->restarting) {
        return true; /* its answer is next, and nothing else */
    }
#endif
    app->corrupt = app->corrupt || (due && selfcal_check(&app->bank) != SELFCAL_OK);
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
        (void)selfcal_telemetry_status(&app->telemetry, selfcal_counters(&app->bank), SELFCAL_FINISHED,
                                       app->report_number, now);
        return true;
    }
    if (app_status_due(app, now)) {
        app_tell_status(app, now);
        return true;
    }
    return false;
}

bool app_advance(app_t *app)
{
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
        const uint8_t axis = (uint8_t)(app->stage - STAGE_AXES);
        app->begun_ms = now; /* too short: no report yet */
        app->computing = selfcal_report_begin(&app->work, &app->bank, axis, &app->report) == SELFCAL_OK;
    }
    app->stage = (uint8_t)(app->stage < STAGE_END ? app->stage + 1 : STAGE_NONE);
    return true;
}

