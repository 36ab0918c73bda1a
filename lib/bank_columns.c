/* Regressors beside the constant, and the normal equations of a node.
 *
 * A reading is y_i = x0 + c' z_i + x_i + v_i with known columns z (time, temperature, a step, ...) and coefficients
 * c ~ N(m, diag(sd^2)). As the constant does, every column goes through the node's zero-bias filter; with u = (u_0,
 * u_1, ...) the innovations of "1" and of the columns, the sums A = sum u u'/s, B = sum u nu/s and C = sum nu^2/s give
 * the likelihood of every subset of columns (generalised least squares; de Jong, Biometrika 78 (1991) 143-151). A
 * belongs to the node, B to a node and an axis. Columns are taken about their first bank sample, as the readings are.
 *
 * What a regressor explains may be a thousand times the noise, and C - B'A^-1 B is what is left of it: all columns, "1"
 * among them, and the readings must go through one and the same linear filter. Its gains may be rounded, for they are
 * the same for all; the states carry twice the digits of selfcal_real_t, and so do the sums.
 *
 * All of it lies behind SELFCAL_SIZE() in the caller's memory; a model without regressors has none. */
#include "bank_inside.h"

/* A pivot below this part of its diagonal: the column is one of the others in all that was seen (or was constant).
 * Nothing is lost by taking it so: what the estimate then leaves is carried along (`rest`). */
#define COLLINEAR 1e-9

static size_t columns_of(const selfcal_t *self) {
    return self->model->regressors->count;
}

/* --- bank --- */

static bool valid_regressors(const selfcal_model_t *model) {
    const selfcal_regressors_t *regressors = model->regressors;
    if (regressors->count == 0U || regressors->count > SELFCAL_REGRESSORS_MAX || regressors->reference == NULL ||
        regressors->coefficient_sd == NULL) {
        return false;
    }
    for (size_t k = 0; k < regressors->count; k++) {
        if (!isfinite(regressors->reference[k])) {
            return false;
        }
    }
    for (size_t k = 0; k < (size_t)model->axes * regressors->count; k++) {
        if (!(regressors->coefficient_sd[k] >= 0.0F) || !isfinite(regressors->coefficient_sd[k])) {
            return false;
        }
        if (regressors->coefficient_mean != NULL && !isfinite(regressors->coefficient_mean[k])) {
            return false;
        }
    }
    return true;
}

/* `memory` follows the bank's own; what SELFCAL_REGRESSORS_SIZE() adds includes the room to align it. */
static void init_columns(selfcal_t *self, unsigned char *memory) {
    const size_t p = columns_of(self), nodes = self->model->nodes, axes = axes_in(self);
    memory += (8U - ((uintptr_t)memory & 7U)) & 7U;
    self->columns = (selfcal_columns_t *)(void *)memory;
    self->columns->column = (selfcal_column_t *)(void *)(self->columns + 1);
    self->columns->a = (selfcal_sum_t *)(void *)(self->columns->column + p);
    self->columns->b = self->columns->a + nodes * SELFCAL_REGRESSORS_ROWS(p + 1U);
    self->columns->x = self->columns->b + nodes * axes * p;
    self->columns->reading = (selfcal_reading_t *)(void *)(self->columns->x + nodes * (p + 1U));
}

static bool columns_sound(const selfcal_t *self) {
    const size_t p = columns_of(self), nodes = self->model->nodes, cells = nodes * self->model->axes;
    const selfcal_columns_t *columns = self->columns;
    const selfcal_sum_t *end = columns->x + nodes * (p + 1U);
    if (columns->column != (const void *)(columns + 1) || columns->a != (const void *)(columns->column + p) ||
        columns->b != columns->a + nodes * SELFCAL_REGRESSORS_ROWS(p + 1U) || columns->x != columns->b + cells * p) {
        return false;
    }
    if (columns->reading != (const void *)end || !selfcal_kernel_readings_sound(self)) {
        return false;
    }
    for (const selfcal_sum_t *sum = columns->a; sum < end; sum++) {
        if (!finite_sum(*sum)) {
            return false;
        }
    }
    for (size_t k = 0; k < p; k++) {
        const selfcal_column_t *column = &columns->column[k];
        if (!isfinite(column->last) || !isfinite(column->origin) || !isfinite(column->first) ||
            !isfinite(column->offset) || !isfinite(column->sum)) {
            return false;
        }
    }
    return true;
}

