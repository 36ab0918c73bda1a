# The firmware for an emulated core: make -f port/qemu/qemu.mk qemu CORE=cortex-m4f|cortex-m0 MODEL_DIR=DIR OUT=DIR
# MODEL_DIR holds what `selfcal codegen --target CORE` writes; makes OUT/selfcal-qemu.elf.

include port/arm.mk

QEMU_SOURCES := $(wildcard port/replay/*.c port/qemu/*.c) $(APP_WITHOUT_SENSOR) $(ARM_SOURCES_$(CORE)) \
                $(MODEL_DIR)/selfcal_model.c
QEMU_HEADERS := $(wildcard lib/*.[ch] port/*.h port/app/*.h port/replay/*.h port/qemu/*.h) \
                $(MODEL_DIR)/selfcal_model.h $(MODEL_DIR)/selfcal_config.h
QEMU_BOARD_cortex-m4f := QEMU_NETDUINOPLUS2
QEMU_BOARD_cortex-m0 := QEMU_MICROBIT
# Its RAM has no room for the judgement of the model beside six axes.
QEMU_APP_cortex-m0 := -DSELFCAL_MODEL_JUDGED=0
QEMU_MAP_cortex-m4f := FLASH_ORIGIN=0x08000000,--defsym=RAM_BYTES=0x20000
# 4 KB more than the part's 32: the recording's buffers and a stack twice as large, which an image does not have.
QEMU_MAP_cortex-m0 := FLASH_ORIGIN=0,--defsym=RAM_BYTES=0x9000

.PHONY: qemu
qemu: $(OUT)/selfcal-qemu.elf

$(OUT)/selfcal-qemu.elf: $(QEMU_SOURCES) $(QEMU_HEADERS) port/qemu/link.ld port/library.mk port/arm.mk
	@rm -rf $(OUT)/objects
	@$(MAKE) --no-print-directory -f port/library.mk objects CORE=$(CORE) MODEL_DIR=$(MODEL_DIR) OUT=$(OUT)/objects \
	    'PROGRAM_FLAGS=$(subst ','\'',$(QEMU_CFLAGS))'
	$(call arm_objects,$(ARM_$(CORE)) -fstack-usage -g $(NODE_FLAGS) \
	    $(filter-out %.c,$(QEMU_CFLAGS)) -D$(QEMU_BOARD_$(CORE)) $(QEMU_APP_$(CORE)) \
	    -Ilib -Iport -Iport/app -Iport/replay \
	    -I$(MODEL_DIR),$(QEMU_SOURCES) $(filter %.c,$(QEMU_CFLAGS)),$(OUT)/objects)
	arm-none-eabi-gcc $(ARM_$(CORE)) -nostartfiles -T port/qemu/link.ld -Wl,--gc-sections,--defsym=$(QEMU_MAP_$(CORE)) \
	    $(OUT)/objects/*.o -lm -o $@
