#include "app.h"

#include <math.h>
#include <string.h>

#include "selfcal_frames.h"

enum { SAMPLES_A_TURN = 64 };
enum { STAGE_NONE = 0, STAGE_STATUS = 1, STAGE_AXES = 2, STAGE_END = STAGE_AXES + SELFCAL_MODEL_AXES };

/* A Cortex-M0 at 16 MHz takes half a minute over an axis's report, and a port takes a frame or drops it within a second; what has not come
 * about after so long never will. */
#define PATIENCE_MS 300000U

/* Between statuses of a module, at most. */
#define STATUS_MS 10000U

unsigned port_axis(const char *name)
{
    static const char *const names[PORT_AXES] = {"gx", "gy", "gz", "ax", "ay", "az"};
    unsigned at = 0;
    while (at < PORT_AXES && strcmp(name, names[at]) != 0) {
        at++;
    }
    return at;
}

/* The regressors' values go on from what the bank has seen. */
static void begin_columns(app_t *app)
{
#if SELFCAL_MODEL_REGRESSORS > 0
    const selfcal_counters_t *seen = selfcal_counters(&app->bank);
    (void)selfcal_former_init(&app->former, &selfcal_model);
    selfcal_former_pass(&app->former, seen->samples + seen->missing);
#if APP_CORRECTED_MS
    memset(app->used, 0, sizeof app->used);
#endif
#else
    (void)app;
#endif
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
    begin_columns(app);
#if APP_COMMANDS
    for (size_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        app->bias[axis] = NAN;
    }
#endif
    const selfcal_status_t wire = selfcal_telemetry_init(&app->telemetry, &selfcal_model, selfcal_model_axis_name);
    selfcal_telemetry_module(&app->telemetry, &app->told);
    return wire == SELFCAL_OK ? app_node(app, SELFCAL_NODE) : wire;
}

selfcal_status_t app_node(app_t *app, uint8_t node)
{
    return selfcal_telemetry_node(&app->telemetry, node);
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

/* What the bank knows the sensor to add, into a sensor that may have forgotten. */
static bool tell_sensor(app_t *app)
{
    float wanted[SELFCAL_MODEL_AXES], got[SELFCAL_MODEL_AXES];
    bool any = false;
    for (uint8_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        wanted[axis] = selfcal_shifted(&app->bank, axis);
        any = any || wanted[axis] != 0.0F;
    }
    return !any || app->module->write_offsets(app->module->context, wanted, got);
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
            /* Up to the start of a bank interval: it holds whole windows of the gate. */
            (void)selfcal_moving(&app->bank);
            const uint64_t block = app->bank.block, past = (app->bank.position + module->save_gap) % block;
            (void)selfcal_skip(&app->bank, module->save_gap + (past > 0U ? block - past : 0U));
            (void)tell_sensor(app);
            begin_columns(app);
            app->told.state_found = older == 0 ? SELFCAL_STATUS_STATE_FOUND_NEWEST : SELFCAL_STATUS_STATE_FOUND_OLDER;
            app->restored = true;
            return;
        }
        app->told.state_refused = (uint32_t)-status;
        app->told.state_found = SELFCAL_STATUS_STATE_FOUND_REFUSED;
    }
}

void app_module(app_t *app, const port_module_t *module)
{
    app->module = module;
    restore(app);
    app->saved_ms = app->port->time_ms(app->port->context);
}

bool app_healthy(const app_t *app)
{
    const uint32_t now = app->port->time_ms(app->port->context);
    return !app->corrupt && (!app->computing || now - app->begun_ms < PATIENCE_MS) &&
           (!app->refused || now - app->refused_ms < PATIENCE_MS);
}

/* `count` samples are missing. */
static void pass(app_t *app, uint32_t count)
{
#if SELFCAL_MODEL_GATE
    if (app->gated && selfcal_gate_skip(&app->gate, count) == SELFCAL_MOVING) {
        (void)selfcal_moving(&app->bank);
    }
#endif
    (void)selfcal_skip(&app->bank, count);
}

