/* The image's sensor, -DSENSOR=name, in the model's order of axes. One a program. */
#ifndef READINGS_H
#define READINGS_H

#include "port.h"
#include "sensor.h"

/* False: the model has an axis or a rate that the sensor has not. */
bool readings_init(void);

/* From the interrupt handlers of data-ready and of a transfer's end, and from the main loop. */
void readings_ready(void);
void readings_done(bool whole);
void readings_poll(void);
void readings_pause(bool on);

/* For port_t and port_module_t. */
port_sample_t readings_sample(void *context, float reading[], uint32_t *missing);
bool readings_write_offsets(void *context, const float wanted[], float got[]);
void readings_tell(selfcal_module_t *told);

#endif