static bool usable_values(selfcal_t *self, const float values[]) {
    for (size_t k = 0; k < columns_of(self); k++) {
        if (!(fabsf(values[k]) < SELFCAL_SAMPLE_MAX)) { /* the bound of intake.c holds for A as well */
            self->counters.regressor_not_finite++;
            return false;
        }
    }
    return true;
}

static void add_values(selfcal_t *self, const float values[]) {
    for (size_t k = 0; k < columns_of(self); k++) {
        selfcal_column_t *column = &self->columns->column[k];
        if (self->used == 0U) {
            column->first = values[k];
            column->sum = R(0.0);
        }
        column->sum += (selfcal_real_t)values[k] - (selfcal_real_t)column->first;
    }
}

static void close_columns(selfcal_t *self) {
    const bool first = selfcal_count(self) == 0U;
    for (size_t k = 0; k < columns_of(self); k++) {
        selfcal_column_t *column = &self->columns->column[k];
        const selfcal_real_t mean = column->sum / (selfcal_real_t)self->used;
        if (first) {
            column->origin = column->first;
            column->offset = mean;
        }
        column->z[self->gathering][self->batch[self->gathering].count] =
            ((selfcal_real_t)column->first - (selfcal_real_t)column->origin) + (mean - column->offset);
    }
}

static void hand_over_columns(selfcal_t *self) {
    const uint8_t handed_over = (uint8_t)(1U - self->gathering);
    const uint32_t count = waiting(self)->count;
    for (size_t k = 0; k < columns_of(self) && count > 0U; k++) {
        self->columns->column[k].last = self->columns->column[k].z[handed_over][count - 1U];
    }
}

/* The node's zero-bias filter over one series, `y` [SELFCAL_BATCH] or all 1 if NULL. Returns the next prediction. What
 * is rounded off each step is a part of its change, and the change is small where the filter is slow. */
static selfcal_sum_t filter_column(const selfcal_t *self, size_t j, const gains_t *gains, const selfcal_real_t *y,
                                   selfcal_sum_t x, innovations_t *out) {
    const selfcal_real_t minus_beta = -self->node[j].beta;
    const uint32_t from = gains->span.from, count = gains->span.to - gains->span.from;
    for (uint32_t i = 0; i < count; i++) {
        const selfcal_real_t value = y != NULL ? y[from + i] : R(1.0), inv_s = gains->inv_s[from + i];
        const selfcal_real_t nu = (value - x.hi) - x.lo;
        out->nu[i] = nu;
        out->weighted[i] = nu * inv_s;
        out->low[i] = r_fma_exact(nu, inv_s, -out->weighted[i]);
        x = two_sum(x.hi, r_fma_exact(gains->g[from + i], nu, minus_beta * value) + x.lo);
    }
    return x;
}

/* As selfcal_kernel_run() for a model without regressors. */
static void run_columns(selfcal_t *self, size_t j, const gains_t *gains) {
    const size_t p = columns_of(self), axes = self->model->axes;
    innovations_t column[1 + SELFCAL_REGRESSORS_MAX], reading;
    selfcal_sum_t *a = &self->columns->a[j * SELFCAL_REGRESSORS_ROWS(p + 1U)];
    for (size_t k = 0; k <= p; k++) {
        selfcal_sum_t *x = &self->columns->x[j * (p + 1U) + k];
        *x = filter_column(self, j, gains, k == 0U ? NULL : self->columns->column[k - 1U].z[1U - self->gathering], *x,
                           &column[k]);
        for (size_t l = 0; l <= k; l++) {
            selfcal_add_products(a++, gains, &column[l], &column[k]);
        }
    }
    for (size_t at = j * axes; at < (j + 1U) * axes; at++) {
        const reading_sums_t sums = selfcal_kernel_reading(self, at);
        selfcal_kernel_set_reading_drift(self, at,
                                         filter_column(self, j, gains, waiting(self)->y[at - j * axes],
                                                       selfcal_kernel_reading_drift(self, at), &reading));
        selfcal_add_products(sums.c, gains, &reading, &reading);
        selfcal_add_products(sums.b, gains, &column[0], &reading);
        for (size_t k = 0; k < p; k++) {
            selfcal_add_products(&self->columns->b[at * p + k], gains, &column[k + 1U], &reading);
        }
    }
}

