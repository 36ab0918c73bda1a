/* The pipe: bit for bit what its parts do, called by hand after the rules that selfcal_parts.h states at each. */
#include "noise.h"
#include "selfcal_frames.h"
#include "selfcal_model.h"
#include "unity.h"

#include <math.h>
#include <string.h>

enum { BLOCK = 15, WINDOW = 5, AXES = SELFCAL_MODEL_AXES, SAMPLES = 15000 };

static selfcal_gate_config_t gate_config;
static selfcal_pipe_t pipe;
static selfcal_model_t model;
static selfcal_wide_t memory[2][(SELFCAL_MODEL_IMU_BYTES + 200000U) / sizeof(selfcal_wide_t)];
static selfcal_imu_t imu;
static selfcal_kept_t kept;

/* The same by hand. */
static struct {
    selfcal_t bank;
    selfcal_gate_t gate;
    uint32_t learn_at;
    selfcal_adequacy_t adequacy;
    selfcal_former_t former;
    selfcal_work_t work;
    selfcal_report_t report;
} parts;

/* With one regressor, the time. */
static const float reference[] = {0.0F}, coefficient_sd[AXES] = {0.1F, 0.1F, 0.1F}, ln_odds[AXES];
static const selfcal_source_t source[] = {{SELFCAL_COLUMN_TIME, 0U, 0.0F, 0.0F}};
static const selfcal_regressors_t regressors = {
    &selfcal_regressors_code, 1U, reference, coefficient_sd, source, ln_odds, NULL,
};

void setUp(void) {
    state = 20261126U;
    gate_config = selfcal_model_gate;
    gate_config.window = WINDOW;
    pipe = selfcal_model_pipe;
    pipe.model = &model;
    pipe.rate_hz = (float)BLOCK;
    pipe.gate = &gate_config;
    model = selfcal_model;
    model.block = BLOCK;
    model.dt_s = 1.0F;
}

void tearDown(void) {}

/* A record with gaps, a motion, and samples that are no numbers. */
static uint32_t draw_sample(uint32_t at, float reading[]) {
    for (unsigned axis = 0; axis < AXES; axis++) {
        reading[axis] = 0.1F * (float)axis + (axis < 3U ? 0.4F : 0.05F) * noise();
        reading[axis] += at > 8000U && at < 8200U ? 20.0F * noise() : 0.0F;
    }
    if (at == 5000U) {
        reading[1] = NAN;
    }
    return draw() % 500U == 0U ? draw() % 40U : 0U;
}

static void begin(void) {
    memset(&parts, 0, sizeof parts);
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_imu_init(&imu, &pipe, memory[0], sizeof memory[0]));
    selfcal_imu_keep(&imu, &kept);
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_init(&parts.bank, &model, memory[1], sizeof memory[1]));
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_gate_init(&parts.gate, &gate_config));
    parts.learn_at = SELFCAL_GATE_MEASURED_MIN;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_adequacy_init(&parts.adequacy, &parts.bank));
    if (model.regressors != NULL) {
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_former_init(&parts.former, &model));
    }
}

static void learn(void) {
    if (parts.gate.measured == 0U) {
        parts.learn_at = SELFCAL_GATE_MEASURED_MIN;
    }
    if (parts.gate.measured >= parts.learn_at) {
        parts.learn_at *= 2U;
        for (uint8_t axis = 0; axis < AXES; axis++) {
            selfcal_gate_noise_t noise_of;
            if (selfcal_gate_measured(&parts.gate, axis, &noise_of) == SELFCAL_OK) {
                (void)selfcal_gate_noise(&parts.gate, axis, &noise_of);
            }
        }
    }
}

/* By the rules at selfcal_push_moving(), selfcal_form() and selfcal_adequacy_push(). */
static void take_by_hand(uint32_t missing, const float reading[], const float side[]) {
    float values[1] = {0.0F};
    const bool columns = model.regressors != NULL;
    if (missing > 0U) {
        if (selfcal_gate_skip(&parts.gate, missing) == SELFCAL_MOVING) {
            (void)selfcal_moving(&parts.bank);
        }
        (void)selfcal_skip(&parts.bank, missing);
    }
    if (columns) {
        selfcal_form(&parts.former, missing, reading, NULL, values);
    }
    const bool first = selfcal_counters(&parts.bank)->samples == 0U && parts.gate.position != 0U;
    const selfcal_motion_t before = parts.gate.state, now = selfcal_gate_push(&parts.gate, reading);
    learn();
    if (before == SELFCAL_RESTING && now == SELFCAL_RESTING && !first) {
        (void)selfcal_push_with(&parts.bank, reading, values);
    } else {
        (void)selfcal_push_moving(&parts.bank, reading);
    }
    selfcal_adequacy_push(&parts.adequacy, &parts.bank, side, columns ? values : NULL);
}

