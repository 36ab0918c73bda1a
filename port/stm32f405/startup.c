/* Vectors, start-up, and what happens on a fault: it is recorded in memory that a reset leaves alone, and the processor
 * is reset. */
#include "board.h"
#include "stm32f405.h"

extern uint32_t link_stack[], link_data_load[], link_data[], link_data_end[], link_bss[], link_bss_end[];
extern uint32_t link_ccm[], link_ccm_end[];

enum { FAULT_MAGIC = 0x5EFA0177 };

static struct {
    uint32_t magic;
    board_fault_t fault;
} kept __attribute__((section(".kept")));

bool board_last_fault(board_fault_t *fault) {
    const bool found = kept.magic == FAULT_MAGIC;
    if (found) {
        *fault = kept.fault;
        kept.magic = 0;
    }
    return found;
}

void board_reset(void) {
    __asm__ volatile("dsb" : : : "memory");
    SCB_AIRCR = SCB_AIRCR_SYSRESETREQ;
    for (;;) { /* the watchdog ends it if the reset does not come */
    }
}

/* `frame`: what the processor pushed on entry (PM0214 2.3.7). With the stack itself gone it may lie outside the
 * memory; then only the vector and CFSR are told. */
void fault_record(const uint32_t *frame, uint32_t vector);
void fault_record(const uint32_t *frame, uint32_t vector) {
    const uintptr_t at = (uintptr_t)frame;
    const bool readable = at >= 0x20000000U && at <= 0x20020000U - 32U;
    kept.fault.vector = vector;
    kept.fault.cfsr = SCB_CFSR;
    kept.fault.pc = readable ? frame[6] : 0U;
    kept.fault.lr = readable ? frame[5] : 0U;
    kept.magic = FAULT_MAGIC;
    board_reset();
}

/* Every exception and interrupt without a handler of its own. The stack pointer is put back to its start first,
 * because it may be what is broken. */
__attribute__((naked)) static void unexpected(void) {
    __asm__ volatile("mov r0, sp\n"
                     "mrs r1, ipsr\n"
                     "ldr r2, =link_stack\n"
                     "mov sp, r2\n"
                     "b fault_record\n"
                     ".ltorg");
}

int main(void);

__attribute__((noreturn)) void startup(void);
void startup(void) {
    SCB_CPACR |= SCB_CPACR_FPU; /* before anything may touch the FPU */
    __asm__ volatile("dsb\n isb" : : : "memory");
    const uint32_t *from = link_data_load;
    for (uint32_t *to = link_data; to < link_data_end; to++) {
        *to = *from++;
    }
    for (uint32_t *to = link_bss; to < link_bss_end; to++) {
        *to = 0;
    }
    for (uint32_t *to = link_ccm; to < link_ccm_end; to++) {
        *to = 0;
    }
    (void)main();
    board_reset();
    for (;;) {
    }
}

typedef union {
    void (*call)(void);
    void *stack;
} vector_t;

#define X {.call = unexpected}
#define X4 X, X, X, X
#define X12 X4, X4, X4
/* clang-format off */
__attribute__((section(".vectors"), used)) static const vector_t vectors[16 + IRQ_COUNT] = {
    {.stack = link_stack}, {.call = startup},
    X12, X, {.call = systick_handler},                /* exceptions 2 to 15, PM0214 2.3.2 */
    X4, X, X, {.call = sensor_ready_handler},         /* interrupts from 0 (RM0090 table 62) to 6 EXTI0 */
    X12, {.call = can_tx_handler},                    /* to 19 CAN1_TX */
    X, X, {.call = can_error_handler},                /* to 22 CAN1_SCE */
    X12, X, X, {.call = usart_handler},               /* to 37 USART1 */
    X12, X4, X, X, {.call = sensor_done_handler},     /* to 56 DMA2_Stream0 */
    X12, X12, X,                                      /* to 81 FPU */
};
/* clang-format on */
