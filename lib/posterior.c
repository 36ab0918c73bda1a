/* Posterior: from the bank's sums to evidences, probabilities, moments and quantiles (12)-(14), in slices.
 *
 * For one hypothesis the unknowns are (rho, alpha, sigma_v); the sums give ln p(Y | node, sigma_v) in closed form. With
 * t = ln sigma_v and t^ its mode at a node,
 *     ln p = profile(node) - n_eff (delta + e^(-2 delta)/2 - 1/2),   delta = t - t^,
 * so the shape in delta is one for all nodes, and only profile and t^ have to be interpolated between nodes, in ln rho and
 * ln alpha. Both follow from the innovations' variance. What that is expected to be, for data of the best of all nodes, has a
 * closed form (expected() below); it carries the terms of order n. Those of order sqrt(n) say by how much the data's spectrum
 * happens to differ from that one: this is fitted to the nodes of all laws (step_fit() below). A quintic spline takes what is left.
 * Under the priors of the bias and of the coefficients, t^ has no closed form: it is found by turns, with
 *     sigma_v^2 = (residual + noise) / (n - w),   w = P0 A/(P0 A + sigma_v^2),   noise = (1 - w)^2 A (x0^ - x0 prior)^2,
 * w being the share of one sample that the bias takes, 1 under a wide prior. n_eff is half the curvature there, of the best node; the shape
 * is exact for w = 0 or 1, else to the second order in delta. With regressors in use each coefficient takes such a share as well.
 *
 * A report looks at every node once and keeps two numbers of each. A search finds the rows of alpha that count, and for each where in ln rho
 * it counts. The integral then runs over cells of these rows (midpoint rule: for a smooth peak it converges faster than any power of the cell).
 * sigma_v is integrated in closed form, but in cells that the priors' limits cut. Priors enter per cell, limits by the part of the cell they
 * leave, so the interpolated thing is always the likelihood alone. */
#include "internal.h"

/* Stages of a report. One step of any takes below 61 000 instructions on a Cortex-M4F without regressors in use, and below a million on a
 * Cortex-M0: 60 ms at 16 MHz. */
enum { GATHER, TRUTH, FIT, SIGMA, VALUES, SPLINE_PROFILE, SPLINE_SIGMA, SEARCH, SUM, WEIGHTS, WEIGHTS_SQ, BIAS, ESTIMATES, EVIDENCE, WHOLE };
#define STEP_NODES 3U
#define STEP_VALUES 16U
#define STEP_LINES 8U
/* Cells of a row that one step sums. One that a limit cuts counts as so many, and so do sigma_v's cells laid anew. */
#ifdef SELFCAL_FIXED /* as a rule all floats are software there */
#define STEP_CELLS 10U
#else
#define STEP_CELLS 16U
#endif
#define COST_OF_CUT 5U
#define COST_OF_LAYING 8U

/* ln-likelihood below a row's peak, or a row's peak below the best, at which a cell or row no longer counts: 4.9 sd of a normal one;
 * more of a short record, whose tails are long. */
#define DEPTH R(12.0)
#define DEPTH_OF_SHORT R(80.0) /* over n_eff */
/* The search of a row, or of the rows, ends when a pass shrinks it by less than this, and nothing at its ends counts. Else it grows there. */
#define SHRINK R(0.7)
#define GROWTH R(0.5)
#define PASSES_MAX 12U
/* A row of the sums is taken so much wider, either way, than the rows of the search beside it say. */
#define BEYOND R(0.04)
/* n_eff (delta + e^(-2 delta)/2 - 1/2) at the ends of the sigma_v cells. */
#define SIGMA_DEPTH R(13.0)
/* ln(sigma_v/mode): more than any cell has that counts beside a sound best, and e^(2 of it) is still a float. */
#define DELTA_MOST R(30.0)

static const selfcal_hypothesis_t *hypothesis_of(const selfcal_work_t *work) {
    return &work->bank->model->hypothesis[work->hypothesis];
}

/* A node is dearer with regressors in use: one a step. */
static unsigned step_nodes(const selfcal_work_t *work) {
    return work->mask == 0U ? STEP_NODES : 1U;
}

static const selfcal_axis_t *axis_of(const selfcal_work_t *work) {
    return &work->bank->model->axis[work->axis];
}

static const selfcal_prior_t *prior_of(const selfcal_work_t *work) {
    return priors_of(work->bank->model, hypothesis_of(work), work->axis);
}

/* ln(N) - ln(sigma_v). */
static selfcal_real_t half_ln_dt(const selfcal_work_t *work) {
    return R(0.5) * r_log((selfcal_real_t)work->bank->model->dt_s);
}

/* ln(parameter) - ln(rho) - ln(sigma_v): K sqrt(dt) = sigma_w = rho sigma_v, sigma_m = rho sigma_v. */
static selfcal_real_t drift_shift(const selfcal_work_t *work) {
    return has_walk(hypothesis_of(work)->law) ? -half_ln_dt(work) : R(0.0);
}

/* ------------------------------------------------------------------------------------------------------------ spline */

/* Knot k of the spline through `nodes` points one apart: six at either end, none at the two points next to them. */
static int knot(int nodes, int k) {
    return k <= 5 ? 0 : (k >= nodes ? nodes - 1 : k - 3);
}

/* Values of the six quintic B-splines that are not zero at z (in steps from the first node), by the Cox-de Boor recursion;
 * the index of the first. Beyond the ends the position is held at the end. */
static uint8_t basis_at(uint16_t nodes, selfcal_real_t z, selfcal_real_t out[6]) {
    /* No more lies between six knots: 7 or, of 9 or 10 nodes, all. */
    static const selfcal_real_t inverse[10] = {R(0.0), R(1.0), R(1.0) / R(2.0), R(1.0) / R(3.0), R(1.0) / R(4.0),
                                               R(1.0) / R(5.0), R(1.0) / R(6.0), R(1.0) / R(7.0), R(1.0) / R(8.0), R(1.0) / R(9.0)};
    z = r_fmin(r_fmax(z, R(0.0)), (selfcal_real_t)(nodes - 1U));
    int span = (int)z + 3; /* unless a knot is missing there */
    span = span < 6 ? 5 : (span >= nodes - 1 ? nodes - 1 : span);
    while (span > 5 && z < (selfcal_real_t)knot(nodes, span)) {
        span--;
    }
    int at[10]; /* the knots that count, five either side */
    selfcal_real_t to[10];
    for (int k = 0; k < 10; k++) {
        at[k] = knot(nodes, span - 4 + k);
        to[k] = (selfcal_real_t)at[k] - z;
    }
    out[0] = R(1.0);
    for (int k = 1; k <= 5; k++) {
        selfcal_real_t carry = R(0.0);
        for (int i = 0; i < k; i++) {
            const selfcal_real_t part = out[i] * inverse[at[5 + i] - at[5 + i - k]];
            out[i] = r_fma(to[5 + i], part, carry);
            carry = -to[5 + i - k] * part;
        }
        out[k] = carry;
    }
    return (uint8_t)(span - 5);
}

/* One line of values, `stride` apart, by the grid's matrix or its transpose; as it is without a grid. */
static void transform_line(const selfcal_grid_t *grid, bool transposed, const selfcal_real_t in[], selfcal_real_t out[], size_t stride) {
    const size_t nodes = grid_nodes(grid);
    selfcal_real_t line[SELFCAL_GRID_MAX];
    for (size_t i = 0; i < nodes; i++) {
        line[i] = in[i * stride];
    }
    for (size_t i = 0; i < nodes; i++) {
        selfcal_real_t sum = grid == NULL ? line[i] : R(0.0);
        for (size_t k = 0; grid != NULL && k < nodes; k++) {
            sum = r_fma(grid->fit[transposed ? k * nodes + i : i * nodes + k], line[k], sum);
        }
        out[i * stride] = sum;
    }
}

/* ---------------------------------------------------------------------------------------------------------- expectation */

/* In selfcal_real_t, which is right to some 2e-7 n/2 ln V nats, and in selfcal_wide_t for what is longer than that. */
#define NAME(name) name
#define T selfcal_real_t
#define T_(x) R(x)
#define T_exp r_exp
#define T_log1p r_log1p
#define T_sqrt r_sqrt
#include "expected.h"
#undef NAME
#undef T
#undef T_
#undef T_exp
#undef T_log1p
#undef T_sqrt
#define NAME(name) name##_wide
#define T selfcal_wide_t
#define T_(x) x
#define T_exp exp
#define T_log1p log1p
#define T_sqrt sqrt
#include "expected.h"

/* n ln V beyond which selfcal_real_t would cost 0.02 nat. */
#define WIDE_BEYOND R(2e5)

/* A plain Gauss-Markov law, of one pole at each alpha. */
static bool has_pole(const selfcal_work_t *work) {
    return hypothesis_of(work)->alpha != NULL && !is_sum(hypothesis_of(work)->law);
}

/* 1 - phi of the drift at an alpha; 0 of a random walk. */
static selfcal_real_t beta_at(const selfcal_work_t *work, selfcal_real_t ln_alpha) {
    return has_pole(work) ? -r_expm1(-r_exp(ln_alpha) * (selfcal_real_t)work->bank->model->dt_s) : R(0.0);
}
static selfcal_wide_t beta_wide(const selfcal_work_t *work, selfcal_real_t ln_alpha) {
    return has_pole(work) ? -expm1(-exp((selfcal_wide_t)ln_alpha) * (selfcal_wide_t)work->bank->model->dt_s) : 0.0;
}

static bool has_expectation(const selfcal_work_t *work) {
    return hypothesis_of(work)->rho != NULL && !is_sum(hypothesis_of(work)->law);
}

/* What the expectation says of the two fields, the splines hold the rest; and of which filter. */
typedef struct {
    selfcal_wide_t profile, ln_sigma, ln_v;
    selfcal_real_t beta_sq, phi, p_sq, psi; /* |1 - phi e^(i omega)|^2 = beta_sq + phi distance, |1 - psi e^(i omega)|^2 = p_sq + psi distance */
    selfcal_real_t edge, level;             /* see lines and edges below */
    selfcal_real_t per_v; /* inverse of the innovations' variance without lines and edges */
} expectation_t;

/* What lines, and behind them an edge and a level for each three, add to the variance. */
static selfcal_real_t fitted(const selfcal_truth_t *truth, const expectation_t *e) {
    selfcal_real_t more = R(0.0), ends = R(0.0);
    const selfcal_real_t *end = &truth->power[truth->lines];
    for (unsigned m = 0; m < truth->lines; m++) {
        const selfcal_real_t distance = truth->distance[m];
        const selfcal_real_t passed = r_fma(e->phi, distance, e->beta_sq), held_back = r_fma(e->psi, distance, e->p_sq);
        if (m % 3U == 0U) {
            ends = r_fma(e->edge, end[0], e->level * end[1]);
            end += 2;
        }
        more += r_fma(passed, truth->power[m], ends) / held_back;
    }
    return more;
}

