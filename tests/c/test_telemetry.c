/* The frames against the format in words (the comment of lib/selfcal.dbc), taken apart here without selfcal_frames.h.
 * Every item's bits against the DBC: tests/py/test_wire.py. */
#include "selfcal.h"

#include "laws.h"
#include "unity.h"

#include <math.h>
#include <string.h>

static const selfcal_axis_t axis_table[2];
static const selfcal_hypothesis_t all_laws[] = {
    {&named_law[GAUSS_MARKOV], 0.0F, NULL, NULL, NULL},
    {&named_law[CONSTANT], 0.0F, NULL, NULL, NULL},
    {&named_law[RANDOM_WALK], 0.0F, NULL, NULL, NULL}};
static const selfcal_model_t full = {0xCAFEF00DU, 1.0F, 100, 2, 3, 3, axis_table, all_laws, NULL, NULL};
static const char *const names[] = {"ay", "gx"};

static selfcal_telemetry_t telemetry;
static selfcal_counters_t counters;
static selfcal_report_t report;

void setUp(void)
{
    memset(&counters, 0, sizeof counters);
    memset(&report, 0, sizeof report);
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_init(&telemetry, &full, names));
}

void tearDown(void) {}

static uint64_t bits(const selfcal_frame_t *frame)
{
    uint64_t all = 0;
    for (unsigned i = 0; i < 8; i++) {
        all |= (uint64_t)frame->data[i] << (8U * i);
    }
    return all;
}

static uint32_t value(const selfcal_frame_t *frame)
{
    return (uint32_t)bits(frame);
}

static uint32_t field(const selfcal_frame_t *frame, unsigned start, unsigned length)
{
    return (uint32_t)(bits(frame) >> start & ((1ULL << length) - 1U));
}

/* Next frame, which must carry `item`. */
static selfcal_frame_t next(uint32_t item)
{
    selfcal_frame_t frame;
    TEST_ASSERT_TRUE(selfcal_telemetry_next(&telemetry, &frame));
    TEST_ASSERT_EQUAL_UINT32(item, field(&frame, 32, 6));
    return frame;
}

/* All frames; returns how many, and the items in a mask. */
static unsigned drain(uint64_t *items)
{
    selfcal_frame_t frame;
    unsigned count = 0;
    *items = 0;
    while (selfcal_telemetry_next(&telemetry, &frame)) {
        *items |= 1ULL << field(&frame, 32, 6);
        count++;
    }
    return count;
}

/* Published check value of CRC-12/CDMA2000 (catalogue of parametrised CRC algorithms, G. Cook): "123456789" gives 0xD4D. */
static void test_crc_check_value(void)
{
    TEST_ASSERT_EQUAL_HEX16(0xD4D, selfcal_crc12((const uint8_t *)"123456789", 9));
}

/* The checksum by long division of the covered bits, one bit at a time, as the DBC states them. */
static uint32_t crc_by_division(const selfcal_frame_t *frame)
{
    const uint8_t covered[10] = {(uint8_t)(frame->id >> 8), (uint8_t)(frame->id & 0xFFU), frame->length,
                                 frame->data[0], frame->data[1], frame->data[2], frame->data[3], frame->data[4],
                                 frame->data[5], (uint8_t)(frame->data[6] & 0x0FU)};
    uint32_t remainder = 0xFFFU;
    for (unsigned bit = 0; bit < 8U * sizeof covered; bit++) {
        const uint32_t in = ((uint32_t)covered[bit / 8U] >> (7U - bit % 8U)) & 1U;
        const bool subtract = (remainder >> 11 ^ in) == 1U;
        remainder = (remainder << 1 & 0xFFFU) ^ (subtract ? 0xF13U : 0U);
    }
    return remainder;
}

static void test_every_frame_has_form_counter_time_and_checksum(void)
{
    const uint32_t time_ms = 4294967295U; /* the last before it wraps: 4294967 s */
    for (unsigned counter = 0; counter < 300;) {
        report.axis = (uint8_t)(counter % 2U);
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_report(&telemetry, &report, &counters, time_ms));
        selfcal_frame_t frame;
        while (selfcal_telemetry_next(&telemetry, &frame)) {
            TEST_ASSERT_EQUAL_HEX16(report.axis == 0 ? 0x205 : 0x201, frame.id); /* ay, gx */
            TEST_ASSERT_EQUAL_UINT8(8, frame.length);
            TEST_ASSERT_EQUAL_UINT32(counter++ % 64U, field(&frame, 38, 6));
            TEST_ASSERT_EQUAL_UINT32(4294967U % 256U, field(&frame, 44, 8));
            TEST_ASSERT_EQUAL_HEX32(crc_by_division(&frame), field(&frame, 52, 12));
        }
    }
}

