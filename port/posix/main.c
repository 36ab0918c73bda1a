/* The application on a POSIX host: a recording takes the sensor's place, a pseudo-terminal with SLCAN the bus's.
 *
 *     selfcal-posix RECORDING [--report-every S] [--realtime X] [--timeout S]
 *
 * Prints `SELFCAL_PTY path`, waits for the host to open the channel, plays the recording (time stands still while the
 * channel is closed), and ends when the host closes the channel after the last frame. Exit code: 0; 1 if the host went
 * away or never came; 2 for bad arguments or a bad recording.
 *
 * RECORDING, little-endian: "SELFCAL1", uint32 axes, uint32 0, float64 rate (Hz), uint64 rows; then each row: uint32
 * samples missing just before it, float32 reading of each axis. Axes and units are those of the model built in. */
#define _POSIX_C_SOURCE 200112L

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "app.h"
#include "pty.h"

enum { HEADER_BYTES = 32, ROW_BYTES = 4 + 4 * SELFCAL_MODEL_AXES, ROWS_BETWEEN_POLLS = 1024 };

typedef struct {
    FILE *file;
    double rate_hz;
    uint64_t rows;    /* still to read */
    uint64_t passed;  /* samples since the start of the recording, missing ones too: its clock */
    bool waiting;     /* `row` is read and due */
    unsigned char row[ROW_BYTES];
    double speed;     /* times real time; 0: as fast as it goes */
    struct timespec start; /* when the channel was opened, and what had passed then */
    uint64_t passed_at_start;
    uint32_t unpolled;
    const char *error;
    pty_t pty;
} host_t;

static uint32_t little32(const unsigned char *bytes)
{
    return (uint32_t)bytes[0] | (uint32_t)bytes[1] << 8 | (uint32_t)bytes[2] << 16 | (uint32_t)bytes[3] << 24;
}

static uint64_t little64(const unsigned char *bytes)
{
    return little32(bytes) | (uint64_t)little32(bytes + 4) << 32;
}

static uint32_t host_time_ms(void *context)
{
    const host_t *host = context;
    return (uint32_t)(uint64_t)((double)host->passed * 1000.0 / host->rate_hz);
}

static port_sample_t host_sample(void *context, float reading[], uint32_t *missing)
{
    host_t *host = context;
    if (!host->waiting) {
        return host->rows == 0 ? PORT_END : PORT_EMPTY;
    }
    host->waiting = false;
    *missing = little32(host->row);
    for (size_t axis = 0; axis < SELFCAL_MODEL_AXES; axis++) {
        const uint32_t bits = little32(host->row + 4 + 4 * axis);
        memcpy(&reading[axis], &bits, sizeof bits);
    }
    return PORT_SAMPLE;
}

static bool host_send(void *context, const selfcal_frame_t *frame)
{
    host_t *host = context;
    pty_send(&host->pty, frame);
    return true;
}

/* Milliseconds until the recording's clock is due on the wall. */
static int wall_wait_ms(const host_t *host)
{
    struct timespec now;
    (void)clock_gettime(CLOCK_MONOTONIC, &now);
    const double wall = (double)(now.tv_sec - host->start.tv_sec) + 1e-9 * (double)(now.tv_nsec - host->start.tv_nsec);
    const double wait = (double)(host->passed - host->passed_at_start) / host->rate_hz / host->speed - wall;
    return wait > 0.0 ? (int)ceil(fmin(wait, 1.0) * 1000.0) : 0;
}

/* The application has nothing to do: time goes on by one row. */
static void host_idle(void *context)
{
    host_t *host = context;
    if (host->pty.pending > 0 || ++host->unpolled >= ROWS_BETWEEN_POLLS) {
        host->unpolled = 0;
        pty_flush(&host->pty);
        (void)pty_receive(&host->pty, 0);
    }
    if (!host->pty.slcan.open || host->rows == 0) {
        return;
    }
    if (fread(host->row, ROW_BYTES, 1, host->file) != 1) {
        host->error = "the recording is shorter than it says";
        return;
    }
    host->rows--;
    host->passed += (uint64_t)little32(host->row) + 1U;
    host->waiting = true;
    if (host->speed > 0.0) {
        for (int wait = wall_wait_ms(host); wait > 0 && host->pty.error == NULL; wait = wall_wait_ms(host)) {
            (void)pty_receive(&host->pty, wait);
        }
    }
}

