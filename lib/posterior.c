/* Posterior: from the bank's sums to evidences, probabilities, moments and quantiles (12)-(14), in slices.
 *
 * For one hypothesis the unknowns are (rho, alpha, sigma_v); the sums give ln p(Y | node, sigma_v) in closed form. With
 * t = ln sigma_v and t^ its mode at a node,
 *     ln p = profile(node) - n_eff (delta + e^(-2 delta)/2 - 1/2),   delta = t - t^,   t^ = ln(residual / n_eff) / 2,
 * so the shape in delta is one for all nodes, and only profile and t^ have to be interpolated between nodes, in ln rho and
 * ln alpha. Both follow from the innovations' variance. What that is expected to be, for data of the law's own best (rho,
 * alpha), has a closed form (expected() below); it carries the terms of order n. A quintic spline takes what is left, of order
 * sqrt(n): the error of the interpolation is that much smaller than that of a spline through the whole. n_eff = n - w: the bias takes the share w = P0 A/(P0 A + sigma_v^2)
 * of one sample, 1 under a wide bias prior; w is taken at the best node (exact for w = 0 or 1, else first order in delta).
 *
 * The integral runs over cells (midpoint rule: for a smooth peak it converges faster than any power of the cell). First
 * passes find the box that holds the posterior, the last one sums. Priors enter per cell, limits by the part of the cell
 * they leave, so the interpolated thing is always the likelihood alone. */
#include "internal.h"

/* Stages of a report. */
enum { FIELDS, FIT, SCAN, SUM, FINISH };

/* ln-likelihood below the peak at which a cell no longer counts: e^-20 of the peak's density. */
#define DEPTH R(20.0)
/* The search ends when a pass shrinks the box by less than this in both dimensions. */
#define SHRINK R(0.7)
#define PASSES_MAX 8U
/* n_eff (delta + e^(-2 delta)/2 - 1/2) at the ends of the sigma_v cells. */
#define SIGMA_DEPTH 13.0

static const selfcal_hypothesis_t *hypothesis_of(const selfcal_work_t *work) {
    return &work->bank->model->hypothesis[work->hypothesis];
}

static uint16_t grid_nodes(const selfcal_grid_t *grid) {
    return grid != NULL ? grid->nodes : 1U;
}

static const selfcal_axis_t *axis_of(const selfcal_work_t *work) {
    return &work->bank->model->axis[work->axis];
}

/* The drift parameter that goes with rho. */
static selfcal_parameter_t drift_parameter(selfcal_law_t law) {
    return law == SELFCAL_GAUSS_MARKOV ? SELFCAL_SIGMA_M : SELFCAL_K;
}

/* ln(parameter) - ln(rho) - ln(sigma_v): K sqrt(dt) = sigma_w = rho sigma_v, sigma_m = rho sigma_v. */
static selfcal_real_t drift_shift(const selfcal_work_t *work) {
    return hypothesis_of(work)->law == SELFCAL_RANDOM_WALK ? R(-0.5) * r_log((selfcal_real_t)work->bank->model->dt_s) : R(0.0);
}

/* ------------------------------------------------------------------------------------------------------------ spline */

/* Knot k of the spline through `nodes` points one apart: six at either end, none at the two points next to them. */
static selfcal_real_t knot(uint16_t nodes, uint16_t k) {
    return k <= 5U ? R(0.0) : (k >= nodes ? (selfcal_real_t)(nodes - 1U) : (selfcal_real_t)(k - 3U));
}

/* Values of the six quintic B-splines that are not zero at z (in steps from the first node), by the Cox-de Boor recursion;
 * the index of the first. Beyond the ends the position is held at the end. */
static uint8_t basis_at(uint16_t nodes, selfcal_real_t z, selfcal_real_t out[6]) {
    z = r_fmin(r_fmax(z, R(0.0)), (selfcal_real_t)(nodes - 1U));
    uint16_t span = 5U;
    while (span + 1U < nodes && z >= knot(nodes, (uint16_t)(span + 1U))) {
        span++;
    }
    out[0] = R(1.0);
    for (uint16_t k = 1; k <= 5U; k++) {
        selfcal_real_t carry = R(0.0);
        for (uint16_t i = 0; i < k; i++) {
            const selfcal_real_t right = knot(nodes, (uint16_t)(span + 1U + i));
            const selfcal_real_t left = knot(nodes, (uint16_t)(span + 1U + i - k));
            const selfcal_real_t part = out[i] / (right - left);
            out[i] = r_fma(right - z, part, carry);
            carry = (z - left) * part;
        }
        out[k] = carry;
    }
    return (uint8_t)(span - 5U);
}

/* Node values [rho][alpha] in work->values become spline coefficients in `out`. */
static void fit(selfcal_work_t *work, selfcal_real_t out[]) {
    const selfcal_hypothesis_t *hypothesis = hypothesis_of(work);
    const uint16_t rows = grid_nodes(hypothesis->rho), columns = grid_nodes(hypothesis->alpha);
    selfcal_wide_t line[SELFCAL_GRID_MAX];
    for (uint16_t j = 0; hypothesis->rho != NULL && j < columns; j++) {
        for (uint16_t i = 0; i < rows; i++) {
            line[i] = 0.0;
            for (uint16_t k = 0; k < rows; k++) {
                line[i] += hypothesis->rho->fit[i * rows + k] * work->values[k * columns + j];
            }
        }
        for (uint16_t i = 0; i < rows; i++) {
            work->values[i * columns + j] = line[i];
        }
    }
    for (uint16_t i = 0; i < rows; i++) {
        for (uint16_t j = 0; j < columns; j++) {
            selfcal_wide_t sum = 0.0;
            for (uint16_t k = 0; hypothesis->alpha != NULL && k < columns; k++) {
                sum += hypothesis->alpha->fit[j * columns + k] * work->values[i * columns + k];
            }
            out[i * columns + j] = (selfcal_real_t)(hypothesis->alpha != NULL ? sum : work->values[i * columns + j]);
        }
    }
}

/* ---------------------------------------------------------------------------------------------------------- expectation */

typedef struct {
    selfcal_real_t ln_v; /* ln of the innovations' variance over sigma_v^2 of the data */
    selfcal_real_t ln_s; /* ln of what the filter itself takes it to be, over its own sigma_v^2 */
} expected_t;

