/* Made by `selfcal codegen` from the model 'default'. Do not edit. */
#ifndef SELFCAL_MODEL_H
#define SELFCAL_MODEL_H

#include "selfcal.h"
#include "tumble.h"

#define SELFCAL_MODEL_ID 0xE5D59D27UL
#define SELFCAL_MODEL_NODES 209U
#define SELFCAL_MODEL_AXES 6U
#define SELFCAL_MODEL_HYPOTHESES 3U
#define SELFCAL_MODEL_REGRESSORS 0U
/* 1: it handles steps of the bias, or changes of the noise (lib/changes.c). */
#define SELFCAL_MODEL_CHANGES 0
/* Channels that the regressors take beside the readings: selfcal_model_channel_name, in these units. */
#define SELFCAL_MODEL_CHANNELS 0U
/* 1: each is one of port/sensors/sensor.h, in its unit; one is the supply. */
#define SELFCAL_MODEL_CHANNELS_READ 1
#define SELFCAL_MODEL_SUPPLY_READ 0
/* With SELFCAL_FIXED no record overflows (lib/bank_kernel_fixed.c). The coarsest step of each axis that readings within
 * its range can lead to, 2^exponent of the unit. Rounding moves a likelihood by 3e-3 nats at 10^5 bank samples where
 * sigma_v is 2^17 of these; by a tenth of that at rest, where a step is 2^-20 sigma_v. */
#define SELFCAL_MODEL_EXPONENTS {-17, -17, -17, -18, -18, -18}
#define SELFCAL_MODEL_TERM_NODES 0U
/* What selfcal_init() wants. */
#define SELFCAL_MODEL_BYTES \
    (SELFCAL_SIZE(SELFCAL_MODEL_NODES, SELFCAL_MODEL_AXES) + \
     SELFCAL_REGRESSORS_SIZE(SELFCAL_MODEL_NODES, SELFCAL_MODEL_AXES, SELFCAL_MODEL_REGRESSORS) + \
     SELFCAL_TERMS_SIZE(SELFCAL_MODEL_TERM_NODES, SELFCAL_MODEL_AXES, SELFCAL_MODEL_REGRESSORS))
/* 1: the model is judged (lib/adequacy.c), and steps and changes of the noise are found where it handles them. */
#ifndef SELFCAL_MODEL_JUDGED
#define SELFCAL_MODEL_JUDGED 1
#endif
/* 1: a report rests on a copy of its axis's sums, so that no sample overtakes it (lib/imu_hold.c). */
#define SELFCAL_MODEL_HELD 0
#define SELFCAL_MODEL_HELD_BYTES \
    (SELFCAL_MODEL_HELD \
         ? SELFCAL_HELD_SIZE(SELFCAL_MODEL_NODES, SELFCAL_MODEL_TERM_NODES, SELFCAL_MODEL_REGRESSORS) \
         : 0U)
/* Calls of selfcal_imu_work() in a bank interval that keep every report ahead of the samples; held, any number does. A
 * program that makes so many with every sample says #if !SELFCAL_MODEL_KEEPS_UP(calls), and #error. */
#define SELFCAL_MODEL_REPORT_STEPS \
    (SELFCAL_MODEL_HELD \
         ? 1U \
         : SELFCAL_REPORT_CALLS(SELFCAL_MODEL_NODES, SELFCAL_MODEL_HYPOTHESES, SELFCAL_MODEL_REGRESSORS))
#define SELFCAL_MODEL_KEEPS_UP(calls_a_sample) ((calls_a_sample) * 819U >= SELFCAL_MODEL_REPORT_STEPS)
/* 1: it calibrates by rests in several positions (lib/tumble.h), for which it needs six axes and the gate. */
#ifndef SELFCAL_MODEL_TUMBLED
#define SELFCAL_MODEL_TUMBLED 0
#endif
/* Where the part rests, m/s^2. */
#ifndef SELFCAL_MODEL_GRAVITY
#define SELFCAL_MODEL_GRAVITY 9.80665F
#endif
#define SELFCAL_MODEL_TUMBLED_BYTES (SELFCAL_MODEL_TUMBLED ? SELFCAL_PART(sizeof(selfcal_imu_tumble_t)) : 0U)
/* What selfcal_imu_init() wants. */
#define SELFCAL_MODEL_IMU_BYTES \
    (SELFCAL_MODEL_BYTES + SELFCAL_MODEL_HELD_BYTES + SELFCAL_MODEL_TUMBLED_BYTES + \
     SELFCAL_PARTS_SIZE(SELFCAL_MODEL_NODES, SELFCAL_MODEL_AXES, SELFCAL_MODEL_GATE, SELFCAL_MODEL_REGRESSORS, \
                        SELFCAL_MODEL_JUDGED, SELFCAL_MODEL_JUDGED && SELFCAL_MODEL_CHANGES))
/* What selfcal_imu_save() writes at most: for a slot of flash. */
#define SELFCAL_MODEL_SNAPSHOT_MAX \
    (SELFCAL_SNAPSHOT_MAX(SELFCAL_MODEL_BYTES) + (SELFCAL_MODEL_TUMBLED ? SELFCAL_TUMBLE_SAVED : 0U))
/* Rate of the samples, Hz. */
#define SELFCAL_MODEL_RATE_HZ 819.2F
/* The same in 1/1000 Hz, for the preprocessor: a program whose samples come at another rate must not compile. */
#define SELFCAL_MODEL_RATE_MILLIHZ 819200UL
/* 1: every axis is one of lib/selfcal.dbc, in the unit that it has there. The library alone takes any. */
#define SELFCAL_MODEL_UNITS_SENT 1
/* 1: selfcal_model_gate is there. */
#define SELFCAL_MODEL_GATE 1

extern const selfcal_model_t selfcal_model;
extern const selfcal_pipe_t selfcal_model_pipe;
extern const char *const selfcal_model_axis_name[SELFCAL_MODEL_AXES];
#if SELFCAL_MODEL_CHANNELS > 0
extern const char *const selfcal_model_channel_name[SELFCAL_MODEL_CHANNELS];
#endif
extern const selfcal_tumbling_t selfcal_model_tumbling;
#if SELFCAL_MODEL_GATE
extern const selfcal_gate_config_t selfcal_model_gate;
#endif

#endif
