/* The report's inside: its stages, and the functions that one file of them calls in another. Not for users.
 *
 *   report.c           the stages in order, probabilities, the bias over all laws
 *   report_node.c      every node once: profile ln-likelihood, sigma_v's mode
 *   report_expected.c  the expected likelihood, taken off before interpolation
 *   report_spectrum.c  the data's spectrum beyond it
 *   report_spline.c    interpolation of the rest
 *   report_cells.c     likelihood and parameters in a cell
 *   report_search.c    where the likelihood counts
 *   report_integral.c  the sums over the cells there
 *   report_marginal.c  sigma_v, histograms, estimates
 *   report_bias.c      the bias now */
#ifndef SELFCAL_REPORT_INSIDE_H
#define SELFCAL_REPORT_INSIDE_H

#include "bank_inside.h"

/* In this order. One step of any takes below 61 000 instructions on a Cortex-M4F without regressors in use, and below a
 * 600 000 on a Cortex-M0: 37 ms at 16 MHz. */
enum {
    GATHER,
    TRUTH,
    FIT,
    SIGMA,
    VALUES,
    SPLINE_PROFILE,
    SPLINE_SIGMA,
    SEARCH,
    SUM,
    WEIGHTS,
    WEIGHTS_SQ,
    BIAS,
    ESTIMATES,
    EVIDENCE,
    WHOLE
};

/* The report that has just begun rests on the same sums as one before it, whose work->batches these are. If they have
 * moved since, it is overtaken. */
static inline void selfcal_again(selfcal_work_t *work, uint32_t batches) {
    work->batches = batches;
    work->gathered = true;
}

/* --- the hypothesis in hand --- */

static inline const selfcal_hypothesis_t *hypothesis_of(const selfcal_work_t *work) {
    return &work->bank->model->hypothesis[work->hypothesis];
}

static inline const selfcal_axis_t *axis_of(const selfcal_work_t *work) {
    return &work->bank->model->axis[work->axis];
}

static inline const selfcal_prior_t *prior_of(const selfcal_work_t *work) {
    return priors_of(work->bank->model, hypothesis_of(work), work->axis);
}

static inline uint16_t nodes_of(const selfcal_work_t *work) {
    return hypothesis_nodes(hypothesis_of(work));
}

/* Where the hypothesis's node k lies. */
static inline selfcal_place_t place_of(const selfcal_work_t *work, uint16_t k) {
    return selfcal_bank_place(work->bank, (uint16_t)(work->first_node + k));
}

/* ln(N) - ln(sigma_v). */
static inline selfcal_real_t half_ln_dt(const selfcal_work_t *work) {
    return R(0.5) * r_log((selfcal_real_t)work->bank->model->dt_s);
}

/* A plain Gauss-Markov law, of one pole at each alpha. */
static inline bool has_pole(const selfcal_work_t *work) {
    return hypothesis_of(work)->alpha != NULL && !is_sum(hypothesis_of(work)->law);
}

static inline bool has_expectation(const selfcal_work_t *work) {
    return hypothesis_of(work)->rho != NULL && !is_sum(hypothesis_of(work)->law);
}

static inline bool has_parameter(const selfcal_law_t *law, unsigned parameter) {
    return parameter == SELFCAL_N || (parameter == SELFCAL_K && has_walk(law)) ||
           (parameter == SELFCAL_SIGMA_M && has_deviation(law)) ||
           (parameter == SELFCAL_ALPHA && (has_alpha(law) || has_ratio(law)));
}

/* Beginning of this step's part of `whole`; work->at becomes its end. */
static inline uint16_t step_part(selfcal_work_t *work, unsigned step, uint16_t whole) {
    const uint16_t from = work->at;
    work->at = (uint16_t)(from + step < whole ? from + step : whole);
    return from;
}

/* ln of a prior's density in ln(parameter) between its limits, but for a constant: ln_prior_density() in report.c. */
static inline selfcal_real_t prior_shape(const selfcal_prior_t *prior, selfcal_real_t ln_value) {
    if (prior->law == SELFCAL_LOG_NORMAL) {
        const selfcal_real_t lo = (selfcal_real_t)prior->ln_min, hi = (selfcal_real_t)prior->ln_max;
        const selfcal_real_t sds =
            (ln_value - R(0.5) * (lo + hi)) * ((selfcal_real_t)(2.0 * SELFCAL_LOG_NORMAL_REACH) / (hi - lo));
        return R(-0.5) * sds * sds;
    }
    return prior->law == SELFCAL_UNIFORM ? ln_value : R(0.0);
}

/* --- nodes --- */