/* The converged filter of (rho, alpha) over white noise and a first-order drift of deviation sqrt(truth[0]) and pole
 * 1 - truth[1]. Its innovations are (1 - phi B)/(1 - psi B) y with psi = phi (1 - K), B the delay; their variance is that of an
 * ARMA(2,1) process, here written so that nothing cancels when the poles are close to 1. */
static expected_t expected(const selfcal_work_t *work, selfcal_real_t ln_rho, selfcal_real_t ln_alpha) {
    selfcal_real_t beta = R(0.0), q = r_exp(R(2.0) * ln_rho);
    if (hypothesis_of(work)->law == SELFCAL_GAUSS_MARKOV) {
        beta = -r_expm1(-r_exp(ln_alpha) * (selfcal_real_t)work->bank->model->dt_s);
        q *= beta * (R(2.0) - beta);
    }
    const selfcal_real_t b = beta * (R(2.0) - beta) - q;
    const selfcal_real_t root = r_sqrt(b * b + R(4.0) * q);
    const selfcal_real_t p_inf = b > R(0.0) ? R(2.0) * q / (b + root) : R(0.5) * (root - b);
    const selfcal_real_t gain = (R(1.0) - beta) * p_inf / (R(1.0) + p_inf); /* phi K */
    const selfcal_real_t p = gain + beta;                                   /* 1 - psi */
    const selfcal_real_t c = work->truth[1];
    const selfcal_real_t white = R(1.0) + gain * gain / (p * (R(2.0) - p));
    const selfcal_real_t drift = (beta * beta * (R(1.0) + (R(1.0) - p) * (R(1.0) - c)) + R(2.0) * (R(1.0) - beta) * p * c) /
                                 (p * (R(2.0) - p) * (p + c - p * c));
    const expected_t e = {r_log(r_fma(work->truth[0], drift, white)), r_log(R(1.0) + p_inf)};
    return e;
}

/* Takes (rho, alpha) as what made the data. A drift slower than the record looks like a random walk within it, and its level
 * is taken up by the bias: the pole is moved to 3/n at equal steps (for a random walk: the mean square about the mean). */
static void set_truth(selfcal_work_t *work, selfcal_real_t ln_rho, selfcal_real_t ln_alpha) {
    const selfcal_real_t cut = R(3.0) / (selfcal_real_t)work->bank->n;
    selfcal_real_t rate = R(0.0), variance = r_exp(R(2.0) * ln_rho);
    if (hypothesis_of(work)->law == SELFCAL_GAUSS_MARKOV) {
        rate = r_exp(ln_alpha) * (selfcal_real_t)work->bank->model->dt_s;
    }
    const selfcal_real_t slow = r_sqrt(rate * rate + cut * cut);
    work->truth[0] = hypothesis_of(work)->law == SELFCAL_GAUSS_MARKOV ? variance * rate / slow : variance / (R(2.0) * slow);
    work->truth[1] = -r_expm1(-slow);
    work->ln_v_peak = expected(work, ln_rho, ln_alpha).ln_v;
}

/* ------------------------------------------------------------------------------------------------------------ fields */

typedef struct {
    selfcal_wide_t ln_sigma, profile;
} field_t;

/* Profile ln-likelihood of a node and ln of the conditional mode of sigma_v, for the given n_eff. */
static field_t node_field(selfcal_work_t *work, uint16_t index, selfcal_wide_t n_eff, selfcal_wide_t *bias_share) {
    selfcal_t *bank = work->bank;
    selfcal_node_view_t v;
    (void)selfcal_node(bank, work->axis, index, &v);
    const selfcal_wide_t n = (selfcal_wide_t)bank->n;
    const selfcal_wide_t sd = (selfcal_wide_t)axis_of(work)->bias_sd;
    const selfcal_wide_t p0 = sd * sd;
    /* A record without any scatter has no likelihood; the floor keeps its logarithm finite, far below any prior. */
    const selfcal_wide_t floor_sd = 1e-9 * sd;
    const selfcal_wide_t residual = fmax(v.c - v.b * v.b / v.a, n_eff * floor_sd * floor_sd);
    const selfcal_wide_t var = residual / n_eff;
    const selfcal_wide_t miss = v.b / v.a + selfcal_offset(bank, work->axis);
    field_t field;
    field.ln_sigma = 0.5 * log(var);
    field.profile = -0.5 * (n * (SELFCAL_LN_2PI + 2.0 * field.ln_sigma) + v.ln_s + n_eff + log1p(p0 * v.a / var) +
                            miss * miss / (var / v.a + p0));
    *bias_share = p0 * v.a / (p0 * v.a + var);
    return field;
}

/* n_eff (delta + e^(-2 delta)/2 - 1/2), and where it reaches SIGMA_DEPTH. */
static selfcal_wide_t sigma_shape(selfcal_wide_t n_eff, selfcal_wide_t delta) {
    return n_eff * (delta + 0.5 * expm1(-2.0 * delta));
}

static selfcal_wide_t sigma_end(selfcal_wide_t n_eff, selfcal_wide_t sign) {
    selfcal_wide_t inside = 0.0, outside = sign * (SIGMA_DEPTH / n_eff + 1.0);
    for (int i = 0; i < 40; i++) {
        const selfcal_wide_t middle = 0.5 * (inside + outside);
        if (sigma_shape(n_eff, middle) < SIGMA_DEPTH) {
            inside = middle;
        } else {
            outside = middle;
        }
    }
    return outside;
}

static void sigma_cells(selfcal_work_t *work) {
    const selfcal_wide_t lo = sigma_end(work->n_eff, -1.0), hi = sigma_end(work->n_eff, 1.0);
    const selfcal_wide_t width = (hi - lo) / SELFCAL_SIGMA_CELLS;
    work->delta_width = (selfcal_real_t)width;
    for (int k = 0; k < SELFCAL_SIGMA_CELLS; k++) {
        const selfcal_wide_t delta = lo + ((selfcal_wide_t)k + 0.5) * width;
        work->delta[k] = (selfcal_real_t)delta;
        work->delta_expm1[k] = (selfcal_real_t)expm1(delta);
        work->delta_weight[k] = (selfcal_real_t)(exp(-sigma_shape(work->n_eff, delta)) * width);
    }
}

static uint16_t nodes_of(const selfcal_work_t *work) {
    return (uint16_t)(grid_nodes(hypothesis_of(work)->rho) * grid_nodes(hypothesis_of(work)->alpha));
}

