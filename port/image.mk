# An image for a board of boards.txt. A board's own file sets TARGET and IMAGE_CFLAGS and includes this one:
#   make -f port/TARGET/TARGET.mk TARGET MODEL_DIR=DIR OUT=DIR [SENSOR=adis16405] [CFLAGS=...]
# MODEL_DIR holds what `selfcal codegen --target CORE` writes. Makes OUT/selfcal.elf, .bin, .hex and .map,
# and beside the objects gcc's statements of their stacks (.su).
include port/boards.mk port/arm.mk
CORE := $(CORE_$(TARGET))

$(if $(OUT),,$(error OUT=DIR is wanted))
PROGRAM_FLAGS := $(strip -DSENSOR=$(SENSOR_NAME) $(IMAGE_CFLAGS) $(CFLAGS) $(NODE_FLAGS))
# Between single quotes of the shell.
QUOTED_FLAGS = $(subst ','\'',$(PROGRAM_FLAGS))
IMAGE_SOURCES := $(wildcard port/app/*.c port/$(TARGET)/*.c) port/sensors/sensor.c $(SENSOR_SOURCE)
IMAGE_HEADERS := $(wildcard lib/*.[ch] port/*.h port/app/*.h port/sensors/*.h port/$(TARGET)/*.h) \
                 $(wildcard $(SENSOR_ROOM)*.h)

.PHONY: $(TARGET)
$(TARGET): $(OUT)/selfcal.elf $(OUT)/selfcal.bin $(OUT)/selfcal.hex

$(OUT)/selfcal.elf: $(IMAGE_SOURCES) $(IMAGE_HEADERS) $(MODEL_DIR)/selfcal_model.c $(MODEL_DIR)/selfcal_model.h \
                    port/$(TARGET)/link.ld port/$(TARGET)/$(TARGET).mk port/image.mk port/library.mk port/arm.mk \
                    $(MODEL_DIR)/selfcal_config.h $(OUT)/flags
	@rm -rf $(OUT)/objects
	@$(MAKE) --no-print-directory -f port/library.mk objects CORE=$(CORE) MODEL_DIR=$(MODEL_DIR) OUT=$(OUT)/objects \
	    'PROGRAM_FLAGS=$(QUOTED_FLAGS)'
	$(call arm_objects,$(ARM_$(CORE)) -fstack-usage -g @$(OUT)/flags -Ilib -Iport -Iport/app -Iport/sensors \
	    -I$(SENSOR_ROOM) -I$(MODEL_DIR),$(IMAGE_SOURCES) $(MODEL_DIR)/selfcal_model.c,$(OUT)/objects)
	arm-none-eabi-gcc $(ARM_$(CORE)) -nostartfiles -T port/$(TARGET)/link.ld \
	    -Wl,--gc-sections,-Map=$(OUT)/selfcal.map,--fatal-warnings $(OUT)/objects/*.o -lm -o $@

# Other flags, another image: touched when they change. The compiler reads them there, so that no log shows a command
# key. Whoever can read an image has its key: the folder of an image with a key is its owner's alone.
.PHONY: flags
$(OUT)/flags: flags
	@mkdir -p $(OUT) && $(if $(findstring APP_COMMAND_KEY,$(PROGRAM_FLAGS)),chmod go= $(OUT) &&) \
	    umask 077 && touch -a $@ && chmod 600 $@ && \
	    { printf '%s\n' '$(QUOTED_FLAGS)' | cmp -s - $@ || printf '%s\n' '$(QUOTED_FLAGS)' > $@; }

$(OUT)/selfcal.bin: $(OUT)/selfcal.elf
	arm-none-eabi-objcopy -O binary $< $@

$(OUT)/selfcal.hex: $(OUT)/selfcal.elf
	arm-none-eabi-objcopy -O ihex $< $@
