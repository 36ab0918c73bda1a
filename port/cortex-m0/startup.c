/* Vectors and start-up. A fault resets the processor; that it did is kept in the register that a reset leaves alone. */
#include "board.h"
#include "nrf51.h"

extern uint32_t link_stack[], link_data_load[], link_data[], link_data_end[], link_bss[], link_bss_end[];

/* What newlib's <math.h> sets and nobody reads; its own would come with 1 KB of state. */
int *__errno(void); /* NOLINT(bugprone-reserved-identifier,cert-dcl37-c,cert-dcl51-cpp): newlib calls it so */
int *__errno(void)  /* NOLINT(bugprone-reserved-identifier,cert-dcl37-c,cert-dcl51-cpp) */
{
    static int number;
    return &number;
}

enum { FAULT_MARK = 0x5E };

void board_reset(void) {
    __asm__ volatile("dsb" : : : "memory");
    SCB_AIRCR = SCB_AIRCR_SYSRESETREQ;
    for (;;) { /* the watchdog ends it if the reset does not come */
    }
}

void board_fault(void) {
    POWER_GPREGRET = FAULT_MARK;
    board_reset();
}

reset_cause_t board_reset_cause(void) {
    const uint32_t reason = POWER_RESETREAS;
    const bool fault = (POWER_GPREGRET & 0xFFU) == FAULT_MARK;
    POWER_RESETREAS = reason; /* cleared by ones */
    POWER_GPREGRET = 0U;
    return reason == 0U                              ? RESET_POWER_ON
           : (reason & POWER_RESETREAS_DOG) != 0U    ? RESET_WATCHDOG
           : (reason & POWER_RESETREAS_LOCKUP) != 0U ? RESET_FAULT
           : (reason & POWER_RESETREAS_SREQ) != 0U   ? (fault ? RESET_FAULT : RESET_SOFTWARE)
           : (reason & POWER_RESETREAS_PIN) != 0U    ? RESET_PIN
           : (reason & POWER_RESETREAS_OFF) != 0U    ? RESET_LOW_POWER
                                                     : RESET_UNKNOWN;
}

int main(void);

__attribute__((noreturn)) void startup(void);
void startup(void) {
    POWER_RAMONB = POWER_RAMONB_ALL; /* RAM blocks 2 and 3 of the parts with 32 KB */
    const uint32_t *from = link_data_load;
    for (uint32_t *to = link_data; to < link_data_end; to++) {
        *to = *from++;
    }
    for (uint32_t *to = link_bss; to < link_bss_end; to++) {
        *to = 0;
    }
    (void)main();
    board_reset();
}

typedef union {
    const void *stack;
    void (*call)(void);
} vector_t;

/* Those without a handler are never enabled; the gaps of exceptions are reserved, ARMv6-M ARM table B1-3. */
__attribute__((section(".vectors"), used)) static const vector_t vectors[16 + IRQ_COUNT] = {
    [0] = {.stack = link_stack},
    [1] = {.call = startup},
    [2] = {.call = board_fault},  /* NMI */
    [3] = {.call = board_fault},  /* HardFault */
    [11] = {.call = board_fault}, /* SVCall */
    [14] = {.call = board_fault}, /* PendSV */
    [15] = {.call = board_fault}, /* SysTick */
    [16 + IRQ_UART0] = {.call = uart_handler},
    [16 + IRQ_SPI0] = {.call = spi_handler},
    [16 + IRQ_GPIOTE] = {.call = ready_handler},
    [16 + IRQ_TIMER0] = {.call = clock_handler},
};
