/* The frames against the format in words (the comment of lib/selfcal.dbc), taken apart here without selfcal_frames.h.
 * Every item's bits against the DBC: tests/lib/test_wire.py. */
#include "selfcal.h"

#include "named_laws.h"
#include "unity.h"

#include <math.h>
#include <string.h>

static const selfcal_axis_t axis_table[2];
static const selfcal_grid_t grid; /* a hypothesis has the places whose grids it has */
static const selfcal_hypothesis_t all_laws[] = {{&named_law[GAUSS_MARKOV], 0.0F, &grid, &grid, NULL},
                                                {&named_law[CONSTANT], 0.0F, NULL, NULL, NULL},
                                                {&named_law[RANDOM_WALK], 0.0F, &grid, NULL, NULL}};
static const selfcal_model_t full = {0xCAFEF00DU, 1.0F, 100, 2, 3, 3, axis_table, all_laws, NULL, NULL, NULL, NULL};
static const char *const names[] = {"ay", "gx"};
enum { GX = 0x201, AY = 0x205, GX_H0 = 0x220, AY_H0 = 0x240, GX_COEFFICIENTS = 0x20A }; /* of node 0 */

static selfcal_telemetry_t telemetry;
static selfcal_counters_t counters;
static selfcal_report_t report;

void setUp(void) {
    memset(&counters, 0, sizeof counters);
    memset(&report, 0, sizeof report);
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_init(&telemetry, &full, names));
}

void tearDown(void) {}

static uint64_t bits(const selfcal_frame_t *frame) {
    uint64_t all = 0;
    for (unsigned i = 0; i < 8; i++) {
        all |= (uint64_t)frame->data[i] << (8U * i);
    }
    return all;
}

static uint32_t value(const selfcal_frame_t *frame) {
    return (uint32_t)bits(frame);
}

static uint32_t field(const selfcal_frame_t *frame, unsigned start, unsigned length) {
    return (uint32_t)(bits(frame) >> start & ((1ULL << length) - 1U));
}

/* Next frame, which must carry `item`. */
static selfcal_frame_t next(uint32_t item) {
    selfcal_frame_t frame;
    TEST_ASSERT_TRUE(selfcal_telemetry_next(&telemetry, &frame));
    TEST_ASSERT_EQUAL_UINT32(item, field(&frame, 32, 6));
    return frame;
}

/* Next frame, which must carry `item` of the message `id`. */
static selfcal_frame_t next_of(uint16_t id, uint32_t item) {
    const selfcal_frame_t frame = next(item);
    TEST_ASSERT_EQUAL_HEX16(id, frame.id);
    return frame;
}

/* All frames; returns how many. */
static unsigned drain(void) {
    selfcal_frame_t frame;
    unsigned count = 0;
    while (selfcal_telemetry_next(&telemetry, &frame)) {
        count++;
    }
    return count;
}

static uint32_t bits_of(float number) {
    uint32_t all;
    memcpy(&all, &number, sizeof all);
    return all;
}

/* Published check value of CRC-12/CDMA2000 (catalogue of parametrised CRC algorithms, G. Cook): "123456789" gives
 * 0xD4D. */
static void test_crc_check_value(void) {
    TEST_ASSERT_EQUAL_HEX16(0xD4D, selfcal_crc12((const uint8_t *)"123456789", 9));
}

/* The checksum by long division of the covered bits, one bit at a time, as the DBC states them. */
static uint32_t crc_by_division(const selfcal_frame_t *frame) {
    const uint8_t covered[10] = {(uint8_t)(frame->id >> 8),
                                 (uint8_t)(frame->id & 0xFFU),
                                 frame->length,
                                 frame->data[0],
                                 frame->data[1],
                                 frame->data[2],
                                 frame->data[3],
                                 frame->data[4],
                                 frame->data[5],
                                 (uint8_t)(frame->data[6] & 0x0FU)};
    uint32_t remainder = 0xFFFU;
    for (unsigned bit = 0; bit < 8U * sizeof covered; bit++) {
        const uint32_t in = ((uint32_t)covered[bit / 8U] >> (7U - bit % 8U)) & 1U;
        const bool subtract = (remainder >> 11 ^ in) == 1U;
        remainder = (remainder << 1 & 0xFFFU) ^ (subtract ? 0xF13U : 0U);
    }
    return remainder;
}

