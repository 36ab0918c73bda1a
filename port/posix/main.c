/* The application on a POSIX host: a recording takes the sensor's place; telemetry leaves by a pseudo-terminal with
 * SLCAN, or by a CAN bus of the host.
 *
 *     selfcal-posix RECORDING [--report-every S] [--realtime X] [--timeout S] [--gate] [--node N]
 *                   [--stay | --can BUS] [--leash]
 *
 * Prints `SELFCAL_PTY path`, waits for the host to open the channel, plays the recording (time stands still while the
 * channel is closed), and ends when the host closes the channel after the last frame. With --stay a host that goes away
 * has closed the channel, and another may open it.
 * With --can it prints `SELFCAL_CAN bus`, plays the recording whether anybody listens or not, and ends after the last
 * frame (port/posix/can.h).
 * With --gate motion is kept out, by the model's gate.
 * With --leash the program ends when its standard input does: when its parent has died, however that came.
 * --node is the module's number on its bus, 0 to 11. It moves all identifiers.
 * Exit code: 0; 1 if the host went away or never came, or the bus failed; 2 for bad arguments or a bad recording.
 *
 * RECORDING: see port/replay/replay.h.
 */
#define _POSIX_C_SOURCE 200112L

#include <errno.h>
#include <math.h>
#include <poll.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "app.h"
#include "can.h"
#include "pty.h"
#include "replay.h"

enum { ROWS_BETWEEN_POLLS = 1024 };

typedef struct {
    FILE *file;
    replay_t replay;
    double speed;          /* times real time; 0: as fast as it goes */
    struct timespec start; /* when the channel was opened, and what had passed then */
    uint64_t passed_at_start;
    uint32_t unpolled;
    const char *error; /* of the recording */
    pty_t pty;
    bool on_can; /* the bus in place of the pseudo-terminal */
    can_t can;
} host_t;

static bool host_read(void *context, void *bytes, size_t count) {
    const host_t *host = context;
    return fread(bytes, count, 1, host->file) == 1;
}

static uint32_t host_time_ms(void *context) {
    const host_t *host = context;
    return host->replay.time_ms;
}

static port_sample_t host_sample(void *context, float reading[], uint32_t *missing) {
    host_t *host = context;
    return replay_sample(&host->replay, reading, missing);
}

static bool host_send(void *context, const selfcal_frame_t *frame) {
    host_t *host = context;
    if (host->on_can) {
        can_send(&host->can, frame);
    } else {
        pty_send(&host->pty, frame);
    }
    return true;
}

/* Milliseconds until the recording's clock is due on the wall. */
static int wall_wait_ms(const host_t *host) {
    struct timespec now;
    (void)clock_gettime(CLOCK_MONOTONIC, &now);
    const double wall = (double)(now.tv_sec - host->start.tv_sec) + 1e-9 * (double)(now.tv_nsec - host->start.tv_nsec);
    const double passed = (double)(host->replay.passed - host->passed_at_start) / host->replay.rate_hz;
    const double wait = passed / host->speed - wall;
    return wait > 0.0 ? (int)ceil(fmin(wait, 1.0) * 1000.0) : 0;
}

/* Why the wire is of no more use; NULL while it works. */
static const char *wire_error(const host_t *host) {
    return host->on_can ? host->can.error : host->pty.error;
}

/* Waits, on a pseudo-terminal for commands. */
static void wait_on_wire(host_t *host, int wait_ms) {
    if (host->on_can) {
        (void)poll(NULL, 0, wait_ms);
    } else {
        (void)pty_receive(&host->pty, wait_ms);
    }
}

/* The application has nothing to do: time goes on by one row. */
static void host_idle(void *context) {
    host_t *host = context;
    if (!host->on_can && (host->pty.pending > 0 || ++host->unpolled >= ROWS_BETWEEN_POLLS)) {
        host->unpolled = 0;
        pty_flush(&host->pty);
        (void)pty_receive(&host->pty, 0);
    }
    if ((!host->on_can && !host->pty.slcan.open) || host->replay.rows == 0) {
        return;
    }
    host->error = replay_next(&host->replay);
    if (host->speed > 0.0) {
        for (int wait = wall_wait_ms(host); wait > 0 && wire_error(host) == NULL; wait = wall_wait_ms(host)) {
            wait_on_wire(host, wait);
        }
    }
}

static const char *open_recording(host_t *host, const char *path) {
    host->file = fopen(path, "rb");
    if (host->file == NULL) {
        return strerror(errno);
    }
    host->replay.read = host_read;
    host->replay.context = host;
    return replay_open(&host->replay);
}

static void start_clock(host_t *host) {
    (void)clock_gettime(CLOCK_MONOTONIC, &host->start);
    host->passed_at_start = host->replay.passed;
}

/* Waits until the channel is open, or closed; false if the host went away or let the timeout pass. */
static bool await_channel(host_t *host, bool open) {
    while (host->pty.error == NULL && host->pty.slcan.open != open) {
        if (!pty_receive(&host->pty, host->pty.timeout_ms)) {
            host->pty.error = open ? "the host did not open the channel" : "the host did not close the channel";
        } else if (host->pty.slcan.open) {
            start_clock(host);
        }
    }
    return host->pty.error == NULL;
}

static bool positive(const char *text, double *value) {
    char *end;
    *value = strtod(text, &end);
    return end != text && *end == '\0' && *value > 0.0 && *value < 1e6;
}

