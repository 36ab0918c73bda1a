/* The kernel in selfcal_real_t: every axis of one node through a span. Sums of a span are short enough for selfcal_real_t; they
 * go into the long ones scaled in full. */
#include "kernel.h"

#ifndef SELFCAL_FIXED

void selfcal_kernel_run(selfcal_t *self, size_t j, const gains_t *gains) {
    const span_t span = gains->span;
    const selfcal_batch_t *batch = waiting(self);
    const selfcal_real_t minus_beta = -self->node[j].beta;
    const size_t axes = self->model->axes;
    for (size_t axis = 0; axis < axes; axis++) {
        const size_t k = j * axes + axis;
        selfcal_real_t x = self->x[k], b = R(0.0), c = R(0.0);
        for (uint32_t i = span.from; i < span.to; i++) {
            const selfcal_real_t y = batch->y[axis][i];
            const selfcal_real_t nu = y - x;
            b = r_fma(gains->u[i], nu, b);
            c = r_fma(nu, nu * gains->inv_s[i], c);
            x = r_fma(minus_beta, y, r_fma(gains->g[i], nu, x));
        }
        self->x[k] = x;
        sum_add_scaled(&self->b[k], gains->scale, b);
        sum_add_scaled(&self->c[k], gains->scale, c);
    }
}

/* A level node's sums are held as plain sums of nu and nu^2: B over u/s, C over 1/s. Where u is 0 its B stays as it is. */
static selfcal_sum_t times(selfcal_sum_t sum, selfcal_sum_t factor) {
    selfcal_sum_t product = {R(0.0), R(0.0)};
    sum_add_scaled(&product, factor, sum.hi);
    sum_add(&product, factor.hi * sum.lo, R(0.0));
    return product;
}

static void rescale(selfcal_t *self, size_t j, bool level) {
    const selfcal_node_t *node = &self->node[j];
    const selfcal_wide_t s = 1.0 + (selfcal_wide_t)node->p_inf, u = (selfcal_wide_t)node->u_inf;
    const selfcal_sum_t of_c = make_sum(level ? s : 1.0 / s);
    const selfcal_sum_t of_b = make_sum(u > 0.0 ? level ? s / u : u / s : 1.0);
    const size_t axes = self->model->axes;
    for (size_t k = j * axes; k < (j + 1U) * axes; k++) {
        self->c[k] = times(self->c[k], of_c);
        self->b[k] = times(self->b[k], of_b);
    }
}

void selfcal_kernel_settle(selfcal_t *self, size_t j) {
    rescale(self, j, true);
}

void selfcal_kernel_unsettle(selfcal_t *self, size_t j) {
    rescale(self, j, false);
}

/* Four samples: x goes on, sums of nu and nu^2 are added. By fours, which keeps the sums short: squares of lattice values would
 * round to one side (1e-7 of C, seen with 64 in a row). */
typedef struct {
    selfcal_real_t x, b, c;
} track_t;

static inline track_t run_four(track_t t, const selfcal_real_t y[4], selfcal_real_t g, selfcal_real_t minus_beta) {
    const selfcal_real_t y0 = y[0], y1 = y[1], y2 = y[2], y3 = y[3];
    const selfcal_real_t nu0 = y0 - t.x;
    t.x = r_fma(minus_beta, y0, r_fma(g, nu0, t.x));
    const selfcal_real_t nu1 = y1 - t.x;
    t.x = r_fma(minus_beta, y1, r_fma(g, nu1, t.x));
    const selfcal_real_t nu2 = y2 - t.x;
    t.x = r_fma(minus_beta, y2, r_fma(g, nu2, t.x));
    const selfcal_real_t nu3 = y3 - t.x;
    t.x = r_fma(minus_beta, y3, r_fma(g, nu3, t.x));
    t.b += (nu0 + nu1) + (nu2 + nu3);
    t.c += r_fma(nu3, nu3, r_fma(nu2, nu2, r_fma(nu1, nu1, nu0 * nu0)));
    return t;
}

