/* SLCAN against the Lawicel command set as slcan.h restates it. */
#include "slcan.h"
#include "unity.h"

#include <string.h>

static slcan_t slcan;

void setUp(void) {
    slcan_init(&slcan);
}

void tearDown(void) {}

/* Feeds a text and gathers all answers. */
static const char *answers(const char *text) {
    static char all[256];
    size_t length = 0;
    for (; *text != '\0'; text++) {
        char answer[SLCAN_ANSWER_BYTES];
        const size_t got = slcan_receive(&slcan, (uint8_t)*text, answer);
        TEST_ASSERT_LESS_THAN(sizeof all, length + got);
        memcpy(all + length, answer, got);
        length += got;
    }
    all[length] = '\0';
    return all;
}

static void test_frame_is_a_lawicel_line(void) {
    const selfcal_frame_t frame = {0x2A1, 8, {0x01, 0x23, 0x45, 0x67, 0x89, 0xAB, 0xCD, 0xEF}};
    char line[SLCAN_FRAME_BYTES];
    slcan_encode(&frame, line);
    TEST_ASSERT_EQUAL_STRING_LEN("t2A180123456789ABCDEF\r", line, sizeof line);
}

/* The bytes python-can 4.6 writes when it opens and closes the channel at 500 kbit/s. */
static void test_python_can_opens_and_closes(void) {
    TEST_ASSERT_EQUAL_STRING("\r\r\r\r\r", answers("C\rS6\r\rO\rO\r"));
    TEST_ASSERT_TRUE(slcan.open);
    TEST_ASSERT_EQUAL_STRING("\r", answers("C\r"));
    TEST_ASSERT_FALSE(slcan.open);
}

static void test_listen_only_opens_too(void) {
    TEST_ASSERT_EQUAL_STRING("\r\r", answers("L\rL\r"));
    TEST_ASSERT_TRUE(slcan.open);
}

static void test_lines_may_end_in_both(void) {
    TEST_ASSERT_EQUAL_STRING("\r\rV0101\r\r", answers("C\r\nO\r\nV\r\n\r\n"));
    TEST_ASSERT_TRUE(slcan.open);
}

static void test_identification(void) {
    TEST_ASSERT_EQUAL_STRING("V0101\rv0101\rNSCAL\r", answers("V\rv\rN\r"));
    TEST_ASSERT_FALSE(slcan.open);
}

static void test_anything_else_is_refused(void) {
    static const char *const line[] = {"S\r",     "S9\r", "S66\r", "s0000\r", "o\r",   "OO\r",   "O\nO\r",
                                       "t1000\r", "Z1\r", "VV\r",  " \r",     "C\n\r", "\x80\r", "\a\r"};
    for (size_t i = 0; i < sizeof line / sizeof line[0]; i++) {
        TEST_ASSERT_EQUAL_STRING_MESSAGE("\a", answers(line[i]), line[i]);
        TEST_ASSERT_FALSE_MESSAGE(slcan.open, line[i]);
    }
}

static void test_overlong_line_is_refused_and_forgotten(void) {
    char answer[SLCAN_ANSWER_BYTES];
    for (int i = 0; i < 1000000; i++) {
        TEST_ASSERT_EQUAL_size_t(0, slcan_receive(&slcan, 'O', answer));
    }
    TEST_ASSERT_EQUAL_STRING("\a\r", answers("\rO\r"));
    TEST_ASSERT_TRUE(slcan.open);
}

/* What the rules say of a whole line: a second formulation, over the line as a string. */
static const char *expected(const char *line, size_t length, bool *open) {
    static const char *const accepted[] = {"", "S0", "S1", "S2", "S3", "S4", "S5", "S6", "S7", "S8", "C", "O", "L"};
    if (strlen(line) == length) { /* no zero byte inside */
        for (size_t i = 0; i < sizeof accepted / sizeof accepted[0]; i++) {
            if (strcmp(line, accepted[i]) == 0) {
                *open = strcmp(line, "C") == 0                             ? false
                        : strcmp(line, "O") == 0 || strcmp(line, "L") == 0 ? true
                                                                           : *open;
                return "\r";
            }
        }
        if (strcmp(line, "V") == 0 || strcmp(line, "v") == 0 || strcmp(line, "N") == 0) {
            return strcmp(line, "V") == 0 ? "V0101\r" : strcmp(line, "v") == 0 ? "v0101\r" : "NSCAL\r";
        }
    }
    return "\a";
}

static void test_two_million_random_bytes(void) {
    static const char likely[] = "\r\r\r\rCOLSSVvN0123456789\nt\a";
    uint32_t random = 12345;
    char line[64];
    size_t length = 0, opened = 0;
    bool open = false;
    for (long i = 0; i < 2000000; i++) {
        random = random * 1664525U + 1013904223U; /* Numerical Recipes */
        uint8_t byte = (uint8_t)(random >> 24);
        if ((random >> 20 & 0xFU) != 0U) {
            byte = (uint8_t)likely[byte % (sizeof likely - 1U)];
        }
        char answer[SLCAN_ANSWER_BYTES + 1];
        memset(answer, 0x55, sizeof answer);
        const size_t got = slcan_receive(&slcan, byte, answer);
        TEST_ASSERT_EQUAL_HEX8(0x55, answer[SLCAN_ANSWER_BYTES]);
        if (byte != '\r') {
            TEST_ASSERT_EQUAL_size_t(0, got);
            if (length < sizeof line - 1U && !(byte == '\n' && length == 0U)) {
                line[length++] = (char)byte;
            }
            continue;
        }
        line[length] = '\0';
        const char *want = expected(line, length, &open);
        TEST_ASSERT_EQUAL_size_t(strlen(want), got);
        TEST_ASSERT_EQUAL_MEMORY(want, answer, got);
        TEST_ASSERT_EQUAL(open, slcan.open);
        opened += open ? 1U : 0U;
        length = 0;
    }
    TEST_ASSERT_GREATER_THAN(1000, opened); /* the fuzz reached the open state */
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(test_frame_is_a_lawicel_line);
    RUN_TEST(test_python_can_opens_and_closes);
    RUN_TEST(test_listen_only_opens_too);
    RUN_TEST(test_lines_may_end_in_both);
    RUN_TEST(test_identification);
    RUN_TEST(test_anything_else_is_refused);
    RUN_TEST(test_overlong_line_is_refused_and_forgotten);
    RUN_TEST(test_two_million_random_bytes);
    return UNITY_END();
}