/* Samples from the start, or the last call, to now. */
static uint32_t absent(app_t *app)
{
    const uint32_t now = app->port->time_ms(app->port->context);
    const double passed = 1e-3 * (double)(now - app->absent_ms) * (double)SELFCAL_MODEL_RATE_HZ;
    app->absent_ms = now;
    return (uint32_t)passed;
}

/* Between reports, because the bank must stand still. */
static void save(app_t *app, uint32_t now)
{
    const port_module_t *module = app->module;
    const uint32_t count = app->restored ? absent(app) : 0U;
    if (count > 0U) {
        pass(app, count);
        begin_columns(app);
    }
    app->saved_ms = now;
    /* The state in use is the one to be kept, though the newest be whole: start-up may have refused that as another model's. */
    const bool keep_older = app->told.state_found == SELFCAL_STATUS_STATE_FOUND_OLDER && app->told.state_saves == 0U;
    const bool whole = module->save_begin(module->context, keep_older) &&
                       selfcal_save(&app->bank, module->save_put, module->context) == SELFCAL_OK;
    if (module->save_end(module->context, whole)) {
        app->told.state_saves++;
    } else {
        app->told.state_save_failures++;
    }
}

#if APP_CORRECTED_MS
/* Whether the bank will keep this sample out for a fault of the sensor's, which it then counts. */
static bool faulty(const app_t *app, const float reading[])
{
    for (uint8_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        const float range = selfcal_model.axis[axis].range;
        if (!selfcal_retired(&app->bank, axis) && (!isfinite(reading[axis]) || (range > 0.0F && fabsf(reading[axis]) >= range))) {
            return true;
        }
    }
    return false;
}
#endif

#if SELFCAL_MODEL_GATE
/* Takes what the gate has measured at rest for its noise, after SELFCAL_GATE_MEASURED_MIN windows of it and whenever there are twice as
 * many. */
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
            (void)selfcal_gate_noise(&app->gate, axis, &noise); /* refused if a factor is 0, as that of a record without noise */
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

#if APP_CORRECTED_MS
static bool stuck(const app_t *app, uint8_t axis)
{
    const uint32_t limit = selfcal_model.axis[axis].stuck_limit;
    return limit > 0U && app->bank.equal[axis] >= limit;
}
#endif

static bool take_sample(app_t *app)
{
    float reading[SELFCAL_MODEL_AXES + SELFCAL_MODEL_CHANNELS];
    const float *values = NULL;
    uint32_t missing = 0;
    switch (app->port->sample(app->port->context, reading, &missing)) {
    case PORT_SAMPLE:
        if (app->restored) { /* the driver's first: what passed since the start is missing as well */
            app->restored = false;
            missing += absent(app);
        }
        if (missing > 0) {
            pass(app, missing);
        }
#if SELFCAL_MODEL_REGRESSORS > 0
        float formed[SELFCAL_MODEL_REGRESSORS];
        const float *channels = SELFCAL_MODEL_CHANNELS > 0U ? reading + SELFCAL_MODEL_AXES : NULL;
        selfcal_form(&app->former, missing, reading, channels, formed);
        values = formed;
#if APP_CORRECTED_MS
        memcpy(app->values, formed, sizeof formed);
#endif
#endif
        give(app, reading, values);
        app->fresh = true;
#if APP_CORRECTED_MS
        app->passed += (uint64_t)missing + 1U;
        memcpy(app->reading, reading, sizeof app->reading);
        app->reading_ms = app->port->time_ms(app->port->context);
        app->newer = true;
#endif
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
        if (!app->waiting) {
            return sent;
        }
        if (!app->port->send(app->port->context, &app->frame)) {
            if (!app->refused) {
                app->refused_ms = app->port->time_ms(app->port->context);
            }
            app->refused = true;
            return sent;
        }
        app->refused = false;
        app->waiting = false;
        sent = true;
    }
}

static uint32_t motion(const app_t *app)
{
#if SELFCAL_MODEL_GATE
    if (app->gated) {
        return app->gate.state == SELFCAL_RESTING ? SELFCAL_STATUS_MOTION_RESTING : SELFCAL_STATUS_MOTION_MOVING;
    }
#endif
    (void)app;
    return SELFCAL_STATUS_MOTION_NOT_WATCHED;
}

