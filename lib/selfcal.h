/* selfcal: an inertial sensor at rest identifies its own error model.
 *
 * SCOPE
 *   A bank of Kalman filters, one per (hypothesis, grid node), runs over the readings of up to SELFCAL_AXES_MAX axes of a
 *   resting sensor. By Bayes' rule it gives the probability of each drift law, the noise parameters with intervals, and
 *   the bias with its uncertainty. One axis reads, at bank interval i,
 *       y_i = x0 + x_i + v_i,   x0 ~ N(0, P0),   v_i ~ N(0, sigma_v^2),
 *   with the drift x_i of a law (selfcal_law_t). Source of the method: Stepanov & Motorin, IFAC-PapersOnLine
 *   50-1 (2017) 2830-2835; equation numbers in this library are theirs.
 *
 * HOW TO INTEGRATE
 *   1. `selfcal codegen MODEL.yaml -o DIR` writes the model tables (const, for flash).
 *   2. Give selfcal_init() the model and SELFCAL_SIZE(nodes, axes) bytes; the memory stays yours, nothing is allocated.
 *   3. selfcal_push() every sample, selfcal_skip() every missing one. Cost is even: SELFCAL_BATCH bank samples are
 *      gathered, and while the next ones are, some nodes run over them at every push.
 *   4. When a report is wanted: selfcal_report_begin(), then selfcal_report_step() until it no longer says SELFCAL_BUSY.
 *      Samples may be pushed in between, as long as selfcal_room() says that there is room.
 *   Copy the folder lib/ into the product; it needs <string.h> and <math.h> only, and relies on exp, expm1, log, log1p and sqrt of
 *   either width being within 2 units in the last place (newlib's and glibc's are within 1.3).
 *
 * THREADS AND INTERRUPTS
 *   No global state. One selfcal_t belongs to one context at a time; the caller locks when two share it.
 *
 * UNITS
 *   The library knows one unit per axis, "unit" below: the model's (deg/s, m/s^2, ...). Samples come in it.
 *       N        white noise density        unit/sqrt(Hz)   two-sided; the Allan deviation at 1 s
 *       K        random-walk density        unit/s/sqrt(Hz) = unit/sqrt(s) of drift per second
 *       sigma_m  Gauss-Markov deviation     unit
 *       alpha    Gauss-Markov bandwidth     1/s            flicker: that of the middle term
 *       B        flicker coefficient        unit           Allan deviation 0.664 B on its plateau
 *       spectral_ratio                      1              white noise: amplitude at 0 Hz over that at 1/(2 dt)
 *       markov_ratio                        1              sigma_m over K sqrt(correlation time), of a Gauss-Markov drift beside a walk
 *   Per bank interval dt: sigma_v = N/sqrt(dt), random-walk step sigma_w = K*sqrt(dt).
 *
 * THREE KINDS OF TROUBLE
 *   Bad arguments: a status is returned, nothing changes. Run-time events (gap, saturation, not-a-number, stuck sample):
 *   counted in selfcal_counters_t, the sample is kept out of the sums. Bugs: SELFCAL_ASSERT.
 */
#ifndef SELFCAL_H
#define SELFCAL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define SELFCAL_VERSION "0.1.0"

/* ---------------------------------------------------------------------------------------------------- configuration
 * Every macro may be set on the compiler's command line. */

/* Axes one bank serves at most; six inertial axes share every gain. */
#ifndef SELFCAL_AXES_MAX
#define SELFCAL_AXES_MAX 6
#endif
#if SELFCAL_AXES_MAX < 1 || SELFCAL_AXES_MAX > 16
#error "SELFCAL_AXES_MAX must be 1 to 16"
#endif

/* Hypotheses one model holds at most. */
#ifndef SELFCAL_HYPOTHESES_MAX
#define SELFCAL_HYPOTHESES_MAX 4
#endif
#if SELFCAL_HYPOTHESES_MAX < 1 || SELFCAL_HYPOTHESES_MAX > 16
#error "SELFCAL_HYPOTHESES_MAX must be 1 to 16"
#endif

/* Bank samples gathered before the nodes run over them. More: fewer loads per sample and more time for a report, 56 bytes each. */
#ifndef SELFCAL_BATCH
#define SELFCAL_BATCH 16
#endif
#if SELFCAL_BATCH < 8 || SELFCAL_BATCH > 64
#error "SELFCAL_BATCH must be 8 (the first batch places the nodes) to 64"
#endif

/* Nodes that one sample runs at least while a batch waits; more if the batches would come faster than that. More: less overhead. */
#ifndef SELFCAL_PUSH_NODES
#define SELFCAL_PUSH_NODES 1
#endif
#if SELFCAL_PUSH_NODES < 1 || SELFCAL_PUSH_NODES > 65535
#error "SELFCAL_PUSH_NODES must be 1 to 65535"
#endif

/* Pushes from one such step to the next at most; fewer if the batches would come faster than that. For cores on which a node's batch
 * takes longer than a sample. */
#ifndef SELFCAL_PUSH_EVERY
#define SELFCAL_PUSH_EVERY 1
#endif
#if SELFCAL_PUSH_EVERY < 1 || SELFCAL_PUSH_EVERY > 256 || (SELFCAL_PUSH_EVERY & (SELFCAL_PUSH_EVERY - 1)) != 0
#error "SELFCAL_PUSH_EVERY must be a power of two up to 256"
#endif

/* Cells a dimension that a report integrates over, about where the likelihood counts. More of them where its peak is narrow in a wide range,
 * and under a law that is a sum. With 24, nine records in ten have evidence, mean and sd to 0.01 nat, 0.02 sd and 2 %, and quantiles to
 * 0.05 sd. Twice as many: up to four times the sums' part of the time. */
#ifndef SELFCAL_REPORT_CELLS
#define SELFCAL_REPORT_CELLS 80
#endif
#if SELFCAL_REPORT_CELLS < 16 || SELFCAL_REPORT_CELLS > 255
#error "SELFCAL_REPORT_CELLS must be 16 to 255"
#endif

/* Cells of sigma_v in those that a limit cuts, and bins of a parameter's histogram, which its quantiles are read from. */
#ifndef SELFCAL_SIGMA_CELLS
#define SELFCAL_SIGMA_CELLS 48
#endif
#ifndef SELFCAL_HISTOGRAM
#define SELFCAL_HISTOGRAM 128
#endif
#if SELFCAL_SIGMA_CELLS < 8 || SELFCAL_HISTOGRAM < 32
#error "SELFCAL_SIGMA_CELLS must be 8 and SELFCAL_HISTOGRAM 32 at least"
#endif

/* Most frequencies by which a report describes what the data's spectrum has beyond the likeliest filter's, to interpolate between nodes: even
 * in their logarithm, from 1/n to the highest, 0.45 nepers apart. Up to 0.55 they do for the reports' tolerances: 36 to 3 10^7 samples, 20 to
 * 5000. They take 6 LINES^2 bytes of a report's scratch. */
#ifndef SELFCAL_LINES
#define SELFCAL_LINES 36
#endif
#if SELFCAL_LINES < 8 || SELFCAL_LINES > 64 || SELFCAL_LINES % 2 != 0
#error "SELFCAL_LINES must be an even number, 8 to 64"
#endif

/* Nodes one grid dimension holds at most. */
#ifndef SELFCAL_GRID_MAX
#define SELFCAL_GRID_MAX 24
#endif
#if SELFCAL_GRID_MAX < 6 || SELFCAL_GRID_MAX > 64
#error "SELFCAL_GRID_MAX must be 6 (a quintic spline needs six) to 64"
#endif

/* Those of alpha, or of a sum's ratio: 16 bytes each in every hypothesis of a report, and 24 in its scratch. */
#ifndef SELFCAL_ALPHA_MAX
#define SELFCAL_ALPHA_MAX SELFCAL_GRID_MAX
#endif
#if SELFCAL_ALPHA_MAX < 6 || SELFCAL_ALPHA_MAX > SELFCAL_GRID_MAX
#error "SELFCAL_ALPHA_MAX must be 6 to SELFCAL_GRID_MAX"
#endif

/* Nodes one hypothesis holds at most: 16 bytes each in a report's scratch. */
#ifndef SELFCAL_HYPOTHESIS_NODES_MAX
#define SELFCAL_HYPOTHESIS_NODES_MAX (SELFCAL_GRID_MAX * SELFCAL_GRID_MAX)
#endif
#if SELFCAL_HYPOTHESIS_NODES_MAX < SELFCAL_GRID_MAX || SELFCAL_HYPOTHESIS_NODES_MAX > 65535
#error "SELFCAL_HYPOTHESIS_NODES_MAX must be SELFCAL_GRID_MAX to 65535"
#endif

/* Nodes of all hypotheses together at most: 12 bytes each in a report's scratch. */
#ifndef SELFCAL_NODES_MAX
#define SELFCAL_NODES_MAX (SELFCAL_HYPOTHESES_MAX * SELFCAL_HYPOTHESIS_NODES_MAX)
#endif
#if SELFCAL_NODES_MAX < SELFCAL_HYPOTHESIS_NODES_MAX || SELFCAL_NODES_MAX > 65535
#error "SELFCAL_NODES_MAX must be SELFCAL_HYPOTHESIS_NODES_MAX to 65535"
#endif

