/* A pseudo-terminal of the program's own, with the module's end of an SLCAN line on it. */
#ifndef PTY_H
#define PTY_H

#include <stdbool.h>
#include <stddef.h>

#include "slcan.h"

typedef struct {
    int master;
    int slave;         /* held until the host's first byte, so that an absent host is no hang-up; then -1 */
    int timeout_ms;    /* the host may keep the line full for this long */
    const char *error; /* why the line is of no more use; NULL while it works */
    bool hung_up;
    bool stay; /* a host that hangs up has closed the channel, and another may come */
    char path[64];
    slcan_t slcan;
    size_t pending;
    char out[4096];
} pty_t;

/* Opens it, raw; returns the path of the slave, or NULL with errno set. */
const char *pty_open(pty_t *pty, int timeout_ms, bool stay);

/* Reads and answers commands that are waiting, or that come within `wait_ms`; false if none came. */
bool pty_receive(pty_t *pty, int wait_ms);

/* Queues a frame; without effect while the channel is closed. Blocks while the host reads nothing. */
void pty_send(pty_t *pty, const selfcal_frame_t *frame);

/* Writes out all that is queued. */
void pty_flush(pty_t *pty);

#endif
