/* A bias that begins anew (lib/bank_reopen.c): the constant law's sums before and after in closed form. */
#include "one_axis.h"

enum { BEFORE = 400, AFTER = 50 };

static const selfcal_handling_t handling = {0.0F, true, true};
static double n, sum, square;
static float origin;

void setUp(void) {
    choose(CONSTANT_LAW);
    model.handling = &handling;
    begin();
    n = sum = square = 0.0;
    origin = NAN;
}

void tearDown(void) {}

static void record(unsigned count, float level) {
    for (unsigned i = 0; i < count; i++) {
        const float sample = level + 0.05F * noise();
        push(sample);
        origin = isnan(origin) ? sample : origin;
        const double y = (double)sample - (double)origin;
        n += 1.0;
        sum += y;
        square += y * y;
    }
}

static selfcal_node_view_t view_of(void) {
    selfcal_node_view_t view;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_node(&bank, 0, 0, &view));
    return view;
}

/* The first bias integrated out, with ln A at the node's own variance: C = (C - B^2/A)(1 + ln A / n). Nothing else is
 * left. The bias that follows has the posterior of the first as its prior, sigma_v^2 being C over n. 400 float
 * squares: 1e-5. */
static void the_bias_before_becomes_a_prior(void) {
    record(BEFORE, 2.0F);
    const selfcal_reopening_t at = {0};
    const double rest = square - sum * sum / n;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_reopen(&bank, &at, 1.0F, NULL));
    const selfcal_node_view_t view = view_of();
    TEST_ASSERT_TRUE(view.a == 0.0 && view.b == 0.0);
    TEST_ASSERT_TRUE(close_to(rest * (1.0 + log(n) / n), view.c, 1e-5));
    const double sigma_sq = rest / n, p0 = (double)model.axis[0].bias_sd * (double)model.axis[0].bias_sd;
    const double precision = n / sigma_sq + 1.0 / p0, y_mean = (double)origin + sum / n;
    TEST_ASSERT_FLOAT_WITHIN(1e-6F, (float)(n / sigma_sq * y_mean / precision), bank.prior_mean[0]);
    TEST_ASSERT_FLOAT_WITHIN(1e-6F, (float)sqrt(1.0 / precision), bank.prior_sd[0]);
}

/* A step that is stated has a prior of its own, and takes what was learned before it; of that `keep` is left. */
static void a_step_takes_what_was_learned_before(void) {
    record(BEFORE, 2.0F);
    float learned[1];
    selfcal_learned(&bank, learned);
    const double rest = (square - sum * sum / n) * (1.0 + log(n) / n);
    TEST_ASSERT_FLOAT_WITHIN(1e-5F * (float)(rest / n), (float)(rest / n), learned[0]);
    record(AFTER, 3.0F); /* spoils C */
    const selfcal_reopening_t at = {.bias = 3.0F, .bias_sd = 0.5F};
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_reopen(&bank, &at, 0.25F, learned));
    TEST_ASSERT_TRUE(close_to(0.25 * (BEFORE + AFTER) * (double)learned[0], view_of().c, 1e-6));
    TEST_ASSERT_TRUE(close_to(0.25 * (BEFORE + AFTER), bank.weight, 1e-12));
    TEST_ASSERT_TRUE(bank.prior_mean[0] == 3.0F && bank.prior_sd[0] == 0.5F);
}

/* What follows is summed as if it were the first, about the same offset. */
static void what_follows_is_summed_anew(void) {
    record(BEFORE, 2.0F);
    const selfcal_reopening_t at = {0};
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_reopen(&bank, &at, 1.0F, NULL));
    const double before = view_of().c;
    n = sum = square = 0.0;
    record(AFTER, 3.0F);
    const selfcal_node_view_t view = view_of();
    TEST_ASSERT_TRUE(close_to(AFTER, view.a, 1e-12));
    TEST_ASSERT_TRUE(close_to(sum, view.b, 1e-5));
    TEST_ASSERT_TRUE(close_to(before + square, view.c, 1e-5));
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(the_bias_before_becomes_a_prior);
    RUN_TEST(a_step_takes_what_was_learned_before);
    RUN_TEST(what_follows_is_summed_anew);
    return UNITY_END();
}