/* What the status says of the module. */
static void tell(app_t *app)
{
    selfcal_module_t *told = &app->told;
    if (app->module != NULL) {
        app->module->tell(app->module->context, told);
    }
    told->motion = motion(app);
#if SELFCAL_MODEL_GATE
    told->gate_alarm_count = (uint32_t)app->gate.counters.alarms;
#endif
    told->retired = app->bank.retired;
    for (uint8_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        told->offset[axis] = selfcal_shifted(&app->bank, axis);
    }
}

#if APP_COMMANDS
/* -------------------------------------------------------------------------------------------------------------- commands */

static const uint64_t command_key[] = {APP_COMMAND_KEY};
typedef char the_key_has_two_halves[sizeof command_key == 16U ? 1 : -1];
enum { TELEMETRY_PERIOD_LEAST_MS = 100, AXIS_BITS = (1 << PORT_AXES) - 1 };
#define RESTART_MS 3000U /* at most for the answer to leave: the 2 KB before it take 2.1 s at 9600 baud */

static void answer(app_t *app, answer_t *to, uint8_t command, uint8_t result)
{
    app->told.command_count += result == SELFCAL_ANSWER_RESULT_DONE ? 1U : 0U;
    app->told.command_refused_count += result == SELFCAL_ANSWER_RESULT_DONE ? 0U : 1U;
    to->waiting = true;
    to->item = SELFCAL_ANSWER_RESULT;
    to->value = (uint32_t)command << SELFCAL_ANSWER_COMMAND_SHIFT | (uint32_t)result << SELFCAL_ANSWER_RESULT_SHIFT;
}

/* Bit of an axis of the model in a command. */
static uint32_t axis_bit(uint8_t axis)
{
    return 1UL << port_axis(selfcal_model_axis_name[axis]);
}

/* Has the sensor take off the biases of `axes`, or, with none, what it has been told to add. All that was learnt is kept. To take that
 * back is always possible: a sensor put in place of the one that was told may refuse it, and never run. */
static uint8_t write_offsets(app_t *app, uint32_t axes)
{
    float wanted[SELFCAL_MODEL_AXES], got[SELFCAL_MODEL_AXES];
    uint32_t found = 0;
    tell(app);
    if (axes != 0U &&
        (app->told.motion == SELFCAL_STATUS_MOTION_MOVING || app->told.sensor_state != SELFCAL_STATUS_SENSOR_STATE_RUNNING)) {
        return SELFCAL_ANSWER_RESULT_NOT_NOW;
    }
    for (uint8_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        const bool meant = (axes & axis_bit(axis)) != 0U;
        if (meant && (selfcal_retired(&app->bank, axis) || !isfinite(app->bias[axis]))) {
            return SELFCAL_ANSWER_RESULT_NOT_NOW;
        }
        found |= axis_bit(axis);
        wanted[axis] = axes == 0U ? 0.0F : selfcal_shifted(&app->bank, axis) - (meant ? app->bias[axis] : 0.0F);
    }
    if ((axes & ~found) != 0U) {
        return SELFCAL_ANSWER_RESULT_OUT_OF_RANGE;
    }
    if (!app->module->write_offsets(app->module->context, wanted, got)) {
        return SELFCAL_ANSWER_RESULT_FAILED;
    }
    for (uint8_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        const float amount = got[axis] - selfcal_shifted(&app->bank, axis);
        if (amount == 0.0F || selfcal_shift(&app->bank, axis, amount) != SELFCAL_OK) {
            continue;
        }
        app->bias[axis] += amount;
#if SELFCAL_MODEL_GATE
        if (app->gated) {
            selfcal_gate_shift(&app->gate, axis, amount);
        }
#endif
#if APP_CORRECTED_MS
        app->newer = false; /* the reading is one from before */
        app->last_report[axis].bias_mean += amount;
        for (uint8_t h = 0; h < SELFCAL_MODEL_HYPOTHESES; h++) {
            app->last_report[axis].hypothesis[h].bias_mean += amount;
        }
#endif
    }
    return SELFCAL_ANSWER_RESULT_DONE;
}

