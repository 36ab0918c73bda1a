/* SLCAN, the Lawicel text protocol: CAN frames over a serial line, as python-can's `slcan` and slcand speak it.
 * This end is the adapter. Its bus carries telemetry only, so lines that transmit are refused. The one exception is the
 * COMMAND message in an image with commands. No I/O here: bytes go in, bytes to write come out. */
#ifndef SLCAN_H
#define SLCAN_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "selfcal.h"

#define SLCAN_FRAME_BYTES 22 /* "t" id(3) length(1) data(16) CR */
#define SLCAN_ANSWER_BYTES 8
/* The longest line that is accepted. */
#ifdef APP_COMMAND_KEY
#define SLCAN_LINE_BYTES 21
#else
#define SLCAN_LINE_BYTES 2
#endif

typedef struct {
    bool open;           /* frames may be sent */
    bool listening_only; /* ... and none is taken */
    uint8_t length;      /* of the line so far; one more than `line` stands for any that is longer */
    char line[SLCAN_LINE_BYTES];
#ifdef APP_COMMAND_KEY
    bool came; /* a COMMAND message, its bytes in `data`: the caller's to take */
    uint8_t data[8];
#endif
} slcan_t;

void slcan_init(slcan_t *self);

/* Takes one byte from the host. Returns the bytes of `answer` to write back: 0 within a line. A line ends in CR,
 * or in CR and LF.
 *   C               closes the channel
 *   O, L            open it, also when it is open; with L no command is taken
 *   S0 to S8, none  are accepted and change nothing
 *   V, v, N         are answered
 *   t2088...        a COMMAND message (here of node 0) with 16 hexadecimal digits, on an open channel, with commands
 *   anything else   is answered BEL */
size_t slcan_receive(slcan_t *self, uint8_t byte, char answer[SLCAN_ANSWER_BYTES]);

/* The frame as a line, without a terminating zero. */
void slcan_encode(const selfcal_frame_t *frame, char line[SLCAN_FRAME_BYTES]);

#endif