static void test_every_frame_has_form_counter_time_and_checksum(void) {
    const uint32_t time_ms = 4294967295U; /* the last before it wraps: 4294967 s */
    for (unsigned counter = 0; counter < 300;) {
        report.axis = (uint8_t)(counter % 2U);
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_report(&telemetry, &report, &counters, time_ms));
        selfcal_frame_t frame;
        while (selfcal_telemetry_next(&telemetry, &frame)) {
            const uint16_t axis = report.axis == 0 ? AY : GX, first = report.axis == 0 ? AY_H0 : GX_H0;
            TEST_ASSERT_TRUE(frame.id == axis || (frame.id >= first && frame.id < first + 3));
            TEST_ASSERT_EQUAL_UINT8(8, frame.length);
            TEST_ASSERT_EQUAL_UINT32(counter++ % 64U, field(&frame, 38, 6));
            TEST_ASSERT_EQUAL_UINT32(4294967U % 256U, field(&frame, 44, 8));
            TEST_ASSERT_EQUAL_HEX32(crc_by_division(&frame), field(&frame, 52, 12));
        }
    }
}

static void test_full_report_is_opening_hypotheses_and_end(void) {
    const uint32_t time_ms = 0x12345678U;
    static const uint32_t last_item[] = {17, 7, 12}; /* three places, one, two */
    report.axis = 1;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_report(&telemetry, &report, &counters, time_ms));
    selfcal_frame_t frame = next_of(GX, 0);
    TEST_ASSERT_EQUAL_HEX32(time_ms, value(&frame));
    for (uint32_t item = 1; item < 6; item++) {
        (void)next_of(GX, item);
    }
    for (uint16_t k = 0; k < 3; k++) {
        for (uint32_t item = 0; item <= last_item[k]; item++) {
            (void)next_of((uint16_t)(GX_H0 + k), item);
        }
    }
    frame = next_of(GX, 43);
    TEST_ASSERT_EQUAL_HEX32(0x345678, field(&frame, 0, 24));
    TEST_ASSERT_EQUAL_UINT32(46, field(&frame, 24, 8));
    TEST_ASSERT_FALSE(selfcal_telemetry_next(&telemetry, &frame));
}

/* Place 1 is K if the law has a walk, else the deviation. Place 2 has the grid alpha. Every statistic and flag is its
 * own. */
static void test_each_place_carries_its_parameter(void) {
    static const selfcal_parameter_t parameter[3][3] = {{SELFCAL_N, SELFCAL_SIGMA_M, SELFCAL_ALPHA},
                                                        {SELFCAL_N, SELFCAL_PARAMETERS, SELFCAL_PARAMETERS},
                                                        {SELFCAL_N, SELFCAL_K, SELFCAL_PARAMETERS}};
    for (unsigned k = 0; k < 3; k++) {
        for (unsigned q = 0; q < SELFCAL_PARAMETERS; q++) {
            const float base = (float)(100U * k + 10U * q);
            const selfcal_estimate_t estimate = {.mean = base,
                                                 .median = base + 1.0F,
                                                 .sd = base + 2.0F,
                                                 .q05 = base + 3.0F,
                                                 .q95 = base + 4.0F,
                                                 .flags = (uint8_t)(1U + q + k)};
            report.hypothesis[k].parameter[q] = estimate;
        }
    }
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_report(&telemetry, &report, &counters, 0));
    for (uint32_t item = 0; item < 6; item++) {
        (void)next_of(AY, item);
    }
    for (unsigned k = 0; k < 3; k++) {
        const uint16_t id = (uint16_t)(AY_H0 + k);
        uint32_t flags = 0;
        (void)next_of(id, 0);
        (void)next_of(id, 1);
        const selfcal_frame_t told = next_of(id, 2);
        for (unsigned place = 0; place < 3; place++) {
            const unsigned q = parameter[k][place];
            if (q == SELFCAL_PARAMETERS) {
                continue;
            }
            flags |= (1U + q + k) << (4U * place);
            for (unsigned statistic = 0; statistic < 5; statistic++) { /* mean, median, sd, q05, q95 */
                const selfcal_frame_t frame = next_of(id, 3U + 5U * place + statistic);
                TEST_ASSERT_EQUAL_HEX32(bits_of((float)(100U * k + 10U * q + statistic)), value(&frame));
            }
        }
        TEST_ASSERT_EQUAL_HEX32(flags, value(&told));
    }
    (void)next_of(AY, 43);
}