/* Bank intervals in a row that an axis may spoil before it is retired, see selfcal_push(); 0: no axis is ever retired. */
#ifndef SELFCAL_RETIRE_BLOCKS
#define SELFCAL_RETIRE_BLOCKS 60
#endif
#if SELFCAL_RETIRE_BLOCKS < 0
#error "SELFCAL_RETIRE_BLOCKS must be 0 or above"
#endif

/* Regressors one model holds at most (selfcal_regressors_t). Fewer: less stack in a report. */
#ifndef SELFCAL_REGRESSORS_MAX
#define SELFCAL_REGRESSORS_MAX 6
#endif
#if SELFCAL_REGRESSORS_MAX < 1 || SELFCAL_REGRESSORS_MAX > 6
#error "SELFCAL_REGRESSORS_MAX must be 1 to 6"
#endif

/* States of one law at most: 1 for the paper's laws, 3 for sums of terms and coloured noise (see selfcal_law_t).
 * To be set for the application too. With 1 the code of sums is compiled out, and models with them are refused. */
#ifndef SELFCAL_TERMS_MAX
#define SELFCAL_TERMS_MAX 1
#endif
#if SELFCAL_TERMS_MAX != 1 && SELFCAL_TERMS_MAX != 3
#error "SELFCAL_TERMS_MAX must be 1 or 3"
#endif
#define SELFCAL_TERM_PAIRS (SELFCAL_TERMS_MAX * (SELFCAL_TERMS_MAX + 1) / 2)

#ifndef SELFCAL_ASSERT
#define SELFCAL_ASSERT(condition) ((void)0)
#endif

/* State and per-sample arithmetic: float on a target. -DSELFCAL_REAL_DOUBLE builds the same code in double, which is how
 * the float build's own rounding is told from an error of method. */
#ifdef SELFCAL_REAL_DOUBLE
typedef double selfcal_real_t;
#else
typedef float selfcal_real_t;
#endif

/* Sums over the whole record: ln-likelihoods differ by (n/2) ln(ratio), which one float cannot carry beyond n = 10^4. The value
 * is hi + lo, twice the digits of selfcal_real_t by its own arithmetic (compilers must not reassociate: no -ffast-math). */
typedef struct {
    selfcal_real_t hi, lo;
} selfcal_sum_t;

/* The kernels, which do the work of each sample. Left alone: in selfcal_real_t. -DSELFCAL_FIXED=16 or =32 for parts without an
 * FPU: in integers, by 16-bit products (tested to 10^5 bank samples: probabilities within 5e-3, means within 0.05 posterior sd) or
 * by 32-bit ones (likewise to 10^6). Gains, tables and reports are the same. Formats and head-room: kernel_fixed.c. */
#ifdef SELFCAL_FIXED
#if SELFCAL_FIXED != 16 && SELFCAL_FIXED != 32
#error "SELFCAL_FIXED must be 16 or 32"
#endif
#if SELFCAL_BATCH > 16
#error "SELFCAL_FIXED has head-room for a SELFCAL_BATCH of 16"
#endif
#ifdef SELFCAL_REAL_DOUBLE
#error "SELFCAL_FIXED takes its gains from float"
#endif
#endif

/* -DSELFCAL_KERNEL_M4F: run a settled bank by assembly for the Cortex-M4F and its like, a quarter fewer instructions, the same bits. */

/* What a kernel keeps for each (node, axis): its predicted drift, and its sums. */
#ifdef SELFCAL_FIXED
typedef int32_t selfcal_drift_t;
typedef int64_t selfcal_total_t;
#else
typedef selfcal_real_t selfcal_drift_t;
typedef selfcal_sum_t selfcal_total_t;
#endif

/* Reports and ln-likelihoods. Deliberately double, in software where the FPU has none; never touched per sample. */
typedef double selfcal_wide_t;

/* ------------------------------------------------------------------------------------------------------------ model
 * All tables are const and made by `selfcal codegen` or by the Python tools from the same YAML file. */

/* A law is data: the terms of its drift, and the kind of its white noise.
 *   SELFCAL_WALK:   x_i = x_(i-1) + K sqrt(dt) w_i,  x_0 = 0                                             (23)
 *   SELFCAL_MARKOV: x_i = phi x_(i-1) + sigma_m sqrt(1 - phi^2) w_i,  phi = exp(-bandwidth dt), stationary
 * A law has at most three parameters: N, the drift parameter, and a second one.
 * The drift parameter is K if a term is a walk, else sigma_m (B for flicker).
 * The second one is alpha, which scales the bandwidths that are not stated, or a ratio. No law has both. */
typedef enum { SELFCAL_WALK = 0, SELFCAL_MARKOV = 1 } selfcal_term_kind_t;

typedef struct {
    selfcal_term_kind_t kind;
    float deviation; /* times the drift parameter: this term's K or sigma_m; 1e-3 to 1e3.
                        Beside a walk, a Gauss-Markov term has sigma_m = deviation K / sqrt(bandwidth). */
    float bandwidth; /* of a Gauss-Markov term: times alpha, 1e-3 to 1e3; if stated, 1/s. 0 of a walk */
    bool stated;     /* the model states the bandwidth: 1e-6 to 6.9 over dt_s */
    bool by_ratio;   /* the law's ratio multiplies the deviation */
} selfcal_term_t;

/* Laws of one plain term or none take the fast filters. Others need SELFCAL_TERMS_MAX of 3, see selfcal_law_is_sum().
 * Coloured: instead of v_i, (e_i + theta e_(i-1)) / (1 + theta) with e_i ~ N(0, sigma_v^2). N is then the density at low
 * frequency, and the law's ratio is (1 + theta) / (1 - theta), prior within 1e-3 to 1e3. */
#define SELFCAL_LAW_TERMS 3
typedef struct {
    uint8_t terms;       /* those used; with coloured noise 1 or 2 */
    bool coloured_noise;
    selfcal_term_t term[SELFCAL_LAW_TERMS];
} selfcal_law_t;

/* Whether the law needs the filters for several states: SELFCAL_TERMS_MAX of 3, and SELFCAL_TERMS_SIZE for its nodes. */
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
} selfcal_prior_t;

typedef struct {
    selfcal_prior_t prior[SELFCAL_PARAMETERS];
    float bias_sd;        /* sqrt(P0), unit */
    float range;          /* |sample| at or above it is saturated, unit; 0: no check */
    uint32_t stuck_limit; /* this many equal samples in a row are stuck; 0: no check */
} selfcal_axis_t;

/* One grid dimension: nodes at even steps of ln(value), joined by a quintic spline (not-a-knot: no knot at the two places next
 * to either end). Even steps make its matrix the same wherever the nodes lie. */
typedef struct {
    uint16_t nodes;
    const selfcal_real_t *fit; /* [nodes][nodes]: node values to B-spline coefficients */
} selfcal_grid_t;

/* Nodes of a hypothesis: all pairs of rho (outer) and alpha (inner). rho is the drift over the white noise per bank interval:
 * sigma_w / sigma_v, sigma_m / sigma_v or B / sigma_v. The alpha nodes span the priors; the rho nodes span the priors of K or sigma_m over
 * the white noise seen in the first SELFCAL_BATCH bank samples, with a margin of e^0.5 either way, of e^1.25 above sigma_m. A call that
 * looks at the sums sooner (a report, a node's) places them by what is there, for good: with fewer than 8 bank samples often not where
 * later ones need them. Where the nodes lie decides how well the likelihood is interpolated, not the prior. */
typedef struct {
    const selfcal_law_t *law;    /* one law may stand in several hypotheses, with other priors */
    float ln_probability;        /* prior */
    const selfcal_grid_t *rho;   /* NULL for a law without terms */
    const selfcal_grid_t *alpha; /* of alpha or of the ratio; NULL if the law has neither */
    const selfcal_prior_t *prior; /* [axes][SELFCAL_PARAMETERS] under this law; NULL: those of the axes */
} selfcal_hypothesis_t;

/* Where a regressor's value comes from, for selfcal_form(). Times count from the first sample. */
typedef enum {
    SELFCAL_COLUMN_TIME = 0,    /* s */
    SELFCAL_COLUMN_CHANNEL = 1, /* a channel; with a window its mean over that time up to the sample */
    SELFCAL_COLUMN_RATE = 2,    /* what a channel gained over the window, per second */
    SELFCAL_COLUMN_SINE = 3,    /* of a line */
    SELFCAL_COLUMN_COSINE = 4,
    SELFCAL_COLUMN_STEP = 5     /* 0, and 1 from a time on */
} selfcal_column_kind_t;

typedef struct {
    selfcal_column_kind_t kind;
    uint8_t channel; /* CHANNEL, RATE: an axis; from the model's `axes` on, a channel beside the readings */
    float number;    /* CHANNEL, RATE: window, s (CHANNEL: 0 for none); SINE, COSINE: frequency, Hz; STEP: time, s */
} selfcal_source_t;

typedef struct selfcal_regressors_code selfcal_regressors_code_t;
extern const selfcal_regressors_code_t selfcal_regressors_code;

