/* SLCAN on a serial line that interrupts serve: a ring of bytes each way between the main loop and the interrupt's
 * handler.
 *
 * The main loop calls slcan_line_send() and slcan_line_poll(), the handler slcan_line_received() and
 * slcan_line_next(). The board starts its transmitter after the first two. */
#ifndef SLCAN_LINE_H
#define SLCAN_LINE_H

#include "slcan.h"

/* `head` and `tail` count up for ever. Each is moved by one side alone. */
typedef struct {
    volatile uint8_t *byte; /* [size] */
    uint32_t size;          /* a power of two */
    volatile uint32_t head; /* bytes that went in */
    volatile uint32_t tail; /* bytes that came out */
} byte_ring_t;

typedef struct {
    slcan_t slcan;
    byte_ring_t out, in;
    volatile uint32_t lost; /* bytes that were damaged, or found no room; the handler counts */
    uint32_t dropped;       /* frames that were made while the host had not opened the channel */
} slcan_line_t;

/* Over arrays of the board; all else is zero. */
#define SLCAN_LINE(out_bytes, in_bytes)                                                                                \
    {                                                                                                                  \
        .out = {.byte = (out_bytes), .size = sizeof(out_bytes)}, .in = {.byte = (in_bytes), .size = sizeof(in_bytes) } \
    }

/* Takes a frame, or drops it on a closed channel. False: no room, offer it again. */
bool slcan_line_send(slcan_line_t *line, const selfcal_frame_t *frame);

/* Looks at the bytes that came, up to the first command. True: a command is in `line->slcan.data`; call again. An
 * answer that finds no room is left out. */
bool slcan_line_poll(slcan_line_t *line);

/* True once the handler has taken all bytes. */
bool slcan_line_empty(const slcan_line_t *line);

/* A byte came. */
void slcan_line_received(slcan_line_t *line, uint8_t byte);

/* The next byte for the transmitter; false: there is none. */
bool slcan_line_next(slcan_line_t *line, uint8_t *byte);

#endif
