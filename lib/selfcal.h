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
 *   3. Give selfcal_init() the model and SELFCAL_MODEL_BYTES of memory. The memory stays yours; nothing is allocated.
 *   4. selfcal_push() every sample, selfcal_skip() every missing one. The cost of a push is even: SELFCAL_BATCH bank
 *      samples are gathered, and while the next ones are, each push runs some nodes over them.
 *   5. For a report: selfcal_report_begin(), then selfcal_report_step() until it no longer says SELFCAL_BUSY.
 *      Samples may be pushed in between, as long as selfcal_room() is above 0.
 *   exp, expm1, log, log1p and sqrt of <math.h> must be within 2 units in the last place (newlib and glibc: 1.3).
 *
 * THREADS AND INTERRUPTS
 *   There is no global state. One selfcal_t belongs to one context at a time. The caller locks when two share it.
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
 *
 * Structs that the caller places but does not read are in selfcal_layout.h.
 */
#ifndef SELFCAL_H
#define SELFCAL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "selfcal_config.h"

#ifdef __cplusplus
extern "C" {
#endif

#define SELFCAL_VERSION "0.1.0"

/* ---------------------------------------------------------------------------------------------------- configuration
 * Three macros are left to a person; the compiler's command line or selfcal_config.h sets them.
 *   SELFCAL_ASSERT(condition)  what a bug does. As it is: nothing.
 *   SELFCAL_FIXED              defined: samples are processed in integers, for parts without an FPU. Gains, tables
 *                              and reports stay in float. Formats and head-room: bank_kernel_fixed.c.
 *   SELFCAL_REPORT_QUALITY     how finely a report integrates: 1 a module's, 2 a host's, 3 a reference's; 0 fuzzing.
 * selfcal_config.h has the sizes. `selfcal codegen` writes it. Whatever it sets may be set on the command line instead.
 *   SELFCAL_AXES_MAX              axes of a bank, 1 to 16. Six inertial axes share every gain.
 *   SELFCAL_HYPOTHESES_MAX        hypotheses of a model, 1 to 16
 *   SELFCAL_GRID_MAX              nodes of a grid dimension, 6 to 64
 *   SELFCAL_ALPHA_MAX             nodes of alpha or of a ratio, 6 to SELFCAL_GRID_MAX
 *   SELFCAL_HYPOTHESIS_NODES_MAX  nodes of a hypothesis: 16 bytes each in a report's scratch
 *   SELFCAL_NODES_MAX             nodes of all hypotheses: 12 bytes each in a report's scratch
 *   SELFCAL_REGRESSORS_MAX        regressors of a model, 1 to 6
 *   SELFCAL_TERMS_MAX             states of a law: 1, or 3 for laws that are sums
 *   SELFCAL_BATCH                 bank samples gathered before the nodes run over them, 8 to 64; 16 at most in
 *                                 integers. More: fewer loads per sample, more time for a report; 56 bytes each.
 *   SELFCAL_PUSH_NODES            nodes that a push runs at least while a batch waits
 *   SELFCAL_PUSH_EVERY            pushes from one such step to the next at most, a power of two up to 256. For cores
 *                                 on which a node's batch takes longer than a sample.
 *   SELFCAL_LINES                 frequencies by which a report describes the data's spectrum, even, 8 to 64. 20 do
 *                                 for 5000 bank samples, 36 for 3e7. They take 6 LINES^2 bytes of its scratch.
 *   SELFCAL_RETIRE_BLOCKS         bank intervals in a row that an axis may spoil before it is retired; 0: never */
#ifndef SELFCAL_ASSERT
#define SELFCAL_ASSERT(condition) ((void)0)
#endif

/* State and per-sample arithmetic. -DSELFCAL_REAL_DOUBLE builds the same code in double. So the rounding of the float
 * build is told from an error of method. */
#if defined(SELFCAL_REAL_DOUBLE) && defined(SELFCAL_FIXED)
#error "SELFCAL_FIXED and SELFCAL_REAL_DOUBLE exclude each other"
#endif
#ifdef SELFCAL_REAL_DOUBLE
typedef double selfcal_real_t;
#else
typedef float selfcal_real_t;
#endif

/* Reports and ln-likelihoods. Double, in software where the FPU has none. No sample touches it. */
typedef double selfcal_wide_t;

/* ------------------------------------------------------------------------------------------------------------ model
 * All tables are const. `selfcal codegen` and the Python tools make them from the same YAML file. */

/* A law is data: the terms of its drift, and the kind of its white noise.
 *   SELFCAL_WALK:   x_i = x_(i-1) + K sqrt(dt) w_i,  x_0 = 0                                             (23)
 *   SELFCAL_MARKOV: x_i = phi x_(i-1) + sigma_m sqrt(1 - phi^2) w_i,  phi = exp(-bandwidth dt), stationary
 *   SELFCAL_OSCILLATION, then SELFCAL_DAMPING: x'' + 2 damping w x' + w^2 x = white noise, stationary, of one term for
 *     each of two states. The first one's bandwidth is w, the second one's damping w. They share the deviation.
 * That holds at each sample; a bank sample is the mean of a block of samples. A model of one sample a block takes the
 * drift for a point, whatever the sensor averaged before.
 * A law has at most three parameters: N, the drift parameter, and a second one.
 * The drift parameter is K if a term is a walk, else sigma_m (B for flicker).
 * The second one is alpha, which scales the bandwidths that are not stated, or a ratio. No law has both. */
typedef enum {
    SELFCAL_WALK = 0,
    SELFCAL_MARKOV = 1,
    SELFCAL_OSCILLATION = 2,
    SELFCAL_DAMPING = 3
} selfcal_term_kind_t;

typedef struct {
    selfcal_term_kind_t kind;
    float deviation; /* times the drift parameter: this term's K or sigma_m; 1e-3 to 1e3.
                        Beside a walk, a Gauss-Markov term has sigma_m = deviation K / sqrt(bandwidth),
                        and an oscillation's standard deviation is deviation K / sqrt(w). */
    float bandwidth; /* of a Gauss-Markov term: times alpha, 1e-3 to 1e3; if stated, 1/s. 0 of a walk */
    bool stated;     /* the model states the bandwidth: 1e-6 to 6.9 over dt_s. Always of an oscillation, whose w is
                        1e-6 to 0.79 over dt_s, and whose damping is 1e-3 to 0.7 */
    bool by_ratio;   /* the law's ratio multiplies the deviation */
} selfcal_term_t;

/* A law of one plain term or of none takes the fast filters. Others are sums, see selfcal_law_is_sum().
 * Coloured: instead of v_i, (e_i + theta e_(i-1)) / (1 + theta) with e_i ~ N(0, sigma_v^2). N is then the density at
 * low frequency. The law's ratio is (1 + theta) / (1 - theta), its prior within 1e-3 to 1e3. */
#define SELFCAL_LAW_TERMS 3
typedef struct {
    uint8_t terms;       /* those used; with coloured noise 1 or 2 */
    bool coloured_noise;
    selfcal_term_t term[SELFCAL_LAW_TERMS];
} selfcal_law_t;

/* Whether the law needs the filters for several states: selfcal_states_code in the model, SELFCAL_TERMS_MAX of 3. */
bool selfcal_law_is_sum(const selfcal_law_t *law);

/* Places of parameters. A law has K or sigma_m, and alpha or a ratio. */
typedef enum {
    SELFCAL_N = 0,
    SELFCAL_K = 1,
    SELFCAL_SIGMA_M = 2, /* flicker's B as well */
    SELFCAL_ALPHA = 3,
    SELFCAL_RATIO = 3,
    SELFCAL_PARAMETERS = 4
} selfcal_parameter_t;

/* Proper prior of one parameter between two limits: uniform in its logarithm, or uniform in itself. */
typedef struct {
    float ln_min, ln_max; /* ln of the parameter in the units above, within 46 of 0: 1e-20 to 1e20 */
    bool uniform;         /* false: log-uniform */
    bool measured;        /* the limits are those of an earlier record: the parameter counts as identified at once */
} selfcal_prior_t;

typedef struct {
    selfcal_prior_t prior[SELFCAL_PARAMETERS];
    float bias_sd;        /* sqrt(P0), unit */
    float range;          /* a sample whose size reaches it is saturated, unit; 0: no check */
    uint32_t stuck_limit; /* this many equal samples in a row are stuck; 0: no check */
} selfcal_axis_t;

/* One grid dimension: nodes at even steps of ln(value), joined by a quintic spline (not-a-knot: no knot at the two
 * places next to either end). The steps are even, so the spline's matrix is the same wherever the nodes lie. */
typedef struct {
    uint16_t nodes;
    const selfcal_real_t *fit; /* [nodes][nodes]: node values to B-spline coefficients */
} selfcal_grid_t;

/* Nodes of a hypothesis: all pairs of rho (outer) and alpha (inner). rho is the drift over the white noise per bank
 * interval: sigma_w / sigma_v, sigma_m / sigma_v or B / sigma_v. Block means have these less white noise than the
 * samples (averages.h): N^2 / dt is above sigma_v^2, and a Gauss-Markov law's rho is of its block means.
 * The alpha nodes span the priors. The rho nodes span the priors of K or sigma_m over the white noise seen in the first
 * SELFCAL_BATCH bank samples. Their margin is e^0.5 either way, and e^1.25 above sigma_m.
 * A call that looks at the sums sooner (a report, a node's) places the nodes for good by the samples there are. With
 * fewer than 8 they often do not lie where later ones need them. Places decide how well the likelihood is interpolated;
 * the prior does not depend on them. */
typedef struct {
    const selfcal_law_t *law;     /* one law may stand in several hypotheses, with other priors */
    float ln_probability;         /* prior */
    const selfcal_grid_t *rho;    /* NULL for a law without terms */
    const selfcal_grid_t *alpha;  /* of alpha or of the ratio; NULL if the law has neither */
    const selfcal_prior_t *prior; /* [axes][SELFCAL_PARAMETERS] under this law; NULL: those of the axes */
} selfcal_hypothesis_t;

/* Where a regressor's value comes from, for selfcal_form(). Times count from the first sample, a turn-on's from
 * power-on: selfcal_power_on(). */
typedef enum {
    SELFCAL_COLUMN_TIME = 0,    /* s */
    SELFCAL_COLUMN_CHANNEL = 1, /* a channel; with a window its mean over that time up to the sample */
    SELFCAL_COLUMN_RATE = 2,    /* gain of a channel over the window, per second */
    SELFCAL_COLUMN_SINE = 3,    /* of a line */
    SELFCAL_COLUMN_COSINE = 4,
    SELFCAL_COLUMN_STEP = 5,    /* 0, and 1 from a time on */
    SELFCAL_COLUMN_TURN_ON = 6, /* exp(-t / time constant) */
    SELFCAL_COLUMN_PULSE = 7,   /* 0, and 1 from a time on until another */
    SELFCAL_COLUMN_LAG = 8,     /* a channel behind a first-order low pass, at rest at its first value */
    SELFCAL_COLUMN_SLOPE = 9,   /* slope of the straight line that fits a channel's window best, per second */
    SELFCAL_COLUMN_SQUARE = 10, /* of a channel about a value */
    SELFCAL_COLUMN_CUBE = 11
} selfcal_column_kind_t;

typedef struct {
    selfcal_column_kind_t kind;
    uint8_t channel; /* of a channel: an axis; from the model's `axes` on, a channel beside the readings */
    float number;    /* CHANNEL, RATE, SLOPE: window, s (CHANNEL: 0 for none); SINE, COSINE: frequency, Hz;
                      * STEP, PULSE: time, s; TURN_ON, LAG: time constant, s; SQUARE, CUBE: the value they are about */
    float second;    /* PULSE: end, s; LAG, SQUARE, CUBE: window of the mean that they are made of, s; 0 for none */
} selfcal_source_t;

/* Optional code. Only a model that names it links it. */
typedef struct selfcal_regressors_code selfcal_regressors_code_t;
extern const selfcal_regressors_code_t selfcal_regressors_code;
typedef struct selfcal_forgetting_code selfcal_forgetting_code_t;
extern const selfcal_forgetting_code_t selfcal_forgetting_code;
typedef struct selfcal_states_code selfcal_states_code_t;
extern const selfcal_states_code_t selfcal_states_code;

/* Known disturbances z (time, temperature, its rate or lag, supply, another axis, a sine and a cosine, a step, a
 * turn-on, a pulse). Each adds a constant coefficient times its value to every reading. Every subset of them is a
 * hypothesis of its own. The values come with the samples, see selfcal_push_with(); their unit is the application's.
 * With SELFCAL_FIXED the bank then runs in software floating point. */
typedef struct {
    const selfcal_regressors_code_t *code; /* &selfcal_regressors_code */
    uint8_t count;               /* 1 to SELFCAL_REGRESSORS_MAX */
    const float *reference;      /* [count] value at which x0 alone is the bias */
    /* [axes][count] prior N(mean, sd^2), unit per unit of the regressor; sd 0: not for this axis; no means: all 0 */
    const float *coefficient_sd;
    const selfcal_source_t *source; /* [count] for selfcal_form(); NULL: the application makes the values by itself */
    const float *ln_odds;          /* [axes][count] ln of the prior odds that it is in use; a cosine: 0 */
    const float *coefficient_mean; /* [axes][count] or NULL */
} selfcal_regressors_t;

/* For parts whose parameters change. Each bank sample's weight halves every half_life_s. So does the penalty that the
 * bias prior paid at the start of the record: otherwise a law that remembers the bias (constant) would be charged for
 * it for ever, and one that forgets it (random walk) would not. The bias and the coefficients forget as well. Reports
 * rest on about half_life_s / (0.69 dt_s) samples. If nothing has changed, intervals are sqrt(2) wider than necessary.
 * O(axes) for each node and batch. */
typedef struct {
    const selfcal_forgetting_code_t *code; /* &selfcal_forgetting_code */
    float half_life_s; /* at least SELFCAL_BATCH dt_s */
} selfcal_forgetting_t;

/* What no model file can foresee and the module handles by itself. Outliers: selfcal_push(). Steps of the bias and
 * changes of the noise: selfcal_changes_t; not beside regressors. */
typedef struct {
    /* A sample so many standard deviations from the mean of the block before is kept out of the sums; 0: none. After 4
     * in a row the next are taken. Of normal noise 6 keep out one sample in 5e8, which is 35 in 1000 h of six axes at
     * 819 Hz. Not where a bank interval is one sample. */
    float outlier_sd;
    bool steps;
    bool variance_changes;
} selfcal_handling_t;

typedef struct {
    uint32_t id;        /* checksum of the tables: a snapshot or a monitor tells models apart by it */
    float dt_s;         /* bank interval, 1e-6 to 1e6 */
    uint32_t block;     /* samples averaged into one bank sample */
    uint8_t axes;
    uint8_t hypotheses;
    uint16_t nodes;     /* of all hypotheses together */
    const selfcal_axis_t *axis;             /* [axes] */
    const selfcal_hypothesis_t *hypothesis; /* [hypotheses] */
    const selfcal_regressors_t *regressors; /* NULL: none, and none of their cost */
    const selfcal_forgetting_t *forgetting; /* likewise */
    const selfcal_states_code_t *states;    /* &selfcal_states_code if a law is a sum, else NULL */
    const selfcal_handling_t *handling;     /* NULL: nothing is handled, and none of its cost */
} selfcal_model_t;

/* A model with what selfcal_imu_t has beside the bank; NULL: no such part. It stands by itself, so that a program which
 * takes the bank alone does not link the parts. */
typedef struct selfcal_gate_code selfcal_gate_code_t;
extern const selfcal_gate_code_t selfcal_gate_code;
typedef struct selfcal_columns_code selfcal_columns_code_t;
extern const selfcal_columns_code_t selfcal_columns_code;
typedef struct selfcal_judging_code selfcal_judging_code_t;
extern const selfcal_judging_code_t selfcal_judging_code;
typedef struct selfcal_changes_code selfcal_changes_code_t;
extern const selfcal_changes_code_t selfcal_changes_code;
typedef struct selfcal_gate_config selfcal_gate_config_t;
typedef struct {
    const selfcal_model_t *model;
    float rate_hz;                         /* of the samples */
    const selfcal_gate_config_t *gate;     /* of gate_code */
    const selfcal_gate_code_t *gate_code;  /* keeps motion out */
    const selfcal_columns_code_t *columns; /* forms the values of the regressors: with them, and only then */
    const selfcal_judging_code_t *judging; /* judges the model */
    const selfcal_changes_code_t *changes; /* handles steps and changes of the noise; with judging */
} selfcal_pipe_t;

/* ------------------------------------------------------------------------------------------------------------- bank */

typedef struct selfcal selfcal_t; /* of its members, `position` and `used` may be read: samples of this block */

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
    SELFCAL_CORRUPT = -10            /* an invariant is broken */
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
} selfcal_counters_t;