static void gap_columns(selfcal_t *self, size_t j, selfcal_wide_t less) {
    const size_t rows = columns_of(self) + 1U, axes = self->model->axes;
    for (size_t k = j * rows; k < (j + 1U) * rows; k++) {
        self->columns->x[k] = make_sum(sum_value(self->columns->x[k]) * (1.0 - less));
    }
    for (size_t k = j * axes; k < (j + 1U) * axes; k++) {
        selfcal_kernel_set_reading_drift(self, k,
                                         make_sum(sum_value(selfcal_kernel_reading_drift(self, k)) * (1.0 - less)));
    }
}

/* --- normal equations --- */

#define UNKNOWNS_MAX (1 + SELFCAL_REGRESSORS_MAX)

/* Least squares at one node, relative to sigma_v, over the level (x0 at the first sample of every regressor, less the
 * offset) and the coefficients of a subset of the regressors. Matrices are symmetric, the lower half is held. */
typedef struct {
    selfcal_node_view_t node;
    uint8_t order;                                                 /* unknowns: the level and the coefficients */
    uint8_t regressor[UNKNOWNS_MAX];                               /* of each, from 1 on */
    selfcal_wide_t a[UNKNOWNS_MAX][UNKNOWNS_MAX], b[UNKNOWNS_MAX]; /* sums A and B */
    selfcal_wide_t sd[UNKNOWNS_MAX];                               /* of the priors of x0 and of the coefficients */
    selfcal_wide_t prior_mean[UNKNOWNS_MAX];                       /* of the coefficients; 0 of x0 */
    /* offset from the prior; first values of the regressors less their references */
    selfcal_wide_t first[UNKNOWNS_MAX];
    selfcal_wide_t last[UNKNOWNS_MAX]; /* value at the last interval: 1, and the columns about their first */
    selfcal_wide_t left[UNKNOWNS_MAX]; /* change of x0 + c' z + drift there per unit of each */
    selfcal_wide_t lost[UNKNOWNS_MAX][SELFCAL_TERMS_MAX]; /* what the drift, each term of it, takes of that */
    selfcal_wide_t drift[SELFCAL_TERMS_MAX];              /* of the readings at the estimate 0 */
    selfcal_wide_t estimate[UNKNOWNS_MAX];                /* A^-1 B; 0 for what cannot be told from those before it */
    selfcal_wide_t rest[UNKNOWNS_MAX];                    /* B - A estimate */
    selfcal_wide_t residual; /* C - B' A^-1 B, that is (C - 2 B' t + t' A t) at the estimate t */
} normal_t;

/* What the priors add at sigma_v^2 = variance:
 *   -2 ln p(Y | node, sigma_v) = n ln(2 pi sigma_v^2) + D + residual / sigma_v^2 + ln_det + miss. */
