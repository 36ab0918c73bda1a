/* The structs that a caller places, with their sizes. selfcal.h includes this file. Members belong to the library, save
 * those that selfcal.h and selfcal_parts.h name. */
#ifndef SELFCAL_LAYOUT_H
#define SELFCAL_LAYOUT_H

/* Sums over the whole record. ln-likelihoods differ by (n/2) ln(ratio), which one float cannot carry beyond n = 10^4.
 * The value is hi + lo, twice the digits of selfcal_real_t by its own arithmetic. Compilers must not reassociate: no
 * -ffast-math. */
typedef struct {
    selfcal_real_t hi, lo;
} selfcal_sum_t;

#ifdef SELFCAL_FIXED

/* Of each node and axis: its predicted drift, and its sums B and C. */
typedef int32_t selfcal_drift_t;
typedef int64_t selfcal_total_t;

/* One axis of the block in progress, about its first sample (intake_fixed.c). */
typedef struct {
    int64_t sum;      /* steps */
    int64_t sum_sq;   /* (2^shift steps)^2 */
    int32_t first;    /* the first sample, steps */
    int16_t exponent; /* a step is 2^exponent unit */
    uint8_t shift;
} selfcal_block_t;

/* Beside regressors the readings are not in integers: sums B of "1" and C, and their predicted drift. */
typedef struct {
    selfcal_sum_t b, c, x;
} selfcal_reading_t;

/* Sums B and C of a node of several states, beside the states. */
#define SELFCAL_STATE_SUMS 2U

/* Most samples that a span has head-room for. */
#define SELFCAL_BATCH_ROOM 16

/* The build, for a snapshot: bytes of a real, and 32 for integers. */
#define SELFCAL_ARITHMETIC 32U

/* The batch that the nodes run over. */
typedef struct {
    selfcal_scale_t scale[SELFCAL_AXES_MAX];
    int32_t y[SELFCAL_AXES_MAX][SELFCAL_BATCH];
    /* growth of nu before each sample and after the last, for a pole */
    int32_t step[SELFCAL_AXES_MAX][SELFCAL_BATCH + 1];
    uint32_t step_from, step_to; /* samples of those steps; from == to: none */
    float step_beta;             /* 1 - the pole */
} selfcal_integers_t;

#else

typedef selfcal_real_t selfcal_drift_t;
typedef selfcal_sum_t selfcal_total_t;

typedef struct {
    selfcal_real_t sum, sum_sq;
    float first;
} selfcal_block_t;

/* Beside regressors: low part of the readings' predicted drift. */
typedef struct {
    selfcal_real_t low;
} selfcal_reading_t;

#define SELFCAL_STATE_SUMS 0U
#define SELFCAL_BATCH_ROOM 64
#define SELFCAL_ARITHMETIC sizeof(selfcal_real_t)

/* Kernels in selfcal_real_t take the batch as it is. */
typedef struct {
    uint32_t unused;
} selfcal_integers_t;

#endif

/* --- bank --- */

/* How a filter's gains move. */
typedef struct {
    selfcal_real_t c; /* phi^2 / (1 + p_inf): contraction of d */
    selfcal_real_t d; /* predicted variance less p_inf; exactly 0 once converged */
    selfcal_real_t e; /* innovation of the regressor "1" at the next sample less u_inf */
} selfcal_moving_t;

/* Gains of a level node in the integer kernels: phi K + beta, u/s and 1/s, each times 2^shift. */
typedef struct {
    int32_t g, u, w;
} selfcal_settled_t;

/* Gain side of one filter, relative to sigma_v. All axes share it, because covariances do not depend on the data. */
typedef struct {
    selfcal_real_t beta;  /* 1 - phi */
    selfcal_real_t q;     /* drift variance added per interval */
    selfcal_real_t p_inf; /* predicted variance once converged */
    selfcal_real_t u_inf; /* innovation of the regressor "1" once settled */
    union {
        selfcal_moving_t moving;
        selfcal_settled_t settled; /* of a level node in the integer kernels */
    } gains;
    bool level;                        /* d = e = 0: the kernel sums plain nu */
    uint8_t g_shift, u_shift, w_shift; /* of `settled` */
    uint32_t steady;                   /* samples seen with d = 0: their ln s is added when asked for */
    uint32_t level_from; /* steady when it became level: what later samples add to A is added when asked for */
    selfcal_sum_t a;     /* sum u^2 / s */
    selfcal_sum_t ln_s;  /* sum ln s of the other samples */
} selfcal_node_t;

/* Bytes of memory for the bank: for each node 56, and 20 more per axis (check.c holds it to that). */
#define SELFCAL_SIZE(nodes, axes)                                                                                      \
    ((size_t)(nodes) *                                                                                                 \
     (sizeof(selfcal_node_t) + (size_t)(axes) * (2U * sizeof(selfcal_total_t) + sizeof(selfcal_drift_t))))

/* Bank samples on their way into the sums. */
typedef struct {
    selfcal_real_t y[SELFCAL_AXES_MAX][SELFCAL_BATCH]; /* less offset */
    selfcal_real_t r[SELFCAL_BATCH];                   /* white-noise variance of each over a whole block's */
    uint32_t gap[SELFCAL_BATCH];                       /* bank intervals without a sample before each */
    uint32_t gap_after;
    uint32_t count;
    bool part; /* some r is not 1 */
} selfcal_batch_t;

