/* The firmware application, the same on every target: samples go through the stationary gate into the bank, reports go
 * out as frames. app.c is its main loop, app_parts.h the map of its files.
 *
 *     app_init(&app, &port, period);
 *     app_gate(&app);
 *     while (app_step(&app)) {
 *     }
 */
#ifndef APP_H
#define APP_H

#include "command.h"
#include "port.h"
#include "selfcal.h"
#include "selfcal_model.h" /* made by `selfcal codegen` */

#if SELFCAL_MODEL_HYPOTHESES > 8
#error "telemetry carries eight hypotheses at most"
#endif
#if !SELFCAL_MODEL_UNITS_SENT
#error "each axis of the model must be one that telemetry has a message for, in its unit (lib/selfcal.dbc)"
#endif

/* Milliseconds between corrected samples on the wire (message CORRECTED). 0: none, and none of their memory, which is a
 * report an axis. */
#ifndef APP_CORRECTED_MS
#define APP_CORRECTED_MS 0
#endif
#if APP_CORRECTED_MS < 0
#error "APP_CORRECTED_MS: milliseconds, 0 for none"
#endif

/* -DAPP_COMMAND_KEY=0x0706050403020100ULL,0x0F0E0D0C0B0A0908ULL, a key of your own, low half first: the image takes
 * commands (command.h). Without a key it looks at nothing that comes by the wire but the opening and closing of an
 * SLCAN channel. */
#ifdef APP_COMMAND_KEY
#define APP_COMMANDS 1
#else
#define APP_COMMANDS 0
#endif

/* Answers that wait for the wire: one of an order, when it has been obeyed, and one of all that is answered at once.
 * Private. */
enum { OF_ORDER, AT_ONCE, ANSWERS };
typedef struct {
    bool waiting;
    uint8_t item;
    uint32_t value;
} answer_t;

/* Private; declared here so that the caller can place it. About 0.2 kB a node, nearly all in `memory`. */
typedef struct {
    const port_t *port;
    const port_module_t *module; /* NULL: none */
    uint32_t period_ms, due_ms;  /* between reports; when the next one is due */
    uint32_t told_ms;            /* the last status */
    uint32_t report_number;
    uint32_t absent_ms; /* time up to which the samples before a restored state's first are in the bank */
    uint32_t refused_ms;
    uint32_t saved_ms; /* when the state was saved last, or the start */
    uint8_t stage;     /* of the report under way: 0 none, 1 status, 2.. the axes, then the end */
    bool worked_out;   /* an axis's report is, and waits for the wire */
    bool fresh;        /* samples came in since the last report was begun */
    bool ended;        /* no sample will follow */
    bool restored;     /* a saved state was, and no sample has come since */
    bool put_off;      /* the last turn left a slice of a report to this one */
    bool waiting;      /* `frame` is made but not taken yet */
    bool refused;      /* the port has refused it, since refused_ms */
    bool finished;     /* no sample will follow, and the last status is on its way */
    bool corrupt;      /* selfcal_check() failed: nothing is sent any more */
#if APP_COMMANDS
    uint8_t ordered;     /* command that is obeyed between reports; 0: none */
    bool restarting;     /* once the answer is out */
    uint32_t argument;   /* of what is ordered */
    uint32_t restart_ms; /* since when */
    command_t command;
    answer_t answer[ANSWERS];
#endif
    selfcal_module_t told;      /* filled in by `module` */
    uint32_t tumble_ms, tumble; /* when the message of the calibration was sent last, and its progress then */
    uint32_t begun_ms;          /* start of the axis report under way */
#if APP_CORRECTED_MS
    uint32_t corrected_ms; /* when a corrected sample was sent last */
    uint32_t reading_ms;   /* of the newest sample */
    selfcal_corrected_t corrected;
    selfcal_kept_t kept;
#endif
    selfcal_frame_t frame;
    selfcal_telemetry_t telemetry;
    selfcal_imu_t imu;
    selfcal_wide_t memory[(SELFCAL_MODEL_IMU_BYTES + sizeof(selfcal_wide_t) - 1U) / sizeof(selfcal_wide_t)];
} app_t;

/* Starts with the model linked in; a report of all axes every `period_ms`. Fails as selfcal_init() and
 * selfcal_telemetry_init() do. `port` must stay. */
selfcal_status_t app_init(app_t *app, const port_t *port, uint32_t period_ms);

/* After app_init(), which makes it SELFCAL_NODE: the module's number on its bus. SELFCAL_BAD_ARGUMENT beyond 11. */
selfcal_status_t app_node(app_t *app, uint8_t node);

/* After app_init(): the sensor was powered on `samples` before the first sample. Default: with it. */
void app_power_on(app_t *app, uint64_t samples);

/* After app_init(): from here on only samples of rest feed the bank. While the module moves time passes as a gap.
 * The gate starts with the model's noise, a bound. After 30 windows of rest it goes on with the measured noise.
 * False: the model has no gate, and every sample counts as one of rest. */
bool app_gate(app_t *app);

/* After app_gate(): restores the newest saved state that is whole and of this model. From here on the application
 * saves, tells of the module in the status, and sends a status even when no sample comes. `module` must stay. */
void app_module(app_t *app, const port_module_t *module);

/* A frame of message COMMAND came. Built in with APP_COMMAND_KEY. */
void app_command(app_t *app, const uint8_t data[8]);

/* False: only a restart helps, and the watchdog must not be fed. The bank's memory was found corrupt, or an axis's
 * report took five minutes, or the port refused a frame for five minutes. */
bool app_healthy(const app_t *app);

/* One turn of the main loop: the samples that wait, one slice of a report, and as many frames as the wire takes.
 * False once the port has said PORT_END, the final report is out and the status says finished. */
bool app_step(app_t *app);

#endif
