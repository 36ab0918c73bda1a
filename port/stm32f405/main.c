/* The application on an STM32F405 with an ADIS16405: wiring and flashing in GUIDE.md, "The module". */
#include "app.h"
#include "board.h"
#include "sensor.h"
#include "stm32f405.h"

/* Milliseconds between reports of all axes. */
#ifndef BOARD_REPORT_MS
#define BOARD_REPORT_MS 10000
#endif

/* 0: every sample counts as one of rest. */
#ifndef BOARD_GATE
#define BOARD_GATE 1
#endif

/* Seconds of running between saves of the state. A sector bears 10 000 erases and a save erases one of two, so that four saves
 * a day wear the flash out in 13 years. */
#ifndef BOARD_SAVE_PERIOD_S
#define BOARD_SAVE_PERIOD_S 21600U
#endif

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

/* --------------------------------------------------------------------------------------------------------------- port */

static uint32_t port_time_ms(void *context)
{
    (void)context;
    return clock_ms();
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

static const port_t port = {NULL, port_time_ms, sensor_sample, port_send, port_idle};

/* ------------------------------------------------------------------------------------------------------------- module */

static reset_cause_t reset_cause;
static board_fault_t last_fault;

static void module_tell(void *context, selfcal_module_t *told)
{
    (void)context;
    told->reset_cause = (uint32_t)reset_cause;
    told->fault_address = last_fault.pc;
    told->clock = board_clock.crystal ? 1U : 2U;
    sensor_tell(told);
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

#if APP_COMMANDS
static void module_restart(void *context)
{
    (void)context;
    board_reset();
}

void board_command(const uint8_t data[8])
{
    app_command(&app, data);
}
#endif

static const port_module_t module = {
    NULL, module_tell, module_stored, module_save_begin, flash_put, module_save_end, sensor_write_offsets,
#if APP_COMMANDS
    rng_number, module_restart,
#else
    NULL, NULL,
#endif
    BOARD_SAVE_PERIOD_S * 1000U, (uint64_t)((double)BOARD_SAVE_PERIOD_S * (double)SELFCAL_MODEL_RATE_HZ),
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
    if (!sensor_init(&bus) || app_init(&app, &port, BOARD_REPORT_MS) != SELFCAL_OK) {
        return 1; /* the model is not one for this sensor: the start-up code resets */
    }
    if (BOARD_GATE) {
        (void)app_gate(&app);
    }
    app_module(&app, &module);
    for (;;) {
        if (BOARD_CAN_KBITPS == 0) {
            usart_poll();
        } else {
            can_poll();
        }
        sensor_poll();
        (void)app_step(&app);
        feed();
    }
}
