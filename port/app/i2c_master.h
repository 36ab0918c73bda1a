/* An I2C master by two lines that a board pulls low and reads (UM10204). It waits for a sensor that stretches the
 * clock, and frees one that holds the data line: after a reset in the middle of a byte that one waits for the rest of
 * its clocks. */
#ifndef I2C_MASTER_H
#define I2C_MASTER_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

typedef enum { I2C_SCL, I2C_SDA } i2c_line_t;

typedef struct {
    void (*set)(i2c_line_t line, bool released); /* open drain: false pulls it low */
    bool (*level)(i2c_line_t line);
    void (*half)(void); /* half a bit: 1.3 us or more */
    uint32_t (*time_us32)(void);
} i2c_lines_t;

/* Write `written` bytes to the device of 7 bits `address`, then read `wanted` bytes after a repeated start; either may
 * be 0. False: the address or a byte was not acknowledged, the clock was stretched for more than 2 ms, or a line stays
 * low after nine clocks. The bus is free afterwards if it can be. */
bool i2c_transfer(const i2c_lines_t *lines, uint8_t address, const uint8_t *out, size_t written, uint8_t *in,
                  size_t wanted);

#endif
