#include "icm42688.h"

#include <math.h>
#include <string.h>

/* Registers of bank 0. */
enum {
    DEVICE_CONFIG = 0x11,
    FIFO_CONFIG = 0x16,
    FIFO_COUNTH = 0x2E,
    FIFO_DATA = 0x30,
    SIGNAL_PATH_RESET = 0x4B,
    INTF_CONFIG0 = 0x4C,
    PWR_MGMT0 = 0x4E,
    GYRO_CONFIG0 = 0x4F,
    ACCEL_CONFIG0 = 0x50,
    TMST_CONFIG = 0x54,
    FIFO_CONFIG1 = 0x5F,
    SELF_TEST_CONFIG = 0x70,
    WHO_AM_I = 0x75,
    BANK_SEL = 0x76 /* in every bank */
};
enum { GYRO_ST_DATA = 0x5F, ACCEL_ST_DATA = 0x3B, OFFSET_USER0 = 0x77 }; /* banks 1, 2 and 4 */
#define READ 0x80U
#define IDENTITY 0x47U
#define RESET 0x01U
#define STREAM 0x40U /* FIFO: the oldest packet gives way */
#define FLUSH 0x02U
#define BIG_ENDIAN_NO_I2C 0x33U /* counts in bytes */
#define BOTH_LOW_NOISE 0x0FU
#define TIMESTAMPS 0x21U /* 1 us, no delta, no FSYNC */
#define PACKETS_OF_16 0x0FU
#define PACKETS_OF_20 0x5FU /* and a FIFO that is read in parts */
#define RATE_1KHZ 0x06U
#define GYRO_250 (3U << 5)
#define ACCEL_4G (2U << 5)
#define TEST_ALL 0x7FU

/* A header: accelerometer, gyro, 20 bits, timestamp. The two lowest bits say that a rate has just changed. */
#define HEADER 0x78U
#define HEADER_16 0x68U
#define HEADER_KIND 0xFCU
#define EMPTY 0x80U

enum { PACKET = 20, CHUNK = 8, SHORT_PACKET = 16, FIFO_BYTES = 2048, FIFO_PACKETS = FIFO_BYTES / PACKET };
#define GYRO_STEP (2000.0F / 262144.0F)
#define ACCEL_STEP (16.0F * SENSOR_G / 131072.0F)

/* Self-test, at 250 deg/s and 4 g. */
#define GYRO_LSB_PER_DPS (32768.0F / 250.0F)
#define ACCEL_LSB_PER_G (32768.0F / 4.0F)
#define GYRO_RESPONSE 2620.0F /* LSB of code 1; each further one 1 % more */
#define ACCEL_RESPONSE 1310.0F
enum { TEST_SAMPLES = 32 }; /* at least */

#define RESET_US 2000U    /* the data sheet: 1 ms */
#define SPIN_US 60000U    /* the data sheet: 45 ms from power-on of the gyro */
#define STRAIN_US 200000U /* the self-test's deflection settles */
#define GATHER_US 70000U
#define CHECK_US 10000000U /* between readings of the settings */
#define BLIND_US 1000000U  /* from here on the processor's clock counts: a timestamp's turns are unsure */
enum { LEARNING = 64 };    /* samples that the period is learned from, before it is followed slowly */
/* Timestamps out of place in a row: the packets do not follow each other after all. */
enum { MISMATCHES = 4 };

typedef struct {
    sensor_state_t common;
    uint64_t checked_us;      /* when the settings were read last */
    uint64_t last_us;         /* of the last sample */
    uint64_t read_us;         /* of the chunk */
    uint32_t ticks_q16;       /* of a period, in timestamps / 65536 */
    uint32_t dropped;         /* packets since the last sample, none of them good */
    float level[SENSOR_AXES]; /* readings before the self-test */
    int16_t temperature;      /* INT16_MIN: none yet */
    uint16_t last_stamp;
    bool anchored;              /* `last_us` is of a sample */
    bool continuous;            /* the next packet follows the last */
    bool blind;                 /* `last_stamp` is of before a reset */
    uint8_t rate;               /* ODR code */
    uint8_t codes[SENSOR_AXES]; /* factory's responses to a self-test */
    uint8_t mismatches;         /* packets in a row out of place */
    uint8_t next, held, behind; /* packets of the chunk: the next one, all; in the FIFO after them */
    uint8_t chunk[1 + CHUNK * PACKET];
} icm42688_t;

