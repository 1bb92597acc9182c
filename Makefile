# Needs only make and Python 3.11 or newer; every target creates .venv and installs what it needs.
# ARGS="..." is handed on to the command behind a target.

# make test CONSTRAINTS=constraints.txt: the versions that were tested together, in an environment of their own.
CONSTRAINTS :=
TESTED := .venv-tested
VENV := $(if $(CONSTRAINTS),$(TESTED),.venv)
BIN := $(VENV)/bin
FIND = for p in python3.13 python3.12 python3.11 python3; do \
	if $$p -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; \
	then echo $$p; break; fi; done
PYTHON ?= $(shell $(FIND))
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet $(addprefix --constraint ,$(CONSTRAINTS))

# Environment of a second Python: make test VENV=.venv-other PYTHON=python3.13
OTHER := .venv-other

# The oldest versions are installed beside the newest, on the oldest Python, for which they have wheels.
FLOOR := .venv-floor
FLOOR_PYTHON ?= python3.11

# One thread per process: two test processes whose linear algebra also starts threads slow each other down.
ONE_THREAD := OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 NUMBA_NUM_THREADS=1 MPLBACKEND=Agg

# A file of tests stays in one process, which makes what its tests share; the folders with long files come first.
WORKERS := -n 2 --dist loadfile --no-loadscope-reorder

.PHONY: help run test test-all floor check docs perf clean python

help: ## List the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*##/\t/'

run: $(VENV)/run.stamp ## Calibrate the simulated RAZOR bench, close the loop, write a report
	$(BIN)/escape reproduce shwfs $(ARGS)

test: $(VENV)/all.stamp ## Run the tests, with all optional packages
	@$(BIN)/python tests/system_packages.py --window
	$(ONE_THREAD) $(BIN)/python -m pytest $(WORKERS) $(ARGS)

test-all: $(VENV)/all.stamp ## Run every test, also the slow ones and the campaigns
	$(BIN)/python tests/system_packages.py --install
	$(ONE_THREAD) $(BIN)/python -m pytest $(WORKERS) -m "not hardware and not screenshots" $(ARGS)

floor: ## Run the tests with the oldest versions that pyproject.toml allows
	$(FLOOR_PYTHON) -m venv $(FLOOR)
	$(FLOOR)/bin/python .ci/floor.py > $(FLOOR)/constraints.txt
	$(FLOOR)/bin/python -m pip --disable-pip-version-check install --quiet \
		--constraint $(FLOOR)/constraints.txt --editable '.[all]'
	$(ONE_THREAD) $(FLOOR)/bin/python -m pytest $(WORKERS) -W default::DeprecationWarning $(ARGS)

check: $(VENV)/dev.stamp ## Check style, types and layers
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/mypy benchmarks/studies/*/*.py
	$(BIN)/lint-imports

docs: $(VENV)/docs.stamp ## Build the documentation into docs/_build
	$(BIN)/python -m sphinx -W -q -b html docs docs/_build
	@echo docs/_build/index.html

perf: $(VENV)/bench.stamp ## Measure speed against OOPAO and pyRTC
	$(BIN)/escape perf $(ARGS)

clean: ## Remove the environment and caches
	rm -rf $(VENV) $(TESTED) $(OTHER) $(FLOOR) .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache

python: # Say which Python the environment is made with
	@test -n "$(PYTHON)" && echo "$(PYTHON)"

$(BIN)/python:
	@test -n "$(PYTHON)" || { echo "No Python 3.11 or newer with venv found (Debian: apt install python3-venv); set PYTHON=..." >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/run.stamp: pyproject.toml $(CONSTRAINTS) | $(BIN)/python
	$(PIP) --editable .
	@touch $@

$(VENV)/%.stamp: pyproject.toml $(CONSTRAINTS) | $(BIN)/python
	$(PIP) --editable '.[$*]'
	@touch $@
