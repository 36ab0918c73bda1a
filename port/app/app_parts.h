/* The parts of the application, for one another: each file app_*.c has one job, and calls those above it here. */
#ifndef APP_PARTS_H
#define APP_PARTS_H

#include "app.h"

#include "selfcal_frames.h"

static inline uint32_t app_now(const app_t *app) {
    return app->port->time_ms(app->port->context);
}

/* app_frames.c: frames out */

/* Sends as many as the wire has room for; false: none. */
bool app_send_frames(app_t *app);

/* Fills in the status of the module. */
void app_tell(app_t *app);

/* Sends it. */
void app_tell_status(app_t *app, uint32_t now);

/* A status does not wait, neither for a report that is far off nor for the end of one. */
bool app_status_due(const app_t *app, uint32_t now);

/* Whether a calibration by rests in several positions is under way. */
bool app_tumbles(app_t *app);

/* Begins its message if there is news, or with each status; false: no. Only with all frames out. */
bool app_begin_tumble(app_t *app, uint32_t now);

/* app_state.c: saved state */

void app_restore(app_t *app);

/* Samples from the start, or the last call, to now. */
uint32_t app_absent(app_t *app);

/* Between reports, because the bank must stand still. */
void app_save(app_t *app, uint32_t now);

/* app_commands.c; without commands nothing is ordered and nothing answered */

#if APP_COMMANDS
/* Does what was ordered; true: the module restarts, and nothing else is to be done. Between reports: the bank stands
 * still. */
bool app_obey(app_t *app, uint32_t now);

/* Begins an answer, or restarts the module once its answer has left; false: neither. Only with all frames out. */
bool app_begin_answer(app_t *app, uint32_t now);
#else
static inline bool app_obey(app_t *app, uint32_t now) {
    (void)app;
    (void)now;
    return false;
}

static inline bool app_begin_answer(app_t *app, uint32_t now) {
    (void)app;
    (void)now;
    return false;
}
#endif

/* app_reports.c: one axis after the other, in slices */

/* The stage of the report under way: none, its status, the axes, the end. */
enum { STAGE_NONE = 0, STAGE_STATUS = 1, STAGE_AXES = 2 };
#define STAGE_END (STAGE_AXES + SELFCAL_MODEL_AXES)

/* One slice of the axis's report. */
void app_compute(app_t *app);

/* Begins the frames that do not wait for a report's end: the report worked out, an answer, a status.
 * Only with all frames out. */
bool app_begin_frames(app_t *app);

/* Begins a report when one is due, and goes from its status over the axes to its end. Only with all frames out. */
bool app_advance(app_t *app);

#endif