#ifdef SELFCAL_KERNEL_M4F
#if SELFCAL_BATCH != 16 || defined(SELFCAL_REAL_DOUBLE) || !defined(__ARM_FP)
#error "SELFCAL_KERNEL_M4F is for a SELFCAL_BATCH of 16 in single precision"
#endif

/* run_level() of a whole batch, operation for operation and hence bit for bit: 111 instructions an axis. The batch of an axis is one
 * block load, and the pointers go on by themselves.
 * s0 x, s3 and s4 the sums of nu and nu^2, s16 to s31 the batch. */
#define M4F_FOUR(y0, y1, y2, y3, b, c)                                                               \
    "vsub.f32 s5, " y0 ", s0\n vfma.f32 s0, %[g], s5\n vfma.f32 s0, %[m], " y0 "\n vmul.f32 " c ", s5, s5\n"  \
    "vsub.f32 s6, " y1 ", s0\n vfma.f32 s0, %[g], s6\n vfma.f32 s0, %[m], " y1 "\n vfma.f32 " c ", s6, s6\n"  \
    "vadd.f32 s5, s5, s6\n"                                                                          \
    "vsub.f32 s6, " y2 ", s0\n vfma.f32 s0, %[g], s6\n vfma.f32 s0, %[m], " y2 "\n vfma.f32 " c ", s6, s6\n"  \
    "vsub.f32 s7, " y3 ", s0\n vfma.f32 s0, %[g], s7\n vfma.f32 s0, %[m], " y3 "\n vfma.f32 " c ", s7, s7\n"  \
    "vadd.f32 s6, s6, s7\n vadd.f32 " b ", s5, s6\n"
#define M4F_MORE(y0, y1, y2, y3) \
    M4F_FOUR(y0, y1, y2, y3, "s8", "s9") "vadd.f32 s3, s3, s8\n vadd.f32 s4, s4, s9\n"
/* sum_add_value() */
#define M4F_ADD(sum, value)                                                                           \
    "vldr s5, [" sum "]\n vldr s6, [" sum ", #4]\n vadd.f32 s7, s5, " value "\n vsub.f32 s8, s7, s5\n"       \
    "vsub.f32 s9, s7, s8\n vsub.f32 s5, s5, s9\n vsub.f32 s8, " value ", s8\n vadd.f32 s5, s5, s8\n"         \
    "vadd.f32 s5, s5, s6\n vadd.f32 s8, s7, s5\n vsub.f32 s7, s8, s7\n vsub.f32 s9, s5, s7\n"                \
    "vstmia " sum "!, {s8-s9}\n"

static inline void run_level_whole(const float *y, float *x, selfcal_sum_t *b, selfcal_sum_t *c, float g, float minus_beta, size_t axes) {
    __asm__ volatile("1:\n"
                     "vldr s0, [%[x]]\n"
                     "vldmia %[y]!, {s16-s31}\n"
                     M4F_FOUR("s16", "s17", "s18", "s19", "s3", "s4")
                     M4F_MORE("s20", "s21", "s22", "s23")
                     M4F_MORE("s24", "s25", "s26", "s27")
                     M4F_MORE("s28", "s29", "s30", "s31")
                     "vstmia %[x]!, {s0}\n"
                     M4F_ADD("%[b]", "s3")
                     M4F_ADD("%[c]", "s4")
                     "subs %[axes], %[axes], #1\n"
                     "bne 1b\n"
                     : [y] "+r"(y), [x] "+r"(x), [b] "+r"(b), [c] "+r"(c), [axes] "+r"(axes)
                     : [g] "t"(g), [m] "t"(minus_beta)
                     : "s0", "s3", "s4", "s5", "s6", "s7", "s8", "s9", "s16", "s17", "s18", "s19", "s20", "s21", "s22", "s23",
                       "s24", "s25", "s26", "s27", "s28", "s29", "s30", "s31", "cc", "memory");
}
#endif

