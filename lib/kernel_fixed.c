/* The kernel in integers, for parts without an FPU: every axis of one node through a span.
 *
 * INPUT SCALING  y and the drift x are int32 in steps of 2^exponent unit, one exponent an axis, chosen by the data since no model
 *   knows the noise: the first batch sets it so that the white noise seen there is 2^20 to 2^21 steps (one is 5e-7 to 1e-6 sigma).
 *   Where |y| would pass LIMIT = 3 * 2^25 steps (48 to 96 sigma of drift and offset) the step doubles, as often as it takes; where
 *   the readings keep below 2^17 steps it shrinks again by 16. x, B and C are rescaled with it. So nothing saturates;
 *   selfcal_scale() tells how often it happened. What the range and the priors make of it is in the generated
 *   SELFCAL_MODEL_EXPONENTS: by |y| < 2 range, 2^exponent <= 4 range / LIMIT; by the noise, sigma <= sqrt(2) range.
 * HEAD-ROOM  Each function states its own; all rest on
 *     |y| <= LIMIT < 2^26.6                by selfcal_kernel_load()
 *     |x| < LIMIT + 2^24                   x' = (1 - g) x + (g - beta) y with beta <= g <= 1 keeps x among the y and 0, up to the
 *                                          rounding: one step a sample against the pull of g, less than 2^24 steps for g >= 2^-23
 *     |nu| = |y - x| < 2 LIMIT + 2^24 < 2^28
 *     u/s < 2^(11 - b_bits), 1/s <= 2^10   s >= r + P, r >= 2^-10; P >= q, and 1 + p_inf <= 2 + q (b_bits())
 *     a span has 16 samples at most.
 *   None of it depends on the length of the record: sums that fill up make room for themselves (SUMS).
 *   tests/c/fixed/test_fixed.c drives each there under UBSan.
 * GUARD BITS  Rounding to a step moves x by 0.3/sqrt(g) steps. Errors e of nu that are independent between nodes move each
 *   ln-likelihood by sqrt(n) e/sigma nats: 3e-4 at n = 10^5 for e = 1 step, 1e-3 at 10^6; where the step has grown, that much more.
 *   Rounding a square's argument to 4 steps, the most that is done, adds 4^2/12 steps^2 to it on the average: 2^-39 of sigma^2,
 *   and the same for all nodes.
 * SUMS  int64. B in 2^-(6 + b_bits) steps: a sample adds < 2^(28 + 6 + 11) = 2^45, at r = 1 in real records 2^28. C in 2^16 steps^2:
 *   a sample adds < 2^(56 + 10 - 16) = 2^50, at r = 1 in real records 2^26. The step doubles with the next batch once |B| or C has
 *   reached 2^61, which halves B and quarters C: neither passes 2^61 + 2^54. In real records that is never: C takes 2^35 samples,
 *   and the count is 32 bits. How long a record keeps its accuracy is another matter: GUARD BITS, selfcal.h at SELFCAL_FIXED.
 *
 * Gains come in float from bank.c and become mantissa * 2^-shift here: once a span and node, for a level node once for all.
 * >> of a negative number must be arithmetic, as it is with every compiler of these parts. */
#include "kernel.h"

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

/* --------------------------------------------------------------------------------------------------- numbers from float */

/* The shift with which a value has `bits` bits before the binary point: 2^(bits - 1) <= |value| 2^shift < 2^bits. At most 62. */
static int mantissa_shift(float value, int bits) {
    const int shift = 126 + bits - (int)((float_bits(value) >> 23) & 0xFFU);
    return shift < 62 ? shift : 62;
}

/* value / 2^shift rounded to nearest, 1 <= shift <= 63. Sums that floors went into would be off by half a unit a batch. */
static inline int64_t scaled(int64_t value, uint32_t shift) {
    return ((value >> (shift - 1U)) + 1) >> 1;
}

/* u/s < 2^(1 - b_bits) with whole blocks: u <= 1, and s >= 1 + P, where P >= q (bank.c) and p_inf <= 1 + q. */
static int b_bits(const selfcal_node_t *node) {
    const selfcal_real_t p = node->beta > R(0.0) ? node->p_inf : node->q;
    return -mantissa_shift(R(1.0) + p, 1);
}

/* -------------------------------------------------------------------------------------------------------------- scales */

static int32_t larger(int32_t a, int32_t b) {
    return a > b ? a : b;
}

