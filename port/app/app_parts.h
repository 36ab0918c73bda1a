/* The parts of the application, for one another: each file app_*.c has one job. */
#ifndef APP_PARTS_H
#define APP_PARTS_H

#include "app.h"

#include "selfcal_frames.h"

static inline uint32_t app_now(const app_t *app)
{
    return app->port->time_ms(app->port->context);
}

/* app_samples.c: from the port through the gate into the bank */

/* Takes the oldest waiting sample; false: there is none. */
bool app_take_sample(app_t *app);

/* `count` samples are missing. */
void app_pass(app_t *app, uint32_t count);

/* Samples from the start, or the last call, to now. */
uint32_t app_absent(app_t *app);

/* The regressors' values go on from the samples that the bank has seen, and the judgement of the model begins. */
void app_begin_columns(app_t *app);

/* app_state.c: saved state */

void app_restore(app_t *app);

/* Between reports, because the bank must stand still. */
void app_save(app_t *app, uint32_t now);

/* app_reports.c: one axis after the other, in slices */

/* The stage of the report under way: none, its status, the axes, the end. */
enum { STAGE_NONE = 0, STAGE_STATUS = 1, STAGE_AXES = 2, STAGE_END = STAGE_AXES + SELFCAL_MODEL_AXES };

/* One slice of the axis's report. */
bool app_compute(app_t *app);

/* Begins a report when one is due, and goes from its status over the axes to its end. Only with all frames out. */
bool app_advance(app_t *app);

/* app_frames.c: frames out */

/* Sends as many as the wire has room for; false: none. */
bool app_send_frames(app_t *app);

/* Begins the frames that do not wait for a report's end: the report worked out, an answer, a status.
 * Only with all frames out. */
bool app_begin_frames(app_t *app);

/* Fills in the status of the module. */
void app_tell(app_t *app);

/* Sends it. */
void app_tell_status(app_t *app, uint32_t now);

/* A status does not wait, neither for a report that is far off nor for the end of one. */
bool app_status_due(const app_t *app, uint32_t now);

/* The gate's word, as the status has it. */
uint32_t app_motion(const app_t *app);

/* Why an axis has no calibration to rely on. */
selfcal_reason_t app_reason(const app_t *app, uint8_t axis);

#if APP_CORRECTED_MS
/* app_corrected.c: samples less the bias */

/* Keeps a sample. */
void app_keep_sample(app_t *app, const float reading[], uint32_t missing);

/* Keeps the report that was worked out. */
void app_keep_report(app_t *app);

/* A corrected sample, if one is due, of a sample that none was sent of. After all else: on a wire too slow for
 * corrected samples one would always be due. */
bool app_begin_corrected(app_t *app);
#endif

#if APP_COMMANDS
/* app_commands.c */

void app_begin_commands(app_t *app);

/* Does what was ordered. Between reports: the bank stands still. */
void app_obey(app_t *app, uint32_t now);

/* Begins an answer, or restarts the module once its answer has left; false: neither. Only with all frames out. */
bool app_begin_answer(app_t *app, uint32_t now);
#endif

#endif