/* Prepare `self` over `memory`, aligned to 8 bytes. `size`: SELFCAL_MODEL_BYTES of the generated header, or the sum of
 * SELFCAL_SIZE, SELFCAL_REGRESSORS_SIZE and SELFCAL_TERMS_SIZE of selfcal_layout.h. Model and memory must outlive the
 * use. Fails with SELFCAL_BAD_ARGUMENT, SELFCAL_BAD_MODEL or SELFCAL_BAD_MEMORY; then `self` is unusable. */
selfcal_status_t selfcal_init(selfcal_t *self, const selfcal_model_t *model, void *memory, size_t size);

/* A sample of this size counts as saturated whatever the range, 2^40. Below it no sum can overflow (intake.c). */
#define SELFCAL_SAMPLE_MAX 1.099511627776e12F

/* Take one sample of every axis, in the model's order and units.
 * A value that is not finite, at the range limit or stuck keeps the whole sample out, because the axes share gains.
 * Time then passes as with selfcal_skip(). O(axes), and a batch of all axes for SELFCAL_PUSH_NODES nodes, or for 2
 * nodes / (block SELFCAL_BATCH) if that is more.
 *
 * Retirement: an axis at fault in more than half of a bank interval's samples spoils the interval for all. After
 * SELFCAL_RETIRE_BLOCKS such intervals in a row it is retired. The others go on exactly as if the model did not have
 * it. Its values are looked at for the fault counters only; its reports and node views say SELFCAL_AXIS_RETIRED. It
 * stays retired until selfcal_init(). A sample in which every axis fails counts for nobody, and the last axis is never
 * retired: a sensor that is unplugged and back goes on after a gap. Intervals are counted in samples pushed, so missing
 * ones neither help nor harm an axis. */
