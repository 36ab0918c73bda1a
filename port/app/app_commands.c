/* Commands (command.h): judged and answered as they come, obeyed between reports. Built in with APP_COMMAND_KEY. */
#include "app_parts.h"

#include <math.h>

#if APP_COMMANDS

static const uint64_t command_key[] = {APP_COMMAND_KEY};
typedef char the_key_has_two_halves[sizeof command_key == 16U ? 1 : -1];
enum { TELEMETRY_PERIOD_LEAST_MS = 100, AXIS_BITS = (1 << PORT_AXES) - 1 };
#define RESTART_MS 3000U /* at most for the answer to leave: the 2 KB before it take 2.1 s at 9600 baud */

static void answer(app_t *app, answer_t *to, uint8_t command, uint8_t result) {
    app->told.command_count += result == SELFCAL_ANSWER_RESULT_DONE ? 1U : 0U;
    app->told.command_refused_count += result == SELFCAL_ANSWER_RESULT_DONE ? 0U : 1U;
    to->waiting = true;
    to->item = SELFCAL_ANSWER_RESULT;
    to->value = (uint32_t)command << SELFCAL_ANSWER_COMMAND_SHIFT | (uint32_t)result << SELFCAL_ANSWER_RESULT_SHIFT;
}

/* Bit of an axis of the model in a command. */
static uint32_t axis_bit(uint8_t axis) {
    return 1UL << port_axis(selfcal_model_axis_name[axis]);
}

/* Has the sensor take off the biases of `axes`, or, with none, take back all offsets. Everything learnt is kept. To
 * take offsets back is always possible: a sensor put in place of the one that was told may refuse it, and never run. */
static uint8_t write_offsets(app_t *app, uint32_t axes) {
    float wanted[SELFCAL_MODEL_AXES], got[SELFCAL_MODEL_AXES];
    uint32_t found = 0;
    app_tell(app);
    if (app_tumbles(app)) { /* rests of one calibration are read alike */
        return SELFCAL_ANSWER_RESULT_NOT_NOW;
    }
    if (axes != 0U && (app->told.motion == SELFCAL_STATUS_MOTION_MOVING ||
                       app->told.sensor_state != SELFCAL_STATUS_SENSOR_STATE_RUNNING)) {
        return SELFCAL_ANSWER_RESULT_NOT_NOW;
    }
    for (uint8_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        const bool meant = (axes & axis_bit(axis)) != 0U;
        if (meant && (selfcal_retired(&app->imu.bank, axis) || !isfinite(selfcal_imu_bias(&app->imu, axis)))) {
            return SELFCAL_ANSWER_RESULT_NOT_NOW;
        }
        found |= axis_bit(axis);
        const float bias = meant ? selfcal_imu_bias(&app->imu, axis) : 0.0F;
        wanted[axis] = axes == 0U ? 0.0F : selfcal_shifted(&app->imu.bank, axis) - bias;
    }
    if ((axes & ~found) != 0U) {
        return SELFCAL_ANSWER_RESULT_OUT_OF_RANGE;
    }
    if (!app->module->write_offsets(app->module->context, wanted, got)) {
        return SELFCAL_ANSWER_RESULT_FAILED;
    }
    for (uint8_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        const float amount = got[axis] - selfcal_shifted(&app->imu.bank, axis);
        if (amount != 0.0F) {
            (void)selfcal_imu_shift(&app->imu, axis, amount);
        }
    }
    return SELFCAL_ANSWER_RESULT_DONE;
}

static uint8_t forget(app_t *app) {
    app->fresh = false;
    app->restored = false;
    return selfcal_imu_forget(&app->imu) == SELFCAL_OK ? SELFCAL_ANSWER_RESULT_DONE : SELFCAL_ANSWER_RESULT_FAILED;
}

