/* Challenges of commands, with the time coming round. */
#include "command.h"

#include <string.h>

#include "selfcal_frames.h"
#include "unity.h"

static const uint64_t key[2] = {0x0706050403020100ULL, 0x0F0E0D0C0B0A0908ULL};
static command_t command;

void setUp(void) {
    command = (command_t){0};
}

void tearDown(void) {}

/* What comes of the right answer to the challenge at a time. */
static uint8_t answered(uint32_t now_ms) {
    uint8_t data[8] = {SELFCAL_ANSWER_COMMAND_SAVE};
    const uint32_t tag = (uint32_t)command_siphash(key, (uint64_t)command.challenge | (uint64_t)data[0] << 32);
    for (unsigned i = 0; i < 4U; i++) {
        data[4U + i] = (uint8_t)(tag >> (8U * i));
    }
    return command_check(&command, key, data, now_ms);
}

static void test_a_challenge_is_answered_once(void) {
    TEST_ASSERT_TRUE(command_open(&command, 77, 5000));
    TEST_ASSERT_EQUAL(SELFCAL_ANSWER_RESULT_DONE, answered(6000));
    TEST_ASSERT_EQUAL(SELFCAL_ANSWER_RESULT_NO_CHALLENGE, answered(6001));
}

static void test_a_challenge_ends(void) {
    TEST_ASSERT_TRUE(command_open(&command, 77, 5000));
    TEST_ASSERT_EQUAL(SELFCAL_ANSWER_RESULT_NO_CHALLENGE, answered(5000 + COMMAND_CHALLENGE_MS + 1));
}

/* 49.7 days later the time is what it was. */
static void test_a_challenge_does_not_come_again_with_the_time(void) {
    TEST_ASSERT_TRUE(command_open(&command, 77, 5000));
    command_pass(&command, 5000 + COMMAND_CHALLENGE_MS + 1);
    command_pass(&command, 5000 + COMMAND_CHALLENGE_MS / 2);
    TEST_ASSERT_EQUAL(SELFCAL_ANSWER_RESULT_NO_CHALLENGE, answered(5000 + COMMAND_CHALLENGE_MS / 2));
}

static void test_a_pause_does_not_come_again_with_the_time(void) {
    TEST_ASSERT_TRUE(command_open(&command, 77, 5000));
    TEST_ASSERT_EQUAL(SELFCAL_ANSWER_RESULT_DONE, answered(5001));
    TEST_ASSERT_FALSE(command_open(&command, 78, 5002));
    command_pass(&command, 5000 + COMMAND_PAUSE_MS);
    TEST_ASSERT_TRUE(command_open(&command, 79, 5002));
}

static uint64_t state = 1;

/* xorshift64*: Vigna, ACM Trans. Math. Softw. 42 (2016) 30. */
static uint64_t any(void) {
    state ^= state >> 12;
    state ^= state << 25;
    state ^= state >> 27;
    return state * 0x2545F4914F6CDD1DULL;
}

/* tests/ACCURACY.md states these numbers. By chance one would be obeyed in 1400 runs of this test: it has a seed. */
static void test_no_random_frame_is_obeyed(void) {
    for (uint32_t i = 0; i < 3000000U; i++) {
        const uint32_t now = 2000U * i;
        TEST_ASSERT_TRUE(command_open(&command, (uint32_t)any(), now));
        uint8_t data[8];
        const uint64_t frame = any();
        memcpy(data, &frame, sizeof data);
        TEST_ASSERT_EQUAL(SELFCAL_ANSWER_RESULT_WRONG_TAG, command_check(&command, key, data, now));
    }
}

/* A frame that was obeyed, sent to each of the next challenges. */
static void test_no_recorded_frame_is_obeyed_again(void) {
    TEST_ASSERT_TRUE(command_open(&command, 77, 0));
    uint8_t data[8] = {SELFCAL_ANSWER_COMMAND_SAVE};
    const uint32_t tag = (uint32_t)command_siphash(key, (uint64_t)77 | (uint64_t)data[0] << 32);
    for (unsigned i = 0; i < 4U; i++) {
        data[4U + i] = (uint8_t)(tag >> (8U * i));
    }
    TEST_ASSERT_EQUAL(SELFCAL_ANSWER_RESULT_DONE, command_check(&command, key, data, 0));
    for (uint32_t i = 1; i <= 150000U; i++) {
        TEST_ASSERT_TRUE(command_open(&command, (uint32_t)any(), 2000U * i));
        TEST_ASSERT_EQUAL(SELFCAL_ANSWER_RESULT_WRONG_TAG, command_check(&command, key, data, 2000U * i));
    }
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(test_a_challenge_is_answered_once);
    RUN_TEST(test_a_challenge_ends);
    RUN_TEST(test_a_challenge_does_not_come_again_with_the_time);
    RUN_TEST(test_a_pause_does_not_come_again_with_the_time);
    RUN_TEST(test_no_random_frame_is_obeyed);
    RUN_TEST(test_no_recorded_frame_is_obeyed_again);
    return UNITY_END();
}