static void assert_same_banks(void) {
    const size_t after = offsetof(selfcal_t, n); /* pointers come first */
    TEST_ASSERT_EQUAL_MEMORY((const char *)&parts.bank + after, (const char *)&imu.bank + after,
                             sizeof imu.bank - after);
    TEST_ASSERT_EQUAL_MEMORY(memory[1], imu.memory, SELFCAL_SIZE(model.nodes, model.axes));
}

static void assert_same_reports(void) {
    while (selfcal_imu_work(&imu) == SELFCAL_BUSY) {
    }
    for (uint8_t axis = 0; axis < AXES; axis++) {
        memset(&parts.report, 0, sizeof parts.report);
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report(&parts.work, &parts.bank, axis, &parts.report));
        const selfcal_report_t *got = selfcal_imu_report(&imu, axis);
        TEST_ASSERT_NOT_NULL(got);
        if (model.regressors == NULL) { /* weighed against the one with: see the test of the trend */
            TEST_ASSERT_EQUAL_MEMORY(&parts.report.bias_mean, &got->bias_mean, sizeof(float));
            TEST_ASSERT_EQUAL_MEMORY(&parts.report.bias_sd, &got->bias_sd, sizeof(float));
            for (unsigned h = 0; h < model.hypotheses; h++) {
                TEST_ASSERT_TRUE(parts.report.hypothesis[h].ln_evidence == got->hypothesis[h].ln_evidence);
            }
            selfcal_adequacy_report(&parts.adequacy, &model, &parts.report, NULL);
            const selfcal_judgement_t judged = selfcal_judgement(&parts.adequacy, &parts.bank, axis);
            TEST_ASSERT_EQUAL(judged.state, selfcal_imu_judgement(&imu, axis)->state);
            TEST_ASSERT_TRUE(judged.score == selfcal_imu_judgement(&imu, axis)->score);
            TEST_ASSERT_EQUAL(selfcal_reason(&model, &parts.report, judged.state), selfcal_imu_reason(&imu, axis));
        }
    }
}

static void run_both(float trend) {
    uint32_t passed = 0; /* the missing ones too */
    begin();
    for (uint32_t at = 0; at < SAMPLES; at++) {
        float reading[AXES];
        const float side[] = {25.0F + 1e-4F * (float)at, NAN};
        const uint32_t missing = draw_sample(at, reading);
        passed += missing + 1U;
        reading[0] += trend * (float)passed;
        selfcal_imu_skip(&imu, missing);
        TEST_ASSERT_EQUAL(0U, selfcal_imu_sample(&imu, reading, NULL, side) & SELFCAL_ALL_AXES);
        take_by_hand(missing, reading, side);
        if (at == SAMPLES / 2U || at + 1U == SAMPLES) {
            TEST_ASSERT_EQUAL(SELFCAL_BUSY, selfcal_imu_ask(&imu, SELFCAL_ALL_AXES));
            assert_same_reports();
            assert_same_banks();
        }
    }
    TEST_ASSERT_EQUAL(1U, imu.gate->gate.counters.alarms); /* the motion was one */
    TEST_ASSERT_GREATER_THAN(500U, selfcal_count(&imu.bank));
}

static void test_it_is_what_its_parts_are(void) {
    run_both(0.0F);
}

/* Where an axis has a trend its report with the column counts, and no other axis's does. */
static void test_the_likelier_report_counts(void) {
    model.regressors = &regressors;
    pipe.columns = &selfcal_columns_code;
    const float per_s = 4e-3F;
    run_both(per_s / (float)BLOCK);
    const selfcal_sent_coefficient_t *gx = selfcal_imu_coefficients(&imu, 0), *gy = selfcal_imu_coefficients(&imu, 1);
    TEST_ASSERT_TRUE(gx->probability > 0.99F);
    TEST_ASSERT_FLOAT_WITHIN(4.0F * gx->sd, per_s, gx->mean);
    TEST_ASSERT_TRUE(gy->probability < 0.5F);
    TEST_ASSERT_TRUE(isnan(selfcal_imu_coefficients(&imu, 3)->mean)); /* the column is not for it */
}

