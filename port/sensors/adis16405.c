#include "adis16405.h"

#include <math.h>
#include <string.h>

/* Registers. */
enum {
    XGYRO_OFF = 0x1A, /* then y, z, and the accelerometers', two bytes each */
    MSC_CTRL = 0x34,
    SMPL_PRD = 0x36,
    SENS_AVG = 0x38,
    DIAG_STAT = 0x3C,
    GLOB_CMD = 0x3E,
    ALM_MAG1 = 0x40, /* of an alarm that is off: nothing but a place for MARK */
    ALM_CTRL = 0x48,
    PRODUCT_ID = 0x56
};
#define WRITE 0x80U
#define PRODUCT 16405U
#define GLOB_CMD_RESET 0x80U
#define MSC_CTRL_READY 0x06U          /* data-ready on DIO1, rising */
#define MSC_CTRL_SELF_TEST_HIGH 0x04U /* bit 10; clears itself at the end */
#define DIAG_SELF_TEST 0xFC20U        /* channels 15 to 10, overall 5 */
#define DIAG_OVER_RANGE 0x0010U
#define DIAG_FATAL (DIAG_SELF_TEST | 0x0043U) /* and flash checksum 6, supply above 5.25 V 1, below 4.75 V 0 */

/* Stands while the sensor is set up: a reset that nobody asked for shows by its absence, one that was lost by its
 * presence. */
#define MARK 0x15A5U

/* A burst word. */
#define ND 0x8000U
#define EA 0x4000U
#define VALUE 0x3FFFU
enum { SUPPLY_WORD = 0, FIRST_CHANNEL = 1, TEMPERATURE_WORD = 10 };

/* With a side channel's 12 bits: it has been read. */
#define SIDE_READ 0x8000U

/* Full range is 6000 LSB at every setting. A lost sign bit adds 2^13: a step of half of that within a sample is no
 * motion, and with nothing to compare with what could be a negative reading is refused. */
enum { SIGN_STEP = 4096 };
/* Of such readings in a row so many within SIGN_STEP of each other are a rotation: the anomaly strikes single ones
 * once XGYRO_OFF is not negative. Not of those beyond all the sensor can read, 350 deg/s. */
enum { SIGN_ALIKE = 4, SIGN_BEYOND = 7000, SIGN_UNSURE = 8192 - SIGN_BEYOND };
/* Readings of DIAG_STAT in a row, 0.1 s apart, that excuse missing samples; starts that MARK ends before its
 * registers are believed. */
enum { EXCUSES = 100, MARKS_REFUSED = 5 };

enum { CHANGES_ASKED = 2 }; /* after a start, before a sample is taken: a sensor that is stuck still gives none */
#define RESET_PULSE_US 1000U
#define START_US 300000U /* the data sheet: 220 ms from power, 170 ms from a reset */
#define SELF_TEST_US 200000U
/* Samples further apart than this and 1.5 periods, or closer than 3/4 of one: something else may have reset the
 * sensor, which takes 170 ms and leaves a rate of its own. What follows is taken once the settings have been found
 * to stand. */
#define DOUBT_US 100000U
/* Between readings of the settings without a cause. Seldom, since a bit error makes a write of a read, and that does
 * to the settings what is looked for. They take 5 words, 0.2 ms (0.9 ms in slow mode, which a quarter of its period
 * holds), and wait for room between two bursts; five times so long at most, then at the cost of a sample. */
#define CHECK_US 10000000U
#define CHECK_ROOM_US 250U
enum { CHECKS_TRIED = 3 };
#define DIAGNOSIS_US 100000U /* between readings of DIAG_STAT, at least */
/* Readings in a row that may be an eighth of a period or more from where the rate that was set has one. Further ones
 * are not taken: the sensor's clock is another. After a start none is taken before one that is in its place. Steps
 * beyond two periods and a half tell nothing: the 5 % that the clock may be off add up. */
enum { OFF_RATE_TAKEN = 3 };

