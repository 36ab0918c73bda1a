/* The application on an STM32F405 with a sensor on SPI1: wiring and flashing in port/README.md. */
#include "board.h"
#include "stm32f405.h"

/* Milliseconds between reports of all axes. */
#ifndef BOARD_REPORT_MS
#define BOARD_REPORT_MS 10000
#endif
#if BOARD_REPORT_MS < 100 || BOARD_REPORT_MS > 2000000000
#error "BOARD_REPORT_MS: 100 to 2000000000"
#endif

static reset_cause_t reset_cause;
static board_fault_t last_fault;

static void board_sleep(void) {
    __asm__ volatile("wfi" : : : "memory");
}

static void board_tell(selfcal_module_t *told) {
    told->reset_cause = (uint32_t)reset_cause;
    told->fault_address = last_fault.pc;
    told->clock = board_clock.crystal ? 1U : 2U;
    wire_counters_t wire;
    if (BOARD_CAN_KBITPS > 0) {
        can_counters(&wire);
    } else {
        usart_counters(&wire);
    }
    told->frames_dropped = wire.dropped;
    told->bus_off_count = wire.bus_offs;
}

static const module_board_t board_calls = {
    &flash_memory,
    BOARD_REPORT_MS,
    clock_ms,
    clock_ticks,
    BOARD_CAN_KBITPS > 0 ? can_send : usart_send,
    BOARD_CAN_KBITPS > 0 ? can_sent : usart_sent,
    BOARD_CAN_KBITPS > 0 ? can_poll : usart_poll,
    board_sleep,
    watchdog_feed,
    board_tell,
    rng_number,
    board_reset,
};

int main(void) {
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
    module_run(&board_calls);
    return 1; /* the model is not one for this sensor: the start-up code resets */
}
