/* A recording in the sensor's place, for the targets that replay: the host's and the emulators'.
 *
 * Little-endian: "SELFCAL2", uint32 axes, uint32 channels, float64 rate (Hz), uint64 rows, uint64 samples from power-on
 * to the first row. Then each row: uint32 samples missing just before it, float32 reading of each axis and of each
 * channel. Axes, channels and units are the model's; PORT_SIDE are the last channels. Time is that of the recording:
 * samples passed over the rate. */
#ifndef REPLAY_H
#define REPLAY_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "port.h"
#include "selfcal_model.h"

/* Values of a row, and bytes of the longest one: a regressor takes a channel at most. */
#define REPLAY_VALUES (SELFCAL_MODEL_AXES + SELFCAL_MODEL_CHANNELS + PORT_SIDE)
enum { REPLAY_ROW_BYTES = 4 + 4 * (SELFCAL_AXES_MAX + SELFCAL_REGRESSORS_MAX + PORT_SIDE) };

typedef struct {
    bool (*read)(void *context, void *bytes, size_t count); /* exactly `count` bytes; false: there are not so many */
    void *context;
    double rate_hz;
    uint64_t rows;    /* still to read */
    uint64_t powered; /* samples from power-on to the first row */
    uint64_t passed;  /* samples since the start of the recording, missing ones too: its clock */
    uint32_t time_ms; /* the same, modulo 2^32 */
    bool waiting;     /* `row` is read and due */
    unsigned char row[REPLAY_ROW_BYTES];
} replay_t;

/* Reads the header; NULL, or what is wrong with it. `replay->read` and `context` are set. */
const char *replay_open(replay_t *replay);

/* Goes on by one row, if there is one and the last was taken; NULL, or what is wrong. */
const char *replay_next(replay_t *replay);

/* What port_t wants of a sensor. */
port_sample_t replay_sample(replay_t *replay, float reading[], uint32_t *missing);

#endif
