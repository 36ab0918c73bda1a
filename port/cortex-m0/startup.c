/* Vectors and start-up. A fault resets the processor. */
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

int main(void);

__attribute__((noreturn)) void startup(void);
void startup(void)
{
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
    [2] = {.call = board_reset}, /* NMI */
    [3] = {.call = board_reset}, /* HardFault */
    [11] = {.call = board_reset}, /* SVCall */
    [14] = {.call = board_reset}, /* PendSV */
    [15] = {.call = board_reset}, /* SysTick */
    [16 + IRQ_UART0] = {.call = uart_handler},
    [16 + IRQ_SPI0] = {.call = spi_handler},
    [16 + IRQ_GPIOTE] = {.call = ready_handler},
    [16 + IRQ_TIMER0] = {.call = clock_handler},
};
