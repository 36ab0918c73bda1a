/* The whole calibration from rests (tumble.h): generalised least squares with a normal prior.
 *
 * Means of an axis have the covariance C of noise and drift; t counts back from the end of the last rest. Over
 * intervals apart from each other, with middles m and lengths L, a walk has K^2 min(m_i, m_j), on the diagonal
 * K^2 (end + L/3). A Gauss-Markov drift moves from there by m(t) - m(0), so it has
 *     sigma^2 (e(i, j) - e(i) - e(j) + 1),  e: means of exp(-alpha |t|) over the intervals.
 * A square of the scale adds square_sd^2 x_i^2 x_j^2, x the reading without its bias. The residual of a rest is |f| - g
 * with derivatives J and the covariance R = sum over axes of w_i w_j C_ij, w = (T K)' f / |f|. With R = L L', whitened
 * columns L^-1 J and residuals L^-1 r, in units of the prior's sd, a step solves
 *     (J' J + 1) step = -(J' r + theta).
 * A gyro's mean is linear in its bias and its row of G. */
#include "tumble.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

typedef selfcal_wide_t wide_t;

enum { ACCEL = SELFCAL_TUMBLE_ACCEL, GYRO = SELFCAL_TUMBLE_GYRO, ALL = 3, ROUNDS = 30, FEWEST = 3 };

/* sd of the priors. */
#define BIAS_SD SELFCAL_TUMBLE_BIAS_SD
#define SCALE_SD SELFCAL_TUMBLE_SCALE_SD
#define ANGLE_SD SELFCAL_TUMBLE_ANGLE_SD
#define GYRO_BIAS_SD 0.17453292519943295
#define G_SD (1.7453292519943296e-3 / 9.80665)
/* The last step, in units of the prior's sd. A mean beyond `LARGEST` is no reading. */
#define SETTLED 1e-10
#define LARGEST 1e6F

static size_t packed(size_t row, size_t column) {
    return row * (row + 1U) / 2U + column;
}

/* L L' = a [n, n], a lower triangle by rows, in place; false if it is not positive definite. */
static bool factorize(wide_t a[], size_t n) {
    for (size_t i = 0; i < n; i++) {
        for (size_t j = 0; j <= i; j++) {
            wide_t sum = a[packed(i, j)];
            for (size_t k = 0; k < j; k++) {
                sum -= a[packed(i, k)] * a[packed(j, k)];
            }
            if (i == j) {
                if (!(sum > 0.0) || !isfinite(sum)) {
                    return false;
                }
                a[packed(i, i)] = sqrt(sum);
            } else {
                a[packed(i, j)] = sum / a[packed(j, j)];
            }
        }
    }
    return true;
}

/* L^-1 x in place. */
static void forward(const wide_t L[], size_t n, wide_t x[]) {
    for (size_t i = 0; i < n; i++) {
        for (size_t k = 0; k < i; k++) {
            x[i] -= L[packed(i, k)] * x[k];
        }
        x[i] /= L[packed(i, i)];
    }
}

/* (L L')^-1 in place. */
static void invert(wide_t L[], size_t n) {
    for (size_t i = 0; i < n; i++) { /* L^-1, by rows */
        L[packed(i, i)] = 1.0 / L[packed(i, i)];
        for (size_t j = 0; j < i; j++) {
            wide_t sum = 0.0;
            for (size_t k = j; k < i; k++) {
                sum -= L[packed(i, k)] * L[packed(k, j)];
            }
            L[packed(i, j)] = sum * L[packed(i, i)];
        }
    }
    for (size_t i = 0; i < n; i++) { /* L^-T L^-1: the rows below are still those of L^-1 */
        for (size_t j = 0; j <= i; j++) {
            wide_t sum = 0.0;
            for (size_t k = i; k < n; k++) {
                sum += L[packed(k, i)] * L[packed(k, j)];
            }
            L[packed(i, j)] = sum;
        }
    }
}

/* Mean of exp(-x s) over s from 0 to 1. */
static wide_t decay(wide_t x) {
    return x > 1e-6 ? -expm1(-x) / x : 1.0;
}

