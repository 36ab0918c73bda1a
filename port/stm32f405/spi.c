/* The sensor on SPI1: SCK PA5, MISO PA6, MOSI PA7, chip select PA4 (by hand), data-ready PB0, reset PB1, which is the
 * second chip's select of a part of two. exchange() is polled; begin() goes by DMA2 (RM0090 table 44: stream 0 channel
 * 3 receives, stream 3 channel 3 sends). */
#include "board.h"
#include "readings.h"
#include "stm32f405.h"

enum { CS_PIN = 4, READY_PIN = 0, RESET_PIN_NUMBER = 1 };
enum { RX_STREAM = 0, TX_STREAM = 3, CHANNEL = 3 };

static uint32_t stall_us;
static bool second; /* of two chips */

static void reset_line(bool low) {
    GPIO_BSRR(GPIOB) = low ? BIT(RESET_PIN_NUMBER + 16) : BIT(RESET_PIN_NUMBER);
}

static void select_sensor(bool on) {
    if (second) {
        reset_line(on);
    } else {
        GPIO_BSRR(GPIOA) = on ? BIT(CS_PIN + 16) : BIT(CS_PIN);
    }
}

static void let_go(void) {
    select_sensor(false);
    clock_spin_us(stall_us);
}

static void open(const sensor_wire_t *wire) {
    RCC_AHB1ENR |= RCC_AHB1ENR_GPIOA | RCC_AHB1ENR_GPIOB | RCC_AHB1ENR_DMA2;
    RCC_APB2ENR |= RCC_APB2ENR_SPI1 | RCC_APB2ENR_SYSCFG;
    (void)RCC_APB2ENR;

    stall_us = wire->stall_us;
    select_sensor(false);
    reset_line(false);
    /* PA5 to PA7 alternate function 5; PA4 and PB1 outputs; PB0 an input, pulled down: a missing sensor gives no
     * edges. */
    GPIO_AFR(GPIOA, 5U) = (GPIO_AFR(GPIOA, 5U) & ~0xFFF00000U) | 0x55500000U;
    GPIO_MODER(GPIOA) = (GPIO_MODER(GPIOA) & ~(0xFFU << 8)) | 0xA9U << 8;
    GPIO_OSPEEDR(GPIOA) |= 0x55U << 8;
    GPIO_MODER(GPIOB) = (GPIO_MODER(GPIOB) & ~0xFU) | 0x4U;
    GPIO_PUPDR(GPIOB) = (GPIO_PUPDR(GPIOB) & ~0x3U) | 0x2U;

    uint32_t rate = 0; /* PCLK2 / 2^(rate + 1) */
    while (rate < 7U && board_clock.pclk2_hz >> (rate + 1U) > wire->sck_max_hz) {
        rate++;
    }
    const uint32_t mode = ((wire->mode & 1U) != 0U ? SPI_CR1_CPHA : 0U) | ((wire->mode & 2U) != 0U ? SPI_CR1_CPOL : 0U);
    SPI1_CR1 = mode | SPI_CR1_MSTR | rate << SPI_CR1_BR_POS | SPI_CR1_SSI | SPI_CR1_SSM;
    SPI1_CR1 |= SPI_CR1_SPE;

    SYSCFG_EXTICR1 = (SYSCFG_EXTICR1 & ~0xFU) | 1U; /* EXTI0 is PB0 */
    EXTI_RTSR |= BIT(READY_PIN);
    EXTI_PR = BIT(READY_PIN);
    EXTI_IMR |= BIT(READY_PIN);
    /* Both may wait for a slow sensor, 180 us. Two bytes come in that time on a line of 115200 baud: the USART cannot
     * wait as long. */
    irq_give_way(IRQ_EXTI0);
    irq_give_way(IRQ_DMA2_STREAM0);
    irq_enable(IRQ_EXTI0);
    irq_enable(IRQ_DMA2_STREAM0);
}

/* A byte takes 12 us at 656 kHz, 49 us at 164 kHz. */
static bool await_status(uint32_t mask, uint32_t value) {
    const uint32_t start = clock_us32();
    while ((SPI1_SR & mask) != value) {
        if (clock_us32() - start > 200U) {
            return false;
        }
    }
    return true;
}

static void stop_dma(void) {
    SPI1_CR2 = 0U;
    DMA_SCR(RX_STREAM) = 0U;
    DMA_SCR(TX_STREAM) = 0U;
    for (uint32_t turn = 0; turn < 100U && ((DMA_SCR(RX_STREAM) | DMA_SCR(TX_STREAM)) & DMA_SCR_EN) != 0U; turn++) {
    } /* section 10.3.17: a stream ends its transfer under way first */
    DMA_LIFCR = DMA_LISR_STREAM0 | DMA_LISR_STREAM3;
}

static bool exchange(const uint8_t *out, uint8_t *in, size_t count) {
    if (((DMA_SCR(RX_STREAM) | DMA_SCR(TX_STREAM)) & DMA_SCR_EN) != 0U) { /* one that never ended */
        stop_dma();
        let_go();
    }
    SPI1_CR2 = 0U;
    (void)SPI1_DR;
    select_sensor(true);
    bool done = true;
    for (size_t i = 0; i < count && done; i++) {
        SPI1_DR = out[i];
        done = await_status(SPI_SR_RXNE, SPI_SR_RXNE);
        in[i] = (uint8_t)SPI1_DR;
    }
    done = await_status(SPI_SR_BSY, 0U) && done;
    let_go();
    return done;
}

static bool begin(const uint8_t *out, uint8_t *in, size_t count) /* NOLINT(readability-non-const-parameter): DMA */
{
    stop_dma();
    select_sensor(false); /* one that never ended is broken off */
    (void)SPI1_DR;
    DMA_SPAR(RX_STREAM) = SPI1_DR_ADDRESS;
    DMA_SM0AR(RX_STREAM) = (uint32_t)(uintptr_t)in;
    DMA_SNDTR(RX_STREAM) = count;
    DMA_SPAR(TX_STREAM) = SPI1_DR_ADDRESS;
    DMA_SM0AR(TX_STREAM) = (uint32_t)(uintptr_t)out;
    DMA_SNDTR(TX_STREAM) = count;
    const uint32_t common = (uint32_t)CHANNEL << DMA_SCR_CHSEL_POS | DMA_SCR_PL_HIGH | DMA_SCR_MINC;
    select_sensor(true);
    SPI1_CR2 = SPI_CR2_RXDMAEN; /* order of section 28.3.9 */
    DMA_SCR(RX_STREAM) = common | DMA_SCR_TCIE | DMA_SCR_TEIE | DMA_SCR_EN;
    DMA_SCR(TX_STREAM) = common | DMA_SCR_TO_PERIPHERAL | DMA_SCR_EN;
    SPI1_CR2 = SPI_CR2_RXDMAEN | SPI_CR2_TXDMAEN;
    return true;
}

static void choose(uint8_t chip) {
    second = chip != 0U;
}

const sensor_bus_t spi_bus = {clock_us, clock_us32, open, exchange, begin, reset_line, choose, NULL};

void sensor_ready_handler(void) {
    EXTI_PR = BIT(READY_PIN);
    readings_ready();
}

void sensor_done_handler(void) {
    const uint32_t flags = DMA_LISR;
    const bool whole = (flags & DMA_LISR_TCIF0) != 0U && (flags & DMA_LISR_TEIF0) == 0U && await_status(SPI_SR_BSY, 0U);
    stop_dma();
    let_go();
    readings_done(whole);
}
