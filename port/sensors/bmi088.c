#include "bmi088.h"

#include <math.h>
#include <string.h>

enum { ACCEL, GYRO }; /* as the bus counts chips */
enum {
    ACC_CHIP_ID = 0x00,
    ACC_DATA = 0x12,
    ACC_TEMPERATURE = 0x22,
    ACC_FIFO_LENGTH = 0x24,
    ACC_FIFO_DATA = 0x26,
    ACC_CONF = 0x40,
    ACC_RANGE = 0x41,
    ACC_FIFO_CONFIG_0 = 0x48,
    ACC_FIFO_CONFIG_1 = 0x49,
    ACC_SELF_TEST = 0x6D,
    ACC_PWR_CONF = 0x7C,
    ACC_PWR_CTRL = 0x7D,
    ACC_SOFTRESET = 0x7E
};
enum {
    GYRO_CHIP_ID = 0x00,
    GYRO_FIFO_STATUS = 0x0E,
    GYRO_RANGE = 0x0F,
    GYRO_BANDWIDTH = 0x10, /* its top bit reads 1 */
    GYRO_SOFTRESET = 0x14,
    GYRO_SELF_TEST = 0x3C,
    GYRO_FIFO_CONFIG_1 = 0x3E,
    GYRO_FIFO_DATA = 0x3F
};
#define READ 0x80U
#define ACC_IDENTITY 0x1EU
#define GYRO_IDENTITY 0x0FU
#define RESET 0xB6U
#define ACC_ON 0x04U
#define RANGE_24G 0x03U
#define ACC_1600HZ 0xACU
#define ACC_STREAM 0x02U
#define ACC_INTO_FIFO 0x50U
#define GYRO_STREAM 0x80U
#define TEST_UP 0x0DU
#define TEST_DOWN 0x09U
#define TRIGGER 0x01U
#define TEST_ENDED 0x02U
#define TEST_FAILED 0x04U
#define OVERRUN 0x80U
/* Frames of the accelerometer's FIFO, but for two bits of its interrupt pins. */
#define FRAME_KIND 0xFCU
#define FRAME_DATA 0x84U
#define FRAME_TIME 0x44U

enum { GYRO_FRAME = 6, ACCEL_FRAME = 7, CHUNK = 8, ACCEL_CHUNK = CHUNK * ACCEL_FRAME, ACCEL_FIFO_BYTES = 1024 };
#define GYRO_STEP (2000.0F / 32767.0F)
#define ACCEL_STEP (24.0F * SENSOR_G / 32768.0F)
#define STEPS_PER_G (32768.0F / 24.0F)

#define RESET_US 50000U /* the gyro: 30 ms */
#define SUSPENDED_US 2000U
#define SETTLE_US 60000U /* of the self-test: 50 ms */
#define CHECK_US 10000000U
#define LOOK_US 1000000U /* at the temperature */
#define NO_TEMPERATURE INT16_MIN
enum { ONE = 256 };                 /* an acceleration, in the counts below */
enum { BEHIND_MOST = 5 * ONE / 2 }; /* accelerations that wait for a rate, before one is left out */
enum { PAUSE = 8 * ONE };           /* more wait after a pause of the loop: they are left out at once */
enum { STARVED_MOST = 2 };          /* samples in a row without a new acceleration */
#define STARVED_US 150000U

typedef struct {
    sensor_state_t common;
    uint64_t checked_us, looked_us; /* when the settings, and the temperature, were read last */
    uint64_t last_us;               /* of the last sample */
    uint64_t read_us;               /* of the chunk */
    uint32_t dropped;               /* frames since the last sample, none of them good */
    int32_t owed;                   /* accelerations that the next samples take, in 1 / ONE */
    int32_t up[3];                  /* readings of the first half of the self-test */
    int32_t accel[3];
    int16_t temperature;
    uint16_t per_sample; /* accelerations, in 1 / ONE */
    uint8_t bandwidth, accel_conf;
    uint16_t starved;
    bool moved;                 /* there has been an acceleration */
    bool anchored;              /* `last_us` is of a sample */
    bool continuous;            /* the next frame follows the last */
    uint8_t next, held, behind; /* frames of the chunk: the next one, all; in the FIFO after them */
    uint8_t accel_at, accel_end;
    uint8_t chunk[1 + CHUNK * GYRO_FRAME];
    uint8_t accel_chunk[2 + ACCEL_CHUNK];
} bmi088_t;