/* Readings that wait for the main loop: 1.25 s at 819.2 Hz. A power of two; 16 bytes each. */
#ifndef SENSOR_QUEUE
#define SENSOR_QUEUE 1024U
#endif
#if SENSOR_QUEUE < 8 || (SENSOR_QUEUE & (SENSOR_QUEUE - 1)) != 0
#error "SENSOR_QUEUE must be a power of two, 8 at least"
#endif

/* The sensor makes 1638.4 / n Hz. */
#define DIVIDER(rate_hz) ((uint32_t)(1638.4F / (rate_hz) + 0.5F))

/* A burst: the command, then a word of each output register. */
enum { BURST_WORDS = 12, BURST_BYTES = 2 + 2 * BURST_WORDS };
static const uint8_t burst_out[BURST_BYTES] = {GLOB_CMD};

enum { GYRO_RANGE_300 = 4, TAPS_LN2 = 1 }; /* SENS_AVG: 300 deg/s, Bartlett filter of 2 taps */
#define FILTER ((uint16_t)(GYRO_RANGE_300 << 8 | TAPS_LN2))

typedef struct {
    sensor_state_t common;
    uint16_t sample_period;    /* SMPL_PRD */
    int16_t base[SENSOR_AXES]; /* offset registers as a reset leaves them */
    uint8_t settling;          /* samples to leave out after they were written */
    uint32_t period_q8;        /* sample period, us / 256 */
    uint32_t nominal_q8;
    volatile bool diagnosis_wanted;
    uint64_t diagnosis_us; /* when DIAG_STAT was read last */
    /* main loop, of the samples */
    uint64_t seen_us;    /* stamp of the last reading taken from the queue */
    uint64_t checked_us; /* when the settings were read last */
    uint64_t last_us;    /* stamp of the last sample delivered */
    bool doubtful;       /* none is delivered until the settings have been found to stand */
    bool anchored;
    uint64_t anchored_us; /* stamp of `common.last` */
    uint8_t unsure;       /* readings in a row that could be negative ones less their sign */
    uint8_t excuses;      /* readings of DIAG_STAT in a row that say over-range */
    uint8_t marks;        /* resets that left MARK */
    bool based;           /* `base` is known */
    uint32_t off_rate;    /* readings in a row that came no whole number of periods after the one before */
    uint8_t unproven;
    volatile uint16_t side[SENSOR_SIDE]; /* as read; 0: none yet */
    /* shared with the interrupt handlers */
    volatile bool listening, reading;
    volatile uint32_t stamp;
    bool second;
    uint16_t first_words[BURST_WORDS];
    uint8_t burst_in[BURST_BYTES];
    volatile uint32_t head, tail; /* count up for ever */
    volatile struct {
        uint32_t stamp;
        int16_t raw[SENSOR_AXES];
    } queue[SENSOR_QUEUE];
} adis16405_t;

static adis16405_t *of(sensor_state_t *state) {
    return (adis16405_t *)(void *)state;
}

static bool word(adis16405_t *self, uint8_t high, uint8_t low, uint16_t *value) {
    const uint8_t out[2] = {high, low};
    uint8_t in[2] = {0};
    const bool done = self->common.bus->exchange(out, in, sizeof out);
    *value = (uint16_t)((uint32_t)in[0] << 8 | in[1]);
    return done;
}

static bool read_register(adis16405_t *self, uint8_t address, uint16_t *value) {
    return word(self, address, 0U, value) && word(self, 0U, 0U, value);
}

/* Twice, and alike: a register has no checksum either. */
static bool read_surely(adis16405_t *self, uint8_t address, uint16_t *value) {
    uint16_t again;
    return read_register(self, address, value) && read_register(self, address, &again) && *value == again;
}

static bool write_byte(adis16405_t *self, uint8_t address, uint16_t value) {
    uint16_t ignored;
    return word(self, WRITE | address, (uint8_t)value, &ignored);
}

static bool write_register(adis16405_t *self, uint8_t address, uint16_t value) {
    uint16_t found;
    return write_byte(self, address, value) && write_byte(self, (uint8_t)(address + 1U), (uint16_t)(value >> 8)) &&
           read_surely(self, address, &found) && found == value;
}