/* Of the hypothesis's node k. */
void selfcal_node_field(const selfcal_work_t *work, uint16_t k, selfcal_field_t *field);

/* Some of all nodes; after the last, the best of those with an expectation is the first guess of the process that
 * made the data. */
void selfcal_node_step_truth(selfcal_work_t *work);

/* Some of the hypothesis's node values, less their expectation: the splines carry these. */
void selfcal_node_step_values(selfcal_work_t *work);

/* --- expectation --- */

/* Expected fields of a filter, and which filter it is. The splines hold the rest. */
typedef struct {
    selfcal_wide_t profile, ln_sigma, ln_v;
    selfcal_real_t rho_sq;
    /* |1 - phi e^(i omega)|^2 = beta_sq + phi distance, |1 - psi e^(i omega)|^2 = p_sq + psi distance */
    selfcal_real_t beta_sq, phi, p_sq, psi;
    selfcal_real_t edge, level; /* see report_spectrum.c */
    selfcal_real_t per_v;       /* inverse of the innovations' variance without lines and edges */
} expectation_t;

/* n ln V beyond which selfcal_real_t would cost 0.02 nat. */
#define WIDE_BEYOND R(2e5)

/* 1 - phi of the drift at an alpha; 0 of a random walk. */
selfcal_real_t selfcal_expected_beta(const selfcal_work_t *work, selfcal_real_t ln_alpha);

/* `beta`: of the alpha. `passed`: selfcal_expected_passed() there; NULL before the lines are fitted. */
void selfcal_expected(const selfcal_work_t *work, selfcal_real_t ln_rho, selfcal_real_t ln_alpha, selfcal_real_t beta,
                      const selfcal_real_t passed[], expectation_t *e);

/* What the drift of one alpha lets pass of each line's power, whatever its rho. */
void selfcal_expected_passed(const selfcal_work_t *work, selfcal_real_t beta, selfcal_real_t passed[SELFCAL_LINES]);

/* A node's mean variance of the noise over sigma_v^2: 1 + truth.noise_less_1 without drift, more beside one that moves
 * within a block. */
selfcal_real_t selfcal_expected_noise(const selfcal_work_t *work, selfcal_real_t rho_sq, selfcal_real_t beta);

/* --- spectrum --- */

/* Of ln omega from 1/n to 6, which stands for pi. */
selfcal_real_t selfcal_spectrum_range(selfcal_real_t weight);

/* Lines are at most so far apart in ln omega. */
#define LINES_APART R(0.55)

/* One node's row of the least squares, and their solution after the last. */
void selfcal_spectrum_step(selfcal_work_t *work);
void selfcal_spectrum_solve(const selfcal_fit_t *fit, selfcal_truth_t *truth);

/* --- spline --- */

/* Values of the six B-splines that are not zero at z (in steps from the first node); the index of the first. Beyond the
 * ends the position is held at the end. */
uint8_t selfcal_spline_basis(uint16_t nodes, selfcal_real_t z, selfcal_real_t out[6]);

/* Node values [rho][alpha] of field `which` become spline coefficients, some lines a step; true after the last.
 * `transposed`: posterior means of the basis functions become weights of the node values. The mean of anything the
 * spline interpolates is the sum of its node values under them. */
bool selfcal_spline_step(selfcal_work_t *work, bool transposed, int which);

/* --- cells --- */

typedef struct {
    selfcal_real_t ln_rho, profile, ln_sigma;
    selfcal_real_t ln_white; /* ln(N) - ln(sigma_v) - ln(dt)/2: white noise that the drift leaves out */
    selfcal_real_t basis[6]; /* of rho */
    uint8_t basis_first;
    bool off_grid;
} cell_t;

/* The part of [sigma.lo, sigma.hi] that counts in a cell: the limits leave it about the height's peak. How far from
 * the conditional mode that peak lies, and how far below it, in ln. Nothing is left unless from < to. */
typedef struct {
    selfcal_real_t from, to, drop, peak;
    /* drop where the limits leave a flank alone or little. Else 0, and all of [sigma.lo, sigma.hi], of which parts do
     * not count */
    selfcal_real_t base;
} reach_t;

/* Part of the depth, at 2.5 sd of a normal one, to which a peak is looked at. */
#define PEAK R(0.25)
/* Least cells of a range by the samples of its search that lie on the peak, three or more of a normal one. Where a
 * limit cuts the likelihood the peak may be narrow in a wide range. `on_two`: where there are two samples; more where
 * nothing narrows the range after the search. */
uint8_t selfcal_cells_for_peak(const selfcal_real_t height[], selfcal_real_t least, uint8_t on_two);