/* Known disturbances z (time, temperature, its rate, supply, another axis, a sine and a cosine, a step): each adds a constant
 * coefficient times its value to every reading, and every subset of them is a hypothesis of its own. The values come with
 * the samples, selfcal_push_with(); their unit is the application's. With SELFCAL_FIXED the bank then runs in software
 * floating point. */
typedef struct {
    const selfcal_regressors_code_t *code; /* &selfcal_regressors_code: only a model with regressors links what they take */
    uint8_t count;               /* 1 to SELFCAL_REGRESSORS_MAX */
    const float *reference;      /* [count] value at which x0 alone is the bias */
    const float *coefficient_sd; /* [axes][count] prior N(0, sd^2), unit per unit of the regressor; 0: not for this axis */
    const selfcal_source_t *source; /* [count] for selfcal_form(); NULL: the application makes the values by itself */
    const float *ln_odds;           /* [count] ln of the prior odds that the regressor is in use; a cosine: 0 */
} selfcal_regressors_t;

typedef struct selfcal_forgetting_code selfcal_forgetting_code_t;
extern const selfcal_forgetting_code_t selfcal_forgetting_code;

/* For parts whose parameters change: what a bank sample adds to the ln-likelihood counts for 2^-(age/half_life_s), from one batch to the
 * next (a report ends a batch). What the prior of the bias (and of the coefficients) costs an evidence goes with the first batch: a law
 * that remembers the bias, such as the constant, must not go on paying what one that forgets it, such as the random walk, no longer
 * does. The bias and the coefficients are those of the record so weighted: they forget as well. Reports then rest on some
 * half_life_s/(dt_s ln 2) bank samples, and where the parameters stand still after all their intervals are up to sqrt(2) wider than
 * need be. O(axes) for each node and batch. */
typedef struct {
    const selfcal_forgetting_code_t *code; /* &selfcal_forgetting_code: only a model that forgets links what it takes */
    float half_life_s; /* at least SELFCAL_BATCH dt_s */
} selfcal_forgetting_t;

typedef struct {
    uint32_t id;        /* checksum of the tables: what a snapshot or a monitor tells models apart by */
    float dt_s;         /* bank interval, 1e-6 to 1e6 */
    uint32_t block;     /* samples averaged into one bank sample */
    uint8_t axes;
    uint8_t hypotheses;
    uint16_t nodes;     /* of all hypotheses together */
    const selfcal_axis_t *axis;             /* [axes] */
    const selfcal_hypothesis_t *hypothesis; /* [hypotheses] */
    const selfcal_regressors_t *regressors; /* NULL: none, and none of their cost */
    const selfcal_forgetting_t *forgetting; /* likewise */
} selfcal_model_t;

/* ------------------------------------------------------------------------------------------------------------- bank */

typedef enum {
    SELFCAL_OK = 0,
    SELFCAL_BUSY = 1,            /* a report has more steps to go */
    SELFCAL_TOO_SHORT = 2,       /* fewer bank samples than a report needs (SELFCAL_REPORT_MIN) */
    SELFCAL_OVERTAKEN = 3,       /* the sums have moved under a report, which is given up */
    SELFCAL_AXIS_RETIRED = 4,    /* the axis failed for SELFCAL_RETIRE_BLOCKS: it has no sums any more */
    SELFCAL_BAD_ARGUMENT = -1,   /* null pointer, axis or node out of range, sigma_v not positive */
    SELFCAL_BAD_MODEL = -2,      /* tables contradict themselves or exceed a configured maximum */
    SELFCAL_BAD_MEMORY = -3,     /* too small, or not aligned to 8 bytes */
    SELFCAL_WRITE_FAILED = -4,         /* the callback of selfcal_save() said so */
    SELFCAL_SNAPSHOT_TRUNCATED = -5,   /* fewer bytes than a snapshot says it has */
    SELFCAL_SNAPSHOT_TOO_LONG = -6,    /* more bytes than it says */
    SELFCAL_SNAPSHOT_DAMAGED = -7,     /* its checksum does not fit */
    SELFCAL_SNAPSHOT_FOREIGN = -8,     /* not a snapshot, or of another model or build */
    SELFCAL_SNAPSHOT_VERSION = -9,     /* of another format version */
    SELFCAL_CORRUPT = -10              /* an invariant is broken */
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
    uint32_t regressor_not_finite; /* samples kept out because a regressor's value was not finite or SELFCAL_SAMPLE_MAX */
} selfcal_counters_t;

/* How a filter's gains move, and what the integer kernels keep once they do not. Private, as is what follows. */
typedef struct {
    selfcal_real_t c; /* phi^2 / (1 + p_inf): contraction of d */
    selfcal_real_t d; /* predicted variance less p_inf; exactly 0 once converged */
    selfcal_real_t e; /* innovation of the regressor "1" at the next sample less u_inf */
} selfcal_moving_t;
typedef struct {
    int32_t g, u, w; /* phi K + beta, u/s and 1/s: each times 2^shift */
} selfcal_settled_t;

/* One filter: the gain side, shared by all axes because covariances do not depend on the data. Relative to sigma_v.
 * Here so that the caller can size it. */
typedef struct {
    selfcal_real_t beta;  /* 1 - phi */
    selfcal_real_t q;     /* drift variance added per interval */
    selfcal_real_t p_inf; /* predicted variance once converged */
    selfcal_real_t u_inf; /* innovation of the regressor "1" once settled */
    union {
        selfcal_moving_t moving;
#ifdef SELFCAL_FIXED
        selfcal_settled_t settled; /* of a level node instead: moving_of() */
#endif
    } gains;
    bool level; /* d = e = 0: the kernel sums plain nu */
#ifdef SELFCAL_FIXED
    uint8_t g_shift, u_shift, w_shift;
#endif
    uint32_t steady;      /* samples seen with d = 0: their ln s is added when asked for */
    uint32_t level_from;  /* steady when it became level: what later samples add to A is added when asked for */
    selfcal_sum_t a;      /* sum u^2 / s */
    selfcal_sum_t ln_s;   /* sum ln s of the other samples */
} selfcal_node_t;

#ifdef SELFCAL_FIXED
/* Number format of one axis and how far it has been filled. Nothing ever saturates: the step grows instead. */
typedef struct {
    int16_t exponent;        /* step of y and drift now: 2^exponent unit */
    uint16_t coarser, finer; /* times the exponent has grown and shrunk */
    int32_t most_y;          /* greatest |y| at this exponent; beyond SELFCAL_FIXED_LIMIT the step grows */
    int32_t most_sum;        /* greatest of the sums C and |B| at this exponent, over 2^32; from 2^29 on the step grows */
} selfcal_scale_t;

#define SELFCAL_FIXED_LIMIT (3 * (1L << 25))

/* A block's sums, about its first sample; formats in averager.c. Private. */
typedef struct {
    int64_t sum;      /* steps */
    int64_t sum_sq;   /* (2^shift steps)^2 */
    int32_t first;    /* the first sample, steps */
    int16_t exponent; /* a step is 2^exponent unit */
    uint8_t shift;
} selfcal_block_t;
#endif

/* Bytes of memory selfcal_init() needs: for each node 56, and 20 more per axis (check.c holds it to that). */
#define SELFCAL_SIZE(nodes, axes) \
    ((size_t)(nodes) * (sizeof(selfcal_node_t) + (size_t)(axes) * (2U * sizeof(selfcal_total_t) + sizeof(selfcal_drift_t))))

/* Bank samples on their way into the sums. Private. */
typedef struct {
    selfcal_real_t y[SELFCAL_AXES_MAX][SELFCAL_BATCH]; /* less offset */
    selfcal_real_t r[SELFCAL_BATCH]; /* white-noise variance of each over that of a whole block */
    uint32_t gap[SELFCAL_BATCH];     /* bank intervals without a sample before each */
    uint32_t gap_after;
    uint32_t count;
    bool part; /* some r is not 1 */
} selfcal_batch_t;
/* One regressor's front end. Private, as selfcal_columns_t; here for the caller's sizing. */
typedef struct {
    selfcal_real_t z[2][SELFCAL_BATCH];   /* beside the batches, less the first bank sample's value */
    selfcal_real_t last;                  /* of the last bank sample that the nodes run over */
    float origin, first;                  /* the first sample of all, and of this block */
    selfcal_real_t offset;                /* the first bank sample less origin */
    selfcal_real_t sum;                   /* of this block about its first */
} selfcal_column_t;

typedef struct {
    selfcal_column_t *column; /* [regressors] */
    selfcal_sum_t *a;    /* [nodes][rows]: for "1" and each regressor, sums of its innovation times those up to its own, over s */
    selfcal_sum_t *b;    /* [nodes][axes][regressors]: sum of its innovation times nu over s */
    selfcal_sum_t *x;    /* [nodes][1 + regressors]: predicted drift of the zero-bias filter over each column */
#ifdef SELFCAL_FIXED
    selfcal_sum_t *reading; /* [nodes][axes][3]: sums B of "1" and C, and x, of the readings: not in integers beside regressors */
#else
    selfcal_real_t *low; /* [nodes][axes]: low part of x of the readings */
#endif
} selfcal_columns_t;