/* Bits of an offset register: 13 of 0.0125 deg/s, 12 of 3.33 mg, two's complement. */
enum { GYRO_OFFSET_LIMIT = 4096, ACCEL_OFFSET_LIMIT = 2048 };
static int32_t offset_limit(size_t channel) {
    return channel < 3U ? GYRO_OFFSET_LIMIT : ACCEL_OFFSET_LIMIT;
}

/* Whether the settings are those of the start: GOOD if so, ALTERED if one read twice alike is not. */
typedef enum { UNSURE, GOOD, ALTERED } settings_t;

static settings_t settings(adis16405_t *self) {
    static const uint8_t address[] = {SMPL_PRD, SENS_AVG, MSC_CTRL, ALM_MAG1};
    enum { COUNT = sizeof address };
    const uint16_t wanted[COUNT] = {self->sample_period, FILTER, MSC_CTRL_READY, MARK};
    uint16_t found[1 + COUNT];
    for (unsigned i = 0; i <= COUNT; i++) { /* an answer comes with the next word */
        if (!word(self, i < COUNT ? address[i] : 0U, 0U, &found[i])) {
            return UNSURE;
        }
    }
    settings_t result = GOOD;
    for (unsigned i = 0; i < COUNT; i++) {
        uint16_t value;
        if (found[1U + i] != wanted[i]) {
            result = UNSURE;
            if (read_surely(self, address[i], &value) && value != wanted[i]) {
                return ALTERED;
            }
        }
    }
    return result;
}

/* As a signed number; the bits above are not used. */
static int16_t offset_value(size_t channel, uint16_t word) {
    const int32_t limit = offset_limit(channel), value = (int32_t)(word & (2U * (uint32_t)limit - 1U));
    return (int16_t)(value >= limit ? value - 2 * limit : value);
}

static bool write_offset(adis16405_t *self, size_t channel, int32_t value) {
    const uint8_t address = (uint8_t)(XGYRO_OFF + 2U * channel);
    const uint16_t word = (uint16_t)(value & 0xFFFF);
    uint16_t found;
    return write_byte(self, address, word) && write_byte(self, (uint8_t)(address + 1U), (uint16_t)(word >> 8)) &&
           read_surely(self, address, &found) && offset_value(channel, found) == value;
}

/* After a reset: what the registers hold, and then what has been added to that. An XGYRO_OFF below 0 loses signs
 * (the anomaly): it is taken for 0, and the bank finds so much more bias. With MARK the reset did not come about,
 * and the registers hold what was added before; a part with MARK in its own flash, improbable as it is, must not be
 * refused for ever. */
static bool restore_offsets(adis16405_t *self) {
    uint16_t word;
    if (!read_surely(self, ALM_MAG1, &word)) {
        return false;
    }
    bool write[SENSOR_AXES];
    const bool marked = word == MARK;
    if (marked && !self->based && self->marks < MARKS_REFUSED) {
        self->marks++;
        return false;
    }
    for (size_t channel = 0; channel < SENSOR_AXES; channel++) {
        write[channel] = marked || self->common.added[channel] != 0;
        if (marked && self->based) {
            continue;
        }
        if (!read_surely(self, (uint8_t)(XGYRO_OFF + 2U * channel), &word)) {
            self->based = false;
            return false;
        }
        self->base[channel] = offset_value(channel, word);
        if (channel == 0U && self->base[0] < 0) {
            self->base[0] = 0;
            write[0] = true;
        }
    }
    self->based = true;
    if (!write_register(self, ALM_MAG1, MARK)) {
        return false;
    }
    for (size_t channel = 0; channel < SENSOR_AXES; channel++) {
        const int32_t value = self->base[channel] + self->common.added[channel];
        if (write[channel] && ((channel == 0U && value < 0) || !write_offset(self, channel, value))) {
            return false; /* of another part's saved state, say: until it is taken back (sensor_offsets(), all 0) */
        }
    }
    return true;
}

