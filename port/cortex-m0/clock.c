#include "board.h"
#include "nrf51.h"

enum { TICK_US = 1000, WATCHDOG_S = 8, LFCLK_HZ = 32768, CRYSTAL_TURNS = 100000 };

static volatile uint32_t milliseconds;

void clock_init(void) {
    CLOCK_HFCLKSTARTED = 0U;
    CLOCK_HFCLKSTART = 1U;
    for (uint32_t turn = 0; turn < CRYSTAL_TURNS && CLOCK_HFCLKSTARTED == 0U; turn++) {
    } /* some ms; without a crystal the internal oscillator goes on */
    CLOCK_LFCLKSRC = CLOCK_LFCLKSRC_RC;
    CLOCK_LFCLKSTART = 1U;

    TIMER0_BITMODE = TIMER0_BITMODE_32;
    TIMER0_PRESCALER = 4U; /* 16 MHz / 2^4 */
    TIMER0_CC1 = TICK_US;
    TIMER0_INTENSET = TIMER0_INTEN_COMPARE1;
    TIMER0_START = 1U;
    irq_enable(IRQ_TIMER0);

    WDT_CRV = (uint32_t)WATCHDOG_S * LFCLK_HZ - 1U;
    WDT_CONFIG = WDT_CONFIG_RUN_ASLEEP;
    WDT_START = 1U;
}

/* Late when the flash was at work: then several ticks are due, or one more by the time that the next is set. */
void clock_handler(void) {
    TIMER0_COMPARE1 = 0U;
    while ((int32_t)(clock_us32() - TIMER0_CC1) >= 0) {
        TIMER0_CC1 += TICK_US;
        milliseconds++;
    }
}

uint32_t clock_ms(void) {
    return milliseconds;
}

/* A handler that captures in between makes the main loop's answer later, never wrong. */
uint32_t clock_us32(void) {
    TIMER0_CAPTURE0 = 1U;
    return TIMER0_CC0;
}

/* Called from the main loop at least once in 71 minutes. */
uint64_t clock_us(void) {
    static uint64_t now;
    now += clock_us32() - (uint32_t)now;
    return now;
}

void clock_spin_us(uint32_t us) {
    uint32_t turns = us * 11U / 2U + 1U; /* of 4 cycles, or of 3: never less than 16 cycles a microsecond */
    __asm__ volatile(".syntax unified\n1: subs %0, #1\n bne 1b" : "+l"(turns) : : "cc");
}

void watchdog_feed(void) {
    WDT_RR0 = WDT_RELOAD;
}
