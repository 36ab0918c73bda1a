# The boards of boards.txt: BOARDS, and for each CORE_BOARD.
BOARD_LINES := $(shell sed '/^\#/d' port/boards.txt | awk '{ print $$1 ":" $$2 }')
BOARDS := $(foreach line,$(BOARD_LINES),$(firstword $(subst :, ,$(line))))
$(foreach line,$(BOARD_LINES),$(eval CORE_$(subst :, := ,$(line))))

# SENSOR is the one of an image: one of port/sensors, or the path of a driver elsewhere, DIR/NAME.c or DIR/NAME.
SENSORS := $(filter-out sensor,$(patsubst port/sensors/%.c,%,$(wildcard port/sensors/*.c)))
SENSOR := adis16405
SENSOR_NAME := $(notdir $(SENSOR:.c=))
SENSOR_ROOM := $(if $(findstring /,$(SENSOR)),$(dir $(SENSOR)),port/sensors/)
SENSOR_SOURCE := $(filter-out port/sensors/sensor.c,$(SENSOR_ROOM)$(SENSOR_NAME).c)
$(if $(wildcard $(SENSOR_SOURCE)),,$(error SENSOR=$(SENSOR): there are $(SENSORS), or the path of a driver's C file))
