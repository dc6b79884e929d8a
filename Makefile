# Every target that needs the environment makes it first, once: uv where it is installed, otherwise venv and pip.
# Another interpreter: make PYTHON=python3.12 demo

PYTHON ?= python3
VENV ?= .venv
JOBS ?= 2
# For a sixth of their time the tests wait for servers, devices and clocks, so that three workers keep two processors busy; the slow ones compute,
# and a worker of theirs takes up to 6 GB.
TEST_JOBS ?= 3
PYTEST_ARGS ?=
NOTEBOOKS ?= yes

BIN := $(VENV)/bin
STAMP := $(VENV)/.hilbo-setup
DOCS_STAMP := $(VENV)/.hilbo-docs
# Installed quietly first. Where that fails, after pauses and aloud: a registry may have been silent for a moment, and pip says which
# requirements are in conflict only when it may speak.
PAUSES ?= 20 180
PIP = $(BIN)/pip install --disable-pip-version-check -c constraints.txt -e '$(WHAT)'
PATIENTLY = $(PIP) --quiet || { for pause in $(PAUSES); do sleep $$pause; $(PIP) && exit; done; exit 1; }
$(STAMP): WHAT = .[dev,hardware,live,excel,browser]
$(DOCS_STAMP): WHAT = .[docs]
PYTEST := $(BIN)/python -m pytest --dist worksteal
export PYTHONDONTWRITEBYTECODE :=  # tests begin hundreds of processes: sources are parsed once, whatever the shell says

.DEFAULT_GOAL := help
.PHONY: help setup demo firmware test test-deep lint docs notebooks wheel floors bench clean

help:  ## show the targets
	@sed -n 's/^\([a-z-]*\):.*## /  \1\t/p' $(firstword $(MAKEFILE_LIST)) | expand -t 14

setup: $(STAMP)  ## make .venv with everything that the other targets need

demo: $(STAMP)  ## re-aggregate the shipped data and run the simulated study, into demo-results/
	$(BIN)/hilbo demo --out demo-results --force

firmware:  ## the C programs of the device, and its Cortex-M images where the cross compiler is
	$(MAKE) --no-print-directory -C firmware

test: $(STAMP)  ## the tests, without the slow ones
	$(PYTEST) -n $(TEST_JOBS) -m "not deep" $(PYTEST_ARGS)

test-deep: $(STAMP)  ## all tests; with HILBO_REQUIRE_ALL=1 a skip is a failure
	$(PYTEST) -n $(JOBS) $(PYTEST_ARGS)

lint: $(STAMP)  ## ruff and pyright
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyright --pythonpath $(BIN)/python

docs: $(DOCS_STAMP)  ## the documentation as a site, into build/site; a broken link or anchor is an error; NOTEBOOKS=no runs no notebook
	$(if $(filter no,$(NOTEBOOKS)),,$(BIN)/python docs/site/notebooks.py --changed)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "open build/site/index.html"

notebooks: $(DOCS_STAMP)  ## all notebooks as .ipynb with their outputs, into build/notebooks, from where make docs takes them
	$(BIN)/python docs/site/notebooks.py

wheel:  ## the sdist and the wheel, into dist, and what a stranger does with them in fresh environments
	.ci/wheel $(PYTHON)

floors:  ## the default tests with the lowest dependencies that pyproject.toml allows
	JOBS=$(JOBS) .ci/floors $(PYTHON) $(PYTEST_ARGS)

bench: $(STAMP)  ## time hilbo against the textbook NumPy form
	$(BIN)/python benchmarks/run.py
	$(BIN)/python benchmarks/mechanics.py
	$(BIN)/python benchmarks/identification.py time

clean:  ## remove the environment, caches and results
	rm -rf $(VENV) demo-results build dist .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	  echo "hilbo needs Python 3.11 or newer and '$(PYTHON)' is not: name another one, as in 'make PYTHON=python3.12 setup'." >&2; exit 1; }
	@if command -v uv >/dev/null; then \
	  set -x; \
	  test -x $(BIN)/python || uv venv --quiet --python $(PYTHON) $(VENV); \
	  uv pip install --quiet --python $(BIN)/python -c constraints.txt -e '$(WHAT)'; \
	else \
	  test -x $(BIN)/pip || $(PYTHON) -m venv --clear $(VENV) || { \
	    echo "'$(PYTHON) -m venv' failed: install Python's venv module, on Debian the package python3-venv." >&2; exit 1; }; \
	  set -x; \
	  $(PATIENTLY); \
	fi
	@touch $@

$(DOCS_STAMP): $(STAMP)
	@set -x; if command -v uv >/dev/null; then \
	  uv pip install --quiet --python $(BIN)/python -c constraints.txt -e '$(WHAT)'; \
	else \
	  $(PATIENTLY); \
	fi
	@touch $@
