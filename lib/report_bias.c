/* Bias: moments of x0 + drift now over the nodes, and how a decaying drift will move them. */
#include "report_inside.h"

/* The terms' part of `now` at a node of a sum, x0 given with its variance. */
static void now_terms(const selfcal_work_t *work, uint16_t k, selfcal_real_t x0, selfcal_real_t variance,
                      selfcal_real_t bias_left, selfcal_now_t *now) {
    const size_t index = (size_t)work->first_node + k;
    selfcal_wide_t lost[SELFCAL_TERMS_MAX], of_reading[SELFCAL_TERMS_MAX];
    const selfcal_states_code_t *states = work->bank->model->states;
    states->drift(work->bank, index, 0, lost);
    states->drift(work->bank, index, series_of_readings(work->bank, work->axis), of_reading);
    for (size_t a = 0; a < SELFCAL_TERMS_MAX; a++) {
        now->drift[a] = (selfcal_real_t)(of_reading[a] - (selfcal_wide_t)x0 * lost[a]);
        now->own[1 + a] = bias_left * (selfcal_real_t)lost[a] * variance;
        for (size_t b = 0; b <= a; b++) {
            now->own[1 + SELFCAL_TERMS_MAX + term_pair(a, b)] = (selfcal_real_t)(lost[a] * lost[b]) * variance;
        }
    }
}

/* As a term decays by 1 - psi, the mean goes to now - psi drift and the node's own variance to
 * (1 - psi)^2 drift_var + (bias_left + psi lost)^2 variance + (1 - (1 - psi)^2) stationary, times sigma_v^2. `off`: the
 * node's mean less bias_about. */
static void gather_decay(const selfcal_work_t *work, uint16_t k, const selfcal_node_view_t *v, const selfcal_now_t *now,
                         selfcal_real_t own, selfcal_real_t off, selfcal_bias_t *bias) {
    const selfcal_law_t *law = hypothesis_of(work)->law;
    const size_t terms = terms_of(law);
    const selfcal_real_t square = r_exp(R(2.0) * (selfcal_real_t)v->ln_rho), weight = work->scratch.grid.spline[0][k];
    selfcal_real_t *decay = bias->decay[k % grid_nodes(hypothesis_of(work)->alpha)];
    selfcal_wide_t spread[SELFCAL_TERM_PAIRS] = {v->drift_var};
    const bool sum = is_sum(law);
    const selfcal_wide_t second = sum ? exp(v->ln_alpha) : 0.0, dt_s = (selfcal_wide_t)work->bank->model->dt_s;
    const selfcal_real_t gain = sum ? R(1.0) : selfcal_points_gain(work, (selfcal_real_t)v->ln_alpha);
    if (sum) {
        work->bank->model->states->spread(work->bank, (size_t)work->first_node + k, spread);
    }
    for (size_t a = 0; a < terms; a++) {
        selfcal_real_t stationary = square / gain;
        if (sum) { /* a walk does not decay: its psi is 0 */
            const selfcal_term_t *term = &law->term[a];
            stationary = term->kind == SELFCAL_WALK
                             ? R(0.0)
                             : (selfcal_real_t)markov_variance(law, term, (selfcal_wide_t)square, second, dt_s);
        }
        const selfcal_real_t weighed_fall = weight * now->drift[a];
        selfcal_real_t with_all = R(0.0);
        for (size_t b = 0; b < terms; b++) {
            const size_t pair = b <= a ? term_pair(a, b) : term_pair(b, a);
            const selfcal_real_t of_pair = (selfcal_real_t)spread[pair];
            with_all += of_pair;
            if (b <= a) {
                decay[(size_t)2 * SELFCAL_TERMS_MAX + pair] +=
                    own * (of_pair + now->own[1 + SELFCAL_TERMS_MAX + pair] - (a == b ? stationary : R(0.0))) +
                    weighed_fall * now->drift[b];
            }
        }
        decay[a] += weighed_fall;
        decay[SELFCAL_TERMS_MAX + a] += R(2.0) * (own * (stationary - with_all + now->own[1 + a]) - weighed_fall * off);
    }
}

/* The node of most weight is the first. */
static void begin_bias(const selfcal_work_t *work, selfcal_bias_t *bias) {
    const selfcal_real_t *weight = work->scratch.grid.spline[0];
    for (uint16_t k = 1; k < nodes_of(work); k++) {
        bias->from = weight[k] > weight[bias->from] ? k : bias->from;
    }
    bias->mean_sq = (selfcal_real_t)(work->sum.mass_sq / work->sum.mass);
}

/* Where the grid is far too coarse for huge readings, a node that counts may have its level beyond a float. Held there,
 * squares of it are still floats. */
#define LEVEL_MOST 1e17

static selfcal_wide_t held(selfcal_wide_t level) {
    return fmin(fmax(level, -LEVEL_MOST), LEVEL_MOST);
}

