/* Independent watchdog and the cause of the last reset. RM0090 chapter 21, section 7.3.21. */
#include "board.h"
#include "stm32f405.h"

enum { RELOAD = 999 }; /* 1000 counts of 32 kHz / 256: 8 s */

reset_cause_t watchdog_reset_cause(void) {
    const uint32_t flags = RCC_CSR;
    RCC_CSR |= RCC_CSR_RMVF;
    /* Several are set at once: every reset pulls the pin too, and power-on sets brown-out. */
    return (flags & RCC_CSR_PORRSTF) != 0U || (flags & RCC_CSR_BORRSTF) != 0U ? RESET_POWER_ON
           : (flags & (RCC_CSR_IWDGRSTF | RCC_CSR_WWDGRSTF)) != 0U            ? RESET_WATCHDOG
           : (flags & RCC_CSR_SFTRSTF) != 0U                                  ? RESET_SOFTWARE
           : (flags & RCC_CSR_LPWRRSTF) != 0U                                 ? RESET_LOW_POWER
           : (flags & RCC_CSR_PINRSTF) != 0U                                  ? RESET_PIN
                                                                              : RESET_UNKNOWN;
}

void watchdog_start(void) {
    IWDG_KR = IWDG_KR_START; /* starts LSI, which the other two registers need */
    IWDG_KR = IWDG_KR_ACCESS;
    IWDG_PR = IWDG_PR_DIV256;
    IWDG_RLR = RELOAD;
    for (uint32_t turn = 0; turn < 100000U && IWDG_SR != 0U; turn++) {
    } /* section 21.4.4: five cycles of LSI */
    watchdog_feed();
}

void watchdog_feed(void) {
    IWDG_KR = IWDG_KR_RELOAD;
}
