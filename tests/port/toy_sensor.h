/* A driver written from "Another sensor" of port/README.md, for a part that no one makes: registers of 16 bits, a new
 * sample each 5 ms, no FIFO, no interrupt. A read is the address with its top bit set, then two bytes. */
#ifndef TOY_SENSOR_H
#define TOY_SENSOR_H

#include <math.h>

#include "sensor.h"

#define toy_has_rate(rate_hz) ((rate_hz) > 199.9F && (rate_hz) < 200.1F)
#define toy_rates "200 Hz"
#define toy_bus spi_bus
#define toy_has_supply 0

enum { TOY_ID = 0, TOY_CONTROL = 1, TOY_COUNT = 2, TOY_DATA = 3, TOY_TEMPERATURE = 9, TOY_REGISTERS = 10 };
enum { TOY_IDENTITY = 0x5A5A, TOY_ON = 1, TOY_TEST = 2, TOY_TEST_PASSED = 4 };

typedef struct {
    sensor_state_t common;
    uint16_t count; /* of samples, as the part has it */
    bool placed;    /* `count` is of the last sample; false after a start */
    uint64_t last_us;
    float temperature;
} toy_t;

static bool toy_register(const sensor_state_t *state, uint8_t address, uint16_t *value) {
    const uint8_t out[3] = {(uint8_t)(0x80U | address)};
    uint8_t in[3];
    const bool done = state->bus->exchange(out, in, sizeof out);
    *value = (uint16_t)((uint32_t)in[1] << 8 | in[2]);
    return done;
}

static bool toy_write(const sensor_state_t *state, uint8_t address, uint16_t value) {
    const uint8_t out[3] = {address, (uint8_t)(value >> 8), (uint8_t)value};
    uint8_t in[3];
    return state->bus->exchange(out, in, sizeof out);
}

static bool toy_init(sensor_state_t *state, float rate_hz, sensor_wire_t *wire) {
    *wire = (sensor_wire_t){8000000U, 1U, 0U};
    state->period_us = 5000U;
    ((toy_t *)(void *)state)->temperature = NAN;
    return toy_has_rate(rate_hz);
}

static sensor_fault_t toy_probe(sensor_state_t *state) {
    uint16_t identity;
    return toy_register(state, TOY_ID, &identity) && identity == TOY_IDENTITY ? SENSOR_NO_FAULT : SENSOR_ABSENT;
}

static sensor_fault_t toy_begin_test(sensor_state_t *state) {
    return toy_write(state, TOY_CONTROL, TOY_TEST) ? SENSOR_NO_FAULT : SENSOR_SET_UP;
}

static sensor_fault_t toy_end_test(sensor_state_t *state) {
    uint16_t control;
    if (!toy_register(state, TOY_CONTROL, &control)) {
        return SENSOR_SELF_TEST;
    }
    if (control == TOY_TEST) {
        return SENSOR_NOT_YET;
    }
    ((toy_t *)(void *)state)->placed = false;
    return control != TOY_TEST_PASSED              ? SENSOR_SELF_TEST
           : toy_write(state, TOY_CONTROL, TOY_ON) ? SENSOR_NO_FAULT
                                                   : SENSOR_SET_UP;
}

static void toy_watch(sensor_state_t *state, uint64_t now_us) {
    uint16_t control;
    (void)now_us;
    if (toy_register(state, TOY_CONTROL, &control) && control != TOY_ON) {
        sensor_fail(state, SENSOR_SET_UP);
    }
}

static bool toy_read(sensor_state_t *state, int32_t raw[SENSOR_AXES], uint32_t *missing) {
    toy_t *self = (toy_t *)(void *)state;
    uint16_t count, word;
    if (!toy_register(state, TOY_COUNT, &count) || (self->placed && count == self->count)) {
        return false;
    }
    state->signs++;
    for (uint8_t axis = 0; axis < SENSOR_AXES; axis++) {
        if (!toy_register(state, (uint8_t)(TOY_DATA + axis), &word)) {
            state->counters.damaged++;
            return false;
        }
        raw[axis] = (int32_t)(word ^ 0x8000U) - 0x8000;
    }
    if (sensor_repeats(state, raw)) {
        return false;
    }
    if (toy_register(state, TOY_TEMPERATURE, &word)) {
        self->temperature = 0.01F * (float)word;
    }
    const uint64_t now_us = state->bus->time_us(), passed = (now_us - self->last_us + 2500U) / 5000U;
    *missing = self->placed                                  ? (uint16_t)(count - self->count - 1U)
               : state->counters.samples > 0U && passed > 0U ? (uint32_t)(passed - 1U)
                                                             : 0U;
    self->count = count;
    self->last_us = now_us;
    self->placed = true;
    return true;
}

static float toy_side(const sensor_state_t *state, unsigned channel) {
    return channel == SENSOR_TEMPERATURE ? ((const toy_t *)(const void *)state)->temperature : NAN;
}

static const sensor_step_t toy_start[] = {{20000U, toy_probe}, {0, toy_begin_test}, {10000U, toy_end_test}};
static toy_t toy_state;

static const sensor_t toy = {
    .state = &toy_state.common,
    .bytes = sizeof toy_state,
    .start = toy_start,
    .steps = sizeof toy_start / sizeof toy_start[0],
    .step = {0.01F, 0.002F},
    .init = toy_init,
    .watch = toy_watch,
    .read = toy_read,
    .side = toy_side,
};

#endif
