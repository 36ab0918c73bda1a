/* A coarse bank that tells whether the bias follows a channel: random walks from none to a fast one, each with and
 * without a column of a channel. Unlike the filters of adequacy.c it takes no law of a report, which an effect has
 * already made to drift.
 *
 * Filter f has the level as its state, with the walk rho_f sigma_v an interval. It runs from the first bank sample on,
 * over the readings (innovation nu) and over each column (innovation w), with s as in bank.c. With
 *     C = sum nu^2 / s,   D = sum ln s,   A = sum w^2 / s,   B = sum w nu / s
 * and sigma_v at its likeliest, -2 ln p = n ln C + D without a column, n ln(C - B^2/A) + D with it. The gain of a
 * column is the likeliest filter with it over the likeliest without it. So a walk and the column compete for the
 * readings. K, D and A are the same for all axes. The score is sqrt(2 gain), with the sign of B.
 *
 * Each rho is half of the one before: at twice the true one, or half of it, what a slow column gains by chance grows by
 * a half. Columns: the time; each channel; the temperature behind a low pass; exp(-t / tau) of a warm-up.
 * The bank begins anew after COARSE_MOST bank samples: the least rho and the digits of a float do for no more. What it
 * said then stands beside what it says now. */
#include "bank_inside.h"

#define COARSE_MOST 16384U
#define FASTEST R(4.0) /* rho of the first filter; of the last one 0 */
#define WARM_UP_S 300.0F
#define LAG_S 120.0F

/* The column after one more interval, of `count` since the last bank sample. */
static void make_columns(selfcal_coarse_t *self, const selfcal_real_t channel[], selfcal_real_t count, float dt_s,
                         selfcal_real_t column[SELFCAL_COARSE_COLUMNS]) {
    const bool first = self->n == 0U;
    self->elapsed = first ? R(0.0) : self->elapsed + count;
    column[0] = self->elapsed;
    for (size_t i = 0; i < SELFCAL_ADEQUACY_CHANNELS; i++) {
        self->first[i] = first ? channel[i] : self->first[i];
        column[1U + i] = channel[i] - self->first[i];
    }
    const selfcal_real_t gain = -r_expm1(-count * (selfcal_real_t)(dt_s / LAG_S));
    self->lagged = first ? R(0.0) : r_fma(gain, column[1] - self->lagged, self->lagged);
    column[3] = self->lagged;
    column[4] = r_exp(-self->elapsed * (selfcal_real_t)(dt_s / WARM_UP_S));
}

void selfcal_coarse_take(selfcal_coarse_t *self, const selfcal_batch_t *batch, uint32_t at,
                         const selfcal_real_t channel[], const selfcal_model_t *model) {
    selfcal_real_t column[SELFCAL_COARSE_COLUMNS];
    const selfcal_real_t count = (selfcal_real_t)batch->gap[at] + R(1.0);
    if (self->n == COARSE_MOST) {
        selfcal_coarse_restart(self);
    }
    make_columns(self, channel, count, model->dt_s, column);
    selfcal_real_t rho = FASTEST;
    for (size_t f = 0; f < SELFCAL_COARSE_FILTERS; f++) {
        selfcal_coarse_filter_t *filter = &self->filter[f];
        if (self->n == 0U) {
            filter->variance = batch->r[at];
            memcpy(filter->column, column, sizeof column);
            for (uint8_t axis = 0; axis < model->axes; axis++) {
                self->cell[axis][f].level = batch->y[axis][at];
            }
            continue;
        }
        rho = f + 1U < SELFCAL_COARSE_FILTERS ? rho : R(0.0);
        const selfcal_real_t p = r_fma(rho * rho, count, filter->variance), s = p + batch->r[at], gain = p / s;
        selfcal_real_t weighted[SELFCAL_COARSE_COLUMNS];
        filter->variance = gain * batch->r[at];
        filter->ln_s += r_log(s);
        for (size_t k = 0; k < SELFCAL_COARSE_COLUMNS; k++) {
            const selfcal_real_t w = column[k] - filter->column[k];
            filter->column[k] = r_fma(gain, w, filter->column[k]);
            weighted[k] = w / s;
            filter->weight[k] = r_fma(w, weighted[k], filter->weight[k]);
        }
        for (uint8_t axis = 0; axis < model->axes; axis++) {
            selfcal_coarse_cell_t *cell = &self->cell[axis][f];
            const selfcal_real_t nu = batch->y[axis][at] - cell->level;
            cell->level = r_fma(gain, nu, cell->level);
            cell->square = r_fma(nu, nu / s, cell->square);
            for (size_t k = 0; k < SELFCAL_COARSE_COLUMNS; k++) {
                cell->along[k] = r_fma(nu, weighted[k], cell->along[k]);
            }
        }
        rho *= R(0.5);
    }
    self->n++;
}

