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
#define WRITE 0x8000U
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

/* All six channels the same as before: by chance once in 10^4 to 10^8 samples (noise of 0.6 to 18 LSB a channel).
 * From the third in a row on they are withheld, the sixteenth is a fault. */
enum { REPEATS_TAKEN = 2, REPEATS_STUCK = 16 };
enum { CHANGES_ASKED = 2 }; /* after a start, before a sample is taken: a sensor that is stuck still gives none */
#define RESET_PULSE_US 1000U
#define START_US 300000U      /* the data sheet: 220 ms from power, 170 ms from a reset */
#define SELF_TEST_US 200000U
#define SILENCE_US 150000U    /* without a sample; at least 10 periods as well */
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
#define DIAGNOSIS_US 100000U  /* between readings of DIAG_STAT, at least */
#define BACKOFF_MIN_US 100000U
#define BACKOFF_MAX_US 10000000U
enum { PROVEN_SAMPLES = 1000 };
/* Readings in a row that may be an eighth of a period or more from where the rate that was set has one. Further ones
 * are not taken: the sensor's clock is another. After a start none is taken before one that is in its place. Steps
 * beyond two periods and a half tell nothing: the 5 % that the clock may be off add up. */
enum { OFF_RATE_TAKEN = 3 };

enum { STEP_PULSE, STEP_BOOT, STEP_SELF_TEST };

static bool read_register(adis16405_t *self, uint8_t address, uint16_t *value)
{
    const adis16405_bus_t *bus = self->bus;
    uint16_t ignored;
    return bus->word(bus->context, (uint16_t)(address << 8), &ignored) && bus->word(bus->context, 0U, value);
}

/* Twice, and alike: a register has no checksum either. */
static bool read_surely(adis16405_t *self, uint8_t address, uint16_t *value)
{
    uint16_t again;
    return read_register(self, address, value) && read_register(self, address, &again) && *value == again;
}

static bool write_byte(adis16405_t *self, uint8_t address, uint16_t value)
{
    uint16_t ignored;
    return self->bus->word(self->bus->context, (uint16_t)(WRITE | (unsigned)address << 8 | (value & 0xFFU)), &ignored);
}

static bool write_register(adis16405_t *self, uint8_t address, uint16_t value)
{
    uint16_t found;
    return write_byte(self, address, value) && write_byte(self, (uint8_t)(address + 1U), (uint16_t)(value >> 8)) &&
           read_surely(self, address, &found) && found == value;
}

/* Bits of an offset register: 13 of 0.0125 deg/s, 12 of 3.33 mg, two's complement. */
static int32_t offset_limit(size_t channel)
{
    return channel < 3U ? 4096 : 2048;
}

static float offset_step(const adis16405_t *self, size_t channel)
{
    return channel < 3U ? 0.0125F : self->scale[channel];
}

/* Whether the settings are those of the start: GOOD if so, ALTERED if one read twice alike is not. */
typedef enum { UNSURE, GOOD, ALTERED } settings_t;

