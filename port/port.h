/* A target gives the application one const struct of callbacks with their context. None of them may block for longer
 * than the sensor's queue lasts. */
#ifndef PORT_H
#define PORT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "selfcal.h"

/* Place of an axis among gx gy gz ax ay az: the order of the sensor's channels, and of the bits in commands and
 * telemetry. PORT_AXES: it is none of them. */
enum { PORT_AXES = 6 };

/* Beside the readings and the channels of the model every sample has these: the sensor's temperature, degC, and its
 * supply, V. NaN: not known. */
enum { PORT_TEMPERATURE = 0, PORT_SUPPLY = 1, PORT_SIDE = 2 };
unsigned port_axis(const char *name);

typedef enum {
    PORT_SAMPLE, /* one was taken from the queue */
    PORT_EMPTY,  /* none is waiting */
    PORT_END     /* none will follow: the end of a recording */
} port_sample_t;

typedef struct {
    void *context;

    /* Time since start, ms, modulo 2^32. */
    uint32_t (*time_ms)(void *context);

    /* Takes the oldest waiting sample: one reading per axis in the model's order and units, then one per channel of the
     * model (selfcal_model_channel_name), then PORT_SIDE. `missing`: how many samples are missing just before it. The
     * port queues samples while a report is worked out. */
    port_sample_t (*sample)(void *context, float reading[], uint32_t *missing);

    /* Takes a frame for the wire, in order. False: no room, the same frame is offered again later. With nobody
     * listening the port takes frames and drops them. */
    bool (*send)(void *context, const selfcal_frame_t *frame);

    /* Nothing to do until the next sample or until the wire has room: sleep. */
    void (*idle)(void *context);
} port_t;

/* A module has these beside; a program on a host does without. The memory for saved state is two slots in turn, so the
 * state before the newest is still there. */
typedef struct {
    void *context;

    /* Fills in reset, clock, sensor and wire. */
    void (*tell)(void *context, selfcal_module_t *module);

    /* The newest saved state that is whole, or the one before it; NULL: there is none. */
    const void *(*stored)(void *context, bool older, size_t *length);

    /* A save: begin, put until all is put, end. End comes also after a failure; the state is not `whole` then.
     * False: the save has failed, and the state saved before stands: the newest, or with `keep_older` the one before
     * it. May block for 2 s; the sensor's driver counts the samples lost meanwhile. */
    bool (*save_begin)(void *context, bool keep_older);
    bool (*save_put)(void *context, const void *bytes, size_t count);
    bool (*save_end)(void *context, bool whole);

    /* Has the sensor add `wanted` to each axis of the model, as nearly as it can, and reads back into `got` what it
     * adds. Kept through a restart of the sensor. Older samples are given no more.
     * False: it cannot, and adds the same as before. */
    bool (*write_offsets)(void *context, const float wanted[], float got[]);

    /* For commands, else NULL: a random number, false if there is none; true once all frames that were sent have left;
     * a restart. */
    bool (*random)(void *context, uint32_t *number);
    bool (*sent)(void *context);
    void (*restart)(void *context);

    uint32_t save_period_ms; /* between saves, at least: bounds the wear */
    uint64_t save_gap;       /* samples taken as missing after a restore: the age of a saved state is not known */
} port_module_t;

#endif
