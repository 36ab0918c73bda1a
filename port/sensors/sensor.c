#include "sensor.h"

#include <string.h>

enum { REPEATS_TAKEN = 2, REPEATS_STUCK = 16, PROVEN_SAMPLES = 1000 };
enum { SIGNS = 3 };        /* one data-ready may come from plugging */
#define SILENCE_US 150000U /* without a sample; at least 10 periods as well */
#define BACKOFF_MIN_US 100000U
#define BACKOFF_MAX_US 10000000U

static void enter(sensor_state_t *state, uint8_t step) {
    state->condition = SENSOR_STARTING;
    state->step = step;
    state->step_us = state->bus->time_us();
}

bool sensor_open(const sensor_t *sensor, const sensor_bus_t *bus, float rate_hz) {
    sensor_state_t *state = sensor->state;
    sensor_wire_t wire;
    memset(state, 0, sensor->bytes);
    state->sensor = sensor;
    state->bus = bus;
    state->backoff_us = BACKOFF_MIN_US / 2U;
    if (!sensor->init(state, rate_hz, &wire)) {
        return false;
    }
    bus->open(&wire);
    enter(state, 0);
    return true;
}

void sensor_fail(sensor_state_t *state, sensor_fault_t fault) {
    if (state->sensor->stop != NULL) {
        state->sensor->stop(state);
    }
    state->condition = SENSOR_FAILED;
    state->fault = fault;
    state->step_us = state->bus->time_us();
    state->counters.faults++;
    if (state->good >= PROVEN_SAMPLES) {
        state->backoff_us = BACKOFF_MIN_US;
    } else {
        state->backoff_us = state->backoff_us < BACKOFF_MAX_US / 2U ? state->backoff_us * 2U : BACKOFF_MAX_US;
    }
    state->good = 0;
}

void sensor_expect(sensor_state_t *state) {
    state->progress_us = state->bus->time_us();
    state->signs_before = state->signs;
}

static void start_on(const sensor_t *sensor, sensor_state_t *state, uint64_t now) {
    const sensor_step_t *step = &sensor->start[state->step];
    if (now - state->step_us < step->wait_us) {
        return;
    }
    const sensor_fault_t fault = step->act(state);
    if (fault == SENSOR_NOT_YET) {
        return;
    }
    if (fault != SENSOR_NO_FAULT) {
        sensor_fail(state, fault);
    } else if (state->step + 1U < sensor->steps) {
        enter(state, (uint8_t)(state->step + 1U));
    } else {
        state->condition = SENSOR_RUNNING;
        state->equal = REPEATS_TAKEN; /* a reading of the run before is withheld */
        sensor_expect(state);
    }
}

static void watch(const sensor_t *sensor, sensor_state_t *state, uint64_t now) {
    if (sensor->watch != NULL) {
        sensor->watch(state, now);
    }
    const uint64_t silence = SILENCE_US > 10U * state->period_us ? SILENCE_US : 10U * state->period_us;
    if (state->condition != SENSOR_RUNNING) {
        return;
    }
    if (state->equal >= REPEATS_STUCK) {
        sensor_fail(state, SENSOR_STUCK);
    } else if ((int64_t)(now - state->progress_us) > (int64_t)silence &&
               (sensor->waits == NULL || !sensor->waits(state))) {
        sensor_fail(state, state->signs - state->signs_before < SIGNS ? SENSOR_SILENT : SENSOR_NO_DATA);
    }
}

void sensor_poll(const sensor_t *sensor) {
    sensor_state_t *state = sensor->state;
    const uint64_t now = state->bus->time_us();
    switch (state->condition) {
    case SENSOR_STARTING: start_on(sensor, state, now); break;
    case SENSOR_RUNNING: watch(sensor, state, now); break;
    default:
        if (now - state->step_us >= state->backoff_us) {
            enter(state, 0);
        }
        break;
    }
}

bool sensor_repeats(sensor_state_t *state, const int32_t raw[SENSOR_AXES]) {
    state->equal = memcmp(raw, state->last, sizeof state->last) == 0 ? state->equal + 1U : 0U;
    memcpy(state->last, raw, sizeof state->last);
    if (state->equal > REPEATS_TAKEN) {
        state->counters.repeated++;
        return true;
    }
    return false;
}

bool sensor_read(const sensor_t *sensor, float reading[SENSOR_AXES], uint32_t *missing) {
    sensor_state_t *state = sensor->state;
    int32_t raw[SENSOR_AXES];
    if (state->condition != SENSOR_RUNNING || !sensor->read(state, raw, missing)) {
        return false;
    }
    sensor_expect(state);
    state->good++;
    state->counters.samples++;
    for (size_t axis = 0; axis < SENSOR_AXES; axis++) {
        reading[axis] = (float)raw[axis] * sensor->step[sensor_kind(axis)];
    }
    return true;
}

bool sensor_offsets(const sensor_t *sensor, const float wanted[SENSOR_AXES], float got[SENSOR_AXES]) {
    sensor_state_t *state = sensor->state;
    int16_t added[SENSOR_AXES];
    if (sensor->offsets == NULL) {
        return false;
    }
    for (size_t axis = 0; axis < SENSOR_AXES; axis++) {
        const unsigned kind = sensor_kind(axis);
        const float steps = wanted[axis] / sensor->offset_step[kind];
        if (!(steps > -32000.0F && steps < 32000.0F)) {
            return false;
        }
        const int32_t nearest = (int32_t)(steps < 0.0F ? steps - 0.5F : steps + 0.5F);
        if (nearest < -sensor->offset_limit[kind] || nearest >= sensor->offset_limit[kind]) {
            return false;
        }
        added[axis] = (int16_t)nearest;
        got[axis] = (float)nearest * sensor->offset_step[kind];
    }
    if (!sensor->offsets(state, added)) {
        return false;
    }
    memcpy(state->added, added, sizeof added);
    return true;
}