/* One regressor's front end. */
typedef struct {
    selfcal_real_t z[2][SELFCAL_BATCH]; /* beside the batches, less the first bank sample's value */
    selfcal_real_t last;                /* of the last bank sample that the nodes run over */
    float origin, first;                /* the first sample of all, and of this block */
    selfcal_real_t offset;              /* the first bank sample less origin */
    selfcal_real_t sum;                 /* of this block about its first */
} selfcal_column_t;

typedef struct {
    selfcal_column_t *column; /* [regressors] */
    /* [nodes][rows]: for "1" and each regressor, sums of its innovation times those up to its own, over s */
    selfcal_sum_t *a;
    selfcal_sum_t *b;           /* [nodes][axes][regressors]: sum of its innovation times nu over s */
    selfcal_sum_t *x;           /* [nodes][1 + regressors]: predicted drift of the zero-bias filter over each column */
    selfcal_reading_t *reading; /* [nodes][axes] */
} selfcal_columns_t;

/* Sums of the first p rows of A. */
#define SELFCAL_REGRESSORS_ROWS(p) ((size_t)(p) * ((size_t)(p) + 1U) / 2U)

/* Bytes beyond SELFCAL_SIZE for p regressors, 0 for none. For each node in the float build 4 (p + 1) (p + 4), and per
 * axis 8 p + 4; 8 p + 24 in the integer one. */
#define SELFCAL_REGRESSORS_SIZE(nodes, axes, p)                                                                        \
    ((size_t)(p) == 0U                                                                                                 \
         ? (size_t)0U                                                                                                  \
         : 7U + sizeof(selfcal_columns_t) + (size_t)(p) * sizeof(selfcal_column_t) +                                   \
               (size_t)(nodes) * ((SELFCAL_REGRESSORS_ROWS((p) + 1U) + (size_t)(axes) * (p) + (size_t)(p) + 1U) *      \
                                      sizeof(selfcal_sum_t) +                                                          \
                                  (size_t)(axes) * sizeof(selfcal_reading_t)))

/* Gain side of a node of several states, relative to sigma_v. States are scaled so that the reading is their sum and
 * white noise. */
typedef struct {
    selfcal_wide_t p[SELFCAL_TERM_PAIRS];                         /* predicted covariance of the states, lower half */
    selfcal_real_t beta[SELFCAL_TERMS_MAX], q[SELFCAL_TERMS_MAX]; /* 1 - pole, and variance added per interval */
    selfcal_real_t theta; /* of a moving average, whose part e_(i-1) is the last state */
    uint8_t pair;         /* the second state of an oscillation; 0: the law has none. Its beta and q are turn_of()'s */
    bool steady;          /* p has converged */
} selfcal_term_node_t;

typedef struct {
    selfcal_term_node_t *node; /* [nodes of sums] */
    /* [those][1 + regressors + axes][SELFCAL_TERMS_MAX]: predicted states over "1", the columns, the readings */
    selfcal_sum_t *x;
    selfcal_sum_t *bc; /* [those][axes][SELFCAL_STATE_SUMS]: sums B and C of the readings */
} selfcal_terms_t;

/* Bytes beyond those for a model with `nodes` nodes of sums, 0 for none. For each in the float build 104 + 24 p, and
 * per axis 24. */
#define SELFCAL_TERMS_SIZE(nodes, axes, p)                                                                             \
    ((size_t)(nodes) == 0U ? (size_t)0U                                                                                \
                           : 7U + sizeof(selfcal_terms_t) +                                                            \
                                 (size_t)(nodes) * (sizeof(selfcal_term_node_t) +                                      \
                                                    (((size_t)(p) + 1U) * SELFCAL_TERMS_MAX +                          \
                                                     (size_t)(axes) * (SELFCAL_TERMS_MAX + SELFCAL_STATE_SUMS)) *      \
                                                        sizeof(selfcal_sum_t)))

/* What an axis's samples are held against, see selfcal_handling_t. */
typedef struct {
    float level[SELFCAL_AXES_MAX]; /* mean of the block before */
    float limit[SELFCAL_AXES_MAX]; /* how far a sample may be from it; 0: not known */
    uint8_t run[SELFCAL_AXES_MAX]; /* outliers in a row */
} selfcal_usual_t;