static bool node_number(const char *text, long *node) {
    char *end;
    *node = strtol(text, &end, 10);
    return end != text && *end == '\0' && *node >= 0 && *node < (long)SELFCAL_FRAME_NODES;
}

static int fail(int code, const char *subject, const char *what) {
    (void)fprintf(stderr, "selfcal-posix: %s: %s\n", subject, what);
    return code;
}

typedef struct {
    const char *path, *bus; /* the recording; the CAN device, NULL: a pseudo-terminal */
    double report_every_s, timeout_s;
    double speed; /* times as fast as the recording's time; 0: as fast as it goes */
    long node;
    bool gate, stay, leash;
} options_t;

/* 0, or the exit code after a complaint. */
static int parse(options_t *options, int argc, char **argv) {
    for (int i = 1; i < argc; i++) {
        double *number = strcmp(argv[i], "--report-every") == 0 ? &options->report_every_s
                         : strcmp(argv[i], "--realtime") == 0   ? &options->speed
                         : strcmp(argv[i], "--timeout") == 0    ? &options->timeout_s
                                                                : NULL;
        if (number != NULL) {
            if (i + 1 == argc || !positive(argv[i + 1], number)) {
                return fail(2, argv[i], "wants a positive number");
            }
            i++;
        } else if (strcmp(argv[i], "--gate") == 0) {
            options->gate = true;
        } else if (strcmp(argv[i], "--node") == 0) {
            if (i + 1 == argc || !node_number(argv[i + 1], &options->node)) {
                return fail(2, argv[i], "wants a number from 0 to 11");
            }
            i++;
        } else if (strcmp(argv[i], "--stay") == 0) {
            options->stay = true;
        } else if (strcmp(argv[i], "--leash") == 0) {
            options->leash = true;
        } else if (strcmp(argv[i], "--can") == 0 && i + 1 < argc) {
            options->bus = argv[++i];
        } else if (options->path == NULL && argv[i][0] != '-') {
            options->path = argv[i];
        } else {
            return fail(2, argv[i], "unknown argument");
        }
    }
    return options->path == NULL ? fail(2, "RECORDING", "is missing") : 0;
}

/* Waits for the end of the standard input, whatever the program waits for meanwhile. */
static void *hold_leash(void *unused) {
    char byte;
    ssize_t got = 0;
    do {
        got = read(STDIN_FILENO, &byte, 1);
    } while (got > 0 || (got < 0 && errno == EINTR));
    _exit(1);
    return unused;
}

static int run_on_can(host_t *host, app_t *app, const options_t *options) {
    bool more = true;
    host->on_can = true;
    const char *error = can_open(&host->can, options->bus, (int)(options->timeout_s * 1000.0));
    if (error != NULL) {
        return fail(1, options->bus, error);
    }
    (void)printf("SELFCAL_CAN %s\n", options->bus);
    (void)fflush(stdout);
    start_clock(host);
    while (more && host->error == NULL && host->can.error == NULL) {
        more = app_step(app);
    }
    if (host->error != NULL) {
        return fail(2, options->path, host->error);
    }
    return host->can.error != NULL ? fail(1, options->bus, host->can.error) : 0;
}

static int run_on_pty(host_t *host, app_t *app, const options_t *options) {
    bool more = true;
    const char *device = pty_open(&host->pty, (int)(options->timeout_s * 1000.0), options->stay);
    if (device == NULL) {
        return fail(1, "pseudo-terminal", strerror(errno));
    }
    (void)printf("SELFCAL_PTY %s\n", device);
    (void)fflush(stdout);
    while (more && host->error == NULL && await_channel(host, true)) {
        more = app_step(app);
    }
    if (host->error != NULL) {
        return fail(2, options->path, host->error);
    }
    if (host->pty.error != NULL) {
        return fail(1, device, host->pty.error);
    }
    /* Closing the pseudo-terminal would throw away the bytes that the host has not read yet. */
    pty_flush(&host->pty);
    return await_channel(host, false) || host->pty.hung_up ? 0 : fail(1, device, host->pty.error);
}

int main(int argc, char **argv) {
    static host_t host;
    static app_t app;
    const port_t port = {&host, host_time_ms, host_sample, host_send, host_idle};
    options_t options = {.report_every_s = 10.0, .timeout_s = 30.0, .node = SELFCAL_NODE};
    const int refused = parse(&options, argc, argv);
    if (refused != 0) {
        return refused;
    }
    pthread_t thread;
    if (options.leash && pthread_create(&thread, NULL, hold_leash, NULL) != 0) {
        return fail(1, "--leash", "no thread for it");
    }
    host.speed = options.speed;
    const char *error = open_recording(&host, options.path);
    if (error != NULL) {
        return fail(2, options.path, error);
    }
    if (app_init(&app, &port, (uint32_t)ceil(options.report_every_s * 1000.0)) != SELFCAL_OK ||
        app_node(&app, (uint8_t)options.node) != SELFCAL_OK) {
        return fail(2, "model", "refused by the library");
    }
    app_power_on(&app, host.replay.powered);
    if (options.gate && !app_gate(&app)) {
        return fail(2, "model", "has no gate");
    }
    return options.bus != NULL ? run_on_can(&host, &app, &options) : run_on_pty(&host, &app, &options);
}
