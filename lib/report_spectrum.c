/* Spectrum: what the data's spectrum has beyond the supposed one, fitted to the nodes of all laws.
 *
 * Over data of the spectrum S(omega) the innovations nu = (1 - phi B)/(1 - psi B) y, psi = phi (1 - K), have variance
 *     v = mean over omega of S |1 - phi e^(i omega)|^2 / |1 - psi e^(i omega)|^2.
 * So all that (rho, alpha) sees of the data, of whatever law, is a function of one variable, psi, smoothed along ln(1 -
 * psi) by 1/(1 + e^2x), and the nodes together show it far more closely than their rows and columns seem to. What S has
 * beyond the spectrum supposed is fitted to all nodes as lines, even in ln omega. With zeros for what came before the
 * record and after it, S tells of squares that were never summed: at either end the zeros would have added (the filter
 * being at rest, time running either way)
 *     edge w^2,  edge = (phi - psi)^2/(1 - psi^2),  w = y/(1 - psi B) there,
 * and taking the readings about their generalised least squares mean, not their plain one, takes off another
 *     level (w1 + w2)^2,  level = h^2 (1 - phi)/(n (1 - phi) + 2 h),  h = (phi - psi)/(1 - psi).
 * Both functions of psi are fitted as well, a term for each two lines. Taken into the expectation, all these leave to
 * the splines less than a nat, however long the record. A priori a line's power scatters as a periodogram does, and an
 * end's as large as its spectrum makes it. */
#include "report_inside.h"

#define FIT_PRECISION R(50.0) /* 0.5/0.01: they leave 0.01 nat of a node's ln-likelihood -n/2 ln v */
#define FIT_MOST R(1e6)
/* Less of a node whose filter takes 1/p steps to settle in a record hardly longer, for which the ends are not as
 * above. */
#define UNSETTLED R(200.0)
/* Of more nodes those that hardly settle at all are left out; fewer tell too little without. */
#define UNSETTLED_NODES 150U
/* Less, by nats below the best node, where intervals or samples are missing, the rate has changed, or regressors are
 * in use. The level on both sides of a gap, uneven noise and the coefficients then count as well as psi, by some
 * part in a hundred of those nats. */
#define FAR R(0.033)
/* A float's digits of those nats, over the 0.01. */
#define FAR_EVEN R(2e-4)

/* Half of ln 0.1. */
#define HALF_LN_LEAST R(-1.1512925)
/* Lines are so far apart in ln omega, as far as there are so many. */
#define LINE_STEP R(0.45)

/* Of ln omega from 1/n to 6, which stands for pi (set_lines() below). */
selfcal_real_t selfcal_spectrum_range(selfcal_real_t weight) {
    return R(1.7917595) + r_log(weight);
}

static unsigned unknowns(const selfcal_truth_t *truth) {
    return truth->lines + (truth->lines + 2U) / 3U * 2U;
}