static void test_full_report_has_44_frames_opened_and_closed(void)
{
    const uint32_t time_ms = 0x12345678U;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_report(&telemetry, &report, &counters, time_ms));
    selfcal_frame_t frame = next(0);
    TEST_ASSERT_EQUAL_HEX32(time_ms, value(&frame));
    for (uint32_t item = 1; item < 43; item++) {
        (void)next(item);
    }
    frame = next(43);
    TEST_ASSERT_EQUAL_HEX32(0x345678, field(&frame, 0, 24));
    TEST_ASSERT_EQUAL_UINT32(44, field(&frame, 24, 8));
    TEST_ASSERT_FALSE(selfcal_telemetry_next(&telemetry, &frame));
}

static void test_items_of_absent_hypotheses_are_not_sent(void)
{
    static const selfcal_hypothesis_t two[] = {{&named_law[RANDOM_WALK], 0.0F, NULL, NULL, NULL},
                                               {&named_law[CONSTANT], 0.0F, NULL, NULL, NULL}};
    static const selfcal_model_t model = {1, 1.0F, 1, 2, 2, 2, axis_table, two, NULL, NULL};
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_init(&telemetry, &model, names));
    report.hypothesis[0].parameter[SELFCAL_K].median = 7.0F;
    report.hypothesis[0].parameter[SELFCAL_K].flags = 5;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_report(&telemetry, &report, &counters, 0));
    selfcal_frame_t frame;
    uint64_t items = 0;
    unsigned count = 0;
    while (selfcal_telemetry_next(&telemetry, &frame)) {
        const uint32_t item = field(&frame, 32, 6);
        items |= 1ULL << item;
        count++;
        if (item == 12) {
            TEST_ASSERT_EQUAL_HEX32(0x500, value(&frame)); /* random_walk_K_flags: bits 8 to 11 */
        } else if (item == 24) {
            TEST_ASSERT_EQUAL_HEX32(0x40E00000, value(&frame)); /* random_walk_K_median: IEEE 754 single 7.0 */
        } else if (item == 43) {
            TEST_ASSERT_EQUAL_UINT32(count, field(&frame, 24, 8));
        }
    }
    /* 0 to 5, probabilities 6 7, evidences 9 10, flags 12, estimates 13 to 27, end 43 */
    TEST_ASSERT_EQUAL_HEX64(0x3FULL | 0x3ULL << 6 | 0x3ULL << 9 | 1ULL << 12 | 0x7FFFULL << 13 | 1ULL << 43, items);
    TEST_ASSERT_EQUAL_UINT32(27, count);
}

static void test_evidences_are_differences_to_the_best_held_at_the_ends(void)
{
    report.hypothesis[0].ln_evidence = -1000.0;     /* Gauss-Markov: item 11 */
    report.hypothesis[1].ln_evidence = -1.0e12;     /* constant: item 9, beyond 2^31 steps */
    report.hypothesis[2].ln_evidence = -1001.23456; /* random walk: item 10, in steps of 0.001 */
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_report(&telemetry, &report, &counters, 0));
    selfcal_frame_t frame;
    while (selfcal_telemetry_next(&telemetry, &frame)) {
        switch (field(&frame, 32, 6)) {
        case 3: TEST_ASSERT_EQUAL_HEX32(0xC47A0000, value(&frame)); break; /* IEEE 754 single -1000.0 */
        case 9: TEST_ASSERT_EQUAL_HEX32(0x80000000, value(&frame)); break;
        case 10: TEST_ASSERT_EQUAL_INT32(-1235, (int32_t)value(&frame)); break;
        case 11: TEST_ASSERT_EQUAL_INT32(0, (int32_t)value(&frame)); break;
        default: break;
        }
    }
    report.hypothesis[1].ln_evidence = -(selfcal_wide_t)INFINITY;
    report.hypothesis[2].ln_evidence = (selfcal_wide_t)NAN;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_report(&telemetry, &report, &counters, 0));
    while (selfcal_telemetry_next(&telemetry, &frame)) {
        if (field(&frame, 32, 6) == 9 || field(&frame, 32, 6) == 10) {
            TEST_ASSERT_EQUAL_HEX32(0x80000000, value(&frame));
        }
    }
}

static void test_health_flags_are_the_axis_s_own(void)
{
    counters.stuck[1] = 1;
    counters.gaps = 1;
    const uint32_t want[2] = {0x08, 0x0C}; /* bit 2 stuck, bit 3 gaps */
    for (uint8_t axis = 0; axis < 2; axis++) {
        report.axis = axis;
        TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_report(&telemetry, &report, &counters, 0));
        (void)next(0);
        (void)next(1);
        const selfcal_frame_t frame = next(2);
        TEST_ASSERT_EQUAL_HEX32(want[axis], value(&frame));
        uint64_t items;
        (void)drain(&items);
    }
}