/* Sums of the first p rows of A. */
#define SELFCAL_REGRESSORS_ROWS(p) ((size_t)(p) * ((size_t)(p) + 1U) / 2U)

#ifdef SELFCAL_FIXED
#define SELFCAL_REGRESSORS_READING (3U * sizeof(selfcal_sum_t))
#else
#define SELFCAL_REGRESSORS_READING sizeof(selfcal_real_t)
#endif

/* Bytes beyond SELFCAL_SIZE for p regressors, 0 for none. For each node in the float build 4 (p + 1) (p + 4), and per axis 8 p + 4;
 * 8 p + 24 in the fixed-point one. */
#define SELFCAL_REGRESSORS_SIZE(nodes, axes, p) \
    ((size_t)(p) == 0U ? (size_t)0U \
                       : 7U + sizeof(selfcal_columns_t) + (size_t)(p) * sizeof(selfcal_column_t) + \
                             (size_t)(nodes) * ((SELFCAL_REGRESSORS_ROWS((p) + 1U) + (size_t)(axes) * (p) + (size_t)(p) + 1U) * \
                                                    sizeof(selfcal_sum_t) + \
                                                (size_t)(axes) * SELFCAL_REGRESSORS_READING))

#if SELFCAL_TERMS_MAX > 1
/* The gain side of a node of a sum, relative to sigma_v; states are scaled so that the reading is their sum and white noise. Private, as
 * selfcal_terms_t. */
typedef struct {
    selfcal_wide_t p[SELFCAL_TERM_PAIRS]; /* predicted covariance of the states, lower half */
    selfcal_real_t beta[SELFCAL_TERMS_MAX], q[SELFCAL_TERMS_MAX];      /* 1 - pole, and variance added per interval, of each */
    selfcal_real_t theta;                                              /* of a moving average, whose part e_(i-1) is the last state */
    bool steady;                                                       /* p has converged */
} selfcal_term_node_t;

typedef struct {
    selfcal_term_node_t *node; /* [nodes of sums] */
    selfcal_sum_t *x;          /* [those][1 + regressors + axes][SELFCAL_TERMS_MAX]: predicted states over "1", the columns, the readings */
#ifdef SELFCAL_FIXED
    selfcal_sum_t *bc;         /* [those][axes][2]: sums B and C of the readings */
#endif
} selfcal_terms_t;

/* Bytes beyond SELFCAL_SIZE and SELFCAL_REGRESSORS_SIZE for a model with `nodes` nodes of sums, 0 for none. For each in the float build
 * 104 + 24 p, and per axis 24. */
#ifdef SELFCAL_FIXED
#define SELFCAL_TERMS_SUMS (SELFCAL_TERMS_MAX + 2U)
#else
#define SELFCAL_TERMS_SUMS SELFCAL_TERMS_MAX
#endif
#define SELFCAL_TERMS_SIZE(nodes, axes, p) \
    ((size_t)(nodes) == 0U ? (size_t)0U \
                           : 7U + sizeof(selfcal_terms_t) + \
                                 (size_t)(nodes) * (sizeof(selfcal_term_node_t) + \
                                                    (((size_t)(p) + 1U) * SELFCAL_TERMS_MAX + (size_t)(axes) * SELFCAL_TERMS_SUMS) * \
                                                        sizeof(selfcal_sum_t)))
#else
#define SELFCAL_TERMS_SIZE(nodes, axes, p) ((size_t)0U)
#endif

/* Private but for reading `position`, `used` and `block`; declared here so that the caller can place it. */
typedef struct {
    const selfcal_model_t *model;
#if SELFCAL_TERMS_MAX > 1
    selfcal_terms_t *terms;  /* of the sums; NULL: there are none */
#endif
    selfcal_columns_t *columns; /* of the regressors; NULL: there are none */
    selfcal_node_t *node;    /* [nodes] */
    selfcal_total_t *b, *c;  /* [nodes][axes]: sums u nu / s and nu^2 / s */
    selfcal_drift_t *x;      /* [nodes][axes]: predicted drift of the zero-bias filter */
    uint32_t n;              /* bank samples in all sums */
    selfcal_wide_t weight;   /* what they count for: n without forgetting */
    selfcal_wide_t keep;     /* part of the sums that is kept as the waiting batch comes, 1 without forgetting */
    selfcal_wide_t beginning; /* what the first batch counts for */
    selfcal_real_t rho_lo[SELFCAL_HYPOTHESES_MAX], rho_step[SELFCAL_HYPOTHESES_MAX];     /* ln of the nodes */
    selfcal_real_t alpha_lo[SELFCAL_HYPOTHESES_MAX], alpha_step[SELFCAL_HYPOTHESES_MAX];
    /* One batch is gathered while the nodes run, some at every push, over the one before. */
    selfcal_batch_t batch[2];
    uint8_t gathering;    /* which of them is gathered */
    uint16_t ran;         /* nodes that have run over the other */
    uint16_t push_nodes;  /* to run at a push */
    uint32_t pending_gap; /* bank intervals without a sample after the last one gathered */
    uint32_t batches;     /* that the nodes have begun with */
#ifdef SELFCAL_FIXED
    selfcal_scale_t scale[SELFCAL_AXES_MAX];
    /* Of the batch that the nodes run over: y, and what nu grows by before each sample and after the last, for one pole. */
    int32_t y_fixed[SELFCAL_AXES_MAX][SELFCAL_BATCH];
    int32_t step[SELFCAL_AXES_MAX][SELFCAL_BATCH + 1];
    uint32_t step_from, step_to; /* samples the steps are of; from == to: none */
    float step_beta;             /* ... and the pole */
    bool step_floored;
#endif
    /* averager */
    bool started;
    float origin[SELFCAL_AXES_MAX];          /* the first sample, unit */
    selfcal_real_t offset[SELFCAL_AXES_MAX]; /* the first bank sample less origin */
    uint32_t block;                          /* samples a bank interval now has */
    selfcal_real_t variance_ratio;           /* r of a whole block */
#ifdef SELFCAL_FIXED
    selfcal_block_t sums[SELFCAL_AXES_MAX];
#else
    float first[SELFCAL_AXES_MAX];           /* this block's first sample: its sums are taken about it */
    selfcal_real_t sum[SELFCAL_AXES_MAX], sum_sq[SELFCAL_AXES_MAX];
#endif
    uint32_t position, used; /* samples of this block: passed, and usable */
    bool dropped;            /* the rest of it counts for nothing */
    selfcal_wide_t within[SELFCAL_AXES_MAX]; /* sum of squares about the block means */
    uint64_t within_dof;
    float last[SELFCAL_AXES_MAX];
    uint32_t equal[SELFCAL_AXES_MAX];
    bool in_gap;
    float shifted[SELFCAL_AXES_MAX]; /* by selfcal_shift(), in all, unit */
    uint32_t retired;        /* a bit for each axis */
    uint32_t watched;        /* samples looked at since the axes were last judged ... */
    uint32_t bad[SELFCAL_AXES_MAX];        /* ... those of them with the axis at fault ... */
    uint32_t bad_blocks[SELFCAL_AXES_MAX]; /* ... and judgements in a row that went against it */
    selfcal_counters_t counters;
} selfcal_t;

/* Prepares `self` over `memory` (SELFCAL_SIZE + SELFCAL_REGRESSORS_SIZE + SELFCAL_TERMS_SIZE bytes, aligned to 8; both stay the caller's
 * and must outlive the use).
 * Fails with SELFCAL_BAD_ARGUMENT, SELFCAL_BAD_MODEL, SELFCAL_BAD_MEMORY; then `self` is unusable. */
selfcal_status_t selfcal_init(selfcal_t *self, const selfcal_model_t *model, void *memory, size_t size);

/* |sample| from here on counts as saturated whatever the range: the most for which no sum can overflow (averager.c), 2^40. */
#define SELFCAL_SAMPLE_MAX 1.099511627776e12F

/* One sample of every axis, in the model's axis order, in the model's units. A value that is not finite, at the range limit
 * or stuck keeps the whole sample out (the axes share gains) and time passes as with selfcal_skip(). O(axes), and SELFCAL_BATCH
 * bank samples of all axes for SELFCAL_PUSH_NODES nodes, or 2 nodes / (block * SELFCAL_BATCH) if that is more: the work is even.
 *
 * An axis that is at fault in more than half of a bank interval's samples spoils the interval for all. After
 * SELFCAL_RETIRE_BLOCKS such intervals in a row it is retired: the others go on without it, exactly as if the model did not have
 * it; its values are looked at for the fault counters only; its reports and node views say SELFCAL_AXIS_RETIRED. It stays so
 * until selfcal_init(), even if it comes back. Samples in which every axis fails count for nobody, and the last axis is never
 * retired: a sensor that is unplugged and back goes on after a gap. (Intervals are here counted in samples pushed: missing
 * ones neither help nor harm an axis.) */
selfcal_status_t selfcal_push(selfcal_t *self, const float sample[]);

/* The same with the values of the model's regressors, in its order; a value that is not finite, or at SELFCAL_SAMPLE_MAX,
 * keeps the sample out. Values are averaged over a block as the samples are. A model with regressors takes this call only (else
 * SELFCAL_BAD_ARGUMENT), one without does not look at `regressors`. Per node O(count^2 + axes * count) more. */
