# Warnings, layout, house rules: a part of the Makefile.
.PHONY: check

CHECKS := check-tidy check-gcc check-clang check-arm check-c++ check-tokens check-house check-format check-ruff \
          check-mypy
.PHONY: $(CHECKS)
$(CHECKS): setup-dev
check: setup-dev
	@$(MAKE) --no-print-directory --keep-going $(CHECKS)

C_ALL := $(wildcard lib/*.c port/app/*.c port/sensors/*.c port/replay/*.c port/posix/*.c) $(MODEL)/selfcal_model.c
# each COMPILER+FLAGS,FILES: every file by itself, so that every complaint is seen
each = @failed=0; for file in $(2); do $(1) $$file || failed=1; done; exit $$failed

GCC := gcc -std=c99 -O2 -c -o /dev/null $(INCLUDES)
check-gcc: $(MODEL)/selfcal_model.c
	$(call each,$(GCC) $(WARNINGS),$(C_ALL))
	$(call each,$(GCC) $(WARNINGS_DOUBLE) -DSELFCAL_REAL_DOUBLE,$(C_ALL))
	$(call each,$(GCC) $(WARNINGS) -DSELFCAL_TERMS_MAX=3,$(wildcard lib/*.c))
	$(call each,$(GCC) $(WARNINGS) -DSELFCAL_TERMS_MAX=3 -DSELFCAL_FIXED,$(wildcard lib/*.c))

check-clang: $(MODEL)/selfcal_model.c
	$(call each,clang -std=c99 -O2 -c -o /dev/null $(INCLUDES) $(WARNINGS),$(C_ALL))

# Every board with its core and its model; a folder that the emulators share is compiled for each core.
MACHINE_cortex-m4f := -DQEMU_NETDUINOPLUS2
MACHINE_cortex-m0 := -DQEMU_MICROBIT
EMBEDDED = $(wildcard port/qemu/*.c port/$(1)/*.c)
INCLUDES_OF = $(INCLUDES:-I$(MODEL)=-I$(BUILD)/$(1)/model) $(MACHINE_$(CORE_$(1)))
ARM_C := $(wildcard lib/*.c port/app/*.c port/sensors/*.c port/replay/*.c)
ARM_GCC := arm-none-eabi-gcc -O2 -c -o /dev/null $(ARM_COMPILE)
check-arm: $(BOARDS:%=check-arm-%)
.PHONY: $(BOARDS:%=check-arm-%)
$(BOARDS:%=check-arm-%): check-arm-%: $(BUILD)/%/model/selfcal_model.c
	$(call each,$(ARM_GCC) $(ARM_$(CORE_$*)) $(call INCLUDES_OF,$*),$(ARM_C) $(call EMBEDDED,$*) $<)

check-c++:
	$(call each,g++ -std=c++17 -O2 $(WARNINGS_DOUBLE) -isystem /usr/include/eigen3 -c -o /dev/null,\
	    $(wildcard host_sim/*.cpp))

# The compiler's own headers do not know newlib's; integers stand for addresses in firmware.
TIDY := clang-tidy --quiet
TIDY_ARM := --checks=-performance-no-int-to-ptr
HASH := \#
STRING_H = $(shell echo "$(HASH)include <string.h>" | arm-none-eabi-gcc -M -E - | grep -om1 "/[^ ]*/string.h")
TIDY_ARM_FLAGS = -std=c99 --target=arm-none-eabi -isystem $(dir $(STRING_H))
tidy = @$(1) 2>&1 | { ! grep -vE '^[0-9]+ warnings? generated|^Suppressed|^Use -header-filter'; }
TIDY_CPU_cortex-m4f := -mcpu=cortex-m4
TIDY_CPU_cortex-m0 := -mcpu=cortex-m0
check-tidy: $(MODEL)/selfcal_model.c $(BOARDS:%=check-tidy-%)
	$(call tidy,$(TIDY) $(filter-out $(MODEL)/% %_fixed.c,$(C_ALL)) -- -std=c99 $(INCLUDES) -DSELFCAL_TERMS_MAX=3)
	$(call tidy,$(TIDY) $(wildcard lib/*_fixed.c) -- -std=c99 $(INCLUDES) -DSELFCAL_FIXED -DSELFCAL_TERMS_MAX=3)
.PHONY: $(BOARDS:%=check-tidy-%)
$(BOARDS:%=check-tidy-%): check-tidy-%: $(BUILD)/%/model/selfcal_model.c
	$(call tidy,$(TIDY) $(TIDY_ARM) $(call EMBEDDED,$*) -- \
	    $(TIDY_ARM_FLAGS) $(TIDY_CPU_$(CORE_$*)) $(call INCLUDES_OF,$*))

# lib/ has no heap, no I/O and no double but selfcal_wide_t. Comments do not count.
BANNED := (malloc|calloc|realloc|free|alloca|[a-z]*printf|puts|putchar|fopen|exit|abort)[[:space:]]*\(
check-tokens:
	@failed=0; for file in lib/*.[ch]; do \
	    gcc -fpreprocessed -dD -E -P $$file 2>/dev/null > $(BUILD)/tokens; \
	    if grep -nE '\<$(BANNED)' $(BUILD)/tokens || grep -nE '\<double\>' $(BUILD)/tokens | \
	        grep -vE 'typedef double (selfcal_wide_t|selfcal_real_t);'; \
	    then echo "$$file: banned in lib/"; failed=1; fi; done; exit $$failed

# Lines, conditionals, circles, lengths of functions, names.
check-house:
	@$(BIN)/python tests/count_house.py

# The layout of C, C++ and Python.
.PHONY: format
FORMATTED = $(shell find lib port host_sim tests tools -name '*.[ch]' -o -name '*.[ch]pp' -o -name '*.ino')
format: setup-dev
	@$(BIN)/clang-format -i $(FORMATTED)
	@$(BIN)/ruff format --quiet --config tools/pyproject.toml tools tests host_sim
check-format:
	@$(BIN)/clang-format --dry-run -Werror $(FORMATTED)
	@$(BIN)/ruff format --quiet --check --config tools/pyproject.toml tools tests host_sim

check-ruff:
	@$(BIN)/ruff check --quiet --config tools/pyproject.toml tools tests host_sim

check-mypy:
	@cd tools && ../$(BIN)/mypy --no-error-summary
	@MYPYPATH=host_sim $(BIN)/mypy --no-error-summary --config-file tools/pyproject.toml tests/run.py tests/long_run.py \
	    tests/count_house.py tests/bench/bench.py tests/bench/image_sizes.py
	@cd tools && ../$(BIN)/mypy --no-error-summary \
	    $(addprefix ../,$(filter-out tests/hidden/test_%,$(wildcard tests/hidden/*.py)))
	@$(BIN)/mypy --no-error-summary --config-file tools/pyproject.toml --untyped-calls-exclude=unicorn host_sim/parts
