# Set-up, the package, its locks, and the site of the documents: a part of the Makefile.
.PHONY: setup system python lock

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

$(MODEL)/selfcal_model.c: $(PACKAGE) $(wildcard tools/selfcal/model/*.py tools/selfcal/wire/c_tables.py) \
                          $(wildcard tools/selfcal/model/models/*.yaml)
	$(BIN)/selfcal codegen tools/selfcal/model/models/default.yaml -o $(MODEL)

# The pages as they lie in the repository, so that each link between them holds. A broken one fails.
.PHONY: docs
docs: setup-docs
	rm -rf $(BUILD)/docs && mkdir -p $(BUILD)/docs/src
	git ls-files -z | xargs -0 cp --parents -t $(BUILD)/docs/src
	cd tools/docs && NO_MKDOCS_2_WARNING=1 $(abspath $(BIN))/python -m mkdocs build