selfcal_status_t selfcal_push_with(selfcal_t *self, const float sample[], const float regressors[]);
/* True once an axis is retired. */
bool selfcal_retired(const selfcal_t *self, uint8_t axis);

/* `count` samples are missing. The prediction over the gap is exact for up to 2^32 - 1 bank intervals (136 years at 1 Hz); a
 * longer one is taken for that. A block with half or more of its samples counts as their mean with its variance raised by
 * block / used (a moving average's: that of its own e_i); one with fewer is dropped. Before the first sample they are counted alone: the
 * first block begins with it. */
selfcal_status_t selfcal_skip(selfcal_t *self, uint64_t count);

/* Motion was seen in the bank interval in progress: it yields no value, and what is pushed until its end counts as missing.
 * Nothing happens at the start of an interval. */
selfcal_status_t selfcal_moving(selfcal_t *self);

/* A sample taken in motion: it is looked at for faults, which count, and retire an axis, as with selfcal_push(); one without counts as
 * missing. For the rest as selfcal_moving() and selfcal_skip(1). With the gate, every sample goes to selfcal_gate_push() first; if
 * it said resting before this sample and says so with it, the sample goes to selfcal_push(), else it goes here. So it does until the
 * bank has taken its first one (counters' `samples`), unless it is the first of a window (the gate's `position` was 0): the bank's
 * intervals begin there. Then no window of motion reaches back into an interval that is already closed, provided that the block is a
 * multiple of the window. */
selfcal_status_t selfcal_push_moving(selfcal_t *self, const float sample[]);

/* The sampling rate changes: from now on `block` samples make a bank interval, whose length dt stays. The interval in progress
 * yields no value and goes on to its end: its position is scaled to the new block. `variance_ratio`: white-noise variance of a
 * whole block's mean over what it is for the model's block at the model's rate. It is 1 where the sensor's own averaging keeps the noise density, and model->block / block where single samples
 * stay as noisy as before. sigma_v and N remain those of the model's block: the likelihood is exact, though any ratio but 1
 * costs the full gain computation for every sample. SELFCAL_BAD_ARGUMENT, and nothing changes, on a block of 0 or a ratio beyond
 * SELFCAL_VARIANCE_RATIO_MAX or below its inverse. selfcal_within_sd() starts anew. */
#define SELFCAL_VARIANCE_RATIO_MAX 1024.0F
selfcal_status_t selfcal_rate(selfcal_t *self, uint32_t block, float variance_ratio);

/* From the next sample on the sensor itself adds `amount` (unit) to the readings of an axis, say because its offset register was
 * written with the bias. Everything known is kept, and the bias goes up by `amount`: only the origin of the sums and of the bias's
 * prior moves, to the last digits of a float. The interval in progress yields no value. Not while a report is under way: begin it anew.
 * SELFCAL_BAD_ARGUMENT, and nothing changes: no such axis, or `amount` or the sum of all of them is not below SELFCAL_SAMPLE_MAX. Of a
 * retired axis that sum alone is kept. */
selfcal_status_t selfcal_shift(selfcal_t *self, uint8_t axis, float amount);

/* The following take a bank that selfcal_init() has prepared and an axis of its model; anything else is a bug (SELFCAL_ASSERT). */

/* Bank samples in the sums, those on their way into them included. */
uint32_t selfcal_count(const selfcal_t *self);

/* Bank samples that may still come before the nodes have to run on, which ends a report under way (SELFCAL_OVERTAKEN). */
uint32_t selfcal_room(const selfcal_t *self);

const selfcal_counters_t *selfcal_counters(const selfcal_t *self);

/* Standard deviation of samples about their block's mean, pooled, unit; NaN with block == 1, before the first whole block, of a retired axis.
 * White noise would make it sigma_v * sqrt(block): more says coloured noise or vibration within the blocks. */
float selfcal_within_sd(const selfcal_t *self, uint8_t axis);

/* Sum of what selfcal_shift() has been told of an axis, unit; a snapshot keeps it, so that a sensor which has forgotten can be told. */
float selfcal_shifted(const selfcal_t *self, uint8_t axis);

/* Offset (unit) that is taken off an axis before the filters: its first bank sample. */
selfcal_wide_t selfcal_offset(const selfcal_t *self, uint8_t axis);

#ifdef SELFCAL_FIXED
/* Diagnostics of an axis's number format. */
const selfcal_scale_t *selfcal_scale(const selfcal_t *self, uint8_t axis);
#endif

/* What one node knows of one axis, for tests and tools; folds the batch first, hence not const. */
typedef struct {
    uint8_t hypothesis;
    selfcal_wide_t ln_rho, ln_alpha; /* the node; NaN where the law has none */
    selfcal_wide_t a, b, c, ln_s;      /* sums A, B, C about the offset, and D, see bank.c */
    selfcal_wide_t drift;     /* at the last interval, if x0 were the offset */
    selfcal_wide_t bias_left; /* change of x0 + drift at the last interval per unit of x0 */
    selfcal_wide_t drift_var; /* variance of the drift there, given x0, over sigma_v^2 */
} selfcal_node_view_t;
selfcal_status_t selfcal_node(selfcal_t *self, uint8_t axis, uint16_t index, selfcal_node_view_t *view);

/* Exact ln p(Y | node, sigma_v) of everything pushed on one axis, x0 integrated out; sigma_v in unit per bank interval. */
selfcal_status_t selfcal_log_likelihood(selfcal_t *self, uint8_t axis, uint16_t node, selfcal_wide_t sigma_v, selfcal_wide_t *ln_p);

/* The same with the regressors of `mask` in use, a bit each. SELFCAL_BAD_ARGUMENT if the axis does not have them all. */
selfcal_status_t selfcal_log_likelihood_subset(selfcal_t *self, uint8_t axis, uint16_t node, uint8_t mask,
                                               selfcal_wide_t sigma_v, selfcal_wide_t *ln_p);

/* Whether the bank can be what pushes and skips have made of it: pointers, places within their arrays, counts that fit each other,
 * sums finite and of the right sign. SELFCAL_CORRUPT: memory was overwritten, by a bug or by a fault; nothing but selfcal_init()
 * or selfcal_restore() should follow. SELFCAL_BAD_ARGUMENT on NULL. O(nodes * axes), no logarithm, no division. */
selfcal_status_t selfcal_check(const selfcal_t *self);

/* ------------------------------------------------------------------------------------------ values of regressors
 * For a model whose regressors name their sources. The host's tools form the columns of a recording by the same code. */

/* Bins that a window is held in. More: a finer edge of the window, 4 bytes each and column. */
#ifndef SELFCAL_COLUMN_BINS
#define SELFCAL_COLUMN_BINS 32U
#endif

/* Private; declared here so that the caller can place it. */
typedef struct {
    uint64_t step;        /* STEP: its sample; SINE, COSINE: 2^64 turns a sample */
    uint32_t window, bin; /* samples */
    uint32_t bins, in_bin;
    float ring[SELFCAL_COLUMN_BINS + 2U];
    float sum, first, last;
} selfcal_trail_t;

typedef struct {
    const selfcal_model_t *model;
    uint64_t samples; /* before the newest, missing ones too */
    bool begun;
    selfcal_trail_t trail[SELFCAL_REGRESSORS_MAX];
} selfcal_former_t;

/* Begin at the first sample.
 * SELFCAL_BAD_ARGUMENT: null pointer, or regressors without sources. SELFCAL_BAD_MODEL: a source that cannot be formed. */
selfcal_status_t selfcal_former_init(selfcal_former_t *self, const selfcal_model_t *model);

/* Values of all regressors at a sample that follows `missing` absent ones, for selfcal_push_with().
 * `channels`: the values beside the readings, as the sources count them; NULL if there are none.
 * A channel that is not finite gives a value that is not finite. The bank keeps that sample out and counts it. */
void selfcal_form(selfcal_former_t *self, uint32_t missing, const float sample[], const float channels[], float values[]);

/* Value of regressor k at the last bank sample that the sums hold: where the bias of a report with it in use stands. */
float selfcal_regressor_last(const selfcal_t *self, uint8_t k);

/* `samples` went by unseen before the next one. After a restart: the bank's counters `samples` plus `missing`.
 * Times and lines go on; a window begins anew. */
void selfcal_former_pass(selfcal_former_t *self, uint64_t samples);

/* --------------------------------------------------------------------------------------------------------- snapshot
 * Everything a bank knows as a stream of bytes, the same on every machine (little-endian; format in snapshot.c), with a version and
 * a CRC-32. A bank saved and restored goes on bit for bit like one that was never stopped, whatever was under way: a block, a
 * batch, a gap. Not part of it: a report under way, and telemetry. */

/* Takes the next `count` bytes, `context` as given to selfcal_save(). false: the medium failed, nothing more is written. */
typedef bool (*selfcal_write_t)(void *context, const void *bytes, size_t count);

/* selfcal_save() writes this many bytes at a time, and the rest at last. */
#define SELFCAL_SNAPSHOT_CHUNK 64U

