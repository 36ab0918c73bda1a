/* What a bare-metal bench image runs on: a Cortex-M under QEMU with `-icount shift=6,sleep=off`, where every
 * instruction takes 64 ns of virtual time, and semihosting. */
#ifndef IMAGE_H
#define IMAGE_H

#include <stdint.h>

/* SysTick ticks since image_start_clock(), and how often the counter ran round: its handler adds
 * IMAGE_HANDLER_INSTRUCTIONS each time. */
typedef struct {
    uint64_t ticks;
    uint32_t rounds;
} image_time_t;

void image_start_clock(void);
image_time_t image_now(void);

/* Exactly 3 * rounds instructions and those of the call. */
void image_known_loop(uint32_t rounds);

void image_print(const char *text);
void image_print_number(uint64_t number);
void image_exit(uint32_t code);

/* Of the image; 0 is success. */
int main(void);

#endif
