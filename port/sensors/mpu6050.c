#include "mpu6050.h"

#include <math.h>
#include <string.h>

enum { ADDRESS = 0x68 };
enum {
    SELF_TEST_X = 0x0D, /* and three more */
    SMPLRT_DIV = 0x19,
    CONFIG = 0x1A,
    GYRO_CONFIG = 0x1B,
    ACCEL_CONFIG = 0x1C,
    FIFO_EN = 0x23,
    INT_STATUS = 0x3A,
    ACCEL_XOUT_H = 0x3B, /* accelerations, temperature, rates */
    USER_CTRL = 0x6A,
    PWR_MGMT_1 = 0x6B,
    FIFO_COUNTH = 0x72,
    FIFO_R_W = 0x74,
    WHO_AM_I = 0x75
};
#define IDENTITY 0x68U
#define RESET 0x80U
#define CLOCK_OF_GYRO 0x01U
#define ALL_INTO_FIFO 0xF8U
#define FIFO_ON 0x40U
#define FIFO_EMPTIED 0x44U
#define OVERFLOWN 0x10U
#define NEW_DATA 0x01U
#define BAND_188HZ 0x01U
#define TEST_GYRO 0xE0U  /* at 250 deg/s */
#define TEST_ACCEL 0xF0U /* at 8 g */
#define ACCEL_8G 0x10U

enum { PACKET = 14, CHUNK = 4, FIFO_BYTES = 1024, TEST_SAMPLES = 40 };
#define GYRO_STEP (1.0F / 131.0F)
#define ACCEL_STEP (SENSOR_G / 16384.0F)

#define RESET_US 100000U  /* register map, 4.28 */
#define SETTLE_US 100000U /* the gyro starts within 30 ms; a band of 188 Hz settles at once */
#define CHECK_US 10000000U
#define NO_TEMPERATURE INT16_MIN

typedef struct {
    sensor_state_t common;
    uint64_t checked_us; /* when the settings were read last */
    uint64_t last_us;    /* of the last sample */
    uint64_t read_us;    /* of the chunk */
    uint32_t dropped;    /* packets since the last sample, none of them good */
    int32_t sum[SENSOR_AXES];
    float level[SENSOR_AXES]; /* readings before the self-test */
    uint8_t summed;
    int16_t temperature;
    uint8_t divider, band;
    bool anchored;              /* `last_us` is of a sample */
    bool continuous;            /* the next packet follows the last */
    uint8_t codes[4];           /* factory's responses to a self-test */
    uint8_t next, held, behind; /* packets of the chunk: the next one, all; in the FIFO after them */
    uint8_t chunk[CHUNK * PACKET];
} mpu6050_t;

static mpu6050_t *of(sensor_state_t *state) {
    return (mpu6050_t *)(void *)state;
}

/* --- registers --- */

static bool read_registers(mpu6050_t *self, uint8_t place, uint8_t *values, size_t count) {
    return self->common.bus->transfer(ADDRESS, &place, 1U, values, count);
}

static bool write_byte(mpu6050_t *self, uint8_t place, uint8_t value) {
    const uint8_t out[2] = {place, value};
    return self->common.bus->transfer(ADDRESS, out, 2U, NULL, 0U);
}

/* And reads back: a byte has no checksum. */
static bool write_register(mpu6050_t *self, uint8_t place, uint8_t value) {
    uint8_t found;
    return write_byte(self, place, value) && read_registers(self, place, &found, 1U) && found == value;
}

static bool empty_fifo(mpu6050_t *self) {
    self->next = self->held = 0;
    self->continuous = false;
    return write_byte(self, USER_CTRL, FIFO_EMPTIED);
}

/* Six numbers of 16 bits, gx to az. False: none, all bits are alike, as where nobody drives the line. */
static bool unpack(const uint8_t packet[PACKET], int32_t raw[SENSOR_AXES]) {
    bool alike = true;
    for (size_t axis = 0; axis < SENSOR_AXES; axis++) {
        const uint8_t *bytes = packet + (axis < 3U ? 8U : 0U) + 2U * (axis % 3U);
        const int32_t value = (int32_t)bytes[0] << 8 | bytes[1];
        raw[axis] = value >= 0x8000 ? value - 0x10000 : value;
        alike = alike && (value == 0 || value == 0xFFFF);
    }
    return !alike;
}

