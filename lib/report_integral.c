/* Integral: over the cells of the rows that the search has found, by the midpoint rule. For a smooth peak it converges
 * faster than any power of the cell. sigma_v is integrated in closed form, but in cells that the priors' limits cut. */
#include "report_inside.h"

/* Cells of a row that one step sums. One that a limit cuts counts as so many, and so do sigma_v's cells laid anew. */
#define COST_OF_CUT 5U
#define COST_OF_LAYING 8U
/* A row of the sums is taken so much wider, either way, than the rows of the search beside it say. */
#define BEYOND R(0.04)
#define SAMPLES SELFCAL_SEARCH_SAMPLES

/* Part of [*middle - width/2, *middle + width/2] that the prior's limits leave, whose middle *middle becomes. */
static selfcal_real_t permitted(const selfcal_prior_t *prior, selfcal_real_t *middle, selfcal_real_t width) {
    const selfcal_real_t lo = r_fmax(*middle - R(0.5) * width, (selfcal_real_t)prior->ln_min);
    const selfcal_real_t hi = r_fmin(*middle + R(0.5) * width, (selfcal_real_t)prior->ln_max);
    *middle = R(0.5) * (lo + hi);
    return hi > lo ? (hi - lo) / width : R(0.0);
}

/* Nats that interpolation may be wrong by. They move a mean by at most as many sd. */
#define WRONG_MOST R(0.05)
/* Largest error of the quintic spline over the mean of sixth differences, their signs apart, at steps of 1.
 * What the data put into a node's sums looks, as a function of ln rho or ln alpha, like white noise smoothed by
 * 1/(1 + e^2x), whose spectrum falls as e^(-pi |s|/2). Both follow from that spectrum: the error over the square of the
 * step is 5.2e-3 to 7e-3 of the largest difference at steps of 0.5 to 1. The largest is pi/2 of the mean. */
#define PER_SIXTH R(9e-3)

/* Mean of the four sixth differences about the nodes `z` and `z` + 1 of a line of node values, `stride` apart.
 * Their signs do not count. Fewer than seven nodes have no sixth difference, and show nothing. */
static selfcal_real_t sixth_difference(const selfcal_real_t line[], size_t stride, uint16_t nodes, int z) {
    static const selfcal_real_t binomial[7] = {R(1.0), R(-6.0), R(15.0), R(-20.0), R(15.0), R(-6.0), R(1.0)};
    const int last = (int)nodes - 7;
    selfcal_real_t mean = last < 0 ? (selfcal_real_t)INFINITY : R(0.0);
    for (int i = z - 4; i < z && last >= 0; i++) {
        const int first = i < 0 ? 0 : (i < last ? i : last); /* at an end the last counts for those beyond */
        selfcal_real_t sum = R(0.0);
        for (int k = 0; k < 7; k++) {
            sum = r_fma(binomial[k], line[(size_t)(first + k) * stride], sum);
        }
        mean = r_fma(R(0.25), r_fabs(sum), mean);
    }
    return mean;
}

/* The node at or below the middle of a range, not the last. */
static int node_below(selfcal_real_t middle, selfcal_real_t lo, selfcal_real_t step, uint16_t nodes) {
    const selfcal_real_t z = r_fmin(r_fmax((middle - lo) / step, R(0.0)), (selfcal_real_t)(nodes - 2U));
    return (int)z;
}

/* Whether nodes or lines are too far apart for the record. The spline carries a change that is slow from node to node;
 * sixth differences grow with a fast one. tests/ACCURACY.md has how often this errs. */
