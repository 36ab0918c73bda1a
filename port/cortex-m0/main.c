/* The application on an nRF51822 (Cortex-M0, 16 MHz) with a sensor on SPI0; telemetry as SLCAN. */
#include "board.h"
#include "nrf51.h"

#if defined BOARD_CAN_KBITPS || defined BOARD_USART_BAUD
#error "this board's wire is SLCAN at 115200 bit/s: there is no BOARD_CAN_KBITPS, and no other BOARD_USART_BAUD"
#endif

/* Milliseconds between reports of all axes: each takes this core seconds. */
#ifndef BOARD_REPORT_MS
#define BOARD_REPORT_MS 600000
#endif
#if BOARD_REPORT_MS < 100 || BOARD_REPORT_MS > 2000000000
#error "BOARD_REPORT_MS: 100 to 2000000000"
#endif

static reset_cause_t reset_cause;

static void board_sleep(void) {
    __asm__ volatile("wfi" : : : "memory");
}

static void board_tell(selfcal_module_t *told) {
    told->reset_cause = (uint32_t)reset_cause;
    told->clock = (CLOCK_HFCLKSTAT & CLOCK_HFCLKSTAT_CRYSTAL) != 0U ? 1U : 2U;
    uart_tell(told);
}

static const module_board_t board_calls = {
    &flash_memory, BOARD_REPORT_MS, clock_ms,      clock_ms,   uart_send,  uart_sent,
    uart_poll,     board_sleep,     watchdog_feed, board_tell, rng_number, board_reset,
};

int main(void) {
    reset_cause = board_reset_cause();
    clock_init();
    irq_on();
    uart_init();
    module_run(&board_calls);
    return 1; /* the model is not one for this sensor: the start-up code resets */
}
