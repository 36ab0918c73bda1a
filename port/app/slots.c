#include "slots.h"

#include <string.h>

enum { NONE = SLOTS };
#define MAGIC 0x53434131U /* "1ACS" */

typedef struct {
    uint32_t magic, sequence, length, payload_crc, reserved[3], header_crc;
} header_t;

static uint32_t crc32(uint32_t crc, const void *bytes, size_t count) {
    const uint8_t *byte = bytes;
    for (size_t i = 0; i < count; i++) {
        crc ^= byte[i];
        for (int bit = 0; bit < 8; bit++) {
            crc = crc >> 1 ^ ((crc & 1U) != 0U ? 0xEDB88320U : 0U); /* IEEE 802.3 */
        }
    }
    return crc;
}

static uint32_t crc_of(const void *bytes, size_t count) {
    return ~crc32(UINT32_MAX, bytes, count);
}

static const uint8_t *start_of(const slots_t *self, uint32_t slot) {
    return self->memory->base + (size_t)slot * self->memory->stride;
}

static header_t header_of(const slots_t *self, uint32_t slot) {
    header_t header;
    memcpy(&header, start_of(self, slot), sizeof header);
    return header;
}

/* A save that reached its end wrote this header. */
static bool headed(const slots_t *self, uint32_t slot) {
    const header_t header = header_of(self, slot);
    return header.magic == MAGIC && header.header_crc == crc_of(&header, offsetof(header_t, header_crc)) &&
           header.length <= self->memory->stride - SLOTS_HEADER_BYTES;
}

static bool whole_slot(const slots_t *self, uint32_t slot) {
    const header_t header = header_of(self, slot);
    return headed(self, slot) && header.payload_crc == crc_of(start_of(self, slot) + SLOTS_HEADER_BYTES, header.length);
}

/* The slot with the newest state, or the one before it; NONE. */
static uint32_t find(const slots_t *self, bool older) {
    const bool good[SLOTS] = {headed(self, 0), headed(self, 1)};
    if (good[0] && good[1]) {
        /* modulo 2^32 */
        const uint32_t newest = (int32_t)(header_of(self, 1).sequence - header_of(self, 0).sequence) > 0 ? 1U : 0U;
        return older ? 1U - newest : newest;
    }
    if (older) {
        return NONE;
    }
    return good[0] ? 0U : good[1] ? 1U : NONE;
}

/* Nothing was written there since the last erase. */
static bool blank(const slots_t *self, uint32_t slot) {
    const uint8_t *byte = start_of(self, slot);
    size_t erased = 0;
    while (erased < SLOTS_HEADER_BYTES && byte[erased] == 0xFFU) {
        erased++;
    }
    return erased == SLOTS_HEADER_BYTES;
}

/* Where no slot has a header and one has what is left of it, that is a state of no bytes: to be refused, not to be
 * passed over. */
const void *slots_stored(void *context, bool older, size_t *length) {
    const slots_t *self = context;
    const uint32_t slot = find(self, older);
    if (slot == NONE) {
        *length = 0;
        return older || (blank(self, 0) && blank(self, 1)) ? NULL : start_of(self, 0);
    }
    *length = header_of(self, slot).length;
    return start_of(self, slot) + SLOTS_HEADER_BYTES;
}

bool slots_begin(void *context, bool keep_older) {
    slots_t *self = context;
    const uint32_t newest = find(self, false), older = find(self, true);
    const uint32_t kept = older != NONE && (keep_older || !whole_slot(self, newest)) ? older : newest;
    self->slot = kept == 0U ? 1U : 0U;
    self->sequence = newest == NONE ? 1U : header_of(self, newest).sequence + 1U;
    self->at = SLOTS_HEADER_BYTES;
    self->crc = UINT32_MAX;
    self->word = 0;
    self->filled = 0;
    self->failed = !self->memory->erase(self->slot);
    return !self->failed;
}

static void program_word(slots_t *self) {
    self->failed = self->failed || self->at + 4U > self->memory->stride ||
                   !self->memory->program(start_of(self, self->slot) + self->at, self->word);
    self->at += 4U;
    self->word = 0;
    self->filled = 0;
}

bool slots_put(void *context, const void *bytes, size_t count) {
    slots_t *self = context;
    const uint8_t *byte = bytes;
    for (size_t i = 0; i < count && !self->failed; i++) {
        self->word |= (uint32_t)byte[i] << (8U * self->filled);
        self->filled++;
        if (self->filled == 4U) {
            program_word(self);
        }
    }
    self->crc = crc32(self->crc, bytes, count);
    return !self->failed;
}

bool slots_end(void *context, bool whole) {
    slots_t *self = context;
    if (!whole || self->failed) {
        return false;
    }
    const uint32_t length = self->at - SLOTS_HEADER_BYTES + self->filled;
    if (self->filled > 0U) {
        program_word(self);
    }
    header_t header = {MAGIC, self->sequence, length, ~self->crc, {0, 0, 0}, 0};
    header.header_crc = crc_of(&header, offsetof(header_t, header_crc));
    uint32_t words[sizeof header / 4U];
    memcpy(words, &header, sizeof words);
    for (uint32_t i = 0; i < sizeof header / 4U && !self->failed; i++) {
        self->failed = !self->memory->program(start_of(self, self->slot) + (size_t)4U * i, words[i]);
    }
    return !self->failed && whole_slot(self, self->slot);
}