/* `beta`: beta_at() the alpha. */
static void expectation(const selfcal_work_t *work, selfcal_real_t ln_rho, selfcal_real_t ln_alpha, selfcal_real_t beta, expectation_t *e) {
    const selfcal_truth_t *truth = &work->truth;
    if (!has_expectation(work)) {
        memset(e, 0, sizeof *e);
        return;
    }
    e->profile = e->ln_sigma = e->ln_v = 0.0;
    const selfcal_real_t n = (selfcal_real_t)work->bank->weight;
    expected_t_wide wide = {0.0, 0.0, 0.0, 0.0};
    expected_t real;
    ln_rho -= truth->ln_noise;
    if (truth->wide) {
        wide = expected_wide((selfcal_wide_t)ln_rho, beta_wide(work, ln_alpha), truth);
        real.v_less_1 = (selfcal_real_t)wide.v_less_1;
        real.gain = (selfcal_real_t)wide.gain;
        real.p = (selfcal_real_t)wide.p;
    } else {
        real = expected(ln_rho, beta, truth);
    }
    const selfcal_real_t h = real.gain / real.p;
    e->beta_sq = beta * beta;
    e->phi = R(1.0) - beta;
    e->p_sq = real.p * real.p;
    e->psi = R(1.0) - real.p;
    e->edge = real.gain * h / (R(2.0) - real.p);
    e->level = h * h * beta / r_fma(n, beta, R(2.0) * h);
    e->per_v = R(1.0) / (R(1.0) + real.v_less_1);
    const selfcal_real_t more = truth->fitted ? r_fmax(fitted(truth, e), R(-0.99) * (R(1.0) + real.v_less_1)) : R(0.0);
    if (truth->wide) {
        e->ln_v = log1p(wide.v_less_1 + (selfcal_wide_t)more);
        e->ln_sigma = 0.5 * (e->ln_v - log1p(wide.s_less_1));
        e->profile = -0.5 * work->bank->weight * (e->ln_v - truth->ln_v);
    } else {
        const selfcal_real_t ln_v = r_log1p(real.v_less_1 + more);
        e->ln_v = (selfcal_wide_t)ln_v;
        e->ln_sigma = (selfcal_wide_t)(R(0.5) * (ln_v - r_log1p(real.s_less_1)));
        e->profile = (selfcal_wide_t)(R(-0.5) * n * (ln_v - (selfcal_real_t)truth->ln_v));
    }
}

/* ------------------------------------------------------------------------------------------------------------ fields */

/* Of the hypothesis's node k. */
static void node_field(const selfcal_work_t *work, uint16_t k, selfcal_field_t *field) {
    const selfcal_t *bank = work->bank;
    const uint16_t index = (uint16_t)(work->first_node + k);
    const selfcal_wide_t n = bank->weight;
    const selfcal_wide_t sd = (selfcal_wide_t)axis_of(work)->bias_sd, p0 = sd * sd;
    /* A record without any scatter has no likelihood; the floor keeps its logarithm finite, far below any prior's N over the largest rho. */
    const selfcal_wide_t least = 1e-28 * p0;
    if (work->mask != 0U) {
        bank->model->regressors->code->field(work, index, n * least, field);
        return;
    }
    const selfcal_node_view_t *v = &field->node;
    selfcal_bank_sums(bank, work->axis, index, &field->node);
    const selfcal_wide_t mean = v->b / v->a;
    field->var = fmax((v->c - v->b * mean) * work->per_n, least); /* of the residual; the rest is in units of it */
    const selfcal_real_t miss = (selfcal_real_t)((mean + selfcal_bank_from_prior(bank, work->axis)) * work->per_bias_sd);
    const selfcal_real_t beginning = (selfcal_real_t)bank->beginning, size = (selfcal_real_t)n;
    const selfcal_real_t width = (selfcal_real_t)v->a / (selfcal_real_t)(field->var * work->per_bias_sd * work->per_bias_sd);
    const selfcal_real_t missed = beginning * miss * miss * width;
    /* The mode: the bias takes a share of one sample; of how far it missed its prior, what that leaves is noise. (Beyond 10 sd of the prior
     * there is another, where all of that is noise; this one says what the readings scatter by.) */
    selfcal_real_t ratio = R(1.0), before, rest, share, noise;
    unsigned turns = SELFCAL_MODE_TURNS;
    do {
        before = ratio;
        rest = ratio / (width + ratio);
        share = R(1.0) - rest;
        noise = missed * rest * rest;
        ratio = (size + noise) / r_fma(-beginning, share, size);
    } while (r_fabs(ratio - before) > SELFCAL_MODE_LEFT * ratio && --turns > 0U);
    noise /= ratio;
    field->ratio = ratio;
    field->extra = missed / (width + ratio) - beginning * r_log(rest);
    field->share = share * r_fma(beginning, share, noise + noise);
}

/* ln of sigma_v^2's mode over the variance, and that mode's cost, nats a sample: 0 where both agree. */
static selfcal_real_t ln_ratio(const selfcal_field_t *field) {
    return r_log1p(field->ratio - R(1.0));
}
static selfcal_real_t ratio_cost(const selfcal_field_t *field) {
    return ln_ratio(field) - (field->ratio - R(1.0)) / field->ratio;
}

/* One node into what the report keeps of all: from the best so far, so that what counts in the end was counted from near by. */
static void keep_node(selfcal_work_t *work, uint16_t k, const selfcal_field_t *field) {
    selfcal_top_t *top = &work->top;
    selfcal_top_t mine = {field->var, 0.0, field->node.ln_s, ratio_cost(field), field->extra};
    selfcal_real_t profile = R(0.0), scatter = R(0.0);
    if (k > 0U) {
        /* Where the drift hides the white noise, the first two terms are far larger than their sum. */
        const selfcal_wide_t ln_var = selfcal_bank_ln(mine.var * top->per_var);
        profile = (selfcal_real_t)(-0.5 * (work->bank->weight * ln_var + (mine.ln_s - top->ln_s))) -
                  R(0.5) * r_fma((selfcal_real_t)work->bank->weight, mine.cost - top->cost, mine.extra - top->extra);
        scatter = R(0.5) * (selfcal_real_t)ln_var;
    }
    if (k == 0U || profile > R(0.0)) {
        for (uint16_t i = 0; i < k; i++) {
            work->field[0][i] -= profile;
            work->field[1][i] -= scatter;
            work->scratch.fit.scatter[i] -= scatter;
        }
        profile = scatter = R(0.0);
        mine.per_var = 1.0 / mine.var;
        *top = mine;
    }
    work->field[0][k] = profile;
    work->field[1][k] = r_fma(R(0.5), ln_ratio(field), scatter);
    work->scratch.fit.scatter[k] = scatter;
}

/* delta + e^(-2 delta)/2 - 1/2: two terms of delta's order leave one of delta^2; n_eff times what that costs in float is 2e-3 where n_eff
 * is 10^8. */
static selfcal_real_t sigma_shape(selfcal_real_t delta) {
    return r_fma(R(0.5), r_expm1(R(-2.0) * delta), delta);
}

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

/* What the sigma_v cells make of [from, to], with weights that are 1 where the ln-likelihood lies `drop` below the mode. */
static bool sigma_cells(selfcal_work_t *work, selfcal_real_t from, selfcal_real_t to, selfcal_real_t drop) {
    const selfcal_real_t width = (to - from) / (selfcal_real_t)SELFCAL_SIGMA_CELLS;
    if (from == work->delta_from && width == work->delta_width) {
        return false;
    }
    work->delta_from = from;
    work->delta_width = width;
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
    (void)sigma_cells(work, work->delta_lo, work->delta_hi, R(0.0));
    selfcal_real_t mass = R(0.0), first = R(0.0), second = R(0.0);
    for (int k = 0; k < SELFCAL_SIGMA_CELLS; k++) {
        const selfcal_real_t e = work->scratch.grid.delta_expm1[k], weighed = work->scratch.grid.delta_weight[k] * e;
        mass += work->scratch.grid.delta_weight[k];
        first += weighed;
        second = r_fma(weighed, e, second);
    }
    work->sigma_mass = mass;
    work->sigma_first = first / mass;
    work->sigma_second = second / mass;
}

static uint16_t nodes_of(const selfcal_work_t *work) {
    return hypothesis_nodes(hypothesis_of(work));
}

/* Where the hypothesis's node k lies. */
static selfcal_place_t place_of(const selfcal_work_t *work, uint16_t k) {
    return selfcal_bank_place(work->bank, (uint16_t)(work->first_node + k));
}

/* End of this step's part of `whole`, from work->at, which moves there. */
static uint16_t part(selfcal_work_t *work, unsigned step, uint16_t whole) {
    const uint16_t from = work->at;
    work->at = (uint16_t)(from + step < whole ? from + step : whole);
    return from;
}

/* Node values [rho][alpha] become spline coefficients: along alpha, then along rho. `transposed`: posterior means of the basis functions
 * become weights of the node values; the mean of anything the spline interpolates is the sum of its node values under them.
 * Some lines of one of the two; true after the last. */
static bool step_transform(selfcal_work_t *work, bool transposed, int which) {
    const selfcal_real_t *in = &work->field[which][work->first_node];
    selfcal_real_t *out = work->scratch.grid.spline[which];
    const selfcal_grid_t *rho = hypothesis_of(work)->rho, *alpha = hypothesis_of(work)->alpha;
    const uint16_t rows = grid_nodes(rho), columns = grid_nodes(alpha), lines = (uint16_t)(rows + columns);
    for (uint16_t i = part(work, STEP_LINES, lines); i < work->at; i++) {
        if (i < rows) {
            const size_t row = (size_t)i * columns;
            transform_line(alpha, transposed, &in[row], &out[row], 1);
        } else {
            transform_line(rho, transposed, &out[i - rows], &out[i - rows], columns);
        }
    }
    return work->at == lines;
}

/* Looks at all nodes. The best of those with an expectation is the first guess of what made the data. */
static void step_truth(selfcal_work_t *work) {
    const selfcal_model_t *model = work->bank->model;
    selfcal_truth_t *truth = &work->truth;
    const selfcal_real_t weight = (selfcal_real_t)work->bank->weight;
    selfcal_field_t field;
    for (uint16_t k = 0; work->at == 0U && k < model->nodes; k++) {
        work->hypothesis = place_of(work, k).hypothesis;
        if (hypothesis_of(work)->rho == NULL) {
            selfcal_bank_ln_s(work->bank, k, &field.node);
            truth->ln_noise = R(0.5) * (selfcal_real_t)field.node.ln_s / weight;
        }
    }
    if (work->at == 0U) {
        work->per_n = 1.0 / work->bank->weight;
        work->per_bias_sd = 1.0 / (selfcal_wide_t)axis_of(work)->bias_sd;
    }
    for (uint16_t k = part(work, step_nodes(work), model->nodes); k < work->at; k++) {
        const selfcal_place_t place = place_of(work, k);
        work->hypothesis = place.hypothesis;
        node_field(work, k, &field);
        selfcal_bank_ln_s(work->bank, k, &field.node);
        keep_node(work, k, &field);
        if (has_expectation(work)) { /* as its filters settle an even record comes to 8 nats, and to 16 with some gaps: no more counts as missed */
            const selfcal_real_t s_less_1 = truth->ln_noise == R(0.0) ? work->bank->node[k].p_inf
                                                                      : settled(place.ln_rho - truth->ln_noise, beta_at(work, place.ln_alpha));
            const selfcal_real_t ln_s = weight * r_fma(R(2.0), truth->ln_noise, r_log1p(s_less_1));
            truth->missed = r_fmax(truth->missed, r_fabs((selfcal_real_t)field.node.ln_s - ln_s) - R(16.0));
        }
    }
    if (work->at < model->nodes) {
        return;
    }
    work->ln_top = log(work->top.var);
    work->top_profile = -0.5 * (work->bank->weight * (SELFCAL_LN_2PI + work->ln_top + 1.0 + (selfcal_wide_t)work->top.cost) + work->top.ln_s +
                                (selfcal_wide_t)work->top.extra);
    work->best_node = model->nodes;
    for (uint16_t k = 0; k < model->nodes; k++) {
        work->hypothesis = place_of(work, k).hypothesis;
        if (has_expectation(work)) {
            truth->pair = truth->pair || hypothesis_of(work)->alpha != NULL;
            if (work->best_node == model->nodes || work->field[0][k] > work->field[0][work->best_node]) {
                work->best_node = k;
            }
        }
    }
    work->hypothesis = 0;
}

