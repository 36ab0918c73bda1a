# Set-up, the package, its locks, and the site of the documents: a part of the Makefile.
.PHONY: setup system python lock

UNITY_ROOT ?= $(BUILD)/unity
UNITY := $(UNITY_ROOT)/unity.c
PACKAGE := $(VENV)/package.stamp
MODEL := $(BUILD)/model

# One at a time: whoever has waited for the lock finds all done.
LOCKED = flock $(BUILD)/setup.lock $(MAKE) --no-print-directory --silent SETTING_UP=1
setup:
	@mkdir -p $(BUILD)
	@$(LOCKED) system $(PACKAGE)

system:
	@PYTHON="$(PYTHON)" tools/setup/system.sh

# What checks and tests take of the system.
.PHONY: system-dev
system-dev:
	@PYTHON="$(PYTHON)" BROWSER="$(BROWSER)" tools/setup/system.sh dev

python: $(PACKAGE)

# Python compiles a module when it is first imported: most of the packages' modules never are.
PIP_INSTALL = $(BIN)/python -m pip install --no-compile --require-hashes --only-binary :all: --progress-bar off
# What builds the package, and is no part of the environment.
BACKEND := $(VENV)/backend
PIP_BUILD = PYTHONPATH="$(abspath $(BACKEND))" $(BIN)/python -m pip $(1) --no-build-isolation --no-deps \
            --config-settings=cmake.define.SELFCAL_ALL=$(2)

ifdef SETTING_UP
# Of stated hashes, and nothing that would have to be built by what has none. The venv's own pip is replaced as well.
# Its setuptools, which an older Python brings, is left out.
$(VENV)/requirements.stamp: tools/requirements.txt | system
	@echo "Python packages into $(VENV) (half a minute)"
	@$(PYTHON) -m venv --clear $(VENV)
	$(PIP_INSTALL) --requirement tools/requirements.txt
	@$(BIN)/python -m pip uninstall --quiet --yes setuptools 2>/dev/null
	@touch $@

$(BACKEND)/requirements.stamp: tools/requirements-build.txt $(VENV)/requirements.stamp
	@rm -rf $(BACKEND)
	$(PIP_INSTALL) --target $(BACKEND) --requirement tools/requirements-build.txt
	@touch $@

# Installed in place: Python sources need no new set-up, C and C++ ones do. Where tests have been set up, every build of
# the library is made.
$(PACKAGE): $(BACKEND)/requirements.stamp tools/pyproject.toml tools/CMakeLists.txt \
            $(wildcard tools/bindings/*.* tools/bindings/*/* host_sim/* lib/*.[ch] port/*.h port/app/app* port/replay/*)
	@echo "selfcal into $(VENV): its C and C++ is compiled (a minute)"
	$(call PIP_BUILD,install,$(if $(wildcard $(VENV)/builds.stamp),ON,OFF)) --editable tools
	@touch $@

$(VENV)/builds.stamp: | $(PACKAGE) $(VENV)/dev.stamp
	@echo "selfcal into $(VENV): the builds that tests compare with are compiled (half a minute)"
	$(call PIP_BUILD,install,ON) --editable tools
	@touch $@

ifeq ($(UNITY_ROOT),$(BUILD)/unity)
$(UNITY): tools/setup/unity.py | system-dev
	@echo "Unity into $(UNITY_ROOT) (half a minute)"
	$(PYTHON) tools/setup/unity.py $(UNITY_ROOT)
	@touch $@
endif
else
$(PACKAGE): setup ;
$(UNITY): setup-dev ;
endif

# What is compiled already is not compiled anew. `make cases` builds a wheel out of the archive, so that it is whole.
.PHONY: wheel
wheel: setup
	@rm -rf $(BUILD)/wheel && mkdir -p $(BUILD)/wheel
	cd tools && PYTHONPATH=../$(BACKEND) ../$(BIN)/python -c \
	    'import scikit_build_core.build as build; build.build_sdist("../$(BUILD)/wheel")'
	$(call PIP_BUILD,wheel,ON) --wheel-dir $(BUILD)/wheel ./tools

# Versions and hashes anew, from the names in tools/pyproject.toml. A package that has a version keeps it: UPGRADE=1
# takes the newest of all, UPGRADE=numpy of one.
UV_COMPILE = ../$(BUILD)/lock/bin/uv pip compile --quiet --universal --generate-hashes \
             --custom-compile-command "make lock" \
             $(if $(filter 1,$(UPGRADE)),--upgrade,$(UPGRADE:%=--upgrade-package %))
lock:
	@mkdir -p $(BUILD) && $(PYTHON) -m venv --clear $(BUILD)/lock
	$(BUILD)/lock/bin/python -m pip install --quiet --require-hashes --only-binary :all: \
	    --requirement tools/setup/lock.txt
	cd tools && $(UV_COMPILE) --group run --output-file requirements.txt pyproject.toml
	cd tools && for group in build $(filter-out all,$(OPTIONAL)); do $(UV_COMPILE) --group $$group \
	    --python-version 3.11 --constraint requirements.txt --output-file requirements-$$group.txt || exit 1; done
	cd tools && $(UV_COMPILE) --all-extras --constraint requirements.txt --constraint requirements-dev.txt \
	    --output-file requirements-all.txt pyproject.toml

# What not everybody needs, each by itself: tools of checks and tests, all extras, and groups of tools/pyproject.toml.
OPTIONAL := dev all rivals cluster packages docs
BESIDE_dev := system-dev $(UNITY) $(VENV)/builds.stamp
.PHONY: $(OPTIONAL:%=setup-%)
$(OPTIONAL:%=setup-%): setup-%: setup
	@$(LOCKED) $(VENV)/$*.stamp $(BESIDE_$*)
$(OPTIONAL:%=$(VENV)/%.stamp): $(VENV)/%.stamp: tools/requirements-%.txt $(VENV)/requirements.stamp
	@echo "Python packages of setup-$* into $(VENV) (a minute)"
	$(PIP_INSTALL) --requirement $<
	@touch $@

$(MODEL)/selfcal_model.c: $(PACKAGE) $(wildcard tools/selfcal/model/*.py tools/selfcal/wire/c_tables.py) \
                          $(wildcard tools/selfcal/model/models/*.yaml)
	$(BIN)/selfcal codegen tools/selfcal/model/models/default.yaml -o $(MODEL)

# The pages as they lie in the repository, so that each link between them holds. A broken one fails.
.PHONY: docs
docs: setup-docs
	rm -rf $(BUILD)/docs && mkdir -p $(BUILD)/docs/src
	git ls-files -z | xargs -0 cp --parents -t $(BUILD)/docs/src
	cd tools/docs && NO_MKDOCS_2_WARNING=1 $(abspath $(BIN))/python -m mkdocs build
