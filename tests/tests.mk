# Suites and long runs, and the C tests: a part of the Makefile.
CASES := $(foreach room,agree cases hidden lib tools,cases-$(room))
.PHONY: quick test hidden hidden-physics hidden-several false-alarms module-null c-tests
.PHONY: soak tolerances emulate calibration campaigns cases $(CASES)

WARNINGS := -Wall -Wextra -Wpedantic -Wconversion -Wshadow -Wdouble-promotion -Werror
WARNINGS_DOUBLE := $(filter-out -Wdouble-promotion,$(WARNINGS))
INCLUDES := -Ilib -Iport -Iport/app -Iport/sensors -Iport/replay -I$(MODEL) -DSENSOR=adis16405
# What the tests look at beyond the default model.
TEST_SIZES := -DSELFCAL_HYPOTHESES_MAX=4 -DSELFCAL_REGRESSORS_MAX=6
TESTED := $(wildcard lib/*.c port/app/*.c) port/sensors/sensor.c $(MODEL)/selfcal_model.c
TEST_NAMES := $(basename $(notdir $(wildcard tests/lib/test_*.c tests/port/test_*.c)))
TESTS_PLAIN := $(TEST_NAMES:%=$(BUILD)/c/plain/%)
TESTS_SANITIZED := $(TEST_NAMES:%=$(BUILD)/c/sanitized/%)
# The integer builds: the formats by a test of their own, the rest as in float.
TESTS_FIXED := $(foreach test,bank_kernel_fixed intake_fixed bank snapshot check intake,$(BUILD)/c/fixed/test_$(test))

test: setup-dev setup-all
	@$(BIN)/python tests/run.py

quick: setup-dev
	@$(BIN)/python tests/run.py --quick

# The matrices are small: a BLAS with threads burns a core and is no faster.
soak tolerances emulate campaigns calibration cases $(CASES): export OPENBLAS_NUM_THREADS := 1

# What `make test` leaves out. When each last ran, and on which commit, stands in tests/long_runs.txt.
LONG = $(BIN)/python tests/long_run.py $(if $(QUICK)$(ONLY)$(TIMES),--part) $@
PYTEST := $(BIN)/python -m pytest -q --config-file=tools/pyproject.toml --rootdir=.

# A run goes on where an earlier one of this commit ended. Seeds of `hidden` are from the date unless SEED is given.
hidden: SUITE = $(if $(TSOUTLIERS),tsoutliers,$(if $(RIVALS),rivals,recordings))
hidden-physics: SUITE = physics
hidden-several: SUITE = several
hidden hidden-physics hidden-several: setup-dev
	nice $(BIN)/python tests/hidden/judge.py --suite $(SUITE) --kinds $(CLASSES) $(KINDS) $(RECORDS:%=--records %) \
	    $(SEED:%=--seed %) $(if $(SIZES),--sizes $(SIZES)) $(if $(RATE),--rate $(RATE)) $(SECONDS:%=--seconds %) \
	    $(OUT:%=--out %) $(SAVE:%=--save %)

false-alarms: setup-dev
	nice $(BIN)/python tests/hidden/false_alarms.py $(RECORDS:%=--records %) $(SEED:%=--seed %) $(RATE:%=--rate %)

module-null: setup-dev
	nice $(BIN)/python tests/hidden/module_null.py $(RECORDS:%=--records %) $(SEED:%=--seed %)

soak: setup-dev
	SELFCAL_SOAK=1e8 $(LONG) $(PYTEST) -s tests/agree/test_long.py

# SEEDS times the records; QUICK=1: records of up to 10^4 bank samples; ONLY="dense targets": these pairs alone.
tolerances: setup-dev
	@$(LONG) $(BIN)/python tests/agree/tolerances.py \
	    $(if $(SEEDS),--seeds $(SEEDS)) $(if $(QUICK),--quick) $(ONLY:%=--only %)

emulate: setup-dev
	SELFCAL_EMULATE=1 $(LONG) $(PYTEST) -s tests/port/test_firmware_qemu.py -k twenty

# Records of each law and length; the fast subset of `make test` has 60.
calibration: setup-dev
	SELFCAL_CALIBRATION=$(or $(RECORDS),1000) $(BIN)/python tests/long_run.py $(if $(RECORDS),--part) $@ \
	    $(PYTEST) -s tests/agree/test_calibration.py

# Many records of each kind of disturbed log; and the tests of every room but the firmware's that make test leaves out
# (tests/long_tests.txt). A room has its own line, so that a run that is cut short loses one room: `make cases-hidden`.
cases:
	@$(MAKE) --keep-going $(CASES)

$(CASES): cases-%: setup-dev setup-all
	SELFCAL_CASES=$(or $(RECORDS),1) $(BIN)/python tests/long_run.py $(if $(RECORDS),--part) $@ \
	    $(PYTEST) -s -n 2 tests/$* --ignore=tests/tools/test_hostile.py

# All trials, ten times; and the tests of the firmware that make test leaves out.
campaigns: setup-dev setup-all
	@rm -f $(BUILD)/campaigns.txt
	SELFCAL_CAMPAIGN=$(or $(TIMES),10) $(LONG) $(PYTEST) \
	    tests/port tests/tools/test_hostile.py tests/tools/test_monitor_hostile.py
	@printf '%-40s %9s %9s\n' campaign trials survivors && cat $(BUILD)/campaigns.txt

c-tests: $(TESTS_PLAIN) $(TESTS_SANITIZED) $(TESTS_FIXED)

# Without the instruction each fmaf is a call; either rounds once.
FMA := $(if $(filter fma,$(shell grep -m1 '^flags' /proc/cpuinfo 2>/dev/null)),-mfma)

# One archive a variant, so that a test links only what it uses. C is the compiler's flags of the variant.
# The sanitizers' own code draws warnings, so those are left to the plain variant.
$(BUILD)/c/plain/%: C := -O2 $(FMA) $(WARNINGS)
SANITIZED := -O1 $(FMA) -g -fno-omit-frame-pointer -fsanitize=address,undefined -fno-sanitize-recover=all
$(BUILD)/c/sanitized/%: C := $(SANITIZED)
$(BUILD)/c/fixed/%: C := $(SANITIZED) -DSELFCAL_FIXED
# From a folder four levels below to this one, whose path may have spaces.
BACK := ../../../..
C_ROOMS := lib lib/fixed port
define C_TEST

$(BUILD)/c/$(1)/test_%: tests/$(2)/test_%.c $(BUILD)/c/$(1)/tested.a $(wildcard tests/common/*.h tests/port/*.h)
	$(CC) -std=c99 $$(C) $(TEST_SIZES) -ffp-contract=off $(INCLUDES) -Itests/common -isystem $(UNITY_ROOT) \
	    $$(filter-out %.h,$$^) -lm -o $$@
endef
define C_TESTS
$(BUILD)/c/$(1)/tested.a: $(TESTED) $(wildcard lib/*.h port/*.h port/app/*.h port/sensors/*.h) $(UNITY)
	@rm -rf $$(@D)/objects $$@ && mkdir -p $$(@D)/objects
	cd $$(@D)/objects && $(CC) -std=c99 $$(C) $(TEST_SIZES) -ffp-contract=off $(INCLUDES:-I%=-I$(BACK)/%) \
	    -c $(TESTED:%=$(BACK)/%)
	$(CC) $$(filter-out $(WARNINGS),$$(C)) -c $(UNITY) -o $$(@D)/objects/unity.o
	$(AR) -rcs $$@ $$(@D)/objects/*.o
$(foreach room,$(C_ROOMS),$(call C_TEST,$(1),$(room)))
endef
$(eval $(call C_TESTS,plain))
$(eval $(call C_TESTS,sanitized))
$(eval $(call C_TESTS,fixed))
