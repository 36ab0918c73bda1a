# The firmware for the STM32F405: see port/image.mk. CFLAGS configures the image (port/README.md, Settings).
TARGET := stm32f405
include port/image.mk
