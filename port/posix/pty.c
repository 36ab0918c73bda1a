#define _DEFAULT_SOURCE /* cfmakeraw */
#define _XOPEN_SOURCE 600

#include "pty.h"

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <unistd.h>

/* Opens the slave, raw, for the program itself; false with errno set. */
static bool hold(pty_t *pty) {
    struct termios mode;
    pty->slave = open(pty->path, O_RDWR | O_NOCTTY);
    if (pty->slave < 0 || tcgetattr(pty->slave, &mode) != 0) {
        return false;
    }
    cfmakeraw(&mode);
    return tcsetattr(pty->slave, TCSANOW, &mode) == 0;
}

const char *pty_open(pty_t *pty, int timeout_ms, bool stay) {
    memset(pty, 0, sizeof *pty);
    pty->timeout_ms = timeout_ms;
    pty->stay = stay;
    slcan_init(&pty->slcan);
    pty->master = posix_openpt(O_RDWR | O_NOCTTY);
    if (pty->master < 0 || grantpt(pty->master) != 0 || unlockpt(pty->master) != 0) {
        return NULL;
    }
    const char *path = ptsname(pty->master);
    if (path == NULL || strlen(path) >= sizeof pty->path) {
        return NULL;
    }
    memcpy(pty->path, path, strlen(path) + 1U);
    return hold(pty) && fcntl(pty->master, F_SETFL, O_NONBLOCK) == 0 ? pty->path : NULL;
}

static void hang_up(pty_t *pty) {
    if (pty->stay) {
        slcan_init(&pty->slcan);
        pty->pending = 0;
        pty->error = hold(pty) ? NULL : strerror(errno);
        return;
    }
    pty->hung_up = true;
    pty->error = "the host hung up";
}

static void read_commands(pty_t *pty) {
    unsigned char bytes[256];
    const ssize_t got = read(pty->master, bytes, sizeof bytes);
    if (got < 0 && (errno == EAGAIN || errno == EINTR)) {
        return;
    }
    if (got <= 0) {
        hang_up(pty);
        return;
    }
    if (pty->slave >= 0) {
        (void)close(pty->slave);
        pty->slave = -1;
    }
    for (ssize_t i = 0; i < got; i++) {
        char answer[SLCAN_ANSWER_BYTES];
        const size_t length = slcan_receive(&pty->slcan, bytes[i], answer);
        if (length <= sizeof pty->out - pty->pending) { /* a host that floods and never reads loses answers */
            memcpy(pty->out + pty->pending, answer, length);
            pty->pending += length;
        }
    }
}

/* Waits for input, or for room to write; false on a timeout. */
static bool wait_line(pty_t *pty, short events, int wait_ms) {
    struct pollfd line = {.fd = pty->master, .events = events, .revents = 0};
    const int ready = poll(&line, 1, wait_ms);
    if (ready < 0) {
        if (errno != EINTR) {
            pty->error = strerror(errno);
        }
        return true;
    }
    if ((line.revents & POLLIN) != 0) {
        read_commands(pty);
    } else if ((line.revents & (POLLHUP | POLLERR)) != 0) {
        hang_up(pty);
    }
    return ready > 0;
}

void pty_flush(pty_t *pty) {
    while (pty->pending > 0 && pty->error == NULL) {
        const ssize_t written = write(pty->master, pty->out, pty->pending);
        if (written > 0) {
            pty->pending -= (size_t)written;
            memmove(pty->out, pty->out + written, pty->pending);
        } else if (written < 0 && errno != EAGAIN && errno != EINTR) {
            hang_up(pty);
        } else if (!wait_line(pty, POLLIN | POLLOUT, pty->timeout_ms)) {
            pty->error = "the host stopped reading";
        }
    }
}

bool pty_receive(pty_t *pty, int wait_ms) {
    const bool came = wait_line(pty, POLLIN, wait_ms);
    pty_flush(pty);
    return came;
}

void pty_send(pty_t *pty, const selfcal_frame_t *frame) {
    if (!pty->slcan.open) {
        return;
    }
    if (sizeof pty->out - pty->pending < SLCAN_FRAME_BYTES) {
        pty_flush(pty);
    }
    if (pty->error == NULL) {
        slcan_encode(frame, pty->out + pty->pending);
        pty->pending += SLCAN_FRAME_BYTES;
    }
}
