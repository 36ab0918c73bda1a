/* Expectation: the likelihood that a filter is expected to give data of the best of all nodes.
 *
 * The innovations' variance of a filter over such data has a closed form. It carries the terms of order n of a node's
 * ln-likelihood, so that the splines have to hold the rest alone. */
#include "report_inside.h"

/* In selfcal_real_t, right to some 2e-7 n/2 ln V nats, and in selfcal_wide_t for longer records. */
#define NAME(name) name
#define T selfcal_real_t
#define T_(x) R(x)
#define T_sqrt r_sqrt
#include "report_expected.h"
#undef NAME
#undef T
#undef T_
#undef T_sqrt
#define NAME(name) name##_wide
#define T selfcal_wide_t
#define T_(x) x
#define T_sqrt sqrt
#include "report_expected.h"

selfcal_real_t selfcal_expected_beta(const selfcal_work_t *work, selfcal_real_t ln_alpha) {
    return has_pole(work) ? -r_expm1(-r_exp(ln_alpha) * (selfcal_real_t)work->bank->model->dt_s) : R(0.0);
}

static selfcal_wide_t beta_wide(const selfcal_work_t *work, selfcal_real_t ln_alpha) {
    return has_pole(work) ? -expm1(-exp((selfcal_wide_t)ln_alpha) * (selfcal_wide_t)work->bank->model->dt_s) : 0.0;
}

void selfcal_expected_passed(const selfcal_work_t *work, selfcal_real_t beta, selfcal_real_t passed[SELFCAL_LINES]) {
    const selfcal_truth_t *truth = &work->truth;
    for (unsigned m = 0; m < truth->lines; m++) {
        passed[m] = r_fma(R(1.0) - beta, truth->distance[m], beta * beta) * truth->power[m];
    }
}

/* Variance that the lines add, and behind them an edge and a level for each three. */
static selfcal_real_t fitted(const selfcal_truth_t *truth, const expectation_t *e, const selfcal_real_t passed[]) {
    selfcal_real_t more = R(0.0), ends = R(0.0);
    const selfcal_real_t *end = &truth->power[truth->lines];
    for (unsigned m = 0; m < truth->lines; m++) {
        if (m % 3U == 0U) {
            ends = r_fma(e->edge, end[0], e->level * end[1]);
            end += 2;
        }
        more += (passed[m] + ends) / r_fma(e->psi, truth->distance[m], e->p_sq);
    }
    return more;
}

selfcal_real_t selfcal_expected_noise(const selfcal_work_t *work, selfcal_real_t rho_sq, selfcal_real_t beta) {
    const selfcal_real_t less_1 = work->truth.noise_less_1;
    if (less_1 == R(0.0)) {
        return R(1.0);
    }
    const selfcal_real_t q = rho_sq * (beta > R(0.0) ? beta * (R(2.0) - beta) : R(1.0));
    return averaged_noise(R(1.0) + less_1, selfcal_averaged_lost(q, beta, work->bank->model->block));
}

void selfcal_expected(const selfcal_work_t *work, selfcal_real_t ln_rho, selfcal_real_t ln_alpha, selfcal_real_t beta,
                      const selfcal_real_t passed[], expectation_t *e) {
    const selfcal_truth_t *truth = &work->truth;
    const selfcal_real_t rho_sq = r_exp(R(2.0) * ln_rho);
    if (!has_expectation(work)) {
        memset(e, 0, sizeof *e);
        e->rho_sq = rho_sq;
        return;
    }
    e->rho_sq = rho_sq;
    const selfcal_real_t n = (selfcal_real_t)work->bank->weight;
    expected_t_wide wide = {0.0, 0.0, 0.0, 0.0};
    expected_t real;
    const selfcal_real_t noise = selfcal_expected_noise(work, e->rho_sq, beta);
    if (truth->wide) {
        wide =
            expected_wide(exp(2.0 * (selfcal_wide_t)ln_rho) / (selfcal_wide_t)noise, beta_wide(work, ln_alpha), truth);
        real.v_less_1 = (selfcal_real_t)wide.v_less_1;
        real.gain = (selfcal_real_t)wide.gain;
        real.p = (selfcal_real_t)wide.p;
    } else {
        real = expected(e->rho_sq / noise, beta, truth);
    }
    const selfcal_real_t h = real.gain / real.p;
    e->beta_sq = beta * beta;
    e->phi = R(1.0) - beta;
    e->p_sq = real.p * real.p;
    e->psi = R(1.0) - real.p;
    e->edge = real.gain * h / (R(2.0) - real.p);
    e->level = h * h * beta / r_fma(n, beta, R(2.0) * h);
    e->per_v = R(1.0) / (R(1.0) + real.v_less_1);
    const selfcal_real_t more =
        truth->fitted ? r_fmax(fitted(truth, e, passed), R(-0.99) * (R(1.0) + real.v_less_1)) : R(0.0);
    if (truth->wide) { /* digits below 1e-16 do not matter here, and log1p takes 1 KB of flash */
        e->ln_v = log(1.0 + (wide.v_less_1 + (selfcal_wide_t)more));
        e->ln_sigma = 0.5 * (e->ln_v - log(1.0 + wide.s_less_1));
        e->profile = -0.5 * work->bank->weight * (e->ln_v - truth->ln_v);
    } else {
        const selfcal_real_t ln_v = r_log1p(real.v_less_1 + more);
        e->ln_v = (selfcal_wide_t)ln_v;
        e->ln_sigma = (selfcal_wide_t)(R(0.5) * (ln_v - r_log1p(real.s_less_1)));
        e->profile = (selfcal_wide_t)(R(-0.5) * n * (ln_v - (selfcal_real_t)truth->ln_v));
    }
    if (noise != R(1.0)) {
        e->ln_sigma -= (selfcal_wide_t)(R(0.5) * r_log(noise));
    }
}