static const char *open_recording(host_t *host, const char *path)
{
    unsigned char header[HEADER_BYTES];
    host->file = fopen(path, "rb");
    if (host->file == NULL) {
        return strerror(errno);
    }
    if (fread(header, sizeof header, 1, host->file) != 1 || memcmp(header, "SELFCAL1", 8) != 0) {
        return "not a recording for this program";
    }
    if (little32(header + 8) != SELFCAL_MODEL_AXES) {
        return "its axes are not those of the model built in";
    }
    const uint64_t rate = little64(header + 16);
    memcpy(&host->rate_hz, &rate, sizeof rate);
    if (!(host->rate_hz > 0.0) ||
        fabs((double)selfcal_model.dt_s * host->rate_hz / (double)selfcal_model.block - 1.0) > 1e-5) {
        return "its rate is not that of the model built in";
    }
    host->rows = little64(header + 24);
    return NULL;
}

/* Waits until the channel is open, or closed; false if the host went away or let the timeout pass. */
static bool await_channel(host_t *host, bool open)
{
    while (host->pty.error == NULL && host->pty.slcan.open != open) {
        if (!pty_receive(&host->pty, host->pty.timeout_ms)) {
            host->pty.error = open ? "the host did not open the channel" : "the host did not close the channel";
        } else if (host->pty.slcan.open) {
            (void)clock_gettime(CLOCK_MONOTONIC, &host->start);
            host->passed_at_start = host->passed;
        }
    }
    return host->pty.error == NULL;
}

static bool positive(const char *text, double *value)
{
    char *end;
    *value = strtod(text, &end);
    return end != text && *end == '\0' && *value > 0.0 && *value < 1e6;
}

static int fail(int code, const char *subject, const char *what)
{
    (void)fprintf(stderr, "selfcal-posix: %s: %s\n", subject, what);
    return code;
}

int main(int argc, char **argv)
{
    static host_t host;
    static app_t app;
    const port_t port = {&host, host_time_ms, host_sample, host_send, host_idle};
    const char *path = NULL;
    double report_every_s = 10.0, timeout_s = 30.0;

    for (int i = 1; i < argc; i++) {
        double *option = strcmp(argv[i], "--report-every") == 0 ? &report_every_s
                         : strcmp(argv[i], "--realtime") == 0   ? &host.speed
                         : strcmp(argv[i], "--timeout") == 0    ? &timeout_s
                                                                : NULL;
        if (option != NULL) {
            if (i + 1 == argc || !positive(argv[i + 1], option)) {
                return fail(2, argv[i], "wants a positive number");
            }
            i++;
        } else if (path == NULL && argv[i][0] != '-') {
            path = argv[i];
        } else {
            return fail(2, argv[i], "unknown argument");
        }
    }
    if (path == NULL) {
        return fail(2, "RECORDING", "is missing");
    }
    const char *error = open_recording(&host, path);
    if (error != NULL) {
        return fail(2, path, error);
    }
    if (app_init(&app, &port, (uint32_t)ceil(report_every_s * 1000.0)) != SELFCAL_OK) {
        return fail(2, "model", "refused by the library");
    }

    const int timeout_ms = (int)(timeout_s * 1000.0);
    const char *device = pty_open(&host.pty, timeout_ms);
    if (device == NULL) {
        return fail(1, "pseudo-terminal", strerror(errno));
    }
    (void)printf("SELFCAL_PTY %s\n", device);
    (void)fflush(stdout);

    bool more = true;
    while (more && host.error == NULL && await_channel(&host, true)) {
        more = app_step(&app);
    }
    if (host.error != NULL) {
        return fail(2, path, host.error);
    }
    if (host.pty.error != NULL) {
        return fail(1, device, host.pty.error);
    }
    /* Closing the pseudo-terminal would throw away what the host has not read yet. */
    pty_flush(&host.pty);
    return await_channel(&host, false) || host.pty.hung_up ? 0 : fail(1, device, host.pty.error);
}
