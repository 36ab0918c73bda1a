# The firmware for the host: make -f port/posix/posix.mk posix MODEL_DIR=DIR OUT=DIR
# MODEL_DIR holds what `selfcal codegen` writes. Makes OUT/selfcal-posix, with the sizes of its --target.
include port/arm.mk

POSIX_WARNINGS := -Wall -Wextra -Wpedantic -Wconversion -Wshadow -Wdouble-promotion
POSIX_SOURCES := $(wildcard lib/*.c port/replay/*.c port/posix/*.c) $(APP_WITHOUT_SENSOR)
POSIX_HEADERS := $(wildcard lib/*.h port/*.h port/app/*.h port/replay/*.h port/posix/*.h)

.PHONY: posix
posix: $(OUT)/selfcal-posix

$(OUT)/selfcal-posix: $(POSIX_SOURCES) $(POSIX_HEADERS) $(MODEL_DIR)/selfcal_model.c \
                      $(MODEL_DIR)/selfcal_model.h $(MODEL_DIR)/selfcal_config.h
	@mkdir -p $(OUT)
	$(CC) -std=c99 -O2 -ffp-contract=off $(POSIX_WARNINGS) \
	    $(NODE_FLAGS) $(POSIX_CFLAGS) \
	    -Ilib -Iport -Iport/app -Iport/replay -I$(MODEL_DIR) \
	    -o $@ $(POSIX_SOURCES) $(MODEL_DIR)/selfcal_model.c -lm -pthread