/* ln of a node's rho and alpha. */
static selfcal_real_t node_ln_rho(const selfcal_work_t *work, uint16_t row) {
    return r_fma((selfcal_real_t)row, work->bank->rho_step[work->hypothesis], work->bank->rho_lo[work->hypothesis]);
}

static selfcal_real_t node_ln_alpha(const selfcal_work_t *work, uint16_t column) {
    return r_fma((selfcal_real_t)column, work->bank->alpha_step[work->hypothesis], work->bank->alpha_lo[work->hypothesis]);
}

/* The best node settles n_eff, by the share of the bias there, and is the first guess of what made the data. */
static void stage_fields(selfcal_work_t *work) {
    const selfcal_wide_t n = (selfcal_wide_t)work->bank->n;
    const uint16_t rows = grid_nodes(hypothesis_of(work)->rho), columns = grid_nodes(hypothesis_of(work)->alpha);
    selfcal_wide_t share = 1.0;
    selfcal_real_t ln_rho = R(0.0), ln_alpha = R(0.0);
    uint16_t index = work->first_node;
    work->peak = (selfcal_wide_t)-INFINITY;
    for (uint16_t i = 0; i < rows; i++) {
        for (uint16_t j = 0; j < columns; j++) {
            selfcal_wide_t node_share;
            const field_t field = node_field(work, index++, n - 1.0, &node_share);
            if (field.profile > work->peak) {
                work->peak = field.profile;
                share = node_share;
                ln_rho = node_ln_rho(work, i);
                ln_alpha = node_ln_alpha(work, j);
            }
        }
    }
    work->n_eff = n - share;
    sigma_cells(work);
    if (hypothesis_of(work)->rho != NULL) {
        set_truth(work, ln_rho, ln_alpha);
    }
}

/* What the expectation says of the two fields; the splines hold the rest. */
static void expected_fields(const selfcal_work_t *work, selfcal_real_t ln_rho, selfcal_real_t ln_alpha, selfcal_real_t *profile,
                            selfcal_real_t *ln_sigma) {
    if (hypothesis_of(work)->rho == NULL) {
        *profile = R(0.0);
        *ln_sigma = R(0.0);
        return;
    }
    const expected_t e = expected(work, ln_rho, ln_alpha);
    *profile = R(-0.5) * (selfcal_real_t)work->bank->n * (e.ln_v - work->ln_v_peak);
    *ln_sigma = R(0.5) * (e.ln_v - e.ln_s);
}

static void stage_fit(selfcal_work_t *work) {
    const uint16_t rows = grid_nodes(hypothesis_of(work)->rho), columns = grid_nodes(hypothesis_of(work)->alpha);
    for (int field = 0; field < 2; field++) {
        uint16_t index = work->first_node;
        for (uint16_t i = 0; i < rows; i++) {
            for (uint16_t j = 0; j < columns; j++) {
                selfcal_wide_t unused;
                selfcal_real_t expected_of[2];
                const field_t exact = node_field(work, index++, work->n_eff, &unused);
                expected_fields(work, node_ln_rho(work, i), node_ln_alpha(work, j), &expected_of[0], &expected_of[1]);
                work->values[i * columns + j] =
                    (field == 0 ? exact.profile - work->peak : exact.ln_sigma) - (selfcal_wide_t)expected_of[field];
            }
        }
        fit(work, field == 0 ? work->profile : work->ln_sigma);
    }
}

/* ------------------------------------------------------------------------------------------------------------- cells */

static uint16_t cells(const selfcal_grid_t *grid) {
    return grid != NULL ? SELFCAL_REPORT_CELLS : 1U;
}

static selfcal_real_t cell_middle(const selfcal_work_t *work, int dimension, uint16_t cell) {
    return work->lo[dimension] + ((selfcal_real_t)cell + R(0.5)) * work->width[dimension];
}

static void set_box(selfcal_work_t *work, const selfcal_real_t lo[2], const selfcal_real_t hi[2]) {
    const selfcal_t *bank = work->bank;
    const selfcal_hypothesis_t *hypothesis = hypothesis_of(work);
    for (int d = 0; d < 2; d++) {
        work->lo[d] = lo[d];
        work->width[d] = (hi[d] - lo[d]) / (selfcal_real_t)cells(d == 0 ? hypothesis->rho : hypothesis->alpha);
    }
    for (uint16_t i = 0; hypothesis->rho != NULL && i < SELFCAL_REPORT_CELLS; i++) {
        const selfcal_real_t z = (cell_middle(work, 0, i) - bank->rho_lo[work->hypothesis]) / bank->rho_step[work->hypothesis];
        work->basis_first[i] = basis_at(hypothesis->rho->nodes, z, work->basis[i]);
    }
}

/* The widest box that the priors permit. */
static void first_box(selfcal_work_t *work) {
    const selfcal_hypothesis_t *hypothesis = hypothesis_of(work);
    const selfcal_prior_t *prior = axis_of(work)->prior;
    const selfcal_real_t half_ln_dt = R(0.5) * r_log((selfcal_real_t)work->bank->model->dt_s);
    for (int d = 0; d < 2; d++) {
        work->limit_lo[d] = R(0.0);
        work->limit_hi[d] = R(1.0); /* a dimension the law has not: one cell of unit width */
    }
    if (hypothesis->alpha != NULL) {
        work->limit_lo[1] = (selfcal_real_t)prior[SELFCAL_ALPHA].ln_min;
        work->limit_hi[1] = (selfcal_real_t)prior[SELFCAL_ALPHA].ln_max;
    }
    if (hypothesis->rho != NULL) {
        const selfcal_prior_t *drift = &prior[drift_parameter(hypothesis->law)];
        work->limit_lo[0] = (selfcal_real_t)drift->ln_min - (selfcal_real_t)prior[SELFCAL_N].ln_max + half_ln_dt -
                            drift_shift(work);
        work->limit_hi[0] = (selfcal_real_t)drift->ln_max - (selfcal_real_t)prior[SELFCAL_N].ln_min + half_ln_dt -
                            drift_shift(work);
    }
    set_box(work, work->limit_lo, work->limit_hi);
}

/* One row of cells: coefficients of the two splines in rho, alpha taken out. */
typedef struct {
    selfcal_real_t profile[SELFCAL_GRID_MAX], ln_sigma[SELFCAL_GRID_MAX];
    selfcal_real_t basis[6]; /* of alpha */
    uint8_t basis_first;
    selfcal_real_t ln_alpha, shift;
} row_t;