static icm42688_t *of(sensor_state_t *state) {
    return (icm42688_t *)(void *)state;
}

/* --- registers --- */

static uint64_t now_of(const icm42688_t *self) {
    return self->common.bus->time_us();
}

/* `count` registers from `address` on, 14 at most. */
static bool read_registers(icm42688_t *self, uint8_t address, uint8_t *values, size_t count) {
    uint8_t out[15] = {(uint8_t)(READ | address)}, in[15];
    if (!self->common.bus->exchange(out, in, 1U + count)) {
        return false;
    }
    memcpy(values, in + 1, count);
    return true;
}

static bool write_byte(icm42688_t *self, uint8_t address, uint8_t value) {
    const uint8_t out[2] = {address, value};
    uint8_t in[2];
    return self->common.bus->exchange(out, in, 2U);
}

/* And reads back: a byte has no checksum. */
static bool write_register(icm42688_t *self, uint8_t address, uint8_t value) {
    uint8_t found;
    return write_byte(self, address, value) && read_registers(self, address, &found, 1U) && found == value;
}

static bool flush(icm42688_t *self) {
    self->next = self->held = 0;
    self->continuous = false;
    return write_byte(self, SIGNAL_PATH_RESET, FLUSH);
}

/* Registers of another bank; back in bank 0 in any case. */
static bool read_bank(icm42688_t *self, uint8_t bank, uint8_t address, uint8_t *values, size_t count) {
    const bool read = write_register(self, BANK_SEL, bank) && read_registers(self, address, values, count);
    return write_register(self, BANK_SEL, 0U) && read;
}

/* --- offsets --- */

/* Six numbers of 12 bits in nine bytes of bank 4: a byte with the high bits of two between their low ones. */
static void pack_offsets(const int16_t added[SENSOR_AXES], uint8_t bytes[9]) {
    for (size_t pair = 0; pair < 3U; pair++) {
        const unsigned first = (unsigned)added[2U * pair] & 0xFFFU, second = (unsigned)added[2U * pair + 1U] & 0xFFFU;
        bytes[3U * pair] = (uint8_t)(first & 0xFFU);
        bytes[3U * pair + 1U] = (uint8_t)((second >> 8) << 4 | first >> 8);
        bytes[3U * pair + 2U] = (uint8_t)(second & 0xFFU);
    }
}

static bool write_offsets(icm42688_t *self, const int16_t added[SENSOR_AXES]) {
    uint8_t bytes[9];
    pack_offsets(added, bytes);
    bool written = write_register(self, BANK_SEL, 4U);
    for (uint8_t i = 0; i < sizeof bytes && written; i++) {
        written = write_register(self, (uint8_t)(OFFSET_USER0 + i), bytes[i]);
    }
    return write_register(self, BANK_SEL, 0U) && written;
}

static sensor_fault_t relaxed(sensor_state_t *state);

static bool offsets(sensor_state_t *state, const int16_t added[SENSOR_AXES]) {
    icm42688_t *self = of(state);
    const bool set_up = state->condition == SENSOR_STARTING && state->sensor->start[state->step].act == relaxed;
    if (state->condition == SENSOR_RUNNING || set_up) {
        if (!write_offsets(self, added) || !flush(self)) {
            (void)write_offsets(self, state->added);
            (void)flush(self);
            return false;
        }
    }
    return true;
}

/* --- start --- */