static settings_t settings(adis16405_t *self)
{
    static const uint8_t address[] = {SMPL_PRD, SENS_AVG, MSC_CTRL, ALM_MAG1};
    enum { COUNT = sizeof address };
    const uint16_t wanted[COUNT] = {self->sample_period, self->filter, MSC_CTRL_READY, MARK};
    uint16_t found[1 + COUNT];
    for (unsigned i = 0; i <= COUNT; i++) { /* an answer comes with the next word */
        if (!self->bus->word(self->bus->context, (uint16_t)(i < COUNT ? address[i] << 8 : 0), &found[i])) {
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
static int16_t offset_value(size_t channel, uint16_t word)
{
    const int32_t limit = offset_limit(channel), value = (int32_t)(word & (2U * (uint32_t)limit - 1U));
    return (int16_t)(value >= limit ? value - 2 * limit : value);
}

static bool write_offset(adis16405_t *self, size_t channel, int32_t value)
{
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
static bool restore_offsets(adis16405_t *self)
{
    uint16_t word;
    if (!read_surely(self, ALM_MAG1, &word)) {
        return false;
    }
    bool write[ADIS16405_AXES];
    const bool marked = word == MARK;
    if (marked && !self->based && self->marks < MARKS_REFUSED) {
        self->marks++;
        return false;
    }
    for (size_t channel = 0; channel < ADIS16405_AXES; channel++) {
        write[channel] = marked || self->added[channel] != 0;
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
    for (size_t channel = 0; channel < ADIS16405_AXES; channel++) {
        const int32_t value = self->base[channel] + self->added[channel];
        if (write[channel] && ((channel == 0U && value < 0) || !write_offset(self, channel, value))) {
            return false; /* of another part's saved state, say: until it is taken back (adis16405_offsets(), all 0) */
        }
    }
    return true;
}

static void enter(adis16405_t *self, uint8_t step, uint64_t now)
{
    self->state = ADIS16405_STARTING;
    self->step = step;
    self->step_us = now;
}

/* From here on the sensor is to give samples. */
static void expect(adis16405_t *self, uint64_t now)
{
    self->progress_us = now;
    self->ready_seen = self->ready_count;
}

static void begin(adis16405_t *self, uint64_t now)
{
    (void)write_byte(self, GLOB_CMD, GLOB_CMD_RESET);
    self->bus->reset_line(self->bus->context, true);
    enter(self, STEP_PULSE, now);
}

static void fail(adis16405_t *self, adis16405_fault_t fault, uint64_t now)
{
    self->listening = false;
    self->tail = self->head; /* what waits may be of a sensor that was no longer set up */
    self->state = ADIS16405_FAILED;
    self->fault = fault;
    self->step_us = now;
    self->counters.faults++;
    if (self->good >= PROVEN_SAMPLES) {
        self->backoff_us = BACKOFF_MIN_US;
    } else {
        self->backoff_us = self->backoff_us < BACKOFF_MAX_US / 2U ? self->backoff_us * 2U : BACKOFF_MAX_US;
    }
    self->good = 0;
}

bool adis16405_init(adis16405_t *self, const adis16405_bus_t *bus, const adis16405_config_t *config)
{
    memset(self, 0, sizeof *self);
    self->bus = bus;
    if (!ADIS16405_HAS_RATE(config->rate_hz) || config->filter_taps_ln2 > 4U) {
        return false;
    }
    const uint32_t n = ADIS16405_DIVIDER(config->rate_hz);
    self->sample_period = (uint16_t)(n - 1U);
    self->nominal_q8 = (uint32_t)(256.0F * 1e6F / 1638.4F * (float)n + 0.5F);
    self->period_q8 = self->nominal_q8;
    uint16_t range;
    float gyro;
    switch (config->range_deg_s) {
    case 300: range = 4U; gyro = 0.05F; break;
    case 150: range = 2U; gyro = 0.025F; break;
    case 75: range = 1U; gyro = 0.0125F; break;
    default: return false;
    }
    self->filter = (uint16_t)((unsigned)range << 8 | config->filter_taps_ln2);
    for (size_t i = 0; i < ADIS16405_AXES; i++) {
        self->scale[i] = i < 3U ? gyro : 3.33e-3F * 9.80665F;
    }
    self->backoff_us = BACKOFF_MIN_US / 2U;
    begin(self, bus->time_us(bus->context));
    return true;
}

/* ----------------------------------------------------------------------------------------------- interrupt handlers */

static void start_burst(adis16405_t *self)
{
    self->reading = self->bus->burst(self->bus->context);
    if (!self->reading) {
        self->counters.damaged++;
    }
}

void adis16405_ready(adis16405_t *self)
{
    const uint32_t now = self->bus->time_us32(self->bus->context);
    self->ready_count++;
    if (!self->listening) {
        return;
    }
    if (self->reading) {
        self->counters.overruns++;
        if (now - self->stamp < 4U * (self->nominal_q8 >> 8)) {
            return; /* else the burst has died: break it off */
        }
    }
    self->stamp = now;
    self->second = false;
    start_burst(self);
}

/* Whether the words of the first reading are a new sample. */
static bool fresh(adis16405_t *self, const uint16_t words[])
{
    uint16_t all = 0xFFFFU, any = 0;
    for (size_t i = 0; i < ADIS16405_AXES; i++) {
        all &= words[FIRST_CHANNEL + i];
        any |= words[FIRST_CHANNEL + i];
    }
    if ((any & EA) != 0U) {
        self->counters.alarms++;
        self->diagnosis_wanted = true;
        return false;
    }
    if ((all & ND) == 0U) {
        self->counters.stale++;
        return false;
    }
    return true;
}

void adis16405_burst(adis16405_t *self, const uint16_t words[ADIS16405_BURST_WORDS], bool whole)
{
    if (!self->reading) {
        return;
    }
    self->reading = false;
    if (!self->listening) {
        return;
    }
    if (!whole) {
        self->counters.damaged++;
        return;
    }
    if (!self->second) {
        if (fresh(self, words)) {
            memcpy(self->first_words, words, sizeof self->first_words);
            self->second = true;
            start_burst(self);
        }
        return;
    }
    for (size_t i = FIRST_CHANNEL; i < FIRST_CHANNEL + ADIS16405_AXES; i++) {
        if (((words[i] ^ self->first_words[i]) & (VALUE | EA)) != 0U || (words[i] & ND) != 0U) {
            self->counters.damaged++; /* ND again: a sample came in between, and the words may be of either */
            return;
        }
    }
    for (size_t i = 0; i < 2U; i++) {
        const size_t word = i == 0U ? SUPPLY_WORD : TEMPERATURE_WORD;
        if (((words[word] ^ self->first_words[word]) & VALUE) == 0U) {
            self->side[i] = (uint16_t)(SIDE_READ | (words[word] & 0xFFFU));
        }
    }
    const uint32_t head = self->head;
    if (head - self->tail == ADIS16405_QUEUE) {
        self->counters.overruns++;
        return;
    }
    self->queue[head % ADIS16405_QUEUE].stamp = self->stamp;
    for (size_t i = 0; i < ADIS16405_AXES; i++) {
        const uint32_t value = words[FIRST_CHANNEL + i] & VALUE;
        self->queue[head % ADIS16405_QUEUE].raw[i] = (int16_t)((int32_t)(value ^ 0x2000U) - 0x2000);
    }
    self->head = head + 1U;
}

/* -------------------------------------------------------------------------------------------------------- main loop */

float adis16405_temperature(const adis16405_t *self)
{
    const uint32_t side = self->side[1]; /* 12 bits, two's complement, 0.14 degC each, 0 at 25 degC */
    return (side & SIDE_READ) != 0U ? 25.0F + 0.14F * (float)((int32_t)((side & 0xFFFU) ^ 0x800U) - 0x800) : NAN;
}

float adis16405_supply(const adis16405_t *self)
{
    const uint32_t side = self->side[0]; /* 12 bits, 2.418 mV each */
    return (side & SIDE_READ) != 0U ? 2.418e-3F * (float)(side & 0xFFFU) : NAN;
}

/* Stops listening and waits for a reading under way, two bursts of 1.4 ms at most (slow mode); a burst that has died
 * is left. */
static void hold(adis16405_t *self)
{
    const uint32_t start = self->bus->time_us32(self->bus->context);
    self->listening = false;
    while (self->reading && self->bus->time_us32(self->bus->context) - start < 4000U) {
    }
    self->reading = false;
}

static void listen(adis16405_t *self)
{
    self->second = false;
    self->listening = true;
}

void adis16405_pause(adis16405_t *self, bool on)
{
    if (self->state != ADIS16405_RUNNING) {
        return;
    }
    if (on) {
        hold(self);
    } else {
        expect(self, self->bus->time_us(self->bus->context));
        listen(self);
    }
}

bool adis16405_offsets(adis16405_t *self, const float wanted[ADIS16405_AXES], float got[ADIS16405_AXES])
{
    int16_t added[ADIS16405_AXES];
    if (self->state == ADIS16405_STARTING && self->step == STEP_SELF_TEST) {
        return false; /* the registers have been written for this start */
    }
    for (size_t channel = 0; channel < ADIS16405_AXES; channel++) {
        const float steps = wanted[channel] / offset_step(self, channel);
        if (!(steps > -4096.0F && steps < 4096.0F)) {
            return false;
        }
        added[channel] = (int16_t)(steps < 0.0F ? steps - 0.5F : steps + 0.5F);
        const int32_t value = self->base[channel] + added[channel], limit = offset_limit(channel);
        if (self->based && (value < -limit || value >= limit || (channel == 0U && value < 0))) {
            return false;
        }
        got[channel] = (float)added[channel] * offset_step(self, channel);
    }
    if (self->state == ADIS16405_RUNNING) {
        hold(self);
        self->tail = self->head;
        bool done = true;
        for (size_t channel = 0; channel < ADIS16405_AXES && done; channel++) {
            done = added[channel] == self->added[channel] ||
                   write_offset(self, channel, self->base[channel] + added[channel]);
        }
        self->settling = (uint8_t)(2U + (2U << (self->filter & 7U)));
        expect(self, self->bus->time_us(self->bus->context));
        if (!done) {
            fail(self, ADIS16405_SET_UP, self->progress_us); /* the restart writes what was added before */
            return false;
        }
        listen(self);
    }
    memcpy(self->added, added, sizeof added);
    return true;
}

/* Reads DIAG_STAT, which clears it; false: not readable. */
static bool diagnose(adis16405_t *self, uint16_t *bits)
{
    if (!read_register(self, DIAG_STAT, bits) || *bits == 0xFFFFU) { /* floating lines */
        return false;
    }
    self->diagnosis |= *bits;
    self->diagnosis_us = self->bus->time_us(self->bus->context);
    self->diagnosis_wanted = false;
    return true;
}

static void start_on(adis16405_t *self, uint64_t now)
{
    const uint64_t passed = now - self->step_us;
    uint16_t value;
    switch (self->step) {
    case STEP_PULSE:
        if (passed >= RESET_PULSE_US) {
            self->bus->reset_line(self->bus->context, false);
            enter(self, STEP_BOOT, now);
        }
        return;
    case STEP_BOOT:
        if (passed < START_US) {
            return;
        }
        if (!read_surely(self, PRODUCT_ID, &value) || value != PRODUCT) {
            fail(self, ADIS16405_ABSENT, now);
        } else if (!write_register(self, SMPL_PRD, self->sample_period) ||
                   !write_register(self, SENS_AVG, self->filter) || !write_register(self, ALM_CTRL, 0U) ||
                   !write_register(self, MSC_CTRL, MSC_CTRL_READY) || !restore_offsets(self)) {
            fail(self, ADIS16405_SET_UP, now);
        } else if (!diagnose(self, &value) || !write_byte(self, MSC_CTRL + 1U, MSC_CTRL_SELF_TEST_HIGH)) {
            fail(self, ADIS16405_SELF_TEST, now);
        } else {
            enter(self, STEP_SELF_TEST, self->bus->time_us(self->bus->context)); /* the set-up took 20 ms if slow */
        }
        return;
    default: break;
    }
    if (!read_surely(self, MSC_CTRL, &value) || value != MSC_CTRL_READY) {
        if (passed >= SELF_TEST_US) {
            fail(self, ADIS16405_SELF_TEST, now);
        }
        return;
    }
    if (!diagnose(self, &value) || (value & DIAG_SELF_TEST) != 0U) {
        fail(self, ADIS16405_SELF_TEST, now);
        return;
    }
    if ((value & DIAG_FATAL) != 0U) {
        fail(self, ADIS16405_STATUS, now);
        return;
    }
    settings_t found = UNSURE;
    for (int i = 0; i < CHECKS_TRIED && found == UNSURE; i++) {
        found = settings(self);
    }
    if (found != GOOD) { /* reset by something else in between */
        fail(self, ADIS16405_SET_UP, now);
        return;
    }
    self->state = ADIS16405_RUNNING;
    expect(self, now);
    self->seen_us = now;
    self->checked_us = now;
    self->off_rate = OFF_RATE_TAKEN;
    self->doubtful = false;
    self->equal = 0;
    self->unproven = CHANGES_ASKED;
    self->anchored = false;
    self->unsure = 0;
    self->settling = 0;
    self->excuses = 0;
    listen(self);
}

/* Looks after the settings; false: they have been altered, and the sensor is set up anew. */
static bool look_after(adis16405_t *self, uint64_t now)
{
    hold(self);
    const settings_t found = settings(self);
    listen(self);
    self->checked_us = now;
    self->doubtful = self->doubtful && found != GOOD;
    if (found == ALTERED) {
        fail(self, ADIS16405_SET_UP, now);
    }
    return found != ALTERED;
}

static void watch(adis16405_t *self, uint64_t now)
{
    const uint64_t unchecked = now - self->checked_us;
    const uint32_t period = self->nominal_q8 >> 8;
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
            fail(self, ADIS16405_STATUS, now);
            return;
        }
        if (read && (bits & DIAG_OVER_RANGE) != 0U && self->excuses < EXCUSES) {
            self->excuses++; /* the samples are refused, the sensor is well */
            expect(self, now);
        }
    }
    const uint64_t silence = SILENCE_US > 10U * period ? SILENCE_US : 10U * period;
    if (now - self->progress_us > silence && self->head == self->tail) {
        /* One data-ready may come from plugging; a sensor gives one a period. */
        fail(self, self->ready_count - self->ready_seen < 3U ? ADIS16405_SILENT : ADIS16405_NO_DATA, now);
    } else if (self->equal >= REPEATS_STUCK) {
        fail(self, ADIS16405_STUCK, now);
    }
}

void adis16405_poll(adis16405_t *self)
{
    const uint64_t now = self->bus->time_us(self->bus->context);
    switch (self->state) {
    case ADIS16405_STARTING: start_on(self, now); break;
    case ADIS16405_RUNNING: watch(self, now); break;
    default:
        if (now - self->step_us >= self->backoff_us) {
            begin(self, now);
        }
        break;
    }
}

/* XGYRO_OUT less its sign bit, judged by what went before. */
static bool sign_lost(adis16405_t *self, int16_t x)
{
    if (self->anchored) {
        return x - self->last[0] >= SIGN_STEP;
    }
    if (x > SIGN_BEYOND) {
        self->unsure = 0;
        return true;
    }
    const bool alike = self->unsure > 0U && x - self->last[0] < SIGN_STEP && self->last[0] - x < SIGN_STEP;
    self->unsure = x >= SIGN_UNSURE ? (uint8_t)(alike ? self->unsure + 1U : 1U) : 0U;
    self->last[0] = x;
    return self->unsure > 0U && self->unsure < SIGN_ALIKE;
}

/* Periods since the last sample, and the period itself tracked over samples that follow each other. */
static uint32_t periods(adis16405_t *self, uint64_t stamp)
{
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
static bool off_grid(uint64_t step, uint64_t period)
{
    const uint64_t right = 2U * step < 3U * period ? period : 2U * period;
    return 8U * (step < right ? right - step : step - right) >= period;
}

bool adis16405_sample(adis16405_t *self, float reading[ADIS16405_AXES], uint32_t *missing)
{
    while (self->tail != self->head) {
        const uint32_t tail = self->tail;
        int16_t raw[ADIS16405_AXES];
        const uint64_t now = self->bus->time_us(self->bus->context);
        const uint64_t stamp = now - (uint32_t)((uint32_t)now - self->queue[tail % ADIS16405_QUEUE].stamp);
        for (size_t i = 0; i < ADIS16405_AXES; i++) {
            raw[i] = self->queue[tail % ADIS16405_QUEUE].raw[i];
        }
        self->tail = tail + 1U;
        if (self->state != ADIS16405_RUNNING) {
            continue;
        }
        const uint64_t step = stamp - self->seen_us, period = self->nominal_q8 >> 8, doubt = period + period / 2U;
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
            self->counters.anomalies++;
            continue;
        }
        self->equal = memcmp(raw, self->last, sizeof raw) == 0 ? self->equal + 1U : 0U;
        memcpy(self->last, raw, sizeof raw);
        self->anchored = true;
        self->anchored_us = stamp;
        if (self->equal == 0U && self->unproven > 0U) {
            self->unproven--;
        }
        if (self->unproven > 0U || self->equal > REPEATS_TAKEN) {
            self->counters.repeated += self->equal > 0U ? 1U : 0U;
            continue;
        }
        const uint32_t passed = self->counters.samples > 0U ? periods(self, stamp) : 1U;
        *missing = passed > 0U ? passed - 1U : 0U;
        self->last_us = stamp;
        expect(self, now);
        self->excuses = 0;
        self->good++;
        self->counters.samples++;
        for (size_t i = 0; i < ADIS16405_AXES; i++) {
            reading[i] = (float)raw[i] * self->scale[i];
        }
        return true;
    }
    return false;
}