/* Covariance of the means of an axis over two rests of `rests`, `end` the end of the last one. */
static wide_t covariance(const selfcal_tumble_noise_t *noise, const selfcal_tumble_rest_t rests[], size_t i, size_t j,
                         float end) {
    const wide_t a = (wide_t)end - (wide_t)rests[i].end_s, b = (wide_t)end - (wide_t)rests[j].end_s;
    const wide_t la = (wide_t)rests[i].end_s - (wide_t)rests[i].begin_s;
    const wide_t lb = (wide_t)rests[j].end_s - (wide_t)rests[j].begin_s;
    const wide_t N = (wide_t)noise->N, K = (wide_t)noise->K, sigma = (wide_t)noise->sigma_m;
    const wide_t alpha = (wide_t)noise->alpha, x = alpha * la;
    wide_t sum = K * K * (i == j ? a + la / 3.0 : fmin(a + 0.5 * la, b + 0.5 * lb));
    if (i == j) {
        sum += N * N / la;
    }
    if (sigma > 0.0) { /* exponentials are dear */
        const wide_t gap = fmax(fabs(a + 0.5 * la - b - 0.5 * lb) - 0.5 * (la + lb), 0.0);
        const wide_t between = i != j     ? exp(-alpha * gap) * decay(x) * decay(alpha * lb)
                               : x > 1e-3 ? 2.0 * (x + expm1(-x)) / (x * x)
                                          : 1.0 - x / 3.0;
        const wide_t back = exp(-alpha * a) * decay(x) + exp(-alpha * b) * decay(alpha * lb);
        sum += sigma * sigma * (between - back + 1.0);
    }
    return sum;
}

/* Normal equations of whitened columns, in `normal` with `added` on the diagonal. */
static void normal_of(const selfcal_tumble_work_t *work, size_t parameters, size_t count, wide_t added,
                      wide_t normal[]) {
    for (size_t i = 0; i < parameters; i++) {
        for (size_t j = 0; j <= i; j++) {
            wide_t sum = i == j ? added : 0.0;
            for (size_t k = 0; k < count; k++) {
                sum += work->column[i][k] * work->column[j][k];
            }
            normal[packed(i, j)] = sum;
        }
    }
}

/* A step from `theta` [parameters], in units of the prior's sd, by the columns, residuals and covariance in `work`.
 * Leaves the covariance in `normal`. Returns the largest part of the step; negative: there is none. */
static wide_t take_step(selfcal_tumble_work_t *work, size_t parameters, size_t count, wide_t theta[], wide_t normal[]) {
    if (!factorize(work->factor, count)) {
        return -1.0;
    }
    forward(work->factor, count, work->residual);
    for (size_t i = 0; i < parameters; i++) {
        forward(work->factor, count, work->column[i]);
    }
    normal_of(work, parameters, count, 1.0, normal);
    if (!factorize(normal, parameters)) {
        return -1.0;
    }
    invert(normal, parameters);
    wide_t pull[ACCEL], far = 0.0;
    for (size_t i = 0; i < parameters; i++) {
        pull[i] = theta[i];
        for (size_t k = 0; k < count; k++) {
            pull[i] += work->column[i][k] * work->residual[k];
        }
    }
    for (size_t i = 0; i < parameters; i++) {
        wide_t moved = 0.0;
        for (size_t j = 0; j < parameters; j++) {
            moved -= normal[i >= j ? packed(i, j) : packed(j, i)] * pull[j];
        }
        theta[i] += moved;
        far = fmax(far, fabs(moved));
    }
    return isfinite(far) ? far : -1.0;
}

/* A bit for each parameter that the whitened columns in `work` identify. The covariance there is lost. */
static uint16_t identified(selfcal_tumble_work_t *work, size_t parameters, size_t count) {
    wide_t *const normal = work->factor;
    uint16_t bits = 0;
    normal_of(work, parameters, count, 1.0 / (SELFCAL_TUMBLE_WIDER * SELFCAL_TUMBLE_WIDER), normal);
    if (factorize(normal, parameters)) {
        invert(normal, parameters);
        for (size_t i = 0; i < parameters; i++) {
            bits = (uint16_t)(bits | (unsigned)(normal[packed(i, i)] <= SELFCAL_TUMBLE_LEFT) << i);
        }
    }
    return bits;
}

