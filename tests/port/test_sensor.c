/* port/sensors/sensor.c drives a driver that was written from port/README.md alone (toy_sensor.h). Truth: the registers
 * of the part, which are below, and the times that sensor.h states. */
#include "toy_sensor.h"

#include <string.h>

#include "unity.h"

static uint64_t now_us;
static uint16_t registers[TOY_REGISTERS];
static bool broken, test_hangs;
static unsigned starts;
static sensor_wire_t wired;

static uint64_t time_us(void) {
    return now_us;
}

static uint32_t time_us32(void) {
    return (uint32_t)now_us;
}

static void open_wire(const sensor_wire_t *wire) {
    wired = *wire;
}

static bool exchange(const uint8_t *out, uint8_t *in, size_t count) {
    TEST_ASSERT_EQUAL(3, count);
    memset(in, 0xFF, count);
    if (broken) {
        return false;
    }
    uint16_t *at = &registers[out[0] & 0x7FU];
    if ((out[0] & 0x80U) != 0U) {
        in[1] = (uint8_t)(*at >> 8);
        in[2] = (uint8_t)*at;
    } else {
        *at = (uint16_t)((uint32_t)out[1] << 8 | out[2]);
        starts += *at == TOY_TEST ? 1U : 0U;
    }
    return true;
}

static const sensor_bus_t bus = {time_us, time_us32, open_wire, exchange, NULL, NULL, NULL, NULL};

void setUp(void) {
    now_us = 1000U;
    memset(registers, 0, sizeof registers);
    registers[TOY_ID] = TOY_IDENTITY;
    registers[TOY_TEMPERATURE] = 2150;
    broken = test_hangs = false;
    starts = 0;
    TEST_ASSERT_TRUE(sensor_open(&toy, &bus, 200.0F));
}

void tearDown(void) {}

/* The part's next sample. */
static void make(int number) {
    registers[TOY_COUNT]++;
    for (int axis = 0; axis < 6; axis++) {
        registers[TOY_DATA + axis] = (uint16_t)(number * (axis % 2 == 0 ? 3 : -2));
    }
}

/* Lets `ms` pass with a poll each. The part's self-test takes 3 ms. */
static void pass(unsigned ms) {
    for (unsigned i = 0; i < ms; i++) {
        now_us += 1000U;
        sensor_poll(&toy);
        if (registers[TOY_CONTROL] == TOY_TEST && !test_hangs && i % 3U == 2U) {
            registers[TOY_CONTROL] = TOY_TEST_PASSED;
        }
    }
}

static void start(void) {
    pass(60);
    TEST_ASSERT_EQUAL(SENSOR_RUNNING, toy.state->condition);
}

static void test_it_starts_and_gives_samples(void) {
    float reading[SENSOR_AXES];
    uint32_t missing = 99;
    TEST_ASSERT_EQUAL(8000000, wired.sck_max_hz);
    TEST_ASSERT_FALSE(sensor_read(&toy, reading, &missing));
    TEST_ASSERT_TRUE(isnan(toy.side(toy.state, SENSOR_TEMPERATURE)));
    start();
    for (int number = 1; number <= 20; number++) {
        make(number);
        if (number == 7) {
            make(8); /* the loop came too late for one */
            number++;
        }
        TEST_ASSERT_TRUE(sensor_read(&toy, reading, &missing));
        TEST_ASSERT_EQUAL(number == 8 ? 1 : 0, missing);
        for (int axis = 0; axis < 6; axis++) {
            const float step = axis < 3 ? 0.01F : 0.002F;
            TEST_ASSERT_EQUAL_FLOAT((float)(number * (axis % 2 == 0 ? 3 : -2)) * step, reading[axis]);
        }
        TEST_ASSERT_FALSE(sensor_read(&toy, reading, &missing));
        pass(5);
    }
    TEST_ASSERT_EQUAL(19, toy.state->counters.samples);
    TEST_ASSERT_EQUAL_FLOAT(21.5F, toy.side(toy.state, SENSOR_TEMPERATURE));
    TEST_ASSERT_TRUE(isnan(toy.side(toy.state, SENSOR_SUPPLY)));
}