typedef struct {
    selfcal_wide_t ln_det; /* ln det(1 + P0 A / sigma_v^2), P0 the covariance of all priors */
    /* square of what the estimate misses the priors' mean by, over the sum of their covariances */
    selfcal_wide_t miss;
    /* of samples that went into the unknowns: tr U, U = (A/sigma_v^2 + P0^-1)^-1 A/sigma_v^2, 0 to order */
    selfcal_wide_t share;
    selfcal_wide_t noise; /* part of `miss` that goes as 1/sigma_v^2: what the priors leave unexplained */
    /* tr U^2 + 2 h' U h, h what `noise` is the square of: what the curvature in ln sigma_v lacks of n */
    selfcal_wide_t bent;
    selfcal_wide_t mean[UNKNOWNS_MAX], var[UNKNOWNS_MAX]; /* of the unknowns, given node and sigma_v */
    struct {                                              /* selfcal_now_t, wide: columns that go together cancel */
        selfcal_wide_t mean, drift[SELFCAL_TERMS_MAX], own[1 + SELFCAL_TERMS_MAX + SELFCAL_TERM_PAIRS];
    } now;
} fit_t;

/* a = L D L' of the first `order` rows; D on the diagonal, L (unit) below it. A pivot at or below `least` of its
 * diagonal becomes 0: solve() leaves that unknown at 0. */
static void factorise(selfcal_wide_t a[UNKNOWNS_MAX][UNKNOWNS_MAX], uint8_t order, selfcal_wide_t least) {
    for (uint8_t i = 0; i < order; i++) {
        const selfcal_wide_t diagonal = a[i][i];
        for (uint8_t j = 0; j < i; j++) {
            for (uint8_t k = 0; k < j; k++) {
                a[i][j] -= a[i][k] * a[j][k]; /* a[i][k]: L times D so far */
            }
        }
        for (uint8_t j = 0; j < i; j++) {
            const selfcal_wide_t with_pivot = a[i][j];
            a[i][j] = a[j][j] > 0.0 ? with_pivot / a[j][j] : 0.0;
            a[i][i] -= a[i][j] * with_pivot;
        }
        if (!(a[i][i] > least * diagonal)) {
            a[i][i] = 0.0;
        }
    }
}

static void solve(selfcal_wide_t a[UNKNOWNS_MAX][UNKNOWNS_MAX], uint8_t order, selfcal_wide_t x[]) {
    for (uint8_t i = 0; i < order; i++) {
        for (uint8_t j = 0; j < i; j++) {
            x[i] -= a[i][j] * x[j];
        }
    }
    for (uint8_t i = order; i-- > 0U;) {
        x[i] = a[i][i] > 0.0 ? x[i] / a[i][i] : 0.0;
        for (uint8_t j = (uint8_t)(i + 1U); j < order; j++) {
            x[i] -= a[i][i] > 0.0 ? a[j][i] * x[j] : 0.0;
        }
    }
}

uint8_t selfcal_regressors_mask(const selfcal_model_t *model, uint8_t axis) {
    uint8_t mask = 0;
    for (size_t k = 0; model->regressors != NULL && k < model->regressors->count; k++) {
        const bool has = model->regressors->coefficient_sd[(size_t)axis * model->regressors->count + k] > 0.0F;
        mask = (uint8_t)(mask | (has ? 1U << k : 0U));
    }
    return mask;
}

