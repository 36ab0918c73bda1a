/* Forgetting (lib/bank_forget.c): the constant law's sums with weights in closed form. */
#include "one_axis.h"

#define HALF_LIFE_S 200.0F

enum { BATCHES = 40, LEFT = 5 };

static selfcal_forgetting_t forgetting;
static float reading[BATCHES * SELFCAL_BATCH + LEFT];

void setUp(void) {
    choose(CONSTANT_LAW);
    forgetting.code = &selfcal_forgetting_code;
    forgetting.half_life_s = HALF_LIFE_S;
    model.forgetting = &forgetting;
    begin();
}

void tearDown(void) {}

/* All samples of a batch fade together, once for each later batch: by 2^-(its intervals / half-life). Sums: n, the
 * readings, their squares, about the first. Float rounds a batch's sums by 64 times 6e-8. */
static void samples_fade_from_batch_to_batch(void) {
    enum { GAP_AT = 17 * SELFCAL_BATCH, GAP = 90 };
    double a = 0.0, b = 0.0, c = 0.0;
    for (unsigned i = 0; i < sizeof reading / sizeof *reading; i++) {
        if (i == GAP_AT) {
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_skip(&bank, GAP));
        }
        reading[i] = 1.0F + (float)(i / 300U) + 0.1F * noise();
        push(reading[i]);
    }
    for (unsigned from = 0; from < sizeof reading / sizeof *reading; from += SELFCAL_BATCH) {
        const unsigned left = (unsigned)(sizeof reading / sizeof *reading) - from;
        const unsigned count = left < SELFCAL_BATCH ? left : SELFCAL_BATCH;
        /* the gap before a batch's first sample is its own */
        const double intervals = (double)count + (from == GAP_AT ? (double)GAP : 0.0);
        const double keep = from == 0U ? 1.0 : exp2(-intervals / (double)HALF_LIFE_S);
        a *= keep;
        b *= keep;
        c *= keep;
        for (unsigned i = from; i < from + count; i++) {
            const double y = (double)reading[i] - (double)reading[0];
            a += 1.0;
            b += y;
            c += y * y;
        }
    }
    selfcal_node_view_t view;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_node(&bank, 0, 0, &view));
    TEST_ASSERT_TRUE(close_to(a, view.a, 4e-6));
    TEST_ASSERT_TRUE(close_to(b, view.b, 4e-6));
    TEST_ASSERT_TRUE(close_to(c, view.c, 4e-6));
    TEST_ASSERT_TRUE(close_to(a, bank.weight, 1e-9));
    TEST_ASSERT_TRUE(a > 0.8 * (double)HALF_LIFE_S / log(2.0) && a < 1.2 * (double)HALF_LIFE_S / log(2.0));
}

/* The innovations' variances are forgotten with them: of a walk whose filter has settled, D is the weight times
 * ln(1 + p), p = rho^2 (1 + sqrt(1 + 4/rho^2))/2. */
static void the_determinant_fades_with_the_samples(void) {
    choose(WALK_LAW);
    model.forgetting = &forgetting;
    begin();
    for (unsigned i = 0; i < 4000U; i++) { /* 20 half-lives: nothing of the start is left */
        push(0.1F * noise());
    }
    for (uint16_t node = 6; node < model.nodes; node++) { /* those that settle within 1.5 half-lives */
        selfcal_node_view_t view;
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_node(&bank, 0, node, &view));
        const double rho_sq = exp(2.0 * view.ln_rho), p = 0.5 * rho_sq * (1.0 + sqrt(1.0 + 4.0 / rho_sq));
        TEST_ASSERT_TRUE(close_to(bank.weight * log1p(p), view.ln_s, 1e-5));
    }
}

/* However long the gap, the sums count for a millionth of a sample, and what follows is a record of its own. */
static void after_a_long_gap_only_what_follows_counts(void) {
    for (unsigned i = 0; i < 10U * SELFCAL_BATCH; i++) {
        push(5.0F);
    }
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_skip(&bank, UINT64_C(1) << 34));
    for (unsigned i = 0; i < SELFCAL_BATCH; i++) {
        push(7.0F);
    }
    selfcal_node_view_t view;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_node(&bank, 0, 0, &view));
    TEST_ASSERT_TRUE(close_to((double)SELFCAL_BATCH, view.a, 1e-5));
    TEST_ASSERT_TRUE(close_to(2.0 * (double)SELFCAL_BATCH, view.b, 1e-5));
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(samples_fade_from_batch_to_batch);
    RUN_TEST(the_determinant_fades_with_the_samples);
    RUN_TEST(after_a_long_gap_only_what_follows_counts);
    return UNITY_END();
}
