/* Start-up of an emulated Cortex-M. Any exception ends the emulator with exit code 3. */
#include "semihost.h"

extern uint32_t link_stack[], link_data_load[], link_data[], link_data_end[], link_bss[], link_bss_end[];

int main(void);

static void unexpected(void) {
    semihost_print("the processor faulted\n");
    semihost_exit(3U);
}

#ifdef QEMU_STACK
/* How deep the stack went, said at the end: what the bound from the call graph is held against. */
#define UNTOUCHED 0x5AFE57ACU

static void print_stack(uint32_t bytes) {
    char text[] = "stack 0000\n";
    for (int at = 9; at >= 6; at--) {
        text[at] = (char)('0' + (int)(bytes % 10U));
        bytes /= 10U;
    }
    semihost_print(text);
}
#endif

void startup(void);
void startup(void) {
#ifdef __ARM_FP
    volatile uint32_t *const cpacr = (volatile uint32_t *)0xE000ED88U;
    *cpacr |= 0xFU << 20; /* the FPU, before anything may touch it */
    __asm__ volatile("dsb\n isb" : : : "memory");
#endif
    const uint32_t *from = link_data_load;
    for (uint32_t *to = link_data; to < link_data_end; to++) {
        *to = *from++;
    }
    for (uint32_t *to = link_bss; to < link_bss_end; to++) {
        *to = 0;
    }
#ifdef QEMU_STACK
    uint32_t *low = (uint32_t *)0x20000000;
    for (uint32_t *at = low; at < (uint32_t *)__builtin_frame_address(0) - 16; at++) {
        *at = UNTOUCHED;
    }
    const uint32_t code = (uint32_t)main();
    while (*low == UNTOUCHED) {
        low++;
    }
    print_stack((uint32_t)(link_stack - low) * sizeof *low);
    semihost_exit(code);
#else
    semihost_exit((uint32_t)main());
#endif
}

typedef union {
    const void *stack;
    void (*call)(void);
} vector_t;

/* clang-format off */
__attribute__((section(".vectors"), used)) static const vector_t vectors[16] = {
    {.stack = link_stack},  {.call = startup},      {.call = unexpected},   {.call = unexpected},
    {.call = unexpected},   {.call = unexpected},   {.call = unexpected},   {.stack = 0},
    {.stack = 0},           {.stack = 0},           {.stack = 0},           {.call = unexpected},
    {.call = unexpected},   {.stack = 0},           {.call = unexpected},   {.call = unexpected},
};
/* clang-format on */
