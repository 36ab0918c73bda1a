/* The kernel in integers, for parts without an FPU: every axis of one node through a span.
 *
 * INPUT SCALING  y and the drift x are int32 in steps of 2^exponent unit, one exponent an axis. The data choose it,
 *   since no model knows the noise: the first batch sets it so that the white noise seen there is 2^20 to 2^21 steps
 *   (one is 5e-7 to 1e-6 sigma). Where |y| would pass LIMIT = 3 * 2^25 steps (48 to 96 sigma of drift and offset) the
 *   step doubles, as often as it takes; where the readings keep below 2^17 steps it shrinks again by 16. x, B and C are
 *   rescaled with it. So nothing saturates; selfcal_scale() counts these events. What the range and the priors make of
 *   it is in the generated SELFCAL_MODEL_EXPONENTS: by |y| < 2 range, 2^exponent <= 4 range / LIMIT; by the noise,
 *   sigma <= sqrt(2) range.
 * HEAD-ROOM  Each function states its own; all rest on
 *     |y| <= LIMIT < 2^26.6                  by selfcal_kernel_load()
 *     |x| < LIMIT + 2^24                     x' = (1 - g) x + (g - beta) y with beta <= g <= 1 keeps x among the y and
 *                                            0, up to the rounding: one step a sample against the pull of g, less than
 *                                            2^24 steps for g >= 2^-23
 *     |nu| = |y - x| < 2 LIMIT + 2^24 < 2^28
 *     u/s < 2^(11 - b_bits), 1/s <= 2^10     s >= r + P, r >= 2^-10; P >= q, and 1 + p_inf <= 2 + q (b_bits())
 *     a span                                 has 16 samples at most
 *   None of it depends on the length of the record: sums that fill up make room for themselves (SUMS).
 *   tests/lib/fixed/test_bank_kernel_fixed.c drives each there under UBSan.
 * GUARD BITS  Rounding to a step moves x by 0.3/sqrt(g) steps. Errors e of nu that are independent between nodes move
 *   each ln-likelihood by sqrt(n) e/sigma nats: 3e-4 at n = 10^5 for e = 1 step, 1e-3 at 10^6; where the step has
 *   grown, that much more.
 * SUMS  int64. B in 2^-(6 + b_bits) steps: a sample adds < 2^(28 + 6 + 11) = 2^45, at r = 1 in real records 2^28. C in
 *   2^16 steps^2: a sample adds < 2^(56 + 10 - 16) = 2^50, at r = 1 in real records 2^26. The step doubles with the
 *   next batch once |B| or C has reached 2^61, which halves B and quarters C: neither passes 2^61 + 2^54. In real
 *   records that is never: C takes 2^35 samples, and the count is 32 bits. How long a record keeps its accuracy is
 *   another matter: GUARD BITS, selfcal_tables.h at SELFCAL_FIXED.
 *
 * Gains come in float from bank.c and become mantissa * 2^-shift here: once a span and node, for a level node once for
 * all. >> of a negative number must be arithmetic, as it is with every compiler of these parts. */
#include "bank_inside.h"

#ifdef SELFCAL_FIXED

#define LIMIT ((int32_t)SELFCAL_FIXED_LIMIT)
/* White noise of the first batch is at least 2 to this many steps. */
#define SIGMA_BITS 20
/* Readings below this many steps let the step shrink by 2^FINER_BITS. */
#define FEW_STEPS (1L << 17)
#define FINER_BITS 4
/* From this times 2^32 in a sum on the step doubles. */
#define FULL (1L << 29)
/* The step grows by 2 to this many at a time: shifts stay within their types. */
#define MOST_COARSER 30

/* --- numbers from float --- */

/* The shift with which a value has `bits` bits before the binary point: 2^(bits - 1) <= |value| 2^shift < 2^bits. At
 * most 62. */
static int mantissa_shift(float value, int bits) {
    const int shift = 126 + bits - (int)((float_bits(value) >> 23) & 0xFFU);
    return shift < 62 ? shift : 62;
}

/* value / 2^shift rounded to nearest, 1 <= shift <= 63. Sums that floors went into would be off by half a unit a
 * batch. */
static inline int64_t scaled(int64_t value, uint32_t shift) {
    return ((value >> (shift - 1U)) + 1) >> 1;
}

