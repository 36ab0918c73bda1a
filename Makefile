# selfcal. On a fresh machine each of these does its own set-up first:
#   make help                   this list
#   make run [RECORDING=path]   the firmware over a recording: live view, table, plot
#   make quick                  the checks, the C tests and a thin way through everything, in less than a minute
#   make test                   everything that is checked; ends with `N passed, N failed`
#   make hidden [CLASSES="step clean"] [RECORDS=n] [SEED=n] [RATE=hz] [OUT=dir] [SAVE=dir] [RIVALS=1] [TSOUTLIERS=1]
#                               effects hidden in recordings: are they named?
#   make hidden-physics [KINDS="turn_on tilt"] [SIZES=plain] [RECORDS=n] [SEED=n] [RATE=hz] [SECONDS=s] [OUT=dir]
#                               effects from physics, by a generator that knows nothing of the detector
#   make hidden-several [KINDS="step f_walk"] [RECORDS=n] [SEED=n] [OUT=dir]   one cause on several axes: named once?
#   make false-alarms [RECORDS=n] [SEED=n] [RATE=hz]
#                               clean axes: what the tests of the readings, identify and diagnose call wrong
#   make module-null [RECORDS=n] [SEED=n]   the best evidence of several axes on which nothing acts
#   make soak                   a record of 10^8 bank samples
#   make tolerances             all that must agree, as one table; fails where a tolerance is not kept
#   make calibration            ranks of the truth in the bank's posterior over thousands of records, every law
#   make emulate                20 minutes of six axes through the emulated firmware
#   make cases                  logs that went wrong, each kind on hundreds of records; two hours on two cores
#   make campaigns              every fault campaign on the firmware images at length, an hour and more
#   make format                 lay out C, C++ and Python
#   make check                  warnings, clang-tidy, ruff, mypy and house rules alone
#   make fuzz [RUNS=n | SECONDS=n] [KERNEL=fixed]
#                               random calls of the library under sanitizers, 10^7 executions
#   make firmware [TARGET=...] [SENSOR=icm42688 | SENSOR=path/mine.c] [CFLAGS=...] [NODE=n] [ACCEPT=1]
#                               build/TARGET/selfcal.elf, .bin, .hex of each board; sizes; fails above a budget.
#                               With another sensor than the ADIS16405: build/TARGET-SENSOR
#   make flash TARGET=stm32f405 writes it into a module by openocd, st-flash or dfu-util
#   make bench [ACCEPT=1]       instructions on emulated Cortex-M, bytes, ns here; fails on growth unless it is accepted
#   make setup                  the set-up alone: what `make run` takes
#   make setup-dev              what checks and tests take as well, of the system too; they run it
#   make setup-all              every extra too: readers of other programs' logs (450 MB); `make test` runs it
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

.DELETE_ON_ERROR:
.PHONY: all help run clean

all: setup

help:
	@sed -n 's/^#   //p; /^# Settings/s/^# //p' Makefile

run: setup
	@mkdir -p $(BUILD)/run
	$(BIN)/selfcal replay --json $(BUILD)/run/report.json --plot $(BUILD)/run/report.png -- "$$RECORDING"

clean:
	rm -rf $(BUILD)

# A part a room. Paths in them are from this folder.
include tools/setup/setup.mk
include port/boards.mk port/arm.mk port/firmware.mk
include tests/tests.mk tests/checks.mk tests/bench/bench.mk tests/fuzz/fuzz.mk
