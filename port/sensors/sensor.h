/* A sensor is a const struct: its lattice, its steps of a start, and functions that read and watch it. sensor.c drives
 * any of them: starts it, watches it, tries again. A sensor knows no board and no model, a board knows no sensor.
 *
 * STARTS  A start runs the steps of the struct, one a call of sensor_poll(): reset, identification, set-up, self-test.
 * TROUBLE  that does not pass (absent, silent, stuck, failed self-test, bad status) ends in a fault state. A new start
 *   follows, at first after 0.1 s, then with doubled delays up to 10 s.
 * REPEATS  All six axes as before: by chance once in 10^4 samples or less. The third in a row and later ones are
 *   withheld, the sixteenth is a fault.
 * How to write one: port/README.md, "Another sensor". */
#ifndef SENSOR_H
#define SENSOR_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum { SENSOR_AXES = 6 }; /* gx gy gz ax ay az */
/* Side channels: the sensor's temperature, degC, and supply, V. NaN: not known. */
enum { SENSOR_TEMPERATURE, SENSOR_SUPPLY, SENSOR_SIDE };
/* The two kinds of axes: a value of each in the tables below. */
enum { SENSOR_GYRO, SENSOR_ACCEL, SENSOR_KINDS };

#define SENSOR_G 9.80665F

/* How the sensor wants its SPI; of I2C, which goes at up to 400 kHz, nothing. */
typedef struct {
    uint32_t sck_max_hz;
    uint32_t stall_us; /* between two transfers, at least */
    uint8_t mode;      /* 0 to 3 */
} sensor_wire_t;

/* A board's clock, and its SPI (`spi_bus`) or I2C (`i2c_bus`), which lacks the functions of the other. */
typedef struct {
    /* Time since start, us: from the main loop, and modulo 2^32 from anywhere. */
    uint64_t (*time_us)(void);
    uint32_t (*time_us32)(void);
    /* Sets up pins and clock. Interrupts may come from here on. */
    void (*open)(const sensor_wire_t *wire);
    /* `count` bytes each way with chip select low around them, then the stall. Bounded; false: it did not happen. */
    bool (*exchange)(const uint8_t *out, uint8_t *in, size_t count);
    /* Begins an exchange, and breaks off one under way. Its end is an interrupt: the sensor's done(). `out` and `in`
     * must stay until then. */
    bool (*begin)(const uint8_t *out, uint8_t *in, size_t count);
    /* The sensor's reset line; not needed where it is not wired. */
    void (*reset_line)(bool low);
    /* SPI: the exchanges from now on go to this chip, 0 or 1. The second one's chip select is the reset line. */
    void (*choose)(uint8_t chip);
    /* I2C: writes, then reads after a repeated start, either of which may be of 0 bytes. Bounded. False: nobody
     * answers, a byte was not taken, or somebody holds a line; some of it may have happened. */
    bool (*transfer)(uint8_t address, const uint8_t *out, size_t written, uint8_t *in, size_t wanted);
} sensor_bus_t;

/* A board has both. An image has the one that its sensor's header names. */
extern const sensor_bus_t spi_bus, i2c_bus;

/* The numbers of state and fault are those of selfcal.dbc. */
typedef enum {
    SENSOR_OFF = 0,
    SENSOR_STARTING = 1,
    SENSOR_RUNNING = 2,
    SENSOR_FAILED = 3 /* waiting for the next start */
} sensor_condition_t;

typedef enum {
    SENSOR_NO_FAULT = 0,
    SENSOR_ABSENT = 1,    /* no answer with the right product id */
    SENSOR_SET_UP = 2,    /* a register did not read back, or has changed since; or no reset came about */
    SENSOR_SELF_TEST = 3, /* an axis failed it, or it did not end */
    SENSOR_SILENT = 4,    /* no data */
    SENSOR_NO_DATA = 5,   /* data, but no sample that passes the checks */
    SENSOR_STUCK = 6,     /* all six axes stand still */
    SENSOR_STATUS = 7,    /* its own status word: supply out of range, flash checksum */
    SENSOR_NOT_YET = 255  /* of a step only: call it again */
} sensor_fault_t;

/* Since start. Each has one writer, an interrupt handler or the main loop. */
typedef struct {
    uint32_t samples;   /* delivered */
    uint32_t stale;     /* not new */
    uint32_t repeated;  /* all axes as before, once too often */
    uint32_t alarms;    /* marked by the sensor as bad */
    uint32_t damaged;   /* on the wires */
    uint32_t anomalies; /* of a kind that the part is known for */
    uint32_t overruns;  /* no room, or read too late */
    uint32_t faults;    /* times the fault state was entered */
} sensor_counters_t;

struct sensor;

/* The part of a sensor's state that all have: the first member of its own. A sensor writes the members of the first
 * group, and reads all. */
