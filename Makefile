# selfcal. On a fresh machine each of these does its own set-up first:
#   make help                   this list
#   make run [RECORDING=path]   the firmware over a recording: live view, table, plot
#   make quick                  the checks, the C tests and a thin way through everything, in less than a minute
#   make test                   everything that is checked; ends with `N passed, N failed`
#   make hidden [CLASSES="step clean"] [RECORDS=n] [SEED=n] [RATE=hz] [SAVE=dir] [RIVALS=1]
#                               effects hidden in recordings: are they named?
#   make hidden-physics [KINDS="turn_on tilt"] [SIZES=plain] [RECORDS=n] [SEED=n] [RATE=hz] [SECONDS=s] [OUT=dir]
#                               effects from physics, by a generator that knows nothing of the detector
#   make false-alarms [RECORDS=n] [SEED=n] [RATE=hz]
#                               clean axes that diagnose calls inadequate, in the forms of people's logs
#   make soak                   a record of 10^8 bank samples
#   make tolerances             all that must agree, as one table; fails where a tolerance is not kept
#   make calibration            ranks of the truth in the bank's posterior over thousands of records, every law
#   make emulate                20 minutes of six axes through the emulated firmware
#   make cases                  logs that went wrong, each kind on hundreds of records; half an hour
#   make campaigns              every fault campaign on the firmware images at length, an hour and more
#   make format                 lay out C, C++ and Python
#   make check                  warnings, clang-tidy, ruff, mypy and house rules alone
#   make fuzz [RUNS=n | SECONDS=n] [KERNEL=fixed]
#                               random calls of the library under sanitizers, 10^7 executions
#   make firmware [TARGET=...] [SENSOR=icm42688] [CFLAGS=...] [NODE=n] [ACCEPT=1]
#                               build/TARGET/selfcal.elf, .bin, .hex of each board; sizes; fails above a budget.
#                               With another sensor than the ADIS16405: build/TARGET-SENSOR
#   make flash TARGET=stm32f405 writes it into a module by openocd, st-flash or dfu-util
#   make bench [ACCEPT=1]       instructions on emulated Cortex-M, bytes, ns here; fails on growth unless it is accepted
#   make setup                  the set-up alone: what `make run` takes
#   make setup-dev              what checks and tests take as well; they run it
#   make setup-all              every extra too: readers of other programs' logs (400 MB); `make test` runs it
#   make setup-rivals, make setup-cluster   packages that few need: filterpy; dask.distributed and pyarrow (60 MB)
#   make setup-packages         what packs lib/ for the registries of PlatformIO and ESP-IDF (70 MB)
#   make docs                   these pages, the header and the Python functions as a site, build/docs/site/index.html
#   make wheel                  source archive and wheel of the Python package into build/wheel
#   make lock [UPGRADE=1 | UPGRADE=name]
#                               versions and hashes of the Python packages, from the names in tools/pyproject.toml
#   make clean                  removes what was made, but for .venv
# Settings: PYTHON (3.11 or later), UNITY_ROOT (a Unity of your own: the folder with unity.c), BROWSER=0 (no chromium).

PYTHON ?= python3
BROWSER ?= 1
BUILD := build
VENV := .venv
BIN := $(VENV)/bin
RECORDING ?= tests/data/simulated_adis16405.npz
# A file's name is data: make expands nothing in it, here or in a make below. The shell takes it from the environment.
ifeq ($(origin RECORDING),command line)
MAKEOVERRIDES :=
endif
override RECORDING := $(value RECORDING)
export RECORDING

include port/boards.mk port/arm.mk

.DELETE_ON_ERROR:
.PHONY: all help setup system python lock run posix quick test hidden hidden-physics false-alarms c-tests check clean
.PHONY: soak tolerances emulate calibration campaigns cases

all: setup

help:
	@sed -n 's/^#   //p; /^# Settings/s/^# //p' Makefile

# ------------------------------------------------------------------------------------------------------------- set-up

UNITY_ROOT ?= $(BUILD)/unity
UNITY := $(UNITY_ROOT)/unity.c
PACKAGE := $(VENV)/package.stamp
MODEL := $(BUILD)/model

