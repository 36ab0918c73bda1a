/* ICM-42688-P over SPI: six axes in 20 bits from its FIFO, with temperature and timestamps.
 * Data sheet DS-000347. Limits of the self-test, and that a timestamp's unit is its PLL's: the maker's own driver.
 *
 * The sensor gathers packets of 20 bytes, 102 at most. The main loop reads them, so no interrupt is needed. A loop that
 * comes back within 100 ms loses nothing at 1 kHz. Packets follow each other: a timestamp that is not one period after
 * the last betrays a damaged packet. After an overflow, timestamps and the processor's clock count the missing samples.
 * A packet has no checksum, and the FIFO gives it once: a wrong bit in a reading passes. A wrong bit in a header, a
 * timestamp or an unused bit costs its packet.
 * In 20 bits the ranges are 2000 deg/s and 16 g: 1/131.072 deg/s and 1/8192 g a step. */
#ifndef ICM42688_H
#define ICM42688_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum { ICM42688_AXES = 6, ICM42688_PACKET = 20, ICM42688_CHUNK = 8 }; /* gx gy gz ax ay az; packets read at once */
#define ICM42688_SCK_MAX_HZ 24000000U

typedef struct {
    void *context;
    uint64_t (*time_us)(void *context); /* since start */
    /* `count` bytes each way with chip select low around them, SPI mode 0 or 3. Bounded; false: it did not happen. */
    bool (*transfer)(void *context, const uint8_t *out, uint8_t *in, size_t count);
} icm42688_bus_t;

typedef enum {
    ICM42688_STARTING, /* reset, identification, self-test, set-up: 0.6 s */
    ICM42688_RUNNING,
    ICM42688_FAILED    /* waiting for the next try */
} icm42688_state_t;

typedef enum {
    ICM42688_NO_FAULT = 0,
    ICM42688_ABSENT = 1,    /* WHO_AM_I is not 0x47 */
    ICM42688_SET_UP = 2,    /* a register did not read back, or has changed since */
    ICM42688_SELF_TEST = 3, /* an axis failed it, or it gave no samples */
    ICM42688_SILENT = 4,    /* the FIFO stays empty */
    ICM42688_NO_DATA = 5,   /* packets, but none that passes the checks */
    ICM42688_STUCK = 6      /* all six axes stand still */
} icm42688_fault_t;

/* Since start. */
typedef struct {
    uint32_t samples;  /* delivered */
    uint32_t stale;    /* packets with the timestamp of the one before */
    uint32_t repeated; /* all axes as before, once too often */
    uint32_t damaged;  /* header, unused bits or timestamp wrong */
    uint32_t overruns; /* times the FIFO was found full */
    uint32_t faults;   /* times the fault state was entered */
} icm42688_counters_t;

/* Private; declared here so that the caller can place it. */
typedef struct {
    const icm42688_bus_t *bus;
    uint64_t step_us;              /* when the step of the start was entered, or the fault state */
    uint64_t progress_us;          /* when a sample was delivered last, or the run began */
    uint64_t checked_us;           /* when the settings were read last */
    uint64_t last_us;              /* of the last sample */
    uint64_t read_us;              /* of the chunk */
    icm42688_state_t state;
    icm42688_fault_t fault;        /* the last one */
    uint32_t period_us;            /* nominal */
    uint32_t ticks_q16;            /* of a period, in timestamps / 65536 */
    uint32_t backoff_us;
    uint32_t packets_seen;         /* since progress_us */
    uint32_t dropped;              /* packets since the last sample, none of them good */
    uint32_t equal, good;
    float level[ICM42688_AXES];    /* readings before the self-test */
    int32_t last[ICM42688_AXES];
    icm42688_counters_t counters;
    int16_t added[ICM42688_AXES];  /* offset registers */
    int16_t temperature;           /* INT16_MIN: none yet */
    uint16_t last_stamp;
    bool anchored;                 /* `last_us` is of a sample */
    bool continuous;               /* the next packet follows the last */
    bool blind;                    /* `last_stamp` is of before a reset */
    uint8_t rate;                  /* ODR code */
    uint8_t step;
    uint8_t codes[ICM42688_AXES];  /* factory's responses to a self-test */
    uint8_t mismatches;            /* packets in a row out of place */
    uint8_t next, held, behind;    /* packets of the chunk: the next one, all; in the FIFO after them */
    uint8_t chunk[1 + ICM42688_CHUNK * ICM42688_PACKET];
} icm42688_t;

/* Begins to start the sensor. False: it has not this rate. It has 25, 50, 100, 200, 500 and 1000 Hz. */
bool icm42688_init(icm42688_t *self, const icm42688_bus_t *bus, float rate_hz);

/* From the main loop, every few ms: goes on with the start, watches, tries again. */
void icm42688_poll(icm42688_t *self);

/* Has the sensor add `wanted` (deg/s, m/s^2) to its readings. `got`: the nearest steps, 1/32 deg/s and 0.5 mg. Each
 * register is read back, and written anew whenever the sensor is started. Samples that wait are dropped: missing in
 * time. False: beyond the registers (64 deg/s, 1 g), or not written; the sensor then adds the same as before. */
bool icm42688_offsets(icm42688_t *self, const float wanted[ICM42688_AXES], float got[ICM42688_AXES]);

/* The oldest waiting sample, deg/s and m/s^2, and the samples missing before it; false: none is waiting. */
bool icm42688_sample(icm42688_t *self, float reading[ICM42688_AXES], uint32_t *missing);

/* Of the newest sample, degC. NaN before the first. */
float icm42688_temperature(const icm42688_t *self);

#endif
