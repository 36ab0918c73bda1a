/* The sensor on I2C: SCL on SCK's pin, SDA on MOSI's, where a part that has both wires has them for SPI. By hand:
 * clock stretching and a stuck line need no more than two pins. Pull-ups of 2.2 to 4.7 kOhm. */
#include "i2c_master.h"
#include "board.h"
#include "nrf51.h"

static uint32_t pin_of(i2c_line_t line) {
    return line == I2C_SCL ? (uint32_t)PIN_SCK : (uint32_t)PIN_MOSI;
}

static void set(i2c_line_t line, bool released) {
    if (released) {
        GPIO_OUTSET = BIT(pin_of(line));
    } else {
        GPIO_OUTCLR = BIT(pin_of(line));
    }
}

static bool level(i2c_line_t line) {
    return (GPIO_IN & BIT(pin_of(line))) != 0U;
}

static void half(void) {
    clock_spin_us(1U);
}

static const i2c_lines_t lines = {set, level, half, clock_us32};

static void open(const sensor_wire_t *wire) {
    (void)wire;
    set(I2C_SCL, true);
    set(I2C_SDA, true);
    GPIO_PIN_CNF(PIN_SCK) = GPIO_OPEN_DRAIN;
    GPIO_PIN_CNF(PIN_MOSI) = GPIO_OPEN_DRAIN;
}

static bool transfer(uint8_t address, const uint8_t *out, size_t written, uint8_t *in, size_t wanted) {
    return i2c_transfer(&lines, address, out, written, in, wanted);
}

const sensor_bus_t i2c_bus = {clock_us, clock_us32, open, NULL, NULL, NULL, NULL, transfer};
