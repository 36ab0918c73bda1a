/* Search: finds the rows of alpha that count, and for each of them where in ln rho it counts.
 *
 * A row's cells reach from where the likelihood begins to count to where it ends, and so do the rows. Either range is
 * found by passes of few samples: each shrinks it to those that count and one more, or lets it grow where the last one
 * counts. The nodes say where to begin: their heights are known. */
#include "report_inside.h"

/* ln-likelihood below a row's peak, or a row's peak below the best, at which a cell or row no longer counts: 4.9 sd of
 * a normal one; more of a short record, whose tails are long. */
#define DEPTH R(12.0)
#define DEPTH_OF_SHORT R(80.0) /* over n_eff */
/* The search of a row, or of the rows, ends when a pass shrinks it by less than this, and nothing at its ends counts.
 * Else it grows there. */
#define SHRINK R(0.7)
#define GROWTH R(0.5)
/* A row is looked for where the row before it was. Its peak may lie beyond, by many widths of a long record's. Then the
 * range must outgrow its loss at the other end. */
#define GROWTH_TO_PEAK R(2.0)
#define PASSES_MAX 12U

#define SAMPLES SELFCAL_SEARCH_SAMPLES

static selfcal_real_t sample_at(const selfcal_range_t *range, unsigned i) {
    return r_fma((range->hi - range->lo) / (selfcal_real_t)SAMPLES, (selfcal_real_t)i + R(0.5), range->lo);
}

/* The next range after a pass; false: it stays. `open`: the peak may lie beyond it, until an inner sample is the
 * highest. The highest sample always counts: another row may have been higher by an error of the splines. */
static bool next_range(selfcal_range_t *range, const selfcal_real_t height[SAMPLES], selfcal_real_t least,
                       const selfcal_range_t *limit, bool *open) {
    unsigned top = 0, first = 0, last = SAMPLES - 1U;
    for (unsigned i = 1; i < SAMPLES; i++) {
        top = height[i] > height[top] ? i : top;
    }
    while (first < top && !(height[first] > least)) {
        first++;
    }
    while (last > top && !(height[last] > least)) {
        last--;
    }
    *open = *open && (top == 0U || top == SAMPLES - 1U);
    const selfcal_real_t whole = range->hi - range->lo, step = whole / (selfcal_real_t)SAMPLES;
    const selfcal_real_t below = (*open && top == 0U ? GROWTH_TO_PEAK : GROWTH) * whole,
                         above = (*open && top > 0U ? GROWTH_TO_PEAK : GROWTH) * whole;
    const selfcal_real_t lo = r_fmax(first == 0U ? range->lo - below : sample_at(range, first) - step, limit->lo);
    const selfcal_real_t hi =
        r_fmin(last == SAMPLES - 1U ? range->hi + above : sample_at(range, last) + step, limit->hi);
    if (!(lo < range->lo || hi > range->hi || hi - lo < SHRINK * whole)) {
        return false;
    }
    range->lo = lo;
    range->hi = hi;
    return true;
}

/* Height of a cell's middle at the sigma_v that the limits leave. */
static selfcal_real_t height_of(const selfcal_work_t *work, const cell_t *cell, selfcal_real_t ln_value[],
                                reach_t *reach) {
    selfcal_real_t half[2] = {R(0.0), R(0.0)};
    selfcal_cells_parameters(work, cell, ln_value);
    *reach = selfcal_cells_reach(work, ln_value, half);
    return cell->profile - reach->drop;
}

/* The same, and the search keeps the best of all, which the sums are
 * counted from. */
