/* The bias after the report: where it goes under each law, and how the doubt about it grows. */
#include "bank_inside.h"

typedef struct {
    selfcal_real_t mean, var;
} moments_t;

static moments_t predict_law(const selfcal_model_t *model, const selfcal_law_t *law,
                             const selfcal_posterior_t *posterior, selfcal_real_t elapsed_s) {
    moments_t now = {(selfcal_real_t)posterior->bias_mean,
                     (selfcal_real_t)posterior->bias_sd * (selfcal_real_t)posterior->bias_sd};
    for (uint8_t a = 0; a < law->terms; a++) {
        if (law->term[a].kind == SELFCAL_WALK) {
            const selfcal_real_t deviation = (selfcal_real_t)law->term[a].deviation,
                                 rate = deviation * deviation * elapsed_s;
            const selfcal_real_t mean = (selfcal_real_t)posterior->parameter[SELFCAL_K].mean;
            const selfcal_real_t sd = (selfcal_real_t)posterior->parameter[SELFCAL_K].sd;
            now.var = r_fma(r_fma(mean, mean, sd * sd), rate, now.var);
        }
    }
    if (has_decay(law)) {
        selfcal_real_t fall = R(0.0), growth = R(0.0);
        for (unsigned j = 0; j < SELFCAL_ALPHA_MAX; j++) {
            const selfcal_decay_t *decay = &posterior->decay[j];
            selfcal_real_t psi[SELFCAL_TERMS_MAX + 1U] = {R(0.0)}; /* an oscillation writes two */
            for (unsigned a = 0; a < terms_of(law); a++) {
                const selfcal_term_t *term = &law->term[a]; /* a walk's bandwidth is 0 */
                const selfcal_real_t alpha = term->stated ? R(1.0) : (selfcal_real_t)decay->alpha;
                if (term->kind == SELFCAL_OSCILLATION) { /* and of the state behind it */
                    model->states->fall(term, elapsed_s, &psi[a]);
                } else if (term->kind != SELFCAL_DAMPING) {
                    psi[a] = -r_expm1(-(selfcal_real_t)term->bandwidth * alpha * elapsed_s);
                }
                fall = r_fma(psi[a], (selfcal_real_t)decay->mean[a], fall);
                selfcal_real_t with = (selfcal_real_t)decay->var[a];
                for (unsigned b = 0; b <= a; b++) {
                    const selfcal_real_t both = (selfcal_real_t)decay->var_sq[term_pair(a, b)];
                    with = r_fma(b < a ? R(2.0) * psi[b] : psi[b], both, with);
                }
                growth = r_fma(psi[a], with, growth);
            }
        }
        now.mean -= fall;
        now.var = r_fmax(now.var + r_fma(-fall, fall, growth), R(0.0));
    }
    return now;
}

selfcal_status_t selfcal_predict(const selfcal_report_t *report, const selfcal_model_t *model, float elapsed_s,
                                 float *bias, float *sd) {
    if (report == NULL || model == NULL || bias == NULL || sd == NULL || model->hypotheses > SELFCAL_HYPOTHESES_MAX ||
        !(elapsed_s >= 0.0F) || !isfinite(elapsed_s)) {
        return SELFCAL_BAD_ARGUMENT;
    }
    const selfcal_real_t now = (selfcal_real_t)report->bias_mean; /* taken off: gravity costs no digits */
    moments_t law[SELFCAL_HYPOTHESES_MAX] = {{R(0.0), R(0.0)}};
    selfcal_real_t mean = R(0.0), var = R(0.0);
    for (uint8_t h = 0; h < model->hypotheses; h++) {
        const selfcal_real_t p = (selfcal_real_t)report->hypothesis[h].probability;
        if (p != R(0.0)) { /* else its moments may be NaN */
            law[h] = predict_law(model, model->hypothesis[h].law, &report->hypothesis[h], (selfcal_real_t)elapsed_s);
            law[h].mean -= now;
            mean = r_fma(p, law[h].mean, mean);
        }
    }
    for (uint8_t h = 0; h < model->hypotheses; h++) {
        const selfcal_real_t p = (selfcal_real_t)report->hypothesis[h].probability;
        if (p != R(0.0)) {
            const selfcal_real_t off = law[h].mean - mean;
            var = r_fma(p, r_fma(off, off, law[h].var), var);
        }
    }
    *bias = (float)(now + mean);
    *sd = (float)r_sqrt(var);
    return SELFCAL_OK;
}

selfcal_reason_t selfcal_reason(const selfcal_model_t *model, const selfcal_report_t *report,
                                selfcal_adequacy_state_t state) {
    if (!isfinite(report->bias_mean)) {
        return SELFCAL_REASON_OUTSIDE_PRIORS;
    }
    if (state == SELFCAL_INADEQUATE) {
        return SELFCAL_REASON_INADEQUATE;
    }
    float identified = 0.0F;
    for (uint8_t h = 0; h < model->hypotheses; h++) {
        const selfcal_law_t *law = model->hypothesis[h].law;
        const selfcal_estimate_t *parameter = report->hypothesis[h].parameter;
        const unsigned flags = parameter[SELFCAL_N].flags,
                       of_drift = has_drift(law) ? parameter[drift_parameter(law)].flags : flags;
        identified += (flags & of_drift & SELFCAL_IDENTIFIED) != 0U ? report->hypothesis[h].probability : 0.0F;
    }
    return identified >= 0.5F ? SELFCAL_REASON_NONE : SELFCAL_REASON_NOT_IDENTIFIED;
}
