/* Judgement of the model (lib/adequacy.c): the scores of effects whose size in closed form is known. */
#include "one_axis.h"

enum { LEARNED = 600, EPOCH = 300 };
#define SD 0.04F

static selfcal_work_t work;
static selfcal_report_t report;
static selfcal_adequacy_t adequacy;

void setUp(void) {
    choose(CONSTANT_LAW);
    begin();
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_adequacy_init(&adequacy, &bank));
}

void tearDown(void) {}

static void take(float sample, float temperature) {
    const float channels[2] = {temperature, NAN};
    push(sample);
    selfcal_adequacy_push(&adequacy, &bank, channels, NULL);
}

/* A report on LEARNED samples of white noise; then an epoch of half of them. */
static void learn(void) {
    for (unsigned i = 0; i < LEARNED; i++) {
        take(0.3F + SD * noise(), 25.0F);
    }
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report(&work, &bank, 0, &report));
    selfcal_adequacy_report(&adequacy, &model, &report, NULL);
}

/* Of z ~ N(0, 1) + signal, sum z w / sqrt(sum w^2) over the doubt's sqrt(1 + n/n_before): within 4 of its mean.
 * `suspect` must be the strongest. */
static void assert_score(selfcal_suspect_t suspect, float mean) {
    const selfcal_judgement_t judged = selfcal_judgement(&adequacy, &bank, 0);
    TEST_ASSERT_EQUAL(suspect, judged.suspect);
    TEST_ASSERT_FLOAT_WITHIN(4.0F, mean / sqrtf(1.5F), fabsf(judged.score));
    TEST_ASSERT_EQUAL(SELFCAL_INADEQUATE, judged.state);
}

static void white_noise_is_adequate(void) {
    TEST_ASSERT_EQUAL(SELFCAL_NOT_JUDGED, selfcal_judgement(&adequacy, &bank, 0).state);
    learn();
    for (unsigned i = 0; i < EPOCH; i++) {
        take(0.3F + SD * noise(), 25.0F);
    }
    TEST_ASSERT_EQUAL(SELFCAL_ADEQUATE, selfcal_judgement(&adequacy, &bank, 0).state);
}

/* A coefficient c of a temperature that swings by +-1: sum z w / sqrt(sum w^2) = c sqrt(n) / sigma. */
static void a_temperature(void) {
    learn();
    for (unsigned i = 0; i < EPOCH; i++) {
        const float swing = i % 14U < 7U ? 1.0F : -1.0F;
        take(0.3F + 0.8F * SD * swing + SD * noise(), 25.0F + swing);
    }
    assert_score(SELFCAL_SUSPECT_TEMPERATURE, 0.8F * sqrtf((float)EPOCH));
}

/* 1.4 times the noise: sum (z^2 - 1) / sqrt(2 n) = 0.96 sqrt(n/2). It scatters by 1.4^2. */
static void louder_noise(void) {
    learn();
    for (unsigned i = 0; i < EPOCH; i++) {
        take(0.3F + 1.4F * SD * noise(), 25.0F);
    }
    const selfcal_judgement_t judged = selfcal_judgement(&adequacy, &bank, 0);
    TEST_ASSERT_EQUAL(SELFCAL_SUSPECT_VARIANCE_CHANGE, judged.suspect);
    TEST_ASSERT_FLOAT_WITHIN(4.0F * 1.96F, 0.96F * sqrtf(0.5F * (float)EPOCH) / sqrtf(1.5F), judged.score);
}

/* Neighbours that correlate by 0.7, of the same variance: sum z z' / sqrt(n) = 0.7 sqrt(n). It scatters by more than 1
 * there: by sqrt((1 + r^2)/(1 - r^2)) and some. */
static void coloured_noise(void) {
    learn();
    float z = 0.0F;
    for (unsigned i = 0; i < EPOCH; i++) {
        z = 0.7F * z + sqrtf(1.0F - 0.49F) * noise();
        take(0.3F + SD * z, 25.0F);
    }
    const selfcal_judgement_t judged = selfcal_judgement(&adequacy, &bank, 0);
    TEST_ASSERT_TRUE(judged.suspect == SELFCAL_SUSPECT_COLORED_NOISE || judged.suspect == SELFCAL_SUSPECT_FLICKER);
    TEST_ASSERT_TRUE(judged.score > 0.5F * 0.7F * sqrtf((float)EPOCH));
    TEST_ASSERT_EQUAL(SELFCAL_INADEQUATE, judged.state);
}

/* Epochs after a restart, whose record is long already: 256, then twice as many, so that an axis whose report came
 * after the first one had begun waits for 768 bank samples and not for twice half of the record. */
static void a_restart_begins_with_short_epochs(void) {
    learn();
    for (unsigned i = 0; i < 3400U; i++) {
        take(0.3F + SD * noise(), 25.0F);
    }
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_adequacy_init(&adequacy, &bank));
    selfcal_adequacy_report(&adequacy, &model, &report, NULL);
    for (unsigned length = SELFCAL_EPOCH_MIN; length <= 4U * SELFCAL_EPOCH_MIN; length *= 2U) {
        for (unsigned i = 0; i < length; i++) {
            take(0.3F + SD * noise(), 25.0F);
        }
        const selfcal_judgement_t judged = selfcal_judgement(&adequacy, &bank, 0);
        TEST_ASSERT_EQUAL(SELFCAL_ADEQUATE, judged.state);
        TEST_ASSERT_EQUAL(length, judged.samples);
    }
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(a_restart_begins_with_short_epochs);
    RUN_TEST(white_noise_is_adequate);
    RUN_TEST(a_temperature);
    RUN_TEST(louder_noise);
    RUN_TEST(coloured_noise);
    return UNITY_END();
}
