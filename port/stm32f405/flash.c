/* Saved state in the two last sectors of the flash, in turn. A slot: a header of 32 bytes, then the state.
 *
 * The header is written last and its checksum is the last word of it, so a save that a power cut ends anywhere leaves a slot that
 * is refused, and the other slot, which was not touched, is the newest. RM0090 3.6: erase sets every bit, programming
 * clears bits; both stall reads of the flash, so the processor stands still meanwhile.
 *
 * Wear: a sector bears 10 000 erases (data sheet); each save erases one of two, so 20 000 saves. */
#include "board.h"
#include "stm32f405.h"

#include <string.h>

enum { SLOTS = 2, FIRST_SECTOR = 10, SLOT_STRIDE = 0x20000, HEADER_BYTES = 32, NONE = SLOTS };
#define SLOT_BASE 0x080C0000U
#define MAGIC 0x53434131U /* "1ACS" */

typedef struct {
    uint32_t magic, sequence, length, payload_crc, reserved[3], header_crc;
} header_t;

static struct {
    uint32_t address, end; /* next word; first byte past the slot */
    uint32_t slot, sequence, length, crc, word, filled;
    bool failed;
} save;

static uint32_t crc32(uint32_t crc, const void *bytes, size_t count)
{
    const uint8_t *byte = bytes;
    for (size_t i = 0; i < count; i++) {
        crc ^= byte[i];
        for (int bit = 0; bit < 8; bit++) {
            crc = crc >> 1 ^ ((crc & 1U) != 0U ? 0xEDB88320U : 0U); /* IEEE 802.3 */
        }
    }
    return crc;
}

static uint32_t crc_of(const void *bytes, size_t count)
{
    return ~crc32(UINT32_MAX, bytes, count);
}

static uint32_t slot_address(uint32_t slot)
{
    return SLOT_BASE + slot * SLOT_STRIDE;
}

static const header_t *header_of(uint32_t slot)
{
    return (const header_t *)(uintptr_t)slot_address(slot);
}

/* A save that reached its end wrote this header. */
static bool headed(uint32_t slot)
{
    const header_t *header = header_of(slot);
    return header->magic == MAGIC && header->header_crc == crc_of(header, offsetof(header_t, header_crc)) &&
           header->length <= FLASH_SLOT_BYTES;
}

static bool whole(uint32_t slot)
{
    return headed(slot) && header_of(slot)->payload_crc == crc_of(header_of(slot) + 1, header_of(slot)->length);
}

/* The slot with the newest state, or the one before it; NONE. */
static uint32_t find(bool older)
{
    const bool good[SLOTS] = {headed(0), headed(1)};
    if (good[0] && good[1]) {
        /* modulo 2^32 */
        const uint32_t newest = (int32_t)(header_of(1)->sequence - header_of(0)->sequence) > 0 ? 1U : 0U;
        return older ? 1U - newest : newest;
    }
    if (older) {
        return NONE;
    }
    return good[0] ? 0U : good[1] ? 1U : NONE;
}

const void *flash_newest(bool older, size_t *length)
{
    const uint32_t slot = find(older);
    if (slot == NONE) {
        return NULL;
    }
    *length = header_of(slot)->length;
    return header_of(slot) + 1;
}

/* Erasing takes 2 s at most, a word 100 us (data sheet, at x32). */
static bool await_idle(void)
{
    const uint32_t start = clock_us32();
    while ((FLASH_SR & FLASH_SR_BSY) != 0U) {
        if (clock_us32() - start > 4000000U) {
            return false;
        }
    }
    const uint32_t errors = FLASH_SR & (FLASH_SR_OPERR | FLASH_SR_WRPERR | FLASH_SR_PGAERR | FLASH_SR_PGPERR | FLASH_SR_PGSERR);
    FLASH_SR = errors; /* cleared by writing 1 */
    return errors == 0U;
}

static void unlock(void)
{
    if ((FLASH_CR & FLASH_CR_LOCK) != 0U) {
        FLASH_KEYR = FLASH_KEY1;
        FLASH_KEYR = FLASH_KEY2;
    }
}

static void lock(void)
{
    FLASH_CR = FLASH_CR_LOCK;
}

static bool program(uint32_t address, uint32_t word)
{
    volatile uint32_t *const place = &REG32(address);
    FLASH_CR = FLASH_CR_PSIZE_X32 | FLASH_CR_PG;
    *place = word;
    __asm__ volatile("dsb" : : : "memory");
    const bool done = await_idle();
    FLASH_CR = FLASH_CR_PSIZE_X32;
    return done && *place == word;
}

bool flash_begin(void)
{
    /* The newest state stays; but if its payload has been damaged since, the one before it does. */
    const uint32_t newest = find(false), older = find(true);
    const uint32_t kept = newest != NONE && !whole(newest) && older != NONE ? older : newest;
    memset(&save, 0, sizeof save);
    save.slot = kept == 0U ? 1U : 0U;
    save.sequence = newest == NONE ? 1U : header_of(newest)->sequence + 1U;
    save.crc = UINT32_MAX;
    save.address = slot_address(save.slot) + HEADER_BYTES;
    save.end = slot_address(save.slot) + SLOT_STRIDE;

    unlock();
    bool done = await_idle();
    FLASH_CR = FLASH_CR_PSIZE_X32 | FLASH_CR_SER | (FIRST_SECTOR + save.slot) << FLASH_CR_SNB_POS;
    FLASH_CR |= FLASH_CR_STRT;
    __asm__ volatile("dsb" : : : "memory");
    done = await_idle() && done;
    /* The data cache may hold what was there before, section 3.5.2. */
    FLASH_ACR &= ~FLASH_ACR_DCEN;
    FLASH_ACR |= FLASH_ACR_DCRST;
    FLASH_ACR &= ~FLASH_ACR_DCRST;
    FLASH_ACR |= FLASH_ACR_DCEN;
    lock();
    save.failed = !done;
    return done;
}

bool flash_put(void *context, const void *bytes, size_t count)
{
    (void)context;
    const uint8_t *byte = bytes;
    unlock();
    for (size_t i = 0; i < count && !save.failed; i++) {
        save.word |= (uint32_t)byte[i] << (8U * save.filled);
        save.filled++;
        if (save.filled == 4U) {
            save.failed = save.address + 4U > save.end || !program(save.address, save.word);
            save.address += 4U;
            save.word = 0;
            save.filled = 0;
        }
    }
    lock();
    save.crc = crc32(save.crc, bytes, count);
    save.length += (uint32_t)count;
    return !save.failed;
}

bool flash_end(void)
{
    unlock();
    if (save.filled > 0U && !save.failed) {
        save.failed = save.address + 4U > save.end || !program(save.address, save.word);
    }
    header_t header = {MAGIC, save.sequence, save.length, ~save.crc, {0, 0, 0}, 0};
    header.header_crc = crc_of(&header, offsetof(header_t, header_crc));
    uint32_t words[sizeof header / 4U];
    memcpy(words, &header, sizeof words);
    for (uint32_t i = 0; i < sizeof header / 4U && !save.failed; i++) {
        save.failed = !program(slot_address(save.slot) + 4U * i, words[i]);
    }
    lock();
    return !save.failed && whole(save.slot);
}
