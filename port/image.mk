# An image for a board. A target's own file sets TARGET, CORE and IMAGE_CFLAGS and includes this one; it is called with
#   make -f port/TARGET/TARGET.mk TARGET MODEL_DIR=DIR OUT=DIR [CFLAGS=...]
# MODEL_DIR holds selfcal_model.h and .c (`selfcal codegen --target CORE`); makes OUT/selfcal.elf, .bin, .hex and .map, and beside
# the objects what gcc says of their stacks (.su).
include port/arm.mk

$(if $(OUT),,$(error OUT=DIR is wanted))
IMAGE_SOURCES := $(wildcard lib/*.c port/app/*.c port/$(TARGET)/*.c)
IMAGE_HEADERS := $(wildcard lib/*.h port/*.h port/app/*.h port/$(TARGET)/*.h)
IMAGE_MODEL := $(abspath $(MODEL_DIR))

.PHONY: $(TARGET)
$(TARGET): $(OUT)/selfcal.elf $(OUT)/selfcal.bin $(OUT)/selfcal.hex

# The library knows neither the model nor the settings of the application: images that share its flags share its objects.
LIBRARY_FLAGS := $(ARM_$(CORE)) -fstack-usage -g $(filter-out -DAPP_% -DBOARD_% -DADIS16405_%,$(IMAGE_CFLAGS) $(CFLAGS))
LIBRARY := build/library/$(CORE)-$(firstword $(shell printf '%s' '$(subst ','\'',$(LIBRARY_FLAGS))' | cksum))

$(LIBRARY)/stamp: $(wildcard lib/*.c lib/*.h) port/arm.mk
	@rm -rf $(@D) && mkdir -p $(@D)
	cd $(@D) && $(call arm_objects,$(LIBRARY_FLAGS) -I$(CURDIR)/lib,$(abspath $(wildcard lib/*.c)))
	@touch $@

# The lock: images may be made at the same time.
$(OUT)/selfcal.elf: $(IMAGE_SOURCES) $(IMAGE_HEADERS) $(IMAGE_MODEL)/selfcal_model.c $(IMAGE_MODEL)/selfcal_model.h \
                    port/$(TARGET)/link.ld port/$(TARGET)/$(TARGET).mk port/image.mk port/arm.mk $(OUT)/flags
	@rm -rf $(OUT)/objects && mkdir -p $(OUT)/objects build/library
	@flock $(LIBRARY).lock $(MAKE) --no-print-directory -f port/$(TARGET)/$(TARGET).mk $(LIBRARY)/stamp
	@cp $(LIBRARY)/*.o $(LIBRARY)/*.su $(OUT)/objects
	cd $(OUT)/objects && $(call arm_objects,$(ARM_$(CORE)) -fstack-usage -g $(IMAGE_CFLAGS) $(CFLAGS) -I$(CURDIR)/lib -I$(CURDIR)/port \
	    -I$(CURDIR)/port/app -I$(IMAGE_MODEL),$(abspath $(filter-out lib/%,$(IMAGE_SOURCES))) $(IMAGE_MODEL)/selfcal_model.c)
	arm-none-eabi-gcc $(ARM_$(CORE)) -nostartfiles -T port/$(TARGET)/link.ld -Wl,--gc-sections,-Map=$(OUT)/selfcal.map,--fatal-warnings \
	    $(OUT)/objects/*.o -lm -o $@

# Other flags, another image: touched when they change.
IMAGE_FLAGS := $(IMAGE_CFLAGS) $(CFLAGS)
.PHONY: flags
$(OUT)/flags: flags
	@mkdir -p $(OUT) && printf '%s\n' '$(subst ','\'',$(IMAGE_FLAGS))' | cmp -s - $@ || printf '%s\n' '$(subst ','\'',$(IMAGE_FLAGS))' > $@

$(OUT)/selfcal.bin: $(OUT)/selfcal.elf
	arm-none-eabi-objcopy -O binary $< $@

$(OUT)/selfcal.hex: $(OUT)/selfcal.elf
	arm-none-eabi-objcopy -O ihex $< $@
