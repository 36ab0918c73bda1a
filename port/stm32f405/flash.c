/* Saved state in the two last sectors of the flash (port/app/slots.h). RM0090 3.6: erase sets every bit, programming
 * clears bits; both stall reads of the flash, so the processor stands still meanwhile. */
#include "board.h"
#include "stm32f405.h"

enum { FIRST_SECTOR = 10, SLOT_STRIDE = 0x20000 };
#define SLOT_BASE 0x080C0000U

/* Erasing takes 2 s at most, a word 100 us (data sheet, at x32). */
static bool await_idle(void) {
    const uint32_t start = clock_us32();
    while ((FLASH_SR & FLASH_SR_BSY) != 0U) {
        if (clock_us32() - start > 4000000U) {
            return false;
        }
    }
    const uint32_t errors =
        FLASH_SR & (FLASH_SR_OPERR | FLASH_SR_WRPERR | FLASH_SR_PGAERR | FLASH_SR_PGPERR | FLASH_SR_PGSERR);
    FLASH_SR = errors; /* cleared by writing 1 */
    return errors == 0U;
}

static void unlock(void) {
    if ((FLASH_CR & FLASH_CR_LOCK) != 0U) {
        FLASH_KEYR = FLASH_KEY1;
        FLASH_KEYR = FLASH_KEY2;
    }
}

static void lock(void) {
    FLASH_CR = FLASH_CR_LOCK;
}

static bool erase(uint32_t slot) {
    unlock();
    bool done = await_idle();
    FLASH_CR = FLASH_CR_PSIZE_X32 | FLASH_CR_SER | (FIRST_SECTOR + slot) << FLASH_CR_SNB_POS;
    FLASH_CR |= FLASH_CR_STRT;
    __asm__ volatile("dsb" : : : "memory");
    done = await_idle() && done;
    /* The data cache may hold what was there before, section 3.5.2. */
    FLASH_ACR &= ~FLASH_ACR_DCEN;
    FLASH_ACR |= FLASH_ACR_DCRST;
    FLASH_ACR &= ~FLASH_ACR_DCRST;
    FLASH_ACR |= FLASH_ACR_DCEN;
    lock();
    return done;
}

static bool program(const uint8_t *place, uint32_t word) {
    volatile uint32_t *const to = (volatile uint32_t *)(uintptr_t)place;
    unlock();
    FLASH_CR = FLASH_CR_PSIZE_X32 | FLASH_CR_PG;
    *to = word;
    __asm__ volatile("dsb" : : : "memory");
    const bool done = await_idle();
    FLASH_CR = FLASH_CR_PSIZE_X32;
    lock();
    return done && *to == word;
}

const slots_memory_t flash_memory = {(const uint8_t *)SLOT_BASE, SLOT_STRIDE, erase, program};
