# The library for a core, compiled once for all programs that share its flags; it knows neither the model nor the settings of the application.
#   make -f port/library.mk objects CORE=CORE OUT=DIR [PROGRAM_FLAGS=...]
# puts its objects, and what gcc says of their stacks (.su), into DIR.
include port/arm.mk

LIBRARY_FLAGS := $(strip $(ARM_$(CORE)) -fstack-usage -g $(filter-out -DAPP_% -DSELFCAL_NODE=% -DBOARD_% -DADIS16405_% -DQEMU_% -DSAME_% -DBENCH_% -W% %.c,$(PROGRAM_FLAGS)))
LIBRARY_SOURCES := $(wildcard lib/*.c lib/*.h) port/arm.mk
# Named by the content of all that it is made of: no time stamp takes old objects for new ones.
LIBRARY := build/library/$(CORE)-$(shell { printf '%s' '$(subst ','\'',$(LIBRARY_FLAGS))'; cat $(LIBRARY_SOURCES); } | sha256sum | cut -c1-16)

# The lock: programs may be made at the same time.
.PHONY: objects
objects:
	@mkdir -p build/library $(OUT)
	@flock $(LIBRARY).lock $(MAKE) --no-print-directory -f port/library.mk $(LIBRARY)/stamp
	@cp $(LIBRARY)/*.o $(LIBRARY)/*.su $(OUT)

$(LIBRARY)/stamp:
	@rm -rf $(@D) && mkdir -p $(@D)
	$(call arm_objects,$(LIBRARY_FLAGS) -Ilib,$(wildcard lib/*.c),$(@D))
	@touch $@