static bool init(sensor_state_t *state, float rate_hz, sensor_wire_t *wire) {
    static const struct {
        uint16_t rate_hz;
        uint8_t code;
    } rates[] = {{1000, 6}, {500, 15}, {200, 7}, {100, 8}, {50, 9}, {25, 10}};
    icm42688_t *self = of(state);
    if (!icm42688_has_rate(rate_hz)) {
        return false;
    }
    *wire = (sensor_wire_t){24000000U, 0U, 3U};
    for (size_t i = 0; i < sizeof rates / sizeof rates[0]; i++) {
        if (fabsf(rate_hz - (float)rates[i].rate_hz) < 1.0F) {
            self->rate = rates[i].code;
            state->period_us = 1000000U / rates[i].rate_hz;
        }
    }
    self->ticks_q16 = state->period_us * 61440U; /* 30/32 of 65536: the PLL's unit */
    self->temperature = INT16_MIN;
    return true;
}

static void stop(sensor_state_t *state) {
    of(state)->next = of(state)->held = 0;
}

static sensor_fault_t reset(sensor_state_t *state) {
    icm42688_t *self = of(state);
    (void)write_byte(self, BANK_SEL, 0U);
    (void)write_byte(self, DEVICE_CONFIG, RESET);
    self->next = self->held = 0;
    self->continuous = false;
    self->blind = true;
    return SENSOR_NO_FAULT;
}

static sensor_fault_t probe(sensor_state_t *state) {
    uint8_t identity;
    return read_registers(of(state), WHO_AM_I, &identity, 1U) && identity == IDENTITY ? SENSOR_NO_FAULT : SENSOR_ABSENT;
}

/* Bytes in the FIFO. */
static bool fifo_count(icm42688_t *self, uint32_t *count) {
    uint8_t bytes[2];
    if (!read_registers(self, FIFO_COUNTH, bytes, 2U)) {
        return false;
    }
    *count = (uint32_t)bytes[0] << 8 | bytes[1];
    return true;
}

static bool read_fifo(icm42688_t *self, size_t bytes) {
    uint8_t out[sizeof self->chunk] = {READ | FIFO_DATA};
    return self->common.bus->exchange(out, self->chunk, 1U + bytes);
}

static int16_t word_of(const uint8_t *bytes) {
    const int32_t value = (int32_t)bytes[0] << 8 | bytes[1];
    return (int16_t)(value >= 0x8000 ? value - 0x10000 : value);
}

/* Mean of the short packets that wait, gx to az, LSB. */
static bool mean(icm42688_t *self, float result[SENSOR_AXES]) {
    int32_t sum[SENSOR_AXES] = {0};
    size_t taken = 0;
    uint32_t count;
    if (!fifo_count(self, &count)) {
        return false;
    }
    for (size_t left = count / SHORT_PACKET; left > 0U;) {
        const size_t packets = left < CHUNK ? left : CHUNK;
        if (!read_fifo(self, packets * SHORT_PACKET)) {
            return false;
        }
        left -= packets;
        for (size_t i = 0; i < packets; i++) {
            const uint8_t *packet = self->chunk + 1U + i * SHORT_PACKET;
            if ((packet[0] & HEADER_KIND) != HEADER_16) {
                return false;
            }
            for (size_t axis = 0; axis < SENSOR_AXES; axis++) {
                sum[axis] += word_of(packet + (axis < 3U ? 7U : 1U) + 2U * (axis % 3U));
            }
            taken++;
        }
    }
    for (size_t axis = 0; axis < SENSOR_AXES; axis++) {
        result[axis] = (float)sum[axis] / (float)(taken > 0U ? taken : 1U);
    }
    return taken >= TEST_SAMPLES;
}

static sensor_fault_t prepare_test(sensor_state_t *state) {
    icm42688_t *self = of(state);
    const bool prepared =
        read_bank(self, 1U, GYRO_ST_DATA, self->codes, 3U) && read_bank(self, 2U, ACCEL_ST_DATA, self->codes + 3, 3U) &&
        write_register(self, INTF_CONFIG0, BIG_ENDIAN_NO_I2C) && write_register(self, TMST_CONFIG, TIMESTAMPS) &&
        write_register(self, GYRO_CONFIG0, GYRO_250 | RATE_1KHZ) &&
        write_register(self, ACCEL_CONFIG0, ACCEL_4G | RATE_1KHZ) &&
        write_register(self, FIFO_CONFIG1, PACKETS_OF_16) && write_register(self, FIFO_CONFIG, STREAM) &&
        write_byte(self, PWR_MGMT0, BOTH_LOW_NOISE); /* no access for 200 us now */
    return prepared ? SENSOR_NO_FAULT : SENSOR_SET_UP;
}