static void make_row(const selfcal_work_t *work, row_t *row) {
    const selfcal_hypothesis_t *hypothesis = hypothesis_of(work);
    const uint16_t rows = grid_nodes(hypothesis->rho), columns = grid_nodes(hypothesis->alpha);
    row->ln_alpha = cell_middle(work, 1, work->row);
    row->shift = drift_shift(work);
    uint16_t taps = 1;
    row->basis_first = 0;
    row->basis[0] = R(1.0);
    if (hypothesis->alpha != NULL) {
        const selfcal_t *bank = work->bank;
        const selfcal_real_t z = (row->ln_alpha - bank->alpha_lo[work->hypothesis]) / bank->alpha_step[work->hypothesis];
        row->basis_first = basis_at(hypothesis->alpha->nodes, z, row->basis);
        taps = 6;
    }
    for (uint16_t i = 0; i < rows; i++) {
        row->profile[i] = R(0.0);
        row->ln_sigma[i] = R(0.0);
        for (uint16_t j = 0; j < taps; j++) {
            const size_t at = (size_t)i * columns + row->basis_first + j;
            row->profile[i] = r_fma(row->basis[j], work->profile[at], row->profile[i]);
            row->ln_sigma[i] = r_fma(row->basis[j], work->ln_sigma[at], row->ln_sigma[i]);
        }
    }
}

typedef struct {
    selfcal_real_t ln_rho, profile, ln_sigma;
    bool off_grid;
} cell_t;

static void make_cell(const selfcal_work_t *work, const row_t *row, uint16_t i, cell_t *cell) {
    const selfcal_hypothesis_t *hypothesis = hypothesis_of(work);
    cell->off_grid = false;
    cell->ln_rho = R(0.0);
    if (hypothesis->rho == NULL) {
        cell->profile = row->profile[0];
        cell->ln_sigma = row->ln_sigma[0];
        return;
    }
    cell->ln_rho = cell_middle(work, 0, i);
    cell->profile = R(0.0);
    cell->ln_sigma = R(0.0);
    const uint8_t first = work->basis_first[i];
    for (uint16_t k = 0; k < 6U; k++) {
        cell->profile = r_fma(work->basis[i][k], row->profile[first + k], cell->profile);
        cell->ln_sigma = r_fma(work->basis[i][k], row->ln_sigma[first + k], cell->ln_sigma);
    }
    /* Beyond the nodes the spline's part is held and the expectation carries on. */
    const selfcal_t *bank = work->bank;
    const selfcal_real_t z = (cell->ln_rho - bank->rho_lo[work->hypothesis]) / bank->rho_step[work->hypothesis];
    cell->off_grid = z < R(0.0) || z > (selfcal_real_t)(hypothesis->rho->nodes - 1U);
    selfcal_real_t profile, ln_sigma;
    expected_fields(work, cell->ln_rho, row->ln_alpha, &profile, &ln_sigma);
    cell->profile += profile;
    cell->ln_sigma += ln_sigma;
}

/* Part of [middle - width/2, middle + width/2] that the prior's limits leave. */
static selfcal_real_t permitted(const selfcal_prior_t *prior, selfcal_real_t middle, selfcal_real_t width) {
    const selfcal_real_t lo = r_fmax(middle - R(0.5) * width, (selfcal_real_t)prior->ln_min);
    const selfcal_real_t hi = r_fmin(middle + R(0.5) * width, (selfcal_real_t)prior->ln_max);
    return hi > lo ? (width > R(0.0) ? (hi - lo) / width : R(1.0)) : R(0.0);
}

/* ln of the parameters at the conditional mode of a cell. */
static void cell_parameters(const selfcal_work_t *work, const row_t *row, const cell_t *cell, selfcal_real_t ln_value[SELFCAL_PARAMETERS]) {
    const selfcal_real_t half_ln_dt = R(0.5) * r_log((selfcal_real_t)work->bank->model->dt_s);
    ln_value[SELFCAL_N] = cell->ln_sigma + half_ln_dt;
    ln_value[SELFCAL_ALPHA] = row->ln_alpha;
    ln_value[SELFCAL_K] = cell->ln_rho + cell->ln_sigma + row->shift;
    ln_value[SELFCAL_SIGMA_M] = ln_value[SELFCAL_K];
}

static bool has_parameter(selfcal_law_t law, unsigned parameter) {
    return parameter == SELFCAL_N || (parameter == SELFCAL_K && law == SELFCAL_RANDOM_WALK) ||
           ((parameter == SELFCAL_SIGMA_M || parameter == SELFCAL_ALPHA) && law == SELFCAL_GAUSS_MARKOV);
}

/* ---------------------------------------------------------------------------------------------------- search of the box */

static void begin_pass(selfcal_work_t *work) {
    work->row = 0;
    for (int d = 0; d < 2; d++) {
        work->found_lo[d] = INFINITY;
        work->found_hi[d] = -INFINITY;
    }
    for (unsigned p = 0; p < SELFCAL_PARAMETERS; p++) {
        work->range_lo[p] = INFINITY;
        work->range_hi[p] = -INFINITY;
    }
}

/* The conditional mode's reach: the sigma_v cells around it. */
static bool reachable(const selfcal_work_t *work, const selfcal_prior_t *prior, selfcal_real_t ln_value, selfcal_real_t extra) {
    return ln_value + work->delta[0] - extra < (selfcal_real_t)prior->ln_max &&
           ln_value + work->delta[SELFCAL_SIGMA_CELLS - 1] + extra > (selfcal_real_t)prior->ln_min;
}