# One at a time: whoever has waited for the lock finds all done.
setup:
	@mkdir -p $(BUILD)
	@flock $(BUILD)/setup.lock $(MAKE) --no-print-directory --silent SETTING_UP=1 system $(PACKAGE) $(UNITY)

system:
	@PYTHON="$(PYTHON)" BROWSER="$(BROWSER)" tools/setup/system.sh

python: $(PACKAGE)

PIP_INSTALL = $(BIN)/python -m pip install --require-hashes --only-binary :all: --progress-bar off

ifdef SETTING_UP
# Of stated hashes, and nothing that would have to be built by what has none. The venv's own pip is replaced as well.
$(VENV)/requirements.stamp: tools/requirements.txt | system
	@echo "Python packages into $(VENV) (a minute or two)"
	@$(PYTHON) -m venv --clear $(VENV)
	$(PIP_INSTALL) --requirement tools/requirements.txt
	@touch $@

# Installed in place: Python sources need no new set-up, C and C++ ones do.
$(PACKAGE): $(VENV)/requirements.stamp tools/pyproject.toml tools/CMakeLists.txt \
            $(wildcard tools/bindings/*.* tools/bindings/*/* host_sim/* lib/*.[ch] port/*.h port/app/app* port/replay/*)
	@echo "selfcal into $(VENV): its C and C++ is compiled (a minute)"
	$(BIN)/python -m pip install --no-build-isolation --no-deps --editable tools
	@touch $@

ifeq ($(UNITY_ROOT),$(BUILD)/unity)
$(UNITY): tools/setup/unity.py | system
	@echo "Unity into $(UNITY_ROOT) (half a minute)"
	$(PYTHON) tools/setup/unity.py $(UNITY_ROOT)
	@touch $@
endif
else
$(PACKAGE) $(UNITY): setup ;
endif

# The wheel out of the archive, so that both are whole.
.PHONY: wheel
wheel: setup
	@rm -rf $(BUILD)/wheel && mkdir -p $(BUILD)/wheel
	cd tools && ../$(BIN)/python -c 'import scikit_build_core.build as build; build.build_sdist("../$(BUILD)/wheel")'
	$(BIN)/python -m pip wheel --no-build-isolation --no-deps --wheel-dir $(BUILD)/wheel $(BUILD)/wheel/*.tar.gz

# Versions and hashes anew, from the names in tools/pyproject.toml. A package that has a version keeps it: UPGRADE=1
# takes the newest of all, UPGRADE=numpy of one.
UV_COMPILE = ../$(BUILD)/lock/bin/uv pip compile --quiet --universal --generate-hashes \
             --custom-compile-command "make lock" \
             $(if $(filter 1,$(UPGRADE)),--upgrade,$(UPGRADE:%=--upgrade-package %))
lock:
	@mkdir -p $(BUILD) && $(PYTHON) -m venv --clear $(BUILD)/lock
	$(BUILD)/lock/bin/python -m pip install --quiet --require-hashes --only-binary :all: \
	    --requirement tools/setup/lock.txt
	cd tools && $(UV_COMPILE) --group build --output-file requirements.txt pyproject.toml
	cd tools && for group in $(filter-out all,$(OPTIONAL)); do $(UV_COMPILE) --group $$group \
	    --python-version 3.11 --constraint requirements.txt --output-file requirements-$$group.txt || exit 1; done
	cd tools && $(UV_COMPILE) --all-extras --constraint requirements.txt --constraint requirements-dev.txt \
	    --output-file requirements-all.txt pyproject.toml

# What not everybody needs, each by itself: tools of checks and tests, all extras, and groups of tools/pyproject.toml.
OPTIONAL := dev all rivals cluster packages docs
.PHONY: $(OPTIONAL:%=setup-%)
$(OPTIONAL:%=setup-%): setup-%: setup
	@flock $(BUILD)/setup.lock $(MAKE) --no-print-directory --silent SETTING_UP=1 $(VENV)/$*.stamp
$(OPTIONAL:%=$(VENV)/%.stamp): $(VENV)/%.stamp: tools/requirements-%.txt $(VENV)/requirements.stamp
	@echo "Python packages of setup-$* into $(VENV) (a minute)"
	$(PIP_INSTALL) --requirement $<
	@touch $@

$(MODEL)/selfcal_model.c: $(PACKAGE) $(wildcard tools/selfcal/*.py tools/selfcal/verbs/codegen.py) \
                          $(wildcard tools/selfcal/models/*.yaml)
	$(BIN)/selfcal codegen tools/selfcal/models/default.yaml -o $(MODEL)

# The pages as they lie in the repository, so that each link between them holds. A broken one fails.
.PHONY: docs
docs: setup-docs
	rm -rf $(BUILD)/docs && mkdir -p $(BUILD)/docs/src
	git ls-files -z | xargs -0 cp --parents -t $(BUILD)/docs/src
	cd tools/docs && NO_MKDOCS_2_WARNING=1 $(abspath $(BIN))/python -m mkdocs build

# ---------------------------------------------------------------------------------------------------------------- run

run: setup
	@mkdir -p $(BUILD)/run
	$(BIN)/selfcal replay --json $(BUILD)/run/report.json --plot $(BUILD)/run/report.png -- "$$RECORDING"

# The firmware for this machine, of the default model; `selfcal replay` builds its own for each recording's rate.
posix: $(MODEL)/selfcal_model.c
	@$(MAKE) --no-print-directory -f port/posix/posix.mk posix MODEL_DIR=$(MODEL) OUT=$(BUILD)/posix

# -------------------------------------------------------------------------------------------------------------- tests

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
TESTS_FIXED := $(foreach test,fixed block bank snapshot check intake,$(BUILD)/c/fixed/test_$(test))

test: setup-dev setup-all
	@$(BIN)/python tests/run.py

quick: setup-dev
	@$(BIN)/python tests/run.py --quick

# The matrices are small: a BLAS with threads burns a core and is no faster.
soak tolerances emulate campaigns calibration cases: export OPENBLAS_NUM_THREADS := 1

# What `make test` leaves out. When each last ran, and on which commit, stands in tests/long_runs.txt.
LONG = $(BIN)/python tests/long_run.py $(if $(QUICK)$(ONLY)$(TIMES),--part) $@
PYTEST := $(BIN)/python -m pytest -q --config-file=tools/pyproject.toml --rootdir=.

# Seeds from the date unless SEED is given.
hidden: setup-dev
	nice $(BIN)/python tests/hidden/$(if $(RIVALS),rivals,judge).py --records $(or $(RECORDS),20) --classes $(CLASSES) \
	    $(SEED:%=--seed %) $(RATE:%=--rate %) $(SAVE:%=--save %) $(if $(TSOUTLIERS),--tsoutliers)

# Goes on where an earlier run of this commit ended.
hidden-physics: setup-dev
	nice $(BIN)/python tests/hidden/physics_judge.py --records $(or $(RECORDS),10) $(if $(KINDS),--kinds $(KINDS)) \
	    $(if $(SIZES),--sizes $(SIZES)) $(SEED:%=--seed %) $(if $(RATE),--rate $(RATE)) $(SECONDS:%=--seconds %) \
	    $(if $(OUT),--out $(OUT))

false-alarms: setup-dev
	nice $(BIN)/python tests/hidden/false_alarms.py $(RECORDS:%=--records %) $(SEED:%=--seed %) $(RATE:%=--rate %)

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

# Records of each kind of disturbed log; `make test` looks at a few.
cases: setup-dev setup-all
	SELFCAL_CASES=$(or $(RECORDS),1) $(BIN)/python tests/long_run.py $(if $(RECORDS),--part) $@ \
	    $(PYTEST) -s -n 2 tests/cases tests/tools/test_docs.py

campaigns: setup-dev
	@rm -f $(BUILD)/campaigns.txt
	SELFCAL_CAMPAIGN=$(or $(TIMES),10) $(LONG) $(PYTEST) \
	    tests/port/test_firmware_faults.py tests/port/test_firmware_commands.py tests/port/test_firmware_m0.py \
	    tests/tools/test_hostile.py
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

# --------------------------------------------------------------------------------------------------------------- fuzz

# Small grids and batches: an execution is some 0.2 ms. trace-cmp finds magic numbers, which the harness has none of.
.PHONY: fuzz
KERNEL ?= float
FUZZ := $(BUILD)/fuzz/$(KERNEL)
FUZZ_SIZES := -DSELFCAL_AXES_MAX=3 -DSELFCAL_TERMS_MAX=3 -DSELFCAL_HYPOTHESES_MAX=6 -DSELFCAL_GRID_MAX=6 \
    -DSELFCAL_BATCH=8 -DSELFCAL_REPORT_QUALITY=0 -DSELFCAL_ALPHA_MAX=6 -DSELFCAL_HYPOTHESIS_NODES_MAX=36 \
    -DSELFCAL_NODES_MAX=216 -DSELFCAL_RETIRE_BLOCKS=4 -DSELFCAL_REGRESSORS_MAX=2
RUNS ?= 10000000

# RUNS executions, or SECONDS seconds, beginning with the inputs found before. A failing input is left in
# build/fuzz/KERNEL: run fuzz_api there on it.
fuzz: $(FUZZ)/fuzz_api
	@mkdir -p $(FUZZ)/corpus
	ASAN_OPTIONS=quarantine_size_mb=1:detect_leaks=0 $(FUZZ)/fuzz_api -max_len=400 -timeout=20 \
	    -artifact_prefix=$(FUZZ)/ -print_final_stats=1 -entropic=0 -verbosity=0 \
	    $(if $(SECONDS),-max_total_time=$(SECONDS),-runs=$(RUNS)) $(FUZZ)/corpus tests/fuzz/found

# -march=native: fused multiply-adds are no calls.
$(BUILD)/fuzz/%/fuzz_api: tests/fuzz/fuzz_api.c $(wildcard lib/*.[ch]) | $(MODEL)/selfcal_model.c
	@mkdir -p $(@D)
	clang -std=c99 -O2 -g -march=native -ffp-contract=off -Ilib -I$(MODEL) $(FUZZ_SIZES) \
	    $(patsubst fixed,-DSELFCAL_FIXED,$(filter fixed,$*)) \
	    '-DSELFCAL_ASSERT(condition)=((condition) ? (void)0 : __builtin_trap())' \
	    -fsanitize=fuzzer,address,undefined,float-cast-overflow -fno-sanitize-recover=all \
	    -fno-sanitize-coverage=trace-cmp $(filter %.c,$^) -lm -o $@

# ----------------------------------------------------------------------------------------------------------- firmware

.PHONY: firmware firmware-images flash
WANTED := $(filter $(or $(TARGET),$(BOARDS)),$(BOARDS))
NOT_ALL := ACCEPT=1 takes the figures of all images as they are: no TARGET, no SENSOR, no CFLAGS
# The default sensor is the default model's; another one has a part's file that begins with its name.
OTHER_SENSOR := $(filter-out adis16405,$(SENSOR))
IMAGES = $(BUILD)/$(1)$(OTHER_SENSOR:%=-%)
PART := tools/selfcal/models/parts/$(OTHER_SENSOR)
SENSOR_MODEL := $(firstword $(if $(OTHER_SENSOR),$(wildcard $(PART)*.yaml) $(PART).yaml) \
                            tools/selfcal/models/default.yaml)

firmware: setup-dev firmware-images $(if $(ACCEPT),bench-images)
	@$(if $(WANTED),,$(error TARGET=$(TARGET): there are $(BOARDS)))$(BIN)/python tests/bench/image_sizes.py \
	    --sensor $(SENSOR) $(WANTED)
	@$(if $(ACCEPT),$(if $(TARGET)$(OTHER_SENSOR)$(CFLAGS),$(error $(NOT_ALL))))
	@$(if $(ACCEPT),$(BIN)/python tests/bench/bench.py --accept)

define FIRMWARE_IMAGE
.PHONY: image-$(1)
image-$(1): $(IMAGES)/model/selfcal_model.c
	@$$(MAKE) --no-print-directory -s -f port/$(1)/$(1).mk $(1) SENSOR=$(SENSOR) \
	    TARGET=$(1) MODEL_DIR=$(IMAGES)/model OUT=$(IMAGES)
$(IMAGES)/model/selfcal_model.c: $(MODEL)/selfcal_model.c $(SENSOR_MODEL)
	$(BIN)/selfcal codegen $(SENSOR_MODEL) -o $$(@D) --target $(CORE_$(1))
endef
$(foreach target,$(BOARDS),$(eval $(call FIRMWARE_IMAGE,$(target))))
firmware-images: $(WANTED:%=image-%)

flash: setup
	@tools/setup/flash.sh "$(TARGET)"

# -------------------------------------------------------------------------------------------------------------- bench

.PHONY: bench bench-counts bench-images
BENCH := $(BUILD)/bench
BENCH_C := $(wildcard lib/*.c tests/bench/*.c) $(wildcard port/app/app*.c)
BENCH_H := $(wildcard lib/*.h tests/bench/*.h port/*.h port/app/*.h)
ARM_FAST += tests/bench/%
MAP_cortex-m4f := FLASH_ORIGIN=0x08000000,--defsym=RAM_BYTES=0x20000
# 4 KB more than the part has: the measuring and its records take some of it.
MAP_cortex-m0 := FLASH_ORIGIN=0,--defsym=RAM_BYTES=0x9000

bench: setup-dev bench-images firmware-images $(BENCH)/host/O2/bench $(BENCH)/host/O3-avx2/bench
	@$(BIN)/python tests/bench/bench.py --host $(if $(ACCEPT),--accept)

# What is exact, alone.
bench-counts: bench-images firmware-images
	@$(BIN)/python tests/bench/bench.py

BENCH_LINK := arm-none-eabi-gcc -nostartfiles -T tests/bench/image.ld -Wl,--gc-sections
define BENCH_IMAGE
bench-images: $(BENCH)/$(1)/image.elf $(BENCH)/$(1)/module.elf
$(BENCH)/$(1)/selfcal_model.c: $(MODEL)/selfcal_model.c
	$(BIN)/selfcal codegen tools/selfcal/models/default.yaml -o $$(@D) --target $(1)
$(BENCH)/$(1)/objects.stamp: $(BENCH_C) $(BENCH_H) $(BENCH)/$(1)/selfcal_model.c port/arm.mk port/library.mk
	@rm -rf $$(@D)/objects
	@$$(MAKE) --no-print-directory -f port/library.mk objects CORE=$(1) MODEL_DIR=$$(@D) OUT=$$(@D)/objects
	$$(call arm_objects,$(ARM_$(1)) -Ilib -Iport -Iport/app -I$$(@D),\
	    $(filter-out lib/%,$(BENCH_C)) $$(@D)/selfcal_model.c,$$(@D)/objects)
	@touch $$@
# Either main: the library's in bench.c, the application's in module.c.
$(BENCH)/$(1)/image.elf: LEFT_OUT := module app% more
$(BENCH)/$(1)/module.elf: LEFT_OUT := bench paper_float more
$(BENCH)/$(1)/image.elf $(BENCH)/$(1)/module.elf: $(BENCH)/$(1)/objects.stamp tests/bench/image.ld
	$(BENCH_LINK) $(ARM_$(1)) -Wl,-Map=$$(@:.elf=.map),--defsym=$(MAP_$(1)) \
	    $$(patsubst %,$$(@D)/objects/%.o,$$(filter-out $$(LEFT_OUT),$(notdir $(BENCH_C:.c=)) selfcal_model)) -lm -o $$@
endef
$(eval $(call BENCH_IMAGE,cortex-m4f))
$(eval $(call BENCH_IMAGE,cortex-m0))

# more.c without regressors' code, with it, and with the laws that are sums.
MORE_plain := -DBENCH_PLAIN -DSELFCAL_REGRESSORS_MAX=6
MORE_regressors := -DSELFCAL_REGRESSORS_MAX=6
MORE_sums := -DSELFCAL_TERMS_MAX=3 -DBENCH_SUMS
define BENCH_MORE
bench-images: $(BENCH)/$(1)/$(2).elf
$(BENCH)/$(1)/$(2).elf: $(BENCH_C) $(BENCH_H) $(BENCH)/$(1)/selfcal_model.c port/arm.mk port/library.mk \
                        tests/bench/image.ld
	@rm -rf $$(@D)/$(2)
	@$$(MAKE) --no-print-directory -f port/library.mk objects CORE=$(1) MODEL_DIR=$$(@D) OUT=$$(@D)/$(2) \
	    PROGRAM_FLAGS='$(MORE_$(2))'
	$$(call arm_objects,$(ARM_$(1)) $(MORE_$(2)) -Ilib -I$$(@D),\
	    $(addprefix tests/bench/,count.c image.c more.c record.c) $(BENCH)/$(1)/selfcal_model.c,$$(@D)/$(2))
	$(BENCH_LINK) $(ARM_$(1)) -Wl,--defsym=$(MAP_$(1)) $$(@D)/$(2)/*.o -lm -o $$@
endef
$(foreach core,cortex-m4f cortex-m0,$(foreach what,plain regressors sums,$(eval $(call BENCH_MORE,$(core),$(what)))))

$(BENCH)/host/O2/bench: HOST := -O2
$(BENCH)/host/O3-avx2/bench: HOST := -O3 -mavx2 -mfma
$(BENCH)/host/%/bench: tests/bench/host.cpp host_sim/textbook_bank.cpp tests/bench/record.c $(wildcard lib/*.c) \
                       $(MODEL)/selfcal_model.c $(BENCH_H) $(wildcard host_sim/*.hpp)
	@mkdir -p $(@D)
	cd $(@D) && gcc $(HOST) -std=c99 -ffp-contract=off $(WARNINGS) -I$(BACK)/lib -I$(BACK)/$(MODEL) \
	    -c $(filter %.c,$(^:%=$(BACK)/%))
	g++ $(HOST) -std=c++17 $(WARNINGS_DOUBLE) -Ilib -Ihost_sim -I$(MODEL) -isystem /usr/include/eigen3 \
	    $(filter %.cpp,$^) $(@D)/*.o -pthread -o $@

# ------------------------------------------------------------------------------------------------------------- checks

CHECKS := check-tidy check-gcc check-clang check-arm check-c++ check-tokens check-house check-format check-ruff \
          check-mypy
.PHONY: $(CHECKS)
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
STRING_H := $(shell echo "$(HASH)include <string.h>" | arm-none-eabi-gcc -M -E - | grep -om1 "/[^ ]*/string.h")
TIDY_ARM_FLAGS := -std=c99 --target=arm-none-eabi -isystem $(dir $(STRING_H))
tidy = @$(1) 2>&1 | { ! grep -vE '^[0-9]+ warnings? generated|^Suppressed|^Use -header-filter'; }
TIDY_CPU_cortex-m4f := -mcpu=cortex-m4
TIDY_CPU_cortex-m0 := -mcpu=cortex-m0
check-tidy: $(MODEL)/selfcal_model.c $(BOARDS:%=check-tidy-%)
	$(call tidy,$(TIDY) $(filter-out $(MODEL)/%,$(C_ALL)) -- -std=c99 $(INCLUDES))
	$(call tidy,$(TIDY) $(wildcard lib/*.c) -- -std=c99 $(INCLUDES) -DSELFCAL_FIXED -DSELFCAL_TERMS_MAX=3)
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
check-house: setup-dev
	@$(BIN)/python tests/count_house.py

# The layout of C, C++ and Python.
.PHONY: format
FORMATTED = $(shell find lib port host_sim tests tools -name '*.[ch]' -o -name '*.[ch]pp' -o -name '*.ino')
format: setup-dev
	@$(BIN)/clang-format -i $(FORMATTED)
	@$(BIN)/ruff format --quiet --config tools/pyproject.toml tools tests host_sim
check-format: setup-dev
	@$(BIN)/clang-format --dry-run -Werror $(FORMATTED)
	@$(BIN)/ruff format --quiet --check --config tools/pyproject.toml tools tests host_sim

check-ruff: setup-dev
	@$(BIN)/ruff check --quiet --config tools/pyproject.toml tools tests host_sim

check-mypy: setup-dev
	@cd tools && ../$(BIN)/mypy --no-error-summary
	@MYPYPATH=host_sim $(BIN)/mypy --no-error-summary --config-file tools/pyproject.toml tests/run.py tests/long_run.py \
	    tests/count_house.py tests/bench/bench.py tests/bench/image_sizes.py
	@cd tools && ../$(BIN)/mypy --no-error-summary \
	    $(addprefix ../tests/hidden/,generator.py judge.py rivals.py false_alarms.py \
	    evidence.py physics.py physics_judge.py)
	@$(BIN)/mypy --no-error-summary --config-file tools/pyproject.toml --untyped-calls-exclude=unicorn host_sim/parts

clean:
	rm -rf $(BUILD)