/* |sum| in 2^32, rounded down. */
static inline int32_t high(int64_t sum) {
    const int32_t bits = (int32_t)(sum >> 32);
    return bits < 0 ? ~bits : bits;
}

/* Makes the step of an axis 2^bits times as large, 1 to 30, or smaller by FINER_BITS: may_be_finer() has seen to the room. x is
 * rounded to nearest, B and C lose less than one of their units. */
static void rescale(selfcal_t *self, uint8_t axis, int bits) {
    const size_t axes = self->model->axes;
    const size_t cells = self->model->nodes * axes;
    selfcal_scale_t *scale = &self->scale[axis];
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
        if (self->x[k] > FEW_STEPS || self->x[k] < -FEW_STEPS || self->b[k] > room || self->b[k] < -room || self->c[k] > room) {
            return false;
        }
    }
    return true;
}

void selfcal_kernel_start(selfcal_t *self, uint8_t axis, selfcal_real_t ln_sigma) {
    self->scale[axis].exponent = (int16_t)(floorf(ln_sigma * R(1.44269504)) - SIGMA_BITS); /* log2(e) */
}

const selfcal_scale_t *selfcal_scale(const selfcal_t *self, uint8_t axis) {
    SELFCAL_ASSERT(axis < self->model->axes);
    return &self->scale[axis];
}

/* Rounds y to steps, after making the step so coarse that |y| <= LIMIT and that a full sum has room again. */
void selfcal_kernel_load(selfcal_t *self) {
    const selfcal_batch_t *batch = waiting(self);
    self->step_from = self->step_to = 0U;
    for (uint8_t axis = 0; axis < self->model->axes; axis++) {
        selfcal_scale_t *scale = &self->scale[axis];
        float peak = 0.0F;
        for (uint32_t i = 0; i < batch->count; i++) {
            peak = r_fmax(peak, r_fabs(batch->y[axis][i]));
        }
        int bits = scale->most_sum >= FULL ? 1 : 0;
        while (to_fixed(peak, -scale->exponent - bits) > LIMIT) {
            if (++bits == MOST_COARSER) {
                rescale(self, axis, bits);
                bits = 0;
            }
        }
        if (bits > 0) {
            rescale(self, axis, bits);
        } else if (peak > 0.0F && to_fixed(peak, -scale->exponent) < FEW_STEPS && may_be_finer(self, axis)) {
            rescale(self, axis, -FINER_BITS);
        }
        for (uint32_t i = 0; i < batch->count; i++) {
            self->y_fixed[axis][i] = to_fixed(batch->y[axis][i], -scale->exponent);
        }
        const int32_t most = to_fixed(peak, -scale->exponent);
        scale->most_y = most > scale->most_y ? most : scale->most_y;
    }
}

/* What a span adds to the sums of a cell. */
static inline void add_sums(selfcal_t *self, size_t k, size_t axis, int64_t b, int64_t c) {
    self->b[k] += b;
    self->c[k] += c;
    selfcal_scale_t *scale = &self->scale[axis];
    const int32_t most_b = high(self->b[k]), most_c = (int32_t)(self->c[k] >> 32);
    if (most_b > scale->most_sum) {
        scale->most_sum = most_b;
    }
    if (most_c > scale->most_sum) {
        scale->most_sum = most_c;
    }
}

/* ------------------------------------------------------------------------------------------------------- any node */

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

/* 32-bit products, in 64 bits; x is rounded to nearest, and so are the span's sums. Per sample g, u/s, 1/s and beta with mantissas
 * below 2^30. One shift a span for g and beta and one for u/s; 1/s has its own, since it grows a millionfold in the first samples of
 * some nodes:
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
            const int32_t y = self->y_fixed[axis][i];
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

/* --------------------------------------------------------------------------------------------------------- level nodes */

/* Predicting nu needs one product a sample and node:
 *   nu_i = d_i + nu_(i-1) - g nu_(i-1),   d_i = y_i - y_(i-1) + beta y_(i-1),
 * where d is common to the nodes of one pole: hence their order. It starts from -x with d_0 = y_0, and d_count = y - beta y of the
 * last gives x = d_count - (nu - g nu). |d| < 3 LIMIT < 2^29. */
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

/* What a span adds: the sum of nu in 2^SUM_BITS steps, the sum of nu^2 in 2^16 steps^2. */
typedef struct {
    int64_t b;
    uint64_t c;
} level_sums_t;

#if SELFCAL_FIXED == 16

