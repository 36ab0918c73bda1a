/* The bank and its report through the public header, against closed forms. */
#include <math.h>
#include <string.h>

#include "noise.h"
#include "selfcal_model.h"
#include "unity.h"

#define AXES SELFCAL_MODEL_AXES

static selfcal_t bank;
static selfcal_model_t model;
static selfcal_work_t work;
static selfcal_report_t report;
static selfcal_wide_t memory[SELFCAL_SIZE(SELFCAL_MODEL_NODES, AXES) / sizeof(selfcal_wide_t) + 1U];

void setUp(void) {
    model = selfcal_model;
    model.block = 1;
    model.dt_s = 1.0F;
    state = 12345U;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_init(&bank, &model, memory, sizeof memory));
}

void tearDown(void) {}

static void push(float level, float sd) {
    float sample[AXES];
    for (unsigned axis = 0; axis < AXES; axis++) {
        sample[axis] = level + sd * noise();
    }
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push(&bank, sample));
}

static void bad_arguments_change_nothing(void) {
    selfcal_t other;
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_init(NULL, &model, memory, sizeof memory));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_init(&other, NULL, memory, sizeof memory));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_init(&other, &model, NULL, sizeof memory));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_MEMORY,
                      selfcal_init(&other, &model, memory, SELFCAL_SIZE(model.nodes, model.axes) - 1U));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_MEMORY, selfcal_init(&other, &model, (char *)memory + 4, sizeof memory));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_push(&bank, NULL));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_push(NULL, (const float[AXES]){0}));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_skip(NULL, 1));
    push(0.1F, 0.01F);
    push(0.1F, 0.01F);
    /* A report that cannot begin leaves nothing of another axis. */
    memset(&report, 1, sizeof report);
    TEST_ASSERT_EQUAL(SELFCAL_TOO_SHORT, selfcal_report(&work, &bank, 0, &report));
    TEST_ASSERT_EQUAL(0, report.axis);
    TEST_ASSERT_EQUAL(0, report.n);
    TEST_ASSERT_TRUE(isnan(report.bias_mean) && isnan(report.bias_sd));
    TEST_ASSERT_EQUAL_FLOAT(0.0F, report.hypothesis[0].probability);
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_report(&work, &bank, AXES, &report));
    selfcal_node_view_t view;
    selfcal_wide_t ln_p;
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_node(&bank, AXES, 0, &view));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_node(&bank, 0, model.nodes, &view));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_log_likelihood(&bank, 0, 0, 0.0, &ln_p));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_log_likelihood(&bank, 0, 0, -1.0, &ln_p));
    float bias, sd;
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_predict(NULL, &model, 1.0F, &bias, &sd));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_predict(&report, NULL, 1.0F, &bias, &sd));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_predict(&report, &model, 1.0F, NULL, &sd));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_predict(&report, &model, 1.0F, &bias, NULL));
    TEST_ASSERT_EQUAL(2, selfcal_count(&bank));
}

/* Noise of 30 deg/s, beyond what the priors allow, within the range: no number may stand for a bias that nothing is
 * known of. */
static void a_record_outside_the_priors_has_no_bias(void) {
    for (unsigned i = 0; i < 2000U; i++) {
        push(0.0F, 30.0F);
    }
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report(&work, &bank, 0, &report));
    TEST_ASSERT_TRUE(isnan(report.bias_mean));
    TEST_ASSERT_TRUE(isnan(report.bias_sd));
    for (uint8_t h = 0; h < model.hypotheses; h++) {
        TEST_ASSERT_TRUE(isnan(report.hypothesis[h].probability));
    }
    float bias, sd;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_predict(&report, &model, 1.0F, &bias, &sd));
    TEST_ASSERT_TRUE(isnan(bias));
    TEST_ASSERT_TRUE(isnan(sd));
}

/* Short records up to 200 times louder than the priors allow: the last pass of a search may find no row as high as one
 * before it. */