static bool too_coarse(const selfcal_work_t *work) {
    const selfcal_hypothesis_t *hypothesis = hypothesis_of(work);
    if (hypothesis->rho == NULL) {
        return false;
    }
    const selfcal_t *bank = work->bank;
    const selfcal_real_t *value = &work->field[0][work->first_node];
    const uint16_t rows = grid_nodes(hypothesis->rho), columns = grid_nodes(hypothesis->alpha);
    unsigned top = 0;
    for (unsigned i = 1; hypothesis->alpha != NULL && i < SAMPLES; i++) {
        top = work->scratch.grid.height[i] > work->scratch.grid.height[top] ? i : top;
    }
    const selfcal_range_t *found = &work->scratch.grid.found[top], *alpha = &work->search.range[1];
    const selfcal_real_t step = bank->rho_step[work->hypothesis], other = bank->alpha_step[work->hypothesis];
    const int row = node_below(R(0.5) * (found->lo + found->hi), bank->rho_lo[work->hypothesis], step, rows);
    const selfcal_real_t part = ((selfcal_real_t)top + R(0.5)) / (selfcal_real_t)SAMPLES;
    const int column = columns < 2U ? 0
                                    : node_below(r_fma(alpha->hi - alpha->lo, part, alpha->lo),
                                                 bank->alpha_lo[work->hypothesis], other, columns);
    selfcal_real_t along = R(0.0), across = R(0.0);
    for (int i = 0; i < (columns < 2U ? 1 : 2); i++) {
        along = r_fmax(along, sixth_difference(&value[column + i], columns, rows, row));
        if (columns >= 2U) {
            across = r_fmax(across, sixth_difference(&value[(size_t)(row + i) * columns], 1, columns, column));
        }
    }
    return PER_SIXTH * r_fma(step * step, along, other * other * across) > WRONG_MOST ||
           (has_expectation(work) &&
            selfcal_spectrum_range((selfcal_real_t)bank->weight) > LINES_APART * (selfcal_real_t)(SELFCAL_LINES - 1));
}

void selfcal_integral_begin(selfcal_work_t *work) {
    work->row = 0;
    work->sum.rows = (uint8_t)selfcal_cells_in(work, 1);
    work->sum.mass = work->sum.mass_sq = 0.0;
    /* Then all of the mass counts as off the grid. So it does where no row of the last pass is as high as the best. */
    const bool missed = work->sum.range_lo[SELFCAL_N] > work->sum.range_hi[SELFCAL_N];
    work->sum.off_grid = missed || too_coarse(work) ? (selfcal_wide_t)INFINITY : 0.0;
    memset(work->sum.first, 0, sizeof work->sum.first);
    memset(work->sum.second, 0, sizeof work->sum.second);
    for (int which = 0; which < 2; which++) {
        memset(&work->field[which][work->first_node], 0, nodes_of(work) * sizeof work->field[which][0]);
    }
    memset(work->scratch.grid.histogram, 0, sizeof work->scratch.grid.histogram);
    memset(work->scratch.grid.modes, 0, sizeof work->scratch.grid.modes);
    work->sum.range_lo[SELFCAL_ALPHA] = work->search.range[1].lo;
    work->sum.range_hi[SELFCAL_ALPHA] = work->search.range[1].hi;
    for (unsigned p = 0; p < SELFCAL_PARAMETERS; p++) {
        const selfcal_prior_t *prior = &prior_of(work)[p];
        work->sum.range_lo[p] = r_fmax(work->sum.range_lo[p], (selfcal_real_t)prior->ln_min);
        work->sum.range_hi[p] = r_fmin(work->sum.range_hi[p], (selfcal_real_t)prior->ln_max);
        /* the law lacks it, or no row is as high as the best before */
        if (!(work->sum.range_lo[p] <= work->sum.range_hi[p])) {
            work->sum.range_lo[p] = (selfcal_real_t)prior->ln_min;
            work->sum.range_hi[p] = (selfcal_real_t)prior->ln_max;
        }
    }
}

/* A cell so far above the best of the search, in nats, is no likelihood: the nodes are too far apart for what lies
 * between them. Its mass stays a float, and the report says that the grid does not bear it. */
#define LOST R(30.0)

/* A cell's part of the sums, sigma_v integrated: its mass, its mass times sigma_v^2 over the mode's, and first and
 * second moments of N and of the drift parameter about the best cell, relative. */
typedef struct {
    selfcal_real_t mass, mass_sq, first[2], second[2];
} sums_t;

/* N or the drift parameter in a cell. */
typedef struct {
    const selfcal_prior_t *prior;
    /* at sigma_v's conditional mode; what it runs through at each sigma_v of the cell */
    selfcal_real_t ln_value, width;
    selfcal_real_t off; /* from the best cell, relative */
    bool cut;           /* the limits do not leave all of it */
    spread_t spread;
} side_t;

/* Where nothing cuts sigma_v: its moments are those of all such cells, and their histograms receive it at the end
 * (add_modes() below). */
static sums_t sum_whole(const selfcal_work_t *work, const side_t side[2], unsigned sides, selfcal_real_t height) {
    const selfcal_real_t e = work->sigma.first, e_sq = work->sigma.second;
    sums_t sum = {height * work->sigma.mass, R(0.0), {R(0.0), R(0.0)}, {R(0.0), R(0.0)}};
    sum.mass_sq = sum.mass * (R(1.0) + e + e + e_sq);
    for (unsigned j = 0; j < sides; j++) {
        const selfcal_real_t off = side[j].off, per = R(1.0) + off;
        sum.first[j] = sum.mass * r_fma(per, e, off);
        sum.second[j] = sum.mass * r_fma(off, r_fma(R(2.0) * per, e, off), per * per * e_sq);
        selfcal_histogram_deposit(&side[j].spread, side[j].ln_value, sum.mass);
    }
    return sum;
}