/* No snapshot of a model without regressors and sums is longer, with them by no more than SELFCAL_REGRESSORS_SIZE and
 * SELFCAL_TERMS_SIZE: for a flash slot or a buffer laid out by the compiler. */
#define SELFCAL_SNAPSHOT_MAX(nodes, axes) (32U + sizeof(selfcal_t) + SELFCAL_SIZE(nodes, axes))

/* Bytes selfcal_save() writes; the same at any time of a bank's life. 0 on NULL. */
size_t selfcal_snapshot_size(const selfcal_t *self);

/* Writes the bank. It is not changed, and not flushed. SELFCAL_WRITE_FAILED; SELFCAL_CORRUPT if selfcal_check() fails: nothing is
 * written, so that the last good snapshot stays; SELFCAL_BAD_ARGUMENT on NULL. */
selfcal_status_t selfcal_save(const selfcal_t *self, selfcal_write_t write, void *context);

/* selfcal_init(), then the state that `snapshot` holds: `length` bytes, aligned or not, all of them and no more. `model` must be
 * that of the saved bank, known by its id, axes and nodes; the build must have the same selfcal_real_t and configuration.
 * Refused with one of SELFCAL_SNAPSHOT_..., SELFCAL_BAD_ARGUMENT, SELFCAL_BAD_MODEL or SELFCAL_BAD_MEMORY: `self` and `memory` are as
 * they were. SELFCAL_CORRUPT (the checksum fits what no bank can be): `self` is as selfcal_init() leaves it, without a sample.
 * O(nodes * axes). */
selfcal_status_t selfcal_restore(selfcal_t *self, const selfcal_model_t *model, void *memory, size_t size, const void *snapshot,
                                 size_t length);

/* ----------------------------------------------------------------------------------------------------------- report */

/* Bank samples below which no report is made. */
#define SELFCAL_REPORT_MIN 3

enum {
    SELFCAL_IDENTIFIED = 1,   /* sd of ln(parameter) is below half its prior's, and neither limit holds it */
    SELFCAL_AT_MIN = 2,       /* more than 5 % of the posterior lies in the lowest 2 % of the prior's ln range */
    SELFCAL_AT_MAX = 4,       /* likewise at the top */
    SELFCAL_OFF_GRID = 8      /* the grid does not bear it: more than 1 % of the posterior lies beyond the last node, or the nodes are so far apart
                                 that with a record so long, or with so much missing in so many places, or with rates so different, the
                                 interpolation may be off by more than 0.05 nat, 0.05 sd, 3 % of sd. A bound, not an
                                 estimate. Without a Gauss-Markov law in the model it does not see a record that holds what no random walk
                                 makes: give the walk 20 nodes there */
};

typedef struct {
    float mean, sd, median, q05, q95; /* units as above */
    uint8_t flags;
} selfcal_estimate_t;

/* How a decaying drift moves the bias, for selfcal_predict(). One entry for each node of alpha (or of the ratio).
 * Each term a of the law falls by psi_a = 1 - e^(-bandwidth_a t) in the time t after the report; a walk stays.
 * The bias's mean is then bias_mean - f, f = sum psi mean. Its variance is
 * bias_sd^2 + sum (psi var + sum over b psi_a psi_b var_sq) - f^2, the pair b <= a at a (a + 1)/2 + b. */
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
    float bias_mean, bias_sd;   /* x0 + drift now (+ c' z, see selfcal_report_begin_subset()), under this hypothesis, unit */
    selfcal_decay_t decay[SELFCAL_ALPHA_MAX]; /* where a term decays; else 0 */
} selfcal_posterior_t;

typedef struct {
    uint8_t axis;
    uint32_t n;                /* bank samples it rests on, forgotten ones among them */
    float bias_mean, bias_sd;  /* x0 + drift at the last interval, over all hypotheses, unit. NaN, as all
                                  probabilities, where the record lies outside the priors */
    selfcal_posterior_t hypothesis[SELFCAL_HYPOTHESES_MAX];
} selfcal_report_t;

/* Coefficients of the regressors under one hypothesis, unit per unit of each; NaN for those not in use. */
typedef struct {
    float mean[SELFCAL_REGRESSORS_MAX], sd[SELFCAL_REGRESSORS_MAX];
    selfcal_wide_t first[SELFCAL_REGRESSORS_MAX], second[SELFCAL_REGRESSORS_MAX], own[SELFCAL_REGRESSORS_MAX]; /* private */
} selfcal_coefficients_t;

#define SELFCAL_FITTED (SELFCAL_LINES + (SELFCAL_LINES + 2) / 3 * 2)
/* What a report supposes to have made the data, when it takes the expected likelihood off the one it interpolates. Private. */
typedef struct {
    selfcal_real_t ln_noise;       /* ln of the samples' noise, their geometric mean, over that of whole blocks at the model's rate */
    selfcal_real_t missed;         /* nats of a node's ln-likelihood, the most of all, that come of what is uneven in noise or time */
    selfcal_real_t variance, rate; /* of a first-order drift over that noise's variance; 1 - its pole */
    selfcal_wide_t ln_v;           /* expected variance of its own filter's innovations */
    bool wide;                     /* the record is so long that the expectation takes selfcal_wide_t */
    uint8_t lines;
    bool fitted, pair;             /* what the nodes show besides is known; there are nodes in two dimensions */
    /* That, of either sign: lines at frequencies omega, and behind them two of each two lines' band, edges and
     * level (see posterior.c). */
    selfcal_real_t distance[SELFCAL_LINES]; /* |1 - e^(i omega)|^2 */
    selfcal_real_t power[SELFCAL_FITTED];
} selfcal_truth_t;

/* Least squares for them by rotations: a triangle, row by row, its right side behind each. Private. */
#define SELFCAL_TRIANGLE (SELFCAL_FITTED * (SELFCAL_FITTED + 3) / 2)
typedef struct {
    selfcal_real_t triangle[SELFCAL_TRIANGLE], least;
    selfcal_real_t scatter[SELFCAL_NODES_MAX]; /* of every node, ln of the readings' scatter from the best node's */
} selfcal_fit_t;

/* Of the best node: variance of its residuals, the inverse, D; what the priors of the bias and the coefficients add. Private. */
typedef struct {
    selfcal_wide_t var, per_var, ln_s;
    selfcal_real_t cost, extra;
} selfcal_top_t;

/* One row of a report's cells: coefficients of the two splines in rho, alpha taken out. Private. */
typedef struct {
    selfcal_real_t profile[SELFCAL_GRID_MAX], ln_sigma[SELFCAL_GRID_MAX];
    selfcal_real_t basis[6]; /* of alpha */
    uint8_t basis_first;
    selfcal_real_t ln_alpha, beta, shift, half_ln_dt;
    const selfcal_prior_t *prior; /* of the hypothesis on the axis */
    selfcal_parameter_t drift;    /* which parameter goes with rho */
} selfcal_cell_row_t;

/* Where in ln rho or ln alpha the likelihood counts, and samples of one search pass. Private. */
#define SELFCAL_SEARCH_SAMPLES 8
typedef struct {
    selfcal_real_t lo, hi;
} selfcal_range_t;