/* Whether each axis moved as at the factory, or by a plausible amount if the factory has left no code. */
static bool responded(const icm42688_t *self, const float moved[SENSOR_AXES]) {
    for (size_t axis = 0; axis < SENSOR_AXES; axis++) {
        const bool gyro = axis < 3U;
        const float response = fabsf(moved[axis] - self->level[axis]);
        float least = gyro ? 60.0F * GYRO_LSB_PER_DPS : 0.05F * ACCEL_LSB_PER_G;
        float most = gyro ? INFINITY : 1.2F * ACCEL_LSB_PER_G;
        if (self->codes[axis] > 0U) {
            float expected = gyro ? GYRO_RESPONSE : ACCEL_RESPONSE;
            for (uint8_t code = 1; code < self->codes[axis]; code++) {
                expected *= 1.01F;
            }
            least = 0.5F * expected;
            most = gyro ? INFINITY : 1.5F * expected;
        }
        if (!(response > least && response < most)) {
            return false;
        }
    }
    return true;
}

static sensor_fault_t begin_gathering(sensor_state_t *state) {
    (void)flush(of(state));
    return SENSOR_NO_FAULT;
}

static sensor_fault_t deflect(sensor_state_t *state) {
    icm42688_t *self = of(state);
    return mean(self, self->level) && write_register(self, SELF_TEST_CONFIG, TEST_ALL) ? SENSOR_NO_FAULT
                                                                                       : SENSOR_SELF_TEST;
}

static sensor_fault_t judge(sensor_state_t *state) {
    float moved[SENSOR_AXES];
    return mean(of(state), moved) && responded(of(state), moved) ? SENSOR_NO_FAULT : SENSOR_SELF_TEST;
}

static sensor_fault_t set_up(sensor_state_t *state) {
    icm42688_t *self = of(state);
    const bool done = write_register(self, SELF_TEST_CONFIG, 0U) && write_register(self, FIFO_CONFIG, 0U) &&
                      write_register(self, GYRO_CONFIG0, self->rate) &&
                      write_register(self, ACCEL_CONFIG0, self->rate) &&
                      write_register(self, FIFO_CONFIG1, PACKETS_OF_20) && write_offsets(self, state->added) &&
                      write_register(self, FIFO_CONFIG, STREAM);
    return done ? SENSOR_NO_FAULT : SENSOR_SET_UP;
}

static sensor_fault_t relaxed(sensor_state_t *state) {
    icm42688_t *self = of(state);
    (void)flush(self);
    self->dropped = 0;
    self->mismatches = 0;
    self->checked_us = now_of(self);
    return SENSOR_NO_FAULT;
}

/* --- run --- */

/* Whether one of the settings has been found wrong twice. */
static bool altered(icm42688_t *self) {
    const struct {
        uint8_t address, value;
    } wanted[] = {{PWR_MGMT0, BOTH_LOW_NOISE}, {GYRO_CONFIG0, self->rate},        {ACCEL_CONFIG0, self->rate},
                  {FIFO_CONFIG, STREAM},       {FIFO_CONFIG1, PACKETS_OF_20},     {TMST_CONFIG, TIMESTAMPS},
                  {SELF_TEST_CONFIG, 0U},      {INTF_CONFIG0, BIG_ENDIAN_NO_I2C}, {BANK_SEL, 0U}};
    for (size_t i = 0; i < sizeof wanted / sizeof wanted[0]; i++) {
        uint8_t found, again;
        if (read_registers(self, wanted[i].address, &found, 1U) && found != wanted[i].value &&
            read_registers(self, wanted[i].address, &again, 1U) && again == found) {
            return true;
        }
    }
    return false;
}

