/* The application on an nRF51822 (Cortex-M0, 16 MHz) with an ADIS16405; telemetry as SLCAN. */
#include "adis16405.h"
#include "app.h"
#include "board.h"
#include "nrf51.h"

#include <string.h>

/* Milliseconds between reports of all axes: each takes this core seconds. */
#ifndef BOARD_REPORT_MS
#define BOARD_REPORT_MS 600000
#endif

static adis16405_t sensor;
static uint8_t channel[SELFCAL_MODEL_AXES]; /* of the sensor, for each axis of the model */
static app_t app;

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
    return uart_send(frame);
}

/* A data-ready, a byte, or the next millisecond ends it. */
static void port_idle(void *context)
{
    (void)context;
    __asm__ volatile("wfi" : : : "memory");
}

static const port_t port = {NULL, port_time_ms, port_sample, port_send, port_idle};

/* Fed once in 100 ms at most, and only if the millisecond clock goes on: a main loop that turns without its interrupts is not
 * healthy. */
static void feed(void)
{
    static uint32_t fed_ms;
    const uint32_t now = clock_ms();
    if (now - fed_ms >= 100U) {
        fed_ms = now;
        watchdog_feed();
    }
}

int main(void)
{
    clock_init();
    irq_on();
    uart_init();
    spi_init();
    if (!sensor_init() || app_init(&app, &port, BOARD_REPORT_MS) != SELFCAL_OK) {
        return 1; /* the model is not one for this sensor: the start-up code resets */
    }
    for (;;) {
        uart_poll();
        adis16405_poll(&sensor);
        (void)app_step(&app);
        feed();
    }
}