selfcal_status_t selfcal_push(selfcal_t *self, const float sample[]);

/* The same with the values of the model's regressors, in its order. They are averaged over a block as the samples are.
 * A value that is not finite, or at SELFCAL_SAMPLE_MAX, keeps the sample out. A model with regressors takes this call
 * only (else SELFCAL_BAD_ARGUMENT); one without does not look at `regressors`. Per node O(count^2 + axes count)
 * more. */
selfcal_status_t selfcal_push_with(selfcal_t *self, const float sample[], const float regressors[]);

/* True once an axis is retired. */
bool selfcal_retired(const selfcal_t *self, uint8_t axis);

/* `count` samples are missing. The prediction over the gap is exact for up to 2^32 - 1 bank intervals (136 years at 1
 * Hz); a longer gap is taken for that. A block with half or more of its samples counts as their mean, its variance
 * raised by block / used. A block with fewer is dropped. Before the first sample they are counted alone: the first
 * block begins with the first sample. */
selfcal_status_t selfcal_skip(selfcal_t *self, uint64_t count);

/* Motion was seen in the bank interval in progress. It yields no value, and samples until its end count as missing.
 * Nothing happens at the start of an interval. */
selfcal_status_t selfcal_moving(selfcal_t *self);

/* Take a sample that was measured in motion. Its faults count, and retire an axis, as with selfcal_push(); one without
 * faults counts as missing. Otherwise this is selfcal_moving() and selfcal_skip(1).
 * With the gate: every sample goes to selfcal_gate_push() first. If the gate said resting before this sample and says
 * so with it, the sample goes to selfcal_push(), else here. Until the bank has taken its first sample (counters'
 * `samples`), only the first sample of a window (the gate's `position` was 0) goes to selfcal_push(): bank intervals
 * begin there. Then no window of motion reaches back into a closed interval, provided that the block is a multiple of
 * the window. */
selfcal_status_t selfcal_push_moving(selfcal_t *self, const float sample[]);

/* The sampling rate changes: from now on `block` samples make a bank interval, whose length dt stays.
 * `variance_ratio`: white-noise variance of a whole block's mean over its value for the model's block and rate. It is 1
 * where the sensor's own averaging keeps the noise density, model->block / block where single samples stay as noisy.
 * The interval in progress yields no value and goes on to its end, its position scaled to the new block. sigma_v and N
 * remain those of the model's block. The likelihood is exact, but any ratio but 1 costs the full gain computation for
 * every sample. selfcal_within_sd() starts anew. SELFCAL_BAD_ARGUMENT, and nothing changes: a block of 0, or a ratio
 * beyond SELFCAL_VARIANCE_RATIO_MAX or below its inverse. */
#define SELFCAL_VARIANCE_RATIO_MAX 1024.0F
selfcal_status_t selfcal_rate(selfcal_t *self, uint32_t block, float variance_ratio);

/* From the next sample on the sensor itself adds `amount` (unit) to the readings of an axis, say because its offset
 * register was written with the bias. Everything known is kept, and the bias goes up by `amount`. The interval in
 * progress yields no value. Begin a report under way anew. SELFCAL_BAD_ARGUMENT, and nothing changes: no such axis, or
 * `amount` or the sum of all of them is not below SELFCAL_SAMPLE_MAX. Of a retired axis that sum alone is kept. */
