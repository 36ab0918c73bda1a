# The firmware for the STM32F405: make -f port/stm32f405/stm32f405.mk stm32f405 MODEL_DIR=DIR OUT=DIR
# MODEL_DIR holds selfcal_model.h and .c (`selfcal codegen --target cortex-m4f`); makes OUT/selfcal.elf, .bin and .hex.
# STM32F405_CFLAGS configures the image: -DBOARD_CAN_KBITPS=250, or 0 for SLCAN on the USART; -DBOARD_REPORT_MS=10000.

STM32F405_CORE := -mcpu=cortex-m4 -mthumb -mfpu=fpv4-sp-d16 -mfloat-abi=hard
STM32F405_WARNINGS := -Wall -Wextra -Wpedantic -Wconversion -Wshadow -Wdouble-promotion -Werror
STM32F405_SOURCES := $(wildcard lib/*.c port/app/*.c port/stm32f405/*.c)
STM32F405_HEADERS := $(wildcard lib/*.h port/*.h port/app/*.h port/stm32f405/*.h)

.PHONY: stm32f405
stm32f405: $(OUT)/selfcal.elf $(OUT)/selfcal.bin $(OUT)/selfcal.hex

# -fstack-usage and -Map: for the figures that are made of it.
$(OUT)/selfcal.elf: $(STM32F405_SOURCES) $(STM32F405_HEADERS) $(MODEL_DIR)/selfcal_model.c $(MODEL_DIR)/selfcal_model.h \
                    port/stm32f405/link.ld port/stm32f405/stm32f405.mk
	@rm -rf $(OUT)/objects && mkdir -p $(OUT)/objects
	cd $(OUT)/objects && arm-none-eabi-gcc $(STM32F405_CORE) -std=c99 -O2 -ffp-contract=off -ffunction-sections -fdata-sections -fstack-usage -g \
	    $(STM32F405_WARNINGS) $(STM32F405_CFLAGS) -I$(CURDIR)/lib -I$(CURDIR)/port -I$(CURDIR)/port/app -I$(abspath $(MODEL_DIR)) \
	    -c $(STM32F405_SOURCES:%=$(CURDIR)/%) $(abspath $(MODEL_DIR))/selfcal_model.c
	arm-none-eabi-gcc $(STM32F405_CORE) -nostartfiles -T port/stm32f405/link.ld -Wl,--gc-sections,-Map=$(OUT)/selfcal.map,--fatal-warnings \
	    $(OUT)/objects/*.o -lm -o $@

$(OUT)/selfcal.bin: $(OUT)/selfcal.elf
	arm-none-eabi-objcopy -O binary $< $@

$(OUT)/selfcal.hex: $(OUT)/selfcal.elf
	arm-none-eabi-objcopy -O ihex $< $@
