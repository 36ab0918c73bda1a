# The firmware for the nRF51822: see port/image.mk. CFLAGS configures the image (port/README.md, Cortex-M0).
TARGET := cortex-m0
# 64 samples are 78 ms at 819.2 Hz. The RAM has no room for the judgement of the model beside six axes.
IMAGE_CFLAGS := -DSENSOR_QUEUE=64U -DSELFCAL_MODEL_JUDGED=0
include port/image.mk