static void scan_row(selfcal_work_t *work) {
    const selfcal_hypothesis_t *hypothesis = hypothesis_of(work);
    const selfcal_prior_t *prior = axis_of(work)->prior;
    const selfcal_parameter_t drift = drift_parameter(hypothesis->law);
    row_t row;
    make_row(work, &row);
    for (uint16_t i = 0; i < cells(hypothesis->rho); i++) {
        cell_t cell;
        selfcal_real_t ln_value[SELFCAL_PARAMETERS];
        make_cell(work, &row, i, &cell);
        cell_parameters(work, &row, &cell, ln_value);
        if (!reachable(work, &prior[SELFCAL_N], ln_value[SELFCAL_N], R(0.0)) ||
            (hypothesis->rho != NULL && !reachable(work, &prior[drift], ln_value[drift], R(0.5) * work->width[0]))) {
            continue;
        }
        if (cell.profile > work->best) {
            work->best = cell.profile;
            work->best_at[0] = cell.ln_rho;
            work->best_at[1] = row.ln_alpha;
            memcpy(work->best_ln, ln_value, sizeof ln_value);
        }
        if (cell.profile < work->best - DEPTH) {
            continue;
        }
        const selfcal_real_t middle[2] = {cell.ln_rho, row.ln_alpha};
        for (int d = 0; d < 2; d++) {
            work->found_lo[d] = r_fmin(work->found_lo[d], middle[d] - R(1.5) * work->width[d]);
            work->found_hi[d] = r_fmax(work->found_hi[d], middle[d] + R(1.5) * work->width[d]);
        }
        for (unsigned p = 0; p < SELFCAL_PARAMETERS; p++) {
            const selfcal_real_t reach = p == SELFCAL_ALPHA ? R(0.0) : R(1.0);
            const selfcal_real_t side = p == SELFCAL_ALPHA ? work->width[1] : (p == SELFCAL_N ? R(0.0) : work->width[0]);
            work->range_lo[p] = r_fmin(work->range_lo[p], ln_value[p] + reach * work->delta[0] - side);
            work->range_hi[p] = r_fmax(work->range_hi[p], ln_value[p] + reach * work->delta[SELFCAL_SIGMA_CELLS - 1] + side);
        }
    }
}

/* Takes what the pass found as the next box; true when the search is over. The first pass only finds the peak, so that the
 * next ones need not keep what lay near an earlier, lower best. */
static bool end_scan(selfcal_work_t *work) {
    if (work->pass == 0U || !(work->found_lo[0] < work->found_hi[0])) {
        return !(work->found_lo[0] < work->found_hi[0]) || hypothesis_of(work)->rho == NULL;
    }
    bool shrunk = false;
    selfcal_real_t hi[2];
    for (int d = 0; d < 2; d++) {
        const bool present = d == 0 ? hypothesis_of(work)->rho != NULL : hypothesis_of(work)->alpha != NULL;
        work->found_lo[d] = r_fmax(work->found_lo[d], work->limit_lo[d]);
        hi[d] = r_fmin(work->found_hi[d], work->limit_hi[d]);
        shrunk = shrunk ||
                 (present && hi[d] - work->found_lo[d] < SHRINK * work->width[d] * (selfcal_real_t)SELFCAL_REPORT_CELLS);
        if (!present) {
            work->found_lo[d] = work->limit_lo[d];
            hi[d] = work->limit_hi[d];
        }
    }
    set_box(work, work->found_lo, hi);
    return !shrunk || work->pass >= PASSES_MAX;
}

/* --------------------------------------------------------------------------------------------------------------- sums */

static void begin_sum(selfcal_work_t *work) {
    work->row = 0;
    work->mass = 0.0;
    work->off_grid = 0.0;
    memset(work->first, 0, sizeof work->first);
    memset(work->second, 0, sizeof work->second);
    memset(work->weight, 0, sizeof work->weight);
    memset(work->weight_sq, 0, sizeof work->weight_sq);
    memset(work->histogram, 0, sizeof work->histogram);
    for (unsigned p = 0; p < SELFCAL_PARAMETERS; p++) {
        const selfcal_prior_t *prior = &axis_of(work)->prior[p];
        work->range_lo[p] = r_fmax(work->range_lo[p], (selfcal_real_t)prior->ln_min);
        work->range_hi[p] = r_fmin(work->range_hi[p], (selfcal_real_t)prior->ln_max);
    }
}

static selfcal_real_t histogram_step(const selfcal_work_t *work, unsigned p) {
    return (work->range_hi[p] - work->range_lo[p]) / (selfcal_real_t)SELFCAL_HISTOGRAM;
}

/* Spreads mass evenly over [middle - width/2, middle + width/2] of a parameter's histogram. */
static void deposit(selfcal_work_t *work, unsigned p, selfcal_real_t middle, selfcal_real_t width, selfcal_real_t mass) {
    const selfcal_real_t step = histogram_step(work, p);
    if (!(step > R(0.0))) {
        return;
    }
    const selfcal_real_t last = (selfcal_real_t)SELFCAL_HISTOGRAM;
    const selfcal_real_t from = r_fmin(r_fmax((middle - R(0.5) * width - work->range_lo[p]) / step, R(0.0)), last);
    const selfcal_real_t to = r_fmin(r_fmax((middle + R(0.5) * width - work->range_lo[p]) / step, R(0.0)), last);
    if (!(to > from)) {
        const int bin = from >= last ? SELFCAL_HISTOGRAM - 1 : (int)from;
        work->histogram[p][bin] += mass;
        return;
    }
    const selfcal_real_t density = mass / (to - from);
    for (int bin = (int)from; bin < SELFCAL_HISTOGRAM && (selfcal_real_t)bin < to; bin++) {
        const selfcal_real_t lo = r_fmax(from, (selfcal_real_t)bin);
        const selfcal_real_t hi = r_fmin(to, (selfcal_real_t)bin + R(1.0));
        work->histogram[p][bin] += density * (hi - lo);
    }
}