static void a_loud_record_has_a_finite_bias_or_none(void) {
    static const unsigned samples[] = {5, 30, 60};
    static const float loud[] = {5.0F, 10.0F, 15.0F, 50.0F, 100.0F};
    for (size_t i = 0; i < sizeof samples / sizeof *samples * 5U; i++) {
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_init(&bank, &model, memory, sizeof memory));
        for (unsigned k = 0; k < samples[i / 5U]; k++) {
            push(0.0F, loud[i % 5U]);
        }
        for (uint8_t axis = 0; axis < AXES; axis++) {
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report(&work, &bank, axis, &report));
            TEST_ASSERT_FALSE(isinf(report.bias_mean));
            TEST_ASSERT_EQUAL(isnan(report.bias_mean), isnan(report.bias_sd));
        }
    }
}

static void models_that_contradict_themselves_are_refused(void) {
    selfcal_t other;
    selfcal_model_t bad = model;
    bad.nodes--;
    TEST_ASSERT_EQUAL(SELFCAL_BAD_MODEL, selfcal_init(&other, &bad, memory, sizeof memory));
    bad = model;
    bad.dt_s = NAN;
    TEST_ASSERT_EQUAL(SELFCAL_BAD_MODEL, selfcal_init(&other, &bad, memory, sizeof memory));
    bad = model;
    bad.axes = SELFCAL_AXES_MAX + 1;
    TEST_ASSERT_EQUAL(SELFCAL_BAD_MODEL, selfcal_init(&other, &bad, memory, sizeof memory));
    bad = model;
    bad.block = 0;
    TEST_ASSERT_EQUAL(SELFCAL_BAD_MODEL, selfcal_init(&other, &bad, memory, sizeof memory));
    static const float intervals[] = {0.0F, -1.0F, 0.9e-6F, 1.1e6F, INFINITY};
    for (unsigned i = 0; i < sizeof intervals / sizeof intervals[0]; i++) {
        bad = model;
        bad.dt_s = intervals[i];
        TEST_ASSERT_EQUAL(SELFCAL_BAD_MODEL, selfcal_init(&other, &bad, memory, sizeof memory));
    }
    static const selfcal_prior_t priors[] = {
        {-47.0F, 0.0F, SELFCAL_LOG_UNIFORM, false}, {0.0F, 47.0F, SELFCAL_LOG_UNIFORM, false},
        {1.0F, 1.0F, SELFCAL_LOG_UNIFORM, false},   {NAN, 1.0F, SELFCAL_LOG_UNIFORM, false},
        {0.0F, NAN, SELFCAL_LOG_UNIFORM, false},    {-INFINITY, 0.0F, SELFCAL_UNIFORM, false},
        {0.0F, INFINITY, SELFCAL_UNIFORM, false}};
    for (unsigned i = 0; i < sizeof priors / sizeof priors[0]; i++) {
        selfcal_axis_t axis[AXES];
        memcpy(axis, model.axis, sizeof axis);
        axis[AXES - 1U].prior[SELFCAL_SIGMA_M] = priors[i];
        bad = model;
        bad.axis = axis;
        TEST_ASSERT_EQUAL(SELFCAL_BAD_MODEL, selfcal_init(&other, &bad, memory, sizeof memory));
    }
}

/* Found by fuzzing: drift over white noise is anything here, up to 1e40. Through the longest gaps there are, with
 * blocks of every weight, nothing overflows. */
static void the_widest_priors_keep_every_sum_finite(void) {
    selfcal_axis_t axis[AXES];
    memcpy(axis, model.axis, sizeof axis);
    for (unsigned i = 0; i < AXES; i++) {
        for (unsigned p = 0; p < SELFCAL_PARAMETERS; p++) {
            axis[i].prior[p].ln_min = -46.0F;
            axis[i].prior[p].ln_max = 46.0F;
        }
    }
    model.axis = axis;
    model.block = 2;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_init(&bank, &model, memory, sizeof memory));
    for (int i = 0; i < 200; i++) {
        push(i % 50 == 0 ? 1e9F : 0.0F, i < 100 ? 0.0F : 0.02F);
        if (i % 7 == 3) {
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_skip(&bank, i % 2 == 0 ? 1U : UINT64_MAX));
        }
        if (i % 40 == 20) {
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_rate(&bank, 2, i == 60 ? SELFCAL_VARIANCE_RATIO_MAX : 1.0F));
        }
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_check(&bank));
    }
    selfcal_node_view_t view;
    for (uint16_t node = 0; node < model.nodes; node++) {
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_node(&bank, 0, node, &view));
        TEST_ASSERT_TRUE(isfinite(view.a) && isfinite(view.b) && isfinite(view.c) && isfinite(view.ln_s) &&
                         view.a > 0.0);
    }
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_check(&bank));
}