static bool init(sensor_state_t *state, float rate_hz, sensor_wire_t *wire) {
    adis16405_t *self = of(state);
    if (!adis16405_has_rate(rate_hz)) {
        return false;
    }
    const uint32_t n = DIVIDER(rate_hz);
    const bool slow = n > 10U;
    *wire = (sensor_wire_t){slow ? 300000U : 1000000U, slow ? 80U : 10U, 3U};
    self->sample_period = (uint16_t)(n - 1U);
    self->nominal_q8 = (uint32_t)(256.0F * 1e6F / 1638.4F * (float)n + 0.5F);
    self->period_q8 = self->nominal_q8;
    state->period_us = self->nominal_q8 >> 8;
    return true;
}

static void stop(sensor_state_t *state) {
    adis16405_t *self = of(state);
    self->listening = false;
    self->tail = self->head; /* what waits may be of a sensor that was no longer set up */
}

/* --- interrupt handlers --- */

static void start_burst(adis16405_t *self) {
    self->reading = self->common.bus->begin(burst_out, self->burst_in, sizeof burst_out);
    if (!self->reading) {
        self->common.counters.damaged++;
    }
}

static void ready(sensor_state_t *state) {
    adis16405_t *self = of(state);
    const uint32_t now = state->bus->time_us32();
    state->signs++;
    if (!self->listening) {
        return;
    }
    if (self->reading) {
        self->common.counters.overruns++;
        if (now - self->stamp < 4U * state->period_us) {
            return; /* else the burst has died: break it off */
        }
    }
    self->stamp = now;
    self->second = false;
    start_burst(self);
}

/* Whether the words of the first reading are a new sample. */
static bool fresh(adis16405_t *self, const uint16_t words[]) {
    uint16_t all = 0xFFFFU, any = 0;
    for (size_t i = 0; i < SENSOR_AXES; i++) {
        all &= words[FIRST_CHANNEL + i];
        any |= words[FIRST_CHANNEL + i];
    }
    if ((any & EA) != 0U) {
        self->common.counters.alarms++;
        self->diagnosis_wanted = true;
        return false;
    }
    if ((all & ND) == 0U) {
        self->common.counters.stale++;
        return false;
    }
    return true;
}

static void done(sensor_state_t *state, bool whole) {
    adis16405_t *self = of(state);
    if (!self->reading) {
        return;
    }
    self->reading = false;
    if (!self->listening) {
        return;
    }
    if (!whole) {
        self->common.counters.damaged++;
        return;
    }
    uint16_t words[BURST_WORDS];
    for (size_t i = 0; i < BURST_WORDS; i++) {
        words[i] = (uint16_t)((uint32_t)self->burst_in[2U * i + 2U] << 8 | self->burst_in[2U * i + 3U]);
    }
    if (!self->second) {
        if (fresh(self, words)) {
            memcpy(self->first_words, words, sizeof self->first_words);
            self->second = true;
            start_burst(self);
        }
        return;
    }
    for (size_t i = FIRST_CHANNEL; i < FIRST_CHANNEL + SENSOR_AXES; i++) {
        if (((words[i] ^ self->first_words[i]) & (VALUE | EA)) != 0U || (words[i] & ND) != 0U) {
            self->common.counters.damaged++; /* ND again: a sample came in between, and the words may be of either */
            return;
        }
    }
    for (size_t i = 0; i < SENSOR_SIDE; i++) {
        const size_t at = i == SENSOR_SUPPLY ? SUPPLY_WORD : TEMPERATURE_WORD;
        if (((words[at] ^ self->first_words[at]) & VALUE) == 0U) {
            self->side[i] = (uint16_t)(SIDE_READ | (words[at] & 0xFFFU));
        }
    }
    const uint32_t head = self->head;
    if (head - self->tail == SENSOR_QUEUE) {
        self->common.counters.overruns++;
        return;
    }
    self->queue[head % SENSOR_QUEUE].stamp = self->stamp;
    for (size_t i = 0; i < SENSOR_AXES; i++) {
        const uint32_t value = words[FIRST_CHANNEL + i] & VALUE;
        self->queue[head % SENSOR_QUEUE].raw[i] = (int16_t)((int32_t)(value ^ 0x2000U) - 0x2000);
    }
    self->head = head + 1U;
}

