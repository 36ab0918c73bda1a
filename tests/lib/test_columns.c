/* Columns after a restart: where the values of regressors go on, and where they begin anew. */
#include "selfcal_model.h"
#include "unity.h"

#include <math.h>
#include <string.h>

enum { LAG, TURN_ON, WAVE, COLUMNS, BLOCK = 4, MOST_BYTES = 40000 };
#define DT 0.25
#define LAG_S 300.0
#define TURN_ON_S 500.0

/* One channel beside the axis. */
static const selfcal_source_t source[COLUMNS] = {
    {SELFCAL_COLUMN_LAG, 1U, (float)LAG_S, 0.0F},
    {SELFCAL_COLUMN_TURN_ON, 0U, (float)TURN_ON_S, 0.0F},
    {SELFCAL_COLUMN_SINE, 0U, 0.003F, 0.0F},
};
static const float reference[COLUMNS] = {25.0F, 0.0F, 0.0F}, coefficient_sd[COLUMNS] = {0.1F, 1.0F, 1.0F};
static const float ln_odds[COLUMNS] = {0.0F, 0.0F, 0.0F};
static const selfcal_regressors_t regressors = {
    .code = &selfcal_regressors_code,
    .count = COLUMNS,
    .reference = reference,
    .coefficient_sd = coefficient_sd,
    .source = source,
    .ln_odds = ln_odds,
};
static selfcal_model_t model;
static selfcal_hypothesis_t only[1];
static selfcal_wide_t memory[2][MOST_BYTES / sizeof(selfcal_wide_t)];
static selfcal_t bank, restored;
static selfcal_former_t former, resumed;
static uint8_t saved[2 * MOST_BYTES];
static size_t length;

static bool keep(void *context, const void *bytes, size_t count) {
    (void)context;
    memcpy(saved + length, bytes, count);
    length += count;
    return length < sizeof saved - SELFCAL_SNAPSHOT_CHUNK;
}

/* The channel warms up by 20 in an hour. */
static float channel_at(uint32_t i) {
    return 20.0F + 20.0F * (float)i / 14400.0F;
}

static void form_at(selfcal_former_t *by, uint32_t i, uint32_t missing, float values[]) {
    const float sample[1] = {0.0F}, channel[1] = {channel_at(i)};
    selfcal_form(by, missing, sample, channel, values);
}

/* `count` samples through the columns into the bank. */
static void run(uint32_t count, float values[]) {
    for (uint32_t i = 0; i < count; i++) {
        const float sample[1] = {0.01F * (float)(i % 7U)};
        form_at(&former, i, 0, values);
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_push_with(&bank, sample, values));
    }
}

static void save_and_restore(void) {
    length = 0;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_save(&bank, keep, NULL));
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_restore(&restored, &model, memory[1], sizeof memory[1], saved, length));
}

void setUp(void) {
    model = selfcal_model;
    model.axes = 1;
    model.block = BLOCK;
    model.dt_s = (float)(BLOCK * DT);
    model.regressors = &regressors;
    uint8_t h = 0;
    while (model.hypothesis[h].rho != NULL) { /* the law without nodes: the columns alone are tested */
        h++;
    }
    only[0] = model.hypothesis[h];
    model.hypothesis = only;
    model.hypotheses = 1;
    model.nodes = 1;
    model.handling = NULL;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_init(&bank, &model, memory[0], sizeof memory[0]));
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_former_init(&former, &model));
}

void tearDown(void) {}

/* Times, lines and turn-ons go on to the bit. A lag goes on from the mean over a bank interval, SELFCAL_BATCH of them
 * ago at most: on this ramp it is off by less than what the channel moves meanwhile. Then the channel is taken to have
 * had its new value in the gap, where the low pass that was never stopped followed the line. */
static void a_snapshot_continues_columns(void) {
    float gone[COLUMNS], values[COLUMNS];
    run(2001, values);
    save_and_restore();
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_former_resume(&resumed, &restored));
    const float slope = 20.0F / 14400.0F, stale = slope * (float)((2U * SELFCAL_BATCH + 1U) * BLOCK);
    for (uint32_t i = 2001; i < 6000; i++) {
        const uint32_t missing = i == 2001U ? 40U : 0U;
        form_at(&former, i + 40U, missing, gone);
        form_at(&resumed, i + 40U, missing, values);
        TEST_ASSERT_EQUAL_FLOAT(gone[TURN_ON], values[TURN_ON]);
        TEST_ASSERT_EQUAL_FLOAT(gone[WAVE], values[WAVE]);
        const float off = stale * expf(-(float)((double)(i - 2001U) * DT / LAG_S)) + 1e-4F;
        TEST_ASSERT_FLOAT_WITHIN(off, gone[LAG], values[LAG]);
    }
    const float behind = slope * (float)(LAG_S / DT); /* of a low pass, on a line */
    TEST_ASSERT_FLOAT_WITHIN(0.05F * behind, channel_at(6039) - behind, values[LAG]);
}

/* A lag that begins at rest would be off by all that the low pass is behind: the test above can fail. */
static void without_a_bank_a_lag_begins_at_rest(void) {
    float gone[COLUMNS], values[COLUMNS];
    run(2001, gone);
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_former_resume(&resumed, &bank));
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_init(&bank, &model, memory[0], sizeof memory[0]));
    selfcal_former_t fresh;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_former_resume(&fresh, &bank));
    form_at(&former, 2001, 0, gone);
    form_at(&resumed, 2001, 0, values);
    TEST_ASSERT_FLOAT_WITHIN(0.2F, gone[LAG], values[LAG]);
    form_at(&fresh, 2001, 0, values);
    TEST_ASSERT_EQUAL_FLOAT(channel_at(2001), values[LAG]);
    TEST_ASSERT_TRUE(values[LAG] - gone[LAG] > 0.5F);
    TEST_ASSERT_EQUAL_FLOAT(1.0F, values[TURN_ON]);
}

/* A turn-on goes on through a restart, begins anew with power, and goes on from there through the next restart. */
static void power_on_restarts_a_turn_on(void) {
    float values[COLUMNS];
    run(800, values);
    for (uint32_t again = 0; again < 3U; again++) {
        save_and_restore();
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_skip(&restored, 100));
        if (again == 1U) {
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_power_on(&restored, 0));
        }
        if (again == 2U) {
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_power_on(&restored, 60));
            length = 0;
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_save(&restored, keep, NULL));
            TEST_ASSERT_EQUAL(SELFCAL_OK,
                              selfcal_restore(&restored, &model, memory[1], sizeof memory[1], saved, length));
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_skip(&restored, 7));
        }
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_former_resume(&resumed, &restored));
        form_at(&resumed, 900, 3, values); /* three more were missing */
        const double passed = again == 0U ? 903.0 : again == 1U ? 3.0 : 70.0;
        TEST_ASSERT_FLOAT_WITHIN(1e-6F, (float)exp(-passed * DT / TURN_ON_S), values[TURN_ON]);
    }
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_power_on(NULL, 0));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_former_resume(&resumed, NULL));
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(a_snapshot_continues_columns);
    RUN_TEST(without_a_bank_a_lag_begins_at_rest);
    RUN_TEST(power_on_restarts_a_turn_on);
    return UNITY_END();
}