/* Node 0 is the constant law: s = 1, nu = y, so A = n, B = sum y, C = sum y^2 about the offset, D = 0. */
static void the_constant_law_sums_the_data(void) {
    selfcal_wide_t sum = 0.0, square = 0.0;
    float first = 0.0F;
    for (int i = 0; i < 1000; i++) {
        float sample[AXES];
        for (unsigned axis = 0; axis < AXES; axis++) {
            sample[axis] = 9.8F + 0.01F * noise();
        }
        if (i == 0) {
            first = sample[0];
        }
        sum += (selfcal_wide_t)sample[0] - (selfcal_wide_t)first;
        square +=
            ((selfcal_wide_t)sample[0] - (selfcal_wide_t)first) * ((selfcal_wide_t)sample[0] - (selfcal_wide_t)first);
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push(&bank, sample));
    }
    selfcal_node_view_t view;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_node(&bank, 0, 0, &view));
    TEST_ASSERT_EQUAL(0, view.hypothesis);
    TEST_ASSERT_TRUE(fabs(view.a - 1000.0) < 1e-9);
    TEST_ASSERT_TRUE(view.ln_s == 0.0);
    /* float sums of 64 before they are folded: 64 roundings of 6e-8 each */
    TEST_ASSERT_TRUE(fabs(view.b - sum) < 4e-6 * (fabs(sum) + sqrt(square)));
    TEST_ASSERT_TRUE(fabs(view.c - square) < 4e-6 * square);
    TEST_ASSERT_TRUE(selfcal_offset(&bank, 0) == (selfcal_wide_t)first);
}

/* ln p of the constant law is a normal density with covariance sigma^2 I + P0 1 1'; its determinant and quadratic form
 * are closed (Sherman-Morrison). */
static void the_likelihood_of_the_constant_law_is_the_normal_density(void) {
    enum { N = 50 };
    selfcal_wide_t sum = 0.0, square = 0.0;
    for (int i = 0; i < N; i++) {
        const float y = 0.3F + 0.04F * noise();
        float sample[AXES];
        for (unsigned axis = 0; axis < AXES; axis++) {
            sample[axis] = y;
        }
        sum += (selfcal_wide_t)y;
        square += (selfcal_wide_t)y * (selfcal_wide_t)y;
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push(&bank, sample));
    }
    const selfcal_wide_t sigma = 0.05,
                         p0 = (selfcal_wide_t)model.axis[0].bias_sd * (selfcal_wide_t)model.axis[0].bias_sd;
    const selfcal_wide_t var = sigma * sigma;
    const selfcal_wide_t expected = -0.5 * (N * log(2.0 * 3.14159265358979324 * var) + log(1.0 + N * p0 / var) +
                                            square / var - p0 * sum * sum / (var * (var + N * p0)));
    selfcal_wide_t ln_p = 0.0;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_log_likelihood(&bank, 0, 0, sigma, &ln_p));
    TEST_ASSERT_TRUE(fabs(ln_p - expected) < 1e-4); /* float sums: 64 roundings of 6e-8 on some 50 nats */
}

/* A gap of k samples told at once or one by one is the same prediction. Both ways the node's sums see the same samples;
 * only the rounding of the one-step predictions differs. */