static const wide_t accel_sd[ACCEL] = {BIAS_SD,  BIAS_SD,  BIAS_SD,  SCALE_SD, SCALE_SD,
                                       SCALE_SD, ANGLE_SD, ANGLE_SD, ANGLE_SD};
static const wide_t gyro_sd[GYRO] = {GYRO_BIAS_SD, G_SD, G_SD, G_SD};

/* Covariance of parameters, in units of the prior's `sd`, in their own. */
static void scale(float covariance_of[], const wide_t normal[], const wide_t sd[], size_t parameters) {
    for (size_t i = 0; i < parameters; i++) {
        for (size_t j = 0; j <= i; j++) {
            covariance_of[packed(i, j)] = (float)(normal[packed(i, j)] * sd[i] * sd[j]);
        }
    }
}

/* T K of parameters in units of the prior's sd. */
static void matrix_of(const wide_t theta[ACCEL], wide_t M[3][3]) {
    const wide_t T[3][3] = {
        {1.0, theta[6] * ANGLE_SD, theta[7] * ANGLE_SD}, {0.0, 1.0, theta[8] * ANGLE_SD}, {0, 0, 1.0}};
    for (size_t i = 0; i < 3U; i++) {
        for (size_t j = 0; j < 3U; j++) {
            M[i][j] = T[i][j] * (1.0 + theta[3U + j] * SCALE_SD);
        }
    }
}

/* Specific force of a rest, and its length. */
static wide_t force_of(const wide_t theta[ACCEL], wide_t M[3][3], const selfcal_tumble_rest_t *rest, wide_t x[3],
                       wide_t f[3]) {
    wide_t square = 0.0;
    for (size_t i = 0; i < 3U; i++) {
        x[i] = (wide_t)rest->mean[i] - theta[i] * BIAS_SD;
    }
    for (size_t i = 0; i < 3U; i++) {
        f[i] = M[i][0] * x[0] + M[i][1] * x[1] + M[i][2] * x[2];
        square += f[i] * f[i];
    }
    return sqrt(square);
}

static bool alike(const selfcal_tumble_noise_t *a, const selfcal_tumble_noise_t *b) {
    return a->N == b->N && a->K == b->K && a->sigma_m == b->sigma_m && a->alpha == b->alpha;
}

/* Residual and columns of the accelerometers in rest `n`, with readings x without bias and the force f, in units of the
 * prior's sd. */
static void lay_accel(const wide_t theta[ACCEL], wide_t M[3][3], const wide_t x[3], const wide_t f[3], wide_t length,
                      size_t n, selfcal_tumble_work_t *work) {
    wide_t(*const column)[SELFCAL_TUMBLE_MAX] = work->column;
    for (size_t i = 0; i < 3U; i++) {
        const wide_t w = (f[0] * M[0][i] + f[1] * M[1][i] + f[2] * M[2][i]) / length;
        column[i][n] = -w * BIAS_SD; /* -w, by which the means' noise enters */
        column[3U + i][n] = w * x[i] / (1.0 + theta[3U + i] * SCALE_SD) * SCALE_SD;
    }
    const wide_t y = x[1] * (1.0 + theta[4] * SCALE_SD), z = x[2] * (1.0 + theta[5] * SCALE_SD);
    column[6][n] = f[0] / length * y * ANGLE_SD;
    column[7][n] = f[0] / length * z * ANGLE_SD;
    column[8][n] = f[1] / length * z * ANGLE_SD;
}