/* Begins anew with what the sensor adds. */
static uint8_t forget(app_t *app)
{
    float shifted[SELFCAL_MODEL_AXES];
    for (uint8_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        shifted[axis] = selfcal_shifted(&app->bank, axis);
    }
    const selfcal_status_t status = selfcal_init(&app->bank, &selfcal_model, app->memory, sizeof app->memory);
    for (uint8_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        (void)selfcal_shift(&app->bank, axis, shifted[axis]);
        app->bias[axis] = NAN;
#if APP_CORRECTED_MS
        app->has_report[axis] = false;
#endif
    }
    begin_columns(app);
    app->fresh = false;
    app->restored = false;
#if SELFCAL_MODEL_GATE
    if (app->gated) { /* its windows go on: the bank must start with one of them */
        (void)app_gate(app);
    }
#endif
    return status == SELFCAL_OK ? SELFCAL_ANSWER_RESULT_DONE : SELFCAL_ANSWER_RESULT_FAILED;
}

static uint8_t saved(app_t *app, uint32_t now)
{
    const uint32_t before = app->told.state_saves;
    save(app, now);
    return app->told.state_saves != before ? SELFCAL_ANSWER_RESULT_DONE : SELFCAL_ANSWER_RESULT_FAILED;
}

/* Between reports: the bank stands still. */
static void obey(app_t *app, uint32_t now)
{
    const uint8_t command = app->ordered;
    uint8_t result = SELFCAL_ANSWER_RESULT_DONE;
    command_pass(&app->command, now);
    if (command == 0U || app->answer[OF_ORDER].waiting || app->module == NULL) {
        return;
    }
    app->ordered = 0;
    if (command == SELFCAL_ANSWER_COMMAND_SAVE) {
        result = saved(app, now);
    } else if (command == SELFCAL_ANSWER_COMMAND_WRITE_OFFSETS) {
        result = write_offsets(app, app->argument);
    } else if (app->argument == 1U) {
        result = forget(app);
        if (result == SELFCAL_ANSWER_RESULT_DONE) {
            /* Or the next restart would bring back what was saved before; in both slots, since one may come to harm. */
            result = saved(app, now) == SELFCAL_ANSWER_RESULT_DONE ? saved(app, now) : SELFCAL_ANSWER_RESULT_FAILED;
        }
    } else {
        app->restarting = true;
        app->restart_ms = app->port->time_ms(app->port->context); /* `now` may be of before a save */
    }
    answer(app, &app->answer[OF_ORDER], command, result);
}

/* What is wrong with a command's argument or time. */
static uint8_t judge(const app_t *app, uint8_t command, uint32_t argument)
{
    bool in_range;
    switch (command) {
    case SELFCAL_ANSWER_COMMAND_RESET: in_range = argument <= 1U; break;
    case SELFCAL_ANSWER_COMMAND_SAVE: in_range = argument == 0U; break;
    case SELFCAL_ANSWER_COMMAND_TELEMETRY_PERIOD: in_range = argument >= TELEMETRY_PERIOD_LEAST_MS; break;
    case SELFCAL_ANSWER_COMMAND_WRITE_OFFSETS: in_range = argument <= AXIS_BITS; break;
    default: return SELFCAL_ANSWER_RESULT_UNKNOWN;
    }
    const bool now = app->ordered == 0U && !app->restarting && app->module != NULL;
    return !in_range ? SELFCAL_ANSWER_RESULT_OUT_OF_RANGE : now ? SELFCAL_ANSWER_RESULT_DONE : SELFCAL_ANSWER_RESULT_NOT_NOW;
}