/* Nearly all samples of a long record go through here: five arithmetic instructions an axis and sample. */
static void run_level(selfcal_t *self, span_t span, size_t j) {
    const selfcal_batch_t *batch = waiting(self);
    const selfcal_node_t *node = &self->node[j];
    const selfcal_real_t minus_beta = -node->beta;
    const selfcal_real_t g = steady_g(node);
    const size_t count = span.to - span.from;
    const size_t axes = self->model->axes;
    for (size_t axis = 0; axis < axes; axis++) {
        const size_t k = j * axes + axis;
        const selfcal_real_t *y = &batch->y[axis][span.from];
        const selfcal_real_t *const end = y + count;
        track_t t = {self->x[k], R(0.0), R(0.0)};
        for (; end - y >= 16; y += 16) {
            t = run_four(t, y, g, minus_beta);
            t = run_four(t, y + 4, g, minus_beta);
            t = run_four(t, y + 8, g, minus_beta);
            t = run_four(t, y + 12, g, minus_beta);
        }
        for (; end - y >= 4; y += 4) {
            t = run_four(t, y, g, minus_beta);
        }
        for (; y < end; y++) {
            const selfcal_real_t nu = *y - t.x;
            t.b += nu;
            t.c = r_fma(nu, nu, t.c);
            t.x = r_fma(minus_beta, *y, r_fma(g, nu, t.x));
        }
        self->x[k] = t.x;
        if (node->u_inf > R(0.0)) {
            sum_add_value(&self->b[k], t.b);
        }
        sum_add_value(&self->c[k], t.c);
    }
}

void selfcal_kernel_level(selfcal_t *self, span_t span, size_t from, size_t to) {
#ifdef SELFCAL_KERNEL_M4F
    const bool whole = span.to - span.from == SELFCAL_BATCH;
    const size_t axes = self->model->axes;
    selfcal_sum_t unused[SELFCAL_AXES_MAX] = {{0.0F, 0.0F}}; /* B where u is 0 */
#endif
    for (size_t j = from; j < to; j++) {
        const selfcal_node_t *node = &self->node[j];
        if (!node->level) {
            continue;
        }
#ifdef SELFCAL_KERNEL_M4F
        if (whole) {
            const size_t k = j * axes;
            run_level_whole(waiting(self)->y[0], &self->x[k], node->u_inf > 0.0F ? &self->b[k] : unused, &self->c[k],
                            steady_g(node), -node->beta, axes);
            continue;
        }
#endif
        run_level(self, span, j);
    }
}

void selfcal_kernel_gap(selfcal_t *self, size_t j, selfcal_wide_t less) {
    const size_t axes = self->model->axes;
    for (size_t k = j * axes; k < (j + 1U) * axes; k++) {
        self->x[k] = (selfcal_real_t)((selfcal_wide_t)self->x[k] * (1.0 - less));
    }
}

void selfcal_kernel_fade(selfcal_t *self, size_t j, selfcal_wide_t keep_b, selfcal_wide_t keep_c) {
    const size_t axes = self->model->axes;
    for (size_t k = j * axes; k < (j + 1U) * axes; k++) {
        sum_fade(&self->b[k], keep_b);
        sum_fade(&self->c[k], keep_c);
    }
}

void selfcal_kernel_view(const selfcal_t *self, size_t k, selfcal_wide_t *b, selfcal_wide_t *c, selfcal_wide_t *x) {
    const selfcal_node_t *node = &self->node[k / self->model->axes];
    *b = sum_value(self->b[k]);
    *c = sum_value(self->c[k]);
    if (node->level) {
        const selfcal_wide_t per_s = 1.0 / (1.0 + (selfcal_wide_t)node->p_inf), u = (selfcal_wide_t)node->u_inf;
        *c *= per_s;
        *b *= u > 0.0 ? u * per_s : 1.0;
    }
    *x = (selfcal_wide_t)self->x[k];
}

#endif