static void test_a_corrected_sample_is_the_reading_less_the_predicted_bias(void) {
    run_both(0.0F);
    float reading[AXES], bias = 0.0F, sd = 0.0F;
    selfcal_corrected_t corrected;
    (void)draw_sample(1U, reading);
    selfcal_imu_skip(&imu, 2U * BLOCK - 1U);
    (void)selfcal_imu_sample(&imu, reading, NULL, NULL);
    TEST_ASSERT_TRUE(selfcal_imu_corrected(&imu, &corrected));
    TEST_ASSERT_FALSE(selfcal_imu_corrected(&imu, &corrected)); /* no newer one */
    /* The report rests on the intervals that had ended: whole seconds, and those of the one in progress then. */
    const float since = (float)(kept.passed - kept.rests_on[2]) / (float)BLOCK;
    TEST_ASSERT_TRUE(since >= 2.0F && since < 3.0F);
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_predict(selfcal_imu_report(&imu, 2), &model, since, &bias, &sd));
    TEST_ASSERT_TRUE(corrected.value[2] == reading[2] - bias);
    TEST_ASSERT_TRUE(corrected.sd[2] == sd);
}

static unsigned char saved[sizeof memory[0] + sizeof imu];
static size_t saved_bytes;

static bool put(void *context, const void *bytes, size_t count) {
    (void)context;
    memcpy(saved + saved_bytes, bytes, count);
    saved_bytes += count;
    return true;
}

static void test_a_restored_pipe_goes_on_at_the_start_of_an_interval(void) {
    run_both(0.0F);
    const uint64_t before = selfcal_counters(&imu.bank)->samples;
    saved_bytes = 0;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_imu_save(&imu, put, NULL));
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_imu_init(&imu, &pipe, memory[0], sizeof memory[0]));
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_imu_restore(&imu, saved, saved_bytes, 1001U));
    TEST_ASSERT_EQUAL(0U, imu.bank.position);
    TEST_ASSERT_TRUE(before == selfcal_counters(&imu.bank)->samples);
    TEST_ASSERT_EQUAL(SELFCAL_REASON_MOVING, selfcal_imu_reason(&imu, 0)); /* until the gate has seen rest */
    TEST_ASSERT_NULL(selfcal_imu_report(&imu, 0));
    saved[saved_bytes / 2U] ^= 1U;
    TEST_ASSERT_EQUAL(SELFCAL_SNAPSHOT_DAMAGED, selfcal_imu_restore(&imu, saved, saved_bytes, 0U));
}

/* An amount that the sensor adds moves bias, report and readings alike, and is kept when all else is forgotten. */
static void test_what_the_sensor_adds_moves_with_it(void) {
    run_both(0.0F);
    const float bias = selfcal_imu_bias(&imu, 1), report = selfcal_imu_report(&imu, 1)->bias_mean;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_imu_shift(&imu, 1, 0.5F));
    TEST_ASSERT_EQUAL_FLOAT(bias + 0.5F, selfcal_imu_bias(&imu, 1));
    TEST_ASSERT_EQUAL_FLOAT(report + 0.5F, selfcal_imu_report(&imu, 1)->bias_mean);
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_imu_shift(&imu, AXES, 0.5F));
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_imu_forget(&imu));
    TEST_ASSERT_EQUAL(0U, selfcal_count(&imu.bank));
    TEST_ASSERT_EQUAL_FLOAT(0.5F, selfcal_shifted(&imu.bank, 1));
    TEST_ASSERT_TRUE(isnan(selfcal_imu_bias(&imu, 1)));
}

/* Another place for the reports has none of those before: no report of zeros. NULL: the last of all is kept again. */
static void test_reports_from_before_are_not_in_a_new_place(void) {
    run_both(0.0F);
    TEST_ASSERT_NOT_NULL(selfcal_imu_report(&imu, 1));
    selfcal_imu_keep(&imu, &kept);
    TEST_ASSERT_NULL(selfcal_imu_report(&imu, 1));
    TEST_ASSERT_EQUAL(SELFCAL_REASON_NO_REPORT, selfcal_imu_reason(&imu, 1));
    TEST_ASSERT_TRUE(isnan(selfcal_imu_bias(&imu, 1)));
    selfcal_imu_keep(&imu, NULL);
    TEST_ASSERT_EQUAL(SELFCAL_BUSY, selfcal_imu_ask(&imu, SELFCAL_ALL_AXES));
    while (selfcal_imu_work(&imu) == SELFCAL_BUSY) {
    }
    TEST_ASSERT_NULL(selfcal_imu_report(&imu, AXES - 2U));
    TEST_ASSERT_FLOAT_WITHIN(1.0F, selfcal_imu_bias(&imu, AXES - 1U), selfcal_imu_report(&imu, AXES - 1U)->bias_mean);
}

