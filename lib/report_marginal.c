/* Marginals: sigma_v about its mode, the histograms of the parameters, and the estimates read from them.
 *
 * For one hypothesis the unknowns are (rho, alpha, sigma_v). The sums give ln p(Y | node, sigma_v) in closed form. With
 * t = ln sigma_v and t^ its mode at a node,
 *     ln p = profile(node) - n_eff (delta + e^(-2 delta)/2 - 1/2),   delta = t - t^,
 * so the shape in delta is one for all nodes. n_eff is half the curvature there, of the best node. The shape is exact
 * where the bias takes no share of a sample or a whole one, else to the second order in delta. */
#include "report_inside.h"

/* ln(sigma_v/mode): more than any cell has that counts beside a sound best, and e^(2 of it) is still a float. */
#define DELTA_MOST R(30.0)

/* Where n_eff times that reaches SIGMA_DEPTH, on one side of 0. */
static selfcal_real_t sigma_end(selfcal_real_t n_eff, selfcal_real_t sign) {
    selfcal_real_t inside = R(0.0), outside = sign * (SIGMA_DEPTH / n_eff + R(1.0));
    for (int i = 0; i < 30; i++) {
        const selfcal_real_t middle = R(0.5) * (inside + outside);
        if (n_eff * sigma_shape(middle) < SIGMA_DEPTH) {
            inside = middle;
        } else {
            outside = middle;
        }
    }
    return outside;
}

bool selfcal_sigma_cells(selfcal_work_t *work, selfcal_real_t from, selfcal_real_t to, selfcal_real_t drop) {
    const selfcal_real_t width = (to - from) / (selfcal_real_t)SELFCAL_SIGMA_CELLS;
    if (from == work->sigma.from && width == work->sigma.width) {
        return false;
    }
    work->sigma.from = from;
    work->sigma.width = width;
    const selfcal_real_t n_eff = work->n_eff;
    for (int k = 0; k < SELFCAL_SIGMA_CELLS; k++) {
        const selfcal_real_t delta = from + ((selfcal_real_t)k + R(0.5)) * width;
        work->scratch.grid.delta_expm1[k] = r_expm1(r_fmin(delta, DELTA_MOST));
        work->scratch.grid.delta_weight[k] = r_exp(r_fma(-n_eff, sigma_shape(delta), drop)) * width;
    }
    return true;
}

/* Moments of sigma_v where nothing cuts it: its mass, and means of e^delta - 1 and of its square. */
static void sigma_moments(selfcal_work_t *work) {
    (void)selfcal_sigma_cells(work, work->sigma.lo, work->sigma.hi, R(0.0));
    selfcal_real_t mass = R(0.0), first = R(0.0), second = R(0.0);
    for (int k = 0; k < SELFCAL_SIGMA_CELLS; k++) {
        const selfcal_real_t e = work->scratch.grid.delta_expm1[k], weighed = work->scratch.grid.delta_weight[k] * e;
        mass += work->scratch.grid.delta_weight[k];
        first += weighed;
        second = r_fma(weighed, e, second);
    }
    work->sigma.mass = mass;
    work->sigma.first = first / mass;
    work->sigma.second = second / mass;
}

void selfcal_sigma_step(selfcal_work_t *work, uint16_t nodes) {
    const selfcal_real_t *profile = &work->field[0][work->first_node];
    uint16_t best = 0;
    for (uint16_t k = 1; k < nodes; k++) {
        best = profile[k] > profile[best] ? k : best;
    }
    selfcal_field_t field;
    selfcal_node_field(work, best, &field);
    work->n_eff = (selfcal_real_t)work->bank->weight - field.share;
    work->peak = profile[best];
    work->sigma.lo = sigma_end(work->n_eff, R(-1.0));
    work->sigma.hi = sigma_end(work->n_eff, R(1.0));
    work->sigma.from = work->sigma.hi; /* no cells yet */
    sigma_moments(work);
}

