/* Cells: rows of cells about where the likelihood counts, what the splines and the expectation give there, and the part
 * of sigma_v that the priors' limits leave. */
#include "report_inside.h"

/* A range has two thirds of the cells, which are 0.6 sd of a normal one wide if all are 24; more if it is wider than
 * 6.4 nepers, since moments of the parameters themselves need them narrower than 0.4. One row alone has twice as many:
 * no other evens out what a limit cuts off in it. Of rows five sixths will do: at their ends alpha's moments are known
 * better than by the midpoint rule. */
#define CELLS_LEAST ((selfcal_real_t)SELFCAL_REPORT_CELLS * (R(2.0) / R(3.0)))
#define CELLS_PER_NEPER ((selfcal_real_t)SELFCAL_REPORT_CELLS * (R(2.5) / R(24.0)))
#define ROWS_PER_CELLS (R(5.0) / R(6.0))
#define ROWS_MOST (SELFCAL_HISTOGRAM < 255U ? SELFCAL_HISTOGRAM : 255U) /* of alpha a bin is a row */

uint8_t selfcal_cells_for_peak(const selfcal_real_t height[], selfcal_real_t least, uint8_t on_two) {
    unsigned count = 0;
    for (unsigned i = 0; i < SELFCAL_SEARCH_SAMPLES; i++) {
        count += height[i] > least ? 1U : 0U;
    }
    if (count == 2U) {
        return on_two;
    }
    return count > 2U ? 13U : 64U;
}

uint16_t selfcal_cells_in(const selfcal_work_t *work, unsigned dimension) {
    const selfcal_hypothesis_t *hypothesis = hypothesis_of(work);
    if ((dimension == 0U ? hypothesis->rho : hypothesis->alpha) == NULL) {
        return 1U;
    }
    const selfcal_range_t *range = &work->search.range[dimension];
    const selfcal_real_t wanted =
        (dimension == 0U ? R(1.0) : ROWS_PER_CELLS) * r_fmax(CELLS_PER_NEPER * (range->hi - range->lo), CELLS_LEAST);
    unsigned cells = wanted < (selfcal_real_t)SELFCAL_REPORT_CELLS ? (unsigned)wanted : SELFCAL_REPORT_CELLS;
    if (hypothesis->alpha == NULL) {
        cells = 2U * SELFCAL_REPORT_CELLS;
    }
    /* Splines that hold all of the likelihood are less even than what an expectation leaves. */
    const unsigned least = (has_expectation(work) ? 1U : 2U) * work->search.least[dimension];
    cells = cells < least ? least : cells;
    return (uint16_t)(dimension == 1U && cells > ROWS_MOST ? ROWS_MOST : cells);
}

/* A drift so fast that averaging hides more of the white noise than this, at the frequency where it hides most, is at
 * the edge: the nodes have no place for one that hides more than all. */
#define LEFT_OUT_MOST R(0.9)
/* rho has no end as that part goes to 1, but what is left of the prior goes to 0 with the rest of it. */
#define LEFT_OUT_LIMIT R(0.99999)

selfcal_real_t selfcal_points_gain(const selfcal_work_t *work, selfcal_real_t ln_alpha) {
    const selfcal_model_t *model = work->bank->model;
    return has_pole(work) ? selfcal_averaged(r_exp(ln_alpha) * (selfcal_real_t)model->dt_s, model->block).gain : R(1.0);
}

/* White noise that the drift leaves out at rho = 1, over sigma_v^2. `ln_second`: of alpha or of the ratio. */
static selfcal_real_t left_out_of(const selfcal_work_t *work, selfcal_real_t ln_second) {
    const selfcal_model_t *model = work->bank->model;
    return (selfcal_real_t)selfcal_white_left_out(hypothesis_of(work)->law, (selfcal_wide_t)r_exp(ln_second),
                                                  (selfcal_wide_t)model->dt_s, model->block) /
           selfcal_points_gain(work, ln_second);
}

/* ln(parameter) - ln(rho) - ln(sigma_v): K sqrt(dt) = sigma_w = rho sigma_v; sigma_m = rho sigma_v but for the
 * points' gain. */
static selfcal_real_t drift_shift(const selfcal_work_t *work, selfcal_real_t ln_alpha) {
    return has_walk(hypothesis_of(work)->law) ? -half_ln_dt(work)
                                              : R(-0.5) * r_log(selfcal_points_gain(work, ln_alpha));
}

