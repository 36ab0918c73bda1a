/* The bias has changed: what was learned of the noise and the drift is kept, the bias is learned anew.
 *
 * The record so far and the record from here on each have a bias of their own. At every node the first one is
 * integrated out under a flat prior, as bank.c has it:
 *   -2 ln p = (C - B^2/A)/sigma_v^2 + n ln sigma_v^2 + ln A + D + a constant.
 * C becomes (C - B^2/A) (1 + ln A / n), which is the same at the node's own likeliest sigma_v. D stays. A, B, the drift
 * and its variance begin as at the first sample. The second bias has a prior N(mean, sd^2) by axis: what the likeliest
 * node says of the bias now, or what is known of the step. So the axes without a step keep what they know, though all
 * share A. A Gauss-Markov drift begins anew as well: its variance then counts twice until the readings tell.
 * The readings between a step and its detection have spoilt C of that axis: they look like more drift. It is put back
 * to what it was per sample before. Those samples then count as if they had been like the others.
 * Noise that has changed is forgotten: C, D and the weight of the samples keep the part `keep`. */
#include "bank_inside.h"

static void restart_node(selfcal_t *self, size_t j, const selfcal_wide_t c[]) {
    selfcal_node_t *node = &self->node[j];
    if (is_state_node(self, node)) {
        self->model->states->restart(self, j, c, self->keep);
        return;
    }
    selfcal_node_view_t view;
    selfcal_bank_ln_s(self, (uint16_t)j, &view);
    const selfcal_sum_t ln_s = make_sum(self->keep * view.ln_s);
    selfcal_bank_leave_level(self, j);
    selfcal_bank_start_node(self, (uint16_t)j);
    node->ln_s = ln_s;
    for (size_t axis = 0; axis < self->model->axes; axis++) {
        selfcal_kernel_restart(self, j * self->model->axes + axis, c[axis]);
    }
}

/* Nearest to a law's parameters. */
static uint16_t nearest(const selfcal_t *self, const selfcal_reopening_t *at) {
    const selfcal_hypothesis_t *hypothesis = &self->model->hypothesis[at->hypothesis];
    size_t first = 0;
    for (uint8_t h = 0; h < at->hypothesis; h++) {
        first += hypothesis_nodes(&self->model->hypothesis[h]);
    }
    const uint16_t rows = grid_nodes(hypothesis->rho), columns = grid_nodes(hypothesis->alpha);
    const selfcal_real_t row =
        rows > 1U ? ((selfcal_real_t)at->ln_rho - self->rho_lo[at->hypothesis]) / self->rho_step[at->hypothesis]
                  : R(0.0);
    const selfcal_real_t column = columns > 1U ? ((selfcal_real_t)at->ln_second - self->alpha_lo[at->hypothesis]) /
                                                     self->alpha_step[at->hypothesis]
                                               : R(0.0);
    /* a place that is not a number counts as the first */
    const size_t i = (size_t)r_fmin(r_fmax(row + R(0.5), R(0.0)), (selfcal_real_t)(rows - 1U));
    const size_t k = (size_t)r_fmin(r_fmax(column + R(0.5), R(0.0)), (selfcal_real_t)(columns - 1U));
    return (uint16_t)(first + i * columns + k);
}

/* Variance of the residuals about their most likely bias. Without a sample since the last time there is none. */
static selfcal_wide_t rest_about_bias(const selfcal_t *self, const selfcal_node_view_t *v) {
    return fmax(v->a > 0.0 ? v->c - v->b * v->b / v->a : v->c, 0.0) / self->weight;
}

