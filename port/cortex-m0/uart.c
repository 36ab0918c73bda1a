/* Telemetry as SLCAN on UART0. */
#include "board.h"
#include "nrf51.h"
#include "slcan.h"

enum { OUT_BYTES = 256, IN_BYTES = 64 }; /* powers of two */

static slcan_t slcan;
static volatile uint8_t out[OUT_BYTES], in[IN_BYTES];
static volatile uint32_t out_head, out_tail, in_head, in_tail; /* count up for ever; the handler moves out_tail and in_head */
static volatile bool sending;
static volatile uint32_t lost_in;
static uint32_t dropped;

void uart_init(void)
{
    slcan_init(&slcan);
    GPIO_OUTSET = BIT(PIN_TX);
    GPIO_PIN_CNF(PIN_TX) = GPIO_OUTPUT;
    GPIO_PIN_CNF(PIN_RX) = GPIO_INPUT | GPIO_PULL_UP; /* an open line is idle */
    UART0_PSELTXD = PIN_TX;
    UART0_PSELRXD = PIN_RX;
    UART0_BAUDRATE = UART0_BAUDRATE_115200;
    UART0_ENABLE = UART0_ENABLED;
    UART0_INTENSET = UART0_INTEN_RXDRDY | UART0_INTEN_TXDRDY | UART0_INTEN_ERROR;
    UART0_STARTTX = 1U;
    UART0_STARTRX = 1U;
    irq_enable(IRQ_UART0);
}

/* The next byte into the transmitter, if there is one. With the UART's interrupt kept out. */
static void send_next(void)
{
    sending = out_tail != out_head;
    if (sending) {
        const uint8_t byte = out[out_tail % OUT_BYTES];
        out_tail++;
        UART0_TXD = byte;
    }
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
    if (!sending) {
        send_next();
    }
    irq_on();
    return true;
}

bool uart_send(const selfcal_frame_t *frame)
{
    if (!slcan.open) {
        dropped++;
        return true;
    }
    char line[SLCAN_FRAME_BYTES];
    slcan_encode(frame, line);
    return put(line, sizeof line);
}

void uart_poll(void)
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

bool uart_sent(void)
{
    return !sending;
}

void uart_tell(selfcal_module_t *told)
{
    told->frames_dropped = dropped;
    told->bus_off_count = lost_in;
}

void uart_handler(void)
{
    if (UART0_ERROR != 0U) {
        UART0_ERROR = 0U;
        UART0_ERRORSRC = UART0_ERRORSRC; /* ones clear it */
        lost_in++;
    }
    if (UART0_RXDRDY != 0U) {
        UART0_RXDRDY = 0U; /* before the byte is taken: the next one sets it again */
        const uint8_t byte = (uint8_t)UART0_RXD;
        if (in_head - in_tail < IN_BYTES) {
            in[in_head % IN_BYTES] = byte;
            in_head++;
        } else {
            lost_in++;
        }
    }
    if (UART0_TXDRDY != 0U) {
        UART0_TXDRDY = 0U;
        send_next();
    }
}