static void sum_row(selfcal_work_t *work) {
    const selfcal_hypothesis_t *hypothesis = hypothesis_of(work);
    const selfcal_prior_t *prior = axis_of(work)->prior;
    const selfcal_parameter_t drift = drift_parameter(hypothesis->law);
    const bool has_drift = hypothesis->rho != NULL;
    const uint16_t rows = grid_nodes(hypothesis->rho), columns = grid_nodes(hypothesis->alpha);
    selfcal_real_t row_weight[SELFCAL_GRID_MAX], row_weight_sq[SELFCAL_GRID_MAX];
    memset(row_weight, 0, sizeof row_weight);
    memset(row_weight_sq, 0, sizeof row_weight_sq);
    row_t row;
    make_row(work, &row);
    /* A uniform prior of density 1/(max - min) in the parameter is e^(ln parameter) of that in its logarithm. */
    const selfcal_real_t alpha_density = prior[SELFCAL_ALPHA].uniform && hypothesis->alpha != NULL ? r_exp(row.ln_alpha) : R(1.0);
    selfcal_wide_t row_mass = 0.0;
    const uint16_t last = (uint16_t)(cells(hypothesis->rho) - 1U);
    cell_t before, cell, after;
    make_cell(work, &row, 0, &after);
    cell = after;
    for (uint16_t i = 0; i <= last; i++) {
        selfcal_real_t ln_value[SELFCAL_PARAMETERS];
        before = cell;
        cell = after;
        if (i < last) {
            make_cell(work, &row, (uint16_t)(i + 1U), &after);
        }
        if (cell.profile < work->best - DEPTH) {
            continue;
        }
        cell_parameters(work, &row, &cell, ln_value);
        /* What N and the drift parameter run through from one side of the cell to the other: where the drift hides the white
         * noise, sigma_v falls as rho rises and their product stands still. */
        const selfcal_real_t fall = (after.ln_sigma - before.ln_sigma) / (i == 0U || i == last ? R(1.0) : R(2.0));
        const selfcal_real_t n_width = r_fmax(work->delta_width, has_drift ? r_fabs(fall) : R(0.0));
        const selfcal_real_t drift_width = r_fmax(work->delta_width, r_fabs(work->width[0] + fall));
        const selfcal_real_t height = r_exp(cell.profile - work->best) * alpha_density;
        const selfcal_real_t n_off = r_expm1(ln_value[SELFCAL_N] - work->best_ln[SELFCAL_N]);
        const selfcal_real_t drift_off = has_drift ? r_expm1(ln_value[drift] - work->best_ln[drift]) : R(0.0);
        selfcal_real_t mass = R(0.0), n1 = R(0.0), n2 = R(0.0), d1 = R(0.0), d2 = R(0.0);
        for (int k = 0; k < SELFCAL_SIGMA_CELLS; k++) {
            const selfcal_real_t delta = work->delta[k];
            selfcal_real_t w = height * work->delta_weight[k] * permitted(&prior[SELFCAL_N], ln_value[SELFCAL_N] + delta, n_width);
            if (has_drift) {
                w *= permitted(&prior[drift], ln_value[drift] + delta, drift_width);
                if (prior[drift].uniform) {
                    w *= r_exp(ln_value[drift] + delta);
                }
            }
            if (!(w > R(0.0))) {
                continue;
            }
            if (prior[SELFCAL_N].uniform) {
                w *= r_exp(ln_value[SELFCAL_N] + delta);
            }
            const selfcal_real_t e = work->delta_expm1[k];
            const selfcal_real_t n_dev = r_fma(n_off, e, n_off + e);
            const selfcal_real_t d_dev = r_fma(drift_off, e, drift_off + e);
            mass += w;
            n1 = r_fma(w, n_dev, n1);
            n2 = r_fma(w * n_dev, n_dev, n2);
            d1 = r_fma(w, d_dev, d1);
            d2 = r_fma(w * d_dev, d_dev, d2);
            deposit(work, SELFCAL_N, ln_value[SELFCAL_N] + delta, n_width, w);
            if (has_drift) {
                deposit(work, drift, ln_value[drift] + delta, drift_width, w);
            }
        }
        row_mass += (selfcal_wide_t)mass;
        const selfcal_real_t mass_sq = mass + R(2.0) * n1 + n2; /* times (N / best N)^2 */
        work->off_grid += cell.off_grid ? (selfcal_wide_t)mass : 0.0;
        work->first[SELFCAL_N] += (selfcal_wide_t)n1;
        work->second[SELFCAL_N] += (selfcal_wide_t)n2;
        if (has_drift) {
            work->first[drift] += (selfcal_wide_t)d1;
            work->second[drift] += (selfcal_wide_t)d2;
            for (uint16_t k = 0; k < 6U; k++) {
                row_weight[work->basis_first[i] + k] += mass * work->basis[i][k];
                row_weight_sq[work->basis_first[i] + k] += mass_sq * work->basis[i][k];
            }
        } else {
            row_weight[0] += mass;
            row_weight_sq[0] += mass_sq;
        }
    }
    work->mass += row_mass;
    if (hypothesis->alpha != NULL) {
        const selfcal_wide_t dev = expm1((selfcal_wide_t)row.ln_alpha - (selfcal_wide_t)work->best_ln[SELFCAL_ALPHA]);
        work->first[SELFCAL_ALPHA] += row_mass * dev;
        work->second[SELFCAL_ALPHA] += row_mass * dev * dev;
        deposit(work, SELFCAL_ALPHA, row.ln_alpha, work->width[1], (selfcal_real_t)row_mass);
    }
    for (uint16_t i = 0; i < rows; i++) {
        for (unsigned j = 0; j < (hypothesis->alpha != NULL ? 6U : 1U); j++) {
            work->weight[(size_t)i * columns + row.basis_first + j] += row_weight[i] * row.basis[j];
            work->weight_sq[(size_t)i * columns + row.basis_first + j] += row_weight_sq[i] * row.basis[j];
        }
    }
}

/* ------------------------------------------------------------------------------------------------------------- results */

static selfcal_real_t quantile(const selfcal_work_t *work, unsigned p, selfcal_real_t total, selfcal_real_t share) {
    const selfcal_real_t step = histogram_step(work, p);
    selfcal_real_t below = R(0.0);
    const selfcal_real_t wanted = share * total;
    for (int bin = 0; bin < SELFCAL_HISTOGRAM; bin++) {
        const selfcal_real_t mass = work->histogram[p][bin];
        if (below + mass >= wanted && mass > R(0.0)) {
            return work->range_lo[p] + ((selfcal_real_t)bin + (wanted - below) / mass) * step;
        }
        below += mass;
    }
    return work->range_hi[p];
}

/* Mass between two values of ln(parameter). */
static selfcal_real_t mass_between(const selfcal_work_t *work, unsigned p, selfcal_real_t lo, selfcal_real_t hi) {
    const selfcal_real_t step = histogram_step(work, p);
    selfcal_real_t mass = R(0.0);
    for (int bin = 0; bin < SELFCAL_HISTOGRAM; bin++) {
        const selfcal_real_t from = work->range_lo[p] + (selfcal_real_t)bin * step;
        const selfcal_real_t part = r_fmin(hi, from + step) - r_fmax(lo, from);
        if (part > R(0.0) && step > R(0.0)) {
            mass += work->histogram[p][bin] * r_fmin(part / step, R(1.0));
        }
    }
    return mass;
}