selfcal_status_t selfcal_shift(selfcal_t *self, uint8_t axis, float amount);

/* The bias or the noise has changed. What is known of the laws and their parameters is kept; the bias of each axis
 * begins anew from what it is now. O(nodes axes), with logarithms: for rare events. Reports under way are given up
 * (SELFCAL_OVERTAKEN).
 * `at`: of each axis of the model the likeliest law and where it lies. `keep`: the part of what was learned of the
 * noise that is kept, above 0 to 1. `learned`: by selfcal_learned(), from before the change; NULL: there is none.
 * SELFCAL_BAD_ARGUMENT; SELFCAL_BAD_MODEL if the model handles nothing or has regressors; SELFCAL_TOO_SHORT. Method:
 * bank_reopen.c. */
typedef struct {
    uint8_t hypothesis;
    float ln_rho, ln_second; /* of its nodes; ln_second of alpha or the ratio */
    float sigma_v;           /* unit; where it is not above 0 the residuals tell it */
    float bias, bias_sd;     /* unit, of an axis with a step; else bias_sd is 0. Such an axis takes what was learned
                                before, since the readings after the step say something else. */
} selfcal_reopening_t;
selfcal_status_t selfcal_reopen(selfcal_t *self, const selfcal_reopening_t at[], float keep, const float learned[]);

/* What the bank knows of the noise and the drift now, for selfcal_reopen(): `learned` [nodes][axes]. O(nodes axes). */
void selfcal_learned(selfcal_t *self, float learned[]);

/* The following take a bank that selfcal_init() has prepared and an axis of its model. Anything else is a bug. */

/* Bank samples in the sums, those on their way into them included. */
uint32_t selfcal_count(const selfcal_t *self);

/* Bank samples that may still come before the nodes run on, which ends a report under way (SELFCAL_OVERTAKEN). */
uint32_t selfcal_room(const selfcal_t *self);

const selfcal_counters_t *selfcal_counters(const selfcal_t *self);

/* Standard deviation of samples about their block's mean, pooled, unit. NaN with a block of 1, before the first whole
 * block, and of a retired axis. White noise makes it sigma_v sqrt(block). More says coloured noise or vibration. */
float selfcal_within_sd(const selfcal_t *self, uint8_t axis);

/* Sum of the amounts given to selfcal_shift() for an axis, unit. A snapshot keeps it. */
float selfcal_shifted(const selfcal_t *self, uint8_t axis);

/* Offset (unit) that is taken off an axis before the filters: its first bank sample. */
selfcal_wide_t selfcal_offset(const selfcal_t *self, uint8_t axis);

/* Number format of one axis with SELFCAL_FIXED, and how far it is filled. Nothing ever saturates: the step grows. */
typedef struct {
    int16_t exponent;        /* step of y and drift now: 2^exponent unit */
    uint16_t coarser, finer; /* times the exponent has grown and shrunk */
    int32_t most_y;          /* greatest |y| at this exponent; beyond SELFCAL_FIXED_LIMIT the step grows */
    int32_t most_sum;        /* greatest of the sums C and |B| over 2^32; from 2^29 on the step grows */
} selfcal_scale_t;
#define SELFCAL_FIXED_LIMIT (3 * (1L << 25))
const selfcal_scale_t *selfcal_scale(const selfcal_t *self, uint8_t axis);

/* State of one node for one axis, for tests and tools. The call folds the batch first, hence it is not const. */
typedef struct {
    uint8_t hypothesis;
    selfcal_wide_t ln_rho, ln_alpha; /* the node; NaN where the law has none */
    selfcal_wide_t a, b, c, ln_s;    /* sums A, B, C about the offset, and D, see bank.c */
    selfcal_wide_t drift;            /* at the end of the last interval, if x0 were the offset */
    selfcal_wide_t bias_left;        /* change of x0 + drift at the end of the last interval per unit of x0 */
    selfcal_wide_t drift_var;        /* variance of the drift there, given x0, over sigma_v^2 */
} selfcal_node_view_t;
selfcal_status_t selfcal_node(selfcal_t *self, uint8_t axis, uint16_t index, selfcal_node_view_t *view);

/* Exact ln p(Y | node, sigma_v) of everything pushed on one axis, x0 integrated out; sigma_v in unit per interval. */
selfcal_status_t selfcal_log_likelihood(selfcal_t *self, uint8_t axis, uint16_t node, selfcal_wide_t sigma_v,
                                        selfcal_wide_t *ln_p);

/* The same with the regressors of `mask` in use, a bit each. SELFCAL_BAD_ARGUMENT if the axis does not have them
 * all. */
selfcal_status_t selfcal_log_likelihood_subset(selfcal_t *self, uint8_t axis, uint16_t node, uint8_t mask,
                                               selfcal_wide_t sigma_v, selfcal_wide_t *ln_p);

/* Whether pushes and skips can have made the bank: pointers, places within their arrays, counts that fit each other,
 * sums finite and of the right sign. SELFCAL_CORRUPT: memory was overwritten, by a bug or by a fault; nothing but
 * selfcal_init() or selfcal_restore() should follow. SELFCAL_BAD_ARGUMENT on NULL. O(nodes axes), no logarithm, no
 * division. */
selfcal_status_t selfcal_check(const selfcal_t *self);

/* ------------------------------------------------------------------------------------------ values of regressors
 * For a model whose regressors name their sources. The host's tools form the columns of a recording by the same
 * code. */

/* The windows of a model's columns, in selfcal_layout.h. */
typedef struct selfcal_former selfcal_former_t;

/* Begin at the first sample.
 * SELFCAL_BAD_ARGUMENT: null pointer, or regressors without sources. SELFCAL_BAD_MODEL: a source that cannot be
 * formed. */
selfcal_status_t selfcal_former_init(selfcal_former_t *self, const selfcal_model_t *model);

/* Values of all regressors at a sample that follows `missing` absent ones, for selfcal_push_with().
 * `channels`: the values beside the readings, as the sources count them; NULL if there are none.
 * A channel that is not finite gives a value that is not finite. The bank keeps that sample out and counts it. */
void selfcal_form(selfcal_former_t *self, uint32_t missing, const float sample[], const float channels[],
                  float values[]);

/* Value of regressor k at the last bank sample that the sums hold: where the bias of a report with it in use stands. */
float selfcal_regressor_last(const selfcal_t *self, uint8_t k);

/* selfcal_former_init() where the bank has got to, as after selfcal_restore(). Times, lines and turn-ons go on. A lag
 * goes on from its value at the bank's last sample; meanwhile the channel is taken to have had its next value. A window
 * begins anew. SELFCAL_BAD_ARGUMENT, SELFCAL_BAD_MODEL: as selfcal_former_init(). */
selfcal_status_t selfcal_former_resume(selfcal_former_t *self, const selfcal_t *bank);

/* The part was powered on `samples` before the next sample; without this, at the first of all. A snapshot has it.
 * Call it before selfcal_former_resume(): at a start where power came on, with 0, or a recording that begins later.
 * SELFCAL_BAD_ARGUMENT on NULL. */
selfcal_status_t selfcal_power_on(selfcal_t *self, uint64_t samples);

