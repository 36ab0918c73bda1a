#include "readings.h"

#include <string.h>

#include "selfcal_model.h"

/* port/sensors/NAME.h, and the names that it begins with NAME_. */
#define JOINED(name, what) name##_##what
#define OF(name, what) JOINED(name, what)
#define QUOTED(name) #name
#define HEADER(name) QUOTED(name.h) /* NOLINT(bugprone-macro-parentheses): the name of a file */
#include HEADER(SENSOR)

/* No image of a model that the sensor cannot keep: the compiler states why. */
#define TEXT_OF(what) #what
#define TEXT(what) TEXT_OF(what)
#define REFUSED(what) __attribute__((error(what)))
extern void the_sensor_has_not_this_rate(void) REFUSED("the model's rate is " TEXT(
    SELFCAL_MODEL_RATE_HZ) " Hz, the " TEXT(SENSOR) " has " OF(SENSOR, rates) ": set sensor.rate_hz in the model file");
extern void the_sensor_has_not_this_channel(void) REFUSED(
    "a regressor of the model reads a channel that the " TEXT(SENSOR) " has not: take it out of the model file");
enum { CHANNELS_KNOWN = SELFCAL_MODEL_CHANNELS_READ && (OF(SENSOR, has_supply) || !SELFCAL_MODEL_SUPPLY_READ) };
typedef char the_axes_and_channels_are_the_ports
    [PORT_AXES == (int)SENSOR_AXES && PORT_SIDE == (int)SENSOR_SIDE && PORT_SUPPLY == (int)SENSOR_SUPPLY ? 1 : -1];

static uint8_t channel[SELFCAL_MODEL_AXES]; /* of the sensor, for each axis of the model */

bool readings_init(void) {
    for (size_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        const unsigned at = port_axis(selfcal_model_axis_name[axis]);
        if (at == PORT_AXES) {
            return false;
        }
        channel[axis] = (uint8_t)at;
    }
    if (!OF(SENSOR, has_rate)(SELFCAL_MODEL_RATE_HZ)) {
        the_sensor_has_not_this_rate();
    }
    if (!CHANNELS_KNOWN) {
        the_sensor_has_not_this_channel();
    }
    return sensor_open(&SENSOR, &OF(SENSOR, bus), SELFCAL_MODEL_RATE_HZ);
}

void readings_ready(void) {
    if (SENSOR.ready != NULL) {
        SENSOR.ready(SENSOR.state);
    }
}

void readings_done(bool whole) {
    if (SENSOR.done != NULL) {
        SENSOR.done(SENSOR.state, whole);
    }
}

void readings_poll(void) {
    sensor_poll(&SENSOR);
}

void readings_pause(bool on) {
    if (SENSOR.pause != NULL) {
        SENSOR.pause(SENSOR.state, on);
    }
}

/* Channels of the model from the sensor's. NOLINTNEXTLINE(readability-non-const-parameter): a model may read none */
static void take_channels(const float side[PORT_SIDE], float channels[]) {
#if SELFCAL_MODEL_CHANNELS > 0
    for (size_t i = 0; i < SELFCAL_MODEL_CHANNELS; i++) {
        channels[i] = side[strcmp(selfcal_model_channel_name[i], "supply") == 0 ? PORT_SUPPLY : PORT_TEMPERATURE];
    }
#endif
    (void)side;
    (void)channels;
}

port_sample_t readings_sample(void *context, float reading[], uint32_t *missing) {
    (void)context;
    float all[SENSOR_AXES];
    if (!sensor_read(&SENSOR, all, missing)) {
        return PORT_EMPTY;
    }
    for (size_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        reading[axis] = all[channel[axis]];
    }
    float *side = reading + SELFCAL_MODEL_AXES + SELFCAL_MODEL_CHANNELS;
    for (unsigned i = 0; i < PORT_SIDE; i++) {
        side[i] = SENSOR.side(SENSOR.state, i);
    }
    take_channels(side, reading + SELFCAL_MODEL_AXES);
    return PORT_SAMPLE;
}

bool readings_write_offsets(void *context, const float wanted[], float got[]) {
    (void)context;
    float all[SENSOR_AXES] = {0.0F}, added[SENSOR_AXES];
    for (size_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        all[channel[axis]] = wanted[axis];
    }
    const bool written = sensor_offsets(&SENSOR, all, added);
    for (size_t axis = 0; axis < SELFCAL_MODEL_AXES && written; axis++) {
        got[axis] = added[channel[axis]];
    }
    return written;
}

void readings_tell(selfcal_module_t *told) {
    const sensor_state_t *state = SENSOR.state;
    told->sensor_state = (uint32_t)state->condition;
    told->sensor_fault = (uint32_t)state->fault;
    told->sensor_fault_count = state->counters.faults;
    told->sensor_diagnosis = state->diagnosis;
    told->sensor_stale_count = state->counters.stale + state->counters.repeated;
    told->sensor_alarm_count = state->counters.alarms;
    told->sensor_damaged_count = state->counters.damaged;
    told->sensor_anomaly_count = state->counters.anomalies;
    told->sensor_overrun_count = state->counters.overruns;
}
