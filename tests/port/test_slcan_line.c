/* The rings of a serial line against a plain queue, whose counters go through 2^32. */
#include "slcan_line.h"
#include "unity.h"

#include <string.h>

static volatile uint8_t out[64], in[8];
static slcan_line_t line;
static const selfcal_frame_t frame = {0x2A1, 8, {0x01, 0x23, 0x45, 0x67, 0x89, 0xAB, 0xCD, 0xEF}};

void setUp(void) {
    const slcan_line_t fresh = SLCAN_LINE(out, in);
    line = fresh;
    /* Ten bytes before the counters come round. */
    line.out.head = line.out.tail = line.in.head = line.in.tail = UINT32_MAX - 9U;
}

void tearDown(void) {}

static void type(const char *text) {
    for (; *text != '\0'; text++) {
        slcan_line_received(&line, (uint8_t)*text);
    }
}

static const char *sent(void) {
    static char all[128];
    size_t length = 0;
    uint8_t byte;
    while (slcan_line_next(&line, &byte)) {
        TEST_ASSERT_LESS_THAN(sizeof all - 1U, length);
        all[length++] = (char)byte;
    }
    all[length] = '\0';
    return all;
}

static void test_frames_are_dropped_until_the_channel_opens(void) {
    TEST_ASSERT_TRUE(slcan_line_send(&line, &frame));
    TEST_ASSERT_EQUAL_UINT32(1, line.dropped);
    TEST_ASSERT_TRUE(slcan_line_empty(&line));
    type("O\r");
    TEST_ASSERT_FALSE(slcan_line_poll(&line));
    TEST_ASSERT_EQUAL_STRING("\r", sent());
    TEST_ASSERT_TRUE(slcan_line_send(&line, &frame));
    TEST_ASSERT_FALSE(slcan_line_empty(&line));
    TEST_ASSERT_EQUAL_STRING("t2A180123456789ABCDEF\r", sent());
    TEST_ASSERT_TRUE(slcan_line_empty(&line));
    TEST_ASSERT_EQUAL_UINT32(1, line.dropped);
}

/* 64 bytes: two frames and 20 bytes. */
static void test_a_frame_without_room_is_offered_again(void) {
    type("O\r");
    (void)slcan_line_poll(&line);
    (void)sent();
    TEST_ASSERT_TRUE(slcan_line_send(&line, &frame));
    TEST_ASSERT_TRUE(slcan_line_send(&line, &frame));
    TEST_ASSERT_FALSE(slcan_line_send(&line, &frame));
    uint8_t byte;
    TEST_ASSERT_TRUE(slcan_line_next(&line, &byte));
    TEST_ASSERT_FALSE(slcan_line_send(&line, &frame));
    TEST_ASSERT_TRUE(slcan_line_next(&line, &byte));
    TEST_ASSERT_TRUE(slcan_line_send(&line, &frame));
    TEST_ASSERT_EQUAL_size_t(64, strlen(sent()));
}

static void test_bytes_without_room_are_counted(void) {
    type("SSSSSSSSSS");
    TEST_ASSERT_EQUAL_UINT32(2, line.lost);
    TEST_ASSERT_FALSE(slcan_line_poll(&line));
    type("\r");
    TEST_ASSERT_FALSE(slcan_line_poll(&line));
    TEST_ASSERT_EQUAL_STRING("\a", sent());
    TEST_ASSERT_EQUAL_UINT32(2, line.lost);
}

static void test_answers_without_room_are_left_out(void) {
    for (unsigned i = 0; i < 20U; i++) { /* 6 bytes each, 10 of them fit */
        type("V\r");
        TEST_ASSERT_FALSE(slcan_line_poll(&line));
    }
    TEST_ASSERT_EQUAL_size_t(60, strlen(sent()));
    type("V\r");
    TEST_ASSERT_FALSE(slcan_line_poll(&line));
    TEST_ASSERT_EQUAL_STRING("V0101\r", sent());
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(test_frames_are_dropped_until_the_channel_opens);
    RUN_TEST(test_a_frame_without_room_is_offered_again);
    RUN_TEST(test_bytes_without_room_are_counted);
    RUN_TEST(test_answers_without_room_are_left_out);
    return UNITY_END();
}