/* The best node of the hypothesis settles n_eff, by the share of the bias there, and with it how sigma_v is spread. */
static void step_sigma(selfcal_work_t *work, uint16_t nodes) {
    const selfcal_real_t *profile = &work->field[0][work->first_node];
    uint16_t best = 0;
    for (uint16_t k = 1; k < nodes; k++) {
        best = profile[k] > profile[best] ? k : best;
    }
    selfcal_field_t field;
    node_field(work, best, &field);
    work->n_eff = (selfcal_real_t)work->bank->weight - field.share;
    work->peak = profile[best];
    work->delta_lo = sigma_end(work->n_eff, R(-1.0));
    work->delta_hi = sigma_end(work->n_eff, R(1.0));
    work->delta_from = work->delta_hi; /* no cells yet */
    sigma_moments(work);
}

/* What the splines have to carry at the nodes. */
static void step_values(selfcal_work_t *work) {
    const uint16_t nodes = nodes_of(work);
    for (uint16_t k = part(work, STEP_VALUES, nodes); k < work->at; k++) {
        const selfcal_place_t place = place_of(work, k);
        selfcal_real_t *profile = &work->field[0][work->first_node + k], *ln_sigma = &work->field[1][work->first_node + k];
        expectation_t e;
        expectation(work, place.ln_rho, place.ln_alpha, beta_at(work, place.ln_alpha), &e);
        *profile = (selfcal_real_t)((selfcal_wide_t)(*profile - work->peak) - e.profile);
        *ln_sigma = (selfcal_real_t)((selfcal_wide_t)*ln_sigma + 0.5 * work->ln_top - e.ln_sigma);
    }
}

/* -------------------------------------------------------------------------------------------------- lines and edges */

/* The innovations nu = (1 - phi B)/(1 - psi B) y, psi = phi (1 - K), have over data of the spectrum S(omega) the variance
 *     v = mean over omega of S |1 - phi e^(i omega)|^2 / |1 - psi e^(i omega)|^2.
 * So all that (rho, alpha) sees of the data, of whatever law, is a function of one variable, psi, smoothed along ln(1 - psi) by
 * 1/(1 + e^2x), and the nodes together show it far more closely than their rows and columns seem to. What S has beyond the spectrum
 * supposed is fitted to all nodes as lines, even in ln omega. With zeros for what came before the record and after it, S tells
 * of squares that were never summed: at either end the zeros would have added (the filter being at rest, time running either way)
 *     edge w^2,  edge = (phi - psi)^2/(1 - psi^2),  w = y/(1 - psi B) there,
 * and taking the readings about their generalised least squares mean, not their plain one, takes off another
 *     level (w1 + w2)^2,  level = h^2 (1 - phi)/(n (1 - phi) + 2 h),  h = (phi - psi)/(1 - psi).
 * Both functions of psi are fitted as well, a term for each two lines. Taken into the expectation, all these leave to the splines
 * less than a nat, however long the record. A priori a line's power scatters as a periodogram does, and an end's as large as its
 * spectrum makes it. */
#define FIT_PRECISION R(50.0) /* 0.5/0.01: they leave 0.01 nat of a node's ln-likelihood -n/2 ln v */
#define FIT_MOST R(1e6)
/* Less of a node whose filter takes 1/p steps to settle in a record hardly longer, for which the ends are not as above. */
#define UNSETTLED R(200.0)
/* Of more nodes those that hardly settle at all are left out; fewer tell too little without. */
#define UNSETTLED_NODES 150U
/* Less, by nats below the best node, where intervals or samples are missing, the rate has changed, or regressors are in use: what a node makes
 * of the level on both sides of a gap, of noise that varies, or of what the coefficients take up, depends on more than psi, and by some
 * part in a hundred of those nats. */
#define FAR R(0.033)
/* What a float holds of those nats, over the 0.01. */
#define FAR_EVEN R(2e-4)

/* Lines are so far apart in ln omega, as far as there are so many; up to LINES_APART they do. */
#define LINE_STEP R(0.45)
#define LINES_APART R(0.55)

/* Of ln omega from 1/n to 6, which stands for pi (set_lines() below). */
static selfcal_real_t lines_range(selfcal_real_t weight) {
    return R(1.7917595) + r_log(weight);
}

static unsigned unknowns(const selfcal_truth_t *truth) {
    return truth->lines + (truth->lines + 2U) / 3U * 2U;
}

static void set_lines(selfcal_work_t *work) {
    selfcal_fit_t *fit = &work->scratch.fit;
    selfcal_truth_t *truth = &work->truth;
    memset(fit->triangle, 0, sizeof fit->triangle);
    const selfcal_real_t weight = (selfcal_real_t)work->bank->weight, range = lines_range(weight);
    truth->lines = 8;
    while (truth->lines < SELFCAL_LINES && range > LINE_STEP * (selfcal_real_t)(truth->lines - 1U)) {
        truth->lines = (uint8_t)(truth->lines + 2U);
    }
    const selfcal_real_t step = range / (selfcal_real_t)(truth->lines - 1U), ratio = r_exp(step);
    selfcal_real_t omega = R(1.0) / weight, *end = &truth->power[truth->lines];
    for (unsigned m = 0; m < truth->lines; m++) {
        const selfcal_real_t omega_sq = omega * omega;
        truth->distance[m] = omega_sq / r_fma(R(0.22222222), omega_sq, R(1.0)); /* 4 where omega is 6: where a line lies is free */
        const selfcal_real_t spectrum =
            R(1.0) + R(2.0) * truth->variance * truth->rate / r_fma(truth->rate, truth->rate, truth->distance[m]);
        const selfcal_real_t share = omega * step / (R(3.1415927) * weight); /* of its band in the record's frequencies */
        truth->power[m] = spectrum * r_sqrt(share); /* until the fit is solved, a prior deviation */
        if (m % 3U < 2U) { /* as of the line in the middle */
            end[0] = end[1] = R(6.0) * spectrum * share; /* two ends, a band of three lines */
        }
        end += m % 3U == 2U ? 2U : 0U;
        omega *= ratio;
    }
    selfcal_real_t *diagonal = fit->triangle;
    fit->least = R(1.0) / (FIT_PRECISION * weight); /* prior deviations of 1, over the nodes' */
    for (unsigned m = 0; m < unknowns(truth); m++) {
        *diagonal = fit->least * fit->least;
        diagonal += unknowns(truth) + 1U - m;
    }
}

/* Rotates a row of the least squares, its right side behind it, into the triangle, without square roots: each row of that is what
 * stands in it times the root of its diagonal (Gentleman, J. Inst. Maths Applics 12, 1973). */
static void rotate_in(selfcal_fit_t *fit, unsigned count, selfcal_real_t row[SELFCAL_FITTED + 1]) {
    selfcal_real_t *mine = fit->triangle, weight = R(1.0);
    for (unsigned m = 0; m < count; m++) {
        const selfcal_real_t x = row[m], diagonal = *mine++;
        if (r_fabs(x) < R(0.01) * fit->least) {
            mine += count - m; /* less than the rows are good for */
            continue;
        }
        const selfcal_real_t weighed = weight * x, now = r_fma(weighed, x, diagonal), s = weighed / now;
        mine[-1] = now;
        weight *= diagonal / now;
        for (unsigned i = m + 1U; i <= count; i++, mine++) {
            row[i] = r_fma(-x, *mine, row[i]);
            *mine = r_fma(s, row[i], *mine);
        }
    }
}

/* Takes the best node as what made the data. A drift slower than the record looks like a random walk within it, and its level
 * is taken up by the bias: the pole is moved to 3/n at equal steps (for a random walk: the mean square about the mean). */
static void set_truth(selfcal_work_t *work, selfcal_place_t place) {
    const selfcal_real_t cut = R(3.0) / (selfcal_real_t)work->bank->weight;
    const bool pole = has_pole(work);
    const selfcal_real_t variance = r_exp(R(2.0) * (place.ln_rho - work->truth.ln_noise));
    const selfcal_real_t rate = pole ? r_exp(place.ln_alpha) * (selfcal_real_t)work->bank->model->dt_s : R(0.0);
    const selfcal_real_t slow = r_sqrt(rate * rate + cut * cut);
    selfcal_truth_t *truth = &work->truth;
    truth->variance = pole ? variance * rate / slow : variance / (R(2.0) * slow);
    truth->rate = -r_expm1(-slow);
}

static void add_row(selfcal_work_t *work, const expectation_t *e, selfcal_real_t off, selfcal_real_t deficit) {
    const selfcal_truth_t *truth = &work->truth;
    const selfcal_real_t n = (selfcal_real_t)work->bank->weight;
    const bool even = work->bank->counters.blocks_lost == 0U && work->mask == 0U && truth->ln_noise == R(0.0);
    const selfcal_real_t far = (even ? FAR_EVEN : FAR) * deficit;
    const selfcal_real_t weight = R(1.0) / (R(1.0) + UNSETTLED / (e->p_sq * n * n) + far), per_v = weight * e->per_v;
    if (even && UNSETTLED > R(20.0) * e->p_sq * n * n && work->bank->model->nodes > UNSETTLED_NODES) {
        return;
    }
    selfcal_real_t row[SELFCAL_FITTED + 1];
    memset(row, 0, sizeof row);
    unsigned end = truth->lines;
    for (unsigned m = 0; m < truth->lines; m++) {
        const selfcal_real_t share = per_v / r_fma(e->psi, truth->distance[m], e->p_sq);
        row[m] = share * r_fma(e->phi, truth->distance[m], e->beta_sq) * truth->power[m];
        row[end] += share * e->edge * truth->power[end];
        row[end + 1U] += share * e->level * truth->power[end + 1U];
        end += m % 3U == 2U ? 2U : 0U;
    }
    row[unknowns(truth)] = weight * r_fmin(r_expm1(R(2.0) * off), FIT_MOST);
    rotate_in(&work->scratch.fit, unknowns(truth), row);
}

static void solve(selfcal_work_t *work) {
    selfcal_truth_t *truth = &work->truth;
    const unsigned count = unknowns(truth);
    const selfcal_real_t *mine = work->scratch.fit.triangle + count * (count + 3U) / 2U;
    selfcal_real_t found[SELFCAL_FITTED];
    for (unsigned m = count; m-- > 0U; mine--) {
        found[m] = *--mine;
        for (unsigned i = count - 1U; i > m; i--) {
            found[m] -= *--mine * found[i];
        }
        truth->power[m] *= found[m];
    }
    truth->fitted = true;
}

/* First the best node of all, for what made the data; then one after the other: its row is its variance over that expected, less that of
 * the best, by lines and edges of their prior deviations. */
static void step_fit(selfcal_work_t *work) {
    selfcal_truth_t *truth = &work->truth;
    const uint16_t at = work->at++, k = at == 0U ? work->best_node : (uint16_t)(at - 1U);
    const selfcal_place_t place = place_of(work, k);
    work->hypothesis = place.hypothesis;
    if (!has_expectation(work)) {
        return;
    }
    if (at == 0U) {
        set_truth(work, place);
    }
    expectation_t e;
    expectation(work, place.ln_rho, place.ln_alpha, beta_at(work, place.ln_alpha), &e);
    /* What the priors of bias and coefficients add is no function of psi. */
    const selfcal_wide_t off = (selfcal_wide_t)work->scratch.fit.scatter[k] - e.ln_sigma;
    if (at == 0U) {
        work->ln_sigma_off = off;
        truth->ln_v = e.ln_v; /* any that is near will do */
        truth->wide = (selfcal_real_t)work->bank->weight * (selfcal_real_t)e.ln_v > WIDE_BEYOND;
        set_lines(work);
    } else {
        add_row(work, &e, (selfcal_real_t)(off - work->ln_sigma_off), work->field[0][work->best_node] - work->field[0][k]);
    }
}