/* --------------------------------------------------------------------------------------------------------- snapshot
 * Everything a bank knows as a stream of bytes (format in snapshot.c), with a version and a CRC-32. A bank saved and
 * restored goes on bit for bit like one that was never stopped, whatever was under way: a block, a batch, a gap. A
 * snapshot belongs to its model and its build. A report under way and telemetry are not part of it. */

/* Take the next `count` bytes, `context` as given to selfcal_save(). false: the medium failed, nothing more is
 * written. */
typedef bool (*selfcal_write_t)(void *context, const void *bytes, size_t count);

/* selfcal_save() writes this many bytes at a time, and the rest at last. */
#define SELFCAL_SNAPSHOT_CHUNK 64U

/* Bytes selfcal_save() writes; the same at any time of a bank's life. 0 on NULL. For a slot or buffer that the compiler
 * lays out, SELFCAL_SNAPSHOT_MAX(SELFCAL_MODEL_BYTES) is a bound. */
size_t selfcal_snapshot_size(const selfcal_t *self);

/* Write the bank. It is not changed, and not flushed. SELFCAL_WRITE_FAILED. SELFCAL_CORRUPT if selfcal_check() fails:
 * nothing is written, so that the last good snapshot stays. SELFCAL_BAD_ARGUMENT on NULL. */
selfcal_status_t selfcal_save(const selfcal_t *self, selfcal_write_t write, void *context);

/* selfcal_init(), then the state that `snapshot` holds: `length` bytes, aligned or not, all of them and no more.
 * `model` must be the saved bank's, known by its id, axes and nodes; the build must have the same configuration.
 * Refused with one of SELFCAL_SNAPSHOT_..., SELFCAL_BAD_ARGUMENT, SELFCAL_BAD_MODEL or SELFCAL_BAD_MEMORY: `self` and
 * `memory` are as they were. SELFCAL_CORRUPT (the checksum fits contents that no bank can have): `self` is as
 * selfcal_init() leaves it, without a sample. O(nodes axes). */
selfcal_status_t selfcal_restore(selfcal_t *self, const selfcal_model_t *model, void *memory, size_t size,
                                 const void *snapshot, size_t length);

/* ----------------------------------------------------------------------------------------------------------- report */

/* Bank samples below which no report is made. */
#define SELFCAL_REPORT_MIN 3

enum {
    SELFCAL_IDENTIFIED = 1, /* sd of ln(parameter) is below half its prior's, or this is measured; no limit holds it */
    SELFCAL_AT_MIN = 2,     /* more than 5 % of the posterior lies in the lowest 2 % of the prior's ln range */
    SELFCAL_AT_MAX = 4,     /* likewise at the top */
    /* The node grid does not support this estimate: treat it as rough.
     * Set if more than 1 % of the posterior lies beyond the outermost node, or if interpolation between nodes may be
     * wrong by more than 0.05 nat (evidence), 0.05 sd (mean) or 3 % (sd).
     * The second condition is a conservative bound. It grows with the length of the record, with scattered gaps, and
     * with changes of rate. Without a Gauss-Markov law in the model it does not see a record that no random walk makes.
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
    selfcal_wide_t ln_evidence; /* nats, density of the bank samples in 1/unit each */
    selfcal_estimate_t parameter[SELFCAL_PARAMETERS]; /* those its law has; the others are NaN with flags 0 */
    float bias_mean, bias_sd;   /* x0 + drift now (+ c' z with regressors) under this hypothesis, unit */
    selfcal_decay_t decay[SELFCAL_ALPHA_MAX]; /* where a term decays; else 0 */
} selfcal_posterior_t;

typedef struct {
    uint8_t axis;
    uint32_t n;               /* bank samples it rests on, forgotten ones among them */
    float bias_mean, bias_sd; /* x0 + drift at the last interval, over all hypotheses, unit. NaN, as all probabilities,
                                 where the record lies outside the priors */
    selfcal_posterior_t hypothesis[SELFCAL_HYPOTHESES_MAX];
} selfcal_report_t;

/* Coefficients of the regressors under one hypothesis, unit per unit of each; NaN for those not in use. */
typedef struct {
    float mean[SELFCAL_REGRESSORS_MAX], sd[SELFCAL_REGRESSORS_MAX];
    selfcal_wide_t moment[3][SELFCAL_REGRESSORS_MAX]; /* under way */
} selfcal_coefficients_t;

/* Scratch of a report under way. All axes may share it. `gathered` may be read: samples from now on come later than the
 * report. */
typedef struct selfcal_work selfcal_work_t;

/* Start a report on one axis. SELFCAL_TOO_SHORT if there are too few samples. Of a bank that forgets, the first step
 * that looks at its sums says so too. A report that does not begin leaves its axis in `report` and no number of
 * another: the bias is NaN, probabilities are 0. */
selfcal_status_t selfcal_report_begin(selfcal_work_t *work, selfcal_t *self, uint8_t axis, selfcal_report_t *report);

/* The same with the regressors of `mask` in use, a bit each: one subset, whose ln_evidence compares with the others'.
 * Bias then means x0 + c' z + drift with z of the last bank sample. `coefficients`: room for one a hypothesis, or NULL.
 * SELFCAL_BAD_ARGUMENT also if the axis does not have them all. SELFCAL_TOO_SHORT with fewer than SELFCAL_REPORT_MIN
 * samples and one more for each. */
selfcal_status_t selfcal_report_begin_subset(selfcal_work_t *work, selfcal_t *self, uint8_t axis, uint8_t mask,
                                             selfcal_coefficients_t coefficients[], selfcal_report_t *report);

/* Take one step, below 61 000 instructions on a Cortex-M4F; with regressors in use, one node's least squares.
 * SELFCAL_BUSY while there is more to do, SELFCAL_OK when `report` is whole. A report first runs the nodes over the
 * gathered samples. Then the sums must rest: after SELFCAL_BATCH further bank samples, or fewer and a call that looks
 * at the sums, it is SELFCAL_OVERTAKEN; begin anew. After either end there is no report under way:
 * SELFCAL_BAD_ARGUMENT. */
selfcal_status_t selfcal_report_step(selfcal_work_t *work, selfcal_report_t *report);

/* All steps in a row. */
selfcal_status_t selfcal_report(selfcal_work_t *work, selfcal_t *self, uint8_t axis, selfcal_report_t *report);

/* Bias of the report's axis and its standard deviation, `elapsed_s` after the last bank interval that the report rests
 * on (missing ones included), over all hypotheses, in the axis's unit. A reading less `bias` is the corrected reading,
 * at rest or moving. Under the constant law the bias stays. Under the random walk its variance grows by E(K^2) per
 * second. A Gauss-Markov term decays towards 0 and its variance grows to sigma_m^2. NaN where the report's own are.
 * `model` is the bank's. SELFCAL_BAD_ARGUMENT: null pointer, elapsed_s negative or not finite. O(alpha nodes). */
selfcal_status_t selfcal_predict(const selfcal_report_t *report, const selfcal_model_t *model, float elapsed_s,
                                 float *bias, float *sd);

/* -------------------------------------------------------------------------------------------------------- adequacy
 * Whether the model of the last report explains the readings after it. Optional: a program that does not name these
 * functions pays nothing for them. Method: adequacy.c.
 *
 *     selfcal_adequacy_init(&adequacy, &bank);
 *     each sample:  selfcal_push(...); selfcal_adequacy_push(&adequacy, &bank, channels, NULL);
 *     each report:  selfcal_adequacy_report(&adequacy, &model, &report, NULL);
 *     at any time:  selfcal_judgement(&adequacy, &bank, axis).state
 */

