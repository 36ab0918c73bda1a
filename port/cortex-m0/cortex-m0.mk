# The firmware for the nRF51822: see port/image.mk. -DBOARD_REPORT_MS=600000 in CFLAGS sets the report period.
TARGET := cortex-m0
CORE := cortex-m0
# 64 samples are 78 ms at 819.2 Hz.
IMAGE_CFLAGS := -DADIS16405_QUEUE=64U
include port/image.mk