static void test_what_does_not_go_together_is_refused(void) {
    const size_t least = SELFCAL_MODEL_IMU_BYTES;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_imu_init(&imu, &pipe, memory[0], least));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_MEMORY, selfcal_imu_init(&imu, &pipe, memory[0], least - 8U));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_MEMORY, selfcal_imu_init(&imu, &pipe, memory[0], 0U));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_MEMORY, selfcal_imu_init(&imu, &pipe, (char *)memory[0] + 4, least));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_imu_init(&imu, &pipe, NULL, least));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_imu_init(&imu, NULL, memory[0], least));
    model.regressors = &regressors; /* nobody forms their values */
    TEST_ASSERT_EQUAL(SELFCAL_BAD_MODEL, selfcal_imu_init(&imu, &pipe, memory[0], sizeof memory[0]));
    model.regressors = NULL;
    pipe.columns = &selfcal_columns_code;
    TEST_ASSERT_EQUAL(SELFCAL_BAD_MODEL, selfcal_imu_init(&imu, &pipe, memory[0], sizeof memory[0]));
    pipe.columns = NULL;
    pipe.changes = &selfcal_changes_code; /* the model handles nothing */
    TEST_ASSERT_EQUAL(SELFCAL_BAD_MODEL, selfcal_imu_init(&imu, &pipe, memory[0], sizeof memory[0]));
}

/* The bank alone: nothing is watched or judged. */
static void test_a_pipe_without_parts_is_a_bank(void) {
    pipe = (selfcal_pipe_t){.model = &model, .rate_hz = (float)BLOCK};
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_imu_init(&imu, &pipe, memory[0], SELFCAL_MODEL_BYTES));
    TEST_ASSERT_FALSE(selfcal_imu_watch(&imu, true));
    for (uint32_t at = 0; at < 100U * BLOCK; at++) {
        float reading[AXES];
        (void)draw_sample(at, reading);
        (void)selfcal_imu_sample(&imu, reading, NULL, NULL);
    }
    TEST_ASSERT_EQUAL(100U, selfcal_count(&imu.bank));
    TEST_ASSERT_EQUAL(SELFCAL_BUSY, selfcal_imu_ask(&imu, 1U << 2));
    while (selfcal_imu_work(&imu) == SELFCAL_BUSY) {
    }
    TEST_ASSERT_NOT_NULL(selfcal_imu_report(&imu, 2));
    TEST_ASSERT_NULL(selfcal_imu_report(&imu, 1));
    TEST_ASSERT_NULL(selfcal_imu_judgement(&imu, 2));
    TEST_ASSERT_NULL(selfcal_imu_coefficients(&imu, 2));
    TEST_ASSERT_EQUAL(SELFCAL_STATUS_MOTION_NOT_WATCHED, selfcal_imu_motion(&imu));
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_imu_work(&imu));            /* nothing is due */
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_imu_ask(&imu, 1U << AXES)); /* no such axis */
}

/* --- before any report --- */

static void fill(void *bytes, size_t count) {
    memset(bytes, 0xB4, count);
}

/* What every getter of selfcal.h says of a pipe without a report, whatever was in its memory. */
static void assert_nothing_known(const char *when) {
    selfcal_corrected_t corrected;
    const uint32_t motion = selfcal_imu_motion(&imu);
    for (uint8_t axis = 0; axis < AXES; axis++) {
        TEST_ASSERT_NULL_MESSAGE(selfcal_imu_report(&imu, axis), when);
        const selfcal_judgement_t *judged = selfcal_imu_judgement(&imu, axis);
        TEST_ASSERT_EQUAL_MESSAGE(pipe.judging != NULL, judged != NULL, when);
        if (judged != NULL) {
            TEST_ASSERT_EQUAL_MESSAGE(SELFCAL_NOT_JUDGED, judged->state, when);
            TEST_ASSERT_EQUAL_MESSAGE(SELFCAL_REASON_NO_REPORT, judged->reason, when);
            TEST_ASSERT_EQUAL_MESSAGE(SELFCAL_SUSPECT_NONE, judged->suspect, when);
            TEST_ASSERT_EQUAL_MESSAGE(0U, judged->samples + judged->changes, when);
            TEST_ASSERT_TRUE_MESSAGE(judged->score == 0.0F && isnan(judged->temperature_span), when);
            TEST_ASSERT_TRUE_MESSAGE(judged->change.size == 0.0F && judged->change.ago_s == 0.0F, when);
        }
        const selfcal_sent_coefficient_t *sent = selfcal_imu_coefficients(&imu, axis);
        TEST_ASSERT_EQUAL_MESSAGE(pipe.columns != NULL, sent != NULL, when);
        TEST_ASSERT_TRUE_MESSAGE(sent == NULL || isnan(sent[0].mean), when);
        TEST_ASSERT_EQUAL_MESSAGE(motion == SELFCAL_STATUS_MOTION_MOVING ? SELFCAL_REASON_MOVING
                                                                         : SELFCAL_REASON_NO_REPORT,
                                  selfcal_imu_reason(&imu, axis), when);
        TEST_ASSERT_TRUE_MESSAGE(isnan(selfcal_imu_bias(&imu, axis)), when);
    }
    TEST_ASSERT_EQUAL_MESSAGE(pipe.gate_code != NULL, motion != SELFCAL_STATUS_MOTION_NOT_WATCHED, when);
    TEST_ASSERT_FALSE_MESSAGE(selfcal_imu_corrected(&imu, &corrected), when);
    TEST_ASSERT_TRUE_MESSAGE(selfcal_imu_room(&imu), when);
    TEST_ASSERT_EQUAL_MESSAGE(0U, selfcal_count(&imu.bank) + selfcal_counters(&imu.bank)->samples, when);
}