/* --- start --- */

static bool init(sensor_state_t *state, float rate_hz, sensor_wire_t *wire) {
    static const struct {
        uint8_t rate_hz, divider, band;
    } rates[] = {{200, 4, 2}, {125, 7, 3}, {100, 9, 3}, {50, 19, 4}, {25, 39, 5}}; /* bands of 94, 42, 20, 10 Hz */
    mpu6050_t *self = of(state);
    if (!mpu6050_has_rate(rate_hz)) {
        return false;
    }
    *wire = (sensor_wire_t){0U, 0U, 0U};
    for (size_t i = 0; i < sizeof rates / sizeof rates[0]; i++) {
        if (fabsf(rate_hz - (float)rates[i].rate_hz) < 1.0F) {
            self->divider = rates[i].divider;
            self->band = rates[i].band;
            state->period_us = 1000000U / rates[i].rate_hz;
        }
    }
    self->temperature = NO_TEMPERATURE;
    return true;
}

static void stop(sensor_state_t *state) {
    of(state)->next = of(state)->held = 0;
    of(state)->continuous = false;
}

static sensor_fault_t reset(sensor_state_t *state) {
    (void)write_byte(of(state), PWR_MGMT_1, RESET);
    return SENSOR_NO_FAULT;
}

static sensor_fault_t probe(sensor_state_t *state) {
    uint8_t identity;
    return read_registers(of(state), WHO_AM_I, &identity, 1U) && identity == IDENTITY ? SENSOR_NO_FAULT : SENSOR_ABSENT;
}

static sensor_fault_t prepare_test(sensor_state_t *state) {
    mpu6050_t *self = of(state);
    const bool prepared = write_register(self, CONFIG, BAND_188HZ) && write_register(self, SMPLRT_DIV, 0U) &&
                          write_register(self, GYRO_CONFIG, 0U) && write_register(self, ACCEL_CONFIG, ACCEL_8G) &&
                          write_register(self, PWR_MGMT_1, CLOCK_OF_GYRO) &&
                          read_registers(self, SELF_TEST_X, self->codes, sizeof self->codes);
    self->summed = 0;
    memset(self->sum, 0, sizeof self->sum);
    return prepared ? SENSOR_NO_FAULT : SENSOR_SET_UP;
}

/* Sums new readings, one a call. */
static sensor_fault_t gather(sensor_state_t *state) {
    mpu6050_t *self = of(state);
    uint8_t status, packet[PACKET];
    int32_t raw[SENSOR_AXES];
    const bool late = self->common.bus->time_us() - state->step_us > SETTLE_US + TEST_SAMPLES * 50000U;
    if (!read_registers(self, INT_STATUS, &status, 1U) || late) {
        return SENSOR_SELF_TEST;
    }
    if ((status & NEW_DATA) == 0U) {
        return SENSOR_NOT_YET;
    }
    if (!read_registers(self, ACCEL_XOUT_H, packet, sizeof packet) || !unpack(packet, raw)) {
        return SENSOR_SELF_TEST;
    }
    for (size_t axis = 0; axis < SENSOR_AXES; axis++) {
        self->sum[axis] += raw[axis];
    }
    self->summed++;
    return self->summed < TEST_SAMPLES ? SENSOR_NOT_YET : SENSOR_NO_FAULT;
}

static void take_mean(mpu6050_t *self, float mean[SENSOR_AXES]) {
    for (size_t axis = 0; axis < SENSOR_AXES; axis++) {
        mean[axis] = (float)self->sum[axis] / (float)TEST_SAMPLES;
        self->sum[axis] = 0;
    }
    self->summed = 0;
}

static sensor_fault_t deflect(sensor_state_t *state) {
    mpu6050_t *self = of(state);
    take_mean(self, self->level);
    return write_register(self, GYRO_CONFIG, TEST_GYRO) && write_register(self, ACCEL_CONFIG, TEST_ACCEL)
               ? SENSOR_NO_FAULT
               : SENSOR_SELF_TEST;
}