/* u/s < 2^(1 - b_bits) with whole blocks: u <= 1, and s >= 1 + P, where P >= q (bank.c) and p_inf <= 1 + q. */
static int b_bits(const selfcal_node_t *node) {
    const selfcal_real_t p = node->beta > R(0.0) ? node->p_inf : node->q;
    return -mantissa_shift(R(1.0) + p, 1);
}

/* --- scales --- */

static int32_t larger(int32_t a, int32_t b) {
    return a > b ? a : b;
}

/* |sum| in 2^32, rounded down. */
static inline int32_t high(int64_t sum) {
    const int32_t bits = (int32_t)(sum >> 32);
    return bits < 0 ? ~bits : bits;
}

/* Makes the step of an axis 2^bits times as large, 1 to 30, or smaller by FINER_BITS: may_be_finer() has seen to the
 * room. x is rounded to nearest, B and C lose less than one of their units. */
static void rescale_axis(selfcal_t *self, uint8_t axis, int bits) {
    const size_t axes = self->model->axes;
    const size_t cells = self->model->nodes * axes;
    selfcal_scale_t *scale = &self->integers.scale[axis];
    scale->most_y = scale->most_sum = 0;
    for (size_t k = axis; k < cells; k += axes) {
        if (bits > 0) {
            self->x[k] = (self->x[k] + (1 << (bits - 1))) >> bits;
            self->b[k] >>= bits;
            self->c[k] >>= 2 * bits;
        } else {
            self->x[k] *= 1 << -bits;
            self->b[k] *= 1 << -bits;
            self->c[k] *= 1 << (-2 * bits);
        }
        scale->most_sum = larger(scale->most_sum, larger(high(self->b[k]), high(self->c[k])));
    }
    scale->exponent = (int16_t)(scale->exponent + bits);
    if (bits > 0) {
        scale->coarser++;
    } else {
        scale->finer++;
    }
}

/* Whether the axis's drifts and sums leave room for a smaller step. */
static bool may_be_finer(const selfcal_t *self, uint8_t axis) {
    const size_t axes = self->model->axes;
    const size_t cells = self->model->nodes * axes;
    for (size_t k = axis; k < cells; k += axes) {
        const int64_t room = INT64_MAX >> (2 * FINER_BITS + 2);
        if (self->x[k] > FEW_STEPS || self->x[k] < -FEW_STEPS || self->b[k] > room || self->b[k] < -room ||
            self->c[k] > room) {
            return false;
        }
    }
    return true;
}

void selfcal_kernel_start(selfcal_t *self, uint8_t axis, selfcal_real_t ln_sigma) {
    self->integers.scale[axis].exponent = (int16_t)(floorf(ln_sigma * R(1.44269504)) - SIGMA_BITS); /* log2(e) */
}

const selfcal_scale_t *selfcal_scale(const selfcal_t *self, uint8_t axis) {
    SELFCAL_ASSERT(axis < self->model->axes);
    return &self->integers.scale[axis];
}

/* Rounds y to steps, after making the step so coarse that |y| <= LIMIT and that a full sum has room again. */
void selfcal_kernel_load(selfcal_t *self) {
    const selfcal_batch_t *batch = waiting(self);
    self->integers.step_from = self->integers.step_to = 0U;
    for (uint8_t axis = 0; axis < self->model->axes; axis++) {
        selfcal_scale_t *scale = &self->integers.scale[axis];
        float peak = 0.0F;
        for (uint32_t i = 0; i < batch->count; i++) {
            peak = r_fmax(peak, r_fabs(batch->y[axis][i]));
        }
        int bits = scale->most_sum >= FULL ? 1 : 0;
        while (to_fixed(peak, -scale->exponent - bits) > LIMIT) {
            if (++bits == MOST_COARSER) {
                rescale_axis(self, axis, bits);
                bits = 0;
            }
        }
        if (bits > 0) {
            rescale_axis(self, axis, bits);
        } else if (peak > 0.0F && to_fixed(peak, -scale->exponent) < FEW_STEPS && may_be_finer(self, axis)) {
            rescale_axis(self, axis, -FINER_BITS);
        }
        for (uint32_t i = 0; i < batch->count; i++) {
            self->integers.y[axis][i] = to_fixed(batch->y[axis][i], -scale->exponent);
        }
        const int32_t most = to_fixed(peak, -scale->exponent);
        scale->most_y = most > scale->most_y ? most : scale->most_y;
    }
}

