/* Random numbers for challenges: the RNG gives a byte in 0.7 ms with its correction of bias. */
#include "board.h"
#include "nrf51.h"

enum { BYTE_US = 5000 };

bool rng_number(uint32_t *number) {
    uint32_t all = 0;
    RNG_CONFIG = RNG_CONFIG_UNBIASED;
    RNG_VALRDY = 0U;
    RNG_START = 1U;
    for (int byte = 0; byte < 4; byte++) {
        const uint32_t start = clock_us32();
        while (RNG_VALRDY == 0U) {
            if (clock_us32() - start > BYTE_US) {
                RNG_STOP = 1U;
                return false;
            }
        }
        RNG_VALRDY = 0U; /* before VALUE is read: the next one sets it again */
        all = all << 8 | (RNG_VALUE & 0xFFU);
    }
    RNG_STOP = 1U;
    *number = all;
    return true;
}
