/* What the parts of this target give each other. Pins are those of a BBC micro:bit's edge connector and of its USB
 * bridge. */
#ifndef BOARD_H
#define BOARD_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "module.h"

enum {
    PIN_READY = 20, /* edge 12 */
    PIN_RESET = 18, /* edge 8 */
    PIN_CS = 16,    /* edge 16 */
    PIN_MOSI = 21,  /* edge 15 */
    PIN_MISO = 22,  /* edge 14 */
    PIN_SCK = 23,   /* edge 13 */
    PIN_TX = 24,
    PIN_RX = 25
};

/* clock.c */

/* 16 MHz by the crystal (by the internal oscillator if it does not start), microseconds and milliseconds by TIMER0,
 * and the watchdog: 8 s by the nominal 32 kHz oscillator, only stopped by a reset. */
void clock_init(void);

/* Time since start. The last is for interrupt handlers too, modulo 2^32. */
uint32_t clock_ms(void);
uint64_t clock_us(void);
uint32_t clock_us32(void);

void clock_spin_us(uint32_t us);
void clock_handler(void);
void watchdog_feed(void);

/* startup.c */

__attribute__((noreturn)) void board_reset(void);
__attribute__((noreturn)) void board_fault(void);

/* Reads and clears it. */
reset_cause_t board_reset_cause(void);

/* flash.c: erasing a slot takes half a second */

extern const slots_memory_t flash_memory;

/* rng.c */

/* False: it gives none. 20 ms at most. */
bool rng_number(uint32_t *number);

/* spi.c, i2c.c: `spi_bus` and `i2c_bus` */

void spi_handler(void);
void ready_handler(void);

/* uart.c: SLCAN at 115200 bit/s */

void uart_init(void);
bool uart_send(const selfcal_frame_t *frame);
bool uart_sent(void); /* the last byte too */
void uart_poll(void); /* takes what the host said */
void uart_tell(selfcal_module_t *told);
void uart_handler(void);

#endif