static void finish_estimate(const selfcal_work_t *work, unsigned p, selfcal_estimate_t *estimate) {
    const selfcal_prior_t *prior = &axis_of(work)->prior[p];
    const selfcal_wide_t centre = exp((selfcal_wide_t)work->best_ln[p]);
    const selfcal_wide_t mean = work->first[p] / work->mass;
    const selfcal_wide_t variance = fmax(work->second[p] / work->mass - mean * mean, 0.0);
    const selfcal_real_t step = histogram_step(work, p);
    selfcal_real_t total = R(0.0), ln_first = R(0.0), ln_second = R(0.0);
    for (int bin = 0; bin < SELFCAL_HISTOGRAM; bin++) {
        const selfcal_real_t at = ((selfcal_real_t)bin + R(0.5)) * step;
        total += work->histogram[p][bin];
        ln_first = r_fma(work->histogram[p][bin], at, ln_first);
        ln_second = r_fma(work->histogram[p][bin] * at, at, ln_second);
    }
    const selfcal_real_t ln_mean = ln_first / total;
    const selfcal_real_t ln_sd = r_sqrt(r_fmax(ln_second / total - ln_mean * ln_mean, R(0.0)));
    estimate->mean = (float)(centre * (1.0 + mean));
    estimate->sd = (float)(centre * sqrt(variance));
    estimate->median = (float)r_exp(quantile(work, p, total, R(0.5)));
    estimate->q05 = (float)r_exp(quantile(work, p, total, R(0.05)));
    estimate->q95 = (float)r_exp(quantile(work, p, total, R(0.95)));
    const selfcal_real_t lo = (selfcal_real_t)prior->ln_min, hi = (selfcal_real_t)prior->ln_max;
    const selfcal_real_t edge = R(0.02) * (hi - lo);
    uint8_t flags = 0;
    if (mass_between(work, p, lo, lo + edge) > R(0.05) * total) {
        flags |= SELFCAL_AT_MIN;
    }
    if (mass_between(work, p, hi - edge, hi) > R(0.05) * total) {
        flags |= SELFCAL_AT_MAX;
    }
    /* The sd of a log-uniform prior is its width over sqrt(12), taken for a uniform one as well. */
    if (flags == 0U && ln_sd < R(0.5) * (hi - lo) / R(3.4641016)) {
        flags |= SELFCAL_IDENTIFIED;
    }
    if (work->off_grid > 0.01 * work->mass) {
        flags |= SELFCAL_OFF_GRID;
    }
    estimate->flags = flags;
}

/* Posterior means of the basis functions become weights of the node values, in work->values: the mean of anything the spline
 * interpolates is the sum of its node values under them (the transpose of fit()). */
static void cardinal_weights(selfcal_work_t *work, const selfcal_real_t of_basis[]) {
    const selfcal_grid_t *rho = hypothesis_of(work)->rho, *alpha = hypothesis_of(work)->alpha;
    const uint16_t rows = grid_nodes(rho), columns = grid_nodes(alpha);
    selfcal_wide_t line[SELFCAL_GRID_MAX];
    for (uint16_t i = 0; i < rows; i++) {
        for (uint16_t j = 0; j < columns; j++) {
            selfcal_wide_t sum = alpha != NULL ? 0.0 : (selfcal_wide_t)of_basis[i];
            for (uint16_t l = 0; alpha != NULL && l < columns; l++) {
                sum += alpha->fit[l * columns + j] * (selfcal_wide_t)of_basis[i * columns + l];
            }
            work->values[i * columns + j] = sum;
        }
    }
    for (uint16_t j = 0; rho != NULL && j < columns; j++) {
        for (uint16_t i = 0; i < rows; i++) {
            line[i] = 0.0;
            for (uint16_t k = 0; k < rows; k++) {
                line[i] += rho->fit[k * rows + i] * work->values[k * columns + j];
            }
        }
        for (uint16_t i = 0; i < rows; i++) {
            work->values[i * columns + j] = line[i];
        }
    }
}

/* Moments of x0 + drift now: the mean over the nodes, the scatter of their means, and their own variance, which goes with
 * sigma_v^2. How far the bias prior pulls at a node is taken at the posterior mean of sigma_v^2: nothing under a wide prior. */
static void finish_bias(selfcal_work_t *work, selfcal_posterior_t *posterior) {
    const selfcal_wide_t best_n = exp((selfcal_wide_t)work->best_ln[SELFCAL_N]);
    const selfcal_wide_t best_sq = best_n * best_n / (selfcal_wide_t)work->bank->model->dt_s;
    const selfcal_wide_t first = work->first[SELFCAL_N] / work->mass, second = work->second[SELFCAL_N] / work->mass;
    const selfcal_wide_t sd = (selfcal_wide_t)axis_of(work)->bias_sd;
    const selfcal_wide_t prior_precision = best_sq * (1.0 + 2.0 * first + second) / (sd * sd);
    const selfcal_wide_t offset = selfcal_offset(work->bank, work->axis);
    selfcal_wide_t mean = 0.0, scatter = 0.0, own = 0.0;
    for (int pass = 0; pass < 3; pass++) {
        if (pass != 1) {
            cardinal_weights(work, pass == 0 ? work->weight : work->weight_sq);
        }
        for (uint16_t j = 0; j < nodes_of(work); j++) {
            selfcal_node_view_t v;
            (void)selfcal_node(work->bank, work->axis, (uint16_t)(work->first_node + j), &v);
            const selfcal_wide_t variance = 1.0 / (v.a + prior_precision);
            const selfcal_wide_t now = v.drift + (v.b - offset * prior_precision) * variance * v.bias_left;
            const selfcal_wide_t weight = work->values[j] / work->mass;
            if (pass == 0) {
                mean += weight * now;
            } else if (pass == 1) {
                scatter += weight * (now - mean) * (now - mean);
            } else {
                own += weight * best_sq * (v.drift_var + v.bias_left * v.bias_left * variance);
            }
        }
    }
    posterior->bias_mean = (float)(mean + offset);
    posterior->bias_sd = (float)sqrt(fmax(scatter, 0.0) + fmax(own, 0.0));
}

static selfcal_wide_t ln_prior_density(const selfcal_prior_t *prior) {
    const selfcal_wide_t lo = (selfcal_wide_t)prior->ln_min, hi = (selfcal_wide_t)prior->ln_max;
    return -log(prior->uniform ? exp(hi) - exp(lo) : hi - lo);
}

