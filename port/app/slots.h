/* Saved state in two slots of flash in turn: each save erases one of them and writes a header of 32 bytes and the state.
 *
 * The header is written last and its checksum is its last word, so a save that a power cut ends anywhere leaves a slot that is
 * refused, and the other slot, which was not touched, is the newest. No I/O here: a board gives the memory. */
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

/* The newest state whose save reached its end, or NULL; `older`: the one before it. Whether it is still what was written its own
 * checksum tells. If there is none, but a slot that was written and has no whole header, a state of length 0, for start-up to refuse. */
const void *slots_stored(void *context, bool older, size_t *length);

/* A save: begin erases the slot of the older state, put appends, end writes the header if the state is `whole`. Until the header's last
 * word is written the newest state stays what it was. With `keep_older`, or a newest state that has been damaged, the one before it is
 * kept instead, where there is one. False: the memory refused, or is full; the save is void. */
bool slots_begin(void *context, bool keep_older);
bool slots_put(void *context, const void *bytes, size_t count);
bool slots_end(void *context, bool whole);

#endif