static void test_the_same_law_may_stand_more_than_once(void) {
    static selfcal_hypothesis_t same[9];
    static selfcal_model_t model;
    TEST_ASSERT_TRUE(SELFCAL_HYPOTHESES_MAX >= 4);
    for (unsigned k = 0; k < 9; k++) {
        same[k].law = &named_law[RANDOM_WALK];
        same[k].rho = &grid;
    }
    model = full;
    model.hypothesis = same;
    model.hypotheses = SELFCAL_HYPOTHESES_MAX < 8 ? SELFCAL_HYPOTHESES_MAX : 8;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_init(&telemetry, &model, names));
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_report(&telemetry, &report, &counters, 0));
    (void)next_of(AY, 0);
    (void)next_of(AY, 1);
    const selfcal_frame_t frame = next_of(AY, 2);
    TEST_ASSERT_EQUAL_UINT32(model.hypotheses, field(&frame, 8, 4));
    TEST_ASSERT_EQUAL_UINT(4U + 13U * model.hypotheses, drain());
    model.hypotheses = 9;
    TEST_ASSERT_EQUAL(SELFCAL_BAD_MODEL, selfcal_telemetry_init(&telemetry, &model, names));
}

/* Columns by place, before the end; one of which nothing is known is left out. */
static void test_coefficients_are_sent_by_column(void) {
    static const selfcal_regressors_t regressors = {.count = 3};
    static const selfcal_sent_coefficient_t column[] = {{0.25F, 0.5F, 0.75F}, {NAN, NAN, NAN}, {-2.0F, 4.0F, 1.0F}};
    selfcal_model_t model = full;
    model.regressors = &regressors;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_init(&telemetry, &model, names));
    selfcal_telemetry_coefficients(&telemetry, column);
    report.axis = 1;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_report(&telemetry, &report, &counters, 0));
    selfcal_frame_t frame = next_of(GX, 0);
    (void)next_of(GX, 1);
    frame = next_of(GX, 2);
    TEST_ASSERT_EQUAL_UINT32(2, field(&frame, 12, 3));
    while (frame.id != GX_COEFFICIENTS) {
        TEST_ASSERT_TRUE(selfcal_telemetry_next(&telemetry, &frame));
    }
    static const uint32_t items[] = {0, 1, 2, 6, 7, 8};
    static const float numbers[] = {0.25F, 0.5F, 0.75F, -2.0F, 4.0F, 1.0F};
    for (unsigned i = 0; i < 6; i++) {
        TEST_ASSERT_EQUAL_UINT32(items[i], field(&frame, 32, 6));
        TEST_ASSERT_EQUAL_HEX32(bits_of(numbers[i]), value(&frame));
        TEST_ASSERT_TRUE(selfcal_telemetry_next(&telemetry, &frame));
    }
    TEST_ASSERT_EQUAL_HEX16(GX, frame.id);
    TEST_ASSERT_EQUAL_UINT32(46 + 6, field(&frame, 24, 8));
    selfcal_telemetry_coefficients(&telemetry, NULL);
    TEST_ASSERT_EQUAL(0, drain());
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_report(&telemetry, &report, &counters, 0));
    TEST_ASSERT_EQUAL_UINT(46, drain());
}

/* Node n has the identifiers of node 0, 128 n higher; the checksum covers them. */
static void test_a_node_has_identifiers_of_its_own(void) {
    for (uint8_t node = 0; node < 12; node++) {
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_node(&telemetry, node));
        const uint16_t first = (uint16_t)(0x200U + 128U * node);
        selfcal_frame_t frame;
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_status(&telemetry, &counters, SELFCAL_RUNNING, 1, 0));
        while (selfcal_telemetry_next(&telemetry, &frame)) {
            TEST_ASSERT_EQUAL_HEX16(first, frame.id);
            TEST_ASSERT_EQUAL_HEX32(crc_by_division(&frame), field(&frame, 52, 12));
        }
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_report(&telemetry, &report, &counters, 0));
        while (selfcal_telemetry_next(&telemetry, &frame)) {
            TEST_ASSERT_TRUE(frame.id == first + 5U || (frame.id >= first + 0x40U && frame.id < first + 0x43U));
        }
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_answer(&telemetry, 1, 0, 0));
        TEST_ASSERT_EQUAL(SELFCAL_BUSY, selfcal_telemetry_node(&telemetry, 0));
        frame = next(1);
        TEST_ASSERT_EQUAL_HEX16(first + 9U, frame.id);
        TEST_ASSERT_TRUE(frame.id <= 0x7FF);
        TEST_ASSERT_EQUAL(0, drain());
    }
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_telemetry_node(&telemetry, 12));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_telemetry_node(NULL, 0));
}

