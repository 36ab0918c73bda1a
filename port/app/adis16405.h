/* Driver of the ADIS16405 inertial sensor, without a target: SPI and time come through callbacks.
 *
 * READING  The sensor raises data-ready once a sample. The driver then reads the burst twice. A burst has no checksum,
 *   but the output registers stand still until the next sample: damage on the wires shows as a difference between the
 *   two readings. A sample is delivered only if
 *   - the first reading has ND (new data) set and EA (error/alarm) clear on all six inertial channels,
 *   - the second one has the same 14 bits everywhere,
 *   - XGYRO_OUT has not lost its sign bit (known anomaly of the part: a step of +2^13 LSB).
 *   Everything else is counted, and time passes: the next delivered sample tells how many are missing before it, by
 *   the clock and the sensor's own sample period, which is tracked.
 * SETTINGS  They are read back every ten seconds, fifty at most. So they are after a pause, and when samples come too
 *   fast, before a sample is taken: something else may have reset the sensor.
 * TROUBLE  that does not pass (absent, silent, stuck, failed self-test, supply out of range) ends in a fault state.
 *   The driver resets the sensor and tries again, at first after 0.1 s, then with doubled delays up to 10 s.
 * TIME  Nothing blocks for longer than a register access, about 70 us each (350 us in the sensor's slow mode): some
 *   ten of them in a row, a hundred when the sensor is started.
 *
 * Registers and bits: ADIS16400/ADIS16405 data sheet, table 8 and the register tables after it. */
#ifndef ADIS16405_H
#define ADIS16405_H

#include <stdbool.h>
#include <stdint.h>

#define ADIS16405_AXES 6U         /* gx gy gz ax ay az */
#define ADIS16405_BURST_WORDS 12U /* supply, 3 gyro, 3 accel, 3 magn, temperature, aux */

/* The sensor makes 1638.4 / n Hz, n = 1 .. 128. The nearest n of a rate up to 1638.4 Hz; true if n makes it to 0.1 %.
 * Constant expressions where the rate is one. */
#define ADIS16405_DIVIDER(rate_hz) ((uint32_t)(1638.4F / (rate_hz) + 0.5F))
#define ADIS16405_OFF(rate_hz) (1638.4F / (rate_hz) - (float)ADIS16405_DIVIDER(rate_hz))
#define ADIS16405_HAS_RATE(rate_hz) \
    (1638.4F / (rate_hz) >= 1.0F && 1638.4F / (rate_hz) < 128.5F && ADIS16405_OFF(rate_hz) <= 1.6384F / (rate_hz) && \
     ADIS16405_OFF(rate_hz) >= -1.6384F / (rate_hz))

/* Data sheet, timing specifications: with SMPL_PRD of 0x0A and more (n > 10) SCK is 300 kHz at most and frames lie
 * 75 us apart. Below that 2 MHz, 1 MHz in a burst, and 9 us. */
#define ADIS16405_SLOW(rate_hz) (ADIS16405_DIVIDER(rate_hz) > 10U)
#define ADIS16405_SCK_MAX_HZ(rate_hz) (ADIS16405_SLOW(rate_hz) ? 300000U : 1000000U)
#define ADIS16405_STALL_US(rate_hz) (ADIS16405_SLOW(rate_hz) ? 80U : 10U)

/* Samples that wait for the main loop: 1.25 s at 819.2 Hz. A power of two; 16 bytes each. */
#ifndef ADIS16405_QUEUE
#define ADIS16405_QUEUE 1024U
#endif
#if ADIS16405_QUEUE < 8 || (ADIS16405_QUEUE & (ADIS16405_QUEUE - 1)) != 0
#error "ADIS16405_QUEUE must be a power of two, 8 at least"
#endif

typedef struct adis16405_bus {
    void *context;
    /* Time since start, us: from the main loop, and modulo 2^32 from anywhere. */
    uint64_t (*time_us)(void *context);
    uint32_t (*time_us32)(void *context);
    /* One frame of 16 bits each way with chip select low around it, SPI mode 3, at most ADIS16405_SCK_MAX_HZ, then
     * ADIS16405_STALL_US of rest. Bounded; false: it did not take place. */
    bool (*word)(void *context, uint16_t out, uint16_t *in);
    /* Begins a burst (0x3E00, then 12 words, chip select low throughout); its end is told by adis16405_burst().
     * Breaks off one under way. */
    bool (*burst)(void *context);
    /* The sensor's reset line; not needed where it is not wired, the driver also resets by command. */
    void (*reset_line)(void *context, bool low);
} adis16405_bus_t;

typedef enum {
    ADIS16405_STARTING, /* reset, identification, set-up, self-test */
    ADIS16405_RUNNING,
    ADIS16405_FAILED    /* waiting for the next try */
} adis16405_state_t;

typedef enum {
    ADIS16405_NO_FAULT = 0,
    ADIS16405_ABSENT = 1,    /* PRODUCT_ID is not 16405 */
    ADIS16405_SET_UP = 2,    /* a register did not read back, or has changed since; or no reset came about */
    ADIS16405_SELF_TEST = 3, /* an axis failed it, or it did not end */
    ADIS16405_SILENT = 4,    /* no data-ready */
    ADIS16405_NO_DATA = 5,   /* data-ready, but no sample that passes the checks */
    ADIS16405_STUCK = 6,     /* all six channels stand still */
    ADIS16405_STATUS = 7     /* DIAG_STAT: supply out of range, flash checksum, self-test */
} adis16405_fault_t;

