/* selfcal: an inertial sensor at rest identifies its own error model.
 *
 * SCOPE
 *   A bank of Kalman filters runs over the readings of a resting sensor, one filter for each hypothesis and grid node.
 *   By Bayes' rule it gives the probability of each drift law, the noise parameters with intervals, and the bias with
 *   its uncertainty. One axis reads, at bank interval i,
 *       y_i = x0 + x_i + v_i,   x0 ~ N(0, P0),   v_i ~ N(0, sigma_v^2),
 *   with the drift x_i of a law (selfcal_law_t). Source of the method: Stepanov & Motorin, IFAC-PapersOnLine 50-1
 *   (2017) 2830-2835. Equation numbers in this library are theirs.
 *
 * HOW TO INTEGRATE
 *   1. `selfcal codegen MODEL.yaml -o DIR` writes selfcal_model.c and .h (const tables, for flash) and selfcal_config.h
 *      (sizes that follow from the model).
 *   2. Copy lib/ and these three files into the product, or take one of the manifests in lib/ (README.md). Tables of
 *      the default model are in default/. The library needs <string.h> and <math.h>.
 *   3. Give selfcal_imu_init() the model and SELFCAL_MODEL_IMU_BYTES of memory. The memory stays yours; nothing is
 *      allocated.
 *   4. selfcal_imu_sample() every sample, selfcal_imu_skip() every missing one. The cost of a sample is even.
 *   5. selfcal_imu_ask() for reports, and selfcal_imu_work() while the processor is idle. Samples may come in between:
 *      with fewer than SELFCAL_MODEL_REPORT_STEPS calls of it in a bank interval they may overtake the report. With
 *      `selfcal codegen --hold` none can.
 *   exp, expm1, log, log1p and sqrt of <math.h> must be within 2 units in the last place (newlib and glibc: 1.3).
 *
 * HEADERS
 *   selfcal.h          this manual: one call a sample. It includes the next three.
 *   selfcal_tables.h   what a model and a configuration are made of
 *   selfcal_parts.h    bank, gate, report, adequacy, changes, telemetry, for a pipe of one's own
 *   selfcal_layout.h   structs that the caller places but does not read
 *   selfcal_frames.h   codes of the telemetry
 *   tumble.h           calibration by rests in several positions, if the pipe names it
 *
 * THREADS AND INTERRUPTS
 *   There is no global state. One selfcal_imu_t belongs to one context at a time. The caller locks when two share it.
 *
 * UNITS
 *   The library knows one unit per axis, called "unit" below: the model's (deg/s, m/s^2, ...). Samples come in it.
 *       N        white noise density        unit/sqrt(Hz)   two-sided; the Allan deviation at 1 s
 *       K        random-walk density        unit/s/sqrt(Hz) = unit/sqrt(s) of drift per second
 *       sigma_m  Gauss-Markov deviation     unit
 *       alpha    Gauss-Markov bandwidth     1/s             flicker: of the middle term
 *       B        flicker coefficient        unit            its plateau of the Allan deviation is 0.664 B
 *       spectral_ratio                      1               white noise: amplitude at 0 Hz over amplitude at 1/(2 dt)
 *       markov_ratio                        1               of a Gauss-Markov drift beside a walk: sigma_m over
 *                                                           K sqrt(correlation time)
 *   Per bank interval dt: sigma_v = N/sqrt(dt), random-walk step sigma_w = K sqrt(dt).
 *
 * THREE KINDS OF TROUBLE
 *   A bad argument gives a status, and nothing changes. A run-time event (gap, saturation, not-a-number, stuck sample)
 *   is counted in selfcal_counters_t, and the sample is kept out of the sums. A bug trips SELFCAL_ASSERT.
 */
#ifndef SELFCAL_H
#define SELFCAL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "selfcal_tables.h"