/* Adds a span's sums to a cell's. */
static inline void add_sums(selfcal_t *self, size_t k, size_t axis, int64_t b, int64_t c) {
    self->b[k] += b;
    self->c[k] += c;
    selfcal_scale_t *scale = &self->integers.scale[axis];
    const int32_t most_b = high(self->b[k]), most_c = (int32_t)(self->c[k] >> 32);
    if (most_b > scale->most_sum) {
        scale->most_sum = most_b;
    }
    if (most_c > scale->most_sum) {
        scale->most_sum = most_c;
    }
}

/* --- any node --- */

static uint32_t at_most_63(int shift) {
    return shift < 63 ? (uint32_t)shift : 63U;
}

/* Largest of the span. */
static float greatest(const float v[SELFCAL_BATCH], span_t span) {
    float most = 0.0F;
    for (uint32_t i = span.from; i < span.to; i++) {
        most = r_fmax(most, r_fabs(v[i]));
    }
    return most;
}

/* 32-bit products, in 64 bits; x is rounded to nearest, and so are the span's sums. Per sample g, u/s, 1/s and beta
 * with mantissas below 2^30. One shift a span for g and beta and one for u/s; 1/s has its own, since it grows a
 * millionfold in the first samples of some nodes:
 *   g nu - beta y   < 2^59
 *   sum u/s nu      < 16 * 2^30 * 2^28 = 2^62
 *   sum (nu/s) nu   < 16 * 2^29 * 2^28 = 2^61, nu/s rounded to its 29th bit
 * u_shift >= 28 + b_bits - 11 + 29 - 29 - 6 - b_bits = 11; c_shift >= 28 - 10 + 29 - 29 - 29 + 16 = 5. */
void selfcal_kernel_run(selfcal_t *self, size_t j, const gains_t *gains) {
    const span_t span = gains->span;
    const selfcal_node_t *node = &self->node[j];
    const int scale_shift = mantissa_shift(gains->scale.hi, 30);
    const int32_t scale = to_fixed(gains->scale.hi, scale_shift) + to_fixed(gains->scale.lo, scale_shift);
    const int u_bare = mantissa_shift(greatest(gains->u, span), 29);
    const int w_bare = mantissa_shift(greatest(gains->inv_s, span), 29);
    const uint32_t u_shift = at_most_63(u_bare + scale_shift - 29 - 6 - b_bits(node));
    const uint32_t c_shift = at_most_63(w_bare + scale_shift - 29 - 29 + 16);
    const int g_shift = mantissa_shift(greatest(gains->g, span), 30);
    int32_t g[SELFCAL_BATCH], u[SELFCAL_BATCH], w[SELFCAL_BATCH];
    uint8_t smaller[SELFCAL_BATCH]; /* 1/s by so many powers of 2 than the greatest */
    for (uint32_t i = span.from; i < span.to; i++) {
        const int w_shift = mantissa_shift(gains->inv_s[i], 29);
        smaller[i] = (uint8_t)(w_shift - w_bare);
        g[i] = to_fixed(gains->g[i], g_shift);
        u[i] = (int32_t)((int64_t)to_fixed(gains->u[i], u_bare) * scale >> 29);
        w[i] = (int32_t)((int64_t)to_fixed(gains->inv_s[i], w_shift) * scale >> 29);
    }
    const int32_t beta = to_fixed(node->beta, g_shift);
    const int64_t half = (int64_t)1 << (g_shift - 1);
    const size_t axes = self->model->axes;
    for (size_t axis = 0; axis < axes; axis++) {
        const size_t k = j * axes + axis;
        int32_t x = self->x[k];
        int64_t b = 0, c = 0;
        for (uint32_t i = span.from; i < span.to; i++) {
            const int32_t y = self->integers.y[axis][i];
            const int32_t nu = y - x;
            b += (int64_t)u[i] * nu;
            const int32_t weighted = (int32_t)(((int64_t)w[i] * nu + (1L << 28)) >> 29);
            c += (int64_t)weighted * nu >> smaller[i];
            x += (int32_t)(((int64_t)g[i] * nu - (int64_t)beta * y + half) >> g_shift);
        }
        self->x[k] = x;
        add_sums(self, k, axis, scaled(b, u_shift), scaled(c, c_shift));
    }
}

/* --- level nodes --- */