static void watch(sensor_state_t *state, uint64_t now) {
    icm42688_t *self = of(state);
    if (now - self->checked_us >= CHECK_US) {
        self->checked_us = now;
        if (altered(self)) {
            sensor_fail(state, SENSOR_SET_UP);
        }
    }
}

/* True: the FIFO holds packets, `count` bytes. False as well: the lines float. */
static bool filled(icm42688_t *self, uint32_t *count) {
    return fifo_count(self, count) && *count >= PACKET && *count <= FIFO_BYTES;
}

static bool waits(sensor_state_t *state) {
    uint32_t count;
    return of(state)->next < of(state)->held || filled(of(state), &count);
}

/* Reads the next packets; false: there are none. */
static bool fetch(icm42688_t *self) {
    uint32_t count;
    if (!filled(self, &count)) {
        return false;
    }
    const uint32_t packets = count / PACKET;
    if (packets + 1U >= FIFO_PACKETS) {
        if (self->continuous) {
            self->common.counters.overruns++;
        }
        self->continuous = false;
    }
    const uint8_t held = (uint8_t)(packets < CHUNK ? packets : CHUNK);
    self->read_us = now_of(self);
    if (!read_fifo(self, (size_t)held * PACKET)) {
        self->continuous = false;
        return false;
    }
    self->behind = (uint8_t)(packets - held);
    self->next = 0;
    self->held = held;
    return true;
}

/* Six numbers of 20 bits, gx to az. False: not a packet, or bits set that a sensor leaves 0. */
static bool unpack(const uint8_t *packet, int32_t raw[SENSOR_AXES]) {
    if ((packet[0] & HEADER_KIND) != HEADER) {
        return false;
    }
    for (size_t axis = 0; axis < SENSOR_AXES; axis++) {
        const bool gyro = axis < 3U;
        const uint8_t *high = packet + (gyro ? 7U : 1U) + 2U * (axis % 3U);
        const uint8_t low = packet[17U + axis % 3U];
        const uint32_t nibble = gyro ? low & 15U : (uint32_t)low >> 4;
        const uint32_t value = (uint32_t)high[0] << 12 | (uint32_t)high[1] << 4 | nibble;
        if ((nibble & (gyro ? 1U : 3U)) != 0U || value == 0x80000U) { /* the latter: no valid sample */
            return false;
        }
        raw[axis] = ((int32_t)(value ^ 0x80000U) - 0x80000) / (gyro ? 2 : 4);
    }
    return true;
}

/* Periods from the last sample to one at `us` with this timestamp, after a break. */
static uint32_t periods(const icm42688_t *self, uint64_t us, uint16_t stamp) {
    const uint64_t passed = us > self->last_us ? us - self->last_us : 0U;
    uint64_t count = (passed + self->common.period_us / 2U) / self->common.period_us;
    if (!self->blind && passed < BLIND_US) { /* whole turns from the clock, the rest from the timestamp */
        const uint64_t ticks = (passed * self->ticks_q16 / self->common.period_us) >> 16;
        const uint32_t part = (uint16_t)(stamp - self->last_stamp);
        const uint64_t turns = ticks > part ? (ticks - part + 0x8000U) >> 16 : 0U;
        count = ((((turns << 16) + part) << 16) + self->ticks_q16 / 2U) / self->ticks_q16;
    }
    return count < 1U ? 1U : count < UINT32_MAX ? (uint32_t)count : UINT32_MAX;
}

/* Whether the timestamp is where `count` periods after the last one have it, within a quarter. */
static bool in_place(icm42688_t *self, uint16_t stamp, uint32_t count) {
    const uint16_t step = (uint16_t)(stamp - self->last_stamp);
    const uint16_t expected = (uint16_t)((uint64_t)count * self->ticks_q16 >> 16);
    const int16_t off = (int16_t)(uint16_t)(step - expected);
    const int32_t bound = (int32_t)(self->ticks_q16 >> 18);
    if (off >= bound || off <= -bound) {
        return false;
    }
    if (count == 1U) {
        const int64_t nominal = (int64_t)self->common.period_us << 16;
        const int64_t error = ((int64_t)step << 16) - (int64_t)self->ticks_q16;
        const int64_t ticks = (int64_t)self->ticks_q16 + error / (self->common.good < LEARNING ? 8 : 64);
        if (ticks > nominal - nominal / 6 && ticks < nominal + nominal / 6) {
            self->ticks_q16 = (uint32_t)ticks;
        }
    }
    return true;
}