static bool full(void *context, const void *bytes, size_t count) {
    (void)context;
    (void)bytes;
    (void)count;
    return false;
}

/* IEEE 802.3, bit by bit. */
static void mend_crc(void) {
    uint32_t crc = 0xFFFFFFFFU;
    for (size_t at = 0; at < 8U * (saved_bytes - 4U); at++) {
        const uint32_t bit = (crc ^ (uint32_t)saved[at / 8U] >> at % 8U) & 1U;
        crc = crc >> 1 ^ (bit != 0U ? 0xEDB88320U : 0U);
    }
    for (unsigned i = 0; i < 4U; i++) {
        saved[saved_bytes - 4U + i] = (unsigned char)(~crc >> 8U * i);
    }
}

/* A snapshot with 0xB4 from a place on: its checksum fits where `mended`. */
static selfcal_status_t restore_spoiled(size_t from, size_t length, bool mended) {
    saved_bytes = 0;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_imu_save(&imu, put, NULL));
    fill(saved + from, saved_bytes - from);
    if (mended) {
        mend_crc();
    }
    return selfcal_imu_restore(&imu, saved, length > 0U ? length : saved_bytes, 3U);
}

static void begin_filled(void) {
    fill(&imu, sizeof imu);
    fill(&kept, sizeof kept);
    fill(memory, sizeof memory);
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_imu_init(&imu, &pipe, memory[0], sizeof memory[0]));
}

static void use_every_getter(void) {
    begin_filled();
    assert_nothing_known("begun");
    selfcal_imu_keep(&imu, &kept);
    assert_nothing_known("reports are kept");
    TEST_ASSERT_EQUAL(SELFCAL_TOO_SHORT, selfcal_imu_ask(&imu, SELFCAL_ALL_AXES));
    assert_nothing_known("no report can be made");
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_imu_work(&imu));
    assert_nothing_known("none is due");
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_imu_shift(&imu, AXES, 1.0F));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_imu_shift(&imu, 0, NAN));
    assert_nothing_known("a shift refused");
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_imu_shift(&imu, 0, 0.25F));
    assert_nothing_known("a shift");
    TEST_ASSERT_EQUAL(SELFCAL_WRITE_FAILED, selfcal_imu_save(&imu, full, NULL));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_imu_save(&imu, NULL, NULL));
    assert_nothing_known("a save failed");
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_imu_restore(&imu, NULL, 64U, 0U));
    TEST_ASSERT_EQUAL(SELFCAL_SNAPSHOT_FOREIGN, restore_spoiled(0U, 0U, false));
    TEST_ASSERT_EQUAL(SELFCAL_SNAPSHOT_TRUNCATED, restore_spoiled(saved_bytes - 1U, saved_bytes - 5U, false));
    TEST_ASSERT_EQUAL(SELFCAL_SNAPSHOT_TOO_LONG, restore_spoiled(saved_bytes - 1U, saved_bytes + 1U, false));
    TEST_ASSERT_EQUAL(SELFCAL_SNAPSHOT_DAMAGED, restore_spoiled(saved_bytes / 2U, 0U, false));
    TEST_ASSERT_EQUAL(SELFCAL_SNAPSHOT_VERSION, restore_spoiled(8U, 0U, true));
    assert_nothing_known("a snapshot refused");
    TEST_ASSERT_EQUAL(SELFCAL_CORRUPT, restore_spoiled(24U, 0U, true));
    assert_nothing_known("a corrupt snapshot");
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_imu_power_on(&imu, 7U));
    assert_nothing_known("power on");
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_imu_forget(&imu));
    assert_nothing_known("forgotten");
    TEST_ASSERT_EQUAL(SELFCAL_BAD_MEMORY, selfcal_imu_init(&imu, &pipe, memory[0], 8U));
    begin_filled();
    assert_nothing_known("begun after a failure");
}

