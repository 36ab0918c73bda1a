/* The sensor on I2C: SCL PA5, SDA PA7, where a part that has both wires has them for SPI. By hand: clock stretching and
 * a stuck line need no more than two pins. Pull-ups of 2.2 to 4.7 kOhm; those inside the part hold an open line. */
#include "i2c_master.h"
#include "board.h"
#include "stm32f405.h"

enum { SCL_PIN = 5, SDA_PIN = 7 };

static uint32_t pin_of(i2c_line_t line) {
    return line == I2C_SCL ? (uint32_t)SCL_PIN : (uint32_t)SDA_PIN;
}

static void set(i2c_line_t line, bool released) {
    GPIO_BSRR(GPIOA) = BIT(pin_of(line) + (released ? 0U : 16U));
}

static bool level(i2c_line_t line) {
    return (GPIO_IDR(GPIOA) & BIT(pin_of(line))) != 0U;
}

static void half(void) {
    clock_spin_us(1U);
}

static const i2c_lines_t lines = {set, level, half, clock_us32};

static void open(const sensor_wire_t *wire) {
    (void)wire;
    RCC_AHB1ENR |= RCC_AHB1ENR_GPIOA;
    (void)RCC_AHB1ENR;
    set(I2C_SCL, true);
    set(I2C_SDA, true);
    GPIO_OTYPER(GPIOA) |= BIT(SCL_PIN) | BIT(SDA_PIN);
    GPIO_PUPDR(GPIOA) = (GPIO_PUPDR(GPIOA) & ~0xCC00U) | 0x4400U;
    GPIO_MODER(GPIOA) = (GPIO_MODER(GPIOA) & ~0xCC00U) | 0x4400U;
}

static bool transfer(uint8_t address, const uint8_t *out, size_t written, uint8_t *in, size_t wanted) {
    return i2c_transfer(&lines, address, out, written, in, wanted);
}

const sensor_bus_t i2c_bus = {clock_us, clock_us32, open, NULL, NULL, NULL, NULL, transfer};