/* An epoch, bank samples. At its end each axis is judged. */
#define SELFCAL_EPOCH_MIN 256U
#define SELFCAL_EPOCH_MAX 4096U
/* Scores beyond these make a model inadequate. One false flag in 1000 h over six axes at 1 Hz: tests/README.md. */
#define SELFCAL_ADEQUACY_LIMIT 5.0F
#define SELFCAL_ADEQUACY_LIMIT_EARLY 8.0F /* of ramp, colored_noise and flicker over fewer bank samples than that: */
#define SELFCAL_ADEQUACY_EARLY 1024U
#define SELFCAL_ADEQUACY_LIMIT_VARIANCE 6.0F
#define SELFCAL_ADEQUACY_LIMIT_KURTOSIS 13.0F

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
    SELFCAL_SUSPECT_STEP = 9, /* this and motion: of a selfcal_change_t alone */
    SELFCAL_SUSPECT_MOTION = 10
} selfcal_suspect_t;

/* Why an axis is not judged, has no corrected sample, or has a calibration that is not to be relied on. */
typedef enum {
    SELFCAL_REASON_NONE = 0,
    SELFCAL_REASON_FIRST_EPOCH = 1,     /* not judged: still under way */
    SELFCAL_REASON_NO_REPORT = 2,       /* none yet */
    SELFCAL_REASON_LAW_NOT_WATCHED = 3, /* not judged: the likeliest law has coloured noise */
    SELFCAL_REASON_RETIRED = 4,
    SELFCAL_REASON_OUTSIDE_PRIORS = 5,  /* the report has no numbers */
    SELFCAL_REASON_MOVING = 6,          /* no report yet, and the gate sees motion */
    SELFCAL_REASON_INADEQUATE = 7,      /* the model does not explain the readings */
    SELFCAL_REASON_NOT_IDENTIFIED = 8,  /* half of the probability has an N or a drift that is not */
    SELFCAL_REASON_BAD_SAMPLE = 9,      /* on some axis it is not finite or saturated */
    SELFCAL_REASON_STUCK = 10           /* the axis repeats one reading */
} selfcal_reason_t;

/* A change that was found while the samples came. */
typedef struct {
    selfcal_suspect_t cause; /* STEP; MOTION: several axes stepped at once; VARIANCE_CHANGE */
    float size;              /* of a step, unit; of a change of variance, the noise over that before */
    float ago_s;             /* since its onset */
} selfcal_change_t;

/* Why the calibration in a report is not to be relied on. `state`: of the axis's last judgement.
 * The first that applies of SELFCAL_REASON_OUTSIDE_PRIORS, _INADEQUATE, _NOT_IDENTIFIED and _NONE. */
selfcal_reason_t selfcal_reason(const selfcal_model_t *model, const selfcal_report_t *report,
                                selfcal_adequacy_state_t state);

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

typedef struct selfcal_adequacy selfcal_adequacy_t;

/* Begin; after selfcal_init() and selfcal_restore() of the bank. */
selfcal_status_t selfcal_adequacy_init(selfcal_adequacy_t *self, const selfcal_t *bank);

/* After each selfcal_push() or selfcal_push_with(). `channels`: temperature and supply. For a value that is not finite
 * the one before stands. NULL: neither is known. `values`: of the regressors; NULL without any. O(axes^2) at an
 * interval's end. */
void selfcal_adequacy_push(selfcal_adequacy_t *self, const selfcal_t *bank, const float channels[],
                           const float values[]);

/* After each report. `coefficient`: of each regressor in use, 0 of the others; NULL: none is in use. */
void selfcal_adequacy_report(selfcal_adequacy_t *self, const selfcal_model_t *model, const selfcal_report_t *report,
                             const float coefficient[]);

/* The judgement of the last epoch, and the last change. */
selfcal_judgement_t selfcal_judgement(const selfcal_adequacy_t *self, const selfcal_t *bank, uint8_t axis);

/* --------------------------------------------------------------------------------------------------------- changes
 * Steps of the bias and changes of the noise, found while the samples come, for a model whose `handling` says so.
 * Method, false-alarm rates and delays: changes.c.
 *
 *     selfcal_changes_init(&changes, &adequacy, &bank, learned);
 *     each sample, after selfcal_adequacy_push():
 *         if (selfcal_changes_handle(&adequacy, &bank) != 0) { ask for a report; selfcal_judgement() has the changes }
 */

typedef struct selfcal_changes selfcal_changes_t;

/* After selfcal_adequacy_init(). `learned`: memory for [nodes][axes], which must outlive the use. SELFCAL_BAD_ARGUMENT
 * on a null pointer. SELFCAL_BAD_MODEL if the model handles neither. */
selfcal_status_t selfcal_changes_init(selfcal_changes_t *self, selfcal_adequacy_t *adequacy, const selfcal_t *bank,
                                      float learned[]);

/* Call it after each sample; from time to time it keeps what was learned. Returns a bit for each axis that has changed.
 * Then the bank has been reopened (selfcal_reopen()): after a step the bias of such an axis is learned anew; after a
 * change of variance all noise learned before it is forgotten. */
uint32_t selfcal_changes_handle(selfcal_adequacy_t *adequacy, selfcal_t *bank);

/* ------------------------------------------------------------------------------------------------------------- gate
 * Does the sensor rest? A likelihood-ratio test over windows of samples of any axes (gyros, accelerometers, or both).
 * gate.c states the hypotheses, the statistics and their distributions. Independent of selfcal_t. */

typedef enum { SELFCAL_MOVING = 0, SELFCAL_RESTING = 1 } selfcal_motion_t;

/* Of its members may be read: state, counters, position (samples passed of this window), t1 and t2 (the last window's
 * statistics), shaken_above, moved_above and rate_moved_above (their thresholds). */
typedef struct selfcal_gate selfcal_gate_t;

struct selfcal_gate_config {
    uint8_t axes;
    uint32_t window;   /* samples, 2 or more; a divisor of the bank's block, see selfcal_push_moving() */
    /* probability that a window of rest is taken for motion, up to 0.1; 0: never, to measure noise */
    float false_alarm;
    /* windows in a row, after a first one, that must be quiet and on one level before motion is over; 1 or more */
    uint32_t hold;
    /* likewise to take a new gyro level, or more noise, for rest; 0: never. Below `hold`: no effect */
    uint32_t settle;
    /* windows that the level at rest is averaged over, 1 or more. Over as many the bias must not drift by more than the
     * noise of a window's mean. */
    uint32_t memory;
    /* noise of one sample at rest: N sqrt(sampling rate); INFINITY leaves the axis out */
    float sigma[SELFCAL_AXES_MAX];
    bool is_rate[SELFCAL_AXES_MAX]; /* a gyro: after a motion it must read what it read before. Others may rest at a new
                                       level. */
};

/* Noise of one axis at rest; the factors are 1 where it is white. */
typedef struct {
    float sigma;  /* of one sample, unit; INFINITY leaves the axis out (absent, retired) */
    float within; /* mean square about the window's mean over sigma^2 */
    float spread; /* variance of that mean square over its value for white noise */
    float level;  /* variance of a window's mean over sigma^2/window */
} selfcal_gate_noise_t;