/* Memory that nobody has set, with all parts of a pipe and with none. */
static void test_getters_before_any_report(void) {
    use_every_getter();
    model.regressors = &regressors;
    pipe.columns = &selfcal_columns_code;
    use_every_getter();
    setUp();
    pipe = (selfcal_pipe_t){.model = &model, .rate_hz = (float)BLOCK};
    use_every_getter();
}

/* What was known is of the past: after selfcal_imu_forget(), and after a snapshot that left a bank without a sample. */
static void test_getters_after_all_is_lost(void) {
    for (unsigned keeps = 0; keeps < 4U; keeps++) {
        run_both(0.0F);
        imu.kept = keeps % 2U == 0U ? NULL : &kept;
        TEST_ASSERT_EQUAL(SELFCAL_BUSY, selfcal_imu_ask(&imu, 1U)); /* under way */
        TEST_ASSERT_EQUAL(SELFCAL_BUSY, selfcal_imu_work(&imu));
        if (keeps < 2U) {
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_imu_forget(&imu));
        } else {
            TEST_ASSERT_EQUAL(SELFCAL_CORRUPT, restore_spoiled(24U, 0U, true));
        }
        for (uint8_t axis = 0; axis < AXES; axis++) {
            TEST_ASSERT_NULL(selfcal_imu_report(&imu, axis));
            TEST_ASSERT_EQUAL(SELFCAL_NOT_JUDGED, selfcal_imu_judgement(&imu, axis)->state);
            TEST_ASSERT_TRUE(isnan(selfcal_imu_bias(&imu, axis)));
        }
        TEST_ASSERT_EQUAL(0U, selfcal_count(&imu.bank));
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_imu_work(&imu)); /* nothing is due any more */
    }
}

/* --- samples that come while a report is worked out --- */

static void feed(uint32_t samples) {
    for (uint32_t at = 0; at < samples; at++) {
        float reading[AXES];
        (void)draw_sample(0U, reading);
        (void)selfcal_imu_sample(&imu, reading, NULL, NULL);
    }
}

/* `calls` of work with every sample, and all reports asked for every ten intervals. */
static void superloop(uint32_t samples, unsigned calls) {
    for (uint32_t at = 0; at < samples; at++) {
        feed(1U);
        if (at % (10U * BLOCK) == 0U) {
            (void)selfcal_imu_ask(&imu, SELFCAL_ALL_AXES);
        }
        for (unsigned k = 0; k < calls; k++) {
            (void)selfcal_imu_work(&imu);
        }
    }
}

static void begin_alone(void) {
    pipe = (selfcal_pipe_t){.model = &model, .rate_hz = (float)BLOCK, .holding = pipe.holding};
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_imu_init(&imu, &pipe, memory[0], sizeof memory[0]));
    selfcal_imu_keep(&imu, &kept);
    feed(200U * BLOCK);
}

/* So few calls that no report can be done in a batch: the axes say so, and it is counted. */
static void test_a_report_that_samples_overtake_says_so(void) {
    begin_alone();
    superloop(400U * BLOCK, 1U);
    for (uint8_t axis = 0; axis < AXES; axis++) {
        TEST_ASSERT_NULL(selfcal_imu_report(&imu, axis));
        TEST_ASSERT_EQUAL(SELFCAL_REASON_OVERTAKEN, selfcal_imu_reason(&imu, axis));
    }
    TEST_ASSERT_GREATER_OR_EQUAL(AXES, selfcal_counters(&imu.bank)->overtaken);
}

/* One that is overtaken leaves the last one in force. */
static void test_an_older_report_stays(void) {
    begin_alone();
    feed(2000U * BLOCK); /* so that it is identified */
    (void)selfcal_imu_ask(&imu, 1U);
    while (selfcal_imu_work(&imu) == SELFCAL_BUSY) {
    }
    const uint32_t n = selfcal_imu_report(&imu, 0)->n;
    const selfcal_reason_t reason = selfcal_imu_reason(&imu, 0);
    superloop(100U * BLOCK, 1U);
    TEST_ASSERT_GREATER_THAN(0U, selfcal_counters(&imu.bank)->overtaken);
    TEST_ASSERT_EQUAL(n, selfcal_imu_report(&imu, 0)->n);
    TEST_ASSERT_EQUAL(SELFCAL_REASON_NONE, reason);
    TEST_ASSERT_EQUAL(SELFCAL_REASON_NONE, selfcal_imu_reason(&imu, 0));
    selfcal_corrected_t corrected;
    TEST_ASSERT_TRUE(selfcal_imu_corrected(&imu, &corrected));
    TEST_ASSERT_TRUE(isfinite(corrected.sd[0]) && isnan(corrected.sd[1]));
}

