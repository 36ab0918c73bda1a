/* Nodes: every node once, and two numbers kept of each: its profile ln-likelihood and ln of sigma_v's conditional mode.
 *
 * Under the priors of the bias and of the coefficients the mode t^ of t = ln sigma_v has no closed form. Turns find it:
 *     sigma_v^2 = (residual + noise) / (n - w), w = P0 A/(P0 A + sigma_v^2), noise = (1 - w)^2 A (x0^ - x0 prior)^2,
 * w the share of one sample that the bias takes, 1 under a wide prior. With regressors in use each coefficient takes
 * such a share as well. */
#include "report_inside.h"

#define STEP_NODES 3U
#define STEP_VALUES 16U

/* A node is dearer with regressors in use: one a step. */
static unsigned step_nodes(const selfcal_work_t *work) {
    return work->mask == 0U ? STEP_NODES : 1U;
}

void selfcal_node_field(const selfcal_work_t *work, uint16_t k, selfcal_field_t *field) {
    const selfcal_t *bank = work->bank;
    const uint16_t index = (uint16_t)(work->first_node + k);
    const selfcal_wide_t n = bank->weight;
    const selfcal_wide_t sd = (selfcal_wide_t)axis_of(work)->bias_sd, p0 = sd * sd; /* of the model, always wide */
    /* A record without any scatter has no likelihood; the floor keeps its logarithm finite, far below any prior's N
     * over the largest rho. */
    const selfcal_wide_t least = 1e-28 * p0;
    if (work->mask != 0U) {
        bank->model->regressors->code->field(work, index, n * least, field);
        return;
    }
    const selfcal_node_view_t *v = &field->node;
    selfcal_bank_sums(bank, work->axis, index, &field->node);
    /* without a sample since selfcal_reopen() the bias is what its prior says */
    const selfcal_wide_t mean = v->a > 0.0 ? v->b / v->a : -selfcal_bank_from_prior(bank, work->axis);
    field->var = fmax((v->c - v->b * mean) * work->per_n, least); /* of the residual; the rest is in units of it */
    const selfcal_real_t miss =
        (selfcal_real_t)((mean + selfcal_bank_from_prior(bank, work->axis)) * work->per_bias_sd);
    const selfcal_real_t beginning = (selfcal_real_t)bank->beginning, size = (selfcal_real_t)n;
    const selfcal_real_t width =
        (selfcal_real_t)v->a / (selfcal_real_t)(field->var * work->per_bias_sd * work->per_bias_sd);
    const selfcal_real_t missed = beginning * miss * miss * width;
    /* The mode: the bias takes a share of one sample; of how far it missed its prior, what that leaves is noise.
     * (Beyond 10 sd of the prior there is another, where all of that is noise; this one says what the readings scatter
     * by.) */
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

/* One node into what the report keeps of all: from the best so far, so that what counts in the end was counted from
 * near by. */
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

/* Some of all nodes. The best of those with an expectation is the first guess of the process that made the data. */
void selfcal_node_step_truth(selfcal_work_t *work) {
    const selfcal_model_t *model = work->bank->model;
    selfcal_truth_t *truth = &work->truth;
    const selfcal_real_t weight = (selfcal_real_t)work->bank->weight;
    selfcal_field_t field;
    for (uint16_t k = 0; work->at == 0U && k < model->nodes; k++) {
        work->hypothesis = place_of(work, k).hypothesis;
        if (hypothesis_of(work)->rho == NULL) {
            selfcal_bank_ln_s(work->bank, k, &field.node);
            truth->noise_less_1 = r_expm1((selfcal_real_t)field.node.ln_s / weight);
        }
    }
    if (work->at == 0U) {
        work->per_n = 1.0 / work->bank->weight;
        work->per_bias_sd = 1.0 / (selfcal_wide_t)work->bank->prior_sd[work->axis];
    }
    for (uint16_t k = step_part(work, step_nodes(work), model->nodes); k < work->at; k++) {
        work->hypothesis = place_of(work, k).hypothesis;
        selfcal_node_field(work, k, &field);
        selfcal_bank_ln_s(work->bank, k, &field.node);
        keep_node(work, k, &field);
    }
    if (work->at < model->nodes) {
        return;
    }
    work->ln_top = log(work->top.var);
    work->top_profile =
        -0.5 * (work->bank->weight * (SELFCAL_LN_2PI + work->ln_top + 1.0 + (selfcal_wide_t)work->top.cost) +
                work->top.ln_s + (selfcal_wide_t)work->top.extra);
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

/* The node values less their expectation. */
void selfcal_node_step_values(selfcal_work_t *work) {
    const uint16_t nodes = nodes_of(work);
    const uint16_t rows = grid_nodes(hypothesis_of(work)->rho), columns = grid_nodes(hypothesis_of(work)->alpha);
    for (uint16_t at = step_part(work, STEP_VALUES, nodes); at < work->at; at++) {
        const uint16_t i = at % rows, j = at / rows, k = (uint16_t)(i * columns + j);
        const selfcal_place_t place = place_of(work, k);
        const selfcal_cell_row_t *row = &work->scratch.grid.row;
        selfcal_real_t *profile = &work->field[0][work->first_node + k],
                       *ln_sigma = &work->field[1][work->first_node + k];
        if (i == 0U) {
            selfcal_cells_column(work, place.ln_alpha, &work->scratch.grid.row);
        }
        expectation_t e;
        selfcal_expected(work, place.ln_rho, place.ln_alpha, row->beta, row->passed, &e);
        const selfcal_wide_t ln_mode = (selfcal_wide_t)*ln_sigma + 0.5 * work->ln_top;
        cell_t cell = {.ln_rho = place.ln_rho, .profile = *profile - work->peak, .ln_sigma = (selfcal_real_t)ln_mode};
        *profile = (selfcal_real_t)((selfcal_wide_t)cell.profile - e.profile);
        *ln_sigma = (selfcal_real_t)(ln_mode - e.ln_sigma);
        (void)selfcal_cells_white(work, e.rho_sq, &cell);
        selfcal_search_node(work, i, j, &cell);
    }
}
