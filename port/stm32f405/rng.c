/* Random numbers for challenges. RM0090 chapter 24; the clock is the PLL's 48 MHz. */
#include "board.h"
#include "stm32f405.h"

static bool next(uint32_t *number) {
    const uint32_t start = clock_us32();
    while ((RNG_SR & RNG_SR_DRDY) == 0U) {
        /* A number takes 40 periods of the clock. */
        if ((RNG_SR & (RNG_SR_CECS | RNG_SR_SECS)) != 0U || clock_us32() - start > 300U) {
            return false;
        }
    }
    *number = RNG_DR;
    return true;
}

bool rng_number(uint32_t *number) {
    uint32_t before = 0;
    RCC_AHB2ENR |= RCC_AHB2ENR_RNG;
    (void)RCC_AHB2ENR;
    RNG_CR = RNG_CR_RNGEN;
    /* The first number after it is switched on is only for comparison; two equal ones are a failure (section
     * 24.3.1). */
    const bool done = next(&before) && next(number) && *number != before;
    RNG_CR = 0U;
    return done;
}
