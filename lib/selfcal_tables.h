/* The tables of a model, and the sizes of a build. All tables are const. `selfcal codegen` and the Python tools make
 * them from the same YAML file, so a product seldom writes one. selfcal.h includes this file. */
#ifndef SELFCAL_TABLES_H
#define SELFCAL_TABLES_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "selfcal_config.h"

#ifdef __cplusplus
extern "C" {
#endif

/* --- configuration ---
 * Three macros are left to a person; the compiler's command line or selfcal_config.h sets them.
 *   SELFCAL_ASSERT(condition)  what a bug does. As it is: nothing.
 *   SELFCAL_FIXED              defined: samples are processed in integers, for parts without an FPU. Gains, tables
 *                              and reports stay in float. Formats and head-room: bank_kernel_fixed.c.
 *   SELFCAL_REPORT_QUALITY     how finely a report integrates: 1 a module's, 2 a host's, 3 a reference's; 0 fuzzing.
 * selfcal_config.h has the sizes. `selfcal codegen` writes it. Whatever it sets may be set on the command line instead.
 *   SELFCAL_AXES_MAX              axes of a bank, 1 to 16. Six inertial axes share every gain.
 *   SELFCAL_HYPOTHESES_MAX        hypotheses of a model, 1 to 16
 *   SELFCAL_GRID_MAX              nodes of a grid dimension, SELFCAL_GRID_MIN to 64
 *   SELFCAL_ALPHA_MAX             nodes of alpha or of a ratio, SELFCAL_GRID_MIN to SELFCAL_GRID_MAX
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

/* --- model --- */

/* Limits of a model's numbers; selfcal_init() refuses others. The host's tools take them from here. */
#define SELFCAL_LN_LIMIT 46.0        /* ln of a parameter that a prior reaches, either way: 1e-20 to 1e20 */
#define SELFCAL_LOG_NORMAL_REACH 4.0 /* sd from the middle of a log-normal prior to its limits */
#define SELFCAL_FACTOR_MAX 1e3       /* factors of a deviation and a bandwidth; the least one is its inverse */
#define SELFCAL_RATIO_MAX 1e3        /* a law's ratio; the least one is its inverse */
#define SELFCAL_TIME_MAX 1e6         /* bank intervals of a stated correlation time, and of 1 / w of an oscillation */
#define SELFCAL_ALPHA_DT_MAX 6.9     /* correlation times in a bank interval, see averages.h */
#define SELFCAL_PERIOD_MIN 8.0       /* bank intervals in a period of an oscillation */
#define SELFCAL_DAMPING_MIN 1e-3     /* damping ratio of an oscillation */
#define SELFCAL_DAMPING_MAX 0.7
#define SELFCAL_GRID_MIN 6 /* nodes of a grid dimension: a quintic spline needs them */

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
typedef enum { SELFCAL_WALK = 0, SELFCAL_MARKOV = 1, SELFCAL_OSCILLATION = 2, SELFCAL_DAMPING = 3 } selfcal_term_kind_t;

typedef struct {
    selfcal_term_kind_t kind;
    float deviation; /* times the drift parameter: this term's K or sigma_m; to SELFCAL_FACTOR_MAX.
                        Beside a walk, a Gauss-Markov term has sigma_m = deviation K / sqrt(bandwidth),
                        and an oscillation's standard deviation is deviation K / sqrt(w). */
    float bandwidth; /* of a Gauss-Markov term: times alpha, to SELFCAL_FACTOR_MAX; if stated, 1/s. 0 of a walk */
    bool stated;     /* the model states the bandwidth. Always of an oscillation */
    bool by_ratio;   /* the law's ratio multiplies the deviation */
} selfcal_term_t;

/* A law of one plain term or of none takes the fast filters. Others are sums, see selfcal_law_is_sum().
 * Coloured: instead of v_i, (e_i + theta e_(i-1)) / (1 + theta) with e_i ~ N(0, sigma_v^2). N is then the density at
 * low frequency. The law's ratio is (1 + theta) / (1 - theta), its prior within SELFCAL_RATIO_MAX. */
#define SELFCAL_LAW_TERMS 3
typedef struct {
    uint8_t terms; /* those used; with coloured noise 1 or 2 */
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

/* Between two limits: uniform in the logarithm, or in the parameter itself, or normal in the logarithm. The mean of the
 * normal is the middle of the limits, which lie SELFCAL_LOG_NORMAL_REACH sd away: they hold all but 6e-5 of it. */
typedef enum { SELFCAL_LOG_UNIFORM = 0, SELFCAL_UNIFORM = 1, SELFCAL_LOG_NORMAL = 2 } selfcal_prior_law_t;

/* Proper prior of one parameter. */
typedef struct {
    float ln_min, ln_max; /* ln of the parameter in the units above, within SELFCAL_LN_LIMIT of 0 */
    selfcal_prior_law_t law;
    bool measured; /* the limits are those of an earlier record: the parameter counts as identified at once */
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
    uint8_t count;                         /* 1 to SELFCAL_REGRESSORS_MAX */
    const float *reference;                /* [count] value at which x0 alone is the bias */
    /* [axes][count] prior N(mean, sd^2), unit per unit of the regressor; sd 0: not for this axis; no means: all 0 */
    const float *coefficient_sd;
    const selfcal_source_t *source; /* [count] for selfcal_form(); NULL: the application makes the values by itself */
    const float *ln_odds;           /* [axes][count] ln of the prior odds that it is in use; a cosine: 0 */
    const float *coefficient_mean;  /* [axes][count] or NULL */
} selfcal_regressors_t;

/* For parts whose parameters change. Each bank sample's weight halves every half_life_s. So does the penalty that the
 * bias prior paid at the start of the record: otherwise a law that remembers the bias (constant) would be charged for
 * it for ever, and one that forgets it (random walk) would not. The bias and the coefficients forget as well. Reports
 * rest on about half_life_s / (0.69 dt_s) samples. If nothing has changed, intervals are sqrt(2) wider than necessary.
 * O(axes) for each node and batch. */
typedef struct {
    const selfcal_forgetting_code_t *code; /* &selfcal_forgetting_code */
    float half_life_s;                     /* at least SELFCAL_BATCH dt_s */
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
    uint32_t id;    /* checksum of the tables: a snapshot or a monitor tells models apart by it */
    float dt_s;     /* bank interval, 1e-6 to 1e6 */
    uint32_t block; /* samples averaged into one bank sample */
    uint8_t axes;
    uint8_t hypotheses;
    uint16_t nodes;                         /* of all hypotheses together */
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
typedef struct selfcal_holding_code selfcal_holding_code_t;
extern const selfcal_holding_code_t selfcal_holding_code;
typedef struct selfcal_tumbling_code selfcal_tumbling_code_t;
extern const selfcal_tumbling_code_t selfcal_tumbling_code;
typedef struct selfcal_tumbling selfcal_tumbling_t; /* tumble.h */
typedef struct selfcal_gate_config selfcal_gate_config_t;
typedef struct {
    const selfcal_model_t *model;
    float rate_hz;                         /* of the samples */
    const selfcal_gate_config_t *gate;     /* of gate_code */
    const selfcal_gate_code_t *gate_code;  /* keeps motion out */
    const selfcal_columns_code_t *columns; /* forms the values of the regressors: with them, and only then */
    const selfcal_judging_code_t *judging; /* judges the model */
    const selfcal_changes_code_t *changes; /* handles steps and changes of the noise; with judging */
    const selfcal_holding_code_t *holding; /* a report rests on a copy of its axis's sums: no sample overtakes it */
    const selfcal_tumbling_t *tumbling;    /* of tumbling_code */
    const selfcal_tumbling_code_t *tumbling_code; /* calibrates by rests in several positions; with a gate */
} selfcal_pipe_t;

#ifdef __cplusplus
}
#endif

#endif
