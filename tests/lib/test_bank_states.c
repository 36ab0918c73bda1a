/* Nodes of laws that are sums (lib/bank_states.c). Truth: the textbook's Kalman filter of the law that the sum is. */
#include "textbook.h"

static selfcal_law_t law;

void setUp(void) {
    draw_readings();
    choose(MARKOV_LAW);
    law = *hypothesis.law;
    hypothesis.law = &law;
    model.states = &selfcal_states_code;
}

void tearDown(void) {}

/* A Gauss-Markov drift of other deviation and bandwidth than the parameters'. */
static void every_node_is_the_textbooks_filter(double deviation, double bandwidth) {
    law.term[0].deviation = (float)deviation;
    law.term[0].bandwidth = (float)bandwidth;
    TEST_ASSERT_TRUE(selfcal_law_is_sum(&law));
    begin();
    push_readings();
    for (uint16_t node = 0; node < model.nodes; node++) {
        selfcal_node_view_t got;
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_node(&bank, 0, node, &got));
        const double rho_sq = deviation * deviation * exp(2.0 * got.ln_rho);
        const double phi = exp(-bandwidth * exp(got.ln_alpha));
        const selfcal_node_view_t want = textbook(phi, rho_sq * (1.0 - phi * phi), rho_sq);
        assert_textbook(&want, &got, rho_sq);
    }
}

static void twice_the_bandwidth(void) {
    every_node_is_the_textbooks_filter(1.0, 2.0);
}

static void a_third_of_the_deviation(void) {
    every_node_is_the_textbooks_filter(0.375, 1.0);
}

/* The sums become a likelihood: a normal density, the bias integrated out, as for every node (bank.c). In nats of 500
 * samples of float innovations: 1e-3. */
static void their_likelihood_is_the_normal_density(void) {
    const double factor = exp2(-1.0);
    law.term[0].bandwidth = 1.0F;
    law.term[0].deviation = (float)factor;
    begin();
    push_readings();
    for (uint16_t node = 0; node < model.nodes; node += 7U) {
        selfcal_node_view_t view;
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_node(&bank, 0, node, &view));
        const double rho_sq = factor * factor * exp(2.0 * view.ln_rho), phi = exp(-exp(view.ln_alpha));
        const selfcal_node_view_t want = textbook(phi, rho_sq * (1.0 - phi * phi), rho_sq);
        const double sigma_sq = 0.0016, p0 = (double)model.axis[0].bias_sd * (double)model.axis[0].bias_sd;
        /* the bias's prior is about 0, the sums about the first reading */
        const double offset = (double)reading[0], precision = 1.0 / p0, level = want.b / sigma_sq - offset * precision;
        const double quadratic =
            want.c / sigma_sq + offset * offset * precision - level * level / (want.a / sigma_sq + precision);
        const double n = TEXTBOOK_SAMPLES, two_pi = 6.283185307179586;
        const double want_ln =
            -0.5 * (n * log(two_pi * sigma_sq) + want.ln_s + log1p(p0 * want.a / sigma_sq) + quadratic);
        selfcal_wide_t got = 0.0;
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_log_likelihood(&bank, 0, node, 0.04, &got));
        TEST_ASSERT_TRUE(fabs(got - want_ln) < 1e-3 + 2e-6 * fabs(quadratic));
    }
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(twice_the_bandwidth);
    RUN_TEST(a_third_of_the_deviation);
    RUN_TEST(their_likelihood_is_the_normal_density);
    return UNITY_END();
}