static void a_gap_may_be_told_in_pieces(void) {
    static selfcal_wide_t memory2[sizeof memory / sizeof memory[0]];
    selfcal_t other;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_init(&other, &model, memory2, sizeof memory2));
    for (int i = 0; i < 200; i++) {
        float sample[AXES];
        for (unsigned axis = 0; axis < AXES; axis++) {
            sample[axis] = 0.1F + 0.02F * noise();
        }
        if (i == 100) {
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_skip(&bank, 37));
            for (int k = 0; k < 37; k++) {
                TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_skip(&other, 1));
            }
        }
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push(&bank, sample));
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push(&other, sample));
    }
    for (uint16_t node = 0; node < model.nodes; node++) {
        selfcal_node_view_t one, many;
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_node(&bank, 0, node, &one));
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_node(&other, 0, node, &many));
        TEST_ASSERT_TRUE(one.c == many.c && one.b == many.b && one.a == many.a && one.ln_s == many.ln_s);
    }
    TEST_ASSERT_EQUAL(1, selfcal_counters(&bank)->gaps);
    TEST_ASSERT_EQUAL(1, selfcal_counters(&other)->gaps);
    TEST_ASSERT_EQUAL(37, selfcal_counters(&other)->missing);
}

/* A gap of two hours lets every drift forget: the likelihood of what follows is that of fresh filters, so nothing may
 * blow up. */
static void a_long_gap_leaves_finite_sums(void) {
    for (int i = 0; i < 100; i++) {
        push(0.1F, 0.02F);
    }
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_skip(&bank, UINT64_C(1) << 40));
    for (int i = 0; i < 100; i++) {
        push(0.1F, 0.02F);
    }
    for (uint16_t node = 0; node < model.nodes; node++) {
        selfcal_node_view_t view;
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_node(&bank, 0, node, &view));
        TEST_ASSERT_TRUE(isfinite(view.a) && isfinite(view.b) && isfinite(view.c) && isfinite(view.ln_s) &&
                         view.a > 0.0);
    }
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report(&work, &bank, 0, &report));
    TEST_ASSERT_TRUE(isfinite(report.bias_mean) && report.bias_sd > 0.0F);
}

/* Once the nodes have their place (after SELFCAL_BATCH bank samples), reports on the way change nothing but where float
 * sums are folded: some hundred roundings of 6e-8. */
static void reports_on_the_way_do_not_change_the_sums(void) {
    selfcal_node_view_t with[SELFCAL_MODEL_NODES];
    for (int round = 0; round < 2; round++) {
        setUp();
        for (int i = 0; i < 200; i++) {
            push(0.1F, 0.02F);
            if (round == 0 && i >= SELFCAL_BATCH && i % 7 == 6) {
                TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report(&work, &bank, 1, &report));
            }
        }
        for (uint16_t node = 0; node < model.nodes; node++) {
            selfcal_node_view_t view;
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_node(&bank, 1, node, &view));
            if (round == 0) {
                with[node] = view;
                continue;
            }
            TEST_ASSERT_TRUE(view.ln_rho == with[node].ln_rho || (isnan(view.ln_rho) && isnan(with[node].ln_rho)));
            TEST_ASSERT_TRUE(fabs(view.c - with[node].c) < 1e-5 * view.c);
            TEST_ASSERT_TRUE(fabs(view.a - with[node].a) < 1e-5 * view.a);
            TEST_ASSERT_TRUE(fabs(view.ln_s - with[node].ln_s) < 1e-5 * (1.0 + fabs(view.ln_s)));
        }
    }
}

static void a_report_is_a_probability_law(void) {
    for (int i = 0; i < 500; i++) {
        push(0.1F, 0.02F);
    }
    for (uint8_t axis = 0; axis < AXES; axis++) {
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report(&work, &bank, axis, &report));
        TEST_ASSERT_EQUAL(500, report.n);
        float sum = 0.0F;
        for (unsigned h = 0; h < SELFCAL_MODEL_HYPOTHESES; h++) {
            const selfcal_posterior_t *p = &report.hypothesis[h];
            sum += p->probability;
            for (int k = 0; k < SELFCAL_PARAMETERS; k++) {
                const selfcal_estimate_t *e = &p->parameter[k];
                if (isfinite(e->mean)) {
                    TEST_ASSERT_TRUE(e->q05 < e->median && e->median < e->q95 && e->sd > 0.0F);
                }
            }
        }
        TEST_ASSERT_FLOAT_WITHIN(1e-5F, 1.0F, sum);
        /* white noise of known size: N is its deviation at dt = 1 s, to 4 sd of a variance estimate from 500 samples */
        const selfcal_estimate_t *n = &report.hypothesis[0].parameter[SELFCAL_N];
        TEST_ASSERT_FLOAT_WITHIN(4.0F * 0.02F / sqrtf(1000.0F), 0.02F, n->mean);
        TEST_ASSERT_TRUE(n->flags & SELFCAL_IDENTIFIED);
        TEST_ASSERT_FLOAT_WITHIN(4.0F * report.bias_sd, 0.1F, report.bias_mean);
    }
}