/* A number of steps, |v| < 2^28: v = 2^14 hi + 4 lo + (0 to 3), |hi| < 2^14, 0 <= lo < 2^12. */
#define HI(v) ((v) >> 14)
#define LO(v) ((int32_t)((uint32_t)(v) << 18 >> 20))

/* Bits of g and beta: 2^16 to 2^17, hence 4e-6 of them. */
#define GAIN_BITS 17

/* mantissa 2^-(shift + 14) v for shift 1 to 31: products below 2^31 and 2^29, rounded; what falls off v first is 1.5 steps
 * of nu on the average, the same for all. */
static inline int32_t part_of(int32_t mantissa, uint32_t shift, int32_t v) {
    return (mantissa * HI(v) + (mantissa * LO(v) >> 12) + (int32_t)(1U << (shift - 1U))) >> shift;
}

#define SUM_BITS 2

/* g nu is rounded down here; that leaves half a step too much in nu, which every second d makes up for. */
#define FLOORED true

/* 16-bit products, in 32 bits; nu^2 is summed over nu rounded down to 4 steps. Sums over up to 16 samples of
 *   nu/4 2^30, hi^2 < 16 * (2^27.6 / 2^14)^2 < 2^32, |hi lo| < 2^30, lo^2 2^28;
 *   nu/4 = 2^12 hi + lo, (nu/4)^2 = 2^24 hi^2 + 2^13 hi lo + lo^2: nothing is rounded. */
static level_sums_t run_level(const selfcal_node_t *node, const int32_t *d, uint32_t count, int32_t *x) {
    const int32_t g = node->gains.settled.g;
    const uint32_t shift = node->g_shift;
    const int32_t *const end = d + count;
    int32_t v = -*x, sum = 0, cross = 0;
    uint32_t square = 0, square_lo = 0;
    do {
        v += *d++;
        sum += v >> 2;
        const int32_t hi = HI(v), lo = LO(v);
        square += (uint32_t)(hi * hi);
        cross += hi * lo;
        square_lo += (uint32_t)(lo * lo);
        v -= (g * hi + (g * lo >> 12)) >> shift;
    } while (d < end);
    *x = *end - v;
    const int32_t rest = 2 * cross + (int32_t)((square_lo + 0x800U) >> 12);
    const level_sums_t sums = {sum, ((uint64_t)square << 12) + (uint64_t)(int64_t)rest};
    return sums;
}

#else

#define GAIN_BITS 30
#define FLOORED false
#define SUM_BITS 0

/* mantissa 2^-(shift + 14) v, rounded; the product is below 2^58. */
static inline int32_t part_of(int32_t mantissa, uint32_t shift, int32_t v) {
    return (int32_t)(((int64_t)mantissa * v + ((int64_t)1 << (shift + 13U))) >> (shift + 14U));
}

/* 32-bit products, in 64 bits; g nu is rounded to nearest. Sums over up to 16 samples: nu 2^32 (times u/s with 30 bits 2^62),
 * nu^2 < 2^60. */
