/* A node in a report (lib/report_node.c): profile ln-likelihood and sigma_v's mode, against a dense search of the
 * bank's own ln-likelihood (test_bank.c has it against the normal density). */
#include "one_axis.h"

static selfcal_axis_t axis;
static selfcal_work_t work;
static selfcal_report_t report;

void setUp(void) {
    choose(WALK_LAW);
    axis = model.axis[0];
    model.axis = &axis;
}

void tearDown(void) {}

static double ln_p(uint16_t node, double ln_sigma) {
    selfcal_wide_t value = 0.0;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_log_likelihood(&bank, 0, node, exp(ln_sigma), &value));
    return value;
}

/* The highest point, by golden section between two that enclose it. */
static double highest(uint16_t node, double lo, double hi) {
    while (hi - lo > 1e-8) {
        const double a = hi - 0.6180339887498949 * (hi - lo), b = lo + 0.6180339887498949 * (hi - lo);
        if (ln_p(node, a) > ln_p(node, b)) {
            hi = b;
        } else {
            lo = a;
        }
    }
    return 0.5 * (lo + hi);
}

/* Profiles are kept relative to the best node's in float, the best one's whole: 1e-6 of some hundred nats. The mode:
 * turns end at 1e-5 of sigma_v^2. */
static void every_node_has_its_mode(float bias_sd, float level) {
    axis.bias_sd = bias_sd;
    begin();
    for (unsigned i = 0; i < 200U; i++) {
        push(level + 0.04F * noise());
    }
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report_begin(&work, &bank, 0, &report));
    while (work.stage != SIGMA) {
        TEST_ASSERT_EQUAL(SELFCAL_BUSY, selfcal_report_step(&work, &report));
    }
    for (uint16_t node = 0; node < model.nodes; node++) {
        const double got = (double)work.field[1][node] + 0.5 * work.ln_top;
        const double mode = highest(node, got - 1.0, got + 1.0);
        TEST_ASSERT_TRUE(fabs(got - mode) < 2e-5);
        const double profile = work.top_profile + (double)work.field[0][node];
        TEST_ASSERT_TRUE(fabs(profile - ln_p(node, mode)) < 1e-5 * (100.0 + fabs(profile)));
    }
}

static void a_wide_prior(void) {
    every_node_has_its_mode(10.0F, 0.3F);
}

static void a_prior_that_pulls(void) {
    every_node_has_its_mode(0.003F, 0.004F);
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(a_wide_prior);
    RUN_TEST(a_prior_that_pulls);
    return UNITY_END();
}
