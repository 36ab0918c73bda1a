/* In the place of the header that `selfcal codegen` writes: the model that Python hands over, for port/app and
 * port/replay. Its numbers are known at run time, the sizes of memory are those of the package's builds. */
#ifndef SELFCAL_MODEL_H
#define SELFCAL_MODEL_H

#include "selfcal.h"
#include "tumble.h"

typedef struct {
    selfcal_pipe_t pipe;
    const char *const *axis_name;
    uint32_t channels;
} firmware_model_t;

/* That of the module which runs. Whoever calls the application sets it before. */
extern const firmware_model_t *firmware_model;

#define selfcal_model (*firmware_model->pipe.model)
#define selfcal_model_pipe (firmware_model->pipe)
#define selfcal_model_axis_name (firmware_model->axis_name)
#define SELFCAL_MODEL_AXES (selfcal_model.axes)
#define SELFCAL_MODEL_CHANNELS (firmware_model->channels)
#define SELFCAL_MODEL_RATE_HZ (selfcal_model_pipe.rate_hz)

#define SELFCAL_MODEL_HYPOTHESES SELFCAL_HYPOTHESES_MAX
#define SELFCAL_MODEL_TUMBLED 0
#define SELFCAL_MODEL_UNITS_SENT 1 /* firmware.py looks */
#define SELFCAL_MODEL_IMU_BYTES                                                                                        \
    (SELFCAL_SIZE(SELFCAL_NODES_MAX, SELFCAL_AXES_MAX) +                                                               \
     SELFCAL_REGRESSORS_SIZE(SELFCAL_NODES_MAX, SELFCAL_AXES_MAX, SELFCAL_REGRESSORS_MAX) +                            \
     SELFCAL_TERMS_SIZE(SELFCAL_NODES_MAX, SELFCAL_AXES_MAX, SELFCAL_REGRESSORS_MAX) +                                 \
     SELFCAL_PARTS_SIZE(SELFCAL_NODES_MAX, SELFCAL_AXES_MAX, 1, 1, 1, 1))

#endif
