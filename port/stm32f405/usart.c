/* Telemetry as SLCAN on USART1: TX PB6, RX PB7, 8N1. RM0090 chapter 30. */
#include "board.h"
#include "slcan.h"
#include "stm32f405.h"

#include <string.h>

enum { OUT_BYTES = 2048, IN_BYTES = 256 }; /* powers of two */

static slcan_t slcan;
static volatile uint8_t out[OUT_BYTES], in[IN_BYTES];
static volatile uint32_t out_head, out_tail, in_head, in_tail; /* count up for ever; the handler moves out_tail and in_head */
static volatile uint32_t lost_in;
static uint32_t dropped;

void usart_init(uint32_t baud)
{
    slcan_init(&slcan);
    RCC_AHB1ENR |= RCC_AHB1ENR_GPIOB;
    RCC_APB2ENR |= RCC_APB2ENR_USART1;
    (void)RCC_APB2ENR;
    GPIO_AFR(GPIOB, 6U) = (GPIO_AFR(GPIOB, 6U) & ~0xFF000000U) | 0x77000000U;
    GPIO_MODER(GPIOB) = (GPIO_MODER(GPIOB) & ~(0xFU << 12)) | 0xAU << 12;
    GPIO_PUPDR(GPIOB) = (GPIO_PUPDR(GPIOB) & ~(0x3U << 14)) | 0x1U << 14; /* an open line is idle */
    USART1_BRR = (board_clock.pclk2_hz + baud / 2U) / baud; /* section 30.3.4, oversampling by 16 */
    USART1_CR1 = USART_CR1_UE | USART_CR1_TE | USART_CR1_RE | USART_CR1_RXNEIE;
    irq_enable(IRQ_USART1);
}

static bool put(const char *bytes, uint32_t count)
{
    if (OUT_BYTES - (out_head - out_tail) < count) {
        return false;
    }
    for (uint32_t i = 0; i < count; i++) {
        out[(out_head + i) % OUT_BYTES] = (uint8_t)bytes[i];
    }
    out_head += count;
    irq_off();
    USART1_CR1 |= USART_CR1_TXEIE;
    irq_on();
    return true;
}

bool usart_send(const selfcal_frame_t *frame)
{
    if (!slcan.open) {
        dropped++;
        return true;
    }
    char line[SLCAN_FRAME_BYTES];
    slcan_encode(frame, line);
    return put(line, sizeof line);
}

void usart_poll(void)
{
    while (in_tail != in_head) {
        char answer[SLCAN_ANSWER_BYTES];
        const size_t count = slcan_receive(&slcan, in[in_tail % IN_BYTES], answer);
        in_tail++;
        (void)put(answer, (uint32_t)count); /* an answer that finds no room is left out */
#ifdef APP_COMMAND_KEY
        if (slcan.came) {
            slcan.came = false;
            module_command(slcan.data);
        }
#endif
    }
}

bool usart_sent(void)
{
    return out_tail == out_head && (USART1_SR & USART_SR_TC) != 0U;
}

void usart_counters(wire_counters_t *counters)
{
    counters->dropped = dropped;
    counters->bus_offs = lost_in;
}

void usart_handler(void)
{
    const uint32_t status = USART1_SR;
    if ((status & (USART_SR_RXNE | USART_SR_ORE)) != 0U) {
        const uint8_t byte = (uint8_t)USART1_DR; /* clears them all, section 30.6.1 */
        const bool room = in_head - in_tail < IN_BYTES, sound = (status & (USART_SR_FE | USART_SR_NF)) == 0U;
        if ((status & USART_SR_ORE) != 0U || !sound || !room) {
            lost_in++;
        }
        if ((status & USART_SR_RXNE) != 0U && sound && room) {
            in[in_head % IN_BYTES] = byte;
            in_head++;
        }
    }
    if ((status & USART_SR_TXE) != 0U && (USART1_CR1 & USART_CR1_TXEIE) != 0U) {
        if (out_tail == out_head) {
            USART1_CR1 &= ~USART_CR1_TXEIE;
        } else {
            USART1_DR = out[out_tail % OUT_BYTES];
            out_tail++;
        }
    }
}