/* Cells of a row (dimension 0), and rows. */
uint16_t selfcal_cells_in(const selfcal_work_t *work, unsigned dimension);

/* Variance of a plain Gauss-Markov law's points over the drift's own, at an alpha: its rho is that of the points. */
selfcal_real_t selfcal_points_gain(const selfcal_work_t *work, selfcal_real_t ln_alpha);

/* The widest ranges of ln rho and ln alpha that the priors permit. */
void selfcal_cells_limits(const selfcal_work_t *work, selfcal_search_t *search);

/* The row of cells at an alpha, and what goes for a column of nodes as well; the cell at a rho; its white noise, of
 * which the profile has none as yet; ln of the parameters at its conditional mode. */
void selfcal_cells_row(const selfcal_work_t *work, selfcal_real_t ln_alpha, selfcal_cell_row_t *row);
void selfcal_cells_column(const selfcal_work_t *work, selfcal_real_t ln_alpha, selfcal_cell_row_t *row);
selfcal_real_t selfcal_cells_white(const selfcal_work_t *work, selfcal_real_t rho_sq, cell_t *cell);
void selfcal_cells_make(const selfcal_work_t *work, selfcal_real_t ln_rho, cell_t *cell);
void selfcal_cells_parameters(const selfcal_work_t *work, const cell_t *cell,
                              selfcal_real_t ln_value[SELFCAL_PARAMETERS]);

/* `half`: N and the drift parameter run through so much from the middle of a cell to its side. So far beyond the
 * limits parts of the cell count. It becomes 0 for N where even that does not bring the mode within them: then the
 * profile as a rule rises as fast to the other side. */
reach_t selfcal_cells_reach(const selfcal_work_t *work, const selfcal_real_t ln_value[], selfcal_real_t half[2]);

/* --- search and integral --- */

/* One pass over one of the rows a step; true when all ranges are found. Before it begins it is told of each node of the
 * hypothesis, one column of rho after the other: node `i` of column `j` as a cell. */
void selfcal_search_node(selfcal_work_t *work, uint16_t i, uint16_t j, const cell_t *cell);
void selfcal_search_begin(selfcal_work_t *work);
bool selfcal_search_step(selfcal_work_t *work);

/* Some cells of a row a step. */
void selfcal_integral_begin(selfcal_work_t *work);
void selfcal_integral_step(selfcal_work_t *work);

/* --- marginals --- */

/* n_eff (delta + e^(-2 delta)/2 - 1/2) at the ends of the sigma_v cells. */
#define SIGMA_DEPTH R(13.0)

/* delta + e^(-2 delta)/2 - 1/2: two terms of delta's order leave one of delta^2. n_eff times the cost in float is 2e-3
 * where n_eff is 10^8. */
static inline selfcal_real_t sigma_shape(selfcal_real_t delta) {
    return r_fma(R(0.5), r_expm1(R(-2.0) * delta), delta);
}

/* Lays the sigma_v cells over [from, to], with weights that are 1 where the ln-likelihood lies `drop` below the mode.
 * False: they lie there. */
bool selfcal_sigma_cells(selfcal_work_t *work, selfcal_real_t from, selfcal_real_t to, selfcal_real_t drop);

/* The best node of the hypothesis settles n_eff, by the share of the bias there, and with it how sigma_v is spread. */
void selfcal_sigma_step(selfcal_work_t *work, uint16_t nodes);

/* How masses of one width go into a parameter's histogram. */
typedef struct {
    selfcal_real_t *bins;
    selfcal_real_t lo, per_step;    /* of ln(parameter) */
    selfcal_real_t half, per_width; /* bins */
} spread_t;

selfcal_real_t selfcal_histogram_step(const selfcal_work_t *work, unsigned p);
spread_t selfcal_histogram_spread(const selfcal_work_t *work, unsigned p, selfcal_real_t bins[], selfcal_real_t width);

/* Spreads mass evenly over the width about a value of ln(parameter). What would lie outside is pushed in. Until
 * selfcal_histogram_estimate() the bins hold differences, each to the one before: a mass as wide as all of them costs
 * no more than one within a bin. */
void selfcal_histogram_deposit(const spread_t *spread, selfcal_real_t middle, selfcal_real_t mass);

void selfcal_histogram_estimate(selfcal_work_t *work, unsigned p, selfcal_estimate_t *estimate);

/* --- bias --- */

/* One node a step. */
void selfcal_bias_step(selfcal_work_t *work);
void selfcal_bias_finish(const selfcal_work_t *work, selfcal_posterior_t *posterior);

#endif
