/* Telemetry as SLCAN on UART0. */
#include "board.h"
#include "nrf51.h"
#include "slcan_line.h"

static volatile uint8_t out[256], in[64];
static slcan_line_t line = SLCAN_LINE(out, in);
static volatile bool sending;

void uart_init(void) {
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
static void send_next(void) {
    uint8_t byte;
    sending = slcan_line_next(&line, &byte);
    if (sending) {
        UART0_TXD = byte;
    }
}

static void start(void) {
    irq_off();
    if (!sending) {
        send_next();
    }
    irq_on();
}

bool uart_send(const selfcal_frame_t *frame) {
    const bool taken = slcan_line_send(&line, frame);
    start();
    return taken;
}

void uart_poll(void) {
    while (slcan_line_poll(&line)) {
#ifdef APP_COMMAND_KEY
        module_command(line.slcan.data);
#endif
    }
    start();
}

bool uart_sent(void) {
    return !sending;
}

void uart_tell(selfcal_module_t *told) {
    told->frames_dropped = line.dropped;
    told->bus_off_count = line.lost;
}

void uart_handler(void) {
    if (UART0_ERROR != 0U) {
        UART0_ERROR = 0U;
        UART0_ERRORSRC = UART0_ERRORSRC; /* ones clear it */
        line.lost++;
    }
    if (UART0_RXDRDY != 0U) {
        UART0_RXDRDY = 0U; /* before the byte is taken: the next one sets it again */
        slcan_line_received(&line, (uint8_t)UART0_RXD);
    }
    if (UART0_TXDRDY != 0U) {
        UART0_TXDRDY = 0U;
        send_next();
    }
}