/* Truth: the report of a bank that is left alone meanwhile, to the last bit. */
static void samples_may_come_during_a_report(void) {
    for (int i = 0; i < 300; i++) {
        push(0.1F, 0.02F);
    }
    const uint32_t before = selfcal_count(&bank);
    static selfcal_t twin;
    static selfcal_wide_t twin_memory[sizeof memory / sizeof memory[0]];
    static selfcal_report_t alone;
    const uint32_t seed = state;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_init(&twin, &model, twin_memory, sizeof twin_memory));
    state = 12345U;
    for (uint32_t i = 0; i < before; i++) {
        float sample[AXES];
        for (unsigned axis = 0; axis < AXES; axis++) {
            sample[axis] = 0.1F + 0.02F * noise();
        }
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push(&twin, sample));
    }
    TEST_ASSERT_EQUAL(seed, state);
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report(&work, &twin, 2, &alone));
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report_begin(&work, &bank, 2, &report));
    unsigned pushed = 0;
    selfcal_status_t status;
    do {
        status = selfcal_report_step(&work, &report);
        if (report.n > 0U && selfcal_room(&bank) > 0U) { /* the sums are at rest */
            push(0.3F, 0.5F);
            pushed++;
        }
    } while (status == SELFCAL_BUSY);
    TEST_ASSERT_EQUAL(SELFCAL_OK, status);
    TEST_ASSERT_TRUE(pushed >= SELFCAL_BATCH - 1U);
    TEST_ASSERT_EQUAL(before + pushed, selfcal_count(&bank));
    TEST_ASSERT_EQUAL(before, report.n);
    TEST_ASSERT_EQUAL_MEMORY(&alone, &report, sizeof report);
    TEST_ASSERT_EQUAL(0U, selfcal_room(&bank));
}

static void a_report_that_samples_overtake_is_given_up(void) {
    for (int i = 0; i < 300; i++) {
        push(0.1F, 0.02F);
    }
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report_begin(&work, &bank, 0, &report));
    while (work.row == 0U) { /* into the cells */
        TEST_ASSERT_EQUAL(SELFCAL_BUSY, selfcal_report_step(&work, &report));
    }
    while (selfcal_room(&bank) > 0U) {
        push(0.1F, 0.02F);
        TEST_ASSERT_EQUAL(SELFCAL_BUSY, selfcal_report_step(&work, &report));
    }
    push(0.1F, 0.02F);
    TEST_ASSERT_EQUAL(SELFCAL_OVERTAKEN, selfcal_report_step(&work, &report));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_report_step(&work, &report)); /* it is over */
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report(&work, &bank, 0, &report));
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(bad_arguments_change_nothing);
    RUN_TEST(a_record_outside_the_priors_has_no_bias);
    RUN_TEST(a_loud_record_has_a_finite_bias_or_none);
    RUN_TEST(models_that_contradict_themselves_are_refused);
    RUN_TEST(the_widest_priors_keep_every_sum_finite);
    RUN_TEST(the_constant_law_sums_the_data);
    RUN_TEST(the_likelihood_of_the_constant_law_is_the_normal_density);
    RUN_TEST(a_gap_may_be_told_in_pieces);
    RUN_TEST(a_long_gap_leaves_finite_sums);
    RUN_TEST(reports_on_the_way_do_not_change_the_sums);
    RUN_TEST(a_report_is_a_probability_law);
    RUN_TEST(samples_may_come_during_a_report);
    RUN_TEST(a_report_that_samples_overtake_is_given_up);
    return UNITY_END();
}