/* As many calls as the macro wants: each axis in its turn, though all are asked for before they can be done. */
static void test_each_axis_has_its_turn(void) {
    begin_alone();
    const unsigned wanted = SELFCAL_REPORT_CALLS(SELFCAL_MODEL_NODES, SELFCAL_MODEL_HYPOTHESES, 0U);
    superloop(500U * BLOCK, (wanted + BLOCK - 1U) / BLOCK);
    TEST_ASSERT_EQUAL(0U, selfcal_counters(&imu.bank)->overtaken);
    for (uint8_t axis = 0; axis < AXES; axis++) {
        TEST_ASSERT_NOT_NULL(selfcal_imu_report(&imu, axis));
        TEST_ASSERT_GREATER_THAN(600U, selfcal_imu_report(&imu, axis)->n);
    }
}

/* Bit for bit the report that the bank gives when the copy is taken, whatever comes then. */
static void assert_held(const char *what) {
    while (imu.work.bank != imu.held) {
        TEST_ASSERT_EQUAL_MESSAGE(SELFCAL_BUSY, selfcal_imu_work(&imu), what);
    }
    selfcal_report_t *truth = &parts.report;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_report(&parts.work, &imu.bank, imu.report.axis, truth));
    selfcal_status_t status = SELFCAL_BUSY;
    for (unsigned k = 0; status == SELFCAL_BUSY; k++) {
        feed(k < 300U ? BLOCK : 0U);
        status = selfcal_imu_work(&imu);
    }
    TEST_ASSERT_EQUAL_MESSAGE(SELFCAL_OK, status, what);
    const selfcal_report_t *got = selfcal_imu_report(&imu, truth->axis);
    TEST_ASSERT_EQUAL_MESSAGE(truth->n, got->n, what);
    TEST_ASSERT_EQUAL_MEMORY(truth->hypothesis, got->hypothesis, model.hypotheses * sizeof truth->hypothesis[0]);
    TEST_ASSERT_TRUE_MESSAGE(truth->bias_mean == got->bias_mean && truth->bias_sd == got->bias_sd, what);
    TEST_ASSERT_GREATER_THAN_MESSAGE(truth->n + 250U, selfcal_count(&imu.bank), what);
}

static void test_no_sample_overtakes_a_report_that_is_held(void) {
    pipe.holding = &selfcal_holding_code;
    begin_alone();
    for (uint8_t axis = 0; axis < AXES; axis += 2U) {
        TEST_ASSERT_EQUAL(SELFCAL_BUSY, selfcal_imu_ask(&imu, 1U << axis));
        assert_held("plain laws");
    }
    superloop(2500U * BLOCK, 1U); /* as little work as above: now every axis has its report */
    TEST_ASSERT_EQUAL(0U, selfcal_counters(&imu.bank)->overtaken);
    for (uint8_t axis = 0; axis < AXES; axis++) {
        TEST_ASSERT_GREATER_THAN(selfcal_count(&imu.bank) - 1000U, selfcal_imu_report(&imu, axis)->n);
    }
}

/* Both reports of an axis with regressors rest on the same sums, though samples come between them. */
static void test_the_two_reports_of_an_axis_rest_on_the_same_sums(void) {
    model.regressors = &regressors;
    pipe.columns = &selfcal_columns_code;
    for (unsigned held = 0; held < 2U; held++) {
        float probability[2];
        for (unsigned between = 0; between < 2U; between++) {
            state = 77U;
            pipe = (selfcal_pipe_t){.model = &model,
                                    .rate_hz = (float)BLOCK,
                                    .columns = &selfcal_columns_code,
                                    .holding = held != 0U ? &selfcal_holding_code : NULL};
            TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_imu_init(&imu, &pipe, memory[0], sizeof memory[0]));
            feed(300U * BLOCK);
            TEST_ASSERT_EQUAL(SELFCAL_BUSY, selfcal_imu_ask(&imu, 1U));
            while (!imu.columns->with) {
                TEST_ASSERT_EQUAL(SELFCAL_BUSY, selfcal_imu_work(&imu));
            }
            feed(between * 5U * BLOCK); /* each is worth some nats */
            while (selfcal_imu_work(&imu) == SELFCAL_BUSY) {
            }
            TEST_ASSERT_NOT_NULL(selfcal_imu_report(&imu, 0));
            probability[between] = selfcal_imu_coefficients(&imu, 0)->probability;
        }
        TEST_ASSERT_TRUE(probability[0] == probability[1]);
    }
}