/* Without regressors in use. */
static void now_plain(const selfcal_work_t *work, uint16_t k, selfcal_real_t sigma_sq, selfcal_node_view_t *v,
                      selfcal_now_t *now) {
    selfcal_bank_now(work->bank, (uint16_t)(work->first_node + k), v);
    /* Wide: a bias that nearly no reading shows has a precision beyond a float. */
    const selfcal_wide_t per_sd = (selfcal_wide_t)work->per_bias_sd,
                         prior_precision = (selfcal_wide_t)sigma_sq * per_sd * per_sd,
                         offset = (selfcal_wide_t)selfcal_bank_from_prior(work->bank, work->axis);
    const selfcal_wide_t per_precision = 1.0 / ((selfcal_wide_t)v->a + prior_precision),
                         level = held(((selfcal_wide_t)v->b - offset * prior_precision) * per_precision);
    const selfcal_real_t variance = (selfcal_real_t)per_precision, x0 = (selfcal_real_t)level,
                         left = (selfcal_real_t)v->bias_left, lost = R(1.0) - left;
    now->mean = v->drift + level * (selfcal_wide_t)left;
    now->drift[0] = (selfcal_real_t)v->drift - x0 * lost;
    now->own[0] = left * left * variance;
    now->own[1] = left * lost * variance;
    now->own[1 + SELFCAL_TERMS_MAX] = lost * lost * variance;
    if (is_sum(hypothesis_of(work)->law)) {
        now_terms(work, k, x0, variance, left, now);
    }
}

/* Moments of x0 + drift now, with regressors of x0 + c' z + drift: the mean over the nodes, the scatter of their means,
 * and their own variance. That goes with sigma_v^2, and so does how far the bias prior pulls, by a node's conditional
 * mode: where the drift may hide the white noise one sigma_v for all nodes would be off by decades, and rho^2 alone
 * change too much from node to node. */
void selfcal_bias_step(selfcal_work_t *work) {
    if (work->at == 0U) {
        begin_bias(work, &work->bias);
    }
    const uint16_t in_turn = (uint16_t)(work->bias.from + work->at), nodes = nodes_of(work),
                   k = (uint16_t)(in_turn < nodes ? in_turn : in_turn - nodes);
    const selfcal_real_t weight = work->scratch.grid.spline[0][k];
    const bool first = work->at == 0U;
    if (weight == R(0.0) && !first) {
        work->at++;
        return; /* far from all that counts, its mean may lie beyond a float */
    }
    selfcal_now_t now;
    selfcal_field_t field;
    selfcal_node_field(work, k, &field);
    const selfcal_real_t mode_sq = (selfcal_real_t)field.var * field.ratio, sigma_sq = mode_sq * work->bias.mean_sq;
    const selfcal_real_t own = work->scratch.grid.spline[1][k] * mode_sq;
    if (work->mask != 0U) {
        work->bank->model->regressors->code->now(work, k, (selfcal_wide_t)sigma_sq, &now);
    } else {
        now_plain(work, k, sigma_sq, &field.node, &now);
    }
    now.mean = held(now.mean);
    if (first) {
        work->bias.about = now.mean;
    }
    const selfcal_real_t off = (selfcal_real_t)(now.mean - work->bias.about), weighed = weight * off;
    work->bias.weight += weight;
    work->bias.first += weighed;
    work->bias.second += weighed * off;
    work->bias.own += own * ((selfcal_real_t)field.node.drift_var + now.own[0]);
    if (has_decay(hypothesis_of(work)->law)) {
        gather_decay(work, k, &field.node, &now, own, off, &work->bias);
    }
    work->at++; /* last: what the columns sum begins with the first node as well */
}

void selfcal_bias_finish(const selfcal_work_t *work, selfcal_posterior_t *posterior) {
    const selfcal_real_t per_weight = R(1.0) / work->bias.weight, mean = work->bias.first * per_weight;
    const selfcal_real_t scatter = work->bias.second * per_weight - mean * mean;
    const selfcal_real_t own = work->bias.own / (selfcal_real_t)work->sum.mass;
    posterior->bias_mean = (float)(work->bias.about + (selfcal_wide_t)mean + selfcal_offset(work->bank, work->axis));
    posterior->bias_sd = (float)r_sqrt(r_fmax(scatter, R(0.0)) + r_fmax(own, R(0.0)));
    for (uint16_t j = 0; has_decay(hypothesis_of(work)->law) && j < grid_nodes(hypothesis_of(work)->alpha); j++) {
        const selfcal_real_t *decay = work->bias.decay[j];
        if (hypothesis_of(work)->alpha != NULL) {
            posterior->decay[j].alpha =
                (float)r_exp(selfcal_bank_place(work->bank, (uint16_t)(work->first_node + j)).ln_alpha);
        }
        for (size_t a = 0; a < SELFCAL_TERMS_MAX; a++) {
            posterior->decay[j].mean[a] = (float)(decay[a] * per_weight);
            posterior->decay[j].var[a] =
                (float)((decay[SELFCAL_TERMS_MAX + a] + R(2.0) * mean * decay[a]) * per_weight);
        }
        for (size_t a = 0; a < SELFCAL_TERM_PAIRS; a++) {
            posterior->decay[j].var_sq[a] = (float)(decay[(size_t)2 * SELFCAL_TERMS_MAX + a] * per_weight);
        }
    }
}