/* ------------------------------------------------------------------------------------------------------------- cells */

/* A range has two thirds of the cells, which are 0.6 sd of a normal one wide if all are 24; more if it is wider than 6.4 nepers, since moments
 * of the parameters themselves need them narrower than 0.4. One row alone has twice as many: no other evens out what a limit cuts off in it. */
#define CELLS_LEAST ((selfcal_real_t)SELFCAL_REPORT_CELLS * (R(2.0) / R(3.0)))
#define CELLS_PER_NEPER ((selfcal_real_t)SELFCAL_REPORT_CELLS * (R(2.5) / R(24.0)))
#define ROWS_MOST (SELFCAL_HISTOGRAM < 255U ? SELFCAL_HISTOGRAM : 255U) /* of alpha a bin is a row */

/* Part of the depth, at 2.5 sd of a normal one, to which a peak is looked at. */
#define PEAK R(0.25)
/* Least cells of a range by the samples of its search that lie on the peak, three or more of a normal one. Where a limit cuts the likelihood
 * the peak may be narrow in a wide range. `on_two`: where there are two samples; more where nothing narrows the range after the search. */
static uint8_t cells_for_peak(const selfcal_real_t height[], selfcal_real_t least, uint8_t on_two) {
    unsigned count = 0;
    for (unsigned i = 0; i < SELFCAL_SEARCH_SAMPLES; i++) {
        count += height[i] > least ? 1U : 0U;
    }
    if (count == 2U) {
        return on_two;
    }
    return count > 2U ? 16U : 64U;
}

static uint16_t cells_in(const selfcal_work_t *work, unsigned dimension) {
    const selfcal_hypothesis_t *hypothesis = hypothesis_of(work);
    if ((dimension == 0U ? hypothesis->rho : hypothesis->alpha) == NULL) {
        return 1U;
    }
    const selfcal_range_t *range = &work->range[dimension];
    const selfcal_real_t wanted = r_fmax(CELLS_PER_NEPER * (range->hi - range->lo), CELLS_LEAST);
    unsigned cells = wanted < (selfcal_real_t)SELFCAL_REPORT_CELLS ? (unsigned)wanted : SELFCAL_REPORT_CELLS;
    if (hypothesis->alpha == NULL) {
        cells = 2U * SELFCAL_REPORT_CELLS;
    }
    /* Splines that hold all of the likelihood are less even than what an expectation leaves. */
    const unsigned least = (has_expectation(work) ? 1U : 2U) * work->least[dimension];
    cells = cells < least ? least : cells;
    return (uint16_t)(dimension == 1U && cells > ROWS_MOST ? ROWS_MOST : cells);
}

/* Weight of the cell i of `count`, alike from either end: the midpoint rule, which errs by h^2/24 times the slope at an end that the limits cut,
 * less that (Press et al., Numerical Recipes, 4.1.4). */
static selfcal_real_t cell_weight(unsigned count, unsigned i) {
    static const selfcal_real_t of_end[3] = {R(13.0) / R(12.0), R(7.0) / R(8.0), R(25.0) / R(24.0)};
    const unsigned from_end = i < count - 1U - i ? i : count - 1U - i;
    return count > 1U && from_end < 3U ? of_end[from_end] : R(1.0);
}

/* The widest ranges of ln rho and ln alpha that the priors permit. */
static void first_limits(selfcal_work_t *work) {
    const selfcal_hypothesis_t *hypothesis = hypothesis_of(work);
    const selfcal_prior_t *prior = prior_of(work);
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
        const selfcal_real_t shift = half_ln_dt(work) - drift_shift(work);
        work->limit_lo[0] = (selfcal_real_t)drift->ln_min - (selfcal_real_t)prior[SELFCAL_N].ln_max + shift;
        work->limit_hi[0] = (selfcal_real_t)drift->ln_max - (selfcal_real_t)prior[SELFCAL_N].ln_min + shift;
    }
}

/* The row of cells at an alpha. */
static void make_row(selfcal_work_t *work, selfcal_real_t ln_alpha) {
    selfcal_cell_row_t *row = &work->scratch.grid.row;
    const selfcal_hypothesis_t *hypothesis = hypothesis_of(work);
    const uint16_t rows = grid_nodes(hypothesis->rho), columns = grid_nodes(hypothesis->alpha);
    row->ln_alpha = ln_alpha;
    row->beta = beta_at(work, ln_alpha);
    row->half_ln_dt = half_ln_dt(work);
    row->shift = drift_shift(work);
    row->prior = prior_of(work);
    row->drift = drift_parameter(hypothesis->law);
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
            row->profile[i] = r_fma(row->basis[j], work->scratch.grid.spline[0][at], row->profile[i]);
            row->ln_sigma[i] = r_fma(row->basis[j], work->scratch.grid.spline[1][at], row->ln_sigma[i]);
        }
    }
}

typedef struct {
    selfcal_real_t ln_rho, profile, ln_sigma;
    selfcal_real_t basis[6]; /* of rho */
    uint8_t basis_first;
    bool off_grid;
} cell_t;

static void make_cell(const selfcal_work_t *work, selfcal_real_t ln_rho, cell_t *cell) {
    const selfcal_cell_row_t *row = &work->scratch.grid.row;
    const selfcal_hypothesis_t *hypothesis = hypothesis_of(work);
    cell->off_grid = false;
    cell->ln_rho = R(0.0);
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
    cell->basis_first = basis_at(hypothesis->rho->nodes, z, cell->basis);
    for (uint16_t k = 0; k < 6U; k++) {
        cell->profile = r_fma(cell->basis[k], row->profile[cell->basis_first + k], cell->profile);
        cell->ln_sigma = r_fma(cell->basis[k], row->ln_sigma[cell->basis_first + k], cell->ln_sigma);
    }
    /* Beyond the nodes the spline's part is held and the expectation carries on. */
    cell->off_grid = z < R(0.0) || z > (selfcal_real_t)(hypothesis->rho->nodes - 1U);
    if (is_sum(hypothesis->law)) { /* without an expectation: up there the drift hides the white noise, sigma_v rho stays */
        const selfcal_real_t beyond = z - (selfcal_real_t)(hypothesis->rho->nodes - 1U);
        cell->ln_sigma -= r_fmax(beyond, R(0.0)) * bank->rho_step[work->hypothesis];
    }
    expectation_t e;
    expectation(work, cell->ln_rho, row->ln_alpha, row->beta, &e);
    cell->profile += (selfcal_real_t)e.profile;
    cell->ln_sigma += (selfcal_real_t)e.ln_sigma;
}

/* Part of [*middle - width/2, *middle + width/2] that the prior's limits leave, whose middle *middle becomes. */
static selfcal_real_t permitted(const selfcal_prior_t *prior, selfcal_real_t *middle, selfcal_real_t width) {
    const selfcal_real_t lo = r_fmax(*middle - R(0.5) * width, (selfcal_real_t)prior->ln_min);
    const selfcal_real_t hi = r_fmin(*middle + R(0.5) * width, (selfcal_real_t)prior->ln_max);
    *middle = R(0.5) * (lo + hi);
    return hi > lo ? (hi - lo) / width : R(0.0);
}

/* ln of the parameters at the conditional mode of a cell. */
static void cell_parameters(const selfcal_work_t *work, const cell_t *cell, selfcal_real_t ln_value[SELFCAL_PARAMETERS]) {
    const selfcal_cell_row_t *row = &work->scratch.grid.row;
    ln_value[SELFCAL_N] = cell->ln_sigma + row->half_ln_dt;
    ln_value[SELFCAL_ALPHA] = row->ln_alpha;
    ln_value[SELFCAL_K] = cell->ln_rho + cell->ln_sigma + row->shift;
    ln_value[SELFCAL_SIGMA_M] = ln_value[SELFCAL_K];
}

static bool has_parameter(const selfcal_law_t *law, unsigned parameter) {
    return parameter == SELFCAL_N || (parameter == SELFCAL_K && has_walk(law)) ||
           (parameter == SELFCAL_SIGMA_M && has_deviation(law)) || (parameter == SELFCAL_ALPHA && (has_alpha(law) || has_ratio(law)));
}

/* What counts of sigma_v in a cell: the part of [delta_lo, delta_hi] about the height's peak that the limits leave, and how far from the
 * conditional mode and below it that peak lies, in ln. Nothing is left unless from < to. */
typedef struct {
    selfcal_real_t from, to, drop, peak;
    selfcal_real_t base; /* drop where the limits leave a flank alone or little; else 0, and all of [delta_lo, delta_hi], of which parts do not
                          * count */
} reach_t;

/* `half`: what N and the drift parameter run through from the middle of a cell to its side, so that so far beyond the limits parts of the cell
 * count; 0 for N from here on where even that does not bring the mode within them, since then the profile as a rule rises as fast to
 * the other side. Away from the mode the height falls by SIGMA_DEPTH sooner than about it (the shape is convex), at the peak's slope or faster. */