static selfcal_real_t height_at(selfcal_work_t *work, selfcal_real_t ln_rho) {
    cell_t cell;
    reach_t reach;
    selfcal_real_t ln_value[SELFCAL_PARAMETERS];
    selfcal_cells_make(work, ln_rho, &cell);
    const selfcal_real_t height = height_of(work, &cell, ln_value, &reach);
    if (work->search.best == (selfcal_real_t)-INFINITY) {
        work->sigma.drop[work->hypothesis] = reach.drop; /* until a cell counts: whether the priors exclude it */
    }
    if (work->stage == SEARCH && height > work->search.best) {
        work->search.best = height;
        work->sigma.drop[work->hypothesis] = reach.drop;
        for (unsigned p = 0; p < SELFCAL_PARAMETERS; p++) {
            work->search.best_ln[p] = ln_value[p] + reach.peak;
        }
        work->search.best_ln[SELFCAL_ALPHA] = ln_value[SELFCAL_ALPHA];
    }
    return height > (selfcal_real_t)-INFINITY ? height : (selfcal_real_t)-INFINITY; /* nor NaN */
}

/* Where a row ends between a sample that counts and one that does not: the root of the depth is nearly linear, but
 * where a limit cuts, by halves. */
static selfcal_real_t row_end(selfcal_work_t *work, selfcal_real_t in, selfcal_real_t in_height, selfcal_real_t out,
                              selfcal_real_t out_height) {
    const selfcal_real_t best = work->search.row_best;
    unsigned turns = 0;
    while (in_height > best - PEAK * work->search.depth || out_height < best - R(3.0) * work->search.depth) {
        if (turns++ == 4U) {
            return out;
        }
        const selfcal_real_t middle = R(0.5) * (in + out), height = height_at(work, middle);
        if (height > best - work->search.depth) {
            in = middle;
            in_height = height;
        } else {
            out = middle;
            out_height = height;
        }
    }
    const selfcal_real_t inside = r_sqrt(best - in_height), outside = r_sqrt(best - out_height);
    return r_fma((r_sqrt(work->search.depth) - inside) / (outside - inside), out - in, in);
}

/* One pass over the row in hand; true after the last, when work->search.range[0] is where it counts. */
static bool find_row(selfcal_work_t *work) {
    selfcal_range_t *range = &work->search.range[0];
    const selfcal_range_t limit = {work->search.limit_lo[0], work->search.limit_hi[0]};
    if (hypothesis_of(work)->rho == NULL) {
        *range = limit;
        work->search.row_best = height_at(work, R(0.0));
        return true;
    }
    selfcal_real_t height[SAMPLES], best = (selfcal_real_t)-INFINITY;
    for (unsigned i = 0; i < SAMPLES; i++) {
        height[i] = height_at(work, sample_at(range, i));
        best = r_fmax(best, height[i]);
    }
    work->search.row_best = best;
    selfcal_range_t next = *range;
    if (next_range(&next, height, best - work->search.depth, &limit, &work->search.open) && work->at < PASSES_MAX) {
        *range = next;
        return false;
    }
    unsigned first = 0, last = SAMPLES - 1U;
    while (first < last && !(height[first] > best - work->search.depth)) {
        first++;
    }
    while (last > first && !(height[last] > best - work->search.depth)) {
        last--;
    }
    if (first > 0U) {
        next.lo =
            row_end(work, sample_at(range, first), height[first], sample_at(range, first - 1U), height[first - 1U]);
    }
    if (last < SAMPLES - 1U) {
        next.hi = row_end(work, sample_at(range, last), height[last], sample_at(range, last + 1U), height[last + 1U]);
    }
    work->search.least[0] = selfcal_cells_for_peak(height, best - PEAK * work->search.depth, 16);
    *range = next;
    return true;
}

/* A row near the one in hand is looked for where that one is, and half as far beyond. */
static void widen_row(selfcal_search_t *search) {
    selfcal_range_t *range = &search->range[0];
    const selfcal_real_t more = R(0.5) * (range->hi - range->lo);
    search->open = true;
    range->lo = r_fmax(range->lo - more, search->limit_lo[0]);
    range->hi = r_fmin(range->hi + more, search->limit_hi[0]);
}

static selfcal_real_t depth_of(const selfcal_work_t *work) {
    return DEPTH + DEPTH_OF_SHORT / work->n_eff;
}

