/* ADIS16405 on SPI0, mode 3, 1 MHz, or 250 kHz in the sensor's slow mode. Registers one frame at a time and polled;
 * bursts byte by byte from the interrupt: this SPI has no DMA, and TXD holds one byte in waiting. */
#include "board.h"
#include "sensor.h"
#include "nrf51.h"

enum { BURST_WORDS = 12, BURST_BYTES = 2 + 2 * BURST_WORDS, BURST_COMMAND = 0x3E };
enum { BYTE_US = 100 }; /* a byte takes 8, or 32 */

static volatile uint32_t sent, received;
static volatile uint8_t burst[BURST_BYTES];

static void select_sensor(bool on)
{
    if (on) {
        GPIO_OUTCLR = BIT(PIN_CS);
    } else {
        GPIO_OUTSET = BIT(PIN_CS);
    }
}

void spi_reset_line(void *context, bool low)
{
    (void)context;
    if (low) {
        GPIO_OUTCLR = BIT(PIN_RESET);
    } else {
        GPIO_OUTSET = BIT(PIN_RESET);
    }
}

void spi_init(void)
{
    select_sensor(false);
    spi_reset_line(NULL, false);
    GPIO_OUTSET = BIT(PIN_SCK); /* idle in mode 3 */
    GPIO_PIN_CNF(PIN_CS) = GPIO_OUTPUT;
    GPIO_PIN_CNF(PIN_RESET) = GPIO_OUTPUT;
    GPIO_PIN_CNF(PIN_SCK) = GPIO_OUTPUT;
    GPIO_PIN_CNF(PIN_MOSI) = GPIO_OUTPUT;
    GPIO_PIN_CNF(PIN_MISO) = GPIO_INPUT;
    GPIO_PIN_CNF(PIN_READY) = GPIO_INPUT | GPIO_PULL_DOWN; /* a missing sensor gives no edges */
    SPI0_PSELSCK = PIN_SCK;
    SPI0_PSELMOSI = PIN_MOSI;
    SPI0_PSELMISO = PIN_MISO;
    SPI0_FREQUENCY = SENSOR_SCK_MAX_HZ < 1000000U ? SPI0_FREQUENCY_K250 : SPI0_FREQUENCY_M1;
    SPI0_CONFIG = SPI0_CONFIG_MODE3;
    SPI0_ENABLE = 1U;
    GPIOTE_CONFIG0 = GPIOTE_RISING(PIN_READY);
    GPIOTE_IN0 = 0U;
    GPIOTE_INTENSET = BIT(0);
    irq_enable(IRQ_GPIOTE);
    irq_enable(IRQ_SPI0);
}

static bool exchange(uint8_t out, uint8_t *in)
{
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

/* Breaks off a burst under way. */
static void stop_burst(void)
{
    SPI0_INTENCLR = SPI0_INTEN_READY;
    select_sensor(false);
    SPI0_ENABLE = 0U; /* forgets the byte in waiting */
    SPI0_READY = 0U;
    SPI0_ENABLE = 1U;
}

bool spi_word(void *context, uint16_t out, uint16_t *in)
{
    (void)context;
    stop_burst();
    uint8_t high = 0, low = 0;
    select_sensor(true);
    const bool done = exchange((uint8_t)(out >> 8), &high) && exchange((uint8_t)out, &low);
    select_sensor(false);
    clock_spin_us(SENSOR_STALL_US);
    *in = (uint16_t)((uint32_t)high << 8 | low);
    return done;
}

bool spi_burst(void *context)
{
    (void)context;
    stop_burst();
    sent = 2;
    received = 0;
    select_sensor(true);
    SPI0_INTENSET = SPI0_INTEN_READY;
    SPI0_TXD = BURST_COMMAND;
    SPI0_TXD = 0U;
    return true;
}

void spi_handler(void)
{
    if (SPI0_READY == 0U) {
        return; /* still pending from a burst that stop_burst() broke off */
    }
    SPI0_READY = 0U; /* before RXD is read: that lets the next byte in */
    const uint8_t byte = (uint8_t)SPI0_RXD;
    if (sent < BURST_BYTES) {
        SPI0_TXD = 0U;
        sent++;
    }
    burst[received] = byte;
    received++;
    if (received == BURST_BYTES) {
        SPI0_INTENCLR = SPI0_INTEN_READY;
        select_sensor(false);
        clock_spin_us(SENSOR_STALL_US);
        uint16_t words[BURST_WORDS];
        for (size_t i = 0; i < BURST_WORDS; i++) {
            words[i] = (uint16_t)((uint32_t)burst[2U * i + 2U] << 8 | burst[2U * i + 3U]);
        }
        sensor_burst(words, true);
    }
}

void ready_handler(void)
{
    GPIOTE_IN0 = 0U;
    sensor_ready();
}
