/* The bias after the report (lib/predict.c), against the moments of each law in closed form. */
#include "one_axis.h"

static selfcal_report_t report;

void setUp(void) {
    memset(&report, 0, sizeof report);
    report.hypothesis[0].probability = 1.0F;
    report.bias_mean = report.hypothesis[0].bias_mean = 9.81F;
    report.hypothesis[0].bias_sd = 0.02F;
}

void tearDown(void) {}

/* A float near 9.81 has steps of 1e-6: so far off is the mean, and a law's distance from it. */
static void check(float elapsed_s, double mean, double variance) {
    float bias = 0.0F, sd = 0.0F;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_predict(&report, &model, elapsed_s, &bias, &sd));
    TEST_ASSERT_FLOAT_WITHIN(2e-6F, (float)mean, bias);
    TEST_ASSERT_FLOAT_WITHIN(1e-6F, (float)sqrt(variance), sd);
}

static void a_constant_stays(void) {
    choose(CONSTANT_LAW);
    check(0.0F, 9.81, 4e-4);
    check(1e6F, 9.81, 4e-4);
}

/* E(K^2) a second. */
static void a_walk_spreads(void) {
    choose(WALK_LAW);
    report.hypothesis[0].parameter[SELFCAL_K].mean = 3e-3F;
    report.hypothesis[0].parameter[SELFCAL_K].sd = 4e-3F;
    check(0.0F, 9.81, 4e-4);
    check(100.0F, 9.81, 4e-4 + 2.5e-5 * 100.0);
}

/* x0 ~ N(9.5, 0.01^2) and beside it a drift ~ N(0.31, v) that decays at alpha towards N(0, s^2): the mean goes to
 * 9.5 + e^(-alpha t) 0.31, the variance to 0.01^2 + e^(-2 alpha t) v + (1 - e^(-2 alpha t)) s^2. */
static void a_decaying_drift_goes_home(void) {
    choose(MARKOV_LAW);
    const double v = 3e-4, s_sq = 1e-2, drift = 0.31, alpha = 1.0 / 128.0;
    selfcal_decay_t *decay = &report.hypothesis[0].decay[0];
    decay->alpha = (float)alpha;
    decay->mean[0] = (float)drift;
    decay->var[0] =
        (float)(2.0 * (s_sq - v)); /* report_bias.c: what is linear and what is square in 1 - e^(-alpha t) */
    decay->var_sq[0] = (float)(v - s_sq + drift * drift);
    static const float times[] = {0.0F, 10.0F, 128.0F, 2000.0F};
    for (unsigned i = 0; i < 4U; i++) {
        const double left = exp(-alpha * (double)times[i]);
        check(times[i], 9.5 + left * drift, 1e-4 + left * left * v + (1.0 - left * left) * s_sq);
    }
}

/* Of two laws: the mixture's moments. A law without probability may have no numbers. */
static void laws_are_mixed(void) {
    choose(CONSTANT_LAW);
    selfcal_hypothesis_t three[3] = {hypothesis, hypothesis, hypothesis};
    model.hypothesis = three;
    model.hypotheses = 3;
    report.hypothesis[0].probability = 0.25F;
    report.hypothesis[1].probability = 0.75F;
    report.hypothesis[1].bias_mean = 9.87F;
    report.hypothesis[1].bias_sd = 0.04F;
    report.hypothesis[2].bias_mean = report.hypothesis[2].bias_sd = NAN;
    report.bias_mean = 9.855F;
    check(50.0F, 9.855, 0.25 * 4e-4 + 0.75 * 16e-4 + 0.25 * 0.75 * 0.06 * 0.06);
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(a_constant_stays);
    RUN_TEST(a_walk_spreads);
    RUN_TEST(a_decaying_drift_goes_home);
    RUN_TEST(laws_are_mixed);
    return UNITY_END();
}
