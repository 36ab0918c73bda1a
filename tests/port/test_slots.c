/* Saved state in two slots (port/app/slots.h) on a memory in RAM that behaves as flash: what stands after a power cut
 * at every one of its operations, after operations that it refuses, after damage, and when a state is longer than a
 * slot. The truth is what was put. */
#include "slots.h"

#include <string.h>

#include "unity.h"

enum { STRIDE = 256 };
static union {
    uint32_t aligned;
    uint8_t bytes[SLOTS * STRIDE];
} flash;
static long operations, cut_at, refuse_at;
static bool off; /* the power is cut */

/* The operation that the cut falls into is half done: a word has the low half of its bits, a slot is erased to its
 * middle. */
static bool erase(uint32_t slot) {
    const long now = operations++;
    if (off || now == refuse_at) {
        return false;
    }
    off = now == cut_at;
    memset(flash.bytes + (size_t)slot * STRIDE, 0xFF, off ? STRIDE / 2 : STRIDE);
    return !off;
}

static bool program(const uint8_t *place, uint32_t word) {
    const long now = operations++;
    const size_t at = (size_t)(place - flash.bytes);
    if (off || now == refuse_at) {
        return false;
    }
    off = now == cut_at;
    for (size_t i = 0; i < (off ? 2U : 4U); i++) {
        flash.bytes[at + i] &= (uint8_t)(word >> (8U * i));
    }
    return !off;
}

static const slots_memory_t memory = {flash.bytes, STRIDE, erase, program};
static slots_t slots;

/* A start: nothing is known but the memory. */
static void power_on(void) {
    memset(&slots, 0, sizeof slots);
    slots.memory = &memory;
    off = false;
    cut_at = refuse_at = -1;
    operations = 0;
}

void setUp(void) {
    memset(&flash, 0xFF, sizeof flash);
    power_on();
}

void tearDown(void) {}

/* A state of `length` bytes that `seed` tells from others, in pieces of uneven size. */
static bool save_keeping(bool older, uint8_t seed, size_t length) {
    uint8_t bytes[2 * STRIDE];
    for (size_t i = 0; i < length; i++) {
        bytes[i] = (uint8_t)(seed + 7U * i);
    }
    bool whole = slots_begin(&slots, older);
    for (size_t at = 0; at < length && whole; at += 13U) {
        whole = slots_put(&slots, bytes + at, length - at < 13U ? length - at : 13U);
    }
    return slots_end(&slots, whole);
}

static bool save(uint8_t seed, size_t length) {
    return save_keeping(false, seed, length);
}

/* Which state is there; 0: none, or it is not what was put. */
static int stored(bool older) {
    size_t length = 0;
    const uint8_t *bytes = slots_stored(&slots, older, &length);
    for (size_t i = 0; bytes != NULL && i < length; i++) {
        if (bytes[i] != (uint8_t)(bytes[0] + 7U * i)) {
            return 0;
        }
    }
    return bytes == NULL ? 0 : bytes[0];
}

static void the_newest_and_the_one_before(void) {
    TEST_ASSERT_EQUAL(0, stored(false));
    for (uint8_t seed = 1; seed < 10U; seed++) {
        TEST_ASSERT_TRUE(save(seed, 90U + seed));
        power_on();
        TEST_ASSERT_EQUAL(seed, stored(false));
        TEST_ASSERT_EQUAL(seed - 1, stored(true));
    }
}

static void a_cut_anywhere_leaves_the_state_before_or_the_new_one(void) {
    long total = 0;
    for (long k = 0; k <= total; k++) {
        setUp();
        TEST_ASSERT_TRUE(save(1, 101) && save(2, 99));
        total = operations / 2 + 1;
        operations = 0;
        cut_at = k;
        const bool done = save(3, 100);
        TEST_ASSERT_EQUAL(!off, done);
        power_on();
        TEST_ASSERT_EQUAL(done ? 3 : 2, stored(false));
        TEST_ASSERT_TRUE(save(4, 100));
        TEST_ASSERT_EQUAL(4, stored(false));
        TEST_ASSERT_EQUAL(done ? 3 : 2, stored(true));
    }
    TEST_ASSERT_GREATER_THAN(30, total); /* an erase, 26 words, 8 of the header */
}

static void a_refused_operation_voids_the_save(void) {
    for (long k = 0; k < 34; k++) {
        setUp();
        TEST_ASSERT_TRUE(save(1, 100));
        operations = 0;
        refuse_at = k;
        TEST_ASSERT_FALSE(save(2, 100));
        TEST_ASSERT_EQUAL(1, stored(false));
        refuse_at = -1;
        TEST_ASSERT_TRUE(save(3, 100));
        TEST_ASSERT_EQUAL(3, stored(false));
    }
}