/* The bias now at the likeliest node, with its sd, unit. */
static void bias_at(const selfcal_t *self, uint8_t axis, const selfcal_reopening_t *at, selfcal_wide_t *mean,
                    selfcal_wide_t *sd) {
    if (at->bias_sd > 0.0F) {
        *mean = (selfcal_wide_t)at->bias;
        *sd = (selfcal_wide_t)at->bias_sd;
        return;
    }
    selfcal_node_view_t v;
    selfcal_bank_view(self, axis, nearest(self, at), &v);
    const selfcal_wide_t sigma = (selfcal_wide_t)at->sigma_v, prior = (selfcal_wide_t)self->prior_sd[axis];
    const selfcal_wide_t square = sigma > 0.0 ? sigma * sigma : rest_about_bias(self, &v);
    const selfcal_wide_t precision = square / (prior * prior);
    const selfcal_wide_t x0 = (v.b - selfcal_bank_from_prior(self, axis) * precision) / (v.a + precision);
    *mean = selfcal_offset(self, axis) + v.drift + x0 * v.bias_left;
    *sd = sqrt(square * (v.drift_var + v.bias_left * v.bias_left / (v.a + precision)));
}

static bool valid(const selfcal_t *self, const selfcal_reopening_t at[]) {
    for (uint8_t axis = 0; axis < self->model->axes; axis++) {
        if (at[axis].hypothesis >= self->model->hypotheses || !isfinite(at[axis].bias) || !(at[axis].bias_sd >= 0.0F) ||
            !isfinite(at[axis].bias_sd)) {
            return false;
        }
    }
    return true;
}

/* The same, the bias integrated out. */
static selfcal_wide_t rest_of(const selfcal_t *self, uint8_t axis, size_t j) {
    selfcal_node_view_t v;
    selfcal_bank_sums(self, axis, (uint16_t)j, &v);
    const selfcal_wide_t ln_a = v.a > 0.0 ? log(v.a) : 0.0;
    /* of a handful of samples no less than half */
    return rest_about_bias(self, &v) * fmax(1.0 + ln_a / self->weight, 0.5);
}

void selfcal_learned(selfcal_t *self, float learned[]) {
    selfcal_bank_flush(self);
    for (size_t j = 0; j < self->model->nodes; j++) {
        for (uint8_t axis = 0; axis < self->model->axes; axis++) {
            learned[j * self->model->axes + axis] = (float)rest_of(self, axis, j);
        }
    }
}

selfcal_status_t selfcal_reopen(selfcal_t *self, const selfcal_reopening_t at[], float keep, const float learned[]) {
    if (self == NULL || at == NULL || !(keep > 0.0F) || !(keep <= 1.0F) || !valid(self, at)) {
        return SELFCAL_BAD_ARGUMENT;
    }
    if (self->model->handling == NULL || self->columns != NULL) {
        return SELFCAL_BAD_MODEL;
    }
    if (selfcal_count(self) < SELFCAL_REPORT_MIN) {
        return SELFCAL_TOO_SHORT;
    }
    selfcal_bank_flush(self);
    self->batches++; /* a report under way is of other sums */
    const size_t axes = self->model->axes;
    selfcal_wide_t mean[SELFCAL_AXES_MAX] = {0.0}, sd[SELFCAL_AXES_MAX] = {0.0}, c[SELFCAL_AXES_MAX] = {0.0};
    for (uint8_t axis = 0; axis < axes; axis++) {
        bias_at(self, axis, &at[axis], &mean[axis], &sd[axis]);
    }
    self->keep = (selfcal_wide_t)keep;
    for (size_t j = 0; j < self->model->nodes; j++) {
        for (uint8_t axis = 0; axis < axes; axis++) {
            const bool before = learned != NULL && at[axis].bias_sd > 0.0F;
            const selfcal_wide_t rest = before ? (selfcal_wide_t)learned[j * axes + axis] : rest_of(self, axis, j);
            c[axis] = selfcal_retired(self, axis) ? 0.0 : self->keep * self->weight * rest;
        }
        restart_node(self, j, c);
    }
    for (uint8_t axis = 0; axis < axes; axis++) {
        if (!selfcal_retired(self, axis)) {
            self->prior_mean[axis] = (float)mean[axis];
            self->prior_sd[axis] = (float)sd[axis];
        }
    }
    self->weight *= self->keep;
    self->keep = self->beginning = 1.0;
    return SELFCAL_OK;
}