/* ln(1 - B^2 / (A C)), of the part of C that a column leaves, to the last digits of a float: `lost` is what rounding
 * takes from B / A. */
static selfcal_real_t ln_left(selfcal_real_t along, selfcal_real_t weight, selfcal_real_t square) {
    const selfcal_real_t ratio = along / weight, lost = r_fma_exact(-ratio, weight, along) / weight;
    const selfcal_real_t left = r_fma_exact(-ratio, along, square) - lost * along;
    return left < R(0.5) * square ? r_log(r_fmax(left / square, R(1e-12))) : r_log1p(-ratio * along / square);
}

/* Of one column, that filter's too which makes most of it. `over`: -2 ln p of each filter without a column, over the
 * least of them. */
static selfcal_real_t score_of(const selfcal_coarse_t *self, uint8_t axis, size_t k, const selfcal_real_t over[]) {
    selfcal_real_t most = R(0.0), sign = R(0.0);
    for (size_t f = 0; f < SELFCAL_COARSE_FILTERS; f++) {
        const selfcal_coarse_cell_t *cell = &self->cell[axis][f];
        const selfcal_real_t along = cell->along[k], weight = self->filter[f].weight[k];
        if (!(weight > R(0.0))) {
            continue;
        }
        const selfcal_real_t gain = -(selfcal_real_t)(self->n - 1U) * ln_left(along, weight, cell->square) - over[f];
        if (gain > most) {
            most = gain;
            sign = along > R(0.0) ? R(1.0) : R(-1.0);
        }
    }
    return sign * r_sqrt(most);
}

/* -2 ln p of each filter without a column, but for a constant; the likeliest filter. */
static size_t costs_of(const selfcal_coarse_t *self, uint8_t axis, selfcal_wide_t cost[SELFCAL_COARSE_FILTERS]) {
    size_t likeliest = 0;
    for (size_t f = 0; f < SELFCAL_COARSE_FILTERS; f++) {
        const selfcal_wide_t ln_square = selfcal_bank_ln((selfcal_wide_t)self->cell[axis][f].square);
        cost[f] = (selfcal_wide_t)(self->n - 1U) * ln_square + (selfcal_wide_t)self->filter[f].ln_s;
        likeliest = cost[f] < cost[likeliest] ? f : likeliest;
    }
    return likeliest;
}

selfcal_real_t selfcal_coarse_sigma(const selfcal_coarse_t *self, uint8_t axis) {
    if (!(self->cell[axis][0].square > R(0.0))) {
        return R(0.0);
    }
    selfcal_wide_t cost[SELFCAL_COARSE_FILTERS];
    const size_t likeliest = costs_of(self, axis, cost);
    return r_sqrt(self->cell[axis][likeliest].square / (selfcal_real_t)(self->n - 1U));
}

selfcal_real_t selfcal_coarse_score(const selfcal_coarse_t *self, uint8_t axis, selfcal_suspect_t *suspect) {
    static const selfcal_suspect_t of[SELFCAL_COARSE_COLUMNS] = {
        SELFCAL_SUSPECT_RAMP,        SELFCAL_SUSPECT_TEMPERATURE, SELFCAL_SUSPECT_SUPPLY,
        SELFCAL_SUSPECT_TEMPERATURE, SELFCAL_SUSPECT_TURN_ON,
    };
    selfcal_real_t most = self->before[axis].score;
    *suspect = self->before[axis].suspect;
    if (self->n < SELFCAL_EPOCH_MIN || !(self->cell[axis][0].square > R(0.0))) {
        return most;
    }
    selfcal_wide_t cost[SELFCAL_COARSE_FILTERS];
    selfcal_real_t over[SELFCAL_COARSE_FILTERS];
    const size_t likeliest = costs_of(self, axis, cost);
    for (size_t f = 0; f < SELFCAL_COARSE_FILTERS; f++) {
        over[f] = (selfcal_real_t)(cost[f] - cost[likeliest]);
    }
    for (size_t k = 0; k < SELFCAL_COARSE_COLUMNS; k++) {
        const selfcal_real_t score = score_of(self, axis, k, over);
        if (r_fabs(score) > r_fabs(most)) {
            most = score;
            *suspect = of[k];
        }
    }
    return most;
}

void selfcal_coarse_restart(selfcal_coarse_t *self) {
    selfcal_coarse_told_t told[SELFCAL_AXES_MAX] = {{R(0.0), SELFCAL_SUSPECT_NONE}};
    for (uint8_t axis = 0; axis < SELFCAL_AXES_MAX; axis++) {
        told[axis].score = selfcal_coarse_score(self, axis, &told[axis].suspect);
    }
    memset(self, 0, sizeof *self);
    memcpy(self->before, told, sizeof told);
}
