#include "uart.h"

#define REG32(address) (*(volatile uint32_t *)(address))
#define BIT(n) (1UL << (n))

#ifdef QEMU_NETDUINOPLUS2

/* STM32F405, RM0090 section 30.6. The emulator wants neither clocks nor pins nor a bit rate. */
#define USART1_SR REG32(0x40011000U)
#define USART1_DR REG32(0x40011004U)
#define USART1_CR1 REG32(0x4001100CU)
#define USART_SR_RXNE BIT(5)
#define USART_SR_TXE BIT(7)
#define USART_CR1_RE BIT(2)
#define USART_CR1_TE BIT(3)
#define USART_CR1_UE BIT(13)

void uart_start(void) {
    USART1_CR1 = USART_CR1_UE | USART_CR1_TE | USART_CR1_RE;
}

bool uart_receive(uint8_t *byte) {
    if ((USART1_SR & USART_SR_RXNE) == 0U) {
        return false;
    }
    *byte = (uint8_t)USART1_DR;
    return true;
}

static void send_byte(uint8_t byte) {
    while ((USART1_SR & USART_SR_TXE) == 0U) {
    }
    USART1_DR = byte;
}

#elif defined QEMU_MICROBIT

/* nRF51 Series Reference Manual 3.0, UART: register overview. */
#define UART_STARTRX REG32(0x40002000U)
#define UART_STARTTX REG32(0x40002008U)
#define UART_RXDRDY REG32(0x40002108U)
#define UART_TXDRDY REG32(0x4000211CU)
#define UART_ENABLE REG32(0x40002500U)
#define UART_RXD REG32(0x40002518U)
#define UART_TXD REG32(0x4000251CU)
#define UART_ENABLED 4U

void uart_start(void) {
    UART_ENABLE = UART_ENABLED;
    UART_STARTTX = 1U;
    UART_STARTRX = 1U;
}

bool uart_receive(uint8_t *byte) {
    if (UART_RXDRDY == 0U) {
        return false;
    }
    UART_RXDRDY = 0U; /* before the byte is taken: the next one sets it again */
    *byte = (uint8_t)UART_RXD;
    return true;
}

static void send_byte(uint8_t byte) {
    UART_TXDRDY = 0U;
    UART_TXD = byte;
    while (UART_TXDRDY == 0U) {
    }
}

#else
#error "no emulated board chosen"
#endif

void uart_send(const char *bytes, size_t count) {
    for (size_t i = 0; i < count; i++) {
        send_byte((uint8_t)bytes[i]);
    }
}
