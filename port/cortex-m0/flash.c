/* Saved state at the end of the code flash (port/app/slots.h), by the NVMC. A page of 1 KB is erased in 22.3 ms, a word
 * written in 46 us at most. The processor runs from the same flash and stands still meanwhile (nRF51 Series Reference
 * Manual 3.0, NVMC). */
#include "board.h"
#include "nrf51.h"

enum { SLOT_STRIDE = 0x8000 };
#define SLOT_BASE 0x30000U

/* Pages of a slot that a state of this model can take. */
enum {
    SLOT_BYTES = SLOTS_HEADER_BYTES + SELFCAL_MODEL_SNAPSHOT_MAX,
    SLOT_PAGES = (SLOT_BYTES + NVMC_PAGE_BYTES - 1) / NVMC_PAGE_BYTES
};
typedef char the_state_fits_its_slot[SLOT_PAGES * NVMC_PAGE_BYTES <= SLOT_STRIDE ? 1 : -1];

static bool await_ready(void) {
    const uint32_t start = clock_us32();
    while ((NVMC_READY & 1U) == 0U) {
        if (clock_us32() - start > 100000U) {
            return false;
        }
    }
    return true;
}

static bool erase(uint32_t slot) {
    const uint32_t start = SLOT_BASE + slot * SLOT_STRIDE;
    bool done = await_ready();
    NVMC_CONFIG = NVMC_CONFIG_ERASE;
    for (uint32_t page = 0; page < SLOT_PAGES && done; page++) {
        NVMC_ERASEPAGE = start + page * NVMC_PAGE_BYTES;
        done = await_ready();
    }
    NVMC_CONFIG = NVMC_CONFIG_READ;
    return done;
}

static bool program(const uint8_t *place, uint32_t word) {
    volatile uint32_t *const to = (volatile uint32_t *)(uintptr_t)place;
    NVMC_CONFIG = NVMC_CONFIG_WRITE;
    *to = word;
    const bool done = await_ready();
    NVMC_CONFIG = NVMC_CONFIG_READ;
    return done && *to == word;
}

const slots_memory_t flash_memory = {(const uint8_t *)SLOT_BASE, SLOT_STRIDE, erase, program};
