/* The sums of a node (lib/bank_kernel_float.c, by way of the bank). Truth: the textbook's Kalman filter in double. */
#include "textbook.h"

void setUp(void) {
    draw_readings();
}

void tearDown(void) {}

static void every_node_is_the_textbooks_filter(int kind) {
    choose(kind);
    begin();
    push_readings();
    for (uint16_t node = 0; node < model.nodes; node++) {
        selfcal_node_view_t got;
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_node(&bank, 0, node, &got));
        const double rho_sq = kind == CONSTANT_LAW ? 0.0 : exp(2.0 * got.ln_rho);
        const double phi = kind == MARKOV_LAW ? exp(-exp(got.ln_alpha)) : 1.0;
        const selfcal_node_view_t want =
            kind == MARKOV_LAW ? textbook(phi, rho_sq * (1.0 - phi * phi), rho_sq) : textbook(1.0, rho_sq, rho_sq);
        assert_textbook(&want, &got, rho_sq);
    }
}

static void no_drift(void) {
    every_node_is_the_textbooks_filter(CONSTANT_LAW);
}

static void a_walk(void) {
    every_node_is_the_textbooks_filter(WALK_LAW);
}

static void a_drift_that_decays(void) {
    every_node_is_the_textbooks_filter(MARKOV_LAW);
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(no_drift);
    RUN_TEST(a_walk);
    RUN_TEST(a_drift_that_decays);
    return UNITY_END();
}