static uint8_t saved(app_t *app, uint32_t now) {
    const uint32_t before = app->told.state_saves;
    app_save(app, now);
    return app->told.state_saves != before ? SELFCAL_ANSWER_RESULT_DONE : SELFCAL_ANSWER_RESULT_FAILED;
}

/* Starts or stops a calibration by rests in several positions; a result is saved. */
static uint8_t tumble(app_t *app, uint32_t now) {
    if (!SELFCAL_MODEL_TUMBLED) {
        return SELFCAL_ANSWER_RESULT_UNKNOWN;
    }
    if (app->argument == 1U) {
        return selfcal_imu_tumble_start(&app->imu) ? SELFCAL_ANSWER_RESULT_DONE : SELFCAL_ANSWER_RESULT_NOT_NOW;
    }
    const selfcal_tumble_status_t status = selfcal_imu_tumble_stop(&app->imu);
    if (status == SELFCAL_TUMBLE_BAD_ARGUMENT) { /* none was started */
        return SELFCAL_ANSWER_RESULT_NOT_NOW;
    }
    return status == SELFCAL_TUMBLE_OK ? saved(app, now) : SELFCAL_ANSWER_RESULT_FAILED;
}

static void obey(app_t *app, uint32_t now) {
    const uint8_t command = app->ordered;
    uint8_t result = SELFCAL_ANSWER_RESULT_DONE;
    app->ordered = 0;
    if (command == SELFCAL_ANSWER_COMMAND_SAVE) {
        result = saved(app, now);
    } else if (command == SELFCAL_ANSWER_COMMAND_WRITE_OFFSETS) {
        result = write_offsets(app, app->argument);
    } else if (command == SELFCAL_ANSWER_COMMAND_TUMBLE) {
        result = tumble(app, now);
    } else if (app->argument == 1U) {
        result = forget(app);
        if (result == SELFCAL_ANSWER_RESULT_DONE) {
            /* Or the next restart would bring the old state back. In both slots, since one may come to harm. */
            result = saved(app, now) == SELFCAL_ANSWER_RESULT_DONE ? saved(app, now) : SELFCAL_ANSWER_RESULT_FAILED;
        }
    } else {
        app->restarting = true;
        app->restart_ms = app_now(app); /* `now` may lie before a save */
    }
    answer(app, &app->answer[OF_ORDER], command, result);
}

bool app_obey(app_t *app, uint32_t now) {
    command_pass(&app->command, now);
    if (app->ordered != 0U && !app->answer[OF_ORDER].waiting && app->module != NULL) {
        obey(app, now);
    }
    return app->restarting;
}

/* Checks a command's argument, and whether it can be obeyed now. */
static uint8_t judge(const app_t *app, uint8_t command, uint32_t argument) {
    bool in_range;
    switch (command) {
    case SELFCAL_ANSWER_COMMAND_RESET:
    case SELFCAL_ANSWER_COMMAND_TUMBLE: in_range = argument <= 1U; break;
    case SELFCAL_ANSWER_COMMAND_SAVE: in_range = argument == 0U; break;
    case SELFCAL_ANSWER_COMMAND_TELEMETRY_PERIOD: in_range = argument >= TELEMETRY_PERIOD_LEAST_MS; break;
    case SELFCAL_ANSWER_COMMAND_WRITE_OFFSETS: in_range = argument <= AXIS_BITS; break;
    default: return SELFCAL_ANSWER_RESULT_UNKNOWN;
    }
    if (!in_range) {
        return SELFCAL_ANSWER_RESULT_OUT_OF_RANGE;
    }
    const bool now = app->ordered == 0U && !app->restarting && app->module != NULL;
    return now ? SELFCAL_ANSWER_RESULT_DONE : SELFCAL_ANSWER_RESULT_NOT_NOW;
}

void app_command(app_t *app, const uint8_t data[8]) {
    const uint32_t now = app_now(app);
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

bool app_begin_answer(app_t *app, uint32_t now) {
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
    return false;
}

#endif