static bmi088_t *of(sensor_state_t *state) {
    return (bmi088_t *)(void *)state;
}

/* --- registers --- */

/* `count` registers of a chip, 6 at most. The accelerometer sends a byte of no meaning first. */
static bool read_registers(bmi088_t *self, uint8_t chip, uint8_t place, uint8_t *values, size_t count) {
    const size_t first = chip == ACCEL ? 2U : 1U;
    uint8_t out[8] = {(uint8_t)(READ | place)}, in[8];
    self->common.bus->choose(chip);
    if (!self->common.bus->exchange(out, in, first + count)) {
        return false;
    }
    memcpy(values, in + first, count);
    return true;
}

static bool write_byte(bmi088_t *self, uint8_t chip, uint8_t place, uint8_t value) {
    const uint8_t out[2] = {place, value};
    uint8_t in[2];
    self->common.bus->choose(chip);
    return self->common.bus->exchange(out, in, 2U);
}

/* And reads back: a byte has no checksum. */
static bool write_register(bmi088_t *self, uint8_t chip, uint8_t place, uint8_t value) {
    uint8_t found;
    return write_byte(self, chip, place, value) && read_registers(self, chip, place, &found, 1U) && found == value;
}

static bool empty_gyro(bmi088_t *self) {
    self->next = self->held = 0;
    self->continuous = false;
    return write_byte(self, GYRO, GYRO_FIFO_CONFIG_1, GYRO_STREAM);
}

/* Three numbers of 16 bits, the low byte first. False: all bits are alike, as where nobody drives the line. */
static bool unpack(const uint8_t bytes[6], int32_t raw[3]) {
    bool alike = true;
    for (size_t axis = 0; axis < 3U; axis++) {
        const int32_t value = (int32_t)bytes[2U * axis + 1U] << 8 | bytes[2U * axis];
        raw[axis] = value >= 0x8000 ? value - 0x10000 : value;
        alike = alike && (value == 0 || value == 0xFFFF);
    }
    return !alike;
}

/* --- start --- */