#ifdef __cplusplus
extern "C" {
#endif

#define SELFCAL_VERSION "0.2.0"

/* --- status and counters --- */

typedef enum {
    SELFCAL_OK = 0,
    SELFCAL_BUSY = 1,                /* a report has more steps to go */
    SELFCAL_TOO_SHORT = 2,           /* fewer bank samples than a report needs (SELFCAL_REPORT_MIN) */
    SELFCAL_OVERTAKEN = 3,           /* the sums have moved under a report, which is given up */
    SELFCAL_AXIS_RETIRED = 4,        /* the axis failed for SELFCAL_RETIRE_BLOCKS: it has no sums any more */
    SELFCAL_BAD_ARGUMENT = -1,       /* null pointer, axis or node out of range, sigma_v not positive */
    SELFCAL_BAD_MODEL = -2,          /* tables contradict themselves or exceed a configured maximum */
    SELFCAL_BAD_MEMORY = -3,         /* too small, or not aligned to 8 bytes */
    SELFCAL_WRITE_FAILED = -4,       /* the callback of selfcal_save() said so */
    SELFCAL_SNAPSHOT_TRUNCATED = -5, /* fewer bytes than a snapshot says it has */
    SELFCAL_SNAPSHOT_TOO_LONG = -6,  /* more bytes than it says */
    SELFCAL_SNAPSHOT_DAMAGED = -7,   /* its checksum does not fit */
    SELFCAL_SNAPSHOT_FOREIGN = -8,   /* not a snapshot, or of another model or build */
    SELFCAL_SNAPSHOT_VERSION = -9,   /* of another format version */
    SELFCAL_CORRUPT = -10,           /* an invariant is broken */
    SELFCAL_BAD_BUILD = -11          /* the caller was compiled with another selfcal_config.h than the library, or with
                                        other macros: nothing has been written */
} selfcal_status_t;

/* Monotonic since selfcal_init(). */
typedef struct {
    uint64_t samples;       /* pushed and used */
    uint64_t missing;       /* told by selfcal_skip(), or in motion, see selfcal_moving() */
    uint32_t gaps;          /* runs of missing or rejected samples */
    uint32_t blocks_lost;   /* bank intervals without a value: fewer than half of their samples were usable */
    uint32_t blocks_part;   /* bank intervals averaged from part of their samples */
    uint32_t blocks_moving; /* those of blocks_lost that selfcal_moving() dropped */
    uint32_t not_finite[SELFCAL_AXES_MAX]; /* samples kept out, by the axis at fault */
    uint32_t saturated[SELFCAL_AXES_MAX];
    uint32_t stuck[SELFCAL_AXES_MAX];
    uint16_t outliers[SELFCAL_AXES_MAX]; /* see selfcal_handling_t; held at 65535 */
    /* samples kept out because a regressor's value was not finite or SELFCAL_SAMPLE_MAX */
    uint32_t regressor_not_finite;
    uint32_t overtaken; /* reports that were given up: SELFCAL_OVERTAKEN */
} selfcal_counters_t;

/* --- report --- */

/* Bank samples below which no report is made. */
#define SELFCAL_REPORT_MIN 3

enum {
    SELFCAL_IDENTIFIED = 1, /* sd of ln(parameter) is below half its prior's, or this is measured; no limit holds it */
    SELFCAL_AT_MIN = 2,     /* more than 5 % of the posterior lies in the lowest 2 % of the prior's ln range */
    SELFCAL_AT_MAX = 4,     /* likewise at the top */
    /* The node grid does not support this estimate: treat it as rough.
     * Set if more than 1 % of the posterior lies beyond the outermost node, or if interpolation between nodes may be
     * wrong by more than 0.05 nat (evidence), 0.05 sd (mean) or 3 % (sd).
     * The nodes about the posterior show the second condition: by how far they depart from what splines can hold.
     * Fewer than seven nodes a dimension do not show it, and are flagged. Without a Gauss-Markov law in the model the
     * flag does not see a record that no random walk makes.
     * Also set for all laws if the report lost one between the nodes: its ln_evidence is -INFINITY, its estimates are
     * NaN, and no probability is right. Without the flag an ln_evidence of -INFINITY means that the priors exclude the
     * law.
     * Remedy: more nodes in the model file.
     * Also set if more than 1 % of the posterior lies where the drift moves so far in a bank interval that its averages
     * hide over 90 % of the white noise: of a random walk, K dt / N above 2.3. Above sqrt(6) there is no node.
     * Remedy: a higher bank rate. */
    SELFCAL_OFF_GRID = 8
};

typedef struct {
    float mean, sd, median, q05, q95; /* units as above */
    uint8_t flags;
} selfcal_estimate_t;

/* For selfcal_predict(): how a decaying drift moves the bias, at one node of alpha or of the ratio (report_bias.c). */
#define SELFCAL_TERM_PAIRS (SELFCAL_TERMS_MAX * (SELFCAL_TERMS_MAX + 1) / 2)
typedef struct {
    float alpha; /* 1/s; of no meaning where the law has a ratio */
    float mean[SELFCAL_TERMS_MAX];
    float var[SELFCAL_TERMS_MAX];
    float var_sq[SELFCAL_TERM_PAIRS];
} selfcal_decay_t;

typedef struct {
    float probability;
    selfcal_wide_t ln_evidence;                       /* nats, density of the bank samples in 1/unit each */
    selfcal_estimate_t parameter[SELFCAL_PARAMETERS]; /* those its law has; the others are NaN with flags 0 */
    float bias_mean, bias_sd;                 /* x0 + drift now (+ c' z with regressors) under this hypothesis, unit */
    selfcal_decay_t decay[SELFCAL_ALPHA_MAX]; /* where a term decays; else 0 */
} selfcal_posterior_t;

typedef struct {
    uint8_t axis;
    uint32_t n;               /* bank samples it rests on, forgotten ones among them */
    float bias_mean, bias_sd; /* x0 + drift at the last interval, over all hypotheses, unit. NaN, as all probabilities,
                                 where the record lies outside the priors */
    selfcal_posterior_t hypothesis[SELFCAL_HYPOTHESES_MAX];
} selfcal_report_t;

/* --- judgement --- */

typedef enum { SELFCAL_NOT_JUDGED = 0, SELFCAL_ADEQUATE = 1, SELFCAL_INADEQUATE = 2 } selfcal_adequacy_state_t;

/* Causes, as `selfcal diagnose` names them. */
typedef enum {
    SELFCAL_SUSPECT_NONE = 0,
    SELFCAL_SUSPECT_TEMPERATURE = 1,
    SELFCAL_SUSPECT_SUPPLY = 2,
    SELFCAL_SUSPECT_CROSS_AXIS = 3,
    SELFCAL_SUSPECT_RAMP = 4,
    SELFCAL_SUSPECT_COLORED_NOISE = 5,
    SELFCAL_SUSPECT_FLICKER = 6, /* or another drift than the law's */
    SELFCAL_SUSPECT_VARIANCE_CHANGE = 7,
    SELFCAL_SUSPECT_OUTLIERS = 8,
    SELFCAL_SUSPECT_STEP = 9,
    SELFCAL_SUSPECT_MOTION = 10, /* several axes step at once */
    SELFCAL_SUSPECT_TURN_ON = 11,
    SELFCAL_SUSPECT_PERIODIC = 12, /* a line */
    SELFCAL_SUSPECT_TWO_LEVEL = 13 /* popcorn noise */
} selfcal_suspect_t;

/* Why an axis is not judged, has no corrected sample, or has a calibration that is not to be relied on. */
typedef enum {
    SELFCAL_REASON_NONE = 0,
    SELFCAL_REASON_FIRST_EPOCH = 1,     /* not judged: still under way */
    SELFCAL_REASON_NO_REPORT = 2,       /* none yet */
    SELFCAL_REASON_LAW_NOT_WATCHED = 3, /* not judged: the likeliest law has coloured noise */
    SELFCAL_REASON_RETIRED = 4,
    SELFCAL_REASON_OUTSIDE_PRIORS = 5, /* the report has no numbers */
    SELFCAL_REASON_MOVING = 6,         /* no report yet, and the gate sees motion */
    SELFCAL_REASON_INADEQUATE = 7,     /* the model does not explain the readings */
    SELFCAL_REASON_NOT_IDENTIFIED = 8, /* half of the probability has an N or a drift that is not */
    SELFCAL_REASON_BAD_SAMPLE = 9,     /* on some axis it is not finite or saturated */
    SELFCAL_REASON_STUCK = 10,         /* the axis repeats one reading */
    /* samples have overtaken the last report, and there is none before it, or a rough one: see
     * SELFCAL_MODEL_REPORT_STEPS */
    SELFCAL_REASON_OVERTAKEN = 11
} selfcal_reason_t;

/* A change that was found while the samples came. */
typedef struct {
    selfcal_suspect_t cause; /* STEP; MOTION: several axes stepped at once; VARIANCE_CHANGE */
    float size;              /* of a step, unit; of a change of variance, the noise over that before */
    float ago_s;             /* since its onset */
} selfcal_change_t;

typedef struct {
    selfcal_adequacy_state_t state;
    selfcal_reason_t reason;
    selfcal_suspect_t suspect; /* the strongest one, also of an adequate model */
    float score;               /* of the suspect, in standard deviations of its null law */
    uint32_t samples;          /* bank samples that it rests on */
    float temperature_span;    /* how far the temperature has moved since the start; NAN: there is none */
    uint32_t changes;          /* found on this axis so far ... */
    selfcal_change_t change;   /* ... and the last of them */
} selfcal_judgement_t;

/* A corrected sample, by axis of the model, unit; sd NAN: there is none of this axis. With a calibration (tumble.h)
 * accelerometers have the specific force and its sd, and gyros are without their g-sensitivity. */
typedef struct {
    float value[SELFCAL_AXES_MAX];             /* reading less bias, see selfcal_predict() */
    float sd[SELFCAL_AXES_MAX];                /* of that bias */
    uint32_t motion;                           /* code as in selfcal.dbc */
    selfcal_reason_t reason[SELFCAL_AXES_MAX]; /* why there is none, or why it is not to be relied on */
} selfcal_corrected_t;

/* The coefficient of one regressor column, given that the column is in use, and the probability that it is. With a mean
 * of NaN nothing is known of the column, and nothing is sent. */
typedef struct {
    float mean, sd, probability;
} selfcal_sent_coefficient_t;

/* Take the next `count` bytes, `context` as given to selfcal_save(). false: the medium failed, nothing more is
 * written. */
typedef bool (*selfcal_write_t)(void *context, const void *bytes, size_t count);

/* --- pipe ---
 * The way of a sample in one call: gate, columns, bank, judgement, changes, whatever the model names.
 *
 *     selfcal_imu_init(&imu, &selfcal_model_pipe, memory, sizeof memory);
 *     each sample:  selfcal_imu_sample(&imu, reading, NULL, NULL);
 *     now and then: selfcal_imu_ask(&imu, SELFCAL_ALL_AXES);
 *     idle:         selfcal_imu_work(&imu);
 *     at any time:  selfcal_imu_report(&imu, axis), selfcal_imu_reason(&imu, axis), selfcal_imu_corrected(&imu, &out)
 */

typedef struct selfcal_imu selfcal_imu_t; /* of its members, `bank`, `computing` and `gate` may be looked at */

/* Begin over `memory`, aligned to 8 bytes. `size`: SELFCAL_MODEL_IMU_BYTES of the generated header. Tables and memory
 * must outlive the use. A gate that the model has watches from the first sample on. Fails with SELFCAL_BAD_ARGUMENT,
 * SELFCAL_BAD_MODEL (also if the parts that the pipe names do not go together), SELFCAL_BAD_MEMORY or
 * SELFCAL_BAD_BUILD; then `imu` is unusable. */
static inline selfcal_status_t selfcal_imu_init(selfcal_imu_t *imu, const selfcal_pipe_t *pipe, void *memory,
                                                size_t size);
selfcal_status_t selfcal_imu_init_as(uint32_t layout, selfcal_imu_t *imu, const selfcal_pipe_t *pipe, void *memory,
                                     size_t size);

/* From here on the last report of each axis is kept, for selfcal_imu_report() and selfcal_imu_corrected(). Without it,
 * or with NULL, the last report of all. Reports from before are gone. `kept` must outlive the use. */
typedef struct selfcal_kept selfcal_kept_t;
void selfcal_imu_keep(selfcal_imu_t *imu, selfcal_kept_t *kept);

/* The gate begins anew, or is off: every sample counts as one of rest. True if it watches. */
bool selfcal_imu_watch(selfcal_imu_t *imu, bool on);

/* Take one sample of every axis, in the model's order and units. `channels`: of the regressors, as their sources count
 * them; NULL without any. `side`: temperature (degC) and supply (V), for the judgement; NULL: neither is known.
 * Returns a bit for each axis that has changed, whose last report is of the past: ask for another. Beside them
 * SELFCAL_IMU_DEAR: the sample took as long as a slice of a report. Let the next slice wait. */
#define SELFCAL_IMU_DEAR 0x80000000UL
uint32_t selfcal_imu_sample(selfcal_imu_t *imu, const float reading[], const float channels[], const float side[]);

/* `count` samples are missing before the next one. */
void selfcal_imu_skip(selfcal_imu_t *imu, uint64_t count);

/* False while a report is worked out and one more sample might overtake it. Let the samples wait then. Always true
 * where the model holds reports. */
bool selfcal_imu_room(const selfcal_imu_t *imu);

/* Reports of these axes are due, a bit each; the axes take turns. SELFCAL_BUSY: one of them has begun. Else why the
 * last of them cannot be made. */
#define SELFCAL_ALL_AXES 0xFFFFU
selfcal_status_t selfcal_imu_ask(selfcal_imu_t *imu, uint32_t axes);

/* Take one step of the reports that are due, as selfcal_report_step(). With regressors an axis takes two reports. The
 * likelier of both stands. SELFCAL_BUSY: there is more to do. SELFCAL_OK: there is not. Else the last report of all has
 * come to nothing, and there is no more to do. */
selfcal_status_t selfcal_imu_work(selfcal_imu_t *imu);

/* The following take an axis of the model. Another one is a bug (SELFCAL_ASSERT): they do not look. */

/* The last report of an axis, NULL: none yet, or a change has made it one of the past. It stays as it is until another
 * one of the axis (without selfcal_imu_keep(): of any axis) is worked on. */
const selfcal_report_t *selfcal_imu_report(const selfcal_imu_t *imu, uint8_t axis);

/* The judgement at that report; before the first, SELFCAL_NOT_JUDGED and the reason. NULL: the model is not judged. */
const selfcal_judgement_t *selfcal_imu_judgement(const selfcal_imu_t *imu, uint8_t axis);

/* The coefficients at that report, by column; NULL: the model has no regressors. */
const selfcal_sent_coefficient_t *selfcal_imu_coefficients(const selfcal_imu_t *imu, uint8_t axis);

/* Why the calibration of an axis is not to be relied on now. */
selfcal_reason_t selfcal_imu_reason(const selfcal_imu_t *imu, uint8_t axis);

/* The bias of an axis's last report, unit. It goes with selfcal_imu_shift(). NAN: there is none. */
float selfcal_imu_bias(const selfcal_imu_t *imu, uint8_t axis);

/* Whether the sensor rests, by the code of selfcal.dbc. */
uint32_t selfcal_imu_motion(const selfcal_imu_t *imu);

/* The newest sample less the bias predicted for its time, or by a calibration, with its sd and reason. False: no sample
 * has come since the last call, or selfcal_imu_keep() has not been called. O(alpha nodes axes). */
bool selfcal_imu_corrected(selfcal_imu_t *imu, selfcal_corrected_t *corrected);

/* From the next sample on the sensor itself adds `amount` (unit) to the readings of an axis, say because its offset
 * register was written with the bias. Everything known is kept, and the bias goes up by `amount`. Not while a report is
 * worked out. SELFCAL_BAD_ARGUMENT, and nothing changes: no such axis, or `amount` or the sum of all of them is not
 * below SELFCAL_SAMPLE_MAX. */
selfcal_status_t selfcal_imu_shift(selfcal_imu_t *imu, uint8_t axis, float amount);

/* The part was powered on `samples` before the next sample; without this, at the first of all. A snapshot has it. Call
 * it before the first sample, or after selfcal_imu_restore(). */
selfcal_status_t selfcal_imu_power_on(selfcal_imu_t *imu, uint64_t samples);

/* All is forgotten but what the sensor adds (selfcal_imu_shift()). */
selfcal_status_t selfcal_imu_forget(selfcal_imu_t *imu);

/* The bank's state as bytes with a version and a CRC-32, see selfcal_save() and selfcal_restore() for each status:
 * SELFCAL_MODEL_SNAPSHOT_MAX bytes at most. A save may come amid a report, which goes on. A restore gives up a report
 * under way. A snapshot belongs to its model and its build. After a restore `gap` samples, and the rest of a bank
 * interval, are missing. */
selfcal_status_t selfcal_imu_save(const selfcal_imu_t *imu, selfcal_write_t write, void *context);
selfcal_status_t selfcal_imu_restore(selfcal_imu_t *imu, const void *snapshot, size_t length, uint64_t gap);

#ifdef __cplusplus
}
#endif

#include "selfcal_parts.h"

#include "selfcal_layout.h" /* needs the types of the parts */

#endif