/* Monotonic since selfcal_gate_init(). */
typedef struct {
    uint64_t windows;
    uint64_t shaken; /* windows that scatter too much */
    uint64_t moved;  /* windows off the level of the rest, or of the quiet windows, before */
    uint64_t blind;  /* windows with a sample that is no number (or at SELFCAL_SAMPLE_MAX), or less than half full */
    uint64_t alarms; /* times that rest ended by a shaken or moved window */
} selfcal_gate_counters_t;

/* Starts as moving. SELFCAL_BAD_ARGUMENT if the configuration is not as said above. */
selfcal_status_t selfcal_gate_init(selfcal_gate_t *gate, const selfcal_gate_config_t *config);

/* Take one sample of every axis; return the state.
 * The state changes at the end of a window, so it is at most one window late. A non-finite sample ends rest at once.
 *   RESTING -> MOVING   after one window that is shaken, moved or blind.
 *   MOVING -> RESTING after hold + 1 quiet windows in a row on one level. Gyros must also have returned to the level of
 *                       the last rest. After blind windows, one quiet window on the level of the rest before is enough.
 * A gyro that stays off that level for `settle` windows is believed to have a new bias, for a rotation at a constant
 * rate is nothing else to a gyro. So is noise that has grown, up to the noise that the gate started from. Blind windows
 * do not count in a row and do not end one. A false alarm costs hold + 2 windows.
 * O(axes). Thresholds are worked out in steps, one with each sample, below 10 000 instructions on a Cortex-M4F: up to
 * 60 steps from the start on, 30 from a change of noise on. At a window's end the missing ones are worked out there:
 * all of them where windows are shorter than that, and one, 70 000 instructions, for a window with missing samples. */
selfcal_motion_t selfcal_gate_push(selfcal_gate_t *gate, const float sample[]);

/* `count` samples are missing; windows keep their grid. A window with half or more of its samples is judged by them. */
selfcal_motion_t selfcal_gate_skip(selfcal_gate_t *gate, uint64_t count);

/* Take the noise of an axis from now on, say once N is identified. SELFCAL_BAD_ARGUMENT: null pointer, no such axis, a
 * value that is not above 0, or a factor that is infinite. */
selfcal_status_t selfcal_gate_noise(selfcal_gate_t *gate, uint8_t axis, const selfcal_gate_noise_t *noise);

/* The sensor itself adds `amount` (unit) to the readings of an axis from the next sample on, see selfcal_shift(): no
 * motion. An axis that the gate does not have, or an amount that is not finite, is a bug. */
void selfcal_gate_shift(selfcal_gate_t *gate, uint8_t axis, float amount);

/* The noise as measured over the whole windows of rest so far, for selfcal_gate_noise(). Run with false_alarm 0 while
 * the sensor is known to rest, and with the sigma that is to be used. Each factor's relative error is about
 * sqrt(2/windows). SELFCAL_TOO_SHORT below SELFCAL_GATE_MEASURED_MIN windows. */
#define SELFCAL_GATE_MEASURED_MIN 30U
selfcal_status_t selfcal_gate_measured(const selfcal_gate_t *gate, uint8_t axis, selfcal_gate_noise_t *noise);

/* -------------------------------------------------------------------------------------------------------- telemetry
 * Reports as classical CAN frames of 8 bytes with 11-bit identifiers. selfcal.dbc describes every item, with its unit
 * and bits. selfcal_frames.h and the decoders are made from the same source.
 * Each frame carries one value and its item number, a counter over all frames of the module, the module time in whole
 * seconds modulo 256, and a CRC-12.
 * A report's opening and end do not depend on the laws. Between them each hypothesis has a message of its own. It
 * carries up to three parameters by place: N; the drift parameter; the bandwidth or ratio. A place that the law lacks
 * is not sent. So any model of up to eight hypotheses fits, and the same law may stand twice.
 * Up to twelve modules share a bus: the node number moves all identifiers.
 * Frames must reach the wire in the order they are made (bxCAN: set TXFP). */

typedef struct {
    uint16_t id; /* 11 bits */
    uint8_t length;
    uint8_t data[8];
} selfcal_frame_t;

/* State of the module, for its status: finished once no sample will follow. */
typedef enum { SELFCAL_RUNNING, SELFCAL_FINISHED } selfcal_state_t;

/* A module's state beside the bank; meanings and codes as in selfcal.dbc. */
typedef struct {
    uint32_t reset_cause;
    uint32_t fault_address;
    uint32_t clock;
    uint32_t sensor_state;
    uint32_t sensor_fault;
    uint32_t sensor_fault_count;
    uint32_t sensor_diagnosis;
    uint32_t sensor_stale_count;
    uint32_t sensor_alarm_count;
    uint32_t sensor_damaged_count;
    uint32_t sensor_anomaly_count;
    uint32_t sensor_overrun_count;
    uint32_t frames_dropped;
    uint32_t bus_off_count;
    uint32_t state_found;
    uint32_t state_refused;
    uint32_t state_saves;
    uint32_t state_save_failures;
    uint32_t motion;
    uint32_t gate_alarm_count;
    uint32_t retired; /* a bit for each axis of the model */
    selfcal_reason_t reason[SELFCAL_AXES_MAX]; /* why an axis has no calibration to rely on */
    uint32_t command_count;
    uint32_t command_refused_count;
    /* of each axis of the model, unit: added by the sensor itself, see selfcal_shift() */
    float offset[SELFCAL_AXES_MAX];
} selfcal_module_t;

/* A corrected sample, by axis of the model, unit; sd NAN: there is none of this axis. */
typedef struct {
    float value[SELFCAL_AXES_MAX]; /* reading less bias, see selfcal_predict() */
    float sd[SELFCAL_AXES_MAX];    /* of that bias */
    uint32_t motion;               /* code as in selfcal.dbc */
    selfcal_reason_t reason[SELFCAL_AXES_MAX]; /* why there is none, or why it is not to be relied on */
} selfcal_corrected_t;

/* The coefficient of one regressor column, given that the column is in use, and the probability that it is. With a mean
 * of NaN nothing is known of the column, and nothing is sent. */
typedef struct {
    float mean, sd, probability;
} selfcal_sent_coefficient_t;

typedef struct selfcal_telemetry selfcal_telemetry_t;

/* `axis_name[]`: the name of each axis of the model, which chooses its message: gx gy gz (deg/s), ax ay az (m/s^2). The
 * model's units must be those. The node is 0. SELFCAL_BAD_ARGUMENT on a null pointer. SELFCAL_BAD_MODEL if a name has
 * no message or comes twice, or if the model has more than eight hypotheses. */
selfcal_status_t selfcal_telemetry_init(selfcal_telemetry_t *self, const selfcal_model_t *model,
                                        const char *const axis_name[]);

/* The module's number on its bus, 0 to 11, from here on. SELFCAL_BAD_ARGUMENT beyond. SELFCAL_BUSY, and nothing
 * changes, while frames are still to be fetched. */
selfcal_status_t selfcal_telemetry_node(selfcal_telemetry_t *self, uint8_t node);

/* Mean and sd of each column's coefficient over the laws of a report made with all of them in use. */
void selfcal_mix_coefficients(const selfcal_report_t *report, const selfcal_model_t *model,
                              const selfcal_coefficients_t coefficients[], float probability,
                              selfcal_sent_coefficient_t sent[]);

