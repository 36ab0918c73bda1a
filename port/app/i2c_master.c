#include "i2c_master.h"

#define STRETCH_US 2000U
enum { CLOCKS_TO_FREE = 9 };

/* Lets the clock go up; false: the device holds it for too long. */
static bool clock_up(const i2c_lines_t *lines) {
    lines->set(I2C_SCL, true);
    const uint32_t start = lines->time_us32();
    bool late = false; /* by the time before the line is looked at: an interrupt in between is no failure */
    while (!lines->level(I2C_SCL)) {
        if (late) {
            return false;
        }
        late = lines->time_us32() - start > STRETCH_US;
    }
    lines->half();
    return true;
}

static void clock_down(const i2c_lines_t *lines) {
    lines->set(I2C_SCL, false);
    lines->half();
}

static bool put_bit(const i2c_lines_t *lines, bool bit) {
    lines->set(I2C_SDA, bit);
    lines->half();
    const bool done = clock_up(lines);
    clock_down(lines);
    return done;
}

static bool get_bit(const i2c_lines_t *lines, bool *bit) {
    lines->set(I2C_SDA, true);
    lines->half();
    const bool done = clock_up(lines);
    *bit = lines->level(I2C_SDA);
    clock_down(lines);
    return done;
}

static bool stop(const i2c_lines_t *lines) {
    lines->set(I2C_SDA, false);
    lines->half();
    const bool done = clock_up(lines);
    lines->set(I2C_SDA, true);
    lines->half();
    return done && lines->level(I2C_SDA);
}

/* True: both lines are high. A device that holds the data line gets clocks until it lets go (UM10204, 3.1.16). */
static bool free_bus(const i2c_lines_t *lines) {
    lines->set(I2C_SDA, true);
    if (!clock_up(lines)) {
        return false;
    }
    for (unsigned i = 0; i < CLOCKS_TO_FREE && !lines->level(I2C_SDA); i++) {
        clock_down(lines);
        if (!clock_up(lines)) {
            return false;
        }
        if (lines->level(I2C_SDA)) {
            clock_down(lines);
            return stop(lines);
        }
    }
    return lines->level(I2C_SDA);
}

/* From a clock that is high, or low for a repeated start. */
static bool start(const i2c_lines_t *lines) {
    lines->set(I2C_SDA, true);
    lines->half();
    if (!clock_up(lines) || !lines->level(I2C_SDA)) {
        return false;
    }
    lines->set(I2C_SDA, false);
    lines->half();
    clock_down(lines);
    return true;
}

/* True: acknowledged. */
static bool put_byte(const i2c_lines_t *lines, uint8_t byte) {
    bool done = true, refused = true;
    for (unsigned bit = 0; bit < 8U && done; bit++) {
        done = put_bit(lines, ((unsigned)byte << bit & 0x80U) != 0U);
    }
    return done && get_bit(lines, &refused) && !refused;
}

static bool get_byte(const i2c_lines_t *lines, uint8_t *byte, bool more) {
    unsigned value = 0;
    for (unsigned i = 0; i < 8U; i++) {
        bool bit;
        if (!get_bit(lines, &bit)) {
            return false;
        }
        value = value << 1 | (bit ? 1U : 0U);
    }
    *byte = (uint8_t)value;
    return put_bit(lines, !more);
}

bool i2c_transfer(const i2c_lines_t *lines, uint8_t address, const uint8_t *out, size_t written, uint8_t *in,
                  size_t wanted) {
    if (!free_bus(lines)) {
        return false;
    }
    const unsigned to_write = (unsigned)address << 1;
    bool done = true;
    if (written > 0U || wanted == 0U) {
        done = start(lines) && put_byte(lines, (uint8_t)to_write);
    }
    for (size_t i = 0; i < written && done; i++) {
        done = put_byte(lines, out[i]);
    }
    if (wanted > 0U && done) {
        done = start(lines) && put_byte(lines, (uint8_t)(to_write | 1U));
    }
    for (size_t i = 0; i < wanted && done; i++) {
        done = get_byte(lines, &in[i], i + 1U < wanted);
    }
    return stop(lines) && done;
}
