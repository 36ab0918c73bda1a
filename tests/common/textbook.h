/* A record of one axis with gaps through a bank and through the textbook's Kalman filter in double. */
#ifndef TEXTBOOK_H
#define TEXTBOOK_H

#include "one_axis.h"

enum { TEXTBOOK_SAMPLES = 500 };

static float reading[TEXTBOOK_SAMPLES];

static inline void draw_readings(void) {
    state = 7U;
    float drift = 0.0F;
    for (unsigned i = 0; i < TEXTBOOK_SAMPLES; i++) {
        drift += 0.004F * noise();
        reading[i] = 9.8F + drift + 0.04F * noise();
    }
}

/* Before these samples so many intervals are missing. */
static inline unsigned missing(unsigned i) {
    return i % 97U == 50U ? 3U : i == 333U ? 400U : 0U;
}

static inline void push_readings(void) {
    for (unsigned i = 0; i < TEXTBOOK_SAMPLES; i++) {
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_skip(&bank, missing(i)));
        push(reading[i]);
    }
}

/* Over the readings less the first, and over "1": x = phi x + w, var w = q, P the predicted variance, of the first
 * reading q or the whole; all over sigma_v^2. */
static inline selfcal_node_view_t textbook(double phi, double q, double p) {
    selfcal_node_view_t s = {0, NAN, NAN, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
    double x = 0.0, one = 0.0;
    for (unsigned i = 0; i < TEXTBOOK_SAMPLES; i++) {
        for (unsigned k = i == 0U ? 0U : missing(i) + 1U; k > 0U; k--) {
            x *= phi;
            one *= phi;
            p = phi * phi * p + q;
        }
        const double nu = ((double)reading[i] - (double)reading[0]) - x, u = 1.0 - one, variance = 1.0 + p;
        s.a += u * u / variance;
        s.b += u * nu / variance;
        s.c += nu * nu / variance;
        s.ln_s += log(variance);
        x += p / variance * nu;
        one += p / variance * u;
        p -= p * p / variance;
    }
    s.drift = x;
    s.bias_left = 1.0 - one;
    s.drift_var = p;
    return s;
}

/* Each sum against its own size; B's is sqrt(A C). Float innovations of 6e-8, whose errors a filter remembers for 1/g
 * samples: measured 2e-6 at most. The drift's variance is a prediction less q, a float of size rho^2. */
static inline void assert_textbook(const selfcal_node_view_t *want, const selfcal_node_view_t *got, double rho_sq) {
    TEST_ASSERT_TRUE(close_to(want->a, got->a, 1e-5));
    TEST_ASSERT_TRUE(close_to(want->c, got->c, 1e-5));
    TEST_ASSERT_TRUE(fabs(want->b - got->b) < 1e-5 * sqrt(want->a * want->c));
    TEST_ASSERT_TRUE(fabs(want->ln_s - got->ln_s) < 1e-5 * (1.0 + want->ln_s));
    TEST_ASSERT_TRUE(fabs(want->drift - got->drift) < 1e-5);
    TEST_ASSERT_TRUE(fabs(want->bias_left - got->bias_left) < 1e-5);
    TEST_ASSERT_TRUE(fabs(want->drift_var - got->drift_var) < 1e-5 + 6e-8 * rho_sq);
}

#endif
