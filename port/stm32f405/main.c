/* The application on an STM32F405 with an ADIS16405: wiring and flashing in GUIDE.md, "The module". */
#include "adis16405.h"
#include "app.h"
#include "board.h"
#include "stm32f405.h"

#include <string.h>

/* Milliseconds between reports of all axes. */
#ifndef BOARD_REPORT_MS
#define BOARD_REPORT_MS 10000
#endif

/* Seconds of running between saves of the state. A sector bears 10 000 erases and a save erases one of two, so that four saves
 * a day wear the flash out in 13 years. */
#ifndef BOARD_SAVE_PERIOD_S
#define BOARD_SAVE_PERIOD_S 21600U
#endif

static adis16405_t sensor;
static uint8_t channel[SELFCAL_MODEL_AXES]; /* of the sensor, for each axis of the model */
static app_t app;

/* ------------------------------------------------------------------------------------------------------------- sensor */

static uint64_t bus_time_us(void *context)
{
    (void)context;
    return clock_us();
}

static uint32_t bus_time_us32(void *context)
{
    (void)context;
    return clock_us32();
}

static const adis16405_bus_t bus = {NULL, bus_time_us, bus_time_us32, spi_word, spi_burst, spi_reset_line};

void board_sensor_ready(void)
{
    adis16405_ready(&sensor);
}

void board_sensor_burst(const uint16_t words[12], bool whole)
{
    adis16405_burst(&sensor, words, whole);
}

static bool sensor_init(void)
{
    static const char *const name[ADIS16405_AXES] = {"gx", "gy", "gz", "ax", "ay", "az"};
    for (size_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        uint8_t at = 0;
        while (at < ADIS16405_AXES && strcmp(selfcal_model_axis_name[axis], name[at]) != 0) {
            at++;
        }
        if (at == ADIS16405_AXES) {
            return false;
        }
        channel[axis] = at;
    }
    const adis16405_config_t config = {SELFCAL_MODEL_RATE_HZ, 300, 1};
    return adis16405_init(&sensor, &bus, &config);
}

/* --------------------------------------------------------------------------------------------------------------- port */

static uint32_t port_time_ms(void *context)
{
    (void)context;
    return clock_ms();
}

static port_sample_t port_sample(void *context, float reading[], uint32_t *missing)
{
    (void)context;
    float all[ADIS16405_AXES];
    if (!adis16405_sample(&sensor, all, missing)) {
        return PORT_EMPTY;
    }
    for (size_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        reading[axis] = all[channel[axis]];
    }
    return PORT_SAMPLE;
}

static bool port_send(void *context, const selfcal_frame_t *frame)
{
    (void)context;
    return BOARD_CAN_KBITPS > 0 ? can_send(frame) : usart_send(frame);
}

/* A data-ready, a free mailbox, a byte, or the next millisecond ends it. */
static void port_idle(void *context)
{
    (void)context;
    __asm__ volatile("wfi" : : : "memory");
}

static const port_t port = {NULL, port_time_ms, port_sample, port_send, port_idle};

/* ------------------------------------------------------------------------------------------------------------- module */

static reset_cause_t reset_cause;
static board_fault_t last_fault;

static void module_tell(void *context, selfcal_module_t *told)
{
    (void)context;
    told->reset_cause = (uint32_t)reset_cause;
    told->fault_address = last_fault.pc;
    told->clock = board_clock.crystal ? 1U : 2U;
    told->sensor_state = (uint32_t)sensor.state + 1U;
    told->sensor_fault = (uint32_t)sensor.fault;
    told->sensor_fault_count = sensor.counters.faults;
    told->sensor_diagnosis = sensor.diagnosis;
    told->sensor_stale_count = sensor.counters.stale + sensor.counters.repeated;
    told->sensor_alarm_count = sensor.counters.alarms;
    told->sensor_damaged_count = sensor.counters.damaged;
    told->sensor_anomaly_count = sensor.counters.anomalies;
    told->sensor_overrun_count = sensor.counters.overruns;
    wire_counters_t wire;
    if (BOARD_CAN_KBITPS > 0) {
        can_counters(&wire);
    } else {
        usart_counters(&wire);
    }
    told->frames_dropped = wire.dropped;
    told->bus_off_count = wire.bus_offs;
}

static const void *module_stored(void *context, bool older, size_t *length)
{
    (void)context;
    return flash_newest(older, length);
}

static bool module_save_begin(void *context)
{
    (void)context;
    watchdog_feed(); /* the erase takes 2 s at most, the watchdog 5.4 s at least */
    return flash_begin();
}

static bool module_save_end(void *context)
{
    (void)context;
    return flash_end();
}

static const port_module_t module = {
    NULL, module_tell, module_stored, module_save_begin, flash_put, module_save_end, BOARD_SAVE_PERIOD_S * 1000U,
    (uint64_t)((double)BOARD_SAVE_PERIOD_S * (double)SELFCAL_MODEL_RATE_HZ),
};

/* Fed once in 100 ms at most, and only if the ticks go on (a main loop that turns without its interrupts is not healthy) and the
 * application is well. */
static void feed(void)
{
    static uint32_t fed;
    const uint32_t now = clock_ticks();
    if (now - fed >= 100U && app_healthy(&app)) {
        fed = now;
        watchdog_feed();
    }
}

int main(void)
{
    watchdog_start();
    reset_cause = watchdog_reset_cause();
    if (board_last_fault(&last_fault) && reset_cause == RESET_SOFTWARE) {
        reset_cause = RESET_FAULT;
    }
    clock_init();
    irq_on();
    if (BOARD_CAN_KBITPS > 0) {
        (void)can_init((uint32_t)BOARD_CAN_KBITPS * 1000U);
    } else {
        usart_init(BOARD_USART_BAUD);
    }
    spi_init();
    if (!sensor_init() || app_init(&app, &port, BOARD_REPORT_MS) != SELFCAL_OK) {
        return 1; /* the model is not one for this sensor: the start-up code resets */
    }
    app_module(&app, &module);
    for (;;) {
        if (BOARD_CAN_KBITPS == 0) {
            usart_poll();
        }
        adis16405_poll(&sensor);
        (void)app_step(&app);
        feed();
    }
}