/* The factory's response on an axis, LSB (register map, 4.1 and 4.5); 0: it has left none. */
static float trim_of(const uint8_t codes[4], size_t axis) {
    const bool gyro = axis < 3U;
    const unsigned place = (unsigned)axis % 3U;
    const unsigned low = (unsigned)codes[3] >> (4U - 2U * place) & 3U;
    const unsigned code = gyro ? codes[place] & 31U : (unsigned)codes[place] >> 5 << 2 | low;
    float trim = gyro ? 25.0F * 131.0F : 4096.0F * 0.34F;
    for (unsigned i = 1; i < code; i++) {
        trim *= gyro ? 1.046F : 1.0337391F; /* (0.92 / 0.34)^(1 / 30) */
    }
    return code == 0U ? 0.0F : axis == 1U ? -trim : trim;
}

/* Within 14 % of the factory's, as the product specification has it; of an axis without one, some response. */
static sensor_fault_t judge(sensor_state_t *state) {
    mpu6050_t *self = of(state);
    float moved[SENSOR_AXES];
    take_mean(self, moved);
    for (size_t axis = 0; axis < SENSOR_AXES; axis++) {
        const float response = moved[axis] - self->level[axis], trim = trim_of(self->codes, axis);
        if (!(fabsf(response) > 100.0F) || (trim != 0.0F && !(fabsf(response - trim) < 0.14F * fabsf(trim)))) {
            return SENSOR_SELF_TEST;
        }
    }
    return SENSOR_NO_FAULT;
}

static sensor_fault_t set_up(sensor_state_t *state) {
    mpu6050_t *self = of(state);
    const bool done = write_register(self, GYRO_CONFIG, 0U) && write_register(self, ACCEL_CONFIG, 0U) &&
                      write_register(self, CONFIG, self->band) && write_register(self, SMPLRT_DIV, self->divider) &&
                      write_register(self, FIFO_EN, ALL_INTO_FIFO);
    return done ? SENSOR_NO_FAULT : SENSOR_SET_UP;
}

static sensor_fault_t relaxed(sensor_state_t *state) {
    mpu6050_t *self = of(state);
    self->checked_us = self->common.bus->time_us();
    self->dropped = 0;
    return empty_fifo(self) ? SENSOR_NO_FAULT : SENSOR_SET_UP;
}

/* --- run --- */

/* Whether one of the settings has been found wrong twice. */
static bool altered(mpu6050_t *self) {
    const struct {
        uint8_t place, value;
    } wanted[] = {{PWR_MGMT_1, CLOCK_OF_GYRO}, {CONFIG, self->band}, {SMPLRT_DIV, self->divider}, {GYRO_CONFIG, 0U},
                  {ACCEL_CONFIG, 0U},          {USER_CTRL, FIFO_ON}, {FIFO_EN, ALL_INTO_FIFO}};
    for (size_t i = 0; i < sizeof wanted / sizeof wanted[0]; i++) {
        uint8_t found, again;
        if (read_registers(self, wanted[i].place, &found, 1U) && found != wanted[i].value &&
            read_registers(self, wanted[i].place, &again, 1U) && again == found) {
            return true;
        }
    }
    return false;
}

static void watch(sensor_state_t *state, uint64_t now) {
    mpu6050_t *self = of(state);
    if (now - self->checked_us >= CHECK_US) {
        self->checked_us = now;
        if (altered(self)) {
            sensor_fail(state, SENSOR_SET_UP);
        }
    }
}

/* True: the FIFO holds packets, `count` bytes. */
static bool filled(mpu6050_t *self, uint32_t *count) {
    uint8_t bytes[2];
    if (!read_registers(self, FIFO_COUNTH, bytes, 2U)) {
        return false;
    }
    *count = (uint32_t)bytes[0] << 8 | bytes[1];
    return *count >= PACKET && *count <= FIFO_BYTES;
}