/* Scratch of a report under way. Private but for reading `gathered`; may be shared by all axes and reused. */
typedef struct {
    selfcal_t *bank;
    uint8_t axis, hypothesis, stage, pass, rows;
    uint16_t first_node;
    uint16_t row, at; /* in the stage: row of cells; node, cell of the row, or parameter that is next */
    uint32_t batches; /* of the bank, when the sums came to rest */
    bool gathered;    /* the nodes run over the last batch: what is pushed now is later than the report */
    uint8_t mask, unknowns; /* regressors in use; those and the bias */
    selfcal_coefficients_t *coefficients; /* [hypotheses] or NULL */
    uint16_t best_node;      /* of all: the likeliest */
    selfcal_top_t top; /* ... whatever its law, and its ln var and ln-likelihood */
    selfcal_wide_t per_n, per_bias_sd, ln_top, top_profile;
    /* Of every node, of the profile ln-likelihood and of ln of sigma_v's conditional mode, from those of the best; then of the hypothesis in
     * hand less their expectation; then posterior means of the basis functions. */
    selfcal_real_t field[2][SELFCAL_NODES_MAX];
    selfcal_wide_t ln_sigma_off; /* there, of sigma_v's mode from its expectation */
    selfcal_truth_t truth;
    /* of the hypothesis in hand */
    selfcal_real_t peak;     /* of the nodes' profile ln-likelihood */
    selfcal_real_t n_eff;    /* bank samples less those that bias and coefficients took */
    /* what the priors permit of (ln rho, ln alpha); of these the row in hand, and the rows; what the last pass found */
    selfcal_real_t limit_lo[2], limit_hi[2];
    selfcal_range_t range[2];
    uint8_t least[2]; /* cells that its peak needs */
    selfcal_real_t row_best; /* ln-likelihood of the row in hand */
    selfcal_real_t depth; /* below the best at which no more counts */
    selfcal_real_t best, best_ln[SELFCAL_PARAMETERS];
    selfcal_real_t range_lo[SELFCAL_PARAMETERS], range_hi[SELFCAL_PARAMETERS]; /* ln of the parameters */
    selfcal_real_t sigma_mass, sigma_first, sigma_second; /* moments of sigma_v about its mode where no limit cuts it */
    /* sigma_v's offset in ln from its conditional mode: where it ends if no limit does; the first of the cells in hand, their width */
    selfcal_real_t delta_lo, delta_hi, delta_from, delta_width;
    selfcal_real_t drop[SELFCAL_HYPOTHESES_MAX]; /* of the ln-likelihood from that mode to the priors' limits, in each law's best cell */
    /* posterior sums */
    selfcal_wide_t mass, off_grid;
    selfcal_wide_t first[SELFCAL_PARAMETERS], second[SELFCAL_PARAMETERS];
    union {
        selfcal_fit_t fit; /* before the first hypothesis */
        struct {
            selfcal_real_t spline[2][SELFCAL_HYPOTHESIS_NODES_MAX]; /* B-spline coefficients; later weights of the nodes ... */
            /* ... as they are, and with sigma_v^2 over that of its conditional mode */
            selfcal_real_t histogram[SELFCAL_PARAMETERS][SELFCAL_HISTOGRAM + 2]; /* a mass that ends at the last bin's end reaches beyond it */
            /* of each sigma_v cell: the offset's exponential, less 1; the weight */
            selfcal_real_t delta_expm1[SELFCAL_SIGMA_CELLS], delta_weight[SELFCAL_SIGMA_CELLS];
            selfcal_range_t found[SELFCAL_SEARCH_SAMPLES]; /* the rows of the search, and how high they are, ln */
            selfcal_real_t height[SELFCAL_SEARCH_SAMPLES];
            uint8_t least[SELFCAL_SEARCH_SAMPLES];
            selfcal_real_t modes[2][SELFCAL_HISTOGRAM + 2]; /* of N and the drift parameter, sigma_v at its mode, where no limit cuts it */
            selfcal_cell_row_t row;
        } grid;
    } scratch;
    selfcal_wide_t bias_about, bias_weight, bias_first, bias_second; /* x0 + drift now, about the first node's */
    selfcal_wide_t mean_sq; /* of sigma_v^2 over that of the mode */
    selfcal_wide_t bias_own, mass_sq;                                /* its variance at the nodes; mass with sigma_v^2 over that of the mode */
    /* sums of selfcal_decay_t over the nodes of each alpha */
    selfcal_wide_t bias_decay[SELFCAL_ALPHA_MAX][2 * SELFCAL_TERMS_MAX + SELFCAL_TERM_PAIRS];
} selfcal_work_t;

/* Starts a report on one axis. SELFCAL_TOO_SHORT if there are too few samples; of a bank that forgets, the first step that looks at
 * its sums says so too. */
selfcal_status_t selfcal_report_begin(selfcal_work_t *work, selfcal_t *self, uint8_t axis, selfcal_report_t *report);

/* The same with the regressors of `mask` in use, a bit each: one subset, whose ln_evidence compares with those of the others. Bias
 * then means x0 + c' z + drift with z of the last bank sample. `coefficients`: room for one a hypothesis, or NULL.
 * SELFCAL_BAD_ARGUMENT also if the axis does not have them all; SELFCAL_TOO_SHORT with fewer than SELFCAL_REPORT_MIN samples and one
 * more for each. */
selfcal_status_t selfcal_report_begin_subset(selfcal_work_t *work, selfcal_t *self, uint8_t axis, uint8_t mask,
                                             selfcal_coefficients_t coefficients[], selfcal_report_t *report);

/* One slice of it, below 61 000 instructions on a Cortex-M4F without regressors in use, else one
 * node's least squares. SELFCAL_BUSY while there is more to do, SELFCAL_OK when `report` is whole. It first runs the nodes over
 * what was gathered, then the sums must rest: after SELFCAL_BATCH further bank samples, or fewer and a call that looks at the sums,
 * it is SELFCAL_OVERTAKEN; begin anew. After SELFCAL_OK or that, SELFCAL_BAD_ARGUMENT: no report is under way. */
selfcal_status_t selfcal_report_step(selfcal_work_t *work, selfcal_report_t *report);

/* All steps in a row. */
selfcal_status_t selfcal_report(selfcal_work_t *work, selfcal_t *self, uint8_t axis, selfcal_report_t *report);

/* The bias of the report's axis `elapsed_s` after the last bank interval (missing ones told by selfcal_skip() included) that the
 * report rests on, and its standard deviation, mixed over the hypotheses; both in the axis's unit. A reading less `bias` is the
 * corrected reading, at rest or moving. Under the constant law the bias stays; under the random walk its variance grows by
 * E(K^2) per second; a Gauss-Markov term decays towards 0 and its variance grows to sigma_m^2:
 * exact moments of the mixture over the nodes and sigma_v, as far as the report's own are. NaN where those are. `model` is the bank's.
 * SELFCAL_BAD_ARGUMENT: null pointer, elapsed_s negative or not finite. O(alpha nodes). */
selfcal_status_t selfcal_predict(const selfcal_report_t *report, const selfcal_model_t *model, float elapsed_s, float *bias, float *sd);

/* ------------------------------------------------------------------------------------------------------------- gate
 * Does the sensor rest? A likelihood-ratio test over windows of samples of any axes (gyros, accelerometers, or both); gate.c
 * states the hypotheses, the statistics and their distributions. Independent of selfcal_t. */

typedef enum { SELFCAL_MOVING = 0, SELFCAL_RESTING = 1 } selfcal_motion_t;

typedef struct {
    uint8_t axes;
    uint32_t window;   /* samples, 2 or more; a divisor of the bank's block, see selfcal_moving() */
    float false_alarm; /* probability that a window of rest is taken for motion, up to 0.1; 0: never, to measure the noise */
    uint32_t hold;     /* windows in a row, after a first one, that must be quiet and on one level before motion is over; 1 or more */
    uint32_t settle;   /* likewise to take a new gyro level, or more noise, for rest; below `hold` it does nothing, 0: never */
    uint32_t memory;   /* windows that the level at rest is averaged over, 1 or more; over as many the bias must not drift by more
                          than the noise of a window's mean. A rotation is found by its distance from that level. */
    float sigma[SELFCAL_AXES_MAX];  /* noise of one sample at rest: N sqrt(sampling rate); INFINITY leaves the axis out */
    bool is_rate[SELFCAL_AXES_MAX]; /* a gyro: after a motion it must read what it read before. Others may rest at a new level. */
} selfcal_gate_config_t;

