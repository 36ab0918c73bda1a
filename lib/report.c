/* Report: from the bank's sums to evidences, probabilities, moments and quantiles (12)-(14), in steps.
 *
 * The unknowns of one hypothesis are (rho, alpha, sigma_v). The sums give ln p(Y | node, sigma_v) in closed form, of
 * one shape in ln sigma_v for all nodes (report_marginal.c). So two numbers of each node are kept and interpolated in
 * ln rho and ln alpha: its profile ln-likelihood, and sigma_v's mode (report_node.c). Both follow from the innovations'
 * variance. For data of the best of all nodes that variance has a closed form, with the terms of order n
 * (report_expected.c). The terms of order sqrt(n) say by how much the data's spectrum happens to differ; they are
 * fitted to the nodes of all laws (report_spectrum.c). A quintic spline takes the rest (report_spline.c).
 *
 * A search finds the rows of alpha that count, and where in ln rho each counts (report_search.c). The integral runs
 * over the cells of these rows (report_integral.c). Priors enter per cell, limits by the part of the cell they leave,
 * so the interpolated thing is always the likelihood alone. */
#include "report_inside.h"

/* ln of the density in ln(parameter) where prior_shape() is 0. */
static selfcal_real_t ln_prior_density(const selfcal_prior_t *prior) {
    const selfcal_real_t hi = (selfcal_real_t)prior->ln_max, width = hi - (selfcal_real_t)prior->ln_min;
    if (prior->law == SELFCAL_UNIFORM) {
        return -hi - r_log(-r_expm1(-width));
    }
    /* ln of 2 reach / sqrt(2 pi) over the part of the normal within SELFCAL_LOG_NORMAL_REACH sd */
    return (prior->law == SELFCAL_LOG_NORMAL ? R(1.1605664) : R(0.0)) - r_log(width);
}

static void finish_hypothesis(selfcal_work_t *work, selfcal_posterior_t *posterior) {
    if (!(work->sum.mass > 0.0)) {
        work->lost = work->lost || !(work->sigma.drop[work->hypothesis] > SIGMA_DEPTH); /* else the priors exclude it */
        return;
    }
    posterior->ln_evidence =
        work->top_profile + (selfcal_wide_t)work->peak + (selfcal_wide_t)work->search.best + log(work->sum.mass);
    for (unsigned p = 0; p < SELFCAL_PARAMETERS; p++) {
        if (has_parameter(hypothesis_of(work)->law, p)) {
            posterior->ln_evidence += (selfcal_wide_t)ln_prior_density(&prior_of(work)[p]);
        }
    }
    selfcal_bias_finish(work, posterior);
    if (work->mask != 0U) {
        work->bank->model->regressors->code->finish(work);
    }
}

/* No law has an evidence, so there is no probability and no bias. */
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
        for (int r = 0; work->coefficients != NULL && h < work->bank->model->hypotheses && r < SELFCAL_REGRESSORS_MAX;
             r++) {
            work->coefficients[h].mean[r] = NAN;
            work->coefficients[h].sd[r] = NAN;
        }
    }
}

/* Without the evidence of a law that the priors allow, no probability is right, nor is it sure that the priors exclude
 * all laws. All estimates are flagged. */
static void flag_all(const selfcal_model_t *model, selfcal_report_t *report) {
    for (uint8_t h = 0; h < model->hypotheses; h++) {
        for (unsigned p = 0; p < SELFCAL_PARAMETERS; p++) {
            if (has_parameter(model->hypothesis[h].law, p)) {
                report->hypothesis[h].parameter[p].flags |= (uint8_t)SELFCAL_OFF_GRID;
            }
        }
    }
}

