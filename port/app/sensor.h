/* The board's ADIS16405 as the application's sensor: axes in the model's order. One a program. */
#ifndef SENSOR_H
#define SENSOR_H

#include "adis16405.h"
#include "port.h"
#include "selfcal_model.h"

#if !SELFCAL_MODEL_CHANNELS_READ
#error "the sensor's side channels are temp in degC and supply in V: the regressors of the model take another"
#endif

/* How its SPI is clocked at the model's rate, and what lies between two frames. */
#define SENSOR_SCK_MAX_HZ ADIS16405_SCK_MAX_HZ(SELFCAL_MODEL_RATE_HZ)
#define SENSOR_STALL_US ADIS16405_STALL_US(SELFCAL_MODEL_RATE_HZ)

/* False: the model has an axis or a rate that the sensor has not. */
bool sensor_init(const adis16405_bus_t *bus);

/* From the interrupt handlers, and from the main loop: as adis16405_ready(), _burst(), _poll() and _pause(). */
void sensor_ready(void);
void sensor_burst(const uint16_t words[ADIS16405_BURST_WORDS], bool whole);
void sensor_poll(void);
void sensor_pause(bool on);

/* For port_t and port_module_t. */
port_sample_t sensor_sample(void *context, float reading[], uint32_t *missing);
bool sensor_write_offsets(void *context, const float wanted[], float got[]);
void sensor_tell(selfcal_module_t *told);

#endif