/* Noise of one axis at rest; the factors are 1 where it is white. */
typedef struct {
    float sigma;  /* of one sample, unit; INFINITY leaves the axis out (absent, retired) */
    float within; /* mean square about the window's mean over sigma^2 */
    float spread; /* variance of that mean square over what it is for white noise */
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

/* A level and its variance over sigma^2 of each axis. Private. */
typedef struct {
    float mean[SELFCAL_AXES_MAX];
    selfcal_real_t gamma;
} selfcal_level_t;

/* A chi-square threshold under way. Private. */
typedef struct {
    selfcal_wide_t a, ln_p, ln_gamma, x; /* half the degrees of freedom, ln of the probability, half the threshold */
    selfcal_wide_t b, c, d, h;           /* of the continued fraction */
    uint16_t term;
    uint8_t rounds, at;
} selfcal_quantile_t;

/* Private but for reading `state`, `counters`, `position`, and the last window's statistics with their thresholds. */
typedef struct {
    selfcal_gate_config_t config;
    selfcal_gate_noise_t axis[SELFCAL_AXES_MAX];
    selfcal_motion_t state;
    selfcal_gate_counters_t counters;
    float t1, t2;
    float shaken_above, moved_above, rate_moved_above;
    float whole_above;                  /* shaken_above of a window without missing samples */
    uint8_t work;                       /* which threshold is being worked out; 0: none */
    uint8_t judged_axes, judged_rates;  /* axes that moved_above is for, gyros that rate_moved_above is for */
    selfcal_quantile_t quantile;
    uint32_t at_once;                   /* windows that had to have theirs worked out at their end */
    bool started;
    float origin[SELFCAL_AXES_MAX]; /* the first sample: gravity or a turn-on bias costs no digits */
    /* window in progress */
    float first[SELFCAL_AXES_MAX];
    selfcal_real_t sum[SELFCAL_AXES_MAX], sum_sq[SELFCAL_AXES_MAX]; /* about the first sample */
    uint32_t position, used; /* samples of this window: passed, and sound */
    bool blind;
    /* levels: of the rest, and of the windows in a row since motion, calm by the noise the gate started from, the last ones quiet by
     * that measured */
    selfcal_level_t rest, found;
    bool rested, unseen;
    uint32_t quiet, calm;
    float off_sum;                  /* of T2 over those windows; at rest one that forgets */
    float grown[SELFCAL_AXES_MAX];  /* their mean square about the mean over that of the noise measured */
    /* measured over whole windows of rest */
    uint64_t measured;
    selfcal_wide_t sum_scatter[SELFCAL_AXES_MAX], sum_scatter_sq[SELFCAL_AXES_MAX], sum_level_sq[SELFCAL_AXES_MAX];
} selfcal_gate_t;

/* Starts as moving. SELFCAL_BAD_ARGUMENT if the configuration is not as said above. */
selfcal_status_t selfcal_gate_init(selfcal_gate_t *gate, const selfcal_gate_config_t *config);

/* One sample of every axis. Returns the state: that of the last whole window, so with a sample's last window, known one window
 * late at most. The window is judged with its last sample. A sample that is no number ends rest at once.
 *   resting -> moving: one window that scatters too much or is off the level of the rest; a blind window.
 *   moving -> resting: the first window after blind ones, if it is one of the rest before. Else `hold` windows after a first quiet one,
 *   all on one level, the gyros' that of the last rest. A gyro that
 *   stays off for `settle` windows is believed to have a new bias: a rotation at a constant rate is nothing else to a gyro. So is noise
 *   that has grown beyond what was measured, up to what the gate started from: it then starts from that again. Blind windows are none of
 *   those in a row and do not end them.
 * A false alarm so costs hold + 2 windows (the odd one, a first quiet one, `hold` more). O(axes). Thresholds are worked out a step
 * with each sample, below 10 000 instructions on a Cortex-M4F: up to 60 steps from the start on, 30 from a change of noise on. What is
 * not known at a window's end is worked out there: all of them where windows are shorter than that, and one, 70 000 instructions,
 * O(sqrt(axes * window)) in selfcal_wide_t, for a window with missing samples. */
selfcal_motion_t selfcal_gate_push(selfcal_gate_t *gate, const float sample[]);

/* `count` samples are missing; windows keep their grid. One with half or more of its samples is judged by those. O(1) + a window's. */
selfcal_motion_t selfcal_gate_skip(selfcal_gate_t *gate, uint64_t count);

/* Takes the noise of an axis from now on, say once N is identified. SELFCAL_BAD_ARGUMENT: null pointer, no such axis, a value that
 * is not above 0, or a factor that is infinite. */
selfcal_status_t selfcal_gate_noise(selfcal_gate_t *gate, uint8_t axis, const selfcal_gate_noise_t *noise);

/* The sensor itself adds `amount` (unit) to the readings of an axis from the next sample on, see selfcal_shift(): no motion. An axis that the
 * gate has not, or an amount that is not finite, is a bug (SELFCAL_ASSERT). */
void selfcal_gate_shift(selfcal_gate_t *gate, uint8_t axis, float amount);

/* The noise as measured over the whole windows of rest so far, for selfcal_gate_noise(): run with false_alarm 0 while the sensor
 * is known to rest, and with the sigma that is to be used. Each factor's relative error is about sqrt(2/windows), that of
 * `within` less. SELFCAL_TOO_SHORT below SELFCAL_GATE_MEASURED_MIN windows. */
#define SELFCAL_GATE_MEASURED_MIN 30U
selfcal_status_t selfcal_gate_measured(const selfcal_gate_t *gate, uint8_t axis, selfcal_gate_noise_t *noise);

/* -------------------------------------------------------------------------------------------------------- telemetry
 * Reports as classical CAN frames of 8 bytes with 11-bit identifiers. selfcal.dbc describes every item, with its unit and
 * bits. selfcal_frames.h and the decoders are made from the same source.
 * Each frame carries one value and its item number, a counter over all frames of the module, the module time in whole
 * seconds modulo 256, and a CRC-12.
 * A report's opening and end do not depend on the laws. Between them each hypothesis has a message of its own. It carries
 * up to three parameters by place: N; the drift parameter; the bandwidth or ratio. A place that the law lacks is not
 * sent. So any model of up to eight hypotheses fits, and the same law may stand twice.
 * Up to twelve modules share a bus: the node number moves all identifiers.
 * Frames must reach the wire in the order they are made (bxCAN: set TXFP). */

typedef struct {
    uint16_t id; /* 11 bits */
    uint8_t length;
    uint8_t data[8];
} selfcal_frame_t;

/* What the module does, for its status: finished once no sample will follow. */
typedef enum { SELFCAL_RUNNING, SELFCAL_FINISHED } selfcal_state_t;

/* What a module tells of itself beside the bank; meanings and codes as in selfcal.dbc. */
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
    uint32_t command_count;
    uint32_t command_refused_count;
    float offset[SELFCAL_AXES_MAX]; /* of each axis of the model, unit: what the sensor adds by itself, see selfcal_shift() */
} selfcal_module_t;

/* A corrected sample, by axis of the model, unit; sd NAN: there is none of this axis. */
typedef struct {
    float value[SELFCAL_AXES_MAX]; /* reading less bias, see selfcal_predict() */
    float sd[SELFCAL_AXES_MAX];    /* of that bias */
    uint32_t motion;               /* code as in selfcal.dbc */
} selfcal_corrected_t;

/* The coefficient of one regressor column, given that the column is in use, and the probability that it is. With a mean of
 * NaN nothing is known of the column, and nothing is sent. */
typedef struct {
    float mean, sd, probability;
} selfcal_sent_coefficient_t;

/* Private; declared here so that the caller can place it. */
typedef struct {
    const selfcal_model_t *model;
    const selfcal_module_t *module;
    const selfcal_sent_coefficient_t *coefficient; /* [regressors of the model], or NULL */
    uint16_t first_id;                 /* of the node */
    uint8_t message[SELFCAL_AXES_MAX]; /* which axis message each axis has */
    /* of the frames under way */
    uint8_t source;
    uint8_t part; /* of a report */
    uint16_t id;
    const selfcal_report_t *report;
    const selfcal_corrected_t *corrected;
    uint32_t answer;
    const selfcal_counters_t *counters;
    selfcal_wide_t ln_best;
    uint32_t report_number;
    uint32_t time_ms;
    selfcal_state_t state;
    uint8_t item;  /* to look at next */
    uint8_t items; /* past the last one: 0 with nothing under way */
    uint8_t made;  /* frames of this report or status */
    uint32_t frames; /* made since selfcal_telemetry_init() */
} selfcal_telemetry_t;

/* `axis_name[]`: the name of each axis of the model, which chooses its message: gx gy gz (deg/s), ax ay az (m/s^2). The
 * model's units must be those. The node is 0. SELFCAL_BAD_ARGUMENT on a null pointer. SELFCAL_BAD_MODEL if a name has
 * no message or comes twice, or if the model has more than eight hypotheses. */
selfcal_status_t selfcal_telemetry_init(selfcal_telemetry_t *self, const selfcal_model_t *model,
                                        const char *const axis_name[]);

/* The module's number on its bus, 0 to 11, from here on. SELFCAL_BAD_ARGUMENT beyond. SELFCAL_BUSY, and nothing changes,
 * while frames are still to be fetched. */
selfcal_status_t selfcal_telemetry_node(selfcal_telemetry_t *self, uint8_t node);

/* Mean and sd of each column's coefficient over the laws of a report made with all of them in use. */
void selfcal_mix_coefficients(const selfcal_report_t *report, const selfcal_model_t *model,
                              const selfcal_coefficients_t coefficients[], float probability,
                              selfcal_sent_coefficient_t sent[]);

/* What the following reports tell of the regressors' coefficients on their axis, by column of the model. They must stay
 * as the report must. NULL, as at the start: nothing. */
void selfcal_telemetry_coefficients(selfcal_telemetry_t *self, const selfcal_sent_coefficient_t column[]);

/* Sends one axis's report next: 7 frames, and of each hypothesis 3 and 5 for each of its parameters. The paper's three
 * laws take 46. Each coefficient takes 3 more. `time_ms`: module time since its start, modulo 2^32, later than that of
 * the axis's last report. `report` and `counters` must stay, the report unchanged, until selfcal_telemetry_next() says
 * false. SELFCAL_BUSY, and nothing changes, while frames are still to be fetched. */
selfcal_status_t selfcal_telemetry_report(selfcal_telemetry_t *self, const selfcal_report_t *report,
                                          const selfcal_counters_t *counters, uint32_t time_ms);

/* What the following statuses tell of the module; it must stay. NULL: zeros. */
void selfcal_telemetry_module(selfcal_telemetry_t *self, const selfcal_module_t *module);

/* Sends the status next, 46 frames; otherwise as selfcal_telemetry_report(). */
selfcal_status_t selfcal_telemetry_status(selfcal_telemetry_t *self, const selfcal_counters_t *counters,
                                          selfcal_state_t state, uint32_t report_number, uint32_t time_ms);

/* Sends a corrected sample next, up to 14 frames; otherwise as selfcal_telemetry_report(). */
selfcal_status_t selfcal_telemetry_corrected(selfcal_telemetry_t *self, const selfcal_corrected_t *corrected, uint32_t time_ms);

/* Sends one item of the answer message next; otherwise as selfcal_telemetry_report(). SELFCAL_BAD_ARGUMENT also if there is no such item. */
selfcal_status_t selfcal_telemetry_answer(selfcal_telemetry_t *self, uint8_t item, uint32_t value, uint32_t time_ms);

/* Makes the next frame; false when there is none. O(1). */
bool selfcal_telemetry_next(selfcal_telemetry_t *self, selfcal_frame_t *frame);

/* CRC-12/CDMA2000: polynomial 0xF13, initial value 0xFFF, most significant bit first. */
uint16_t selfcal_crc12(const uint8_t *data, size_t length);

#ifdef __cplusplus
}
#endif

#endif