/* Covariance of the accelerometers' residuals of rests i and j, with squares of the scale of this sd. */
static wide_t accel_covariance(const selfcal_tumble_part_t *part, const selfcal_tumble_rest_t rests[], size_t i,
                               size_t j, float end, const wide_t theta[ACCEL], wide_t square_sd,
                               const selfcal_tumble_work_t *work) {
    wide_t sum = 0.0, C = 0.0;
    for (size_t axis = 0; axis < 3U; axis++) {
        const selfcal_tumble_noise_t *noise = &part->noise[axis];
        if (axis == 0U || !alike(noise, noise - 1)) { /* mostly all are alike */
            C = covariance(noise, rests, i, j, end);
        }
        const wide_t a = (wide_t)rests[i].mean[axis] - theta[axis] * BIAS_SD;
        const wide_t b = (wide_t)rests[j].mean[axis] - theta[axis] * BIAS_SD;
        const wide_t square = square_sd * a * b;
        sum += work->column[axis][i] * work->column[axis][j] * (C + square * square) / (BIAS_SD * BIAS_SD);
    }
    return sum;
}

/* Residuals, columns and covariance at `theta` of the accelerometers: those of a gyro `axis`, or of the accelerometers
 * themselves at ALL. */
static void lay(const selfcal_tumble_part_t *part, const selfcal_tumble_rest_t rests[], size_t count, size_t axis,
                const wide_t theta[ACCEL], wide_t square_sd, selfcal_tumble_work_t *work) {
    wide_t M[3][3];
    matrix_of(theta, M);
    const float end = rests[count - 1U].end_s;
    for (size_t n = 0; n < count; n++) {
        wide_t x[3], f[3];
        const wide_t length = force_of(theta, M, &rests[n], x, f);
        if (axis == ALL) {
            work->residual[n] = length - (wide_t)part->gravity;
            lay_accel(theta, M, x, f, length, n, work);
            for (size_t j = 0; j <= n; j++) {
                work->factor[packed(n, j)] = accel_covariance(part, rests, n, j, end, theta, square_sd, work);
            }
            continue;
        }
        const wide_t level = (wide_t)part->level, share = f[axis] / length;
        work->residual[n] = -((wide_t)rests[n].mean[3U + axis] - (wide_t)part->vertical * share);
        work->column[0][n] = GYRO_BIAS_SD;
        for (size_t i = 0; i < 3U; i++) {
            work->column[1U + i][n] = f[i] * G_SD;
        }
        for (size_t j = 0; j <= n; j++) {
            work->factor[packed(n, j)] = covariance(&part->noise[3U + axis], rests, n, j, end);
        }
        work->factor[packed(n, n)] += level * level * (1.0 - share * share);
    }
}

/* No number at all: of IEEE 754, bytes of ones are a NaN. */
static void clear(selfcal_tumble_t *found) {
    memset(found, 0xFF, sizeof *found);
    found->accel_identified = found->gyro_identified = 0U;
}

/* False for NaN, infinity, and what is no size. */
static bool is_size(float value) {
    return value >= 0.0F && value < LARGEST;
}

static selfcal_tumble_status_t check(const selfcal_tumble_part_t *part, const selfcal_tumble_rest_t rests[],
                                     uint8_t count) {
    bool sound = part->gravity > 1.0F && part->gravity < 100.0F && fabsf(part->vertical) < 1.0F &&
                 part->level >= 0.0F && part->level < 1.0F;
    for (size_t axis = 0; axis < 6U; axis++) {
        const selfcal_tumble_noise_t *noise = &part->noise[axis];
        sound = sound && noise->N > 0.0F && is_size(noise->N) && is_size(noise->K) && is_size(noise->sigma_m) &&
                is_size(noise->alpha);
    }
    if (!sound) {
        return SELFCAL_TUMBLE_BAD_PART;
    }
    float before = -INFINITY;
    for (size_t n = 0; n < count; n++) {
        for (size_t axis = 0; axis < 6U; axis++) {
            if (!(fabsf(rests[n].mean[axis]) < LARGEST)) {
                return SELFCAL_TUMBLE_BAD_REST;
            }
        }
        if (!(rests[n].begin_s >= before && rests[n].begin_s > -1e9F && rests[n].end_s > rests[n].begin_s &&
              rests[n].end_s < 1e9F)) {
            return SELFCAL_TUMBLE_BAD_REST;
        }
        before = rests[n].end_s;
    }
    return count < FEWEST ? SELFCAL_TUMBLE_TOO_FEW : SELFCAL_TUMBLE_OK;
}