/* Pointers first: a snapshot has the members that follow them. */
struct selfcal {
    const selfcal_model_t *model;
    selfcal_terms_t *terms;     /* of the laws that are sums; NULL: there are none */
    selfcal_columns_t *columns; /* of the regressors; NULL: there are none */
    selfcal_node_t *node;       /* [nodes] */
    selfcal_total_t *b, *c;     /* [nodes][axes]: sums u nu / s and nu^2 / s */
    selfcal_drift_t *x;         /* [nodes][axes]: predicted drift of the zero-bias filter */
    bool held;                  /* a copy for a report, imu_hold.c: of all that has [axes] it has one */
    uint32_t n;                 /* bank samples in all sums */
    selfcal_wide_t weight;      /* of these samples: n without forgetting */
    selfcal_wide_t keep;        /* part of the sums that is kept as the waiting batch comes, 1 without forgetting */
    selfcal_wide_t beginning;   /* weight of the first batch */
    selfcal_real_t rho_lo[SELFCAL_HYPOTHESES_MAX], rho_step[SELFCAL_HYPOTHESES_MAX]; /* ln of the nodes */
    selfcal_real_t alpha_lo[SELFCAL_HYPOTHESES_MAX], alpha_step[SELFCAL_HYPOTHESES_MAX];
    /* One batch is gathered while the nodes run, some at every push, over the one before. */
    selfcal_batch_t batch[2];
    uint8_t gathering;    /* which of them is gathered */
    uint16_t ran;         /* nodes that have run over the other */
    uint16_t push_nodes;  /* to run at a push */
    uint32_t pending_gap; /* bank intervals without a sample after the last one gathered */
    uint32_t batches;     /* that the nodes have begun with */
    selfcal_integers_t integers;
    /* intake */
    bool started;
    float origin[SELFCAL_AXES_MAX];          /* the first sample, unit */
    selfcal_real_t offset[SELFCAL_AXES_MAX]; /* the first bank sample less origin */
    uint32_t block;                          /* samples a bank interval now has */
    selfcal_real_t variance_ratio;           /* r of a whole block */
    selfcal_block_t sums[SELFCAL_AXES_MAX];
    uint32_t position, used;                 /* samples of this block: passed, and usable */
    bool dropped;                            /* the rest of it counts for nothing */
    selfcal_wide_t within[SELFCAL_AXES_MAX]; /* sum of squares about the block means */
    uint64_t within_dof;
    float last[SELFCAL_AXES_MAX];
    uint32_t equal[SELFCAL_AXES_MAX];
    bool in_gap;
    float shifted[SELFCAL_AXES_MAX]; /* by selfcal_shift(), in all, unit */
    uint64_t powered;                /* samples since power-on less those counted, modulo 2^64 */
    /* of the bias's prior, unit: the model's until selfcal_reopen() */
    float prior_mean[SELFCAL_AXES_MAX], prior_sd[SELFCAL_AXES_MAX];
    uint32_t retired;                      /* a bit for each axis */
    uint32_t watched;                      /* samples looked at since the axes were last judged ... */
    uint32_t bad[SELFCAL_AXES_MAX];        /* ... those of them with the axis at fault ... */
    uint16_t bad_blocks[SELFCAL_AXES_MAX]; /* ... and judgements in a row that went against it */
    selfcal_usual_t usual;
    selfcal_counters_t counters;
};

/* No snapshot of a bank over `bytes` of memory (SELFCAL_MODEL_BYTES) is longer. For a flash slot or a buffer that the
 * compiler lays out. */
#define SELFCAL_SNAPSHOT_MAX(bytes) (32U + sizeof(selfcal_t) + (bytes))

/* --- values of regressors --- */

/* Bins that a window is held in. More: a finer edge of the window, 4 bytes each and column. */
#define SELFCAL_COLUMN_BINS 32U

typedef struct {
    uint64_t step;        /* STEP, PULSE: its sample; SINE, COSINE: 2^64 turns a sample */
    selfcal_sum_t state;  /* LAG: the low pass less the channel */
    selfcal_real_t gain;  /* ... and its share of a step, a sample */
    uint32_t window, bin; /* samples; PULSE: window is its length */
    uint32_t bins, in_bin;
    float ring[SELFCAL_COLUMN_BINS + 2U];
    float sum, first, last;
} selfcal_trail_t;

struct selfcal_former {
    const selfcal_model_t *model;
    uint64_t samples; /* before the newest, missing ones too */
    uint64_t powered; /* ... and those since power-on less these, modulo 2^64 */
    bool begun;
    selfcal_trail_t trail[SELFCAL_REGRESSORS_MAX];
};

/* --- report --- */

/* By SELFCAL_REPORT_QUALITY: cells a dimension, cells of sigma_v where a limit cuts, bins of a parameter's
 * histogram. */
#define SELFCAL_BY_QUALITY(fuzz, module, host, reference)                                                              \
    (SELFCAL_REPORT_QUALITY == 0   ? (fuzz)                                                                            \
     : SELFCAL_REPORT_QUALITY == 1 ? (module)                                                                          \
     : SELFCAL_REPORT_QUALITY == 2 ? (host)                                                                            \
                                   : (reference))
#define SELFCAL_STEP_CELLS 16U /* that one step of a report sums */
#define SELFCAL_REPORT_CELLS SELFCAL_BY_QUALITY(16, 24, 80, 192)
#define SELFCAL_SIGMA_CELLS SELFCAL_BY_QUALITY(8, 24, 48, 96)
#define SELFCAL_HISTOGRAM SELFCAL_BY_QUALITY(32, 64, 128, 512)

/* report_expected.c: the process supposed to have made the data, for the expected likelihood; report_spectrum.c: the
 * data's spectrum beyond it. */
#define SELFCAL_FITTED (SELFCAL_LINES + (SELFCAL_LINES + 2) / 3 * 2)
typedef struct {
    /* the samples' noise, their geometric mean, over a whole block's at the model's rate, less 1 */
    selfcal_real_t noise_less_1;
    selfcal_real_t variance, rate; /* of a first-order drift over that noise's variance; 1 - its pole */
    selfcal_wide_t ln_v;           /* expected variance of its own filter's innovations */
    bool wide;                     /* the record is so long that the expectation takes selfcal_wide_t */
    uint8_t lines;
    bool fitted, pair; /* the spectrum is fitted; there are nodes in two dimensions */
    /* Of either sign: lines at frequencies omega, and behind them two of each three lines' band, edges and level. */
    selfcal_real_t distance[SELFCAL_LINES]; /* |1 - e^(i omega)|^2 */
    selfcal_real_t power[SELFCAL_FITTED];
} selfcal_truth_t;

