# The firmware for the STM32F405: see port/image.mk. CFLAGS configures the image: -DBOARD_CAN_KBITPS=250, or 0 for SLCAN on the
# USART; -DBOARD_REPORT_MS=10000.
TARGET := stm32f405
CORE := cortex-m4f
include port/image.mk
