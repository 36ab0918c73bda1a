/* Telemetry as SLCAN on USART1: TX PB6, RX PB7, 8N1. RM0090 chapter 30. */
#include "board.h"
#include "slcan_line.h"
#include "stm32f405.h"

static volatile uint8_t out[2048], in[256];
static slcan_line_t line = SLCAN_LINE(out, in);

void usart_init(uint32_t baud) {
    RCC_AHB1ENR |= RCC_AHB1ENR_GPIOB;
    RCC_APB2ENR |= RCC_APB2ENR_USART1;
    (void)RCC_APB2ENR;
    GPIO_AFR(GPIOB, 6U) = (GPIO_AFR(GPIOB, 6U) & ~0xFF000000U) | 0x77000000U;
    GPIO_MODER(GPIOB) = (GPIO_MODER(GPIOB) & ~(0xFU << 12)) | 0xAU << 12;
    GPIO_PUPDR(GPIOB) = (GPIO_PUPDR(GPIOB) & ~(0x3U << 14)) | 0x1U << 14; /* an open line is idle */
    USART1_BRR = (board_clock.pclk2_hz + baud / 2U) / baud;               /* section 30.3.4, oversampling by 16 */
    USART1_CR1 = USART_CR1_UE | USART_CR1_TE | USART_CR1_RE | USART_CR1_RXNEIE;
    irq_enable(IRQ_USART1);
}

static void start(void) {
    if (!slcan_line_empty(&line)) {
        irq_off();
        USART1_CR1 |= USART_CR1_TXEIE;
        irq_on();
    }
}

bool usart_send(const selfcal_frame_t *frame) {
    const bool taken = slcan_line_send(&line, frame);
    start();
    return taken;
}

void usart_poll(void) {
    while (slcan_line_poll(&line)) {
#ifdef APP_COMMAND_KEY
        module_command(line.slcan.data);
#endif
    }
    start();
}

bool usart_sent(void) {
    return slcan_line_empty(&line) && (USART1_SR & USART_SR_TC) != 0U;
}

void usart_counters(wire_counters_t *counters) {
    counters->dropped = line.dropped;
    counters->bus_offs = line.lost;
}

void usart_handler(void) {
    const uint32_t status = USART1_SR;
    if ((status & (USART_SR_RXNE | USART_SR_ORE)) != 0U) {
        const uint8_t byte = (uint8_t)USART1_DR; /* clears them all, section 30.6.1 */
        const bool sound = (status & (USART_SR_FE | USART_SR_NF)) == 0U;
        if ((status & USART_SR_RXNE) != 0U && sound) {
            slcan_line_received(&line, byte);
        }
        if ((status & USART_SR_ORE) != 0U || !sound) {
            line.lost++;
        }
    }
    if ((status & USART_SR_TXE) != 0U && (USART1_CR1 & USART_CR1_TXEIE) != 0U) {
        uint8_t byte;
        if (slcan_line_next(&line, &byte)) {
            USART1_DR = byte;
        } else {
            USART1_CR1 &= ~USART_CR1_TXEIE;
        }
    }
}