/* Where a limit cuts sigma_v: over its cells, the first of which begins at `from`. */
static sums_t sum_cut(const selfcal_work_t *work, const side_t side[2], unsigned sides, selfcal_real_t height,
                      selfcal_real_t from) {
    const selfcal_real_t width = work->sigma.width;
    sums_t sum = {R(0.0), R(0.0), {R(0.0), R(0.0)}, {R(0.0), R(0.0)}};
    for (int k = 0; k < SELFCAL_SIGMA_CELLS; k++) {
        const selfcal_real_t delta = from + ((selfcal_real_t)k + R(0.5)) * width, e = work->scratch.grid.delta_expm1[k];
        selfcal_real_t w = height * work->scratch.grid.delta_weight[k], ln[2], dev[2];
        for (unsigned j = 0; j < sides; j++) {
            const side_t *s = &side[j];
            ln[j] = s->ln_value + delta;
            dev[j] = r_fma(s->off, e, s->off + e);
            if (s->cut) {
                const selfcal_real_t middle = ln[j];
                w *= permitted(s->prior, &ln[j], s->width);
                const selfcal_real_t moved = ln[j] - middle; /* e^moved of no cell so wide that it falls to 0 */
                dev[j] = r_fma(moved / (R(1.0) + r_fmax(-moved, R(0.0))), R(1.0) + dev[j], dev[j]);
            }
            if (s->prior->law != SELFCAL_LOG_UNIFORM) {
                w *= r_exp(prior_shape(s->prior, ln[j]));
            }
        }
        if (!(w > R(0.0))) {
            continue;
        }
        sum.mass += w;
        sum.mass_sq = r_fma(w * (R(1.0) + e), R(1.0) + e, sum.mass_sq);
        for (unsigned j = 0; j < sides; j++) {
            const selfcal_real_t weighed = w * dev[j];
            sum.first[j] += weighed;
            sum.second[j] = r_fma(weighed, dev[j], sum.second[j]);
            selfcal_histogram_deposit(&side[j].spread, ln[j], w);
        }
    }
    return sum;
}

/* `change`: of ln N and of the drift parameter from one side of the cell to the other, at sigma_v's mode; `profile`: ln
 * height there. `cost`: in cells that nothing cuts. */
static sums_t sum_cell(selfcal_work_t *work, const selfcal_real_t ln_value[], selfcal_real_t profile,
                       selfcal_real_t density, const selfcal_real_t change[2], unsigned *cost) {
    const selfcal_hypothesis_t *hypothesis = hypothesis_of(work);
    const unsigned sides = hypothesis->rho != NULL ? 2U : 1U;
    /* What N and the drift parameter run through from one side of the cell to the other: where the drift hides the
     * white noise, sigma_v falls as rho rises and their product stands still. */
    selfcal_real_t half[2] = {R(0.5) * r_fabs(change[0]), R(0.5) * r_fabs(change[1])};
    const reach_t reach = selfcal_cells_reach(work, ln_value, half);
    sums_t sum = {R(0.0), R(0.0), {R(0.0), R(0.0)}, {R(0.0), R(0.0)}};
    /* nor NaN */
    if (!(reach.from < reach.to) || !(profile - reach.drop > work->search.best - R(3.0) * work->search.depth)) {
        return sum;
    }
    if (profile - reach.drop > work->search.best + LOST) {
        work->sum.off_grid = (selfcal_wide_t)INFINITY;
    }
    const selfcal_real_t height = r_exp(r_fmin(profile - work->search.best - reach.base, LOST)) * density;
    side_t side[2];
    bool whole = reach.from == work->sigma.lo && reach.to == work->sigma.hi;
    for (unsigned j = 0; j < sides; j++) {
        const unsigned p = j == 0U ? SELFCAL_N : work->scratch.grid.row.drift;
        side_t *s = &side[j];
        s->prior = &work->scratch.grid.row.prior[p];
        s->ln_value = ln_value[p];
        s->off = r_expm1(ln_value[p] - work->search.best_ln[p]);
        s->cut = s->ln_value + reach.from - half[j] < (selfcal_real_t)s->prior->ln_min ||
                 s->ln_value + reach.to + half[j] > (selfcal_real_t)s->prior->ln_max;
        whole = whole && !s->cut && s->prior->law == SELFCAL_LOG_UNIFORM;
    }
    for (unsigned j = 0; j < sides && whole; j++) {
        const unsigned p = j == 0U ? SELFCAL_N : work->scratch.grid.row.drift;
        side[j].spread = selfcal_histogram_spread(work, p, work->scratch.grid.modes[j],
                                                  r_fmax(R(2.0) * half[j], selfcal_histogram_step(work, p)));
    }
    if (whole) {
        return sum_whole(work, side, sides, height);
    }
    *cost = COST_OF_CUT + (selfcal_sigma_cells(work, reach.from, reach.to, reach.base) ? COST_OF_LAYING : 0U);
    const selfcal_real_t width = work->sigma.width;
    for (unsigned j = 0; j < sides; j++) {
        const unsigned p = j == 0U ? SELFCAL_N : work->scratch.grid.row.drift;
        side_t *s = &side[j];
        s->width = r_fmax(width, R(2.0) * half[j]);
        s->spread = selfcal_histogram_spread(work, p, work->scratch.grid.histogram[p], s->width);
        const selfcal_real_t side_half = R(0.5) * s->width;
        s->cut = s->ln_value + reach.from - side_half < (selfcal_real_t)s->prior->ln_min ||
                 s->ln_value + reach.to + side_half > (selfcal_real_t)s->prior->ln_max;
    }
    return sum_cut(work, side, sides, height, reach.from);
}

