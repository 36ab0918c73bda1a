/* The firmware application, the same on every target: samples into the bank, reports out as frames.
 *
 *     app_init(&app, &port, period);
 *     while (app_step(&app)) {
 *     }
 */
#ifndef APP_H
#define APP_H

#include "port.h"
#include "selfcal.h"
#include "selfcal_model.h" /* made by `selfcal codegen` */

#if SELFCAL_MODEL_REGRESSORS > 0 || SELFCAL_MODEL_TERM_NODES > 0
#error "this application gives its bank no regressors, and its telemetry has no items for laws that are sums"
#endif

/* Private; declared here so that the caller can place it. About 0.2 kB a node, nearly all of it `memory`. */
typedef struct {
    const port_t *port;
    const port_module_t *module; /* NULL: none */
    uint32_t period_ms, due_ms; /* between reports; when the next one is due */
    uint32_t report_number;
    uint8_t stage;    /* of the report under way: 0 none, 1 status, 2.. the axes, then the end */
    bool computing;   /* an axis's report is being worked out */
    bool fresh;       /* samples came in since the last report was begun */
    bool ended;       /* no sample will follow */
    bool waiting;     /* `frame` is made but not taken yet */
    bool finished;    /* ... and the last status is on its way */
    bool corrupt;     /* selfcal_check() failed: nothing is sent any more */
    uint32_t report_ms; /* when the report under way was begun */
    uint32_t saved_ms;  /* when the state was saved last, or the start */
    selfcal_module_t told; /* filled in by `module` */
    uint32_t begun_ms; /* start of the axis report under way */
    selfcal_frame_t frame;
    selfcal_telemetry_t telemetry;
    selfcal_t bank;
    selfcal_work_t work;
    selfcal_report_t report;
    selfcal_wide_t memory[(SELFCAL_SIZE(SELFCAL_MODEL_NODES, SELFCAL_MODEL_AXES) + sizeof(selfcal_wide_t) - 1U) /
                          sizeof(selfcal_wide_t)];
} app_t;

/* Starts with the model linked in; a report of all axes every `period_ms`. Fails as selfcal_init() and
 * selfcal_telemetry_init() do. `port` must stay. */
selfcal_status_t app_init(app_t *app, const port_t *port, uint32_t period_ms);

/* After app_init(): restores the newest saved state that is whole and of this model, and from here on saves, tells of the module in
 * the status, and sends a status even when no sample comes. `module` must stay. */
void app_module(app_t *app, const port_module_t *module);

/* False once the bank's memory has been found corrupt, or a report has not ended for a minute: then only a restart helps, and the
 * watchdog must not be fed. */
bool app_healthy(const app_t *app);

/* One turn of the main loop: the samples that wait, one slice of a report, and the frames the wire has room for. False once
 * the port has said PORT_END, the final report is out and the status says finished. */
bool app_step(app_t *app);

#endif
