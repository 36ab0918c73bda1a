# The firmware for the nRF51822: see port/image.mk. -DBOARD_REPORT_MS=600000 in CFLAGS sets the report period.
TARGET := cortex-m0
CORE := cortex-m0
# 16 samples are 20 ms at 819.2 Hz. The largest grid dimension of nodes.cortex-m0 is 8.
IMAGE_CFLAGS := -DADIS16405_QUEUE=64U -DSELFCAL_GRID_MAX=8
include port/image.mk