void selfcal_cells_limits(const selfcal_work_t *work, selfcal_search_t *search) {
    const selfcal_hypothesis_t *hypothesis = hypothesis_of(work);
    const selfcal_prior_t *prior = prior_of(work);
    for (int d = 0; d < 2; d++) {
        search->limit_lo[d] = R(0.0);
        search->limit_hi[d] = R(1.0); /* a dimension the law has not: one cell of unit width */
    }
    if (hypothesis->alpha != NULL) {
        search->limit_lo[1] = (selfcal_real_t)prior[SELFCAL_ALPHA].ln_min;
        search->limit_hi[1] = (selfcal_real_t)prior[SELFCAL_ALPHA].ln_max;
    }
    if (hypothesis->rho != NULL) {
        const selfcal_prior_t *drift = &prior[drift_parameter(hypothesis->law)];
        const selfcal_real_t lo = half_ln_dt(work) - drift_shift(work, search->limit_lo[1]),
                             hi = half_ln_dt(work) - drift_shift(work, search->limit_hi[1]);
        search->limit_lo[0] = (selfcal_real_t)drift->ln_min - (selfcal_real_t)prior[SELFCAL_N].ln_max + lo;
        search->limit_hi[0] = (selfcal_real_t)drift->ln_max - (selfcal_real_t)prior[SELFCAL_N].ln_min + hi;
        /* this far over N/sqrt(dt), farther over sigma_v */
        const selfcal_real_t of_noise = r_exp(R(2.0) * search->limit_hi[0]) * left_out_of(work, search->limit_hi[1]);
        search->limit_hi[0] -= R(0.5) * r_log1p(-r_fmin(of_noise, LEFT_OUT_LIMIT));
    }
}

void selfcal_cells_column(const selfcal_work_t *work, selfcal_real_t ln_alpha, selfcal_cell_row_t *row) {
    const selfcal_hypothesis_t *hypothesis = hypothesis_of(work);
    row->ln_alpha = ln_alpha;
    row->beta = selfcal_expected_beta(work, ln_alpha);
    row->half_ln_dt = half_ln_dt(work);
    row->shift = drift_shift(work, ln_alpha);
    row->left_out = left_out_of(work, ln_alpha);
    row->noise_sq = hypothesis->law->coloured_noise ? r_exp(R(2.0) * ln_alpha) : R(1.0);
    row->prior = prior_of(work);
    row->drift = drift_parameter(hypothesis->law);
    if (work->truth.fitted && has_expectation(work)) {
        selfcal_expected_passed(work, row->beta, row->passed);
    }
}

void selfcal_cells_row(const selfcal_work_t *work, selfcal_real_t ln_alpha, selfcal_cell_row_t *row) {
    const selfcal_hypothesis_t *hypothesis = hypothesis_of(work);
    const uint16_t rows = grid_nodes(hypothesis->rho), columns = grid_nodes(hypothesis->alpha);
    selfcal_cells_column(work, ln_alpha, row);
    uint16_t taps = 1;
    row->basis_first = 0;
    row->basis[0] = R(1.0);
    if (hypothesis->alpha != NULL) {
        const selfcal_t *bank = work->bank;
        const selfcal_real_t z =
            (row->ln_alpha - bank->alpha_lo[work->hypothesis]) / bank->alpha_step[work->hypothesis];
        row->basis_first = selfcal_spline_basis(hypothesis->alpha->nodes, z, row->basis);
        taps = 6;
    }
    for (uint16_t i = 0; i < rows; i++) {
        row->profile[i] = R(0.0);
        row->ln_sigma[i] = R(0.0);
        for (uint16_t j = 0; j < taps; j++) {
            const size_t at = (size_t)i * columns + row->basis_first + j;
            row->profile[i] = r_fma(row->basis[j], work->scratch.grid.spline[0][at], row->profile[i]);
            row->ln_sigma[i] = r_fma(row->basis[j], work->scratch.grid.spline[1][at], row->ln_sigma[i]);
        }
    }
}

selfcal_real_t selfcal_cells_white(const selfcal_work_t *work, selfcal_real_t rho_sq, cell_t *cell) {
    /* N^2/dt = (1 + left) sigma_v^2, so d(ln N) d(ln K) = d(ln sigma_v) d(ln rho)/(1 + left) */
    const selfcal_real_t left = work->scratch.grid.row.left_out * rho_sq;
    cell->ln_white = left > R(0.0) ? R(0.5) * r_log1p(left) : R(0.0);
    cell->profile -= R(2.0) * cell->ln_white;
    return left;
}