static int bins_of(const selfcal_work_t *work, unsigned p) {
    return p == SELFCAL_ALPHA ? work->sum.rows : SELFCAL_HISTOGRAM;
}

selfcal_real_t selfcal_histogram_step(const selfcal_work_t *work, unsigned p) {
    return (work->sum.range_hi[p] - work->sum.range_lo[p]) / (selfcal_real_t)bins_of(work, p);
}

spread_t selfcal_histogram_spread(const selfcal_work_t *work, unsigned p, selfcal_real_t bins[], selfcal_real_t width) {
    const selfcal_real_t step = selfcal_histogram_step(work, p);
    const selfcal_real_t per_step = step > R(0.0) ? R(1.0) / step : R(0.0);
    const selfcal_real_t half = R(0.5) * width * per_step;
    spread_t spread = {NULL, work->sum.range_lo[p], per_step, half, half > R(0.0) ? R(0.5) / half : R(0.0)};
    spread.bins = bins;
    return spread;
}

void selfcal_histogram_deposit(const spread_t *spread, selfcal_real_t middle, selfcal_real_t mass) {
    const selfcal_real_t last = (selfcal_real_t)SELFCAL_HISTOGRAM;
    const selfcal_real_t at = (middle - spread->lo) * spread->per_step;
    selfcal_real_t edge[2] = {at - spread->half, at + spread->half}, density = mass * spread->per_width;
    if (edge[0] < R(0.0) || edge[1] > last) {
        edge[0] = r_fmin(r_fmax(edge[0], R(0.0)), last);
        edge[1] = r_fmin(r_fmax(edge[1], R(0.0)), last);
        if (!(edge[0] < edge[1])) {
            edge[0] = r_fmin(edge[0], last - R(1.0));
            edge[1] = edge[0] + R(1.0);
        }
        density = mass / (edge[1] - edge[0]);
    }
    for (int j = 0; j < 2; j++) {
        const int bin = (int)edge[j];
        const selfcal_real_t share = density * (edge[j] - (selfcal_real_t)bin);
        spread->bins[bin] += density - share;
        spread->bins[bin + 1] += share;
        density = -density;
    }
}

/* Within a bin the density is taken as linear, its slope from the bins beside it. */
static selfcal_real_t quantile(const selfcal_work_t *work, unsigned p, selfcal_real_t total, selfcal_real_t share) {
    const selfcal_real_t step = selfcal_histogram_step(work, p), *bins = work->scratch.grid.histogram[p];
    const int last = bins_of(work, p) - 1;
    selfcal_real_t below = R(0.0);
    const selfcal_real_t wanted = share * total;
    for (int bin = 0; bin <= last; bin++) {
        const selfcal_real_t mass = bins[bin], more = wanted - below;
        if (mass >= more && mass > R(0.0)) {
            const selfcal_real_t before = bins[bin > 0 ? bin - 1 : 0], after = bins[bin < last ? bin + 1 : last];
            const selfcal_real_t slope = r_fmin(r_fmax(R(0.5) * (after - before), R(-2.0) * mass), R(2.0) * mass);
            const selfcal_real_t first = mass - R(0.5) * slope; /* density where the bin begins */
            const selfcal_real_t root = first + r_sqrt(r_fmax(r_fma(first, first, R(2.0) * slope * more), R(0.0)));
            return work->sum.range_lo[p] +
                   ((selfcal_real_t)bin + (root > R(0.0) ? r_fmin(R(2.0) * more / root, R(1.0)) : R(1.0))) * step;
        }
        below += mass;
    }
    return work->sum.range_hi[p];
}

/* Mass between two values of ln(parameter). */
static selfcal_real_t mass_between(const selfcal_work_t *work, unsigned p, selfcal_real_t lo, selfcal_real_t hi) {
    const selfcal_real_t step = selfcal_histogram_step(work, p);
    selfcal_real_t mass = R(0.0);
    for (int bin = 0; bin < bins_of(work, p); bin++) {
        const selfcal_real_t from = work->sum.range_lo[p] + (selfcal_real_t)bin * step;
        const selfcal_real_t part = r_fmin(hi, from + step) - r_fmax(lo, from);
        if (part > R(0.0)) { /* step is not 0 then */
            mass += work->scratch.grid.histogram[p][bin] * r_fmin(part / step, R(1.0));
        }
    }
    return mass;
}