/* From the sums as they are; axis, node and mask fit the bank. */
static void make_normal(const selfcal_t *self, uint8_t axis, uint16_t index, uint8_t mask, normal_t *normal) {
    memset(normal, 0, sizeof *normal);
    selfcal_bank_view(self, axis, index, &normal->node);
    normal->order = 1;
    normal->a[0][0] = normal->node.a;
    normal->b[0] = normal->node.b;
    normal->last[0] = 1.0;
    normal->left[0] = normal->node.bias_left;
    normal->lost[0][0] = 1.0 - normal->left[0];
    normal->drift[0] = normal->node.drift;
    normal->sd[0] = (selfcal_wide_t)self->prior_sd[axis];
    normal->first[0] = selfcal_bank_from_prior(self, axis);
    const selfcal_wide_t per_prediction = selfcal_bank_per_prediction(self, index);
    const size_t p = mask != 0U ? columns_of(self) : 0U;
    const selfcal_states_code_t *states = is_state_node(self, &self->node[index]) ? self->model->states : NULL;
    if (states != NULL) {
        states->drift(self, index, 0, normal->lost[0]);
        states->drift(self, index, series_of_readings(self, axis), normal->drift);
    }
    const selfcal_sum_t *a = p > 0U ? &self->columns->a[index * SELFCAL_REGRESSORS_ROWS(p + 1U)] : NULL;
    if (p > 0U) {
        normal->a[0][0] = sum_value(a[0]); /* the same as node.a, to more digits */
    }
    for (size_t k = 0; k < p; k++) {
        if (((unsigned)mask >> k & 1U) == 0U) {
            continue;
        }
        const uint8_t row = normal->order++;
        const selfcal_column_t *column = &self->columns->column[k];
        normal->regressor[row] = (uint8_t)k;
        for (uint8_t l = 0; l <= row; l++) {
            const size_t of = l == 0U ? 0U : normal->regressor[l] + 1U;
            normal->a[row][l] = sum_value(a[SELFCAL_REGRESSORS_ROWS(k + 1U) + of]);
        }
        const size_t at = cell_of(self, index, axis);
        normal->b[row] = sum_value(self->columns->b[at * p + k]);
        normal->last[row] = (selfcal_wide_t)column->last;
        normal->lost[row][0] = sum_value(self->columns->x[index * (p + 1U) + k + 1U]) * per_prediction;
        if (states != NULL) {
            states->drift(self, index, k + 1U, normal->lost[row]);
        }
        normal->left[row] = normal->last[row];
        for (size_t t = 0; t < SELFCAL_TERMS_MAX; t++) {
            normal->left[row] -= normal->lost[row][t];
        }
        normal->sd[row] = (selfcal_wide_t)self->model->regressors->coefficient_sd[axis * p + k];
        normal->prior_mean[row] = self->model->regressors->coefficient_mean == NULL
                                      ? 0.0
                                      : (selfcal_wide_t)self->model->regressors->coefficient_mean[axis * p + k];
        normal->first[row] = (selfcal_wide_t)column->origin + (selfcal_wide_t)column->offset -
                             (selfcal_wide_t)self->model->regressors->reference[k];
    }
    selfcal_wide_t factor[UNKNOWNS_MAX][UNKNOWNS_MAX];
    memcpy(factor, normal->a, sizeof factor);
    factorise(factor, normal->order, COLLINEAR);
    memcpy(normal->estimate, normal->b, sizeof normal->estimate);
    solve(factor, normal->order, normal->estimate);
    normal->residual = normal->node.c;
    for (uint8_t i = 0; i < normal->order; i++) {
        normal->rest[i] = normal->b[i];
        for (uint8_t j = 0; j < normal->order; j++) {
            normal->rest[i] -= (j <= i ? normal->a[i][j] : normal->a[j][i]) * normal->estimate[j];
        }
        normal->residual -= normal->estimate[i] * (normal->b[i] + normal->rest[i]);
    }
}

/* Sums over the columns of G^-1, from its factors. */
static void inverse_sums(const normal_t *normal, selfcal_wide_t variance, selfcal_wide_t g[UNKNOWNS_MAX][UNKNOWNS_MAX],
                         const selfcal_wide_t pulled[], fit_t *fit) {
    const uint8_t order = normal->order;
    selfcal_wide_t taken[UNKNOWNS_MAX][UNKNOWNS_MAX];
    memset(fit->now.own, 0, sizeof fit->now.own);
    fit->share = fit->bent = 0.0;
    for (uint8_t i = 0; i < order; i++) {
        selfcal_wide_t column[UNKNOWNS_MAX] = {0.0};
        column[i] = 1.0;
        solve(g, order, column);
        fit->var[i] = column[i];
        for (uint8_t j = 0; j < order; j++) {
            fit->now.own[0] += normal->left[i] * column[j] * normal->left[j] / variance;
            for (size_t t = 0; t < SELFCAL_TERMS_MAX; t++) {
                fit->now.own[1 + t] += normal->left[i] * column[j] * normal->lost[j][t] / variance;
                for (size_t u = 0; u <= t; u++) { /* all i and j: G^-1 is symmetric */
                    fit->now.own[1 + SELFCAL_TERMS_MAX + term_pair(t, u)] +=
                        normal->lost[i][t] * column[j] * normal->lost[j][u] / variance;
                }
            }
            fit->bent += 2.0 * pulled[i] * column[j] * pulled[j];
            taken[i][j] = 0.0;
            for (uint8_t k = 0; k < order; k++) {
                taken[i][j] += column[k] * (j <= k ? normal->a[k][j] : normal->a[j][k]) / variance;
            }
        }
        fit->share += taken[i][i];
        for (uint8_t j = 0; j <= i; j++) {
            fit->bent += (j < i ? 2.0 : 1.0) * taken[i][j] * taken[j][i];
        }
    }
}