static level_sums_t run_level(const selfcal_node_t *node, const int32_t *d, uint32_t count, int32_t *x) {
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

#endif

static uint32_t gain_shift(float gain) {
    const int shift = mantissa_shift(gain, GAIN_BITS) - 14;
    return shift < 31 ? (uint32_t)shift : 31U;
}

void selfcal_kernel_settle(selfcal_t *self, size_t j) {
    selfcal_kernel_mantissas(&self->node[j]);
}

void selfcal_kernel_mantissas(selfcal_node_t *node) {
    const selfcal_sum_t inv_s = steady_inv_s(node);
    const selfcal_real_t g = steady_g(node), u = inv_s.hi * node->u_inf;
    const selfcal_real_t u_lo = r_fma_exact(inv_s.hi, node->u_inf, -u) + inv_s.lo * node->u_inf;
    node->g_shift = (uint8_t)gain_shift(g);
    node->gains.settled.g = to_fixed(g, node->g_shift + 14);
    const int u_shift = mantissa_shift(u, 30);
    node->gains.settled.u = to_fixed(u, u_shift) + to_fixed(u_lo, u_shift);
    node->u_shift = (uint8_t)(u_shift - SUM_BITS - 6 - b_bits(node));
    node->w_shift = (uint8_t)mantissa_shift(inv_s.hi, 30);
    node->gains.settled.w = to_fixed(inv_s.hi, node->w_shift) + to_fixed(inv_s.lo, node->w_shift);
}

void selfcal_kernel_unsettle(selfcal_t *self, size_t j) {
    self->node[j].gains.moving = moving_of(&self->node[j]);
}

/* `floored`: the nodes round g nu down. */
static void make_steps(selfcal_t *self, span_t span, float beta, bool floored) {
    if (self->step_from == span.from && self->step_to == span.to && self->step_beta == beta && self->step_floored == floored) {
        return;
    }
    self->step_from = span.from;
    self->step_to = span.to;
    self->step_beta = beta;
    self->step_floored = floored;
    const uint32_t shift = gain_shift(beta);
    const int32_t mantissa = to_fixed(beta, (int)shift + 14);
    const uint32_t count = span.to - span.from;
    for (size_t axis = 0; axis < self->model->axes; axis++) {
        const int32_t *y = &self->y_fixed[axis][span.from];
        int32_t *d = self->step[axis];
        int32_t held = 0; /* phi y of the sample before */
        for (uint32_t i = 0; i < count; i++) {
            d[i] = y[i] - held - (floored ? (int32_t)(i & 1U) : 0);
            held = y[i] - part_of(mantissa, shift, y[i]);
        }
        d[count] = held;
    }
}

bool selfcal_kernel_steps_sound(const selfcal_t *self) {
    if (self->step_from > self->step_to || self->step_to > SELFCAL_BATCH || !(self->step_beta >= 0.0F) || !(self->step_beta < 1.0F)) {
        return false;
    }
    const uint32_t shift = gain_shift(self->step_beta), count = self->step_to - self->step_from;
    const int32_t mantissa = to_fixed(self->step_beta, (int)shift + 14);
    for (size_t axis = 0; axis < self->model->axes && count > 0U; axis++) {
        const int32_t *y = &self->y_fixed[axis][self->step_from], *d = self->step[axis];
        int32_t held = 0;
        for (uint32_t i = 0; i < count; i++) {
            if (d[i] != y[i] - held - (self->step_floored ? (int32_t)(i & 1U) : 0)) {
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
        const level_sums_t sums = run_level(node, self->step[axis], count, &self->x[k]);
        const int64_t b = node->gains.settled.u != 0 ? scaled(sums.b * node->gains.settled.u, node->u_shift) : 0;
        add_sums(self, k, axis, b, weigh(sums.c, (uint32_t)node->gains.settled.w, node->w_shift));
    }
}

void selfcal_kernel_level(selfcal_t *self, span_t span, size_t from, size_t to) {
    for (size_t i = from; i < to; i++) {
        const size_t j = kernel_node(self, i);
        const selfcal_node_t *node = &self->node[j];
        if (node->level) {
            make_steps(self, span, node->beta, FLOORED && node->gains.settled.g != 0);
            level_node(self, j, span.to - span.from);
        }
    }
}

/* ----------------------------------------------------------------------------------------------------------- the rest */

static selfcal_total_t faded(selfcal_total_t sum, selfcal_wide_t keep) {
    return (selfcal_total_t)(keep * (selfcal_wide_t)sum + (sum < 0 ? -0.5 : 0.5));
}

void selfcal_kernel_fade(selfcal_t *self, size_t j, selfcal_wide_t keep_b, selfcal_wide_t keep_c) {
    const size_t axes = self->model->axes;
    for (size_t k = j * axes; k < (j + 1U) * axes; k++) {
        self->b[k] = faded(self->b[k], keep_b);
        self->c[k] = faded(self->c[k], keep_c);
    }
}

void selfcal_kernel_gap(selfcal_t *self, size_t j, selfcal_wide_t less) {
    const int32_t keep = (int32_t)((1.0 - less) * (selfcal_wide_t)(1L << 30));
    const size_t axes = self->model->axes;
    for (size_t k = j * axes; k < (j + 1U) * axes; k++) {
        self->x[k] = (int32_t)(((int64_t)self->x[k] * keep + (1L << 29)) >> 30);
    }
}

void selfcal_kernel_view(const selfcal_t *self, size_t k, selfcal_wide_t *b, selfcal_wide_t *c, selfcal_wide_t *x) {
    const int exponent = self->scale[k % self->model->axes].exponent;
    *b = ldexp((selfcal_wide_t)self->b[k], exponent - 6 - b_bits(&self->node[k / self->model->axes]));
    *c = ldexp((selfcal_wide_t)self->c[k], 2 * exponent + 16);
    *x = ldexp((selfcal_wide_t)self->x[k], exponent);
}

#endif