static reach_t reach_of(const selfcal_work_t *work, const selfcal_real_t ln_value[], selfcal_real_t half[2]) {
    const selfcal_hypothesis_t *hypothesis = hypothesis_of(work);
    const selfcal_real_t n_eff = work->n_eff;
    reach_t reach = {-INFINITY, INFINITY, R(0.0), R(0.0), R(0.0)};
    selfcal_real_t whole = R(6.0); /* drop up to which the cells of [delta_lo, delta_hi] see what the limits leave, measured */
    for (unsigned j = 0; j < (hypothesis->rho != NULL ? 2U : 1U); j++) {
        const unsigned p = j == 0U ? SELFCAL_N : work->scratch.grid.row.drift;
        const selfcal_prior_t *prior = &work->scratch.grid.row.prior[p];
        const selfcal_real_t lo = (selfcal_real_t)prior->ln_min - ln_value[p], hi = (selfcal_real_t)prior->ln_max - ln_value[p];
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
    if (reach.drop < whole && reach.to - reach.from > R(0.3) * (work->delta_hi - work->delta_lo)) {
        reach.from = work->delta_lo;
        reach.to = work->delta_hi;
        return reach;
    }
    reach.base = reach.drop;
    const selfcal_real_t depth = R(0.5) * SIGMA_DEPTH / r_fabs(r_fma(n_eff, peak, -reach.drop)); /* over the slope, 1 - e^(-2 delta) */
    reach.from = r_fmax(reach.from, peak + r_fmax(work->delta_lo, -depth));
    reach.to = r_fmin(reach.to, peak + r_fmin(work->delta_hi, depth));
    return reach;
}

/* -------------------------------------------------------------------------------------------------------------- search */

/* A row's cells reach from where the likelihood begins to count to where it ends, and so do the rows. Either range is found by
 * passes of few samples: each shrinks it to those that count and one more, or lets it grow where the last one counts. */
#define SAMPLES SELFCAL_SEARCH_SAMPLES

static selfcal_real_t sample_at(const selfcal_range_t *range, unsigned i) {
    return r_fma((range->hi - range->lo) / (selfcal_real_t)SAMPLES, (selfcal_real_t)i + R(0.5), range->lo);
}

/* The next range after a pass; false: it stays. */
static bool next_range(selfcal_range_t *range, const selfcal_real_t height[SAMPLES], selfcal_real_t least, const selfcal_range_t *limit) {
    unsigned first = 0, last = SAMPLES - 1U;
    while (first < last && !(height[first] > least)) {
        first++;
    }
    while (last > first && !(height[last] > least)) {
        last--;
    }
    const selfcal_real_t whole = range->hi - range->lo, step = whole / (selfcal_real_t)SAMPLES;
    const selfcal_real_t lo = r_fmax(first == 0U ? range->lo - GROWTH * whole : sample_at(range, first) - step, limit->lo);
    const selfcal_real_t hi = r_fmin(last == SAMPLES - 1U ? range->hi + GROWTH * whole : sample_at(range, last) + step, limit->hi);
    if (!(lo < range->lo || hi > range->hi || hi - lo < SHRINK * whole)) {
        return false;
    }
    range->lo = lo;
    range->hi = hi;
    return true;
}

/* Height of a cell's middle at the sigma_v that the limits leave. The search keeps the best of all, which the sums are counted from. */
static selfcal_real_t height_at(selfcal_work_t *work, selfcal_real_t ln_rho) {
    cell_t cell;
    selfcal_real_t ln_value[SELFCAL_PARAMETERS], half[2] = {R(0.0), R(0.0)};
    make_cell(work, ln_rho, &cell);
    cell_parameters(work, &cell, ln_value);
    const reach_t reach = reach_of(work, ln_value, half);
    const selfcal_real_t height = cell.profile - reach.drop;
    if (work->stage == SEARCH && height > work->best) {
        work->best = height;
        work->drop[work->hypothesis] = reach.drop;
        for (unsigned p = 0; p < SELFCAL_PARAMETERS; p++) {
            work->best_ln[p] = ln_value[p] + reach.peak;
        }
        work->best_ln[SELFCAL_ALPHA] = ln_value[SELFCAL_ALPHA];
    }
    return height > (selfcal_real_t)-INFINITY ? height : (selfcal_real_t)-INFINITY; /* nor NaN */
}

/* Where a row ends between a sample that counts and one that does not: the root of the depth is nearly linear, but where a limit cuts,
 * by halves. */
static selfcal_real_t row_end(selfcal_work_t *work, selfcal_real_t in, selfcal_real_t in_height, selfcal_real_t out, selfcal_real_t out_height) {
    const selfcal_real_t best = work->row_best;
    unsigned turns = 0;
    while (in_height > best - PEAK * work->depth || out_height < best - R(3.0) * work->depth) {
        if (turns++ == 4U) {
            return out;
        }
        const selfcal_real_t middle = R(0.5) * (in + out), height = height_at(work, middle);
        if (height > best - work->depth) {
            in = middle;
            in_height = height;
        } else {
            out = middle;
            out_height = height;
        }
    }
    const selfcal_real_t inside = r_sqrt(best - in_height), outside = r_sqrt(best - out_height);
    return r_fma((r_sqrt(work->depth) - inside) / (outside - inside), out - in, in);
}

/* One pass over the row in hand; true after the last, when work->range[0] is where it counts. */
static bool find_row(selfcal_work_t *work) {
    selfcal_range_t *range = &work->range[0];
    const selfcal_range_t limit = {work->limit_lo[0], work->limit_hi[0]};
    if (hypothesis_of(work)->rho == NULL) {
        *range = limit;
        work->row_best = height_at(work, R(0.0));
        return true;
    }
    selfcal_real_t height[SAMPLES], best = (selfcal_real_t)-INFINITY;
    for (unsigned i = 0; i < SAMPLES; i++) {
        height[i] = height_at(work, sample_at(range, i));
        best = r_fmax(best, height[i]);
    }
    work->row_best = best;
    selfcal_range_t next = *range;
    if (next_range(&next, height, best - work->depth, &limit) && work->at < PASSES_MAX) {
        *range = next;
        return false;
    }
    unsigned first = 0, last = SAMPLES - 1U;
    while (first < last && !(height[first] > best - work->depth)) {
        first++;
    }
    while (last > first && !(height[last] > best - work->depth)) {
        last--;
    }
    if (first > 0U) {
        next.lo = row_end(work, sample_at(range, first), height[first], sample_at(range, first - 1U), height[first - 1U]);
    }
    if (last < SAMPLES - 1U) {
        next.hi = row_end(work, sample_at(range, last), height[last], sample_at(range, last + 1U), height[last + 1U]);
    }
    work->least[0] = cells_for_peak(height, best - PEAK * work->depth, 16);
    *range = next;
    return true;
}

/* A row near the one in hand is looked for where that one is, and half as far beyond. */
static void widen_row(selfcal_work_t *work) {
    selfcal_range_t *range = &work->range[0];
    const selfcal_real_t more = R(0.5) * (range->hi - range->lo);
    range->lo = r_fmax(range->lo - more, work->limit_lo[0]);
    range->hi = r_fmin(range->hi + more, work->limit_hi[0]);
}

static void begin_pass(selfcal_work_t *work) {
    work->row = 0;
    for (unsigned p = 0; p < SELFCAL_PARAMETERS; p++) {
        work->range_lo[p] = INFINITY;
        work->range_hi[p] = -INFINITY;
    }
}

static void begin_search(selfcal_work_t *work) {
    first_limits(work);
    work->range[1].lo = work->limit_lo[1];
    work->range[1].hi = work->limit_hi[1];
    work->depth = DEPTH + DEPTH_OF_SHORT / work->n_eff;
    work->best = -INFINITY;
    work->least[0] = 1;
    work->pass = 0;
    begin_pass(work);
}

/* What N and the drift parameter run through in a row: both are monotonic in rho. */
static void note_ranges(selfcal_work_t *work) {
    for (int end = 0; end < 2; end++) {
        cell_t cell;
        selfcal_real_t ln_value[SELFCAL_PARAMETERS];
        make_cell(work, end == 0 ? work->range[0].lo : work->range[0].hi, &cell);
        cell_parameters(work, &cell, ln_value);
        for (unsigned p = 0; p < SELFCAL_PARAMETERS; p++) {
            work->range_lo[p] = r_fmin(work->range_lo[p], ln_value[p] + work->delta_lo);
            work->range_hi[p] = r_fmax(work->range_hi[p], ln_value[p] + work->delta_hi);
        }
    }
}

/* One pass over one of the rows. True when all ranges are found. */
static bool step_search(selfcal_work_t *work) {
    const bool rows = hypothesis_of(work)->alpha != NULL;
    selfcal_range_t *range = &work->range[1];
    if (work->at == 0U) {
        const selfcal_real_t ln_alpha = rows ? sample_at(range, work->row) : R(0.0);
        if (work->pass == 0U) {
            work->range[0].lo = work->limit_lo[0]; /* nothing is known yet: a row may have two peaks */
            work->range[0].hi = work->limit_hi[0];
        } else {
            widen_row(work);
        }
        make_row(work, ln_alpha);
    }
    work->at++;
    if (!find_row(work)) {
        return false;
    }
    work->at = 0;
    work->scratch.grid.height[work->row] = work->row_best;
    work->scratch.grid.found[work->row] = work->range[0];
    work->scratch.grid.least[work->row] = work->least[0];
    if (work->row_best > work->best - work->depth) {
        note_ranges(work);
    }
    work->row++;
    if (rows && work->row < SAMPLES) {
        return false;
    }
    const selfcal_range_t limit = {work->limit_lo[1], work->limit_hi[1]};
    const selfcal_range_t before = *range;
    /* After the last pass the range stays what the rows found belong to. */
    if (rows && work->pass < PASSES_MAX && next_range(range, work->scratch.grid.height, work->best - work->depth, &limit)) {
        work->pass++;
        /* It does not grow again beyond a row that did not count. */
        work->limit_lo[1] = range->lo > before.lo ? range->lo : work->limit_lo[1];
        work->limit_hi[1] = range->hi < before.hi ? range->hi : work->limit_hi[1];
        /* Huge samples shrink the range to a few roundings at the prior's end: there at may be all samples. */
        const selfcal_real_t at = (range->lo - before.lo) / (before.hi - before.lo) * (selfcal_real_t)SAMPLES;
        work->range[0] = work->scratch.grid.found[at > R(0.0) ? (unsigned)r_fmin(at, (selfcal_real_t)(SAMPLES - 1U)) : 0U];
        begin_pass(work);
        return false;
    }
    work->least[1] = rows ? cells_for_peak(work->scratch.grid.height, work->best - PEAK * work->depth, 32) : 1U;
    return true;
}

/* --------------------------------------------------------------------------------------------------------------- sums */

/* Whether nodes or lines are too far apart for a record so long. What the data put into a node's sums looks, as a function of ln rho or ln
 * alpha, like white noise smoothed by 1/(1 + e^2x), whose spectrum falls as e^(-pi |s|/2): at the nodes' Nyquist frequency pi/h that is
 * e^(-pi^2/2h), of alpha 3/8 of it. It grows as sqrt(n); the nodes of a grid of two dimensions show what lies between its rows and columns, and between the nodes
 * of a random walk beside it, so that lines leave little of it; on such a grid no more comes after some 10^4 samples. Of a law without
 * an expectation all of the ln-likelihood is left to the splines, which grows as n. The limits are measured, on records over the
 * whole prior, n = 100 to 10^5 on 8 to 24 nodes: below them 98 in 100 kept all three tolerances (the
 * Cortex-M0's 14 x 7: 388 of 390 of 4100 and 4400, then 8 of 120 of 6000 did not). What uneven noise or time adds to the
 * ln-likelihood is as smooth and left to the splines whole, with lines that are forced to explain it besides: a nat of it weighs as 100. */
static bool too_coarse(const selfcal_work_t *work) {
    /* 0, so that e^-inf is the rest, where there is none. */
    const selfcal_real_t step[2] = {work->bank->rho_step[work->hypothesis], work->bank->alpha_step[work->hypothesis]};
    const selfcal_real_t weight = (selfcal_real_t)work->bank->weight;
    const selfcal_real_t rest = r_exp(R(-4.9348022) / step[0]) + R(0.375) * r_exp(R(-4.9348022) / step[1]);
    if (!has_expectation(work)) {
        return rest * weight > R(0.08);
    }
    const bool pair = hypothesis_of(work)->alpha != NULL;
    return rest * (r_sqrt((pair ? r_fmin(weight, R(1e4)) : weight) + R(400.0)) + R(100.0) * work->truth.missed) > (work->truth.pair ? R(0.4) : R(0.02)) ||
           lines_range(weight) > LINES_APART * (selfcal_real_t)(SELFCAL_LINES - 1);
}

static void begin_sum(selfcal_work_t *work) {
    work->row = 0;
    work->rows = (uint8_t)cells_in(work, 1);
    work->mass = work->mass_sq = 0.0;
    work->off_grid = too_coarse(work) ? (selfcal_wide_t)INFINITY : 0.0; /* then all of the mass counts as off the grid */
    memset(work->first, 0, sizeof work->first);
    memset(work->second, 0, sizeof work->second);
    for (int which = 0; which < 2; which++) {
        memset(&work->field[which][work->first_node], 0, nodes_of(work) * sizeof work->field[which][0]);
    }
    memset(work->scratch.grid.histogram, 0, sizeof work->scratch.grid.histogram);
    memset(work->scratch.grid.modes, 0, sizeof work->scratch.grid.modes);
    work->range_lo[SELFCAL_ALPHA] = work->range[1].lo;
    work->range_hi[SELFCAL_ALPHA] = work->range[1].hi;
    for (unsigned p = 0; p < SELFCAL_PARAMETERS; p++) {
        const selfcal_prior_t *prior = &prior_of(work)[p];
        work->range_lo[p] = r_fmax(work->range_lo[p], (selfcal_real_t)prior->ln_min);
        work->range_hi[p] = r_fmin(work->range_hi[p], (selfcal_real_t)prior->ln_max);
        if (!(work->range_lo[p] <= work->range_hi[p])) { /* the last pass found no row as high as the best before: the priors cut nearly all */
            work->range_lo[p] = (selfcal_real_t)prior->ln_min;
            work->range_hi[p] = (selfcal_real_t)prior->ln_max;
        }
    }
}

static int bins_of(const selfcal_work_t *work, unsigned p) {
    return p == SELFCAL_ALPHA ? work->rows : SELFCAL_HISTOGRAM;
}

static selfcal_real_t histogram_step(const selfcal_work_t *work, unsigned p) {
    return (work->range_hi[p] - work->range_lo[p]) / (selfcal_real_t)bins_of(work, p);
}

/* How masses of one width go into a parameter's histogram. */
typedef struct {
    selfcal_real_t *bins;
    selfcal_real_t lo, per_step; /* of ln(parameter) */
    selfcal_real_t half, per_width; /* bins */
} spread_t;

static spread_t spread_over(const selfcal_work_t *work, unsigned p, selfcal_real_t bins[], selfcal_real_t width) {
    const selfcal_real_t step = histogram_step(work, p);
    const selfcal_real_t per_step = step > R(0.0) ? R(1.0) / step : R(0.0);
    const selfcal_real_t half = R(0.5) * width * per_step;
    spread_t spread = {NULL, work->range_lo[p], per_step, half, half > R(0.0) ? R(0.5) / half : R(0.0)};
    spread.bins = bins;
    return spread;
}

/* Spreads mass evenly over the width about a value of ln(parameter); what would lie outside is pushed in. Until finish_estimate() the
 * bins hold differences, each to the one before: a mass as wide as all of them costs no more than one within a bin. */
static void deposit(const spread_t *spread, selfcal_real_t middle, selfcal_real_t mass) {
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

/* A cell so far above the best of the search, in nats, is no likelihood: the nodes are too far apart for what lies between them. Its mass
 * stays a float, and the report says that the grid does not bear it. */
#define LOST R(30.0)

/* What a cell adds to the sums, sigma_v integrated: its mass, the same times sigma_v^2 over that of the mode, and first and second
 * moments of N and of the drift parameter about the best cell, relative. */
typedef struct {
    selfcal_real_t mass, mass_sq, first[2], second[2];
} moments_t;

/* N or the drift parameter in a cell. */
typedef struct {
    const selfcal_prior_t *prior;
    selfcal_real_t ln_value, width; /* at sigma_v's conditional mode; what it runs through at each sigma_v of the cell */
    selfcal_real_t off;             /* from the best cell, relative */
    bool cut;                       /* the limits do not leave all of it */
    spread_t spread;
} side_t;

/* Where nothing cuts sigma_v: its moments are those of all such cells, and their histograms receive it at the end (add_modes() below). */
static moments_t sum_whole(selfcal_work_t *work, const side_t side[2], unsigned sides, selfcal_real_t height) {
    const selfcal_real_t e = work->sigma_first, e_sq = work->sigma_second;
    moments_t sum = {height * work->sigma_mass, R(0.0), {R(0.0), R(0.0)}, {R(0.0), R(0.0)}};
    sum.mass_sq = sum.mass * (R(1.0) + e + e + e_sq);
    for (unsigned j = 0; j < sides; j++) {
        const selfcal_real_t off = side[j].off, per = R(1.0) + off;
        sum.first[j] = sum.mass * r_fma(per, e, off);
        sum.second[j] = sum.mass * r_fma(off, r_fma(R(2.0) * per, e, off), per * per * e_sq);
        deposit(&side[j].spread, side[j].ln_value, sum.mass);
    }
    return sum;
}

/* `fall`: change of ln sigma_v's mode from one side of the cell to the other, of width `wide` in ln rho; `profile`: ln height at that mode.
 * `cost`: in cells that nothing cuts. */
static moments_t sum_cell(selfcal_work_t *work, const selfcal_real_t ln_value[], selfcal_real_t profile, selfcal_real_t density,
                          selfcal_real_t wide, selfcal_real_t fall, unsigned *cost) {
    const selfcal_hypothesis_t *hypothesis = hypothesis_of(work);
    const unsigned sides = hypothesis->rho != NULL ? 2U : 1U;
    /* What N and the drift parameter run through from one side of the cell to the other: where the drift hides the white
     * noise, sigma_v falls as rho rises and their product stands still. */
    selfcal_real_t half[2] = {R(0.5) * r_fabs(fall), R(0.5) * r_fabs(wide + fall)};
    const reach_t reach = reach_of(work, ln_value, half);
    moments_t sum = {R(0.0), R(0.0), {R(0.0), R(0.0)}, {R(0.0), R(0.0)}};
    if (!(reach.from < reach.to) || !(profile - reach.drop > work->best - R(3.0) * work->depth)) { /* nor NaN */
        return sum;
    }
    if (profile - reach.drop > work->best + LOST) {
        work->off_grid = (selfcal_wide_t)INFINITY;
    }
    const selfcal_real_t height = r_exp(r_fmin(profile - work->best - reach.base, LOST)) * density;
    side_t side[2];
    bool whole = reach.from == work->delta_lo && reach.to == work->delta_hi;
    for (unsigned j = 0; j < sides; j++) {
        const unsigned p = j == 0U ? SELFCAL_N : work->scratch.grid.row.drift;
        side_t *s = &side[j];
        s->prior = &work->scratch.grid.row.prior[p];
        s->ln_value = ln_value[p];
        s->off = r_expm1(ln_value[p] - work->best_ln[p]);
        s->cut = s->ln_value + reach.from - half[j] < (selfcal_real_t)s->prior->ln_min ||
                 s->ln_value + reach.to + half[j] > (selfcal_real_t)s->prior->ln_max;
        whole = whole && !s->cut && !s->prior->uniform;
    }
    for (unsigned j = 0; j < sides && whole; j++) {
        const unsigned p = j == 0U ? SELFCAL_N : work->scratch.grid.row.drift;
        side[j].spread = spread_over(work, p, work->scratch.grid.modes[j], r_fmax(R(2.0) * half[j], histogram_step(work, p)));
    }
    if (whole) {
        return sum_whole(work, side, sides, height);
    }
    *cost = COST_OF_CUT + (sigma_cells(work, reach.from, reach.to, reach.base) ? COST_OF_LAYING : 0U);
    const selfcal_real_t width = work->delta_width;
    for (unsigned j = 0; j < sides; j++) {
        const unsigned p = j == 0U ? SELFCAL_N : work->scratch.grid.row.drift;
        side_t *s = &side[j];
        s->width = r_fmax(width, R(2.0) * half[j]);
        s->spread = spread_over(work, p, work->scratch.grid.histogram[p], s->width);
        const selfcal_real_t side_half = R(0.5) * s->width;
        s->cut = s->ln_value + reach.from - side_half < (selfcal_real_t)s->prior->ln_min ||
                 s->ln_value + reach.to + side_half > (selfcal_real_t)s->prior->ln_max;
    }
    for (int k = 0; k < SELFCAL_SIGMA_CELLS; k++) {
        const selfcal_real_t delta = reach.from + ((selfcal_real_t)k + R(0.5)) * width, e = work->scratch.grid.delta_expm1[k];
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
            /* A uniform prior of density 1/(max - min) in the parameter is e^(ln parameter) of that in its logarithm. */
            if (s->prior->uniform) {
                w *= r_exp(ln[j]);
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
            deposit(&side[j].spread, ln[j], w);
        }
    }
    return sum;
}

/* The next row of the sums, which counts where those of the search beside it do, and a little beyond. */
static void begin_row(selfcal_work_t *work) {
    const selfcal_range_t *range = &work->range[1];
    if (hypothesis_of(work)->alpha == NULL) {
        make_row(work, R(0.0));
        return;
    }
    const selfcal_real_t at = ((selfcal_real_t)work->row + R(0.5)) / (selfcal_real_t)work->rows;
    const selfcal_real_t z = r_fmax(at * (selfcal_real_t)SAMPLES - R(0.5), R(0.0));
    const unsigned i = z < (selfcal_real_t)(SAMPLES - 2U) ? (unsigned)z : SAMPLES - 2U;
    const selfcal_range_t *one = &work->scratch.grid.found[i], *other = &work->scratch.grid.found[i + 1U];
    const selfcal_real_t part = r_fmin(z - (selfcal_real_t)i, R(1.0));
    const uint8_t *least = &work->scratch.grid.least[i];
    work->least[0] = least[0] > least[1] ? least[0] : least[1];
    const selfcal_real_t lo = r_fma(part, other->lo - one->lo, one->lo), hi = r_fma(part, other->hi - one->hi, one->hi);
    const selfcal_real_t more = BEYOND * (hi - lo);
    work->range[0].lo = r_fmax(lo - more, work->limit_lo[0]);
    work->range[0].hi = r_fmin(hi + more, work->limit_hi[0]);
    make_row(work, r_fma(range->hi - range->lo, at, range->lo));
}

/* Some cells of a row. */
static void step_sum(selfcal_work_t *work) {
    const selfcal_hypothesis_t *hypothesis = hypothesis_of(work);
    const uint16_t rows = grid_nodes(hypothesis->rho), columns = grid_nodes(hypothesis->alpha);
    const unsigned taps = hypothesis->rho != NULL ? 6U : 1U;
    if (work->at == 0U) {
        begin_row(work);
    }
    const uint16_t count = cells_in(work, 0);
    selfcal_real_t weight[SELFCAL_GRID_MAX], weight_sq[SELFCAL_GRID_MAX]; /* of the rho basis functions */
    memset(weight, 0, sizeof weight);
    memset(weight_sq, 0, sizeof weight_sq);
    const selfcal_cell_row_t *row = &work->scratch.grid.row;
    const selfcal_range_t range = work->range[0];
    const selfcal_real_t wide = (range.hi - range.lo) / (selfcal_real_t)count;
    const selfcal_real_t high = (work->range[1].hi - work->range[1].lo) / (selfcal_real_t)work->rows;
    selfcal_real_t density = wide * high * cell_weight(work->rows, work->row);
    if (work->scratch.grid.row.prior[SELFCAL_ALPHA].uniform && hypothesis->alpha != NULL) {
        density *= r_exp(row->ln_alpha);
    }
    selfcal_real_t part_mass = R(0.0), part_mass_sq = R(0.0), part_off_grid = R(0.0), first[2] = {R(0.0), R(0.0)}, second[2] = {R(0.0), R(0.0)};
    cell_t before, cell, after;
    uint16_t i = work->at;
    make_cell(work, r_fma(wide, (selfcal_real_t)i + R(0.5), range.lo), &after);
    cell = after;
    if (i > 0U) {
        make_cell(work, r_fma(wide, (selfcal_real_t)i - R(0.5), range.lo), &cell);
    }
    for (unsigned spent = 0; i < count && spent < STEP_CELLS; i++) {
        const bool last = i + 1U == count;
        before = cell;
        cell = after;
        if (!last) {
            make_cell(work, r_fma(wide, (selfcal_real_t)i + R(1.5), range.lo), &after);
        }
        selfcal_real_t ln_value[SELFCAL_PARAMETERS];
        cell_parameters(work, &cell, ln_value);
        const selfcal_real_t fall = (after.ln_sigma - before.ln_sigma) / (i == 0U || last ? R(1.0) : R(2.0));
        unsigned cost = 1;
        const moments_t sum = sum_cell(work, ln_value, cell.profile, density, wide, fall, &cost);
        spent += cost;
        part_mass += sum.mass;
        part_mass_sq += sum.mass_sq;
        part_off_grid += cell.off_grid ? sum.mass : R(0.0);
        for (unsigned j = 0; j < 2U; j++) { /* zero without a drift */
            first[j] += sum.first[j];
            second[j] += sum.second[j];
        }
        for (unsigned k = 0; k < taps; k++) {
            weight[cell.basis_first + k] += sum.mass * cell.basis[k];
            weight_sq[cell.basis_first + k] += sum.mass_sq * cell.basis[k];
        }
    }
    work->at = i;
    if (!(part_mass > R(0.0))) {
        return;
    }
    work->mass += (selfcal_wide_t)part_mass;
    work->mass_sq += (selfcal_wide_t)part_mass_sq;
    work->off_grid += (selfcal_wide_t)part_off_grid;
    for (unsigned j = 0; j < 2U; j++) {
        work->first[j == 0U ? SELFCAL_N : work->scratch.grid.row.drift] += (selfcal_wide_t)first[j];
        work->second[j == 0U ? SELFCAL_N : work->scratch.grid.row.drift] += (selfcal_wide_t)second[j];
    }
    if (hypothesis->alpha != NULL) {
        const selfcal_wide_t dev = expm1((selfcal_wide_t)row->ln_alpha - (selfcal_wide_t)work->best_ln[SELFCAL_ALPHA]);
        const selfcal_wide_t weighed = (selfcal_wide_t)part_mass * dev;
        work->first[SELFCAL_ALPHA] += weighed;
        work->second[SELFCAL_ALPHA] += weighed * dev;
        work->scratch.grid.histogram[SELFCAL_ALPHA][work->row] += part_mass / cell_weight(work->rows, work->row);
    }
    selfcal_real_t *mean = &work->field[0][work->first_node], *mean_sq = &work->field[1][work->first_node];
    for (uint16_t j = 0; j < rows; j++) {
        for (unsigned k = 0; k < (hypothesis->alpha != NULL ? 6U : 1U); k++) {
            const size_t at = (size_t)j * columns + row->basis_first + k;
            mean[at] = r_fma(weight[j], row->basis[k], mean[at]);
            mean_sq[at] = r_fma(weight_sq[j], row->basis[k], mean_sq[at]);
        }
    }
}

/* ------------------------------------------------------------------------------------------------------------- results */

/* Within a bin the density is taken as linear, its slope from the bins beside it. */
static selfcal_real_t quantile(const selfcal_work_t *work, unsigned p, selfcal_real_t total, selfcal_real_t share) {
    const selfcal_real_t step = histogram_step(work, p), *bins = work->scratch.grid.histogram[p];
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
            return work->range_lo[p] + ((selfcal_real_t)bin + (root > R(0.0) ? r_fmin(R(2.0) * more / root, R(1.0)) : R(1.0))) * step;
        }
        below += mass;
    }
    return work->range_hi[p];
}

