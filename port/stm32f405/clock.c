/* Clocks: 168 MHz by the PLL; TIM2 counts microseconds, SysTick wakes the main loop each millisecond. RM0090 7.2 and
 * 7.3, figure 21. */
#include "board.h"
#include "stm32f405.h"

/* The board's crystal. */
#ifndef BOARD_HSE_HZ
#define BOARD_HSE_HZ 8000000
#endif
#if BOARD_HSE_HZ < 4000000 || BOARD_HSE_HZ > 26000000 || BOARD_HSE_HZ % 1000000 != 0
#error "BOARD_HSE_HZ: 4000000 to 26000000, whole MHz"
#endif

enum { HSE_HZ = BOARD_HSE_HZ, HSI_HZ = 16000000, PLL_HZ = 168000000 };

board_clock_t board_clock;
static volatile uint32_t ticks;

/* Bounded: HSE starts within 2 ms (data sheet), the PLL locks within 0.3 ms; a turn takes 5 or more cycles of 16
 * MHz. */
static bool await(const volatile uint32_t *reg, uint32_t mask, uint32_t value) {
    for (uint32_t turn = 0; turn < 60000U; turn++) {
        if ((*reg & mask) == value) {
            return true;
        }
    }
    return false;
}

/* VCO = input / M * N with input / M = 1 MHz, N = 336; P = 2, Q = 7 (section 7.3.2). */
static bool pll_start(uint32_t source_hz, uint32_t source) {
    RCC_PLLCFGR =
        source_hz / 1000000U | 336U << RCC_PLLCFGR_N_POS | 0U << RCC_PLLCFGR_P_POS | source | 7U << RCC_PLLCFGR_Q_POS;
    RCC_CR |= RCC_CR_PLLON;
    return await(&RCC_CR, RCC_CR_PLLRDY, RCC_CR_PLLRDY);
}

void clock_init(void) {
    RCC_APB1ENR |= RCC_APB1ENR_PWR | RCC_APB1ENR_TIM2;
    (void)RCC_APB1ENR; /* errata sheet ES0182: a peripheral answers two cycles after its clock is on */
    PWR_CR |= PWR_CR_VOS;
    FLASH_ACR = FLASH_ACR_LATENCY_5WS | FLASH_ACR_PRFTEN | FLASH_ACR_ICEN | FLASH_ACR_DCEN;

    RCC_CR |= RCC_CR_HSEON;
    board_clock.crystal = await(&RCC_CR, RCC_CR_HSERDY, RCC_CR_HSERDY);
    const bool locked = board_clock.crystal ? pll_start(HSE_HZ, RCC_PLLCFGR_SRC_HSE) : pll_start(HSI_HZ, 0U);
    if (locked) {
        RCC_CFGR = RCC_CFGR_PPRE1_DIV4 | RCC_CFGR_PPRE2_DIV4; /* SPI1 divides PCLK2 by 256 at most */
        RCC_CFGR |= RCC_CFGR_SW_PLL;
    }
    if (locked && await(&RCC_CFGR, RCC_CFGR_SW_MASK << RCC_CFGR_SWS_POS, RCC_CFGR_SW_PLL << RCC_CFGR_SWS_POS)) {
        board_clock.hclk_hz = PLL_HZ;
        board_clock.pclk1_hz = PLL_HZ / 4U;
        board_clock.pclk2_hz = PLL_HZ / 4U;
        board_clock.tim2_hz = PLL_HZ / 2U; /* twice PCLK1 where that is divided, section 7.2 */
        if (board_clock.crystal) {
            RCC_CR |= RCC_CR_CSSON; /* a crystal that stops raises NMI, which resets: the next start takes HSI */
        }
    } else {
        RCC_CFGR = 0U;
        board_clock = (board_clock_t){HSI_HZ, HSI_HZ, HSI_HZ, HSI_HZ, false};
    }

    TIM2_PSC = board_clock.tim2_hz / 1000000U - 1U;
    TIM2_ARR = UINT32_MAX;
    TIM2_EGR = TIM_EGR_UG; /* takes the prescaler over, section 18.4.11 */
    TIM2_CR1 = TIM_CR1_CEN;
    SYST_RVR = board_clock.hclk_hz / 1000U - 1U;
    SYST_CVR = 0U;
    SYST_CSR = SYST_CSR_RUN;
}

void systick_handler(void) {
    ticks++;
}

uint32_t clock_ticks(void) {
    return ticks;
}

/* Not from the ticks, which an erase of the flash keeps from being counted. */
uint32_t clock_ms(void) {
    return (uint32_t)(clock_us() / 1000U);
}

uint32_t clock_us32(void) {
    return TIM2_CNT;
}

/* Called from the main loop at least once in 71 minutes. */
uint64_t clock_us(void) {
    static uint64_t now;
    now += TIM2_CNT - (uint32_t)now;
    return now;
}

void clock_spin_us(uint32_t us) {
    /* 2 to 4 cycles a turn */
    uint32_t turns = us * (board_clock.hclk_hz / 2000000U) + 1U;
    __asm__ volatile(".syntax unified\n1: subs %0, #1\n bne 1b" : "+r"(turns) : : "cc");
}