static void test_rates_and_offsets_that_it_has_not(void) {
    const float wanted[SENSOR_AXES] = {0.0F};
    float got[SENSOR_AXES];
    TEST_ASSERT_FALSE(sensor_open(&toy, &bus, 100.0F));
    TEST_ASSERT_FALSE(sensor_offsets(&toy, wanted, got));
}

/* Faults of a start, and the delays before the next one: 0.1, 0.2, 0.4 s ... 10 s. */
static void test_a_start_that_fails(void) {
    registers[TOY_ID] = 0x1234;
    pass(21);
    TEST_ASSERT_EQUAL(SENSOR_FAILED, toy.state->condition);
    TEST_ASSERT_EQUAL(SENSOR_ABSENT, toy.state->fault);
    for (unsigned delay = 100; delay < 20000U; delay *= 2U) {
        const unsigned faults = toy.state->counters.faults, least = delay < 10000U ? delay : 10000U;
        pass(least - 2U);
        TEST_ASSERT_EQUAL(SENSOR_FAILED, toy.state->condition);
        unsigned after = 0; /* 2 ms of the delay, 20 of the start */
        while (toy.state->counters.faults == faults && after < 25U) {
            pass(1);
            after++;
        }
        TEST_ASSERT_UINT_WITHIN(2, 22, after);
    }
    registers[TOY_ID] = TOY_IDENTITY;
    pass(11000);
    TEST_ASSERT_EQUAL(1, starts);
}

static void test_a_self_test_that_fails_or_does_not_end(void) {
    test_hangs = true;
    pass(500);
    TEST_ASSERT_EQUAL(SENSOR_STARTING, toy.state->condition);
    registers[TOY_CONTROL] = 0;
    pass(1);
    TEST_ASSERT_EQUAL(SENSOR_SELF_TEST, toy.state->fault);
}

/* Silence: 150 ms, since ten periods are 50 ms. */
static void test_no_samples(void) {
    float reading[SENSOR_AXES];
    uint32_t missing;
    start();
    make(1);
    TEST_ASSERT_TRUE(sensor_read(&toy, reading, &missing));
    pass(150);
    TEST_ASSERT_EQUAL(SENSOR_RUNNING, toy.state->condition);
    pass(1);
    TEST_ASSERT_EQUAL(SENSOR_FAILED, toy.state->condition);
    TEST_ASSERT_EQUAL(SENSOR_SILENT, toy.state->fault);
    pass(200);
    start();
    broken = true;
    pass(160);
    TEST_ASSERT_EQUAL(SENSOR_SILENT, toy.state->fault);
}

static void test_a_setting_that_changes(void) {
    start();
    registers[TOY_CONTROL] = 0;
    pass(1);
    TEST_ASSERT_EQUAL(SENSOR_SET_UP, toy.state->fault);
}

/* Two repeats are delivered, the third and later ones are not; the sixteenth is a fault. After the new start none. */
static void test_the_same_readings(void) {
    float reading[SENSOR_AXES];
    uint32_t missing;
    start();
    unsigned delivered = 0;
    for (int i = 0; i < 17; i++) {
        make(5);
        delivered += sensor_read(&toy, reading, &missing) ? 1U : 0U;
        TEST_ASSERT_EQUAL(SENSOR_RUNNING, toy.state->condition);
        pass(5);
    }
    TEST_ASSERT_EQUAL(3, delivered);
    TEST_ASSERT_EQUAL(14, toy.state->counters.repeated);
    TEST_ASSERT_EQUAL(SENSOR_STUCK, toy.state->fault);
    const uint64_t last_us = now_us - 14U * 5000U - 5000U; /* of the third */
    pass(100);
    start();
    make(5);
    TEST_ASSERT_FALSE(sensor_read(&toy, reading, &missing));
    make(6);
    TEST_ASSERT_TRUE(sensor_read(&toy, reading, &missing));
    TEST_ASSERT_UINT_WITHIN(1, (now_us - last_us) / 5000U - 1U, missing);
}

int main(void) {
    UNITY_BEGIN();
    RUN_TEST(test_it_starts_and_gives_samples);
    RUN_TEST(test_rates_and_offsets_that_it_has_not);
    RUN_TEST(test_a_start_that_fails);
    RUN_TEST(test_a_self_test_that_fails_or_does_not_end);
    RUN_TEST(test_no_samples);
    RUN_TEST(test_a_setting_that_changes);
    RUN_TEST(test_the_same_readings);
    return UNITY_END();
}