/* Least squares about `estimate`, with the square completed: the residual does not feel the priors, what they pull at
 * is the sum of two squares (and of what `rest` is worth, where columns could not be told apart). Unknowns inside: c,
 * and the level x0 + c' first - offset of the readings about their first samples, so that the prior is (level + offset
 * - c' first)^2 / P0 + sum (c - m)^2 / sd^2. With d = c - m the first square is (level + offset - m' first -
 * d' first)^2, so `from_prior` is level + offset - m' first, and then d. */
static void make_fit(const normal_t *normal, selfcal_wide_t variance, fit_t *fit) {
    const uint8_t order = normal->order;
    const selfcal_wide_t p0 = normal->sd[0] * normal->sd[0];
    selfcal_wide_t precision[UNKNOWNS_MAX][UNKNOWNS_MAX], g[UNKNOWNS_MAX][UNKNOWNS_MAX];
    fit->ln_det = 2.0 * log(normal->sd[0]);
    for (uint8_t i = 0; i < order; i++) {
        const selfcal_wide_t pull = i == 0U ? -1.0 : normal->first[i];
        for (uint8_t j = 0; j <= i; j++) {
            precision[i][j] = pull * (j == 0U ? -1.0 : normal->first[j]) / p0;
        }
        if (i > 0U) {
            precision[i][i] += 1.0 / (normal->sd[i] * normal->sd[i]);
            fit->ln_det += 2.0 * log(normal->sd[i]);
        }
        for (uint8_t j = 0; j <= i; j++) {
            g[i][j] = normal->a[i][j] / variance + precision[i][j];
        }
    }
    factorise(g, order, 0.0);
    selfcal_wide_t from_prior[UNKNOWNS_MAX], shift[UNKNOWNS_MAX];
    for (uint8_t i = 0; i < order; i++) {
        fit->ln_det += log(g[i][i]);
        from_prior[i] = normal->estimate[i] + (i == 0U ? normal->first[0] : -normal->prior_mean[i]);
        from_prior[0] -= i == 0U ? 0.0 : normal->prior_mean[i] * normal->first[i];
    }
    for (uint8_t i = 0; i < order; i++) {
        shift[i] = normal->rest[i] / variance;
        for (uint8_t j = 0; j < order; j++) {
            shift[i] -= (j <= i ? precision[i][j] : precision[j][i]) * from_prior[j];
        }
    }
    solve(g, order, shift);
    fit->miss = 0.0;
    fit->now.mean = normal->node.drift;
    memcpy(fit->now.drift, normal->drift, sizeof fit->now.drift);
    selfcal_wide_t x0_off = 0.0;
    selfcal_wide_t pulled[UNKNOWNS_MAX];
    fit->noise = 0.0;
    for (uint8_t i = 0; i < order; i++) {
        pulled[i] = 0.0;
        for (uint8_t j = 0; j < order; j++) {
            pulled[i] += (j <= i ? normal->a[i][j] : normal->a[j][i]) * shift[j] / variance;
        }
        fit->noise += shift[i] * (pulled[i] - 2.0 * normal->rest[i] / variance);
        const selfcal_wide_t off = from_prior[i] + shift[i];
        x0_off += i == 0U ? off : -off * normal->first[i];
        fit->miss += i == 0U ? 0.0 : off * off / (normal->sd[i] * normal->sd[i]);
        fit->mean[i] = normal->estimate[i] + shift[i];
        fit->now.mean += fit->mean[i] * normal->left[i];
        for (size_t t = 0; t < SELFCAL_TERMS_MAX; t++) {
            fit->now.drift[t] -= fit->mean[i] * normal->lost[i][t];
        }
    }
    fit->miss += x0_off * x0_off / p0 + fit->noise;
    inverse_sums(normal, variance, g, pulled, fit);
}