/* Predicting nu needs one product a sample and node:
 *   nu_i = d_i + nu_(i-1) - g nu_(i-1),   d_i = y_i - y_(i-1) + beta y_(i-1),
 * where d is common to the nodes of one pole: hence their order. It starts from -x with d_0 = y_0, and d_count = y -
 * beta y of the last gives x = d_count - (nu - g nu). |d| < 3 LIMIT < 2^29. */
size_t kernel_node(const selfcal_t *self, size_t i) {
    const node_of_t node = node_of(self->model, i);
    const selfcal_hypothesis_t *hypothesis = &self->model->hypothesis[node.hypothesis];
    const size_t rows = grid_nodes(hypothesis->rho);
    size_t row = node.index, column = 0;
    for (; row >= rows; row -= rows) {
        column++; /* shorter than a division in software */
    }
    return i - node.index + row * grid_nodes(hypothesis->alpha) + column;
}

/* A span's sum of nu in steps, and of nu^2 in 2^16 steps^2. */
typedef struct {
    int64_t b;
    uint64_t c;
} level_sums_t;

#define GAIN_BITS 30

/* mantissa 2^-(shift + 14) v, rounded; the product is below 2^58. */
static inline int32_t part_of(int32_t mantissa, uint32_t shift, int32_t v) {
    return (int32_t)(((int64_t)mantissa * v + ((int64_t)1 << (shift + 13U))) >> (shift + 14U));
}

/* 32-bit products, in 64 bits; g nu is rounded to nearest. Sums over up to 16 samples: nu 2^32 (times u/s with 30 bits
 * 2^62), nu^2 < 2^60. */
static level_sums_t run_level_axis(const selfcal_node_t *node, const int32_t *d, uint32_t count, int32_t *x) {
    const int32_t g = node->gains.settled.g;
    const uint32_t shift = node->g_shift;
    const int32_t *const end = d + count;
    int32_t v = -*x;
    int64_t b = 0, c = 0;
    do {
        v += *d++;
        b += v;
        c += (int64_t)v * v;
        v -= part_of(g, shift, v);
    } while (d < end);
    *x = *end - v;
    const level_sums_t sums = {b, ((uint64_t)c + 0x8000U) >> 16};
    return sums;
}

static uint32_t gain_shift(float gain) {
    const int shift = mantissa_shift(gain, GAIN_BITS) - 14;
    return shift < 31 ? (uint32_t)shift : 31U;
}

/* g, u/s and 1/s of a level node, in place of how they moved. */
static void set_mantissas(selfcal_node_t *node) {
    const selfcal_sum_t inv_s = steady_inv_s(node);
    const selfcal_real_t g = steady_g(node), u = inv_s.hi * node->u_inf;
    const selfcal_real_t u_lo = r_fma_exact(inv_s.hi, node->u_inf, -u) + inv_s.lo * node->u_inf;
    node->g_shift = (uint8_t)gain_shift(g);
    node->gains.settled.g = to_fixed(g, node->g_shift + 14);
    const int u_shift = mantissa_shift(u, 30);
    node->gains.settled.u = to_fixed(u, u_shift) + to_fixed(u_lo, u_shift);
    node->u_shift = (uint8_t)(u_shift - 6 - b_bits(node));
    node->w_shift = (uint8_t)mantissa_shift(inv_s.hi, 30);
    node->gains.settled.w = to_fixed(inv_s.hi, node->w_shift) + to_fixed(inv_s.lo, node->w_shift);
}

void selfcal_kernel_settle(selfcal_t *self, size_t j) {
    set_mantissas(&self->node[j]);
}

void selfcal_kernel_unsettle(selfcal_t *self, size_t j) {
    self->node[j].gains.moving = moving_of(&self->node[j]);
}

static void make_steps(selfcal_t *self, span_t span, float beta) {
    if (self->integers.step_from == span.from && self->integers.step_to == span.to &&
        self->integers.step_beta == beta) {
        return;
    }
    self->integers.step_from = span.from;
    self->integers.step_to = span.to;
    self->integers.step_beta = beta;
    const uint32_t shift = gain_shift(beta);
    const int32_t mantissa = to_fixed(beta, (int)shift + 14);
    const uint32_t count = span.to - span.from;
    for (size_t axis = 0; axis < self->model->axes; axis++) {
        const int32_t *y = &self->integers.y[axis][span.from];
        int32_t *d = self->integers.step[axis];
        int32_t held = 0; /* phi y of the sample before */
        for (uint32_t i = 0; i < count; i++) {
            d[i] = y[i] - held;
            held = y[i] - part_of(mantissa, shift, y[i]);
        }
        d[count] = held;
    }
}