/* Since start. Each has one writer, an interrupt handler or the main loop. */
typedef struct {
    uint32_t samples;   /* delivered to the application */
    uint32_t stale;     /* ND not set */
    uint32_t repeated;  /* all channels as before, once too often */
    uint32_t alarms;    /* EA set */
    uint32_t damaged;   /* the two readings differ, or a burst failed */
    uint32_t anomalies; /* lost sign bit of XGYRO_OUT */
    uint32_t overruns;  /* data-ready with a reading under way, or no room in the queue */
    uint32_t faults;    /* times the fault state was entered */
} adis16405_counters_t;

typedef struct {
    float rate_hz;           /* one that ADIS16405_HAS_RATE */
    uint16_t range_deg_s;    /* 300, 150 or 75 */
    uint8_t filter_taps_ln2; /* Bartlett filter of 2^m taps, 0 to 4 */
} adis16405_config_t;

/* Private; declared here so that the caller can place it. */
typedef struct {
    const adis16405_bus_t *bus;
    uint16_t sample_period, filter; /* SMPL_PRD, SENS_AVG */
    int16_t base[ADIS16405_AXES];   /* offset registers as a reset leaves them ... */
    int16_t added[ADIS16405_AXES];  /* ... and what has been added to them */
    uint8_t settling;               /* samples to leave out after that */
    uint32_t nominal_q8, period_q8; /* sample period, us / 256 */
    float scale[ADIS16405_AXES];
    adis16405_state_t state;
    adis16405_fault_t fault; /* the last one */
    uint8_t step;
    uint64_t step_us;      /* when the step of the start was entered, or the fault state */
    uint32_t backoff_us;
    uint16_t diagnosis;    /* every bit of DIAG_STAT seen so far */
    volatile bool diagnosis_wanted;
    uint64_t diagnosis_us; /* when it was read last */
    /* main loop, of the samples */
    uint64_t seen_us;      /* stamp of the last reading taken from the queue */
    uint64_t checked_us;   /* when the settings were read last */
    uint64_t last_us;      /* stamp of the last sample delivered */
    bool doubtful;         /* none is delivered until the settings have been found to stand */
    bool anchored;
    uint64_t anchored_us;  /* stamp of `last` */
    uint8_t unsure;        /* readings in a row that could be negative ones less their sign */
    uint8_t excuses;       /* readings of DIAG_STAT in a row that say over-range */
    uint8_t marks;         /* resets that left MARK */
    bool based;            /* `base` is known */
    int16_t last[ADIS16405_AXES];
    volatile uint16_t side[2]; /* supply and temperature, as read; 0: none yet */
    uint32_t off_rate;     /* readings in a row that came no whole number of periods after the one before */
    uint32_t equal, unproven;
    uint32_t good;         /* samples since the start of this run */
    uint64_t progress_us;  /* when a sample was delivered last, or the run began */
    uint32_t ready_seen;
    /* shared with the interrupt handlers */
    volatile bool listening, reading;
    volatile uint32_t stamp;
    volatile uint32_t ready_count;
    bool second;
    uint16_t first_words[ADIS16405_BURST_WORDS];
    volatile uint32_t head, tail; /* count up for ever */
    volatile struct {
        uint32_t stamp;
        int16_t raw[ADIS16405_AXES];
    } queue[ADIS16405_QUEUE];
    adis16405_counters_t counters;
} adis16405_t;

/* Begins to start the sensor. False: the configuration has no setting of the sensor. */
bool adis16405_init(adis16405_t *self, const adis16405_bus_t *bus, const adis16405_config_t *config);

/* From the data-ready interrupt, and at the end of a burst (`whole`: it went through). Equal priorities, please. */
void adis16405_ready(adis16405_t *self);
void adis16405_burst(adis16405_t *self, const uint16_t words[ADIS16405_BURST_WORDS], bool whole);

/* From the main loop, every few ms at least: goes on with the start, watches, tries again. */
void adis16405_poll(adis16405_t *self);

/* From the main loop, while interrupts come late or not at all: takes no samples from here on, or goes on. The
 * samples of a pause are missing in time. Waits for a reading under way, 4 ms at most. */
void adis16405_pause(adis16405_t *self, bool on);

/* Has the sensor add `wanted` (deg/s, m/s^2) to its readings by its offset registers. 0 is its own offset after a
 * reset, but no negative XGYRO_OFF. `got`: the nearest steps, 0.0125 deg/s and 3.33 mg. Each register is read back.
 * All are written anew whenever the sensor is started, so nothing goes into its flash. Samples that wait, and some
 * that follow, are dropped: missing in time.
 * False: beyond the registers (50 deg/s, 6.8 g), or not written. The sensor then adds the same as before, after a
 * restart if need be. A negative XGYRO_OFF is refused: with one the part loses the sign bit of negative x rates (the
 * anomaly above). So a positive x bias stays. */
bool adis16405_offsets(adis16405_t *self, const float wanted[ADIS16405_AXES], float got[ADIS16405_AXES]);

/* The oldest waiting sample, deg/s and m/s^2, and the samples missing before it; false: none is waiting. */
bool adis16405_sample(adis16405_t *self, float reading[ADIS16405_AXES], uint32_t *missing);

/* The sensor's temperature, degC, and supply, V, of the newest sample that was taken. NaN before the first sample.
 * If the two readings of a burst differ, the value before stands. */
float adis16405_temperature(const adis16405_t *self);
float adis16405_supply(const adis16405_t *self);

#endif
