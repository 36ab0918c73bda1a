# The library for a core, compiled once for all programs that share its flags. It knows the sizes in
# MODEL_DIR/selfcal_config.h, not the model, and no settings of the application.
#   make -f port/library.mk objects CORE=CORE MODEL_DIR=DIR OUT=DIR [PROGRAM_FLAGS=...]
# puts its objects, and gcc's statements of their stacks (.su), into DIR.
include port/arm.mk

NOT_THE_LIBRARYS := -DAPP_% -DSELFCAL_MODEL_% -DSELFCAL_NODE=% \
                     -DBOARD_% -DSENSOR% -DQEMU_% -DSAME_% -DBENCH_% -W% %.c
LIBRARY_FLAGS := $(strip $(ARM_$(CORE)) -fstack-usage -g $(filter-out $(NOT_THE_LIBRARYS),$(PROGRAM_FLAGS)))
LIBRARY_SOURCES := $(wildcard lib/*.c lib/*.h) port/arm.mk
# Named by the content of all that it is made of: no time stamp takes old objects for new ones. Of selfcal_config.h its
# sizes count, not the model's name: models of equal sizes share the objects.
LIBRARY_HASH := $(shell { printf '%s' '$(subst ','\'',$(LIBRARY_FLAGS))'; \
    cat $(LIBRARY_SOURCES); grep '^\#define' $(MODEL_DIR)/selfcal_config.h; } | sha256sum)
LIBRARY := build/library/$(CORE)-$(shell echo $(LIBRARY_HASH) | cut -c1-16)

# The lock: programs may be made at the same time.
.PHONY: objects
objects:
	@mkdir -p build/library $(OUT)
	@flock $(LIBRARY).lock $(MAKE) --no-print-directory -f port/library.mk $(LIBRARY)/stamp
	@cp $(LIBRARY)/*.o $(LIBRARY)/*.su $(OUT)

$(LIBRARY)/stamp:
	@rm -rf $(@D) && mkdir -p $(@D)
	$(call arm_objects,$(LIBRARY_FLAGS) -Ilib -I$(MODEL_DIR),$(wildcard lib/*.c),$(@D))
	@touch $@