selfcal_status_t selfcal_log_likelihood_subset(selfcal_t *self, uint8_t axis, uint16_t node, uint8_t mask,
                                               selfcal_wide_t sigma_v, selfcal_wide_t *ln_p) {
    selfcal_node_view_t view;
    if (ln_p == NULL || !(sigma_v > 0.0)) {
        return SELFCAL_BAD_ARGUMENT;
    }
    const selfcal_status_t status = selfcal_node(self, axis, node, &view);
    if (status != SELFCAL_OK) {
        return status;
    }
    if (((unsigned)mask & ~(unsigned)selfcal_regressors_mask(self->model, axis)) != 0U) {
        return SELFCAL_BAD_ARGUMENT;
    }
    normal_t normal;
    fit_t fit;
    const selfcal_wide_t variance = sigma_v * sigma_v;
    make_normal(self, axis, node, mask, &normal);
    make_fit(&normal, variance, &fit);
    *ln_p = -0.5 * (self->weight * (SELFCAL_LN_2PI + 2.0 * log(sigma_v)) + view.ln_s + normal.residual / variance +
                    self->beginning * (fit.ln_det + fit.miss));
    return SELFCAL_OK;
}

selfcal_status_t selfcal_log_likelihood(selfcal_t *self, uint8_t axis, uint16_t node, selfcal_wide_t sigma_v,
                                        selfcal_wide_t *ln_p) {
    return selfcal_log_likelihood_subset(self, axis, node, 0U, sigma_v, ln_p);
}

/* --- report --- */

static void field_with_columns(const selfcal_work_t *work, uint16_t index, selfcal_wide_t least,
                               selfcal_field_t *result) {
    const selfcal_wide_t n = work->bank->weight, beginning = work->bank->beginning;
    normal_t normal;
    fit_t fit;
    make_normal(work->bank, work->axis, index, work->mask, &normal);
    const selfcal_wide_t residual = fmax(normal.residual, least);
    selfcal_wide_t variance = residual / (n - (selfcal_wide_t)work->unknowns), before;
    unsigned turns = SELFCAL_MODE_TURNS;
    do { /* as node_field() in report_node.c */
        before = variance;
        make_fit(&normal, variance, &fit);
        variance = (residual + beginning * fit.noise * variance) / (n - beginning * fit.share);
    } while (fabs(variance - before) > (selfcal_wide_t)SELFCAL_MODE_LEFT * variance && --turns > 0U);
    result->node = normal.node;
    result->var = residual / n;
    result->ratio = (selfcal_real_t)(variance / result->var);
    result->extra = (selfcal_real_t)(beginning * (fit.ln_det + fit.miss));
    result->share = (selfcal_real_t)(beginning * fit.bent);
}

/* The coefficients' moments go as those of the bias: their means at the nodes about those of the first in turn, and
 * their own variances. */