/* Whether a good packet with this timestamp is a sample, and how many are missing before it. */
static bool placed(icm42688_t *self, uint64_t us, uint16_t stamp, uint32_t *missing) {
    if (self->continuous && self->dropped == 0U && stamp == self->last_stamp) {
        self->common.counters.stale++;
        return false;
    }
    if (self->continuous && !in_place(self, stamp, self->dropped + 1U)) {
        self->common.counters.damaged++;
        self->dropped++;
        if (++self->mismatches >= MISMATCHES) {
            self->continuous = false;
        }
        return false;
    }
    *missing = self->continuous ? self->dropped : self->anchored ? periods(self, us, stamp) - 1U : 0U;
    return true;
}

static bool take(icm42688_t *self, const int32_t raw[SENSOR_AXES], uint64_t us, uint16_t stamp) {
    if (sensor_repeats(&self->common, raw)) {
        self->dropped++;
        return false;
    }
    self->last_us = us;
    self->last_stamp = stamp;
    self->anchored = self->continuous = true;
    self->blind = false;
    self->dropped = 0;
    self->mismatches = 0;
    return true;
}

static bool read_sample(sensor_state_t *state, int32_t raw[SENSOR_AXES], uint32_t *missing) {
    icm42688_t *self = of(state);
    while (self->next < self->held || fetch(self)) {
        const uint8_t *packet = self->chunk + 1U + (size_t)self->next * PACKET;
        self->next++;
        if ((packet[0] & EMPTY) != 0U && packet[0] == 0xFFU) { /* the count was too high */
            self->next = self->held;
            return false;
        }
        state->signs++;
        const uint64_t us = self->read_us - (uint64_t)(self->held - self->next + self->behind) * self->common.period_us;
        const uint16_t stamp = (uint16_t)((unsigned)packet[15] << 8 | packet[16]);
        if (!unpack(packet, raw)) {
            self->common.counters.damaged++;
            self->dropped++;
            if (++self->mismatches >= MISMATCHES) { /* out of step with the packets */
                (void)flush(self);
                self->mismatches = 0;
            }
            continue;
        }
        if (!placed(self, us, stamp, missing) || !take(self, raw, us, stamp)) {
            continue;
        }
        self->temperature = word_of(packet + 13);
        return true;
    }
    return false;
}

static float side(const sensor_state_t *state, unsigned channel) {
    const int16_t temperature = ((const icm42688_t *)(const void *)state)->temperature;
    const bool known = channel == SENSOR_TEMPERATURE && temperature != INT16_MIN;
    return known ? 25.0F + (float)temperature / 132.48F : NAN;
}

/* clang-format off */
static const sensor_step_t icm42688_steps[] = {
    {0, reset},
    {RESET_US, probe},
    {0, prepare_test},
    {SPIN_US, begin_gathering},
    {GATHER_US, deflect},
    {STRAIN_US, begin_gathering},
    {GATHER_US, judge},
    {0, set_up},
    {STRAIN_US, relaxed},
};
/* clang-format on */
static icm42688_t sensor;

const sensor_t icm42688 = {
    .state = &sensor.common,
    .bytes = sizeof sensor,
    .start = icm42688_steps,
    .steps = sizeof icm42688_steps / sizeof icm42688_steps[0],
    .step = {GYRO_STEP, ACCEL_STEP},
    .offset_step = {1.0F / 32.0F, 0.5e-3F * SENSOR_G},
    .offset_limit = {2048, 2048},
    .init = init,
    .stop = stop,
    .watch = watch,
    .waits = waits,
    .read = read_sample,
    .side = side,
    .offsets = offsets,
};
