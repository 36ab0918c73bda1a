/* Start-up, semihosting and clock of a bench image. */
#include "image.h"

#include <stdbool.h>
#include <stddef.h>

extern uint32_t image_data_load[], image_data[], image_data_end[], image_bss[], image_bss_end[];
extern void image_stack(void); /* its address is the stack's */

#define REGISTER(address) (*(volatile uint32_t *)(address))
#define SYST_CSR REGISTER(0xE000E010U)
#define SYST_RVR REGISTER(0xE000E014U)
#define SYST_CVR REGISTER(0xE000E018U)
#define CPACR REGISTER(0xE000ED88U)
#define RELOAD 0xFFFFFFU

volatile uint32_t image_rounds;

/* --- semihosting --- */

enum { SYS_WRITE0 = 0x04, SYS_EXIT_EXTENDED = 0x20 };

static void semihost(uint32_t operation, const void *argument) {
    register uint32_t r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = argument;
    __asm__ volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
}

void image_print(const char *text) {
    semihost(SYS_WRITE0, text);
}

void image_print_number(uint64_t number) {
    char text[21];
    size_t at = sizeof text - 1U;
    text[at] = '\0';
    do {
        text[--at] = (char)('0' + (int)(number % 10U));
        number /= 10U;
    } while (number > 0U);
    image_print(&text[at]);
}

void image_exit(uint32_t code) {
    const uint32_t block[2] = {0x20026U /* ADP_Stopped_ApplicationExit */, code};
    semihost(SYS_EXIT_EXTENDED, block);
    for (;;) {
    }
}

/* --- clock --- */

/* In assembly, so that what it adds to a count is known: five instructions. */
__attribute__((naked)) static void count_round(void) {
    __asm__ volatile(".syntax unified\n ldr r0, =image_rounds\n ldr r1, [r0]\n adds r1, #1\n str r1, [r0]\n bx lr\n"
                     ".ltorg");
}

void image_start_clock(void) {
    SYST_RVR = RELOAD;
    SYST_CVR = 0;
    SYST_CSR = 7U; /* processor clock, interrupt, on */
}

image_time_t image_now(void) {
    uint32_t before, left;
    do {
        before = image_rounds;
        left = SYST_CVR;
    } while (before != image_rounds);
    const image_time_t now = {(uint64_t)before * (RELOAD + 1ULL) + (RELOAD - left), before};
    return now;
}

__attribute__((naked, noinline)) void image_known_loop(uint32_t count) {
    (void)count;
    __asm__ volatile(".syntax unified\n1: nop\n subs r0, #1\n bne 1b\n bx lr");
}

/* --- start-up --- */

static void fault(void) {
    image_print("fault\n");
    image_exit(3U);
}

void reset(void);
void reset(void) {
#ifdef __ARM_FP
    CPACR |= 0xFU << 20; /* before anything may touch the FPU */
    __asm__ volatile("dsb\n isb" : : : "memory");
#endif
    const uint32_t *from = image_data_load;
    for (uint32_t *to = image_data; to < image_data_end; to++) {
        *to = *from++;
    }
    for (uint32_t *to = image_bss; to < image_bss_end; to++) {
        *to = 0;
    }
    image_exit((uint32_t)main());
}

typedef void (*vector_t)(void);
__attribute__((section(".vectors"), used)) static const vector_t vectors[16] = {
    image_stack, reset, fault, fault, fault, fault, fault, NULL,
    NULL,        NULL,  NULL,  fault, fault, NULL,  fault, count_round,
};