typedef struct {
    uint32_t period_us;      /* nominal */
    uint32_t diagnosis;      /* every bit of its status word seen so far */
    volatile uint32_t signs; /* counts up with each sign of life: a data-ready, a packet */
    sensor_counters_t counters;

    const struct sensor *sensor;
    const sensor_bus_t *bus;
    sensor_condition_t condition;
    sensor_fault_t fault; /* the last one */
    uint8_t step;         /* of the start */
    uint64_t step_us;     /* when it was entered, or the fault state */
    uint32_t backoff_us;
    uint64_t progress_us;  /* when a sample was delivered last, or the run began */
    uint32_t signs_before; /* `signs` then */
    uint32_t good;         /* samples since the start of this run */
    uint32_t equal;        /* in a row */
    int32_t last[SENSOR_AXES];
    int16_t added[SENSOR_AXES]; /* offsets that were wanted last, in steps */
} sensor_state_t;

/* After `wait_us` in this step act() is called. SENSOR_NO_FAULT: on to the next step; after the last one the sensor
 * runs. SENSOR_NOT_YET: again at the next poll. Else the start has failed. */
typedef struct {
    uint32_t wait_us;
    sensor_fault_t (*act)(sensor_state_t *state);
} sensor_step_t;

/* Functions that may be NULL are marked so. All but ready() and done() are called from the main loop. None may block
 * for longer than a hundred register accesses. */
typedef struct sensor {
    sensor_state_t *state; /* the first member of the sensor's own, `bytes` long */
    size_t bytes;
    const sensor_step_t *start;
    uint8_t steps;
    float step[SENSOR_KINDS];        /* lattice: deg/s and m/s^2 a step of a reading */
    float offset_step[SENSOR_KINDS]; /* of the offset registers, which have -offset_limit to offset_limit - 1 steps */
    int32_t offset_limit[SENSOR_KINDS];

    /* Settings for a rate; sets `period_us`. The state is zero before. False: the sensor has not this rate. */
    bool (*init)(sensor_state_t *state, float rate_hz, sensor_wire_t *wire);
    /* The run ends in a fault: forget the readings that wait. NULL: none do. */
    void (*stop)(sensor_state_t *state);
    /* While it runs: looks after status word and settings; may call sensor_fail(). NULL: nothing to look after. */
    void (*watch)(sensor_state_t *state, uint64_t now_us);
    /* True: readings wait to be read. NULL: never for long. */
    bool (*waits)(sensor_state_t *state);
    /* The oldest good sample in steps, and the samples missing before it. False: none waits, or the run has ended. */
    bool (*read)(sensor_state_t *state, int32_t raw[SENSOR_AXES], uint32_t *missing);
    /* Temperature or supply of the newest sample. NaN before the first, and for what the sensor has not. */
    float (*side)(const sensor_state_t *state, unsigned channel);
    /* Has the sensor add these steps to its readings; reads them back. In any condition: a start writes `added`. False:
     * refused, and the sensor adds the same as before. NULL: it cannot. */
    bool (*offsets)(sensor_state_t *state, const int16_t added[SENSOR_AXES]);
    /* Interrupts come late or not at all from now on, or no longer do. NULL: no matter. */
    void (*pause)(sensor_state_t *state, bool on);
    /* From the interrupts of data-ready and of an exchange's end (`whole`: it went through). NULL: not used. */
    void (*ready)(sensor_state_t *state);
    void (*done)(sensor_state_t *state, bool whole);
} sensor_t;

static inline unsigned sensor_kind(size_t axis) {
    return axis < 3U ? SENSOR_GYRO : SENSOR_ACCEL;
}

/* --- for the application --- */

/* Begins to start the sensor. False: it has not this rate. */
bool sensor_open(const sensor_t *sensor, const sensor_bus_t *bus, float rate_hz);

/* From the main loop, every few ms at least: goes on with the start, watches, tries again. */
void sensor_poll(const sensor_t *sensor);

/* The oldest waiting sample, deg/s and m/s^2, and the samples missing before it; false: none is waiting. */
bool sensor_read(const sensor_t *sensor, float reading[SENSOR_AXES], uint32_t *missing);

/* Has the sensor add `wanted` (deg/s, m/s^2) to its readings by its offset registers. 0 is its own offset after a
 * reset. `got`: the nearest steps. All are written anew whenever the sensor is started, so nothing goes into its flash.
 * Samples that wait, and some that follow, are dropped: missing in time.
 * False: beyond the registers, or not written. The sensor then adds the same as before, after a restart if need be. */
bool sensor_offsets(const sensor_t *sensor, const float wanted[SENSOR_AXES], float got[SENSOR_AXES]);

/* --- for a sensor --- */

/* Ends the start or the run. */
void sensor_fail(sensor_state_t *state, sensor_fault_t fault);

/* Makes a good reading the newest one; true: it repeats the one before too often, and must be withheld. */
bool sensor_repeats(sensor_state_t *state, const int32_t raw[SENSOR_AXES]);

/* From here on the sensor is to give samples. */
void sensor_expect(sensor_state_t *state);

#endif