/* Coefficients for the following reports, by column of the model, on their axis. They must stay as the report must.
 * NULL, as at the start: none. */
void selfcal_telemetry_coefficients(selfcal_telemetry_t *self, const selfcal_sent_coefficient_t column[]);

/* The adequacy that goes with the next report; it must stay until the report is out. NULL: none is sent. */
void selfcal_telemetry_adequacy(selfcal_telemetry_t *self, const selfcal_judgement_t *judgement);

/* Sends one axis's report next: 7 frames, and of each hypothesis 3 and 5 for each of its parameters. The paper's three
 * laws take 46. Each coefficient takes 3 more. `time_ms`: module time since its start, modulo 2^32, later than that of
 * the axis's last report. `report` and `counters` must stay, the report unchanged, until selfcal_telemetry_next() says
 * false. SELFCAL_BUSY, and nothing changes, while frames are still to be fetched. */
selfcal_status_t selfcal_telemetry_report(selfcal_telemetry_t *self, const selfcal_report_t *report,
                                          const selfcal_counters_t *counters, uint32_t time_ms);

/* The module's state for the following statuses; it must stay. NULL: zeros. */
void selfcal_telemetry_module(selfcal_telemetry_t *self, const selfcal_module_t *module);

/* Sends the status next, 46 frames; otherwise as selfcal_telemetry_report(). */
selfcal_status_t selfcal_telemetry_status(selfcal_telemetry_t *self, const selfcal_counters_t *counters,
                                          selfcal_state_t state, uint32_t report_number, uint32_t time_ms);

/* Sends a corrected sample next, up to 14 frames; otherwise as selfcal_telemetry_report(). */
selfcal_status_t selfcal_telemetry_corrected(selfcal_telemetry_t *self, const selfcal_corrected_t *corrected,
                                             uint32_t time_ms);

/* Sends one item of the answer message next; otherwise as selfcal_telemetry_report(). SELFCAL_BAD_ARGUMENT also if
 * there is no such item. */
selfcal_status_t selfcal_telemetry_answer(selfcal_telemetry_t *self, uint8_t item, uint32_t value, uint32_t time_ms);

/* Makes the next frame; false when there is none. O(1). */
bool selfcal_telemetry_next(selfcal_telemetry_t *self, selfcal_frame_t *frame);

/* CRC-12/CDMA2000: polynomial 0xF13, initial value 0xFFF, most significant bit first. */
uint16_t selfcal_crc12(const uint8_t *data, size_t length);

/* ------------------------------------------------------------------------------------------------------------ pipe
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
 * must outlive the use. A gate that the model has watches from the first sample on. Fails as selfcal_init() does.
 * SELFCAL_BAD_MODEL also if the parts that the pipe names do not go together. */
selfcal_status_t selfcal_imu_init(selfcal_imu_t *imu, const selfcal_pipe_t *pipe, void *memory, size_t size);

/* From here on the last report of each axis is kept, for selfcal_imu_report() and selfcal_imu_corrected(). Without it
 * the last report of all. `kept` must outlive the use. */
typedef struct selfcal_kept selfcal_kept_t;
void selfcal_imu_keep(selfcal_imu_t *imu, selfcal_kept_t *kept);

/* The gate begins anew, or is off: every sample counts as one of rest. True if it watches. */
bool selfcal_imu_watch(selfcal_imu_t *imu, bool on);

/* Take one sample of every axis, in the model's order and units. `channels`: of the regressors, as their sources count
 * them; NULL without any. `side`: temperature and supply, for the judgement; NULL: neither is known.
 * Returns a bit for each axis that has changed, whose last report is of the past: ask for another. Beside them
 * SELFCAL_IMU_DEAR: the sample took as long as a slice of a report. Let the next slice wait. */
#define SELFCAL_IMU_DEAR 0x80000000UL
uint32_t selfcal_imu_sample(selfcal_imu_t *imu, const float reading[], const float channels[], const float side[]);

/* `count` samples are missing before the next one. */
void selfcal_imu_skip(selfcal_imu_t *imu, uint64_t count);

/* False while a report is worked out and one more sample might overtake it. Let the samples wait then. */
bool selfcal_imu_room(const selfcal_imu_t *imu);

/* Reports of these axes are due, a bit each. SELFCAL_BUSY: one of them has begun. Else why the last of them cannot be
 * made. */
#define SELFCAL_ALL_AXES 0xFFFFU
selfcal_status_t selfcal_imu_ask(selfcal_imu_t *imu, uint32_t axes);

/* Take one step of the reports that are due, as selfcal_report_step(). With regressors an axis takes two reports. The
 * likelier of both stands. SELFCAL_BUSY: there is more to do. SELFCAL_OK: there is not. Else the last report of all has
 * come to nothing, and there is no more to do. */
selfcal_status_t selfcal_imu_work(selfcal_imu_t *imu);

/* The last report of an axis, NULL: none yet, or a change has made it one of the past. It stays as it is until another
 * one of the axis (without selfcal_imu_keep(): of any axis) is worked on. */
const selfcal_report_t *selfcal_imu_report(const selfcal_imu_t *imu, uint8_t axis);

/* The judgement at that report; NULL: the model is not judged. */
const selfcal_judgement_t *selfcal_imu_judgement(const selfcal_imu_t *imu, uint8_t axis);

/* The coefficients at that report, by column; NULL: the model has no regressors. */
const selfcal_sent_coefficient_t *selfcal_imu_coefficients(const selfcal_imu_t *imu, uint8_t axis);

/* Why the calibration of an axis is not to be relied on now. */
selfcal_reason_t selfcal_imu_reason(const selfcal_imu_t *imu, uint8_t axis);

/* The bias of an axis's last report, unit. It goes with selfcal_imu_shift(). NAN: there is none. */
float selfcal_imu_bias(const selfcal_imu_t *imu, uint8_t axis);

/* Whether the sensor rests, by the code of selfcal.dbc. */
uint32_t selfcal_imu_motion(const selfcal_imu_t *imu);

/* The newest sample less the bias predicted for its time, with its sd and reason. False: no sample has come since the
 * last call, or selfcal_imu_keep() has not been called. O(alpha nodes axes). */
bool selfcal_imu_corrected(selfcal_imu_t *imu, selfcal_corrected_t *corrected);

/* As selfcal_shift(), with all that is known of the axis. Not while a report is worked out. */
selfcal_status_t selfcal_imu_shift(selfcal_imu_t *imu, uint8_t axis, float amount);

/* As selfcal_power_on(): before the first sample, or after selfcal_imu_restore(). */
selfcal_status_t selfcal_imu_power_on(selfcal_imu_t *imu, uint64_t samples);

/* All is forgotten but what the sensor adds (selfcal_imu_shift()). */
selfcal_status_t selfcal_imu_forget(selfcal_imu_t *imu);

/* As selfcal_save() and selfcal_restore(); the snapshot is of the bank alone. After a restore `gap` samples, and the
 * rest of a bank interval, are missing. */
selfcal_status_t selfcal_imu_save(const selfcal_imu_t *imu, selfcal_write_t write, void *context);
selfcal_status_t selfcal_imu_restore(selfcal_imu_t *imu, const void *snapshot, size_t length, uint64_t gap);

#include "selfcal_layout.h"

#ifdef __cplusplus
}
#endif

#endif
