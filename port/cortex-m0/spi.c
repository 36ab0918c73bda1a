/* The sensor on SPI0. exchange() is polled; begin() goes byte by byte from the interrupt: this SPI has no DMA, and TXD
 * holds one byte in waiting. */
#include "board.h"
#include "nrf51.h"
#include "readings.h"

#define SCK_LEAST_HZ 125000U
enum { SCK_DOUBLINGS = 6 };
enum { BYTE_US = 100 }; /* a byte takes 64 at most */

static const uint8_t *going_out;
static uint8_t *coming_in;
static volatile uint16_t to_go, sent, received;
static uint8_t stall_us;
static bool second; /* of two chips */

static void pull(uint32_t pin, bool low) {
    if (low) {
        GPIO_OUTCLR = BIT(pin);
    } else {
        GPIO_OUTSET = BIT(pin);
    }
}

static void select_sensor(bool on) {
    pull(second ? PIN_RESET : PIN_CS, on);
}

static void let_go(void) {
    select_sensor(false);
    clock_spin_us(stall_us);
}

static void reset_line(bool low) {
    pull(PIN_RESET, low);
}

static void open(const sensor_wire_t *wire) {
    stall_us = (uint8_t)wire->stall_us;
    uint32_t doublings = 0;
    while (doublings < SCK_DOUBLINGS && SCK_LEAST_HZ << (doublings + 1U) <= wire->sck_max_hz) {
        doublings++;
    }
    select_sensor(false);
    reset_line(false);
    if (wire->mode >= 2U) {
        GPIO_OUTSET = BIT(PIN_SCK); /* as it idles */
    }
    GPIO_PIN_CNF(PIN_CS) = GPIO_OUTPUT;
    GPIO_PIN_CNF(PIN_RESET) = GPIO_OUTPUT;
    GPIO_PIN_CNF(PIN_SCK) = GPIO_OUTPUT;
    GPIO_PIN_CNF(PIN_MOSI) = GPIO_OUTPUT;
    GPIO_PIN_CNF(PIN_MISO) = GPIO_INPUT;
    GPIO_PIN_CNF(PIN_READY) = GPIO_INPUT | GPIO_PULL_DOWN; /* a missing sensor gives no edges */
    SPI0_PSELSCK = PIN_SCK;
    SPI0_PSELMOSI = PIN_MOSI;
    SPI0_PSELMISO = PIN_MISO;
    SPI0_FREQUENCY = SPI0_FREQUENCY_K125 << doublings;
    SPI0_CONFIG = SPI0_CONFIG_MODE(wire->mode);
    SPI0_ENABLE = 1U;
    GPIOTE_CONFIG0 = GPIOTE_RISING(PIN_READY);
    GPIOTE_IN0 = 0U;
    GPIOTE_INTENSET = BIT(0);
    irq_enable(IRQ_GPIOTE);
    irq_enable(IRQ_SPI0);
}

static bool exchange_byte(uint8_t out, uint8_t *in) {
    SPI0_READY = 0U;
    SPI0_TXD = out;
    const uint32_t start = clock_us32();
    bool late = false; /* by the time before READY is looked at: an interrupt in between is no failure */
    while (SPI0_READY == 0U) {
        if (late) {
            return false;
        }
        late = clock_us32() - start > BYTE_US;
    }
    *in = (uint8_t)SPI0_RXD;
    return true;
}

/* Breaks off a transfer under way. */
static void stop_transfer(void) {
    SPI0_INTENCLR = SPI0_INTEN_READY;
    select_sensor(false);
    SPI0_ENABLE = 0U; /* forgets the byte in waiting */
    SPI0_READY = 0U;
    SPI0_ENABLE = 1U;
}

static bool exchange(const uint8_t *out, uint8_t *in, size_t count) {
    stop_transfer();
    select_sensor(true);
    bool done = true;
    for (size_t i = 0; i < count && done; i++) {
        done = exchange_byte(out[i], &in[i]);
    }
    let_go();
    return done;
}

static void send_next(void) {
    if (sent < to_go) {
        SPI0_TXD = going_out[sent];
        sent++;
    }
}

static bool begin(const uint8_t *out, uint8_t *in, size_t count) {
    stop_transfer();
    going_out = out;
    coming_in = in;
    to_go = (uint16_t)count;
    sent = received = 0;
    select_sensor(true);
    SPI0_INTENSET = SPI0_INTEN_READY;
    send_next();
    send_next();
    return true;
}

static void choose(uint8_t chip) {
    second = chip != 0U;
}

const sensor_bus_t spi_bus = {clock_us, clock_us32, open, exchange, begin, reset_line, choose, NULL};

void spi_handler(void) {
    if (SPI0_READY == 0U) {
        return; /* still pending from a transfer that stop_transfer() broke off */
    }
    SPI0_READY = 0U; /* before RXD is read: that lets the next byte in */
    const uint8_t byte = (uint8_t)SPI0_RXD;
    send_next();
    coming_in[received] = byte;
    received++;
    if (received == to_go) {
        SPI0_INTENCLR = SPI0_INTEN_READY;
        let_go();
        readings_done(true);
    }
}

void ready_handler(void) {
    GPIOTE_IN0 = 0U;
    readings_ready();
}
