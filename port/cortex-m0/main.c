/* The application on an nRF51822 (Cortex-M0, 16 MHz) with an ADIS16405; telemetry as SLCAN. */
#include "app.h"
#include "board.h"
#include "nrf51.h"
#include "sensor.h"

/* Milliseconds between reports of all axes: each takes this core seconds. */
#ifndef BOARD_REPORT_MS
#define BOARD_REPORT_MS 600000
#endif

/* 0: every sample counts as one of rest. */
#ifndef BOARD_GATE
#define BOARD_GATE 1
#endif

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

static uint32_t port_time_ms(void *context)
{
    (void)context;
    return clock_ms();
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

static const port_t port = {NULL, port_time_ms, sensor_sample, port_send, port_idle};

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
    if (!sensor_init(&bus) || app_init(&app, &port, BOARD_REPORT_MS) != SELFCAL_OK) {
        return 1; /* the model is not one for this sensor: the start-up code resets */
    }
    if (BOARD_GATE) {
        (void)app_gate(&app);
    }
    for (;;) {
        uart_poll();
        sensor_poll();
        (void)app_step(&app);
        feed();
    }
}