static void now_with_columns(const selfcal_work_t *work, uint16_t k, selfcal_wide_t variance, selfcal_now_t *result) {
    normal_t normal;
    fit_t fit;
    make_normal(work->bank, work->axis, (uint16_t)(work->first_node + k), work->mask, &normal);
    make_fit(&normal, variance, &fit);
    result->mean = fit.now.mean;
    for (size_t t = 0; t < SELFCAL_TERMS_MAX; t++) {
        result->drift[t] = (selfcal_real_t)fit.now.drift[t];
    }
    for (size_t t = 0; t < sizeof result->own / sizeof result->own[0]; t++) {
        result->own[t] = (selfcal_real_t)fit.now.own[t];
    }
    selfcal_coefficients_t *of = work->coefficients == NULL ? NULL : &work->coefficients[work->hypothesis];
    for (uint8_t i = 1; of != NULL && i < normal.order; i++) {
        const uint8_t r = normal.regressor[i];
        if (work->at == 0U) {
            of->mean[r] = (float)fit.mean[i];
            of->moment[0][r] = of->moment[1][r] = of->moment[2][r] = 0.0;
        }
        const selfcal_wide_t off = fit.mean[i] - (selfcal_wide_t)of->mean[r];
        of->moment[0][r] += (selfcal_wide_t)work->scratch.grid.spline[0][k] * off;
        of->moment[1][r] += (selfcal_wide_t)work->scratch.grid.spline[0][k] * off * off;
        of->moment[2][r] += (selfcal_wide_t)work->scratch.grid.spline[1][k] * fit.var[i];
    }
}

static void finish_coefficients(const selfcal_work_t *work) {
    selfcal_coefficients_t *of = work->coefficients == NULL ? NULL : &work->coefficients[work->hypothesis];
    for (uint8_t r = 0; of != NULL && r < SELFCAL_REGRESSORS_MAX; r++) {
        if (((unsigned)work->mask >> r & 1U) != 0U) {
            const selfcal_wide_t mean = of->moment[0][r] / (selfcal_wide_t)work->bias.weight;
            const selfcal_wide_t scatter = of->moment[1][r] / (selfcal_wide_t)work->bias.weight - mean * mean;
            of->sd[r] = (float)sqrt(fmax(scatter, 0.0) + fmax(of->moment[2][r] / work->sum.mass_sq, 0.0));
            of->mean[r] = (float)((selfcal_wide_t)of->mean[r] + mean);
        }
    }
}

static void fade_columns(selfcal_t *self, size_t j, selfcal_wide_t part, selfcal_wide_t part_of_one) {
    const size_t p = columns_of(self), axes = self->model->axes;
    selfcal_sum_t *a = &self->columns->a[j * SELFCAL_REGRESSORS_ROWS(p + 1U)];
    selfcal_wide_t of[1 + SELFCAL_REGRESSORS_MAX] = {part_of_one};
    for (size_t k = 0; k <= p; k++, a += k) {
        if (k > 0U) {
            of[k] = part * part * sum_value(a[k]) > SELFCAL_KEPT_MIN * SELFCAL_KEPT_MIN ? part : 1.0; /* in any unit */
        }
        for (size_t l = 0; l <= k; l++) {
            sum_fade(&a[l], of[k] * of[l]);
        }
    }
    for (size_t at = j * axes; at < (j + 1U) * axes; at++) {
        for (size_t k = 0; k < p; k++) {
            sum_fade(&self->columns->b[at * p + k], part * of[k + 1U]);
        }
    }
}

static void hold_columns(selfcal_t *held, const selfcal_t *self, uint8_t axis) {
    const size_t p = columns_of(self), nodes = self->model->nodes;
    const selfcal_columns_t *from = self->columns, *to = held->columns;
    memcpy(to->column, from->column, p * sizeof to->column[0]);
    memcpy(to->a, from->a, nodes * SELFCAL_REGRESSORS_ROWS(p + 1U) * sizeof to->a[0]);
    memcpy(to->x, from->x, nodes * (p + 1U) * sizeof to->x[0]);
    for (size_t j = 0; j < nodes; j++) {
        const size_t at = cell_of(self, j, axis);
        memcpy(&to->b[j * p], &from->b[at * p], p * sizeof to->b[0]);
        to->reading[j] = from->reading[at];
    }
}

const selfcal_regressors_code_t selfcal_regressors_code = {
    valid_regressors,   init_columns,      columns_sound,       usable_values, add_values,
    close_columns,      hand_over_columns, run_columns,         gap_columns,   fade_columns,
    field_with_columns, now_with_columns,  finish_coefficients, hold_columns,
};
