#include "module.h"

#include "readings.h"

/* 0: every sample counts as one of rest. */
#ifndef BOARD_GATE
#define BOARD_GATE 1
#endif

/* Seconds of running between saves of the state. A save erases one of two slots. A slot bears 10 000 erases
 * (STM32F405) or 20 000 (nRF51822): four saves a day wear the flash out in 13 years or 27. */
#ifndef BOARD_SAVE_PERIOD_S
#define BOARD_SAVE_PERIOD_S 21600U
#endif
#if BOARD_SAVE_PERIOD_S < 1 || BOARD_SAVE_PERIOD_S > 4000000
#error "BOARD_SAVE_PERIOD_S: 1 to 4000000 (milliseconds are counted in 32 bits)"
#endif

static app_t app;
static slots_t slots;
static const module_board_t *board;

/* --- port --- */

static uint32_t port_time_ms(void *context) {
    (void)context;
    return board->time_ms();
}

static bool port_send(void *context, const selfcal_frame_t *frame) {
    (void)context;
    return board->send(frame);
}

static void port_idle(void *context) {
    (void)context;
    board->sleep();
}

static const port_t port = {NULL, port_time_ms, readings_sample, port_send, port_idle};

/* --- module --- */

static void module_tell(void *context, selfcal_module_t *told) {
    (void)context;
    board->tell(told);
    readings_tell(told);
}

/* Flash at work holds the processor up, and with it the interrupts that stamp samples: none is taken meanwhile. */
static bool module_save_begin(void *context, bool keep_older) {
    board->feed();
    readings_pause(true);
    return slots_begin(context, keep_older);
}

static bool module_save_end(void *context, bool whole) {
    const bool saved = slots_end(context, whole);
    readings_pause(false);
    return saved;
}

static bool module_random(void *context, uint32_t *number) {
    (void)context;
    return board->random(number);
}

static bool module_sent(void *context) {
    (void)context;
    return board->sent();
}

static void module_restart(void *context) {
    (void)context;
    board->restart();
}

#if APP_COMMANDS
void module_command(const uint8_t data[8]) {
    app_command(&app, data);
}
#endif

static const port_module_t module = {
    &slots,
    module_tell,
    slots_stored,
    module_save_begin,
    slots_put,
    module_save_end,
    readings_write_offsets,
    module_random,
    module_sent,
    module_restart,
    BOARD_SAVE_PERIOD_S * 1000U,
    (uint64_t)((double)BOARD_SAVE_PERIOD_S * (double)SELFCAL_MODEL_RATE_HZ),
};

/* Fed once in 100 ms at most, and only if the application is healthy and the ticks go on: a main loop that turns
 * without its interrupts is not healthy. */
static void feed(void) {
    static uint32_t fed;
    const uint32_t now = board->ticks();
    if (now - fed >= 100U && app_healthy(&app)) {
        fed = now;
        board->feed();
    }
}

void module_run(const module_board_t *its_board) {
    board = its_board;
    slots.memory = board->memory;
    if (!readings_init() || app_init(&app, &port, board->report_ms) != SELFCAL_OK) {
        return;
    }
    if (BOARD_GATE) {
        (void)app_gate(&app);
    }
    app_module(&app, &module);
    for (;;) {
        board->poll();
        readings_poll();
        (void)app_step(&app);
        feed();
    }
}