/* The masses of cells that nothing cuts, so far at sigma_v's modes, go where sigma_v spreads them. */
static void add_modes(selfcal_work_t *work, unsigned p) {
    const selfcal_real_t *modes = work->scratch.grid.modes[p == SELFCAL_N ? 0 : 1];
    selfcal_real_t *bins = work->scratch.grid.histogram[p], kernel[SELFCAL_HISTOGRAM + 2] = {R(0.0)};
    const selfcal_real_t step = selfcal_histogram_step(work, p),
                         width = (work->sigma.hi - work->sigma.lo) / (selfcal_real_t)SELFCAL_SIGMA_CELLS;
    const int zero = (int)(-work->sigma.lo / step) + 1; /* the bin of a delta of 0 */
    spread_t spread = selfcal_histogram_spread(work, p, kernel, width);
    spread.lo = -((selfcal_real_t)zero + R(0.5)) * step;
    (void)selfcal_sigma_cells(work, work->sigma.lo, work->sigma.hi, R(0.0));
    for (int k = 0; k < SELFCAL_SIGMA_CELLS; k++) {
        selfcal_histogram_deposit(&spread, work->sigma.lo + ((selfcal_real_t)k + R(0.5)) * width,
                                  work->scratch.grid.delta_weight[k] / work->sigma.mass);
    }
    for (int k = 1; k < SELFCAL_HISTOGRAM; k++) {
        kernel[k] += kernel[k - 1];
    }
    const int wide = (int)((work->sigma.hi - work->sigma.lo) / step) + 3,
              most = wide < SELFCAL_HISTOGRAM ? wide : SELFCAL_HISTOGRAM;
    selfcal_real_t mass = R(0.0);
    for (int i = 0; i < SELFCAL_HISTOGRAM; i++) {
        mass += modes[i];
        if (mass > R(0.0)) {
            const int first = i < zero ? zero - i : 0, room = SELFCAL_HISTOGRAM + zero - i,
                      last = most < room ? most : room;
            for (int k = first; k < last; k++) { /* no whole cell reaches beyond the limits */
                bins[i + k - zero] = r_fma(mass, kernel[k], bins[i + k - zero]);
            }
        }
    }
}

/* First and second moment of alpha about the best, relative, from the masses of its rows. The midpoint rule errs by
 * step^2/24 of the slope at an end that the limits cut, of mass times deviation. Three rows give mass and slope there;
 * the deviation's is known, and counts where the mass is even enough to be continued. */