/* Steps of an axis's reports, from the last samples that they rest on to their end: of 99 in 100 records drawn from the
 * default priors, of those at their limits too, no more; of most about half. With regressors an axis has two. */
#define SELFCAL_REPORT_STEPS(nodes, hypotheses, regressors)                                                            \
    (((regressors) > 0U ? 2U : 1U) * (3U * (nodes) + SELFCAL_BY_QUALITY(350U, 500U, 700U, 1500U) * (hypotheses)))
/* Calls in a bank interval that bring them to their end before the next batch is full. */
#define SELFCAL_REPORT_CALLS(nodes, hypotheses, regressors)                                                            \
    ((SELFCAL_REPORT_STEPS(nodes, hypotheses, regressors) + SELFCAL_BATCH - 2U) / (SELFCAL_BATCH - 1U))

/* Least squares for them by rotations: a triangle, row by row, its right side behind each. */
#define SELFCAL_TRIANGLE (SELFCAL_FITTED * (SELFCAL_FITTED + 3) / 2)
typedef struct {
    selfcal_real_t triangle[SELFCAL_TRIANGLE], least;
    selfcal_real_t scatter[SELFCAL_NODES_MAX]; /* of every node, ln of the readings' scatter from the best node's */
} selfcal_fit_t;

/* report_node.c: of the best node, variance of its residuals, the inverse, and D; the cost of sigma_v's mode, and
 * the priors' part. */
typedef struct {
    selfcal_wide_t var, per_var, ln_s;
    selfcal_real_t cost, extra;
} selfcal_top_t;

/* report_marginal.c: sigma_v about its mode at a node, in ln. */
typedef struct {
    selfcal_real_t mass, first, second; /* moments where no limit cuts it */
    selfcal_real_t lo, hi;              /* where it ends if no limit does */
    selfcal_real_t from, width;         /* the first of the cells in hand, their width */
    /* of the ln-likelihood from the mode to the priors' limits, in each law's best cell */
    selfcal_real_t drop[SELFCAL_HYPOTHESES_MAX];
} selfcal_sigma_t;

/* report_integral.c: one row of cells, coefficients of the two splines in rho, alpha taken out. */
typedef struct {
    selfcal_real_t profile[SELFCAL_GRID_MAX], ln_sigma[SELFCAL_GRID_MAX];
    selfcal_real_t basis[6]; /* of alpha */
    uint8_t basis_first;
    selfcal_real_t ln_alpha, beta, shift, half_ln_dt;
    selfcal_real_t left_out, noise_sq;    /* white_left_out(); the square of the ratio of coloured noise, else 1 */
    const selfcal_prior_t *prior;         /* of the hypothesis on the axis */
    selfcal_parameter_t drift;            /* which parameter goes with rho */
    selfcal_real_t passed[SELFCAL_LINES]; /* selfcal_expected_passed() */
} selfcal_cell_row_t;

/* Where in ln rho or ln alpha the likelihood counts. */
typedef struct {
    selfcal_real_t lo, hi;
} selfcal_range_t;

/* Nodes of one alpha: where they count, a node beyond either way, and the highest. */
typedef struct {
    selfcal_range_t range;
    selfcal_real_t height;
} selfcal_node_column_t;

#define SELFCAL_SEARCH_SAMPLES 8 /* of one search pass */
typedef struct {
    uint8_t pass;
    bool open;                               /* the peak of the row in hand may lie beyond its range */
    selfcal_real_t limit_lo[2], limit_hi[2]; /* permitted by the priors: (ln rho, ln alpha) */
    selfcal_range_t range[2];                /* of these the row in hand, and the rows */
    uint8_t least[2];                        /* cells that its peak needs */
    selfcal_real_t row_best;                 /* ln-likelihood of the row in hand */
    selfcal_real_t depth;                    /* below the best at which no more counts */
    selfcal_real_t best, best_ln[SELFCAL_PARAMETERS];
} selfcal_search_t;

typedef struct {
    uint8_t rows;
    selfcal_real_t range_lo[SELFCAL_PARAMETERS], range_hi[SELFCAL_PARAMETERS]; /* ln of the parameters */
    selfcal_wide_t mass, off_grid;
    selfcal_wide_t mass_sq; /* mass with sigma_v^2 over the mode's */
    selfcal_wide_t first[SELFCAL_PARAMETERS], second[SELFCAL_PARAMETERS];
} selfcal_integral_t;

/* report_bias.c: x0 + drift now, about that of the node of most weight: far from it a float's digits would not do. */
typedef struct {
    uint16_t from; /* that node, the first in turn */
    selfcal_wide_t about;
    selfcal_real_t weight, first, second;
    selfcal_real_t mean_sq; /* of sigma_v^2 over the mode's */
    selfcal_real_t own;     /* its variance at the nodes */
    /* sums of selfcal_decay_t over the nodes of each alpha */
    selfcal_real_t decay[SELFCAL_ALPHA_MAX][2 * SELFCAL_TERMS_MAX + SELFCAL_TERM_PAIRS];
} selfcal_bias_t;

