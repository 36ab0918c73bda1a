/* The application on an emulated board (QEMU's netduinoplus2: Cortex-M4F; microbit: Cortex-M0). A recording, read
 * through semihosting, takes the sensor's place; telemetry leaves through the emulated UART as SLCAN.
 *
 * Arguments (-semihosting-config arg=...): a word, the recording's file (port/replay/replay.h), the report period in
 * ms, and "gate" to keep motion out.
 * Says SELFCAL_UART on the console once it listens.
 * Time is the recording's, so every run sends the same bytes. It stands still until the host opens the channel; the
 * emulator ends when the host has closed it after the last frame. Exit code: 0; 1 if the host never came or never
 * closed; 2 for bad arguments or a bad recording; 3 for a fault of the processor. */
#include "app.h"
#include "replay.h"
#include "semihost.h"
#include "slcan.h"
#include "uart.h"

#include <string.h>

enum { ROWS_BUFFERED = 32, ROWS_BETWEEN_POLLS = 64, TIMEOUT_S = 60 };

typedef struct {
    int32_t file;
    size_t at, filled; /* of `buffer` */
    unsigned char buffer[ROWS_BUFFERED * REPLAY_ROW_BYTES];
    replay_t replay;
    slcan_t slcan;
    uint32_t unpolled;
    const char *error;
} board_t;

static board_t board;
static app_t app;

static bool board_read(void *context, void *bytes, size_t count) {
    board_t *self = context;
    unsigned char *to = bytes;
    while (count > 0U) {
        if (self->at == self->filled) {
            self->at = 0;
            self->filled = semihost_read(self->file, self->buffer, sizeof self->buffer);
            if (self->filled == 0U) {
                return false;
            }
        }
        const size_t there = self->filled - self->at;
        const size_t part = count < there ? count : there;
        memcpy(to, self->buffer + self->at, part);
        self->at += part;
        to += part;
        count -= part;
    }
    return true;
}

static uint32_t board_time_ms(void *context) {
    const board_t *self = context;
    return self->replay.time_ms;
}

static port_sample_t board_sample(void *context, float reading[], uint32_t *missing) {
    board_t *self = context;
    return replay_sample(&self->replay, reading, missing);
}

static bool board_send(void *context, const selfcal_frame_t *frame) {
    const board_t *self = context;
    if (self->slcan.open) {
        char line[SLCAN_FRAME_BYTES];
        slcan_encode(frame, line);
        uart_send(line, sizeof line);
    }
    return true;
}

static void answer_host(board_t *self) {
    uint8_t byte;
    while (uart_receive(&byte)) {
        char answer[SLCAN_ANSWER_BYTES];
        uart_send(answer, slcan_receive(&self->slcan, byte, answer));
    }
}

/* The application has nothing to do: time goes on by one row. */
static void board_idle(void *context) {
    board_t *self = context;
    if (++self->unpolled >= ROWS_BETWEEN_POLLS) {
        self->unpolled = 0;
        answer_host(self);
    }
    if (self->slcan.open) {
        self->error = replay_next(&self->replay);
    }
}

/* False if the host lets TIMEOUT_S of wall time pass. */
static bool await_channel(board_t *self, bool open) {
    if (self->slcan.open != open) {
        const uint32_t start = semihost_wall_s();
        do {
            answer_host(self);
        } while (self->slcan.open != open && semihost_wall_s() - start <= TIMEOUT_S);
    }
    return self->slcan.open == open;
}

/* The recording's path and the period out of the command line; false if they are not there. */
static bool arguments(char *line, const char **path, uint32_t *period_ms, bool *gate) {
    char *const file = strchr(line, ' ');
    char *const period = file != NULL ? strchr(file + 1, ' ') : NULL;
    if (period == NULL) {
        return false;
    }
    *period = '\0';
    *path = file + 1;
    *period_ms = 0;
    const char *digit = period + 1;
    for (; *digit >= '0' && *digit <= '9'; digit++) {
        *period_ms = *period_ms * 10U + (uint32_t)(*digit - '0');
    }
    *gate = strcmp(digit, " gate") == 0;
    return *period_ms > 0U && (*gate || *digit == '\0');
}

static int fail(int code, const char *subject, const char *what) {
    semihost_print(subject);
    semihost_print(": ");
    semihost_print(what);
    semihost_print("\n");
    return code;
}

int main(void) {
    static char line[256];
    const port_t port = {&board, board_time_ms, board_sample, board_send, board_idle};
    const char *path = NULL;
    uint32_t period_ms = 0;
    bool gate = false;
    if (!semihost_command_line(line, sizeof line) || !arguments(line, &path, &period_ms, &gate)) {
        return fail(2, "arguments", "want the recording and the report period in ms");
    }
    board.file = semihost_open(path);
    if (board.file < 0) {
        return fail(2, path, "cannot be opened");
    }
    board.replay.read = board_read;
    board.replay.context = &board;
    board.error = replay_open(&board.replay);
    if (board.error != NULL) {
        return fail(2, path, board.error);
    }
    if (app_init(&app, &port, period_ms) != SELFCAL_OK) {
        return fail(2, "model", "refused by the library");
    }
    app_power_on(&app, board.replay.powered);
    if (gate && !app_gate(&app)) {
        return fail(2, "model", "has no gate");
    }
    slcan_init(&board.slcan);
    uart_start();
    semihost_print("SELFCAL_UART\n"); /* bytes that come before are lost */

    bool more = true;
    while (more && board.error == NULL) {
        if (!await_channel(&board, true)) {
            return fail(1, "channel", "the host did not open it");
        }
        more = app_step(&app);
    }
    if (board.error != NULL) {
        return fail(2, path, board.error);
    }
    /* Ending the emulator would throw away what the host has not read yet. */
    return await_channel(&board, false) ? 0 : fail(1, "channel", "the host did not close it");
}