/* Weight of the cell i of `count`, alike from either end: the midpoint rule, which errs by h^2/24 times the slope at an
 * end that the limits cut, less that (Press et al., Numerical Recipes, 4.1.4). */
static selfcal_real_t cell_weight(unsigned count, unsigned i) {
    static const selfcal_real_t of_end[3] = {R(13.0) / R(12.0), R(7.0) / R(8.0), R(25.0) / R(24.0)};
    const unsigned from_end = i < count - 1U - i ? i : count - 1U - i;
    return count > 1U && from_end < 3U ? of_end[from_end] : R(1.0);
}

/* The next row of the sums, which counts where those of the search beside it do, and a little beyond. */
static void begin_row(const selfcal_work_t *work, selfcal_search_t *search, selfcal_cell_row_t *row) {
    const selfcal_range_t *range = &work->search.range[1];
    if (hypothesis_of(work)->alpha == NULL) {
        selfcal_cells_row(work, R(0.0), row);
        return;
    }
    const selfcal_real_t at = ((selfcal_real_t)work->row + R(0.5)) / (selfcal_real_t)work->sum.rows;
    const selfcal_real_t z = r_fmax(at * (selfcal_real_t)SAMPLES - R(0.5), R(0.0));
    const unsigned i = z < (selfcal_real_t)(SAMPLES - 2U) ? (unsigned)z : SAMPLES - 2U;
    const selfcal_range_t *one = &work->scratch.grid.found[i], *other = &work->scratch.grid.found[i + 1U];
    const selfcal_real_t part = r_fmin(z - (selfcal_real_t)i, R(1.0));
    const uint8_t *least = &work->scratch.grid.least[i];
    search->least[0] = least[0] > least[1] ? least[0] : least[1];
    const selfcal_real_t lo = r_fma(part, other->lo - one->lo, one->lo), hi = r_fma(part, other->hi - one->hi, one->hi);
    const selfcal_real_t more = BEYOND * (hi - lo);
    search->range[0].lo = r_fmax(lo - more, work->search.limit_lo[0]);
    search->range[0].hi = r_fmin(hi + more, work->search.limit_hi[0]);
    selfcal_cells_row(work, r_fma(range->hi - range->lo, at, range->lo), row);
}

/* Some cells of a row: their sums, and weights of the basis functions of rho. */
typedef struct {
    sums_t sum;
    selfcal_real_t off_grid;
    selfcal_real_t weight[SELFCAL_GRID_MAX], weight_sq[SELFCAL_GRID_MAX];
} part_t;