/* Mass between two values of ln(parameter). */
static selfcal_real_t mass_between(const selfcal_work_t *work, unsigned p, selfcal_real_t lo, selfcal_real_t hi) {
    const selfcal_real_t step = histogram_step(work, p);
    selfcal_real_t mass = R(0.0);
    for (int bin = 0; bin < bins_of(work, p); bin++) {
        const selfcal_real_t from = work->range_lo[p] + (selfcal_real_t)bin * step;
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
    const selfcal_real_t step = histogram_step(work, p), width = (work->delta_hi - work->delta_lo) / (selfcal_real_t)SELFCAL_SIGMA_CELLS;
    const int zero = (int)(-work->delta_lo / step) + 1; /* the bin of a delta of 0 */
    spread_t spread = spread_over(work, p, kernel, width);
    spread.lo = -((selfcal_real_t)zero + R(0.5)) * step;
    (void)sigma_cells(work, work->delta_lo, work->delta_hi, R(0.0));
    for (int k = 0; k < SELFCAL_SIGMA_CELLS; k++) {
        deposit(&spread, work->delta_lo + ((selfcal_real_t)k + R(0.5)) * width, work->scratch.grid.delta_weight[k] / work->sigma_mass);
    }
    for (int k = 1; k < SELFCAL_HISTOGRAM; k++) {
        kernel[k] += kernel[k - 1];
    }
    const int wide = (int)((work->delta_hi - work->delta_lo) / step) + 3, most = wide < SELFCAL_HISTOGRAM ? wide : SELFCAL_HISTOGRAM;
    selfcal_real_t mass = R(0.0);
    for (int i = 0; i < SELFCAL_HISTOGRAM; i++) {
        mass += modes[i];
        if (mass > R(0.0)) {
            const int first = i < zero ? zero - i : 0, room = SELFCAL_HISTOGRAM + zero - i, last = most < room ? most : room;
            for (int k = first; k < last; k++) { /* no whole cell reaches beyond the limits */
                bins[i + k - zero] = r_fma(mass, kernel[k], bins[i + k - zero]);
            }
        }
    }
}

static void finish_estimate(selfcal_work_t *work, unsigned p, selfcal_estimate_t *estimate) {
    const selfcal_prior_t *prior = &prior_of(work)[p];
    const selfcal_real_t centre = r_exp(work->best_ln[p]), mean = (selfcal_real_t)(work->first[p] / work->mass);
    const selfcal_real_t variance = r_fmax(r_fma(-mean, mean, (selfcal_real_t)(work->second[p] / work->mass)), R(0.0));
    const selfcal_real_t step = histogram_step(work, p);
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
    if (flags == 0U && ln_sd < R(0.5) * (hi - lo) / R(3.4641016)) {
        flags |= SELFCAL_IDENTIFIED;
    }
    if (work->off_grid > 0.01 * work->mass) {
        flags |= SELFCAL_OFF_GRID;
    }
    estimate->flags = flags;
}

#if SELFCAL_TERMS_MAX > 1
/* What of `now` belongs to the terms of a node of a sum, x0 given with its variance. */
static void now_terms(const selfcal_work_t *work, uint16_t k, selfcal_wide_t x0, selfcal_wide_t variance, selfcal_wide_t bias_left,
                      selfcal_now_t *now) {
    const size_t index = (size_t)work->first_node + k;
    selfcal_wide_t lost[SELFCAL_TERMS_MAX], of_reading[SELFCAL_TERMS_MAX];
    selfcal_terms_drift(work->bank, index, 0, lost);
    selfcal_terms_drift(work->bank, index, selfcal_terms_series(work->bank, work->axis), of_reading);
    for (size_t a = 0; a < SELFCAL_TERMS_MAX; a++) {
        now->drift[a] = of_reading[a] - x0 * lost[a];
        now->own[1 + a] = bias_left * lost[a] * variance;
        for (size_t b = 0; b <= a; b++) {
            now->own[1 + SELFCAL_TERMS_MAX + term_pair(a, b)] = lost[a] * lost[b] * variance;
        }
    }
}
#endif

/* As a term decays by 1 - psi, the mean goes to now - psi drift and the node's own variance to
 * (1 - psi)^2 drift_var + (bias_left + psi lost)^2 variance + (1 - (1 - psi)^2) stationary, times sigma_v^2. `off`: the node's mean
 * less bias_about. */
static void gather_decay(selfcal_work_t *work, uint16_t k, const selfcal_node_view_t *v, const selfcal_now_t *now, selfcal_wide_t own,
                         selfcal_wide_t off) {
    const selfcal_law_t *law = hypothesis_of(work)->law;
    const size_t terms = terms_of(law);
    const selfcal_wide_t square = (selfcal_wide_t)r_exp(R(2.0) * (selfcal_real_t)v->ln_rho);
    selfcal_wide_t *decay = work->bias_decay[k % grid_nodes(hypothesis_of(work)->alpha)];
    selfcal_wide_t spread[SELFCAL_TERM_PAIRS] = {v->drift_var};
#if SELFCAL_TERMS_MAX > 1
    const selfcal_wide_t second = exp(v->ln_alpha), dt_s = (selfcal_wide_t)work->bank->model->dt_s;
    if (is_sum(law)) {
        selfcal_terms_spread(work->bank, (size_t)work->first_node + k, spread);
    }
#endif
    for (size_t a = 0; a < terms; a++) {
        selfcal_wide_t stationary = square;
#if SELFCAL_TERMS_MAX > 1
        if (is_sum(law)) { /* a walk does not decay: its psi is 0 */
            const selfcal_term_t *term = &law->term[a];
            stationary = term->kind == SELFCAL_WALK ? 0.0 : markov_variance(law, term, square, second, dt_s);
        }
#endif
        const selfcal_wide_t weighed_fall = (selfcal_wide_t)work->scratch.grid.spline[0][k] * now->drift[a];
        selfcal_wide_t with_all = 0.0;
        for (size_t b = 0; b < terms; b++) {
            const size_t pair = b <= a ? term_pair(a, b) : term_pair(b, a);
            with_all += spread[pair];
            if (b <= a) {
                decay[(size_t)2 * SELFCAL_TERMS_MAX + pair] +=
                    own * (spread[pair] + now->own[1 + SELFCAL_TERMS_MAX + pair] - (a == b ? stationary : 0.0)) +
                    weighed_fall * now->drift[b];
            }
        }
        decay[a] += weighed_fall;
        decay[SELFCAL_TERMS_MAX + a] += 2.0 * (own * (stationary - with_all + now->own[1 + a]) - weighed_fall * off);
    }
}

/* Moments of x0 + drift now, with regressors of x0 + c' z + drift: the mean over the nodes, the scatter of their means, and their own variance.
 * That goes with sigma_v^2, and so does how far the bias prior pulls, by a node's conditional mode: where the drift may hide the white
 * noise one sigma_v for all nodes would be off by decades, and rho^2 alone change too much from node to node. */
static void step_bias(selfcal_work_t *work) {
    const selfcal_wide_t offset = selfcal_bank_from_prior(work->bank, work->axis);
    const uint16_t k = work->at++;
    if (k == 0U) {
        work->mean_sq = work->mass_sq / work->mass;
    }
    selfcal_now_t now;
    selfcal_field_t field;
    node_field(work, k, &field);
    const selfcal_node_view_t *v = &field.node;
    if (work->mask == 0U) {
        selfcal_bank_now(work->bank, (uint16_t)(work->first_node + k), &field.node);
    }
    const selfcal_wide_t mode_sq = field.var * (selfcal_wide_t)field.ratio, sigma_sq = mode_sq * work->mean_sq;
    const selfcal_wide_t own = (selfcal_wide_t)work->scratch.grid.spline[1][k] * mode_sq;
    if (work->mask != 0U) {
        work->bank->model->regressors->code->now(work, k, sigma_sq, &now);
    } else {
        const selfcal_wide_t prior_precision = sigma_sq * work->per_bias_sd * work->per_bias_sd;
        const selfcal_wide_t variance = (selfcal_wide_t)(R(1.0) / (selfcal_real_t)(v->a + prior_precision)), lost = 1.0 - v->bias_left;
        const selfcal_wide_t x0 = (v->b - offset * prior_precision) * variance;
        now.mean = v->drift + x0 * v->bias_left;
        now.drift[0] = now.mean - x0;
        now.own[0] = v->bias_left * v->bias_left * variance;
        now.own[1] = v->bias_left * lost * variance;
        now.own[1 + SELFCAL_TERMS_MAX] = lost * lost * variance;
#if SELFCAL_TERMS_MAX > 1
        if (is_sum(hypothesis_of(work)->law)) {
            now_terms(work, k, x0, variance, v->bias_left, &now);
        }
#endif
    }
    if (k == 0U) {
        work->bias_about = now.mean;
    }
    const selfcal_wide_t off = now.mean - work->bias_about, weighed = (selfcal_wide_t)work->scratch.grid.spline[0][k] * off;
    work->bias_weight += (selfcal_wide_t)work->scratch.grid.spline[0][k];
    work->bias_first += weighed;
    work->bias_second += weighed * off;
    work->bias_own += own * (v->drift_var + now.own[0]);
    if (has_decay(hypothesis_of(work)->law)) {
        gather_decay(work, k, v, &now, own, off);
    }
}

static void finish_bias(const selfcal_work_t *work, selfcal_posterior_t *posterior) {
    const selfcal_wide_t mean = work->bias_first / work->bias_weight;
    const selfcal_wide_t scatter = work->bias_second / work->bias_weight - mean * mean;
    const selfcal_wide_t own = work->bias_own / work->mass;
    posterior->bias_mean = (float)(work->bias_about + mean + selfcal_offset(work->bank, work->axis));
    posterior->bias_sd = (float)sqrt(fmax(scatter, 0.0) + fmax(own, 0.0));
    for (uint16_t j = 0; has_decay(hypothesis_of(work)->law) && j < grid_nodes(hypothesis_of(work)->alpha); j++) {
        const selfcal_wide_t *decay = work->bias_decay[j];
        if (hypothesis_of(work)->alpha != NULL) {
            posterior->decay[j].alpha = (float)r_exp(selfcal_bank_place(work->bank, (uint16_t)(work->first_node + j)).ln_alpha);
        }
        for (size_t a = 0; a < SELFCAL_TERMS_MAX; a++) {
            posterior->decay[j].mean[a] = (float)(decay[a] / work->bias_weight);
            posterior->decay[j].var[a] = (float)((decay[SELFCAL_TERMS_MAX + a] + 2.0 * mean * decay[a]) / work->bias_weight);
        }
        for (size_t a = 0; a < SELFCAL_TERM_PAIRS; a++) {
            posterior->decay[j].var_sq[a] = (float)(decay[(size_t)2 * SELFCAL_TERMS_MAX + a] / work->bias_weight);
        }
    }
}

static selfcal_real_t ln_prior_density(const selfcal_prior_t *prior) {
    const selfcal_real_t hi = (selfcal_real_t)prior->ln_max, width = hi - (selfcal_real_t)prior->ln_min;
    return prior->uniform ? -hi - r_log(-r_expm1(-width)) : -r_log(width);
}

/* One parameter a step. */
static void step_estimates(selfcal_work_t *work, selfcal_posterior_t *posterior) {
    const unsigned p = work->at++;
    if (has_parameter(hypothesis_of(work)->law, p)) {
        finish_estimate(work, p, &posterior->parameter[p]);
    }
}

static void finish_hypothesis(const selfcal_work_t *work, selfcal_posterior_t *posterior) {
    if (!(work->mass > 0.0)) {
        return; /* the priors leave nothing of the likelihood */
    }
    posterior->ln_evidence = work->top_profile + (selfcal_wide_t)work->peak + (selfcal_wide_t)work->best +
                             log(work->mass);
    for (unsigned p = 0; p < SELFCAL_PARAMETERS; p++) {
        if (has_parameter(hypothesis_of(work)->law, p)) {
            posterior->ln_evidence += (selfcal_wide_t)ln_prior_density(&prior_of(work)[p]);
        }
    }
    finish_bias(work, posterior);
    if (work->mask != 0U) {
        work->bank->model->regressors->code->finish(work);
    }
}

/* No law has an evidence, nor what follows from one. */
static void know_nothing(const selfcal_work_t *work, selfcal_report_t *report) {
    for (int h = 0; h < SELFCAL_HYPOTHESES_MAX; h++) {
        selfcal_posterior_t *posterior = &report->hypothesis[h];
        posterior->ln_evidence = (selfcal_wide_t)-INFINITY;
        posterior->bias_mean = NAN;
        posterior->bias_sd = NAN;
        for (unsigned p = 0; p < SELFCAL_PARAMETERS; p++) {
            const selfcal_estimate_t nothing = {NAN, NAN, NAN, NAN, NAN, 0};
            posterior->parameter[p] = nothing;
        }
        for (int r = 0; work->coefficients != NULL && h < work->bank->model->hypotheses && r < SELFCAL_REGRESSORS_MAX; r++) {
            work->coefficients[h].mean[r] = NAN;
            work->coefficients[h].sd[r] = NAN;
        }
    }
}

/* (13), and the bias over all hypotheses. */
static void finish_report(const selfcal_work_t *work, selfcal_report_t *report) {
    const selfcal_model_t *model = work->bank->model;
    selfcal_wide_t best = (selfcal_wide_t)-INFINITY;
    uint8_t likeliest = 0;
    for (uint8_t h = 0; h < model->hypotheses; h++) {
        const selfcal_wide_t joint = report->hypothesis[h].ln_evidence + (selfcal_wide_t)model->hypothesis[h].ln_probability;
        if (joint > best) {
            best = joint;
            likeliest = h;
        }
    }
    if (work->drop[likeliest] > SIGMA_DEPTH) { /* to that law too all the noise that the priors allow is as good as impossible */
        know_nothing(work, report);
    }
    const selfcal_real_t about = (selfcal_real_t)report->hypothesis[likeliest].bias_mean;
    selfcal_real_t sum = R(0.0), mean = R(0.0), square = R(0.0);
    for (uint8_t h = 0; h < model->hypotheses; h++) {
        selfcal_posterior_t *posterior = &report->hypothesis[h];
        const selfcal_real_t weight = r_exp((selfcal_real_t)(posterior->ln_evidence + (selfcal_wide_t)model->hypothesis[h].ln_probability - best));
        posterior->probability = (float)weight;
        sum += weight;
        if (weight != R(0.0)) { /* a law without evidence has no bias, and counts for nothing; if none has any, all is NaN */
            const selfcal_real_t off = (selfcal_real_t)posterior->bias_mean - about, sd = (selfcal_real_t)posterior->bias_sd;
            mean = r_fma(weight, off, mean);
            square = r_fma(weight, r_fma(off, off, sd * sd), square);
        }
    }
    for (uint8_t h = 0; h < model->hypotheses; h++) {
        report->hypothesis[h].probability /= (float)sum;
    }
    mean /= sum;
    report->bias_mean = (float)(about + mean);
    report->bias_sd = (float)r_sqrt(square / sum - mean * mean);
}

/* --------------------------------------------------------------------------------------------------------------- slices */

selfcal_status_t selfcal_report_begin(selfcal_work_t *work, selfcal_t *self, uint8_t axis, selfcal_report_t *report) {
    return selfcal_report_begin_subset(work, self, axis, 0U, NULL, report);
}

selfcal_status_t selfcal_report_begin_subset(selfcal_work_t *work, selfcal_t *self, uint8_t axis, uint8_t mask,
                                             selfcal_coefficients_t coefficients[], selfcal_report_t *report) {
    if (work == NULL || self == NULL || report == NULL || axis >= self->model->axes ||
        ((unsigned)mask & ~(unsigned)selfcal_regressors_mask(self->model, axis)) != 0U) {
        return SELFCAL_BAD_ARGUMENT;
    }
    if (selfcal_retired(self, axis)) {
        return SELFCAL_AXIS_RETIRED;
    }
    uint8_t unknowns = 1;
    for (uint8_t r = 0; r < SELFCAL_REGRESSORS_MAX; r++) {
        unknowns = (uint8_t)(unknowns + ((unsigned)mask >> r & 1U));
    }
    if (selfcal_count(self) + 1U < SELFCAL_REPORT_MIN + (uint32_t)unknowns) {
        return SELFCAL_TOO_SHORT;
    }
    memset(work, 0, sizeof *work);
    work->bank = self;
    work->axis = axis;
    work->mask = mask;
    work->unknowns = unknowns;
    work->coefficients = coefficients;
    work->stage = GATHER;
    memset(report, 0, sizeof *report);
    report->axis = axis;
    know_nothing(work, report);
    return SELFCAL_OK;
}

/* Runs the nodes over what the bank has gathered when the report begins; true when the sums are at rest. */
static bool step_gather(selfcal_work_t *work) {
    if (selfcal_bank_run(work->bank, STEP_NODES)) {
        return false;
    }
    if (!work->gathered) {
        work->gathered = true;
        if (selfcal_bank_hand_over(work->bank)) {
            return false;
        }
    }
    work->batches = work->bank->batches;
    return true;
}

static void go_to(selfcal_work_t *work, int stage) {
    work->stage = (uint8_t)stage;
    work->at = 0;
}

selfcal_status_t selfcal_report_step(selfcal_work_t *work, selfcal_report_t *report) {
    if (work == NULL || report == NULL || work->bank == NULL) {
        return SELFCAL_BAD_ARGUMENT;
    }
    if (work->stage > GATHER && work->batches != work->bank->batches) {
        work->bank = NULL;
        return SELFCAL_OVERTAKEN;
    }
    if (work->stage == WHOLE) {
        finish_report(work, report);
        work->bank = NULL;
        return SELFCAL_OK;
    }
    selfcal_posterior_t *posterior = &report->hypothesis[work->hypothesis];
    const uint16_t nodes = nodes_of(work);
    switch (work->stage) {
    case GATHER:
        if (step_gather(work)) {
            report->n = work->bank->n;
            if (work->bank->weight + 1.0 < (selfcal_wide_t)(SELFCAL_REPORT_MIN + work->unknowns)) {
                work->bank = NULL;
                return SELFCAL_TOO_SHORT; /* the rest is forgotten */
            }
            go_to(work, TRUTH);
        }
        break;
    case TRUTH:
        step_truth(work);
        if (work->at == work->bank->model->nodes) {
            go_to(work, work->best_node < work->bank->model->nodes ? FIT : SIGMA);
        }
        break;
    case FIT:
        step_fit(work);
        if (work->at > work->bank->model->nodes || !work->truth.pair) {
            solve(work); /* all 0 without a pair: the nodes of a random walk alone tell too little */
            go_to(work, SIGMA);
            work->hypothesis = 0;
        }
        break;
    case SIGMA:
        step_sigma(work, nodes);
        go_to(work, VALUES);
        break;
    case VALUES:
        step_values(work);
        if (work->at == nodes) {
            go_to(work, SPLINE_PROFILE);
        }
        break;
    case SPLINE_PROFILE:
    case SPLINE_SIGMA:
        if (step_transform(work, false, work->stage - SPLINE_PROFILE)) {
            if (work->stage == SPLINE_SIGMA) {
                begin_search(work);
            }
            go_to(work, work->stage + 1);
        }
        break;
    case SEARCH:
        if (step_search(work)) {
            if (work->best > (selfcal_real_t)-INFINITY) {
                begin_sum(work);
                go_to(work, SUM);
            } else {
                work->mass = 0.0;
                go_to(work, EVIDENCE);
            }
        }
        break;
    case SUM:
        step_sum(work);
        if (work->at == cells_in(work, 0)) {
            work->row++;
            go_to(work, work->row < work->rows ? SUM : work->mass > 0.0 ? WEIGHTS : EVIDENCE);
        }
        break;
    case WEIGHTS:
    case WEIGHTS_SQ:
        if (step_transform(work, true, work->stage - WEIGHTS)) {
            work->bias_weight = work->bias_first = work->bias_second = work->bias_own = 0.0;
            memset(work->bias_decay, 0, sizeof work->bias_decay);
            go_to(work, work->stage + 1);
        }
        break;
    case BIAS:
        step_bias(work);
        if (work->at == nodes) {
            go_to(work, ESTIMATES);
        }
        break;
    case ESTIMATES:
        step_estimates(work, posterior);
        if (work->at == SELFCAL_PARAMETERS) {
            go_to(work, EVIDENCE);
        }
        break;
    case EVIDENCE:
        finish_hypothesis(work, posterior);
        work->first_node = (uint16_t)(work->first_node + nodes);
        work->hypothesis++;
        go_to(work, work->hypothesis < work->bank->model->hypotheses ? SIGMA : WHOLE);
        break;
    default: SELFCAL_ASSERT(false); break;
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
