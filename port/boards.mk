# The boards of boards.txt: BOARDS, and for each CORE_BOARD.
BOARD_LINES := $(shell sed '/^\#/d' port/boards.txt | awk '{ print $$1 ":" $$2 }')
BOARDS := $(foreach line,$(BOARD_LINES),$(firstword $(subst :, ,$(line))))
$(foreach line,$(BOARD_LINES),$(eval CORE_$(subst :, := ,$(line))))

# The sensors of port/sensors: SENSOR is the one of an image.
SENSORS := $(filter-out sensor,$(patsubst port/sensors/%.c,%,$(wildcard port/sensors/*.c)))
SENSOR := adis16405
$(if $(filter $(SENSOR),$(SENSORS)),,$(error SENSOR=$(SENSOR): there are $(SENSORS)))