void selfcal_cells_make(const selfcal_work_t *work, selfcal_real_t ln_rho, cell_t *cell) {
    const selfcal_cell_row_t *row = &work->scratch.grid.row;
    const selfcal_hypothesis_t *hypothesis = hypothesis_of(work);
    cell->off_grid = false;
    cell->ln_rho = cell->ln_white = R(0.0);
    if (hypothesis->rho == NULL) {
        cell->profile = row->profile[0];
        cell->ln_sigma = row->ln_sigma[0];
        cell->basis_first = 0;
        cell->basis[0] = R(1.0);
        return;
    }
    cell->ln_rho = ln_rho;
    cell->profile = R(0.0);
    cell->ln_sigma = R(0.0);
    const selfcal_t *bank = work->bank;
    const selfcal_real_t z = (cell->ln_rho - bank->rho_lo[work->hypothesis]) / bank->rho_step[work->hypothesis];
    cell->basis_first = selfcal_spline_basis(hypothesis->rho->nodes, z, cell->basis);
    for (uint16_t k = 0; k < 6U; k++) {
        cell->profile = r_fma(cell->basis[k], row->profile[cell->basis_first + k], cell->profile);
        cell->ln_sigma = r_fma(cell->basis[k], row->ln_sigma[cell->basis_first + k], cell->ln_sigma);
    }
    /* Beyond the nodes the spline's part is held and the expectation carries on. */
    cell->off_grid = z < R(0.0) || z > (selfcal_real_t)(hypothesis->rho->nodes - 1U);
    /* without an expectation: up there the drift hides the white noise, sigma_v rho stays */
    if (is_sum(hypothesis->law)) {
        const selfcal_real_t beyond = z - (selfcal_real_t)(hypothesis->rho->nodes - 1U);
        cell->ln_sigma -= r_fmax(beyond, R(0.0)) * bank->rho_step[work->hypothesis];
    }
    expectation_t e;
    selfcal_expected(work, cell->ln_rho, row->ln_alpha, row->beta, row->passed, &e);
    cell->profile += (selfcal_real_t)e.profile;
    cell->ln_sigma += (selfcal_real_t)e.ln_sigma;
    const selfcal_real_t left = selfcal_cells_white(work, e.rho_sq, cell);
    cell->off_grid = cell->off_grid || left * row->noise_sq > LEFT_OUT_MOST * (R(1.0) + left);
}

void selfcal_cells_parameters(const selfcal_work_t *work, const cell_t *cell,
                              selfcal_real_t ln_value[SELFCAL_PARAMETERS]) {
    const selfcal_cell_row_t *row = &work->scratch.grid.row;
    ln_value[SELFCAL_N] = cell->ln_sigma + cell->ln_white + row->half_ln_dt;
    ln_value[SELFCAL_ALPHA] = row->ln_alpha;
    ln_value[SELFCAL_K] = cell->ln_rho + cell->ln_sigma + row->shift;
    ln_value[SELFCAL_SIGMA_M] = ln_value[SELFCAL_K];
}

/* Away from the mode the height falls by SIGMA_DEPTH sooner than about it (the shape is convex), at the peak's slope or
 * faster. */
reach_t selfcal_cells_reach(const selfcal_work_t *work, const selfcal_real_t ln_value[], selfcal_real_t half[2]) {
    const selfcal_hypothesis_t *hypothesis = hypothesis_of(work);
    const selfcal_real_t n_eff = work->n_eff;
    reach_t reach = {-INFINITY, INFINITY, R(0.0), R(0.0), R(0.0)};
    /* drop up to which the cells of [delta_lo, delta_hi] see what the limits leave, measured */
    selfcal_real_t whole = R(6.0);
    for (unsigned j = 0; j < (hypothesis->rho != NULL ? 2U : 1U); j++) {
        const unsigned p = j == 0U ? SELFCAL_N : work->scratch.grid.row.drift;
        const selfcal_prior_t *prior = &work->scratch.grid.row.prior[p];
        const selfcal_real_t lo = (selfcal_real_t)prior->ln_min - ln_value[p],
                             hi = (selfcal_real_t)prior->ln_max - ln_value[p];
        if (j == 0U && (lo > half[j] || hi < -half[j])) {
            half[j] = R(0.0);
            whole = R(6.0);
        }
        reach.from = r_fmax(reach.from, lo - half[j]);
        reach.to = r_fmin(reach.to, hi + half[j]);
    }
    const selfcal_real_t peak = r_fmin(r_fmax(R(0.0), reach.from), reach.to);
    reach.peak = peak;
    reach.drop = n_eff * sigma_shape(peak);
    if (reach.drop < whole && reach.to - reach.from > R(0.3) * (work->sigma.hi - work->sigma.lo)) {
        reach.from = work->sigma.lo;
        reach.to = work->sigma.hi;
        return reach;
    }
    reach.base = reach.drop;
    /* over the slope, 1 - e^(-2 delta) */
    const selfcal_real_t depth = R(0.5) * SIGMA_DEPTH / r_fabs(r_fma(n_eff, peak, -reach.drop));
    reach.from = r_fmax(reach.from, peak + r_fmax(work->sigma.lo, -depth));
    reach.to = r_fmin(reach.to, peak + r_fmin(work->sigma.hi, depth));
    return reach;
}
