#include "sensor.h"

#include <string.h>

/* Two bursts, 634 us, must fit a sample period. */
typedef char the_rate_can_be_read[(int)SELFCAL_MODEL_RATE_HZ < 1000 ? 1 : -1];
/* No constant, and no image, if it would divide by zero. (An array's size must be an integer constant expression: no
 * quotient of floats.) */
static const int the_sensor_makes_the_rate = 1 / ADIS16405_HAS_RATE(SELFCAL_MODEL_RATE_HZ);

static adis16405_t sensor;
static volatile bool listening; /* a sensor that was not reset with the processor is ready before the driver is */
static uint8_t channel[SELFCAL_MODEL_AXES]; /* of the sensor, for each axis of the model */
#if SELFCAL_MODEL_CHANNELS > 0
static bool is_supply[SELFCAL_MODEL_CHANNELS]; /* else temperature */
#endif

bool sensor_init(const adis16405_bus_t *bus)
{
    for (size_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        const unsigned at = port_axis(selfcal_model_axis_name[axis]);
        if (at == PORT_AXES) {
            return false;
        }
        channel[axis] = (uint8_t)at;
    }
#if SELFCAL_MODEL_CHANNELS > 0
    for (size_t i = 0; i < SELFCAL_MODEL_CHANNELS; i++) {
        is_supply[i] = strcmp(selfcal_model_channel_name[i], "supply") == 0;
    }
#endif
    const adis16405_config_t config = {SELFCAL_MODEL_RATE_HZ, 300, 1};
    listening = the_sensor_makes_the_rate != 0 && adis16405_init(&sensor, bus, &config);
    return listening;
}

void sensor_ready(void)
{
    if (listening) {
        adis16405_ready(&sensor);
    }
}

void sensor_burst(const uint16_t words[ADIS16405_BURST_WORDS], bool whole)
{
    adis16405_burst(&sensor, words, whole);
}

void sensor_poll(void)
{
    adis16405_poll(&sensor);
}

void sensor_pause(bool on)
{
    adis16405_pause(&sensor, on);
}

port_sample_t sensor_sample(void *context, float reading[], uint32_t *missing)
{
    (void)context;
    float all[ADIS16405_AXES];
    if (!adis16405_sample(&sensor, all, missing)) {
        return PORT_EMPTY;
    }
    for (size_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        reading[axis] = all[channel[axis]];
    }
    float *side = reading + SELFCAL_MODEL_AXES + SELFCAL_MODEL_CHANNELS;
    side[PORT_TEMPERATURE] = adis16405_temperature(&sensor);
    side[PORT_SUPPLY] = adis16405_supply(&sensor);
#if SELFCAL_MODEL_CHANNELS > 0
    for (size_t i = 0; i < SELFCAL_MODEL_CHANNELS; i++) {
        reading[SELFCAL_MODEL_AXES + i] = side[is_supply[i] ? PORT_SUPPLY : PORT_TEMPERATURE];
    }
#endif
    return PORT_SAMPLE;
}

bool sensor_write_offsets(void *context, const float wanted[], float got[])
{
    (void)context;
    float all[ADIS16405_AXES] = {0.0F}, done[ADIS16405_AXES];
    for (size_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        all[channel[axis]] = wanted[axis];
    }
    const bool written = adis16405_offsets(&sensor, all, done);
    for (size_t axis = 0; axis < SELFCAL_MODEL_AXES && written; axis++) {
        got[axis] = done[channel[axis]];
    }
    return written;
}

void sensor_tell(selfcal_module_t *told)
{
    told->sensor_state = (uint32_t)sensor.state + 1U;
    told->sensor_fault = (uint32_t)sensor.fault;
    told->sensor_fault_count = sensor.counters.faults;
    told->sensor_diagnosis = sensor.diagnosis;
    told->sensor_stale_count = sensor.counters.stale + sensor.counters.repeated;
    told->sensor_alarm_count = sensor.counters.alarms;
    told->sensor_damaged_count = sensor.counters.damaged;
    told->sensor_anomaly_count = sensor.counters.anomalies;
    told->sensor_overrun_count = sensor.counters.overruns;
}