static bool init(sensor_state_t *state, float rate_hz, sensor_wire_t *wire) {
    static const struct {
        uint16_t rate_hz, accel_hz;
        uint8_t bandwidth, conf;
    } rates[] = {{1000, 1600, 0x82, 0xAC}, {400, 400, 0x83, 0xAA}, {200, 200, 0x84, 0xA9}, {100, 100, 0x85, 0xA8}};
    bmi088_t *self = of(state);
    if (!bmi088_has_rate(rate_hz)) {
        return false;
    }
    *wire = (sensor_wire_t){10000000U, 2U, 3U};
    for (size_t i = 0; i < sizeof rates / sizeof rates[0]; i++) {
        if (fabsf(rate_hz - (float)rates[i].rate_hz) < 1.0F) {
            self->bandwidth = rates[i].bandwidth;
            self->accel_conf = rates[i].conf;
            self->per_sample = (uint16_t)((uint32_t)ONE * rates[i].accel_hz / rates[i].rate_hz);
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
    bmi088_t *self = of(state);
    uint8_t unused;
    (void)read_registers(self, ACCEL, ACC_CHIP_ID, &unused, 1U); /* its select's rise makes it take SPI */
    (void)write_byte(self, ACCEL, ACC_SOFTRESET, RESET);
    (void)write_byte(self, GYRO, GYRO_SOFTRESET, RESET);
    return SENSOR_NO_FAULT;
}

static sensor_fault_t probe(sensor_state_t *state) {
    bmi088_t *self = of(state);
    uint8_t accel, gyro;
    (void)read_registers(self, ACCEL, ACC_CHIP_ID, &accel, 1U); /* again, after the reset */
    const bool there = read_registers(self, ACCEL, ACC_CHIP_ID, &accel, 1U) && accel == ACC_IDENTITY &&
                       read_registers(self, GYRO, GYRO_CHIP_ID, &gyro, 1U) && gyro == GYRO_IDENTITY;
    return there && write_byte(self, ACCEL, ACC_PWR_CONF, 0U) ? SENSOR_NO_FAULT : SENSOR_ABSENT;
}

static sensor_fault_t power(sensor_state_t *state) {
    return write_byte(of(state), ACCEL, ACC_PWR_CTRL, ACC_ON) ? SENSOR_NO_FAULT : SENSOR_SET_UP;
}

static sensor_fault_t begin_test(sensor_state_t *state) {
    bmi088_t *self = of(state);
    const bool begun =
        write_register(self, ACCEL, ACC_RANGE, RANGE_24G) && write_register(self, ACCEL, ACC_CONF, ACC_1600HZ) &&
        write_byte(self, ACCEL, ACC_SELF_TEST, TEST_UP) && write_byte(self, GYRO, GYRO_SELF_TEST, TRIGGER);
    return begun ? SENSOR_NO_FAULT : SENSOR_SET_UP;
}

static bool read_accel(bmi088_t *self, int32_t raw[3]) {
    uint8_t bytes[6];
    return read_registers(self, ACCEL, ACC_DATA, bytes, sizeof bytes) && unpack(bytes, raw);
}

static sensor_fault_t turn_test(sensor_state_t *state) {
    bmi088_t *self = of(state);
    return read_accel(self, self->up) && write_byte(self, ACCEL, ACC_SELF_TEST, TEST_DOWN) ? SENSOR_NO_FAULT
                                                                                           : SENSOR_SELF_TEST;
}

/* The data sheet's least differences; the gyroscope judges itself. */
static sensor_fault_t judge(sensor_state_t *state) {
    static const float least_g[3] = {1.0F, 1.0F, 0.5F};
    bmi088_t *self = of(state);
    int32_t down[3];
    uint8_t gyro;
    bool passed = read_accel(self, down) && write_byte(self, ACCEL, ACC_SELF_TEST, 0U) &&
                  read_registers(self, GYRO, GYRO_SELF_TEST, &gyro, 1U) &&
                  (gyro & (TEST_ENDED | TEST_FAILED)) == TEST_ENDED;
    for (size_t axis = 0; axis < 3U && passed; axis++) {
        passed = (float)(self->up[axis] - down[axis]) >= least_g[axis] * STEPS_PER_G;
    }
    return passed ? SENSOR_NO_FAULT : SENSOR_SELF_TEST;
}

static sensor_fault_t set_up(sensor_state_t *state) {
    bmi088_t *self = of(state);
    const bool done = write_register(self, ACCEL, ACC_CONF, self->accel_conf) &&
                      write_register(self, ACCEL, ACC_FIFO_CONFIG_0, ACC_STREAM) &&
                      write_register(self, ACCEL, ACC_FIFO_CONFIG_1, ACC_INTO_FIFO) &&
                      write_register(self, GYRO, GYRO_RANGE, 0U) &&
                      write_register(self, GYRO, GYRO_BANDWIDTH, self->bandwidth);
    return done ? SENSOR_NO_FAULT : SENSOR_SET_UP;
}

static sensor_fault_t relaxed(sensor_state_t *state) {
    bmi088_t *self = of(state);
    self->checked_us = self->common.bus->time_us();
    self->dropped = 0;
    self->owed = 0;
    self->starved = 0;
    self->moved = false;
    self->accel_at = self->accel_end = 0;
    return empty_gyro(self) ? SENSOR_NO_FAULT : SENSOR_SET_UP;
}

/* --- run --- */

/* Whether one of the settings has been found wrong twice. */
static bool altered(bmi088_t *self) {
    const struct {
        uint8_t chip, place, value;
    } wanted[] = {{ACCEL, ACC_CONF, self->accel_conf},
                  {ACCEL, ACC_RANGE, RANGE_24G},
                  {ACCEL, ACC_PWR_CTRL, ACC_ON},
                  {ACCEL, ACC_PWR_CONF, 0U},
                  {ACCEL, ACC_FIFO_CONFIG_0, ACC_STREAM},
                  {ACCEL, ACC_FIFO_CONFIG_1, ACC_INTO_FIFO},
                  {GYRO, GYRO_RANGE, 0U},
                  {GYRO, GYRO_BANDWIDTH, self->bandwidth},
                  {GYRO, GYRO_FIFO_CONFIG_1, GYRO_STREAM}};
    for (size_t i = 0; i < sizeof wanted / sizeof wanted[0]; i++) {
        uint8_t found, again;
        if (read_registers(self, wanted[i].chip, wanted[i].place, &found, 1U) && found != wanted[i].value &&
            read_registers(self, wanted[i].chip, wanted[i].place, &again, 1U) && again == found) {
            return true;
        }
    }
    return false;
}

/* 11 bits of 1/8 degC about 23 degC, the high byte first. */
static void look_at_temperature(bmi088_t *self) {
    uint8_t bytes[2];
    if (read_registers(self, ACCEL, ACC_TEMPERATURE, bytes, 2U) && bytes[0] != 0x80U) {
        const int32_t value = (int32_t)bytes[0] << 3 | bytes[1] >> 5;
        self->temperature = (int16_t)(value > 1023 ? value - 2048 : value);
    }
}

static void watch(sensor_state_t *state, uint64_t now) {
    bmi088_t *self = of(state);
    if (now - self->looked_us >= LOOK_US) {
        self->looked_us = now;
        look_at_temperature(self);
    }
    if (now - self->checked_us >= CHECK_US) {
        self->checked_us = now;
        if (altered(self)) {
            sensor_fail(state, SENSOR_SET_UP);
        }
    }
}

/* True: the gyroscope's FIFO holds frames, or has lost some. */
static bool filled(bmi088_t *self, uint8_t *status) {
    return read_registers(self, GYRO, GYRO_FIFO_STATUS, status, 1U) && *status != 0U && *status != 0xFFU;
}

static bool waits(sensor_state_t *state) {
    uint8_t status;
    return of(state)->next < of(state)->held || filled(of(state), &status);
}

/* Bytes in the accelerometer's FIFO. */
static size_t accel_bytes(bmi088_t *self) {
    uint8_t bytes[2] = {0, 0};
    const bool read = read_registers(self, ACCEL, ACC_FIFO_LENGTH, bytes, 2U);
    const size_t count = (size_t)bytes[1] << 8 | bytes[0];
    return read && count <= ACCEL_FIFO_BYTES ? count : 0U; /* more: the lines float */
}

/* Reads the next frames; false: there are none. Both FIFOs end now, so their newest frames are of one time. One or two
 * accelerations stay behind: which of two newest frames has come already changes from read to read. */
static bool fetch(bmi088_t *self) {
    uint8_t status;
    if (!filled(self, &status)) {
        return false;
    }
    const sensor_bus_t *bus = self->common.bus;
    self->read_us = bus->time_us();
    if ((status & OVERRUN) != 0U) {
        self->common.counters.overruns++;
        (void)empty_gyro(self);
        sensor_expect(&self->common); /* the next frame is to come yet */
        return false;
    }
    const uint8_t held = status < CHUNK ? status : (uint8_t)CHUNK;
    const size_t wait = (accel_bytes(self) + self->accel_end - self->accel_at) / ACCEL_FRAME;
    const int32_t ahead = (int32_t)wait * ONE - (int32_t)status * self->per_sample - self->owed;
    if (ahead > BEHIND_MOST) {
        self->owed += ahead > PAUSE || !self->moved ? ahead - ONE - ahead % ONE : ONE;
    } else if (ahead < 0) { /* the last one again */
        self->owed -= ONE;
    }
    uint8_t out[sizeof self->chunk] = {READ | GYRO_FIFO_DATA};
    bus->choose(GYRO);
    if (!bus->exchange(out, self->chunk, 1U + (size_t)held * GYRO_FRAME)) {
        (void)empty_gyro(self);
        return false;
    }
    self->behind = (uint8_t)(status - held);
    self->next = 0;
    self->held = held;
    return true;
}

static bool fetch_accel(bmi088_t *self) {
    uint8_t out[sizeof self->accel_chunk] = {READ | ACC_FIFO_DATA};
    const size_t wait = accel_bytes(self), count = wait < ACCEL_CHUNK ? wait : ACCEL_CHUNK;
    self->accel_at = self->accel_end = 0;
    self->common.bus->choose(ACCEL);
    if (count == 0U || !self->common.bus->exchange(out, self->accel_chunk, 2U + count)) {
        return false;
    }
    self->accel_at = 2U;
    self->accel_end = (uint8_t)(2U + count);
    return true;
}

/* The next acceleration becomes the newest one; false: there is none. A frame that the end of the chunk cuts off comes
 * again, as the data sheet has it. */
static bool next_accel(bmi088_t *self) {
    for (unsigned turn = 0; turn < 2U; turn++) {
        while (self->accel_at < self->accel_end) {
            const uint8_t *frame = self->accel_chunk + self->accel_at;
            const unsigned kind = frame[0] & FRAME_KIND;
            const unsigned length = kind == FRAME_DATA ? ACCEL_FRAME : kind == FRAME_TIME ? 4U : 2U;
            if (kind != FRAME_DATA && kind != FRAME_TIME && kind != 0x40U && kind != 0x48U && kind != 0x50U) {
                self->accel_at = self->accel_end; /* the FIFO was empty, or the lines float */
                return false;
            }
            if (self->accel_at + length > self->accel_end) {
                break;
            }
            self->accel_at = (uint8_t)(self->accel_at + length);
            if (kind == FRAME_DATA && unpack(frame + 1, self->accel)) {
                self->starved = 0;
                self->moved = true;
                return true;
            }
        }
        if (turn > 0U || !fetch_accel(self)) {
            break;
        }
    }
    return false;
}

/* The accelerations of one more sample. False: there has been none for too long. */
static bool take_accel(bmi088_t *self) {
    self->starved = (uint16_t)(self->starved + 1U); /* bounded by STARVED_US */
    self->owed += self->per_sample;
    while (self->owed >= ONE) {
        self->owed -= ONE;
        if (!next_accel(self)) {
            self->owed = 0;
        }
    }
    return self->moved && self->starved <= STARVED_MOST;
}

/* Samples missing before one at `us`. */
static uint32_t missing_before(const bmi088_t *self, uint64_t us) {
    if (self->continuous || !self->anchored) {
        return self->continuous ? self->dropped : 0U;
    }
    const uint64_t passed = us > self->last_us ? us - self->last_us : 0U;
    const uint64_t count = (passed + self->common.period_us / 2U) / self->common.period_us;
    return count < 1U ? 0U : count < UINT32_MAX ? (uint32_t)(count - 1U) : UINT32_MAX;
}

static bool read_sample(sensor_state_t *state, int32_t raw[SENSOR_AXES], uint32_t *missing) {
    static const uint8_t no_frame[GYRO_FRAME] = {0x00, 0x80, 0x00, 0x80, 0x00, 0x80};
    bmi088_t *self = of(state);
    while (self->next < self->held || fetch(self)) {
        const uint8_t *frame = self->chunk + 1U + (size_t)self->next * GYRO_FRAME;
        if (memcmp(frame, no_frame, sizeof no_frame) == 0) { /* the FIFO's count was too high */
            self->held = self->next;
            return false;
        }
        self->next++;
        state->signs++;
        const uint64_t us = self->read_us - (uint64_t)(self->held - self->next + self->behind) * state->period_us;
        const bool whole = take_accel(self);
        if (self->starved * state->period_us > STARVED_US) {
            sensor_fail(state, SENSOR_SILENT);
            return false;
        }
        if (!whole || !unpack(frame, raw)) {
            state->counters.damaged += whole ? 1U : 0U;
            self->dropped++;
            continue;
        }
        memcpy(raw + 3, self->accel, sizeof self->accel);
        if (sensor_repeats(state, raw)) {
            self->dropped++;
            continue;
        }
        *missing = missing_before(self, us);
        self->last_us = us;
        self->anchored = self->continuous = true;
        self->dropped = 0;
        return true;
    }
    return false;
}

static float side(const sensor_state_t *state, unsigned channel) {
    const int16_t temperature = ((const bmi088_t *)(const void *)state)->temperature;
    const bool known = channel == SENSOR_TEMPERATURE && temperature != NO_TEMPERATURE;
    return known ? 23.0F + 0.125F * (float)temperature : NAN;
}

/* clang-format off */
static const sensor_step_t bmi088_steps[] = {
    {0, reset},
    {RESET_US, probe},
    {SUSPENDED_US, power},
    {SETTLE_US, begin_test},
    {SETTLE_US, turn_test},
    {SETTLE_US, judge},
    {SETTLE_US, set_up},
    {SETTLE_US, relaxed},
};
/* clang-format on */
static bmi088_t sensor;

const sensor_t bmi088 = {
    .state = &sensor.common,
    .bytes = sizeof sensor,
    .start = bmi088_steps,
    .steps = sizeof bmi088_steps / sizeof bmi088_steps[0],
    .step = {GYRO_STEP, ACCEL_STEP},
    .init = init,
    .stop = stop,
    .watch = watch,
    .waits = waits,
    .read = read_sample,
    .side = side,
};