/* (13), and the bias over all hypotheses. */
static void finish_report(const selfcal_work_t *work, selfcal_report_t *report) {
    const selfcal_model_t *model = work->bank->model;
    selfcal_wide_t best = (selfcal_wide_t)-INFINITY;
    uint8_t likeliest = 0;
    for (uint8_t h = 0; h < model->hypotheses; h++) {
        const selfcal_wide_t joint =
            report->hypothesis[h].ln_evidence + (selfcal_wide_t)model->hypothesis[h].ln_probability;
        if (joint > best) {
            best = joint;
            likeliest = h;
        }
    }
    /* to that law too all the noise that the priors allow is as good as impossible */
    bool lost = work->lost;
    if (work->sigma.drop[likeliest] > SIGMA_DEPTH) {
        lost = lost || (report->hypothesis[likeliest].parameter[SELFCAL_N].flags & (unsigned)SELFCAL_OFF_GRID) != 0U;
        know_nothing(work, report);
    }
    if (lost) {
        flag_all(model, report);
    }
    const selfcal_real_t about = (selfcal_real_t)report->hypothesis[likeliest].bias_mean;
    selfcal_real_t sum = R(0.0), mean = R(0.0), square = R(0.0);
    for (uint8_t h = 0; h < model->hypotheses; h++) {
        selfcal_posterior_t *posterior = &report->hypothesis[h];
        const selfcal_real_t weight = r_exp(
            (selfcal_real_t)(posterior->ln_evidence + (selfcal_wide_t)model->hypothesis[h].ln_probability - best));
        posterior->probability = (float)weight;
        sum += weight;
        /* a law without evidence has no bias, and counts for nothing; if none has any, all is NaN */
        if (weight != R(0.0)) {
            const selfcal_real_t off = (selfcal_real_t)posterior->bias_mean - about,
                                 sd = (selfcal_real_t)posterior->bias_sd;
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

/* --- stages --- */

#define STEP_GATHER 3U /* nodes of one step */

static void go_to(selfcal_work_t *work, int stage) {
    work->stage = (uint8_t)stage;
    work->at = 0;
}

static void go_on(selfcal_work_t *work, bool over) {
    if (over) {
        go_to(work, work->stage + 1);
    }
}

/* Runs the nodes over what the bank has gathered when the report begins; true when the sums are at rest. */
static bool gathered(selfcal_work_t *work) {
    if (selfcal_bank_run(work->bank, STEP_GATHER)) {
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

/* Of a bank that forgets too little may be left. */
static selfcal_status_t step_gather(selfcal_work_t *work, selfcal_report_t *report) {
    if (work->batches == 0U && !gathered(work)) {
        return SELFCAL_BUSY;
    }
    report->n = work->bank->n;
    go_to(work, TRUTH);
    return work->bank->weight + 1.0 < (selfcal_wide_t)(SELFCAL_REPORT_MIN + work->unknowns) ? SELFCAL_TOO_SHORT
                                                                                            : SELFCAL_BUSY;
}

static selfcal_status_t step_truth(selfcal_work_t *work, selfcal_report_t *report) {
    (void)report;
    const uint16_t nodes = work->bank->model->nodes;
    selfcal_node_step_truth(work);
    if (work->at == nodes) {
        go_to(work, work->best_node < nodes ? FIT : SIGMA);
    }
    return SELFCAL_BUSY;
}

/* Without a pair of dimensions nothing is fitted: the nodes of a random walk alone tell too little. */
static selfcal_status_t step_fit(selfcal_work_t *work, selfcal_report_t *report) {
    (void)report;
    selfcal_spectrum_step(work);
    if (work->at > work->bank->model->nodes || !work->truth.pair) {
        selfcal_spectrum_solve(&work->scratch.fit, &work->truth);
        go_to(work, SIGMA);
        work->hypothesis = 0;
    }
    return SELFCAL_BUSY;
}

static selfcal_status_t step_sigma(selfcal_work_t *work, selfcal_report_t *report) {
    (void)report;
    selfcal_sigma_step(work, nodes_of(work));
    go_on(work, true);
    return SELFCAL_BUSY;
}

static selfcal_status_t step_values(selfcal_work_t *work, selfcal_report_t *report) {
    (void)report;
    selfcal_node_step_values(work);
    go_on(work, work->at == nodes_of(work));
    return SELFCAL_BUSY;
}

static selfcal_status_t step_spline(selfcal_work_t *work, selfcal_report_t *report) {
    (void)report;
    if (selfcal_spline_step(work, false, work->stage - SPLINE_PROFILE)) {
        if (work->stage == SPLINE_SIGMA) {
            selfcal_search_begin(work);
        }
        go_on(work, true);
    }
    return SELFCAL_BUSY;
}

static selfcal_status_t step_search(selfcal_work_t *work, selfcal_report_t *report) {
    (void)report;
    if (selfcal_search_step(work)) {
        if (work->search.best > (selfcal_real_t)-INFINITY) {
            selfcal_integral_begin(work);
            go_to(work, SUM);
        } else {
            work->sum.mass = 0.0;
            go_to(work, EVIDENCE);
        }
    }
    return SELFCAL_BUSY;
}

static selfcal_status_t step_sum(selfcal_work_t *work, selfcal_report_t *report) {
    (void)report;
    selfcal_integral_step(work);
    if (work->at == selfcal_cells_in(work, 0)) {
        work->row++;
        go_to(work, work->row < work->sum.rows ? SUM : work->sum.mass > 0.0 ? WEIGHTS : EVIDENCE);
    }
    return SELFCAL_BUSY;
}

static selfcal_status_t step_weights(selfcal_work_t *work, selfcal_report_t *report) {
    (void)report;
    if (selfcal_spline_step(work, true, work->stage - WEIGHTS)) {
        memset(&work->bias, 0, sizeof work->bias);
        go_on(work, true);
    }
    return SELFCAL_BUSY;
}

static selfcal_status_t step_bias(selfcal_work_t *work, selfcal_report_t *report) {
    (void)report;
    selfcal_bias_step(work);
    go_on(work, work->at == nodes_of(work));
    return SELFCAL_BUSY;
}

/* One parameter. */
static selfcal_status_t step_estimates(selfcal_work_t *work, selfcal_report_t *report) {
    const unsigned p = work->at++;
    if (has_parameter(hypothesis_of(work)->law, p)) {
        selfcal_histogram_estimate(work, p, &report->hypothesis[work->hypothesis].parameter[p]);
    }
    go_on(work, work->at == SELFCAL_PARAMETERS);
    return SELFCAL_BUSY;
}

static selfcal_status_t step_evidence(selfcal_work_t *work, selfcal_report_t *report) {
    finish_hypothesis(work, &report->hypothesis[work->hypothesis]);
    work->first_node = (uint16_t)(work->first_node + nodes_of(work));
    work->hypothesis++;
    go_to(work, work->hypothesis < work->bank->model->hypotheses ? SIGMA : WHOLE);
    return SELFCAL_BUSY;
}

static selfcal_status_t step_whole(selfcal_work_t *work, selfcal_report_t *report) {
    finish_report(work, report);
    return SELFCAL_OK;
}

/* By stage. Each step says SELFCAL_BUSY, or the status that ends the report. */
typedef selfcal_status_t (*stage_t)(selfcal_work_t *, selfcal_report_t *);
static const stage_t stages[] = {
    step_gather, step_truth,   step_fit,     step_sigma, step_values,    step_spline,   step_spline, step_search,
    step_sum,    step_weights, step_weights, step_bias,  step_estimates, step_evidence, step_whole,
};

/* --- calls --- */

selfcal_status_t selfcal_report_begin(selfcal_work_t *work, selfcal_t *self, uint8_t axis, selfcal_report_t *report) {
    return selfcal_report_begin_subset(work, self, axis, 0U, NULL, report);
}

selfcal_status_t selfcal_report_begin_subset(selfcal_work_t *work, selfcal_t *self, uint8_t axis, uint8_t mask,
                                             selfcal_coefficients_t coefficients[], selfcal_report_t *report) {
    if (work == NULL || self == NULL || report == NULL || axis >= self->model->axes ||
        ((unsigned)mask & ~(unsigned)selfcal_regressors_mask(self->model, axis)) != 0U) {
        return SELFCAL_BAD_ARGUMENT;
    }
    memset(report, 0, sizeof *report); /* nothing of another axis stays, whatever comes */
    report->axis = axis;
    report->bias_mean = NAN;
    report->bias_sd = NAN;
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
    know_nothing(work, report);
    return SELFCAL_OK;
}

selfcal_status_t selfcal_report_step(selfcal_work_t *work, selfcal_report_t *report) {
    if (work == NULL || report == NULL || work->bank == NULL) {
        return SELFCAL_BAD_ARGUMENT;
    }
    const bool overtaken = work->stage > GATHER && work->batches != work->bank->batches;
    const selfcal_status_t status = overtaken ? SELFCAL_OVERTAKEN : stages[work->stage](work, report);
    work->bank->counters.overtaken += overtaken ? 1U : 0U;
    if (status != SELFCAL_BUSY) {
        work->bank = NULL; /* no report is under way */
    }
    return status;
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
