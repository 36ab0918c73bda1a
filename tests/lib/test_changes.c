/* Steps of the bias and changes of the noise (lib/changes.c), of known onset and size. */
#include "one_axis.h"

#define SD 0.04F

static const selfcal_handling_t handling = {0.0F, true, true};
static selfcal_work_t work;
static selfcal_report_t report;
static selfcal_adequacy_t adequacy;
static selfcal_changes_t changes;
static float learned[1];
static uint32_t found; /* samples from the onset on until it was found; 0: not yet */

void setUp(void) {
    choose(CONSTANT_LAW);
    model.handling = &handling;
    begin();
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_adequacy_init(&adequacy, &bank));
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_changes_init(&changes, &adequacy, &bank, learned));
    found = 0;
}

void tearDown(void) {}

static void take(uint32_t count, float level, float sd) {
    for (uint32_t i = 0; i < count; i++) {
        push(level + sd * noise());
        selfcal_adequacy_push(&adequacy, &bank, NULL, NULL);
        if (selfcal_changes_handle(&adequacy, &bank) != 0U) {
            found = i + 1U;
            return;
        }
    }
}

/* A report after 600 samples, and 609 more. Epochs begin at 600 and 856: the next sample is one at which an onset does,
 * each 16 samples from the second of an epoch on. */
static void learn(void) {
    take(600, 0.3F, SD);
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report(&work, &bank, 0, &report));
    selfcal_adequacy_report(&adequacy, &model, &report, NULL);
    take(609, 0.3F, SD);
    TEST_ASSERT_EQUAL(0U, found);
}

/* A step of d after which m samples have come: its size is known to sigma_v / sqrt(m), and its onset to 16 samples,
 * beside as many that the onset may lie off by noise. */
static void a_step_has_its_size_and_onset(void) {
    learn();
    take(400, 0.3F + 4.0F * SD, SD);
    TEST_ASSERT_TRUE(found >= 24U && found < 64U); /* it must hold for 24 samples */
    const selfcal_judgement_t judged = selfcal_judgement(&adequacy, &bank, 0);
    TEST_ASSERT_EQUAL(1U, judged.changes);
    TEST_ASSERT_EQUAL(SELFCAL_SUSPECT_STEP, judged.change.cause);
    TEST_ASSERT_FLOAT_WITHIN(4.0F * SD / sqrtf(24.0F), 4.0F * SD, judged.change.size);
    TEST_ASSERT_FLOAT_WITHIN(16.0F, (float)found, judged.change.ago_s);
    /* the bias is learned anew, from where the step has brought it */
    take(300, 0.3F + 4.0F * SD, SD);
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report(&work, &bank, 0, &report));
    TEST_ASSERT_FLOAT_WITHIN(4.0F * report.bias_sd, 0.3F + 4.0F * SD, report.bias_mean);
    TEST_ASSERT_FLOAT_WITHIN(0.2F * SD / sqrtf(300.0F), SD / sqrtf(300.0F), report.bias_sd);
}

/* Twice the noise, over a window of 64 z^2: to 4 sd of its root, 4 / sqrt(2 64). Squares are held at 4, which lowers
 * it. */
static void a_change_of_the_noise(void) {
    learn();
    take(400, 0.3F, 2.0F * SD);
    TEST_ASSERT_TRUE(found >= 64U && found <= 3U * 64U); /* two windows in a row, and what was left of one */
    const selfcal_judgement_t judged = selfcal_judgement(&adequacy, &bank, 0);
    TEST_ASSERT_EQUAL(SELFCAL_SUSPECT_VARIANCE_CHANGE, judged.change.cause);
    TEST_ASSERT_TRUE(judged.change.size > 2.0F * (1.0F - 0.36F) - 0.3F && judged.change.size < 2.0F * 1.36F);
}

/* A burst of eight samples is neither, and nothing is found at rest: limits of 7 sd. */
static void a_burst_is_no_change(void) {
    learn();
    take(8, 0.3F + 20.0F * SD, SD);
    take(2000, 0.3F, SD);
    TEST_ASSERT_EQUAL(0U, found);
    TEST_ASSERT_EQUAL(0U, selfcal_judgement(&adequacy, &bank, 0).changes);
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(a_step_has_its_size_and_onset);
    RUN_TEST(a_change_of_the_noise);
    RUN_TEST(a_burst_is_no_change);
    return UNITY_END();
}
