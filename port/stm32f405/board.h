/* What the parts of this target give each other. Pins: port/README.md, "Wiring". */
#ifndef BOARD_H
#define BOARD_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "module.h"

/* --- start-up --- */

typedef struct {
    uint32_t vector; /* exception number: 3 HardFault, 16 + n interrupt n */
    uint32_t pc, lr; /* where; 0 if the stack was gone */
    uint32_t cfsr;   /* SCB_CFSR, PM0214 4.4 */
} board_fault_t;

/* The fault that ended the last run, once; false: there was none. */
bool board_last_fault(board_fault_t *fault);

void board_reset(void);

/* --- clock --- */

typedef struct {
    uint32_t hclk_hz, pclk1_hz, pclk2_hz;
    uint32_t tim2_hz;
    bool crystal; /* false: HSE did not start, and HSI serves: 1 %, too coarse for CAN at 500 kbit/s and more */
} board_clock_t;

extern board_clock_t board_clock;

/* 168 MHz from the crystal (BOARD_HSE_HZ), from HSI if that does not start, HSI itself if the PLL does not lock;
 * never waits longer than about 20 ms. */
void clock_init(void);

/* Time since start: for the main loop; the last for interrupt handlers too, modulo 2^32. */
uint32_t clock_ms(void);
uint64_t clock_us(void);
uint32_t clock_us32(void);

/* Goes up each millisecond that interrupts are served. */
uint32_t clock_ticks(void);

/* At least this long, at most twice. */
void clock_spin_us(uint32_t us);

void systick_handler(void);

/* --- sensor --- */

/* spi.c, i2c.c: `spi_bus` and `i2c_bus`. */
void sensor_ready_handler(void);
void sensor_done_handler(void);

/* --- wire --- */

/* Either CAN or SLCAN on the USART, chosen at build time: BOARD_CAN_KBITPS, 125 to 1000, or 0 for the USART. */
#ifndef BOARD_CAN_KBITPS
#define BOARD_CAN_KBITPS 500
#endif
#if BOARD_CAN_KBITPS != 0 && (BOARD_CAN_KBITPS < 125 || BOARD_CAN_KBITPS > 1000 || 42000 % BOARD_CAN_KBITPS != 0 ||    \
                              BOARD_CAN_KBITPS == 240 || BOARD_CAN_KBITPS == 336)
#error "BOARD_CAN_KBITPS: 125 to 1000, and a whole part of 42 MHz with 8 to 20 quanta in a bit; or 0"
#endif
#ifndef BOARD_USART_BAUD
#define BOARD_USART_BAUD 115200
#endif
#if BOARD_USART_BAUD < 9600 || BOARD_USART_BAUD > 2000000
#error "BOARD_USART_BAUD: 9600 to 2000000"
#endif

typedef struct {
    uint32_t dropped;  /* frames taken from the application and not sent */
    uint32_t bus_offs; /* CAN: times the controller left the bus; USART: bytes lost on reception */
} wire_counters_t;

/* False: the bit rate cannot be made exactly from this clock, or the controller does not answer. Then nothing is
 * sent. */
bool can_init(uint32_t bit_per_s);
bool can_send(const selfcal_frame_t *frame);
bool can_sent(void); /* no frame waits in a mailbox */
void can_poll(void); /* takes a command, in an image with commands */
void can_counters(wire_counters_t *counters);
void can_tx_handler(void);
void can_error_handler(void);

/* Value of CAN_BTR for a bit rate, exact, with the sample point nearest to 87.5 %; 0: there is none. */
uint32_t can_bit_timing(uint32_t pclk_hz, uint32_t bit_per_s);

void usart_init(uint32_t baud);
bool usart_send(const selfcal_frame_t *frame);
bool usart_sent(void); /* the last byte too */
void usart_poll(void); /* takes what the host said */
void usart_counters(wire_counters_t *counters);
void usart_handler(void);

/* A random number of the RNG's; false: it has none, for want of a clock or by its own checks. 1 ms at most. */
bool rng_number(uint32_t *number);

/* --- watchdog, reset cause --- */

/* Reads and clears the reset flags. */
reset_cause_t watchdog_reset_cause(void);

/* 8 s by the nominal LSI, 5.4 s at its fastest (47 kHz): longer than the longest erase of a flash sector. */
void watchdog_start(void);
void watchdog_feed(void);

/* --- flash --- */

/* Erasing a slot takes 1 s, 2 s at most, during which the processor stands still. */
extern const slots_memory_t flash_memory;

#endif
