# make demo   creates .venv, installs armctl with the viewer, and the bundled arm moves to the green target; needs Python 3.11 or later
# make test   everything: lint, types, docs, tests, examples
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
WORKERS ?= auto

export PIP_DISABLE_PIP_VERSION_CHECK := 1
export PIP_NO_INPUT := 1

.DEFAULT_GOAL := help
.PHONY: help demo test lint format types docs pytest lowest examples fuzz soak bench outputs pictures clean

help:
	@echo "make demo      the bundled arm moves to the green target and prints a report"
	@echo "make test      lint, types, docs and pytest, as follows"
	@echo "make lint      ruff (rules and format) and the import layers"
	@echo "make format    apply the fixes and the format of ruff"
	@echo "make types     pyright"
	@echo "make docs      build the pages in docs/_build"
	@echo "make pytest    tests and examples"
	@echo "make lowest    tests and examples with the lowest versions that pyproject.toml allows, in .lowest"
	@echo "make examples  only the examples"
	@echo "make fuzz      random calls, files and messages, and 10 000 motions of every kind for each arm: hours;"
	@echo "               ten minutes in all: make fuzz SEED=1 MINUTES=10"
	@echo "make soak      one hour of continuous use; memory must stay constant: make soak MINUTES=60"
	@echo "make bench     the benchmarks, one table each"
	@echo "make outputs   write the printed outputs in README and docs again"
	@echo "make pictures  draw the pictures of README and docs again"
	@echo "make clean     delete everything that these targets made"

# The environment: once, and again when pyproject.toml changes.
$(VENV)/run.stamp: pyproject.toml
	@command -v $(PYTHON) >/dev/null || { \
	  echo "there is no $(PYTHON) here; name a Python, 3.11 or later: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "armctl needs Python 3.11 or later, $(PYTHON) is $$($(PYTHON) --version); name another: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 1; }
	@$(PYTHON) -m venv $(VENV) || { \
	  echo "$(PYTHON) could not make a virtual environment in $(VENV). On Debian and Ubuntu: apt-get install python3-venv"; exit 1; }
	@echo "installing armctl, its dependencies and the viewer into $(VENV): once, half a minute to two minutes"
	@# A distribution called armctl would share the package's files and the command with mujoco-armctl.
	@$(BIN)/python -m pip uninstall --quiet --quiet --yes armctl
	@$(BIN)/python -m pip install --quiet --editable '.[view]' || { \
	  echo "pip could not install what pyproject.toml names; its reason is above. Without a network, set PIP_FIND_LINKS to a folder of wheels."; exit 1; }
	@touch $@

$(VENV)/dev.stamp: $(VENV)/run.stamp
	@echo "installing what the tests need into $(VENV): once, half a minute"
	@$(BIN)/python -m pip install --quiet --editable '.[dev]' || { \
	  echo "pip could not install the tools that pyproject.toml names under dev; its reason is above."; exit 1; }
	@touch $@

demo: $(VENV)/run.stamp
	@$(BIN)/armctl reach robot_arm_3dof

# The checks use one core each.
test:
	@$(MAKE) --no-print-directory --jobs 2 lint types docs
	@$(MAKE) --no-print-directory pytest

lint: $(VENV)/dev.stamp
	@$(BIN)/ruff check . || { echo "ruff found the above; make format fixes some of it"; exit 1; }
	@$(BIN)/lint-imports --no-logo || { echo "an import runs against the layers in pyproject.toml"; exit 1; }
	@$(BIN)/ruff format --check . || { echo "some files are not in ruff's format; make format applies it"; exit 1; }

format: $(VENV)/dev.stamp
	@$(BIN)/ruff check --fix . ; $(BIN)/ruff format .

types: $(VENV)/dev.stamp
	@$(BIN)/pyright --pythonpath $(BIN)/python || { echo "pyright found the type errors above"; exit 1; }

docs: $(VENV)/dev.stamp
	@$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build || { echo "the docs do not build; the warnings above count as errors"; exit 1; }
	@echo "docs/_build/index.html is up to date"

pytest: $(VENV)/dev.stamp
	@$(BIN)/python -m pytest -n $(WORKERS) --maxprocesses 8 --dist loadgroup || { echo "tests failed, as listed above; make pytest runs them alone"; exit 1; }

# uv installs the lowest versions; pip cannot.
.lowest/stamp: pyproject.toml
	@$(PYTHON) -m venv .lowest
	@.lowest/bin/python -m pip install --quiet uv
	@.lowest/bin/uv pip install --quiet --python .lowest/bin/python --resolution lowest-direct --editable '.[dev]'
	@touch $@

lowest: export NUMBA_CACHE_DIR := $(CURDIR)/.lowest/kernels
lowest: .lowest/stamp
	@.lowest/bin/python -m pytest -n $(WORKERS) --maxprocesses 8 --dist loadgroup || { echo "tests failed, as listed above"; exit 1; }

examples: $(VENV)/dev.stamp
	@$(BIN)/python -m pytest tests/project/test_examples.py -n $(WORKERS) --maxprocesses 8

# With MINUTES the tests take this time together. Without it they take ten minutes, and the motions go on until all are made.
fuzz: SEED ?= 0
fuzz: MOTIONS ?= $(if $(filter undefined,$(origin MINUTES)),10000,5)
fuzz: $(VENV)/dev.stamp
	@$(BIN)/python -m pytest tests/fuzz -rP -n $(WORKERS) --maxprocesses 8 --fuzz-seed $(SEED) --fuzz-minutes $(or $(MINUTES),10) --fuzz-motions $(MOTIONS)

soak: MINUTES ?= 60
soak: $(VENV)/dev.stamp
	@$(BIN)/python benchmarks/soak.py --minutes $(MINUTES)

bench outputs pictures: export ARMCTL_COMPILE_AT_ONCE := 1

bench: $(VENV)/dev.stamp
	@for file in $(filter-out benchmarks/soak.py,$(wildcard benchmarks/*.py)); do echo "== $$file"; $(BIN)/python $$file || exit 1; done

outputs: $(VENV)/run.stamp
	@$(BIN)/python docs/outputs/make.py

pictures: $(VENV)/dev.stamp
	@$(BIN)/python docs/pictures/make.py

clean:
	rm -rf $(VENV) .lowest build dist docs/_build run out .pytest_cache .ruff_cache .import_linter_cache .hypothesis MUJOCO_LOG.TXT
	find armctl tests -name __pycache__ -type d -prune -exec rm -rf {} +
