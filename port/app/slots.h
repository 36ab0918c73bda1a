/* Saved state in two slots of flash in turn. Each save erases one slot and writes the state and a header of 32
 * bytes.
 *
 * The header is written last, and its checksum is its last word. So a power cut at any instant of a save leaves a
 * slot that is refused. The other slot was not touched and is the newest. No I/O here: a board gives the memory. */
#ifndef SLOTS_H
#define SLOTS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum { SLOTS = 2, SLOTS_HEADER_BYTES = 32 };

/* Flash that is mapped into memory: erasing sets every bit, programming clears bits, a word at a time. */
typedef struct {
    const uint8_t *base; /* of slot 0; slot 1 lies `stride` bytes on; aligned to 4 */
    uint32_t stride;     /* bytes a slot keeps, its header included */
    /* Both return when it is done; false: the memory refused, or (program) does not read back. */
    bool (*erase)(uint32_t slot);
    bool (*program)(const uint8_t *place, uint32_t word);
} slots_memory_t;

typedef struct {
    const slots_memory_t *memory;
    /* the save under way */
    uint32_t at, slot; /* next byte in the slot */
    uint32_t sequence, crc, word, filled;
    bool failed;
} slots_t;

/* The following are callbacks of port_module_t; `context` is a slots_t with its `memory` set. */

/* The newest state whose save reached its end, or NULL; `older`: the one before it. The state's own checksum tells
 * whether it is still as it was written. With no such state, but a slot that was written and has no whole header,
 * the length is 0: start-up refuses that. */
const void *slots_stored(void *context, bool older, size_t *length);

/* A save: begin erases the slot of the older state, put appends, end writes the header if the state is `whole`.
 * Until the header's last word is written the newest state stays as it was. With `keep_older`, or a damaged newest
 * state, the one before it is kept instead, where there is one. False: the memory refused, or is full; the save is
 * void. */
bool slots_begin(void *context, bool keep_older);
bool slots_put(void *context, const void *bytes, size_t count);
bool slots_end(void *context, bool whole);

#endif