void app_command(app_t *app, const uint8_t data[8])
{
    const uint32_t now = app->port->time_ms(app->port->context);
    const uint8_t command = data[0];
    const uint32_t argument = (uint32_t)data[1] | (uint32_t)data[2] << 8 | (uint32_t)data[3] << 16;
    answer_t *at_once = &app->answer[AT_ONCE];
    if (command == SELFCAL_ANSWER_COMMAND_CHALLENGE) {
        uint32_t number = 0;
        const bool asked = argument == 0U && data[4] == 0U && data[5] == 0U && data[6] == 0U && data[7] == 0U;
        if (asked && app->module != NULL && app->module->random(app->module->context, &number) &&
            command_open(&app->command, number, now)) {
            at_once->waiting = true;
            at_once->item = SELFCAL_ANSWER_CHALLENGE;
            at_once->value = app->command.challenge;
        } else {
            answer(app, at_once, command, asked ? SELFCAL_ANSWER_RESULT_NOT_NOW : SELFCAL_ANSWER_RESULT_OUT_OF_RANGE);
        }
        return;
    }
    uint8_t result = command_check(&app->command, command_key, data, now);
    if (result == SELFCAL_ANSWER_RESULT_DONE) {
        result = judge(app, command, argument);
    }
    if (result != SELFCAL_ANSWER_RESULT_DONE || command == SELFCAL_ANSWER_COMMAND_TELEMETRY_PERIOD) {
        if (result == SELFCAL_ANSWER_RESULT_DONE) {
            app->period_ms = argument;
            app->due_ms = now + argument;
        }
        answer(app, at_once, command, result);
        return;
    }
    app->ordered = command;
    app->argument = argument;
}
#endif

static void tell_status(app_t *app, uint32_t now)
{
    tell(app);
    (void)selfcal_telemetry_status(&app->telemetry, selfcal_counters(&app->bank), SELFCAL_RUNNING, app->report_number, now);
    app->told_ms = now;
}

/* How the module is does not wait: not for a report that is far off, nor for the end of one. */
static bool status_due(const app_t *app, uint32_t now)
{
    return app->module != NULL && now - app->told_ms >= STATUS_MS;
}