/* A copy outlives samples, but not a change of its own axis. */
static void test_a_change_ends_a_report_that_is_held(void) {
    static const selfcal_handling_t steps = {0.0F, true, false};
    model.handling = &steps;
    for (uint8_t asked = 0; asked < 2U; asked++) {
        state = 20261127U;
        pipe = (selfcal_pipe_t){.model = &model,
                                .rate_hz = (float)BLOCK,
                                .judging = &selfcal_judging_code,
                                .changes = &selfcal_changes_code,
                                .holding = &selfcal_holding_code};
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_imu_init(&imu, &pipe, memory[0], sizeof memory[0]));
        selfcal_imu_keep(&imu, &kept);
        feed(300U * BLOCK);
        (void)selfcal_imu_ask(&imu, SELFCAL_ALL_AXES);
        while (selfcal_imu_work(&imu) == SELFCAL_BUSY) {
        }
        feed(600U * BLOCK);
        (void)selfcal_imu_ask(&imu, 1U << asked);
        while (imu.work.bank != imu.held) {
            TEST_ASSERT_EQUAL(SELFCAL_BUSY, selfcal_imu_work(&imu));
        }
        uint32_t changed = 0;
        for (uint32_t at = 0; changed == 0U && at < 200U * BLOCK; at++) {
            float reading[AXES];
            (void)draw_sample(0U, reading);
            reading[1] += 2.0F; /* 20 deviations of a bank sample */
            changed = selfcal_imu_sample(&imu, reading, NULL, NULL) & SELFCAL_ALL_AXES;
        }
        TEST_ASSERT_EQUAL(1U << 1, changed);
        selfcal_status_t status = SELFCAL_BUSY;
        while (status == SELFCAL_BUSY) {
            status = selfcal_imu_work(&imu);
        }
        TEST_ASSERT_EQUAL(asked == 1U ? SELFCAL_OVERTAKEN : SELFCAL_OK, status);
        TEST_ASSERT_NULL(selfcal_imu_report(&imu, 1));
        TEST_ASSERT_NOT_NULL(selfcal_imu_report(&imu, 0));
    }
}

/* Compiled with other sizes than the library: nothing is written. */
static void test_another_build_is_refused(void) {
    static unsigned char before[sizeof imu];
    fill(&imu, sizeof imu);
    memcpy(before, &imu, sizeof imu);
    const uint32_t other = SELFCAL_LAYOUT + (uint32_t)sizeof(float);
    TEST_ASSERT_EQUAL(SELFCAL_BAD_BUILD, selfcal_imu_init_as(other, &imu, &pipe, memory[0], sizeof memory[0]));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_BUILD, selfcal_init_as(other, &imu.bank, &model, memory[0], sizeof memory[0]));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_BUILD,
                      selfcal_restore_as(other, &imu.bank, &model, memory[0], sizeof memory[0], saved, 64U));
    TEST_ASSERT_EQUAL_MEMORY(before, &imu, sizeof imu);
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(test_it_is_what_its_parts_are);
    RUN_TEST(test_the_likelier_report_counts);
    RUN_TEST(test_a_corrected_sample_is_the_reading_less_the_predicted_bias);
    RUN_TEST(test_a_restored_pipe_goes_on_at_the_start_of_an_interval);
    RUN_TEST(test_reports_from_before_are_not_in_a_new_place);
    RUN_TEST(test_what_the_sensor_adds_moves_with_it);
    RUN_TEST(test_what_does_not_go_together_is_refused);
    RUN_TEST(test_a_pipe_without_parts_is_a_bank);
    RUN_TEST(test_getters_before_any_report);
    RUN_TEST(test_getters_after_all_is_lost);
    RUN_TEST(test_a_report_that_samples_overtake_says_so);
    RUN_TEST(test_an_older_report_stays);
    RUN_TEST(test_each_axis_has_its_turn);
    RUN_TEST(test_no_sample_overtakes_a_report_that_is_held);
    RUN_TEST(test_the_two_reports_of_an_axis_rest_on_the_same_sums);
    RUN_TEST(test_a_change_ends_a_report_that_is_held);
    RUN_TEST(test_another_build_is_refused);
    return UNITY_END();
}