static void test_evidences_are_differences_to_the_best_held_at_the_ends(void) {
    report.hypothesis[0].ln_evidence = -1000.0;
    report.hypothesis[1].ln_evidence = -1.0e12;     /* beyond 2^31 steps */
    report.hypothesis[2].ln_evidence = -1001.23456; /* in steps of 0.001 */
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_report(&telemetry, &report, &counters, 0));
    selfcal_frame_t frame;
    while (selfcal_telemetry_next(&telemetry, &frame)) {
        if (frame.id == AY && field(&frame, 32, 6) == 3) {
            TEST_ASSERT_EQUAL_HEX32(0xC47A0000, value(&frame)); /* IEEE 754 single -1000.0 */
        } else if (frame.id != AY && field(&frame, 32, 6) == 1) {
            static const int32_t want[] = {0, INT32_MIN, -1235};
            TEST_ASSERT_EQUAL_INT32(want[frame.id - AY_H0], (int32_t)value(&frame));
        }
    }
    report.hypothesis[1].ln_evidence = -(selfcal_wide_t)INFINITY;
    report.hypothesis[2].ln_evidence = (selfcal_wide_t)NAN;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_report(&telemetry, &report, &counters, 0));
    while (selfcal_telemetry_next(&telemetry, &frame)) {
        if (frame.id > AY_H0 && field(&frame, 32, 6) == 1) {
            TEST_ASSERT_EQUAL_HEX32(0x80000000, value(&frame));
        }
    }
}

static void test_health_flags_are_the_axis_s_own(void) {
    counters.stuck[1] = 1;
    counters.gaps = 1;
    counters.outliers[1] = 5;
    /* bit 2 stuck, bit 3 gaps; three hypotheses in bits 8 to 11; outliers in bits 16 to 31 */
    const uint32_t want[2] = {0x308, 0x5030C};
    for (uint8_t axis = 0; axis < 2; axis++) {
        report.axis = axis;
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_report(&telemetry, &report, &counters, 0));
        (void)next(0);
        (void)next(1);
        const selfcal_frame_t frame = next(2);
        TEST_ASSERT_EQUAL_HEX32(want[axis], value(&frame));
        (void)drain();
    }
}

static void test_status_counts_stop_at_the_end_of_their_range(void) {
    counters.samples = 0x1FFFFFFFFULL;
    counters.saturated[0] = 0xFFFFFFFFU;
    counters.saturated[1] = 2;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_status(&telemetry, &counters, SELFCAL_FINISHED, 3, 5000));
    selfcal_frame_t frame;
    for (uint32_t item = 0; item < 46; item++) {
        frame = next(item);
        TEST_ASSERT_EQUAL_HEX16(0x200, frame.id);
        switch (item) {
        case 1: TEST_ASSERT_EQUAL_UINT32(4, value(&frame)); break;
        case 2: TEST_ASSERT_EQUAL_HEX32(0xCAFEF00D, value(&frame)); break;
        case 5: TEST_ASSERT_EQUAL_UINT32(2, value(&frame)); break;
        case 6: TEST_ASSERT_EQUAL_UINT32(3, value(&frame)); break;
        case 7:
        case 13: TEST_ASSERT_EQUAL_HEX32(0xFFFFFFFF, value(&frame)); break;
        case 45: TEST_ASSERT_EQUAL_UINT32(45, value(&frame)); break; /* frames before this one */
        default: break;
        }
    }
    TEST_ASSERT_FALSE(selfcal_telemetry_next(&telemetry, &frame));
}

static void test_busy_until_all_frames_are_fetched(void) {
    selfcal_frame_t frame;
    TEST_ASSERT_FALSE(selfcal_telemetry_next(&telemetry, &frame));
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_report(&telemetry, &report, &counters, 0));
    (void)next(0);
    TEST_ASSERT_EQUAL(SELFCAL_BUSY, selfcal_telemetry_report(&telemetry, &report, &counters, 1));
    TEST_ASSERT_EQUAL(SELFCAL_BUSY, selfcal_telemetry_status(&telemetry, &counters, SELFCAL_RUNNING, 1, 1));
    TEST_ASSERT_EQUAL_UINT(45, drain());
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_status(&telemetry, &counters, SELFCAL_RUNNING, 1, 1));
}

/* gx is axis 1 of the model and item 1 (its sd 7), ay axis 0 and item 5 (11); an axis without sd, and axes the model
 * has not, are left out. */