/* The library found its state corrupt in the middle: no header may make the half of it a whole. */
static void a_state_that_is_not_whole_is_not_headed(void) {
    TEST_ASSERT_TRUE(save(1, 100));
    TEST_ASSERT_TRUE(slots_begin(&slots, false) && slots_put(&slots, "half", 4));
    TEST_ASSERT_FALSE(slots_end(&slots, false));
    TEST_ASSERT_EQUAL(1, stored(false));
    TEST_ASSERT_EQUAL(0, stored(true));
}

static void the_next_save_overwrites_the_damaged_one(void) {
    TEST_ASSERT_TRUE(save(1, 100) && save(2, 100));
    flash.bytes[STRIDE + 60] ^= 1U; /* the second save is in the second slot */
    TEST_ASSERT_EQUAL(0, stored(false));
    TEST_ASSERT_EQUAL(1, stored(true));
    TEST_ASSERT_TRUE(save(3, 100));
    TEST_ASSERT_EQUAL(3, stored(false));
    TEST_ASSERT_EQUAL(1, stored(true));
}

/* As the application asks when start-up has refused the newest, whole as it is: a cut anywhere leaves the state in use,
 * also in the save after that, which finds no other. */
static void the_older_one_is_kept_where_it_is_asked_for(void) {
    long total = 1;
    for (long k = 0; k < total; k++) {
        setUp();
        TEST_ASSERT_TRUE(save(1, 100) && save(2, 100));
        total = operations / 2;
        operations = 0;
        cut_at = k;
        TEST_ASSERT_FALSE(save_keeping(true, 3, 100));
        power_on();
        TEST_ASSERT_EQUAL(1, stored(false));
        cut_at = 1;
        TEST_ASSERT_FALSE(save_keeping(true, 4, 100));
        power_on();
        TEST_ASSERT_EQUAL(1, stored(false));
        TEST_ASSERT_TRUE(save_keeping(true, 5, 100));
        TEST_ASSERT_EQUAL(5, stored(false));
        TEST_ASSERT_EQUAL(1, stored(true));
    }
    TEST_ASSERT_GREATER_THAN(30, total);
}

static void with_one_state_or_none_there_is_no_older_one_to_keep(void) {
    TEST_ASSERT_TRUE(save_keeping(true, 1, 100) && save_keeping(true, 2, 100));
    TEST_ASSERT_EQUAL(2, stored(false));
    TEST_ASSERT_EQUAL(1, stored(true));
}

static void a_state_longer_than_a_slot_is_refused(void) {
    TEST_ASSERT_TRUE(save(1, STRIDE - SLOTS_HEADER_BYTES));
    TEST_ASSERT_EQUAL(1, stored(false));
    TEST_ASSERT_FALSE(save(2, STRIDE - SLOTS_HEADER_BYTES + 1));
    TEST_ASSERT_EQUAL(1, stored(false));
}

/* The count of saves goes on over 2^32: written into the header as it would stand then. */
static void the_sequence_wraps(void) {
    TEST_ASSERT_TRUE(save(1, 100));
    slots.sequence = UINT32_MAX;
    const uint32_t slot = slots.slot;
    memset(flash.bytes + (size_t)slot * STRIDE, 0xFF, SLOTS_HEADER_BYTES);
    slots.at = SLOTS_HEADER_BYTES + 100U;
    TEST_ASSERT_TRUE(slots_end(&slots, true));
    TEST_ASSERT_TRUE(save(2, 100));
    TEST_ASSERT_EQUAL(0, slots.sequence);
    TEST_ASSERT_EQUAL(2, stored(false));
    TEST_ASSERT_EQUAL(1, stored(true));
}

/* A slot that was written and has no whole header is a state to be refused; an erased one is none. */
static void what_is_left_of_a_header_is_told_from_an_erased_slot(void) {
    size_t length = 1;
    TEST_ASSERT_NULL(slots_stored(&slots, false, &length));
    TEST_ASSERT_TRUE(save(1, 100));
    flash.bytes[(size_t)slots.slot * STRIDE + 5U] ^= 1U;
    TEST_ASSERT_NOT_NULL(slots_stored(&slots, false, &length));
    TEST_ASSERT_EQUAL(0, length);
    TEST_ASSERT_NULL(slots_stored(&slots, true, &length));
    TEST_ASSERT_TRUE(save(2, 100));
    TEST_ASSERT_EQUAL(2, stored(false));
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(the_newest_and_the_one_before);
    RUN_TEST(a_cut_anywhere_leaves_the_state_before_or_the_new_one);
    RUN_TEST(a_refused_operation_voids_the_save);
    RUN_TEST(a_state_that_is_not_whole_is_not_headed);
    RUN_TEST(the_next_save_overwrites_the_damaged_one);
    RUN_TEST(the_older_one_is_kept_where_it_is_asked_for);
    RUN_TEST(with_one_state_or_none_there_is_no_older_one_to_keep);
    RUN_TEST(a_state_longer_than_a_slot_is_refused);
    RUN_TEST(the_sequence_wraps);
    RUN_TEST(what_is_left_of_a_header_is_told_from_an_erased_slot);
    return UNITY_END();
}