struct selfcal_work {
    selfcal_t *bank;
    uint8_t axis, hypothesis, stage;
    uint16_t first_node;
    uint16_t row, at; /* in the stage: row of cells; node, cell of the row, or parameter that is next */
    /* of the bank, when the sums came to rest. Given, the report rests on those of an earlier one: selfcal_again() */
    uint32_t batches;
    bool lost;              /* a law that the priors allow has ended without an evidence */
    bool gathered;          /* the nodes run over the last batch: samples from now on come later than the report */
    uint8_t mask, unknowns; /* regressors in use; those and the bias */
    selfcal_coefficients_t *coefficients; /* [hypotheses] or NULL */
    uint16_t best_node;                   /* of all: the likeliest */
    selfcal_top_t top;                    /* ... whatever its law, and its ln var and ln-likelihood */
    selfcal_wide_t per_n, per_bias_sd, ln_top, top_profile;
    /* Of every node, of the profile ln-likelihood and of ln of sigma_v's conditional mode, from those of the best; then
     * of the hypothesis in hand less their expectation; then posterior means of the basis functions. */
    selfcal_real_t field[2][SELFCAL_NODES_MAX];
    selfcal_wide_t ln_sigma_off; /* there, of sigma_v's mode from its expectation */
    selfcal_truth_t truth;
    /* of the hypothesis in hand */
    selfcal_real_t peak;  /* of the nodes' profile ln-likelihood */
    selfcal_real_t n_eff; /* bank samples less those that bias and coefficients took */
    selfcal_sigma_t sigma;
    selfcal_search_t search;
    selfcal_integral_t sum;
    selfcal_bias_t bias;
    union {
        selfcal_fit_t fit; /* before the first hypothesis */
        struct {
            /* B-spline coefficients; later weights of the nodes, as they are, and with sigma_v^2 over its mode's */
            selfcal_real_t spline[2][SELFCAL_HYPOTHESIS_NODES_MAX];
            /* a mass that ends at the last bin's end reaches beyond it */
            selfcal_real_t histogram[SELFCAL_PARAMETERS][SELFCAL_HISTOGRAM + 2];
            /* of each sigma_v cell: the offset's exponential, less 1; the weight */
            selfcal_real_t delta_expm1[SELFCAL_SIGMA_CELLS], delta_weight[SELFCAL_SIGMA_CELLS];
            selfcal_range_t found[SELFCAL_SEARCH_SAMPLES]; /* the rows of the search, and how high they are, ln */
            selfcal_real_t height[SELFCAL_SEARCH_SAMPLES];
            selfcal_node_column_t column[SELFCAL_ALPHA_MAX];
            uint8_t least[SELFCAL_SEARCH_SAMPLES];
            /* of N and the drift parameter, sigma_v at its mode, where no limit cuts it */
            selfcal_real_t modes[2][SELFCAL_HISTOGRAM + 2];
            selfcal_cell_row_t row;
        } grid;
    } scratch;
};

/* --- gate --- */

/* A level and its variance over sigma^2 of each axis. */
typedef struct {
    float mean[SELFCAL_AXES_MAX];
    selfcal_real_t gamma;
} selfcal_level_t;

/* A chi-square threshold under way. */
typedef struct {
    selfcal_wide_t a, ln_p, ln_gamma, x; /* half the degrees of freedom, ln of the probability, half the threshold */
    selfcal_wide_t b, c, d, h;           /* of the continued fraction */
    uint16_t term;
    uint8_t rounds, at;
} selfcal_quantile_t;

struct selfcal_gate {
    selfcal_gate_config_t config;
    selfcal_gate_noise_t axis[SELFCAL_AXES_MAX];
    selfcal_motion_t state;
    selfcal_gate_counters_t counters;
    float t1, t2;
    float shaken_above, moved_above, rate_moved_above;
    float whole_above;                 /* shaken_above of a window without missing samples */
    uint8_t work;                      /* which threshold is being worked out; 0: none */
    uint8_t judged_axes, judged_rates; /* axes that moved_above is for, gyros that rate_moved_above is for */
    selfcal_quantile_t quantile;
    uint32_t at_once; /* windows that had to have theirs worked out at their end */
    bool started;
    float origin[SELFCAL_AXES_MAX]; /* the first sample: gravity or a turn-on bias costs no digits */
    /* window in progress */
    float first[SELFCAL_AXES_MAX];
    selfcal_real_t sum[SELFCAL_AXES_MAX], sum_sq[SELFCAL_AXES_MAX]; /* about the first sample */
    uint32_t position, used;                                        /* samples of this window: passed, and sound */
    bool blind;
    /* levels: of the rest, and of the windows in a row since motion, calm by the noise the gate started from, the last
     * ones quiet by the measured noise */
    selfcal_level_t rest, found;
    bool rested, unseen;
    uint32_t quiet, calm;
    float off_sum;                 /* of T2 over those windows; at rest one that forgets */
    float grown[SELFCAL_AXES_MAX]; /* their mean square about the mean over the measured noise's */
    /* measured over whole windows of rest */
    uint64_t measured;
    selfcal_wide_t sum_scatter[SELFCAL_AXES_MAX], sum_scatter_sq[SELFCAL_AXES_MAX], sum_level_sq[SELFCAL_AXES_MAX];
};