/* --- main loop --- */

/* Either has 12 bits. Temperature: two's complement, 0.14 degC each, 0 at 25 degC. Supply: 2.418 mV each. If the two
 * readings of a burst differ, the value before stands. */
static float side(const sensor_state_t *state, unsigned channel) {
    const uint32_t read = ((const adis16405_t *)(const void *)state)->side[channel];
    const uint32_t value = read & 0xFFFU;
    if ((read & SIDE_READ) == 0U) {
        return NAN;
    }
    if (channel == SENSOR_SUPPLY) {
        return 2.418e-3F * (float)value;
    }
    return 25.0F + 0.14F * (float)((int32_t)(value ^ 0x800U) - 0x800);
}

/* Stops listening and waits for a reading under way, two bursts of 1.4 ms at most (slow mode); a burst that has died
 * is left. */
static void hold(adis16405_t *self) {
    const uint32_t start = self->common.bus->time_us32();
    self->listening = false;
    while (self->reading && self->common.bus->time_us32() - start < 4000U) {
    }
    self->reading = false;
}

static void listen(adis16405_t *self) {
    self->second = false;
    self->listening = true;
}

static void pause(sensor_state_t *state, bool on) {
    adis16405_t *self = of(state);
    if (state->condition != SENSOR_RUNNING) {
        return;
    }
    if (on) {
        hold(self);
    } else {
        sensor_expect(state);
        listen(self);
    }
}

static sensor_fault_t self_tested(sensor_state_t *state);

/* With a negative XGYRO_OFF the part loses the sign bit of negative x rates (the anomaly above): it is refused. So a
 * positive x bias stays. */
static bool offsets(sensor_state_t *state, const int16_t added[SENSOR_AXES]) {
    adis16405_t *self = of(state);
    if (state->condition == SENSOR_STARTING && state->sensor->start[state->step].act == self_tested) {
        return false; /* the registers have been written for this start */
    }
    for (size_t channel = 0; channel < SENSOR_AXES; channel++) {
        const int32_t value = self->base[channel] + added[channel], limit = offset_limit(channel);
        if (self->based && (value < -limit || value >= limit || (channel == 0U && value < 0))) {
            return false;
        }
    }
    if (state->condition == SENSOR_RUNNING) {
        hold(self);
        self->tail = self->head;
        bool written = true;
        for (size_t channel = 0; channel < SENSOR_AXES && written; channel++) {
            written = added[channel] == state->added[channel] ||
                      write_offset(self, channel, self->base[channel] + added[channel]);
        }
        self->settling = (uint8_t)(2U + (2U << TAPS_LN2));
        if (!written) {
            sensor_fail(state, SENSOR_SET_UP); /* the restart writes what was added before */
            return false;
        }
        sensor_expect(state);
        listen(self);
    }
    return true;
}

/* Reads DIAG_STAT, which clears it; false: not readable. */
static bool diagnose(adis16405_t *self, uint16_t *bits) {
    if (!read_register(self, DIAG_STAT, bits) || *bits == 0xFFFFU) { /* floating lines */
        return false;
    }
    self->common.diagnosis |= *bits;
    self->diagnosis_us = self->common.bus->time_us();
    self->diagnosis_wanted = false;
    return true;
}

static sensor_fault_t reset(sensor_state_t *state) {
    (void)write_byte(of(state), GLOB_CMD, GLOB_CMD_RESET);
    state->bus->reset_line(true);
    return SENSOR_NO_FAULT;
}

static sensor_fault_t let_go(sensor_state_t *state) {
    state->bus->reset_line(false);
    return SENSOR_NO_FAULT;
}

static sensor_fault_t probe(sensor_state_t *state) {
    uint16_t value;
    return read_surely(of(state), PRODUCT_ID, &value) && value == PRODUCT ? SENSOR_NO_FAULT : SENSOR_ABSENT;
}