/* Begins a report when one is due, and goes from its status over the axes to its end. Only with all frames out. */
static bool advance(app_t *app)
{
    const uint32_t now = app->port->time_ms(app->port->context);
    const selfcal_counters_t *counters = selfcal_counters(&app->bank);
    if (app->stage == STAGE_NONE) {
        const bool due = (int32_t)(now - app->due_ms) >= 0;
        if (app->module != NULL && now - app->saved_ms >= app->module->save_period_ms) {
            save(app, now);
        }
#if APP_COMMANDS
        obey(app, now);
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
        } else if (app->ended && !app->finished) {
            app->finished = true;
            tell(app);
            (void)selfcal_telemetry_status(&app->telemetry, counters, SELFCAL_FINISHED, app->report_number, now);
            return true;
        } else if (status_due(app, now)) {
            tell_status(app, now);
            return true;
        } else {
            return false;
        }
    }
    if (app->stage == STAGE_STATUS) {
        tell_status(app, now);
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
    uint8_t mask = 0;
    selfcal_wide_t odds = 0.0;
    for (uint8_t k = 0; k < SELFCAL_MODEL_REGRESSORS; k++) {
        if (sd[k] > 0.0F) {
            mask |= (uint8_t)(1U << k);
            odds += (selfcal_wide_t)selfcal_model.regressors->ln_odds[k];
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
#if APP_CORRECTED_MS
    for (uint8_t k = 0; k < SELFCAL_MODEL_REGRESSORS; k++) {
        const bool used = probability > 0.5F && (mask >> k & 1U) != 0U && isfinite(app->sent[k].mean);
        app->used[axis][k] = used ? app->sent[k].mean : 0.0F;
        app->rested[axis][k] = selfcal_regressor_last(&app->bank, k);
    }
#endif
    return false;
}
#endif

static bool compute(app_t *app)
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
#if APP_CORRECTED_MS
    if (app->worked_out) {
        app->last_report[app->report.axis] = app->report;
        app->has_report[app->report.axis] = isfinite(app->report.bias_mean); /* it is NaN if the record lies outside the priors */
        app->rests_on[app->report.axis] = app->gathered_at;
    }
#endif
#if APP_COMMANDS
    if (app->worked_out) {
        app->bias[app->report.axis] = app->report.bias_mean;
    }
#endif
    return true;
}

#if APP_CORRECTED_MS
/* The newest sample less the bias predicted for its time. */
static void correct(app_t *app)
{
    for (uint8_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        const uint64_t since = app->passed - app->rests_on[axis];
        float bias = NAN, sd = NAN;
        if (app->has_report[axis] && !selfcal_retired(&app->bank, axis) && !stuck(app, axis)) {
            (void)selfcal_predict(&app->last_report[axis], &selfcal_model, (float)since / SELFCAL_MODEL_RATE_HZ, &bias, &sd);
        }
#if SELFCAL_MODEL_REGRESSORS > 0
        for (uint8_t k = 0; k < SELFCAL_MODEL_REGRESSORS; k++) { /* the report's bias holds for the values at its end */
            bias += app->used[axis][k] * (app->values[k] - app->rested[axis][k]);
        }
#endif
        app->corrected.value[axis] = app->reading[axis] - bias;
        app->corrected.sd[axis] = sd;
    }
    app->corrected.motion = motion(app);
}
#endif

/* Begins what does not wait for a report's end: the report worked out, an answer, a status. Only with all frames out. */
static bool begin_frames(app_t *app)
{
    const uint32_t now = app->port->time_ms(app->port->context);
    if (app->worked_out) {
        app->worked_out = false;
        (void)selfcal_telemetry_report(&app->telemetry, &app->report, selfcal_counters(&app->bank), app->begun_ms);
        return true;
    }
#if APP_COMMANDS
    for (unsigned i = 0; i < ANSWERS; i++) {
        if (app->answer[i].waiting) {
            app->answer[i].waiting = false;
            (void)selfcal_telemetry_answer(&app->telemetry, app->answer[i].item, app->answer[i].value, now);
            return true;
        }
    }
    if (app->restarting) { /* and nothing else is sent */
        if (app->module->sent(app->module->context) || now - app->restart_ms > RESTART_MS) {
            app->module->restart(app->module->context);
        }
        return true;
    }
#endif
    if (app->stage != STAGE_NONE && status_due(app, now)) { /* between reports advance() looks: one may begin with it */
        tell_status(app, now);
        return true;
    }
    return false;
}

/* A corrected sample, if one is due, of a sample that none has been of, and that is sound. After all else: on a wire too slow for them
 * one would always be. */
static bool begin_corrected(app_t *app)
{
#if APP_CORRECTED_MS
    const uint32_t now = app->port->time_ms(app->port->context);
    const bool due = app->newer && now - app->corrected_ms >= APP_CORRECTED_MS && !app->corrupt;
    if (due) {
        app->newer = false;
    }
    if (due && !faulty(app, app->reading)) {
        app->corrected_ms = now;
        correct(app);
        (void)selfcal_telemetry_corrected(&app->telemetry, &app->corrected, app->reading_ms);
        return true;
    }
#endif
    (void)app;
    return false;
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

/* Whether one more sample cannot overtake a report under way, nor a gap before it: where there is room for no bank sample, an interval
 * less than half of whose samples are usable ends without one. */
static bool has_room(const app_t *app)
{
    const uint32_t block = app->bank.block, used = app->bank.used + 1U;
    return !app->computing || selfcal_room(&app->bank) > 0U || used < block - used;
}

bool app_step(app_t *app)
{
    /* Samples go on during a report, as long as there is room for them beside its sums: then they wait in the port's queue. On a slow
     * core several come during one slice. */
    const uint32_t dear = dear_windows(app);
    bool busy = false;
    for (unsigned taken = 0; taken < SAMPLES_A_TURN && has_room(app) && take_sample(app); taken++) {
        busy = true;
    }
    /* Such a sample and a slice do not add up in one turn; but a report is not put off twice in a row. */
    app->put_off = dear_windows(app) != dear && !app->put_off;
    if (app->put_off) {
        return true;
    }
    busy = (app->computing && compute(app)) || busy;
    busy = send_frames(app) || busy;
    if (!app->waiting) {
        busy = begin_frames(app) || (!app->computing && advance(app)) || begin_corrected(app) || busy;
    }
    if (!busy) {
        if (app->finished && !app->waiting) {
            return false;
        }
        app->port->idle(app->port->context);
    }
    return true;
}