/* --- adequacy --- */

enum {
    SELFCAL_ADEQUACY_CHANNELS = 2, /* temperature, supply */
    SELFCAL_ADEQUACY_COLUMNS = 3,  /* time and the channels */
    SELFCAL_ADEQUACY_INPUTS = SELFCAL_ADEQUACY_CHANNELS + SELFCAL_REGRESSORS_MAX,
    SELFCAL_FILTER_STATES = 1 + SELFCAL_LAW_TERMS
};

typedef struct {
    uint8_t states;
    selfcal_real_t sigma; /* sigma_v, unit; the rest is relative to it */
    selfcal_real_t pole[SELFCAL_FILTER_STATES], noise[SELFCAL_FILTER_STATES], variance[SELFCAL_FILTER_STATES];
    selfcal_real_t coefficient[SELFCAL_REGRESSORS_MAX];
} selfcal_filter_law_t;

typedef struct {
    selfcal_real_t n, lag, slow, along[SELFCAL_ADEQUACY_COLUMNS], weight[SELFCAL_ADEQUACY_COLUMNS];
    selfcal_real_t product[SELFCAL_AXES_MAX]; /* with each other axis */
    selfcal_real_t power;                     /* of z */
} selfcal_sums_t;

/* Sums of z, and of the w of each column, over a window and the two before it; of the epoch the greatest rise of z from
 * one window to the next but one, and how far the columns rise there. */
enum { SELFCAL_RISE_WINDOWS = 3 };
typedef struct {
    selfcal_real_t sum[1 + SELFCAL_ADEQUACY_COLUMNS][SELFCAL_RISE_WINDOWS];
    selfcal_real_t most, along[SELFCAL_ADEQUACY_COLUMNS];
    uint32_t at; /* bank samples of the epoch before it */
    /* the last step of an epoch before: its score, times the root of the bank samples then */
    selfcal_real_t told;
    selfcal_suspect_t cause;
} selfcal_rise_t;

/* tones.c: what a tone remembers of z, and its sum. */
enum { SELFCAL_TONES_OCTAVE = 6, SELFCAL_TONES_OCTAVES = 5 };
typedef struct {
    selfcal_real_t re, im, sum;
} selfcal_tone_t;
typedef struct {
    uint32_t n;                                 /* samples of the first octave */
    selfcal_real_t half[SELFCAL_TONES_OCTAVES]; /* the first of two samples of each */
    selfcal_tone_t tone[SELFCAL_TONES_OCTAVES][SELFCAL_TONES_OCTAVE];
} selfcal_tones_t;

typedef struct {
    bool known, running, begun;
    selfcal_reason_t reason;                             /* if not known */
    selfcal_filter_law_t next, law;                      /* of the last report; in use */
    selfcal_reopening_t likely;                          /* where the likeliest law of the last report lies */
    selfcal_real_t gain[SELFCAL_FILTER_STATES], root, z; /* of the last bank sample; root of 1/S; z as it is */
    selfcal_real_t state[1 + SELFCAL_ADEQUACY_COLUMNS][SELFCAL_FILTER_STATES];
    selfcal_real_t covariance[SELFCAL_FILTER_STATES * (SELFCAL_FILTER_STATES + 1) / 2];
    selfcal_real_t last, slow, fourth, square[2];
    selfcal_rise_t rise;
    selfcal_sums_t epoch, all;
    selfcal_tones_t tones;
} selfcal_watch_t;

/* A step of the bias that may have begun with some bank sample. */
enum { SELFCAL_ONSETS = 8 };
typedef struct {
    selfcal_real_t state[SELFCAL_FILTER_STATES]; /* of the filter, over a step of 1 */
    selfcal_real_t along, weight, size;          /* sums of z w, z held, and of w^2; of z w */
    selfcal_real_t late, late_weight; /* along and weight when the score had been over its limit for a while */
    uint16_t age, held;               /* bank samples; those in a row with the score over its limit */
} selfcal_onset_t;

typedef struct {
    selfcal_onset_t onset[SELFCAL_ONSETS];
    selfcal_real_t power, square, sum; /* of this window's innovations: squares, held and whole, and themselves */
    selfcal_real_t level, whole;       /* their means over the windows before */
    selfcal_real_t odd, odd_square;    /* of the window before, if it was off that level; else 0 */
    uint16_t windows;                  /* before */
} selfcal_change_watch_t;

struct selfcal_changes {
    uint32_t in_window;                  /* its bank samples so far */
    uint32_t found_at[SELFCAL_AXES_MAX]; /* bank intervals before the last change was found */
    float *learned;                      /* [nodes][axes]: before a change */
    bool keeps, due;                     /* there is something in it; it is to be renewed */
    uint32_t found;                      /* a bit for each axis with a change that is not yet handled: */
    selfcal_change_t change[SELFCAL_AXES_MAX];
    float bias[SELFCAL_AXES_MAX], bias_sd[SELFCAL_AXES_MAX]; /* after a step, unit; less the bank's offset */
    selfcal_change_watch_t watch[SELFCAL_AXES_MAX];
};