static void set_lines(selfcal_real_t weight, selfcal_truth_t *truth, selfcal_fit_t *fit) {
    memset(fit->triangle, 0, sizeof fit->triangle);
    const selfcal_real_t range = selfcal_spectrum_range(weight);
    truth->lines = 8;
    while (truth->lines < SELFCAL_LINES && range > LINE_STEP * (selfcal_real_t)(truth->lines - 1U)) {
        truth->lines = (uint8_t)(truth->lines + 2U);
    }
    const selfcal_real_t step = range / (selfcal_real_t)(truth->lines - 1U), ratio = r_exp(step);
    selfcal_real_t omega = R(1.0) / weight, *end = &truth->power[truth->lines];
    for (unsigned m = 0; m < truth->lines; m++) {
        const selfcal_real_t omega_sq = omega * omega;
        /* 4 where omega is 6: where a line lies is free */
        truth->distance[m] = omega_sq / r_fma(R(0.22222222), omega_sq, R(1.0));
        const selfcal_real_t spectrum =
            R(1.0) + R(2.0) * truth->variance * truth->rate / r_fma(truth->rate, truth->rate, truth->distance[m]);
        /* of its band in the record's frequencies */
        const selfcal_real_t share = omega * step / (R(3.1415927) * weight);
        truth->power[m] = spectrum * r_sqrt(share);      /* until the fit is solved, a prior deviation */
        if (m % 3U < 2U) {                               /* as of the line in the middle */
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

/* Rotates a row of the least squares, its right side behind it, into the triangle, without square roots: each row of
 * that is what stands in it times the root of its diagonal (Gentleman, J. Inst. Maths Applics 12, 1973). */
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
        selfcal_real_t *with = &row[m + 1U];
        for (unsigned left = count - m; left > 0U; left--, with++, mine++) {
            *with = r_fma(-x, *mine, *with);
            *mine = r_fma(s, *with, *mine);
        }
    }
}

/* Takes the best node for the process that made the data. A drift slower than the record looks like a random walk
 * within it, and the bias takes up its level. So the pole is moved to 3/n at equal steps (for a random walk: the
 * mean square about the mean). */
static void set_truth(const selfcal_work_t *work, selfcal_place_t place, selfcal_truth_t *truth) {
    const selfcal_real_t cut = R(3.0) / (selfcal_real_t)work->bank->weight;
    const bool pole = has_pole(work);
    const selfcal_real_t beta = selfcal_expected_beta(work, place.ln_alpha);
    const selfcal_real_t rho_sq = r_exp(R(2.0) * place.ln_rho);
    const selfcal_real_t variance = rho_sq / selfcal_expected_noise(work, rho_sq, beta);
    const selfcal_real_t rate = pole ? r_exp(place.ln_alpha) * (selfcal_real_t)work->bank->model->dt_s : R(0.0);
    const selfcal_real_t slow = r_sqrt(rate * rate + cut * cut);
    truth->variance = pole ? variance * rate / slow : variance / (R(2.0) * slow);
    truth->rate = -r_expm1(-slow);
}

static void add_row(const selfcal_work_t *work, const expectation_t *e, selfcal_real_t off, selfcal_real_t deficit,
                    selfcal_fit_t *fit) {
    const selfcal_truth_t *truth = &work->truth;
    const selfcal_real_t n = (selfcal_real_t)work->bank->weight;
    const bool even = work->bank->counters.blocks_lost == 0U && work->mask == 0U && truth->noise_less_1 == R(0.0);
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
    rotate_in(fit, unknowns(truth), row);
}

void selfcal_spectrum_solve(const selfcal_fit_t *fit, selfcal_truth_t *truth) {
    const unsigned count = unknowns(truth);
    const selfcal_real_t *mine = fit->triangle + count * (count + 3U) / 2U;
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

/* A node that sees less than a tenth of the variance expected shows that the process is supposed too slow: lines cannot
 * take off so much. Its pole is moved up, its drift at high frequencies kept. So a random walk may stand for a drift
 * that is none, where no other node lies near enough to the drift. */
static bool too_slow(const selfcal_work_t *work, const expectation_t *e, selfcal_real_t scatter) {
    return (selfcal_wide_t)scatter - e->ln_sigma - work->ln_sigma_off < (selfcal_wide_t)HALF_LN_LEAST &&
           work->truth.rate < R(0.5);
}

static void speed_up(const selfcal_work_t *work, selfcal_place_t place, selfcal_real_t scatter, selfcal_truth_t *truth,
                     expectation_t *e) {
    while (too_slow(work, e, scatter)) {
        truth->rate += truth->rate;
        truth->variance *= R(0.5);
        selfcal_expected(work, place.ln_rho, place.ln_alpha, selfcal_expected_beta(work, place.ln_alpha), NULL, e);
    }
}

/* First the best node of all, for the process that made the data; then every node. Its row is its variance over the
 * expected one, less the best node's, by lines and edges of their prior deviations. All begins anew where the process
 * was too slow. */
void selfcal_spectrum_step(selfcal_work_t *work) {
    selfcal_truth_t *truth = &work->truth;
    const uint16_t at = work->at++, k = at == 0U ? work->best_node : (uint16_t)(at - 1U);
    const selfcal_place_t place = place_of(work, k);
    work->hypothesis = place.hypothesis;
    if (!has_expectation(work)) {
        return;
    }
    if (!(truth->rate > R(0.0))) {
        set_truth(work, place, truth);
    }
    const selfcal_real_t scatter = work->scratch.fit.scatter[k];
    expectation_t e;
    selfcal_expected(work, place.ln_rho, place.ln_alpha, selfcal_expected_beta(work, place.ln_alpha), NULL, &e);
    /* What the priors of bias and coefficients add is no function of psi. */
    const selfcal_wide_t off = (selfcal_wide_t)scatter - e.ln_sigma;
    if (at == 0U) {
        work->ln_sigma_off = off;
        truth->ln_v = e.ln_v; /* any that is near will do */
        truth->wide = (selfcal_real_t)work->bank->weight * (selfcal_real_t)e.ln_v > WIDE_BEYOND;
        set_lines((selfcal_real_t)work->bank->weight, truth, &work->scratch.fit);
    } else if (too_slow(work, &e, scatter)) {
        speed_up(work, place, scatter, truth, &e);
        work->at = 0;
    } else {
        const selfcal_real_t deficit = work->field[0][work->best_node] - work->field[0][k];
        add_row(work, &e, (selfcal_real_t)(off - work->ln_sigma_off), deficit, &work->scratch.fit);
    }
}