static void test_status_counts_stop_at_the_end_of_their_range(void)
{
    counters.samples = 0x1FFFFFFFFULL;
    counters.saturated[0] = 0xFFFFFFFFU;
    counters.saturated[1] = 2;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_status(&telemetry, &counters, SELFCAL_FINISHED, 3, 5000));
    selfcal_frame_t frame;
    for (uint32_t item = 0; item < 46; item++) {
        frame = next(item);
        TEST_ASSERT_EQUAL_HEX16(0x200, frame.id);
        switch (item) {
        case 1: TEST_ASSERT_EQUAL_UINT32(3, value(&frame)); break;
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

static void test_busy_until_all_frames_are_fetched(void)
{
    selfcal_frame_t frame;
    uint64_t items;
    TEST_ASSERT_FALSE(selfcal_telemetry_next(&telemetry, &frame));
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_report(&telemetry, &report, &counters, 0));
    (void)next(0);
    TEST_ASSERT_EQUAL(SELFCAL_BUSY, selfcal_telemetry_report(&telemetry, &report, &counters, 1));
    TEST_ASSERT_EQUAL(SELFCAL_BUSY, selfcal_telemetry_status(&telemetry, &counters, SELFCAL_RUNNING, 1, 1));
    TEST_ASSERT_EQUAL_UINT(43, drain(&items));
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_status(&telemetry, &counters, SELFCAL_RUNNING, 1, 1));
}

/* gx is axis 1 of the model and item 1 (its sd 7), ay axis 0 and item 5 (11); an axis without sd, and axes the model has not, are left out. */
static void test_a_corrected_sample_goes_out_by_axis(void)
{
    selfcal_corrected_t corrected = {{0.25F, -1.5F}, {0.5F, 0.125F}, 2U};
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
    TEST_ASSERT_EQUAL_UINT32(2, value(&frame));
    TEST_ASSERT_FALSE(selfcal_telemetry_next(&telemetry, &frame));
    corrected.sd[0] = NAN;
    uint64_t items;
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_corrected(&telemetry, &corrected, 0));
    TEST_ASSERT_EQUAL_UINT(4, drain(&items));
}

static void test_an_answer_is_one_frame(void)
{
    TEST_ASSERT_EQUAL(SELFCAL_OK, selfcal_telemetry_answer(&telemetry, 1, 0x0305, 9000));
    selfcal_frame_t frame = next(1);
    TEST_ASSERT_EQUAL_HEX16(0x209, frame.id);
    TEST_ASSERT_EQUAL_HEX32(0x0305, value(&frame));
    TEST_ASSERT_FALSE(selfcal_telemetry_next(&telemetry, &frame));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_telemetry_answer(&telemetry, 2, 0, 0));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_telemetry_answer(NULL, 0, 0, 0));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_ARGUMENT, selfcal_telemetry_corrected(&telemetry, NULL, 0));
}

static void test_bad_arguments_and_models_are_refused(void)
{
    static const char *const unknown[] = {"ay", "mx"};
    static const char *const twice[] = {"gx", "gx"};
    static const char *const none[] = {"gx", NULL};
    static const selfcal_hypothesis_t same[] = {{&named_law[CONSTANT], 0.0F, NULL, NULL, NULL},
                                                {&named_law[CONSTANT], 0.0F, NULL, NULL, NULL}};
    static const selfcal_model_t same_law = {1, 1.0F, 1, 2, 2, 2, axis_table, same, NULL, NULL};
    selfcal_telemetry_t other;
    TEST_ASSERT_EQUAL(SELFCAL_BAD_MODEL, selfcal_telemetry_init(&other, &full, unknown));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_MODEL, selfcal_telemetry_init(&other, &full, twice));
    TEST_ASSERT_EQUAL(SELFCAL_BAD_MODEL, selfcal_telemetry_init(&other, &same_law, names));
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

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_crc_check_value);
    RUN_TEST(test_every_frame_has_form_counter_time_and_checksum);
    RUN_TEST(test_full_report_has_44_frames_opened_and_closed);
    RUN_TEST(test_items_of_absent_hypotheses_are_not_sent);
    RUN_TEST(test_evidences_are_differences_to_the_best_held_at_the_ends);
    RUN_TEST(test_health_flags_are_the_axis_s_own);
    RUN_TEST(test_status_counts_stop_at_the_end_of_their_range);
    RUN_TEST(test_busy_until_all_frames_are_fetched);
    RUN_TEST(test_a_corrected_sample_goes_out_by_axis);
    RUN_TEST(test_an_answer_is_one_frame);
    RUN_TEST(test_bad_arguments_and_models_are_refused);
    return UNITY_END();
}