static void test_a_corrected_sample_goes_out_by_axis(void) {
    selfcal_corrected_t corrected = {
        {0.25F, -1.5F}, {0.5F, 0.125F}, 2U, {SELFCAL_REASON_NOT_IDENTIFIED, SELFCAL_REASON_NONE}};
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_corrected(&telemetry, &corrected, 70000));
    static const struct {
        uint32_t item;
        float value;
    } want[] = {{1, -1.5F}, {5, 0.25F}, {7, 0.125F}, {11, 0.5F}};
    selfcal_frame_t frame = next(0);
    TEST_ASSERT_EQUAL_HEX16(0x207, frame.id);
    TEST_ASSERT_EQUAL_UINT32(70000, value(&frame));
    TEST_ASSERT_EQUAL(SELFCAL_BUSY, selfcal_telemetry_corrected(&telemetry, &corrected, 0));
    TEST_ASSERT_EQUAL(SELFCAL_BUSY, selfcal_telemetry_answer(&telemetry, 0, 0, 0));
    for (size_t i = 0; i < sizeof want / sizeof want[0]; i++) {
        frame = next(want[i].item);
        uint32_t bits_wanted;
        memcpy(&bits_wanted, &want[i].value, sizeof bits_wanted);
        TEST_ASSERT_EQUAL_HEX32(bits_wanted, value(&frame));
    }
    frame = next(13);
    TEST_ASSERT_EQUAL_HEX32(2U | 8U << 24, value(&frame)); /* ay is the fifth axis: bits 24 to 27 */
    TEST_ASSERT_FALSE(selfcal_telemetry_next(&telemetry, &frame));
    corrected.sd[0] = NAN;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_corrected(&telemetry, &corrected, 0));
    TEST_ASSERT_EQUAL_UINT(4, drain());
}

/* 32 words at most: a bit of `there` each. */
static void test_words_are_one_to_32(void) {
    static const uint32_t word[33] = {5U};
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_telemetry_words(&telemetry, 0x207, word, 0, ~0U, 0));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_telemetry_words(&telemetry, 0x207, word, 33, ~0U, 0));
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_words(&telemetry, 0x207, word, 32, ~0U, 0));
    TEST_ASSERT_EQUAL_UINT(33, drain());
}

static void test_an_answer_is_one_frame(void) {
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_answer(&telemetry, 1, 0x0305, 9000));
    selfcal_frame_t frame = next(1);
    TEST_ASSERT_EQUAL_HEX16(0x209, frame.id);
    TEST_ASSERT_EQUAL_HEX32(0x0305, value(&frame));
    TEST_ASSERT_FALSE(selfcal_telemetry_next(&telemetry, &frame));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_telemetry_answer(&telemetry, 2, 0, 0));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_telemetry_answer(NULL, 0, 0, 0));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_telemetry_corrected(&telemetry, NULL, 0));
}

static void test_bad_arguments_and_models_are_refused(void) {
    static const char *const unknown[] = {"ay", "mx"};
    static const char *const twice[] = {"gx", "gx"};
    static const char *const none[] = {"gx", NULL};
    selfcal_telemetry_t other;
    TEST_ASSERT_EQUAL(SELFCAL_BAD_MODEL, selfcal_telemetry_init(&other, &full, unknown));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_MODEL, selfcal_telemetry_init(&other, &full, twice));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_telemetry_init(NULL, &full, names));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_telemetry_init(&other, NULL, names));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_telemetry_init(&other, &full, NULL));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_telemetry_init(&other, &full, none));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_telemetry_report(&telemetry, NULL, &counters, 0));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_telemetry_report(&telemetry, &report, NULL, 0));
    report.axis = 2;
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_telemetry_report(&telemetry, &report, &counters, 0));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_telemetry_status(&telemetry, NULL, SELFCAL_RUNNING, 1, 0));
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(test_crc_check_value);
    RUN_TEST(test_every_frame_has_form_counter_time_and_checksum);
    RUN_TEST(test_full_report_is_opening_hypotheses_and_end);
    RUN_TEST(test_each_place_carries_its_parameter);
    RUN_TEST(test_the_same_law_may_stand_more_than_once);
    RUN_TEST(test_coefficients_are_sent_by_column);
    RUN_TEST(test_a_node_has_identifiers_of_its_own);
    RUN_TEST(test_evidences_are_differences_to_the_best_held_at_the_ends);
    RUN_TEST(test_health_flags_are_the_axis_s_own);
    RUN_TEST(test_status_counts_stop_at_the_end_of_their_range);
    RUN_TEST(test_busy_until_all_frames_are_fetched);
    RUN_TEST(test_a_corrected_sample_goes_out_by_axis);
    RUN_TEST(test_words_are_one_to_32);
    RUN_TEST(test_an_answer_is_one_frame);
    RUN_TEST(test_bad_arguments_and_models_are_refused);
    return UNITY_END();
}