/* From the node before the first that counts to the node after the last; without end where there is none. */
static selfcal_range_t counted(const selfcal_real_t height[], selfcal_real_t least, unsigned nodes, selfcal_real_t lo,
                               selfcal_real_t step) {
    unsigned first = 0, end = nodes;
    while (first < nodes && !(height[first] > least)) {
        first++;
    }
    while (end > first && !(height[end - 1U] > least)) {
        end--;
    }
    selfcal_range_t range = {-INFINITY, INFINITY};
    if (first > 0U && first < nodes) {
        range.lo = r_fma(step, (selfcal_real_t)(first - 1U), lo);
    }
    if (end > first && end < nodes) {
        range.hi = r_fma(step, (selfcal_real_t)end, lo);
    }
    return range;
}

void selfcal_search_node(selfcal_work_t *work, uint16_t i, uint16_t j, const cell_t *cell) {
    const selfcal_grid_t *rho = hypothesis_of(work)->rho;
    if (rho == NULL) {
        return;
    }
    reach_t reach;
    selfcal_real_t ln_value[SELFCAL_PARAMETERS], *height = work->scratch.grid.row.profile;
    height[i] = height_of(work, cell, ln_value, &reach);
    height[i] = height[i] > (selfcal_real_t)-INFINITY ? height[i] : (selfcal_real_t)-INFINITY; /* nor NaN */
    if (i + 1U == rho->nodes) {
        selfcal_node_column_t *column = &work->scratch.grid.column[j];
        column->height = -INFINITY;
        for (unsigned k = 0; k < rho->nodes; k++) {
            column->height = r_fmax(column->height, height[k]);
        }
        column->range = counted(height, column->height - depth_of(work), rho->nodes,
                                work->bank->rho_lo[work->hypothesis], work->bank->rho_step[work->hypothesis]);
    }
}

static void limit(const selfcal_work_t *work, unsigned dimension, selfcal_range_t *range) {
    const selfcal_range_t all = {work->search.limit_lo[dimension], work->search.limit_hi[dimension]};
    range->lo = r_fmax(range->lo, all.lo);
    range->hi = r_fmin(range->hi, all.hi);
    if (!(range->lo < range->hi)) {
        *range = all;
    }
}

/* A row of the first pass is looked for where it counts in the columns of nodes beside it. */
static void begin_line(const selfcal_work_t *work, selfcal_real_t ln_alpha, selfcal_search_t *search) {
    const selfcal_grid_t *alpha = hypothesis_of(work)->alpha;
    const selfcal_node_column_t *column = work->scratch.grid.column, *other = column;
    if (alpha != NULL) {
        const selfcal_real_t z =
            (ln_alpha - work->bank->alpha_lo[work->hypothesis]) / work->bank->alpha_step[work->hypothesis];
        const unsigned last = alpha->nodes - 2U;
        column += z > R(0.0) ? (z < (selfcal_real_t)last ? (unsigned)z : last) : 0U;
        other = column + 1;
    }
    selfcal_range_t *range = &search->range[0];
    range->lo = r_fmin(column->range.lo, other->range.lo);
    range->hi = r_fmax(column->range.hi, other->range.hi);
    limit(work, 0, range);
    search->open = true;
}

/* Likewise the rows. */
static void begin_rows(const selfcal_work_t *work, selfcal_range_t *range) {
    const selfcal_grid_t *alpha = hypothesis_of(work)->alpha;
    range->lo = -INFINITY;
    range->hi = INFINITY;
    if (alpha != NULL) {
        selfcal_real_t height[SELFCAL_ALPHA_MAX], best = (selfcal_real_t)-INFINITY;
        for (unsigned j = 0; j < alpha->nodes; j++) {
            height[j] = work->scratch.grid.column[j].height;
            best = r_fmax(best, height[j]);
        }
        *range = counted(height, best - depth_of(work), alpha->nodes, work->bank->alpha_lo[work->hypothesis],
                         work->bank->alpha_step[work->hypothesis]);
    }
    limit(work, 1, range);
}

