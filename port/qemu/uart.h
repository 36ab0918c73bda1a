/* The first UART of the emulated board, polled. */
#ifndef UART_H
#define UART_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

void uart_start(void);

/* Takes a received byte; false: there is none. */
bool uart_receive(uint8_t *byte);

/* Sends, and waits for it. */
void uart_send(const char *bytes, size_t count);

#endif