/* Residuals in their sd, of those that the parameters leave. */
static float ratio_of(const selfcal_tumble_work_t *work, size_t count, const wide_t normal[]) {
    wide_t free = (wide_t)count, sum = 0.0;
    for (size_t k = 0; k < count; k++) {
        sum += work->residual[k] * work->residual[k];
    }
    for (size_t i = 0; i < ACCEL; i++) {
        free -= 1.0 - normal[packed(i, i)]; /* trace of J (J' J + 1)^-1 J' */
    }
    return free > 0.5 ? (float)sqrt(sum / free) : NAN;
}

/* Steps of the accelerometers from `theta` until they settle; false if they do not, or end beyond the priors' reach. */
static bool find_accel(const selfcal_tumble_part_t *part, const selfcal_tumble_rest_t rests[], size_t count,
                       wide_t square_sd, wide_t theta[ACCEL], wide_t normal[], selfcal_tumble_work_t *work) {
    wide_t far = 1.0;
    for (int round = 0; round < ROUNDS && far >= SETTLED; round++) {
        lay(part, rests, count, ALL, theta, square_sd, work);
        far = take_step(work, ACCEL, count, theta, normal);
    }
    bool sound = far >= 0.0 && far < SETTLED;
    for (size_t i = 0; i < ACCEL; i++) {
        sound = sound && fabs(theta[i]) <= SELFCAL_TUMBLE_REACH;
    }
    return sound;
}

/* Values and covariance of parameters in units of the prior's `sd`; NAN without its bit. */
static void state(wide_t value[], float covariance_of[], const wide_t theta[], const wide_t normal[], const wide_t sd[],
                  size_t parameters, uint16_t bits) {
    for (size_t i = 0; i < parameters; i++) {
        value[i] = ((uint32_t)bits >> i & 1U) != 0U ? theta[i] * sd[i] : (wide_t)NAN;
    }
    scale(covariance_of, normal, sd, parameters);
}

/* Parameters with intervals that have a square of the scale. `bias` and `matrix` come nearest at 1 g: without one. */
static bool fit_accel(selfcal_tumble_t *found, const selfcal_tumble_part_t *part, const selfcal_tumble_rest_t rests[],
                      size_t count, wide_t theta[ACCEL], selfcal_tumble_work_t *work) {
    wide_t normal[ACCEL * (ACCEL + 1) / 2] = {0.0}, straight[ACCEL];
    wide_t(*const M)[3] = (wide_t(*)[3])work->factor; /* at the end: less stack */
    if (!find_accel(part, rests, count, SELFCAL_TUMBLE_SQUARE_SD, theta, normal, work)) {
        return false;
    }
    found->accel_identified = identified(work, ACCEL, count);
    found->ratio = ratio_of(work, count, normal);
    state(found->accel, found->accel_covariance, theta, normal, accel_sd, ACCEL, found->accel_identified);
    memcpy(straight, theta, sizeof straight);
    if (!find_accel(part, rests, count, 0.0, straight, normal, work)) {
        return false;
    }
    matrix_of(straight, M);
    for (size_t i = 0; i < 3U; i++) {
        found->bias[i] = (float)(straight[i] * BIAS_SD);
        for (size_t j = 0; j < 3U; j++) {
            found->matrix[i][j] = (float)M[i][j];
        }
    }
    return true;
}