/* No row has shown a parameter's range yet. */
static void forget_ranges(selfcal_integral_t *sum) {
    for (unsigned p = 0; p < SELFCAL_PARAMETERS; p++) {
        sum->range_lo[p] = INFINITY;
        sum->range_hi[p] = -INFINITY;
    }
}

void selfcal_search_begin(selfcal_work_t *work) {
    selfcal_cells_limits(work, &work->search);
    begin_rows(work, &work->search.range[1]);
    work->search.depth = depth_of(work);
    work->search.best = -INFINITY;
    work->search.least[0] = 1;
    work->search.pass = 0;
    work->row = 0;
    forget_ranges(&work->sum);
}

/* Ranges of N and the drift parameter in a row: both are monotonic in rho. */
static void note_ranges(const selfcal_work_t *work, selfcal_integral_t *sum) {
    for (int end = 0; end < 2; end++) {
        cell_t cell;
        selfcal_real_t ln_value[SELFCAL_PARAMETERS];
        selfcal_cells_make(work, end == 0 ? work->search.range[0].lo : work->search.range[0].hi, &cell);
        selfcal_cells_parameters(work, &cell, ln_value);
        for (unsigned p = 0; p < SELFCAL_PARAMETERS; p++) {
            sum->range_lo[p] = r_fmin(sum->range_lo[p], ln_value[p] + work->sigma.lo);
            sum->range_hi[p] = r_fmax(sum->range_hi[p], ln_value[p] + work->sigma.hi);
        }
    }
}

/* One pass over one of the rows. True when all ranges are found. */
bool selfcal_search_step(selfcal_work_t *work) {
    const bool rows = hypothesis_of(work)->alpha != NULL;
    selfcal_range_t *range = &work->search.range[1];
    if (work->at == 0U) {
        const selfcal_real_t ln_alpha = rows ? sample_at(range, work->row) : R(0.0);
        if (work->search.pass == 0U) {
            begin_line(work, ln_alpha, &work->search);
        } else {
            widen_row(&work->search);
        }
        selfcal_cells_row(work, ln_alpha, &work->scratch.grid.row);
    }
    work->at++;
    if (!find_row(work)) {
        return false;
    }
    work->at = 0;
    work->scratch.grid.height[work->row] = work->search.row_best;
    work->scratch.grid.found[work->row] = work->search.range[0];
    work->scratch.grid.least[work->row] = work->search.least[0];
    if (work->search.row_best > work->search.best - work->search.depth) {
        note_ranges(work, &work->sum);
    }
    work->row++;
    if (rows && work->row < SAMPLES) {
        return false;
    }
    const selfcal_range_t limit = {work->search.limit_lo[1], work->search.limit_hi[1]};
    const selfcal_range_t before = *range;
    bool open = false;
    /* After the last pass the range stays what the rows found belong to. */
    if (rows && work->search.pass < PASSES_MAX &&
        next_range(range, work->scratch.grid.height, work->search.best - work->search.depth, &limit, &open)) {
        work->search.pass++;
        /* It does not grow again beyond a row that did not count. */
        work->search.limit_lo[1] = range->lo > before.lo ? range->lo : work->search.limit_lo[1];
        work->search.limit_hi[1] = range->hi < before.hi ? range->hi : work->search.limit_hi[1];
        /* Huge samples shrink the range to a few roundings at the prior's end: there at may be all samples. */
        const selfcal_real_t at = (range->lo - before.lo) / (before.hi - before.lo) * (selfcal_real_t)SAMPLES;
        work->search.range[0] =
            work->scratch.grid.found[at > R(0.0) ? (unsigned)r_fmin(at, (selfcal_real_t)(SAMPLES - 1U)) : 0U];
        work->row = 0;
        forget_ranges(&work->sum);
        return false;
    }
    work->search.least[1] =
        rows ? selfcal_cells_for_peak(work->scratch.grid.height, work->search.best - PEAK * work->search.depth, 32)
             : 1U;
    return true;
}