static sensor_fault_t set_up(sensor_state_t *state) {
    adis16405_t *self = of(state);
    uint16_t ignored;
    if (!write_register(self, SMPL_PRD, self->sample_period) || !write_register(self, SENS_AVG, FILTER) ||
        !write_register(self, ALM_CTRL, 0U) || !write_register(self, MSC_CTRL, MSC_CTRL_READY) ||
        !restore_offsets(self)) {
        return SENSOR_SET_UP;
    }
    const bool begun = diagnose(self, &ignored) && write_byte(self, MSC_CTRL + 1U, MSC_CTRL_SELF_TEST_HIGH);
    return begun ? SENSOR_NO_FAULT : SENSOR_SELF_TEST;
}

static sensor_fault_t self_tested(sensor_state_t *state) {
    adis16405_t *self = of(state);
    const uint64_t now = state->bus->time_us();
    uint16_t value;
    if (!read_surely(self, MSC_CTRL, &value) || value != MSC_CTRL_READY) {
        return now - state->step_us >= SELF_TEST_US ? SENSOR_SELF_TEST : SENSOR_NOT_YET;
    }
    if (!diagnose(self, &value) || (value & DIAG_SELF_TEST) != 0U) {
        return SENSOR_SELF_TEST;
    }
    if ((value & DIAG_FATAL) != 0U) {
        return SENSOR_STATUS;
    }
    settings_t found = UNSURE;
    for (int i = 0; i < CHECKS_TRIED && found == UNSURE; i++) {
        found = settings(self);
    }
    if (found != GOOD) { /* reset by something else in between */
        return SENSOR_SET_UP;
    }
    self->seen_us = now;
    self->checked_us = now;
    self->off_rate = OFF_RATE_TAKEN;
    self->doubtful = false;
    self->unproven = CHANGES_ASKED;
    self->anchored = false;
    self->unsure = 0;
    self->settling = 0;
    self->excuses = 0;
    listen(self);
    return SENSOR_NO_FAULT;
}

/* Looks after the settings; false: they have been altered, and the sensor is set up anew. */
static bool look_after(adis16405_t *self, uint64_t now) {
    hold(self);
    const settings_t found = settings(self);
    listen(self);
    self->checked_us = now;
    self->doubtful = self->doubtful && found != GOOD;
    if (found == ALTERED) {
        sensor_fail(&self->common, SENSOR_SET_UP);
    }
    return found != ALTERED;
}

static void watch(sensor_state_t *state, uint64_t now) {
    adis16405_t *self = of(state);
    const uint64_t unchecked = now - self->checked_us;
    const uint32_t period = state->period_us;
    const bool room = !self->reading && (uint32_t)now - self->stamp + CHECK_ROOM_US < period - period / 4U;
    if (unchecked >= CHECK_US && (room || unchecked >= 5ULL * CHECK_US) && !look_after(self, now)) {
        return;
    }
    if (self->diagnosis_wanted && now - self->diagnosis_us >= DIAGNOSIS_US) {
        uint16_t bits;
        hold(self);
        const bool read = diagnose(self, &bits);
        listen(self);
        if (read && (bits & DIAG_FATAL) != 0U) {
            sensor_fail(state, SENSOR_STATUS);
            return;
        }
        if (read && (bits & DIAG_OVER_RANGE) != 0U && self->excuses < EXCUSES) {
            self->excuses++; /* the samples are refused, the sensor is well */
            sensor_expect(state);
        }
    }
}

static bool waits(sensor_state_t *state) {
    return of(state)->head != of(state)->tail;
}

/* XGYRO_OUT less its sign bit, judged by what went before. */
static bool sign_lost(adis16405_t *self, int32_t x) {
    if (self->anchored) {
        return x - self->common.last[0] >= SIGN_STEP;
    }
    if (x > SIGN_BEYOND) {
        self->unsure = 0;
        return true;
    }
    const int32_t step = x - self->common.last[0];
    const bool alike = self->unsure > 0U && step < SIGN_STEP && step > -SIGN_STEP;
    self->unsure = x >= SIGN_UNSURE ? (uint8_t)(alike ? self->unsure + 1U : 1U) : 0U;
    self->common.last[0] = x;
    return self->unsure > 0U && self->unsure < SIGN_ALIKE;
}