/* coarse.c: filters, shared by the axes; an axis's part of one; what was said before the last restart. */
enum { SELFCAL_COARSE_FILTERS = 16, SELFCAL_COARSE_COLUMNS = 3 + SELFCAL_ADEQUACY_CHANNELS };
typedef struct {
    selfcal_real_t variance, ln_s;                                                 /* of the level; sum D */
    selfcal_real_t column[SELFCAL_COARSE_COLUMNS], weight[SELFCAL_COARSE_COLUMNS]; /* level and sum A of each */
} selfcal_coarse_filter_t;
typedef struct {
    selfcal_real_t level, square, along[SELFCAL_COARSE_COLUMNS]; /* of the readings; sums C and B */
} selfcal_coarse_cell_t;
typedef struct {
    selfcal_real_t score;
    selfcal_suspect_t suspect;
} selfcal_coarse_told_t;
typedef struct {
    uint32_t n;                                              /* bank samples */
    selfcal_real_t elapsed;                                  /* intervals since the first */
    selfcal_real_t first[SELFCAL_ADEQUACY_CHANNELS], lagged; /* channels at the first; the temperature's low pass */
    selfcal_coarse_filter_t filter[SELFCAL_COARSE_FILTERS];
    selfcal_coarse_cell_t cell[SELFCAL_AXES_MAX][SELFCAL_COARSE_FILTERS];
    selfcal_coarse_told_t before[SELFCAL_AXES_MAX];
} selfcal_coarse_t;

/* levels.c: variances and gains of a linear filter, shared by the axes; an axis's part of one; a switching filter. */
enum { SELFCAL_SWITCHING = 3, SELFCAL_LINEAR = SELFCAL_SWITCHING + 7 };
typedef struct {
    selfcal_real_t walk, stationary;   /* variances of the walk, an interval, and of the drift in the long run */
    selfcal_real_t level, both, drift; /* covariance of level and drift */
    selfcal_real_t gain[2], per_s, ln_s;
} selfcal_linear_t;
typedef struct {
    selfcal_real_t level, drift, ln_p;
} selfcal_linear_cell_t;
typedef struct {
    selfcal_real_t level, variance, upper, ln_p; /* upper: the probability of the upper one */
    uint16_t jumps;
    int8_t side; /* the last one that it was sure of: 1 or -1 */
} selfcal_switching_t;
typedef struct {
    selfcal_real_t per_sigma, before; /* 1/sigma_v; the score of the run before */
    selfcal_linear_cell_t linear[SELFCAL_LINEAR];
    selfcal_switching_t switching[SELFCAL_SWITCHING];
} selfcal_levels_axis_t;
typedef struct {
    bool begun;
    uint32_t n; /* bank samples of this run */
    selfcal_linear_t linear[SELFCAL_LINEAR];
    selfcal_levels_axis_t axis[SELFCAL_AXES_MAX];
} selfcal_levels_t;

struct selfcal_adequacy {
    selfcal_changes_t *changes; /* NULL: they are not looked for */
    void (*look)(selfcal_adequacy_t *self, const selfcal_t *bank, const selfcal_real_t z[], uint32_t gap);
    uint32_t seen, before, length, count, elapsed, used;
    bool any;
    selfcal_real_t first[SELFCAL_ADEQUACY_INPUTS], held[SELFCAL_ADEQUACY_INPUTS];
    selfcal_real_t base[SELFCAL_ADEQUACY_INPUTS], sum[SELFCAL_ADEQUACY_INPUTS];
    float coldest, warmest; /* of the bank intervals' temperatures; NAN: there has been none */
    selfcal_coarse_t coarse;
    selfcal_levels_t levels;
    selfcal_watch_t watch[SELFCAL_AXES_MAX];
    selfcal_judgement_t judgement[SELFCAL_AXES_MAX];
};

/* --- pipe --- */

typedef struct {
    selfcal_gate_t gate;
    uint32_t learn_at; /* windows of rest after which its noise is taken anew */
    uint32_t at_once;  /* its windows of that kind so far */
} selfcal_watched_t;

typedef struct {
    selfcal_former_t former;
    uint32_t skipped;          /* samples before the next one */
    bool with;                 /* the report under way has all regressors of the axis in use */
    selfcal_wide_t ln_without; /* ln evidence of the report without, over the laws */
    selfcal_report_t report_with;
    selfcal_coefficients_t coefficients[SELFCAL_HYPOTHESES_MAX];
    selfcal_sent_coefficient_t sent[SELFCAL_AXES_MAX][SELFCAL_REGRESSORS_MAX]; /* of each axis's last report */
    float values[SELFCAL_REGRESSORS_MAX];                                      /* at the newest sample */
    float rested[SELFCAL_AXES_MAX][SELFCAL_REGRESSORS_MAX]; /* those for which an axis's bias holds */
} selfcal_imu_columns_t;

typedef struct {
    selfcal_adequacy_t adequacy;
    selfcal_judgement_t judged[SELFCAL_AXES_MAX]; /* at each axis's last report */
} selfcal_imu_judge_t;

struct selfcal_kept {
    uint64_t passed;                     /* samples, the missing ones too */
    uint64_t gathered_at;                /* of them, to the end of the last bank interval of the report under way */
    uint64_t rests_on[SELFCAL_AXES_MAX]; /* ... of each axis's last report */
    selfcal_report_t report[SELFCAL_AXES_MAX];
    float reading[SELFCAL_AXES_MAX]; /* the newest */
    bool newer;                      /* than what was last corrected */
};