static bool fit_gyro(selfcal_tumble_t *found, const selfcal_tumble_part_t *part, const selfcal_tumble_rest_t rests[],
                     size_t count, size_t axis, const wide_t accel[ACCEL], selfcal_tumble_work_t *work) {
    wide_t normal[GYRO * (GYRO + 1) / 2], theta[GYRO] = {0.0, 0.0, 0.0, 0.0};
    lay(part, rests, count, axis, accel, 0.0, work);
    if (take_step(work, GYRO, count, theta, normal) < 0.0) {
        return false;
    }
    const uint16_t bits = identified(work, GYRO, count);
    found->gyro_identified = (uint16_t)(found->gyro_identified | (unsigned)bits << (GYRO * axis));
    state(found->gyro[axis], found->gyro_covariance[axis], theta, normal, gyro_sd, GYRO, bits);
    found->gyro_bias[axis] = (float)(theta[0] * GYRO_BIAS_SD);
    for (size_t i = 0; i < 3U; i++) {
        found->G[axis][i] = (float)(theta[1U + i] * G_SD);
    }
    return true;
}

selfcal_tumble_status_t selfcal_tumble(selfcal_tumble_t *found, const selfcal_tumble_part_t *part,
                                       const selfcal_tumble_rest_t rests[], uint8_t count,
                                       selfcal_tumble_work_t *work) {
    if (found == NULL) {
        return SELFCAL_TUMBLE_BAD_ARGUMENT;
    }
    clear(found);
    if (part == NULL || rests == NULL || work == NULL || count > SELFCAL_TUMBLE_MAX) {
        return SELFCAL_TUMBLE_BAD_ARGUMENT;
    }
    wide_t theta[ACCEL] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
    selfcal_tumble_status_t status = check(part, rests, count);
    bool sound = status == SELFCAL_TUMBLE_OK && fit_accel(found, part, rests, count, theta, work);
    for (size_t axis = 0; axis < 3U && sound; axis++) {
        sound = fit_gyro(found, part, rests, count, axis, theta, work);
    }
    if (status == SELFCAL_TUMBLE_OK) {
        const bool nothing = (found->accel_identified | found->gyro_identified) == 0U;
        status = !sound ? SELFCAL_TUMBLE_UNSETTLED : nothing ? SELFCAL_TUMBLE_NOTHING : SELFCAL_TUMBLE_OK;
    }
    if (status != SELFCAL_TUMBLE_OK) {
        clear(found);
    }
    return status;
}

uint16_t selfcal_tumble_known(const selfcal_tumble_part_t *part, const selfcal_tumble_rest_t rests[], uint8_t count,
                              selfcal_tumble_work_t *work, float found[45]) {
    wide_t normal[ACCEL * (ACCEL + 1) / 2] = {0.0}, theta[ACCEL] = {0.0};
    if (count > 0U) {
        lay(part, rests, count, ALL, theta, SELFCAL_TUMBLE_SQUARE_SD, work);
    }
    if (take_step(work, ACCEL, count, theta, normal) < 0.0) {
        return 0U;
    }
    scale(found, normal, accel_sd, ACCEL);
    return identified(work, ACCEL, count);
}

float selfcal_tumble_accel_sd(const selfcal_tumble_t *found, uint8_t k) {
    const bool known = k < ACCEL && (found->accel_identified >> k & 1U) != 0U;
    return known ? sqrtf(found->accel_covariance[packed(k, k)]) : NAN;
}

float selfcal_tumble_gyro_sd(const selfcal_tumble_t *found, uint8_t axis, uint8_t k) {
    const bool known = axis < 3U && k < GYRO && (found->gyro_identified >> (GYRO * axis + k) & 1U) != 0U;
    return known ? sqrtf(found->gyro_covariance[axis][packed(k, k)]) : NAN;
}

void selfcal_tumble_apply(const selfcal_tumble_t *found, const float reading[6], float corrected[6]) {
    for (size_t i = 0; i < 3U; i++) {
        corrected[i] = 0.0F;
        for (size_t j = 0; j < 3U; j++) {
            corrected[i] += found->matrix[i][j] * (reading[j] - found->bias[j]);
        }
    }
    for (size_t i = 0; i < 3U; i++) {
        corrected[3U + i] = reading[3U + i] - found->gyro_bias[i];
        for (size_t j = 0; j < 3U; j++) {
            corrected[3U + i] -= found->G[i][j] * corrected[j];
        }
    }
}