/* Periods since the last sample, and the period itself tracked over samples that follow each other. */
static uint32_t periods(adis16405_t *self, uint64_t stamp) {
    const uint64_t passed_q8 = (stamp - self->last_us) << 8;
    const uint64_t count = (passed_q8 + self->period_q8 / 2U) / self->period_q8;
    if (count == 1U) {
        const int32_t off = (int32_t)(passed_q8 - self->period_q8) / 64;
        const uint32_t period = self->period_q8 + (uint32_t)off;
        if (period > self->nominal_q8 - self->nominal_q8 / 16U && period < self->nominal_q8 + self->nominal_q8 / 16U) {
            self->period_q8 = period;
        }
    }
    return count < UINT32_MAX ? (uint32_t)count : UINT32_MAX;
}

/* Whether `step` is an eighth of a period or more from one and from two of them. */
static bool off_grid(uint64_t step, uint64_t period) {
    const uint64_t right = 2U * step < 3U * period ? period : 2U * period;
    return 8U * (step < right ? right - step : step - right) >= period;
}

static bool read_sample(sensor_state_t *state, int32_t raw[SENSOR_AXES], uint32_t *missing) {
    adis16405_t *self = of(state);
    while (self->tail != self->head) {
        const uint32_t tail = self->tail;
        const uint64_t now = state->bus->time_us();
        const uint64_t stamp = now - (uint32_t)((uint32_t)now - self->queue[tail % SENSOR_QUEUE].stamp);
        for (size_t i = 0; i < SENSOR_AXES; i++) {
            raw[i] = self->queue[tail % SENSOR_QUEUE].raw[i];
        }
        self->tail = tail + 1U;
        const uint64_t step = stamp - self->seen_us, period = state->period_us, doubt = period + period / 2U;
        self->seen_us = stamp;
        if (2U * step < 5U * period) {
            self->off_rate = off_grid(step, period) ? self->off_rate + 1U : 0U;
        }
        if (self->off_rate > OFF_RATE_TAKEN) {
            continue;
        }
        self->doubtful = self->doubtful || step > (DOUBT_US > doubt ? DOUBT_US : doubt) || step < period - period / 4U;
        if (self->doubtful && (!look_after(self, now) || self->doubtful)) {
            continue;
        }
        if (self->settling > 0U) {
            self->settling--;
            continue;
        }
        if (self->anchored && stamp - self->anchored_us > 10U * period) {
            self->anchored = false;
            self->unsure = 0;
        }
        if (sign_lost(self, raw[0])) {
            self->common.counters.anomalies++;
            continue;
        }
        const bool repeats = sensor_repeats(state, raw);
        self->anchored = true;
        self->anchored_us = stamp;
        if (state->equal == 0U && self->unproven > 0U) {
            self->unproven--;
        }
        if (repeats || self->unproven > 0U) {
            continue;
        }
        const uint32_t passed = state->counters.samples > 0U ? periods(self, stamp) : 1U;
        *missing = passed > 0U ? passed - 1U : 0U;
        self->last_us = stamp;
        self->excuses = 0;
        return true;
    }
    return false;
}

static const sensor_step_t adis16405_steps[] = {
    {0, reset}, {RESET_PULSE_US, let_go}, {START_US, probe}, {0, set_up}, {0, self_tested},
};
static adis16405_t sensor;

const sensor_t adis16405 = {
    .state = &sensor.common,
    .bytes = sizeof sensor,
    .start = adis16405_steps,
    .steps = sizeof adis16405_steps / sizeof adis16405_steps[0],
    .step = {0.05F, 3.33e-3F * SENSOR_G},
    .offset_step = {0.0125F, 3.33e-3F * SENSOR_G},
    .offset_limit = {GYRO_OFFSET_LIMIT, ACCEL_OFFSET_LIMIT},
    .init = init,
    .stop = stop,
    .watch = watch,
    .waits = waits,
    .read = read_sample,
    .side = side,
    .offsets = offsets,
    .pause = pause,
    .ready = ready,
    .done = done,
};