/* w (mantissa 2^-shift) times c, c < 2^44: in two parts where it does not fit 32 bits, each product below 2^62. */
static int64_t weigh(uint64_t c, uint32_t mantissa, uint32_t shift) {
    if (c >> 32 == 0U) {
        return (int64_t)((((uint64_t)(uint32_t)c * mantissa >> (shift - 1U)) + 1U) >> 1);
    }
    const uint64_t low = (uint64_t)((uint32_t)c & 0x3FFFFFU) * mantissa >> 22;
    return (int64_t)(((((uint64_t)(uint32_t)(c >> 22) * mantissa + low) >> (shift - 23U)) + 1U) >> 1);
}

static void level_node(selfcal_t *self, size_t j, uint32_t count) {
    const selfcal_node_t *node = &self->node[j];
    const size_t axes = self->model->axes;
    for (size_t axis = 0; axis < axes; axis++) {
        const size_t k = j * axes + axis;
        const level_sums_t sums = run_level_axis(node, self->integers.step[axis], count, &self->x[k]);
        const int64_t b = node->gains.settled.u != 0 ? scaled(sums.b * node->gains.settled.u, node->u_shift) : 0;
        add_sums(self, k, axis, b, weigh(sums.c, (uint32_t)node->gains.settled.w, node->w_shift));
    }
}

void selfcal_kernel_level(selfcal_t *self, span_t span, size_t from, size_t to) {
    for (size_t i = from; i < to; i++) {
        const size_t j = kernel_node(self, i);
        const selfcal_node_t *node = &self->node[j];
        if (node->level) {
            make_steps(self, span, node->beta);
            level_node(self, j, span.to - span.from);
        }
    }
}

/* --- the rest --- */

static selfcal_total_t faded(selfcal_total_t sum, selfcal_wide_t keep) {
    return (selfcal_total_t)(keep * (selfcal_wide_t)sum + (sum < 0 ? -0.5 : 0.5));
}

void selfcal_kernel_fade(selfcal_t *self, size_t j, selfcal_wide_t keep_b, selfcal_wide_t keep_c) {
    const size_t axes = self->model->axes;
    for (size_t k = j * axes; k < (j + 1U) * axes; k++) {
        self->b[k] = faded(self->b[k], keep_b);
        self->c[k] = faded(self->c[k], keep_c);
        if (self->columns != NULL) {
            sum_fade(&self->columns->reading[k].b, keep_b);
            sum_fade(&self->columns->reading[k].c, keep_c);
        }
    }
}

void selfcal_kernel_gap(selfcal_t *self, size_t j, selfcal_wide_t less) {
    const int32_t keep = (int32_t)((1.0 - less) * (selfcal_wide_t)(1L << 30));
    const size_t axes = self->model->axes;
    for (size_t k = j * axes; k < (j + 1U) * axes; k++) {
        self->x[k] = (int32_t)(((int64_t)self->x[k] * keep + (1L << 29)) >> 30);
    }
}

void selfcal_kernel_restart(selfcal_t *self, size_t k, selfcal_wide_t c) {
    const int exponent = self->integers.scale[k % self->model->axes].exponent;
    self->x[k] = 0;
    self->b[k] = 0;
    self->c[k] = (selfcal_total_t)ldexp(c, -2 * exponent - 16);
}

void selfcal_kernel_view(const selfcal_t *self, size_t j, uint8_t axis, selfcal_wide_t *b, selfcal_wide_t *c,
                         selfcal_wide_t *x) {
    const size_t k = cell_of(self, j, axis);
    if (self->columns != NULL) {
        const selfcal_reading_t *reading = &self->columns->reading[k];
        *b = sum_value(reading->b);
        *c = sum_value(reading->c);
        *x = sum_value(reading->x);
        return;
    }
    const int exponent = self->integers.scale[axis].exponent;
    *b = ldexp((selfcal_wide_t)self->b[k], exponent - 6 - b_bits(&self->node[j]));
    *c = ldexp((selfcal_wide_t)self->c[k], 2 * exponent + 16);
    *x = ldexp((selfcal_wide_t)self->x[k], exponent);
}