typedef struct selfcal_imu_tumble selfcal_imu_tumble_t; /* tumble.h */

struct selfcal_imu {
    /* in the caller's memory; NULL: the pipe does not name it */
    selfcal_watched_t *gate;
    selfcal_imu_columns_t *columns;
    selfcal_imu_judge_t *judge;
    selfcal_changes_t *changes; /* with what was learned before a change behind it */
    selfcal_imu_tumble_t *tumble;
    selfcal_kept_t *kept; /* or NULL */
    const selfcal_pipe_t *pipe;
    void *memory;                              /* of the bank */
    selfcal_t *held;                           /* of the report under way, its sums behind it; or NULL */
    uint16_t due;                              /* reports, a bit for each axis */
    uint16_t reported;                         /* axes with a report that is not of the past */
    uint8_t turn;                              /* the axis whose report is looked for first */
    bool watching;                             /* the gate is on */
    bool computing;                            /* a report is worked out */
    bool whole;                                /* it is whole */
    selfcal_reason_t reason[SELFCAL_AXES_MAX]; /* of each axis's last report */
    float bias[SELFCAL_AXES_MAX];              /* likewise; NAN: none */
    selfcal_t bank;
    selfcal_work_t work;
    selfcal_report_t report; /* under way, or the last */
};

/* Bytes of a part, of all that is learned before a change, of the copy for a report, and of the other parts that a
 * model names. */
#define SELFCAL_PART(bytes) (((size_t)(bytes) + 7U) / 8U * 8U)
#define SELFCAL_CHANGES_SIZE(nodes, axes)                                                                              \
    SELFCAL_PART(sizeof(selfcal_changes_t) + (size_t)(nodes) * (axes) * sizeof(float))
#define SELFCAL_HELD_SIZE(nodes, sum_nodes, columns)                                                                   \
    (SELFCAL_PART(sizeof(selfcal_t)) +                                                                                 \
     SELFCAL_PART(SELFCAL_SIZE(nodes, 1) + SELFCAL_REGRESSORS_SIZE(nodes, 1, columns) +                                \
                  SELFCAL_TERMS_SIZE(sum_nodes, 1, columns)))
#define SELFCAL_PARTS_SIZE(nodes, axes, gate, columns, judged, changes)                                                \
    (((gate) ? SELFCAL_PART(sizeof(selfcal_watched_t)) : 0U) +                                                         \
     ((columns) ? SELFCAL_PART(sizeof(selfcal_imu_columns_t)) : 0U) +                                                  \
     ((judged) ? SELFCAL_PART(sizeof(selfcal_imu_judge_t)) : 0U) +                                                     \
     ((changes) ? SELFCAL_CHANGES_SIZE(nodes, axes) : 0U))

/* --- telemetry --- */

struct selfcal_telemetry {
    const selfcal_model_t *model;
    const selfcal_module_t *module;
    const selfcal_sent_coefficient_t *coefficient; /* [regressors of the model], or NULL */
    const selfcal_judgement_t *judgement;          /* of the axis of the report, or NULL */
    uint16_t first_id;                             /* of the node */
    uint8_t message[SELFCAL_AXES_MAX];             /* which axis message each axis has */
    /* of the frames under way */
    uint8_t source;
    uint8_t part; /* of a report */
    uint16_t id;
    const selfcal_report_t *report;
    const selfcal_corrected_t *corrected;
    const uint32_t *word;
    uint32_t answer; /* or the words that are there */
    const selfcal_counters_t *counters;
    selfcal_wide_t ln_best;
    uint32_t report_number;
    uint32_t time_ms;
    selfcal_state_t state;
    uint8_t item;    /* to look at next */
    uint8_t items;   /* past the last one: 0 with nothing under way */
    uint8_t made;    /* frames of this report or status */
    uint32_t frames; /* made since selfcal_telemetry_init() */
};

/* --- one build ---
 * Who calls and who was compiled must mean the same structs: their sizes tell, before any of them is written. */
#define SELFCAL_LAYOUT                                                                                                 \
    ((uint32_t)(sizeof(selfcal_imu_t) + 3U * sizeof(selfcal_t) + 7U * sizeof(selfcal_work_t) +                         \
                31U * sizeof(selfcal_report_t) + 127U * sizeof(selfcal_kept_t) + 8191U * sizeof(selfcal_adequacy_t) +  \
                131071U * sizeof(selfcal_former_t) + 524287U * sizeof(selfcal_gate_t) +                                \
                16777213U * sizeof(selfcal_node_t) + 67108859U * (size_t)SELFCAL_ARITHMETIC))

static inline selfcal_status_t selfcal_imu_init(selfcal_imu_t *imu, const selfcal_pipe_t *pipe, void *memory,
                                                size_t size) {
    return selfcal_imu_init_as(SELFCAL_LAYOUT, imu, pipe, memory, size);
}

static inline selfcal_status_t selfcal_init(selfcal_t *self, const selfcal_model_t *model, void *memory, size_t size) {
    return selfcal_init_as(SELFCAL_LAYOUT, self, model, memory, size);
}

static inline selfcal_status_t selfcal_restore(selfcal_t *self, const selfcal_model_t *model, void *memory, size_t size,
                                               const void *snapshot, size_t length) {
    return selfcal_restore_as(SELFCAL_LAYOUT, self, model, memory, size, snapshot, length);
}

#endif
