# The firmware, for boards and for this machine: a part of the Makefile.
.PHONY: posix

# The firmware for this machine, of the default model; `selfcal replay` builds its own for each recording's rate.
posix: $(MODEL)/selfcal_model.c
	@$(MAKE) --no-print-directory -f port/posix/posix.mk posix MODEL_DIR=$(MODEL) OUT=$(BUILD)/posix

.PHONY: firmware firmware-images flash
WANTED := $(filter $(or $(TARGET),$(BOARDS)),$(BOARDS))
NOT_ALL := ACCEPT=1 takes the figures of all images as they are: no TARGET, no SENSOR, no CFLAGS
# The default sensor is the default model's; another one has a part's file that begins with its name, a driver of one's
# own beside it.
OTHER_SENSOR := $(filter-out adis16405,$(SENSOR_NAME))
IMAGES = $(BUILD)/$(1)$(OTHER_SENSOR:%=-%)
PART := $(if $(findstring /,$(SENSOR)),$(SENSOR_ROOM),tools/selfcal/model/models/parts/)$(OTHER_SENSOR)
SENSOR_MODEL := $(firstword $(if $(OTHER_SENSOR),$(wildcard $(PART)*.yaml) $(PART).yaml) \
                            tools/selfcal/model/models/default.yaml)

firmware: setup-dev firmware-images $(if $(ACCEPT),bench-images)
	@$(if $(WANTED),,$(error TARGET=$(TARGET): there are $(BOARDS)))$(BIN)/python tests/bench/image_sizes.py \
	    --sensor $(SENSOR_NAME) $(WANTED)
	@$(if $(ACCEPT),$(if $(TARGET)$(OTHER_SENSOR)$(CFLAGS),$(error $(NOT_ALL))))
	@$(if $(ACCEPT),$(BIN)/python tests/bench/bench.py --accept)

define FIRMWARE_IMAGE
.PHONY: image-$(1)
image-$(1): $(IMAGES)/model/selfcal_model.c
	@$$(MAKE) --no-print-directory -s -f port/$(1)/$(1).mk $(1) SENSOR=$(SENSOR) \
	    TARGET=$(1) MODEL_DIR=$(IMAGES)/model OUT=$(IMAGES)
$(IMAGES)/model/selfcal_model.c: $(MODEL)/selfcal_model.c $(SENSOR_MODEL) | setup-dev
	$(BIN)/selfcal codegen $(SENSOR_MODEL) -o $$(@D) --target $(CORE_$(1))
endef
$(foreach target,$(BOARDS),$(eval $(call FIRMWARE_IMAGE,$(target))))
firmware-images: $(WANTED:%=image-%)

flash: setup
	@tools/setup/flash.sh "$(TARGET)"