static bool waits(sensor_state_t *state) {
    uint32_t count;
    return of(state)->next < of(state)->held || filled(of(state), &count);
}

/* Reads the next packets; false: there are none. Packets are out of step after an overflow, and after a read that was
 * broken off: then the FIFO begins anew. */
static bool fetch(mpu6050_t *self) {
    uint32_t count;
    uint8_t status = 0;
    if (!filled(self, &count) || (count % PACKET != 0U && !filled(self, &count))) { /* one may be under way */
        return false;
    }
    const bool known = read_registers(self, INT_STATUS, &status, 1U); /* and clears it */
    const bool full = count > FIFO_BYTES - PACKET || (status & OVERFLOWN) != 0U;
    if (full || count % PACKET != 0U || !known) {
        (void)empty_fifo(self);
        if (full) {
            self->common.counters.overruns++;
            sensor_expect(&self->common); /* the next packet is to come yet */
        }
        return false;
    }
    const uint32_t packets = count / PACKET;
    const uint8_t held = (uint8_t)(packets < CHUNK ? packets : CHUNK);
    self->read_us = self->common.bus->time_us();
    if (!read_registers(self, FIFO_R_W, self->chunk, (size_t)held * PACKET)) {
        self->common.counters.damaged++;
        (void)empty_fifo(self);
        return false;
    }
    self->behind = (uint8_t)(packets - held);
    self->next = 0;
    self->held = held;
    return true;
}

/* Samples missing before one at `us`. */
static uint32_t missing_before(const mpu6050_t *self, uint64_t us) {
    if (self->continuous || !self->anchored) {
        return self->continuous ? self->dropped : 0U;
    }
    const uint64_t passed = us > self->last_us ? us - self->last_us : 0U;
    const uint64_t count = (passed + self->common.period_us / 2U) / self->common.period_us;
    return count < 1U ? 0U : count < UINT32_MAX ? (uint32_t)(count - 1U) : UINT32_MAX;
}

static bool read_sample(sensor_state_t *state, int32_t raw[SENSOR_AXES], uint32_t *missing) {
    mpu6050_t *self = of(state);
    while (self->next < self->held || fetch(self)) {
        const uint8_t *packet = self->chunk + (size_t)self->next * PACKET;
        self->next++;
        state->signs++;
        const uint64_t us = self->read_us - (uint64_t)(self->held - self->next + self->behind) * state->period_us;
        if (!unpack(packet, raw)) {
            state->counters.damaged++;
            self->dropped++;
            continue;
        }
        if (sensor_repeats(state, raw)) {
            self->dropped++;
            continue;
        }
        *missing = missing_before(self, us);
        const int32_t temperature = (int32_t)packet[6] << 8 | packet[7];
        self->temperature = (int16_t)(temperature >= 0x8000 ? temperature - 0x10000 : temperature);
        self->last_us = us;
        self->anchored = self->continuous = true;
        self->dropped = 0;
        return true;
    }
    return false;
}

static float side(const sensor_state_t *state, unsigned channel) {
    const int16_t temperature = ((const mpu6050_t *)(const void *)state)->temperature;
    const bool known = channel == SENSOR_TEMPERATURE && temperature != NO_TEMPERATURE;
    return known ? 36.53F + (float)temperature / 340.0F : NAN;
}

/* clang-format off */
static const sensor_step_t mpu6050_steps[] = {
    {0, reset},
    {RESET_US, probe},
    {0, prepare_test},
    {SETTLE_US, gather},
    {0, deflect},
    {SETTLE_US, gather},
    {0, judge},
    {0, set_up},
    {SETTLE_US, relaxed},
};
/* clang-format on */
static mpu6050_t sensor;

const sensor_t mpu6050 = {
    .state = &sensor.common,
    .bytes = sizeof sensor,
    .start = mpu6050_steps,
    .steps = sizeof mpu6050_steps / sizeof mpu6050_steps[0],
    .step = {GYRO_STEP, ACCEL_STEP},
    .init = init,
    .stop = stop,
    .watch = watch,
    .waits = waits,
    .read = read_sample,
    .side = side,
};