static void sum_part(selfcal_work_t *work, uint16_t count, part_t *part) {
    const selfcal_hypothesis_t *hypothesis = hypothesis_of(work);
    const unsigned taps = hypothesis->rho != NULL ? 6U : 1U;
    const selfcal_cell_row_t *row = &work->scratch.grid.row;
    const selfcal_range_t range = work->search.range[0];
    const selfcal_real_t wide = (range.hi - range.lo) / (selfcal_real_t)count;
    const selfcal_real_t high = (work->search.range[1].hi - work->search.range[1].lo) / (selfcal_real_t)work->sum.rows;
    selfcal_real_t density = wide * high * cell_weight(work->sum.rows, work->row);
    if (hypothesis->alpha != NULL && row->prior[SELFCAL_ALPHA].law != SELFCAL_LOG_UNIFORM) {
        density *= r_exp(prior_shape(&row->prior[SELFCAL_ALPHA], row->ln_alpha));
    }
    memset(part, 0, sizeof *part);
    cell_t before, cell, after;
    uint16_t i = work->at;
    selfcal_cells_make(work, r_fma(wide, (selfcal_real_t)i + R(0.5), range.lo), &after);
    cell = after;
    if (i > 0U) {
        selfcal_cells_make(work, r_fma(wide, (selfcal_real_t)i - R(0.5), range.lo), &cell);
    }
    for (unsigned spent = 0; i < count && spent < SELFCAL_STEP_CELLS; i++) {
        const bool last = i + 1U == count;
        before = cell;
        cell = after;
        if (!last) {
            selfcal_cells_make(work, r_fma(wide, (selfcal_real_t)i + R(1.5), range.lo), &after);
        }
        selfcal_real_t ln_value[SELFCAL_PARAMETERS];
        selfcal_cells_parameters(work, &cell, ln_value);
        const selfcal_real_t steps = i == 0U || last ? R(1.0) : R(2.0);
        const selfcal_real_t change[2] = {(after.ln_sigma - before.ln_sigma + (after.ln_white - before.ln_white)) /
                                              steps,
                                          wide + (after.ln_sigma - before.ln_sigma) / steps};
        unsigned cost = 1;
        const sums_t sum = sum_cell(work, ln_value, cell.profile, density, change, &cost);
        spent += cost;
        part->sum.mass += sum.mass;
        part->sum.mass_sq += sum.mass_sq;
        part->off_grid += cell.off_grid ? sum.mass : R(0.0);
        for (unsigned j = 0; j < 2U; j++) { /* zero without a drift */
            part->sum.first[j] += sum.first[j];
            part->sum.second[j] += sum.second[j];
        }
        for (unsigned k = 0; k < taps; k++) {
            part->weight[cell.basis_first + k] += sum.mass * cell.basis[k];
            part->weight_sq[cell.basis_first + k] += sum.mass_sq * cell.basis[k];
        }
    }
    work->at = i;
}

void selfcal_integral_step(selfcal_work_t *work) {
    const selfcal_hypothesis_t *hypothesis = hypothesis_of(work);
    const uint16_t rows = grid_nodes(hypothesis->rho), columns = grid_nodes(hypothesis->alpha);
    const selfcal_cell_row_t *row = &work->scratch.grid.row;
    if (work->at == 0U) {
        begin_row(work, &work->search, &work->scratch.grid.row);
    }
    part_t part;
    sum_part(work, selfcal_cells_in(work, 0), &part);
    if (!(part.sum.mass > R(0.0))) {
        return;
    }
    work->sum.mass += (selfcal_wide_t)part.sum.mass;
    work->sum.mass_sq += (selfcal_wide_t)part.sum.mass_sq;
    work->sum.off_grid += (selfcal_wide_t)part.off_grid;
    for (unsigned j = 0; j < 2U; j++) {
        const unsigned p = j == 0U ? SELFCAL_N : row->drift;
        work->sum.first[p] += (selfcal_wide_t)part.sum.first[j];
        work->sum.second[p] += (selfcal_wide_t)part.sum.second[j];
    }
    if (hypothesis->alpha != NULL) {
        work->scratch.grid.histogram[SELFCAL_ALPHA][work->row] +=
            part.sum.mass / cell_weight(work->sum.rows, work->row);
    }
    selfcal_real_t *mean = &work->field[0][work->first_node], *mean_sq = &work->field[1][work->first_node];
    for (uint16_t j = 0; j < rows; j++) {
        for (unsigned k = 0; k < (hypothesis->alpha != NULL ? 6U : 1U); k++) {
            const size_t at = (size_t)j * columns + row->basis_first + k;
            mean[at] = r_fma(part.weight[j], row->basis[k], mean[at]);
            mean_sq[at] = r_fma(part.weight_sq[j], row->basis[k], mean_sq[at]);
        }
    }
}