static void finish_hypothesis(selfcal_work_t *work, selfcal_posterior_t *posterior) {
    const selfcal_hypothesis_t *hypothesis = hypothesis_of(work);
    const selfcal_prior_t *prior = axis_of(work)->prior;
    if (!(work->mass > 0.0)) {
        posterior->ln_evidence = (selfcal_wide_t)-INFINITY; /* the priors leave nothing of the likelihood */
        return;
    }
    posterior->ln_evidence = work->peak + (selfcal_wide_t)work->best +
                             log(work->mass * (selfcal_wide_t)work->width[0] * (selfcal_wide_t)work->width[1]);
    for (unsigned p = 0; p < SELFCAL_PARAMETERS; p++) {
        if (has_parameter(hypothesis->law, p)) {
            posterior->ln_evidence += ln_prior_density(&prior[p]);
            finish_estimate(work, p, &posterior->parameter[p]);
        }
    }
    finish_bias(work, posterior);
}

/* (13), and the bias over all hypotheses. */
static void finish_report(const selfcal_work_t *work, selfcal_report_t *report) {
    const selfcal_model_t *model = work->bank->model;
    selfcal_wide_t best = (selfcal_wide_t)-INFINITY, sum = 0.0, mean = 0.0, square = 0.0;
    for (uint8_t h = 0; h < model->hypotheses; h++) {
        best = fmax(best, report->hypothesis[h].ln_evidence + (selfcal_wide_t)model->hypothesis[h].ln_probability);
    }
    for (uint8_t h = 0; h < model->hypotheses; h++) {
        sum += exp(report->hypothesis[h].ln_evidence + (selfcal_wide_t)model->hypothesis[h].ln_probability - best);
    }
    for (uint8_t h = 0; h < model->hypotheses; h++) {
        selfcal_posterior_t *posterior = &report->hypothesis[h];
        const selfcal_wide_t weight = exp(posterior->ln_evidence + (selfcal_wide_t)model->hypothesis[h].ln_probability - best) / sum;
        posterior->probability = (float)weight;
        mean += weight > 0.0 ? weight * (selfcal_wide_t)posterior->bias_mean : 0.0;
    }
    for (uint8_t h = 0; h < model->hypotheses; h++) {
        const selfcal_posterior_t *posterior = &report->hypothesis[h];
        const selfcal_wide_t off = (selfcal_wide_t)posterior->bias_mean - mean, sd = (selfcal_wide_t)posterior->bias_sd;
        square += posterior->probability > 0.0F ? (selfcal_wide_t)posterior->probability * (off * off + sd * sd) : 0.0;
    }
    report->bias_mean = (float)mean;
    report->bias_sd = (float)sqrt(square);
}

/* --------------------------------------------------------------------------------------------------------------- slices */

selfcal_status_t selfcal_report_begin(selfcal_work_t *work, selfcal_t *self, uint8_t axis, selfcal_report_t *report) {
    if (work == NULL || self == NULL || report == NULL || axis >= self->model->axes) {
        return SELFCAL_BAD_ARGUMENT;
    }
    if (selfcal_retired(self, axis)) {
        return SELFCAL_AXIS_RETIRED;
    }
    selfcal_bank_flush(self);
    if (self->n < SELFCAL_REPORT_MIN) {
        return SELFCAL_TOO_SHORT;
    }
    memset(work, 0, sizeof *work);
    work->bank = self;
    work->axis = axis;
    work->stage = FIELDS;
    memset(report, 0, sizeof *report);
    report->axis = axis;
    report->n = self->n;
    for (int h = 0; h < SELFCAL_HYPOTHESES_MAX; h++) {
        selfcal_posterior_t *posterior = &report->hypothesis[h];
        posterior->bias_mean = NAN;
        posterior->bias_sd = NAN;
        for (unsigned p = 0; p < SELFCAL_PARAMETERS; p++) {
            const selfcal_estimate_t nothing = {NAN, NAN, NAN, NAN, NAN, 0};
            posterior->parameter[p] = nothing;
        }
    }
    return SELFCAL_OK;
}

selfcal_status_t selfcal_report_step(selfcal_work_t *work, selfcal_report_t *report) {
    if (work == NULL || report == NULL || work->bank == NULL) {
        return SELFCAL_BAD_ARGUMENT;
    }
    const selfcal_hypothesis_t *hypothesis = hypothesis_of(work);
    const uint16_t rows = cells(hypothesis->alpha);
    switch (work->stage) {
    case FIELDS:
        stage_fields(work);
        work->refined = false;
        work->stage = FIT;
        break;
    case FIT:
        stage_fit(work);
        first_box(work);
        work->best = -INFINITY;
        work->pass = 0;
        begin_pass(work);
        work->stage = SCAN;
        break;
    case SCAN:
        scan_row(work);
        work->row++;
        if (work->row == rows) {
            const bool over = end_scan(work);
            work->pass++;
            if (over && !work->refined && hypothesis->rho != NULL && work->best > (selfcal_real_t)-INFINITY) {
                work->refined = true; /* once more, about the peak that was found */
                set_truth(work, work->best_at[0], work->best_at[1]);
                work->stage = FIT;
            } else if (over) {
                begin_sum(work);
                work->stage = work->best > (selfcal_real_t)-INFINITY ? SUM : FINISH; /* nothing within the priors' limits */
            } else {
                begin_pass(work);
            }
        }
        break;
    case SUM:
        sum_row(work);
        work->row++;
        if (work->row == rows) {
            work->stage = FINISH;
        }
        break;
    default:
        finish_hypothesis(work, &report->hypothesis[work->hypothesis]);
        work->first_node = (uint16_t)(work->first_node + nodes_of(work));
        work->hypothesis++;
        work->stage = FIELDS;
        if (work->hypothesis == work->bank->model->hypotheses) {
            finish_report(work, report);
            work->bank = NULL;
            return SELFCAL_OK;
        }
        break;
    }
    return SELFCAL_BUSY;
}

selfcal_status_t selfcal_report(selfcal_work_t *work, selfcal_t *self, uint8_t axis, selfcal_report_t *report) {
    selfcal_status_t status = selfcal_report_begin(work, self, axis, report);
    if (status != SELFCAL_OK) {
        return status;
    }
    do {
        status = selfcal_report_step(work, report);
    } while (status == SELFCAL_BUSY);
    return status;
}