static void alpha_moments(const selfcal_work_t *work, selfcal_real_t moment[2]) {
    const selfcal_real_t step = selfcal_histogram_step(work, SELFCAL_ALPHA), lo = work->sum.range_lo[SELFCAL_ALPHA],
                         best = work->search.best_ln[SELFCAL_ALPHA],
                         *mass = work->scratch.grid.histogram[SELFCAL_ALPHA];
    static const selfcal_real_t of_slope[3] = {R(2.0) / R(24.0), R(-3.0) / R(24.0), R(1.0) / R(24.0)};
    const unsigned rows = work->sum.rows;
    moment[0] = moment[1] = R(0.0);
    bool even[2];
    for (unsigned end = 0; end < 2U; end++) {
        const selfcal_real_t *m = end == 0U ? mass : &mass[rows - 1U];
        const ptrdiff_t next = end == 0U ? 1 : -1;
        even[end] = false;
        if (rows > 2U) {
            const selfcal_real_t there = (R(15.0) * m[0] - R(10.0) * m[next] + R(3.0) * m[2 * next]) / R(8.0);
            even[end] = there > R(0.5) * m[0] && there < R(2.0) * m[0];
            if (even[end]) {
                const selfcal_real_t dev = r_expm1((end == 0U ? lo : work->sum.range_hi[SELFCAL_ALPHA]) - best),
                                     slope = of_slope[0] * m[0] + of_slope[1] * m[next] + of_slope[2] * m[2 * next],
                                     steep = (end == 0U ? -step : step) * there * (R(1.0) + dev) / R(24.0);
                moment[0] += slope * dev + steep;
                moment[1] += (slope * dev + R(2.0) * steep) * dev;
            }
        }
    }
    for (unsigned i = 0; i < rows; i++) {
        const selfcal_real_t dev = r_expm1(lo + ((selfcal_real_t)i + R(0.5)) * step - best);
        selfcal_real_t weight = mass[i];
        for (unsigned end = 0; end < 2U; end++) {
            const unsigned from_end = end == 0U ? i : rows - 1U - i;
            if (!even[end] && rows > 2U && from_end < 3U) {
                weight = r_fma(of_slope[from_end], mass[i], weight);
            }
        }
        moment[0] = r_fma(weight, dev, moment[0]);
        moment[1] = r_fma(weight * dev, dev, moment[1]);
    }
}

void selfcal_histogram_estimate(selfcal_work_t *work, unsigned p, selfcal_estimate_t *estimate) {
    const selfcal_prior_t *prior = &prior_of(work)[p];
    selfcal_real_t moment[2] = {(selfcal_real_t)work->sum.first[p], (selfcal_real_t)work->sum.second[p]};
    if (p == SELFCAL_ALPHA) {
        alpha_moments(work, moment);
    }
    const selfcal_real_t per_mass = R(1.0) / (selfcal_real_t)work->sum.mass;
    const selfcal_real_t centre = r_exp(work->search.best_ln[p]), mean = moment[0] * per_mass;
    const selfcal_real_t variance = r_fmax(r_fma(-mean, mean, moment[1] * per_mass), R(0.0));
    const selfcal_real_t step = selfcal_histogram_step(work, p);
    selfcal_real_t mass = R(0.0), total = R(0.0), ln_first = R(0.0), ln_second = R(0.0);
    for (int bin = 0; bin < SELFCAL_HISTOGRAM && p != SELFCAL_ALPHA; bin++) {
        mass += work->scratch.grid.histogram[p][bin]; /* where there is none, rounding leaves some of either sign */
        work->scratch.grid.histogram[p][bin] = mass;
    }
    if (p != SELFCAL_ALPHA && step > R(0.0)) {
        add_modes(work, p);
    }
    for (int bin = 0; bin < bins_of(work, p); bin++) {
        const selfcal_real_t at = ((selfcal_real_t)bin + R(0.5)) * step;
        mass = work->scratch.grid.histogram[p][bin];
        total += mass;
        ln_first = r_fma(mass, at, ln_first);
        ln_second = r_fma(mass * at, at, ln_second);
    }
    const selfcal_real_t ln_mean = ln_first / total;
    const selfcal_real_t ln_sd = r_sqrt(r_fmax(ln_second / total - ln_mean * ln_mean, R(0.0)));
    /* No cell lies below the limit, but the mean may round there about a best cell far above. */
    estimate->mean = (float)r_fmax(r_fma(centre, mean, centre), r_exp((selfcal_real_t)prior->ln_min));
    estimate->sd = (float)(centre * r_sqrt(variance));
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
    const selfcal_real_t sds = prior->law == SELFCAL_LOG_NORMAL ? R(8.0) : R(3.4641016);
    if (flags == 0U && (prior->measured || ln_sd * sds < R(0.5) * (hi - lo))) {
        flags |= SELFCAL_IDENTIFIED;
    }
    if (work->sum.off_grid > 0.01 * work->sum.mass) {
        flags |= SELFCAL_OFF_GRID;
    }
    estimate->flags = flags;
}