reading_sums_t selfcal_kernel_reading(const selfcal_t *self, size_t at) {
    const reading_sums_t sums = {&self->columns->reading[at].b, &self->columns->reading[at].c};
    return sums;
}

selfcal_sum_t selfcal_kernel_reading_drift(const selfcal_t *self, size_t at) {
    return self->columns->reading[at].x;
}

void selfcal_kernel_set_reading_drift(selfcal_t *self, size_t at, selfcal_sum_t x) {
    self->columns->reading[at].x = x;
}

reading_sums_t selfcal_kernel_state_sums(const selfcal_t *self, size_t j, size_t index, size_t axis) {
    (void)j;
    selfcal_sum_t *bc = &self->terms->bc[cell_of(self, index, axis) * SELFCAL_STATE_SUMS];
    const reading_sums_t sums = {bc, bc + 1};
    return sums;
}

/* --- invariants --- */

#define MOST_SUM ((int64_t)1 << 62)
#define MOST_X (LIMIT + (1L << 24))

bool selfcal_kernel_readings_sound(const selfcal_t *self) {
    const size_t cells = (size_t)self->model->nodes * self->model->axes;
    for (size_t k = 0; k < cells; k++) {
        const selfcal_reading_t *reading = &self->columns->reading[k];
        if (!finite_sum(reading->b) || !finite_sum(reading->c) || !finite_sum(reading->x) ||
            !(reading->c.hi >= R(0.0))) {
            return false;
        }
    }
    return true;
}

/* Whether the steps are those that the readings of their span make. */
static bool steps_are_sound(const selfcal_t *self) {
    if (self->integers.step_from > self->integers.step_to || self->integers.step_to > SELFCAL_BATCH ||
        !(self->integers.step_beta >= 0.0F) || !(self->integers.step_beta < 1.0F)) {
        return false;
    }
    const uint32_t shift = gain_shift(self->integers.step_beta),
                   count = self->integers.step_to - self->integers.step_from;
    const int32_t mantissa = to_fixed(self->integers.step_beta, (int)shift + 14);
    for (size_t axis = 0; axis < self->model->axes && count > 0U; axis++) {
        const int32_t *y = &self->integers.y[axis][self->integers.step_from], *d = self->integers.step[axis];
        int32_t held = 0;
        for (uint32_t i = 0; i < count; i++) {
            if (d[i] != y[i] - held) {
                return false;
            }
            held = y[i] - part_of(mantissa, shift, y[i]);
        }
        if (d[count] != held) {
            return false;
        }
    }
    return true;
}

bool selfcal_kernel_sound(const selfcal_t *self) {
    for (uint8_t axis = 0; axis < self->model->axes; axis++) {
        const selfcal_scale_t *scale = &self->integers.scale[axis];
        if (scale->exponent < -200 || scale->exponent > 200 || scale->most_y < 0 || scale->most_sum < 0) {
            return false;
        }
        for (uint32_t i = 0; i < SELFCAL_BATCH; i++) {
            if (self->integers.y[axis][i] > LIMIT || self->integers.y[axis][i] < -LIMIT) {
                return false;
            }
        }
    }
    return steps_are_sound(self);
}

/* A level node's numbers follow from its gains. */
bool selfcal_kernel_node_sound(const selfcal_t *self, size_t j) {
    const selfcal_node_t *node = &self->node[j];
    if (node->level) {
        selfcal_node_t settled = *node;
        set_mantissas(&settled);
        if (settled.gains.settled.g != node->gains.settled.g || settled.gains.settled.u != node->gains.settled.u ||
            settled.gains.settled.w != node->gains.settled.w || settled.g_shift != node->g_shift ||
            settled.u_shift != node->u_shift || settled.w_shift != node->w_shift) {
            return false;
        }
    }
    const size_t axes = self->model->axes;
    for (size_t k = j * axes; k < (j + 1U) * axes; k++) {
        if (self->b[k] > MOST_SUM || self->b[k] < -MOST_SUM || self->c[k] < 0 || self->c[k] > MOST_SUM ||
            self->x[k] > MOST_X || self->x[k] < -MOST_X) {
            return false;
        }
    }
    return true;
}

#else
typedef int selfcal_no_fixed_kernel_t; /* C99 wants a declaration in every file */
#endif
