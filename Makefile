# make demo   creates .venv, builds the compiled core, installs armctl with the viewer, and the bundled arm moves to the green target;
#             needs Python 3.11 or later; without a C++ compiler, pip installs one (zig) into .venv
# make test   lint, types, docs, and ten minutes of tests; make test-all runs the others, too
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Of the tests: one more than there are cores, for some tests wait for browsers and other processes.
WORKERS ?= $(shell expr $$(getconf _NPROCESSORS_ONLN) + 1)
# Arguments of pytest. Tests marked `full` are left out unless `make test-all` runs them; those marked `nightly` have a job of their own.
TESTS ?=
ALL := -m "not form and not nightly"
SOME := -m "not form and not nightly and not full"
FORM := tests/project/test_architecture.py tests/project/test_docstrings.py
# One process runs a file: what its tests share is made once.
BY_FILE := --dist loadfile --no-loadscope-reorder
# What is installed first: for users, or for tests as well. What all tests need comes on top of that.
EXTRA := $(if $(filter-out demo core outputs,$(or $(MAKECMDGOALS),demo)),dev,view)
PARTS_view := the dependencies and the viewer into $(VENV): once, 1 GB
PARTS_dev := the dependencies, the viewer and what the tests need into $(VENV): once, 2.0 GB
BUILD_CORE := $(BIN)/python packaging/build_backend/armctl_build.py
CXX_SOURCES := $(shell find armctl/cpp -name '*.[ch]pp')
CORE_SOURCES := CMakeLists.txt $(CXX_SOURCES)
CXX_TESTS := $(wildcard tests/cpp/*.[ch]pp)

export PIP_DISABLE_PIP_VERSION_CHECK := 1
export PIP_NO_INPUT := 1
# pip compiles no modules; Python keeps those that it imports.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help demo test test-all core build-core install-dependencies stubs sanitize lint format types docs check-docs pytest pytest-all pytest-nightly lowest examples franka-sim fuzz soak mutants bench outputs pictures clean

help:
	@echo "make demo      the bundled arm moves to the green target and prints a report"
	@echo "make test      lint, types, docs and pytest, as follows"
	@echo "make test-all  the same with the tests that make test leaves out: other robots, browsers, examples of minutes"
	@echo "make core      build the compiled core in place, armctl/_core from armctl/cpp; only what has changed is compiled"
	@echo "make stubs     write armctl/_core.pyi, the types of the compiled core"
	@echo "make sanitize  the tests of the compiled core under AddressSanitizer and UndefinedBehaviorSanitizer"
	@echo "make lint      ruff (rules and format), the import layers, clang-format, clang-tidy, the form of the source, and its size"
	@echo "make format    apply the fixes and the format of ruff and clang-format"
	@echo "make types     pyright"
	@echo "make docs      build the pages in docs/_build; make check-docs only looks for warnings"
	@echo "make pytest    tests; make pytest-all runs more, make pytest-nightly further robots, random tests and repetitions"
	@echo "make lowest    tests with the lowest versions that pyproject.toml allows, in .lowest"
	@echo "make examples  only the examples"
	@echo "make franka-sim  random motions on a simulator of Franka's controller that enforces its limits"
	@echo "make fuzz      random calls, files and messages, and 10 000 motions of every kind for each arm: hours;"
	@echo "               ten minutes in all: make fuzz SEED=1 MINUTES=10"
	@echo "make soak      one hour of continuous use; memory must stay constant: make soak MINUTES=60"
	@echo "make mutants   seed errors in the code, one at a time, and print the share that the tests find: make mutants COUNT=200"
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
	@# The tools of the build are installed first, so that the build can print what it does: pip hides what a build prints.
	@$(BIN)/python -m pip install --quiet --no-compile $$($(PYTHON) packaging/build_backend/requirements.py) || { \
	  echo "pip could not install the tools that build the compiled core; its reason is above."; exit 1; }
	@echo "installing $(PARTS_$(EXTRA)); with the core, one to four minutes in all"
	@$(MAKE) --no-print-directory --jobs 2 build-core install-dependencies EXTRA=$(EXTRA)
	@# A distribution called armctl would share the package's files and the command with mujoco-armctl.
	@$(BIN)/python -m pip uninstall --quiet --quiet --yes armctl
	@$(BIN)/python -m pip install --quiet --no-compile --no-build-isolation --editable '.[$(EXTRA)]' || { \
	  echo "pip could not install armctl; its reason is above."; exit 1; }
	@# What the first page imports is compiled here: a third of the time until it opens.
	@$(BIN)/python -c 'import armctl.view.page, armctl.view.page_server, mink, mjviser'
	@echo $(EXTRA) >$@

# Both at once: the compiler uses two cores only part of the time, and pip one.
build-core:
	@$(BUILD_CORE)

# Apart from armctl, because armctl is built without isolation, in which some of them cannot be built.
install-dependencies:
	@$(PYTHON) packaging/build_backend/requirements.py --run $(EXTRA) | $(BIN)/python -m pip install --quiet --no-compile -r /dev/stdin || { \
	  echo "pip could not install what pyproject.toml names; its reason is above. Without a network, set PIP_FIND_LINKS to a folder of wheels."; exit 1; }

$(VENV)/dev.stamp: $(VENV)/run.stamp
	@grep -q dev $< || { \
	  echo "installing what the tests need into $(VENV): once, 1 GB more, half a minute"; \
	  $(MAKE) --no-print-directory install-dependencies EXTRA=dev && \
	  $(BIN)/python -m pip install --quiet --no-compile --no-build-isolation --editable '.[dev]'; } || { \
	  echo "pip could not install the tools that pyproject.toml names under dev; its reason is above."; exit 1; }
	@touch $@

$(VENV)/ci.stamp: $(VENV)/dev.stamp
	@echo "installing what only make test-all needs into $(VENV): once, up to 6 GB, for PyTorch comes with CUDA; one to three minutes"
	@$(MAKE) --no-print-directory install-dependencies EXTRA=ci && \
	  $(BIN)/python -m pip install --quiet --no-compile --no-build-isolation --editable '.[ci]' || { \
	  echo "pip could not install the packages that pyproject.toml names under ci; its reason is above."; exit 1; }
	@touch $@

# The compiled core: again when a source changes, with the tools that run.stamp has installed.
$(VENV)/core.stamp: $(VENV)/run.stamp $(CORE_SOURCES)
	@$(BUILD_CORE)
	@touch $@

core: $(VENV)/core.stamp

stubs: $(VENV)/dev.stamp $(VENV)/core.stamp
	@$(BIN)/python -m nanobind.stubgen -q -m armctl._core -o armctl/_core.pyi
	@$(BIN)/ruff format --quiet armctl/_core.pyi

# The interpreter itself is not instrumented, so it has to load the sanitizer's library; it also frees nothing at exit.
sanitize: export ASAN_OPTIONS := detect_leaks=0
sanitize: export UBSAN_OPTIONS := print_stacktrace=1
sanitize: $(VENV)/dev.stamp $(VENV)/core.stamp
	@$(BUILD_CORE) --sanitize
	@LD_PRELOAD="$$($${CXX:-c++} -print-file-name=libasan.so) $$($${CXX:-c++} -print-file-name=libstdc++.so)" \
	  ARMCTL_SANITIZED_CORE="$$(echo build/sanitize/*/_core*.so)" $(BIN)/python -m pytest -m core -q || { \
	  echo "tests of the compiled core failed under the sanitizers, as listed above"; exit 1; }

demo: $(VENV)/core.stamp
	@$(BIN)/armctl reach robot_arm_3dof
	@echo "next: source $(BIN)/activate, then armctl view robot_arm_3dof: drag the target in the browser"

# The checks use one core each.
test:
	@$(MAKE) --no-print-directory --jobs 2 lint types check-docs
	@$(MAKE) --no-print-directory pytest

test-all: $(VENV)/ci.stamp
	@$(MAKE) --no-print-directory --jobs 2 lint types check-docs
	@$(MAKE) --no-print-directory pytest-all

lint: $(VENV)/dev.stamp $(VENV)/core.stamp
	@$(BIN)/ruff check . || { echo "ruff found the above; make format fixes some of it"; exit 1; }
	@$(BIN)/lint-imports --no-logo || { echo "an import runs against the layers in pyproject.toml"; exit 1; }
	@$(BIN)/ruff format --check . || { echo "some files are not in ruff's format; make format applies it"; exit 1; }
	@$(BIN)/clang-format --dry-run -Werror $(CXX_SOURCES) $(CXX_TESTS) || { echo "some C++ files are not in clang-format's format; make format applies it"; exit 1; }
	@# clang-tidy reads the headers of the computer's own compiler; zig's are elsewhere.
	@! command -v c++ >/dev/null || printf '%s\n' $(filter %.cpp,$(CXX_SOURCES)) | \
	  xargs -P 2 -n 4 $(BIN)/clang-tidy --quiet -p $$(ls -td build/core/* | head -1) 2>/dev/null || { \
	  echo "clang-tidy found the above"; exit 1; }
	@$(BIN)/python -m pytest -q -m form -n 0 $(FORM) || { echo "the form of the source is not that of CONTRIBUTING.md, as listed above"; exit 1; }
	@$(BIN)/python packaging/code_size.py

format: $(VENV)/dev.stamp $(VENV)/core.stamp
	@$(BIN)/ruff check --fix . ; $(BIN)/ruff format . ; $(BIN)/clang-format -i $(CXX_SOURCES) $(CXX_TESTS)

types: $(VENV)/dev.stamp $(VENV)/core.stamp
	@$(BIN)/pyright --pythonpath $(BIN)/python || { echo "pyright found the type errors above"; exit 1; }

docs: $(VENV)/dev.stamp $(VENV)/core.stamp
	@$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build || { echo "the docs do not build; the warnings above count as errors"; exit 1; }
	@echo "docs/_build/index.html is up to date"

check-docs: $(VENV)/dev.stamp $(VENV)/core.stamp
	@$(BIN)/python -m sphinx -W --keep-going -q -b dummy docs docs/_build/dummy || { echo "the docs do not build; the warnings above count as errors"; exit 1; }

pytest: $(VENV)/dev.stamp $(VENV)/core.stamp
	@echo "left out: tests of other robots, browsers, examples of minutes (make test-all), further robots, random calls (make pytest-nightly)"
	@$(BIN)/python -m pytest $(SOME) $(TESTS) -n $(WORKERS) --maxprocesses 8 $(BY_FILE) || { echo "tests failed, as listed above; make pytest runs them alone"; exit 1; }

pytest-all: $(VENV)/ci.stamp $(VENV)/core.stamp
	@$(BIN)/python -m pytest $(ALL) $(TESTS) -n $(WORKERS) --maxprocesses 8 $(BY_FILE) || { echo "tests failed, as listed above; make pytest-all runs them alone"; exit 1; }

# uv installs the lowest versions; pip cannot.
.lowest/stamp: pyproject.toml
	@$(PYTHON) -m venv .lowest
	@.lowest/bin/python -m pip install --quiet uv
	@.lowest/bin/uv pip install --quiet --python .lowest/bin/python --resolution lowest-direct --editable '.[dev]'
	@touch $@

lowest: .lowest/stamp
	@.lowest/bin/python -m pytest -n $(WORKERS) --maxprocesses 8 $(BY_FILE) || { echo "tests failed, as listed above"; exit 1; }

pytest-nightly: $(VENV)/ci.stamp $(VENV)/core.stamp
	@$(BIN)/python -m pytest -m nightly $(TESTS) -n $(WORKERS) --maxprocesses 8 $(BY_FILE) || { echo "tests failed, as listed above"; exit 1; }

examples: $(VENV)/ci.stamp $(VENV)/core.stamp
	@$(BIN)/python -m pytest tests/project/test_examples.py tests/project/test_framework_examples.py -n $(WORKERS) --maxprocesses 8

# A simulator of Franka's controller that enforces its limits; it needs older packages than armctl, so an environment of its own.
.franka-sim/stamp:
	@$(PYTHON) -m venv .franka-sim && .franka-sim/bin/pip install --quiet franka-sim==1.1.7
	@touch $@

franka-sim: $(VENV)/dev.stamp $(VENV)/core.stamp .franka-sim/stamp
	@$(BIN)/pip install --quiet --no-compile --no-build-isolation --editable '.[franka]' && $(BIN)/python -m pytest tests/run/links/test_franka_sim.py -n 0 -rP

# With MINUTES the tests take this time together. Without it they take ten minutes, and the motions go on until all are made.
fuzz: SEED ?= 0
fuzz: FIRST ?= 0
fuzz: MOTIONS ?= $(if $(filter undefined,$(origin MINUTES)),10000,5)
fuzz: $(VENV)/dev.stamp $(VENV)/core.stamp
	@$(BIN)/python -m pytest tests/fuzz -rP -n $(WORKERS) --maxprocesses 8 --fuzz-seed $(SEED) --fuzz-first $(FIRST) --fuzz-minutes $(or $(MINUTES),10) --fuzz-motions $(MOTIONS)

soak: MINUTES ?= 60
soak: $(VENV)/dev.stamp $(VENV)/core.stamp
	@$(BIN)/python benchmarks/soak.py --minutes $(MINUTES)

mutants: COUNT ?= 200
mutants: SEED ?= 0
mutants: $(VENV)/dev.stamp $(VENV)/core.stamp
	@$(BIN)/python packaging/mutants.py --count $(COUNT) --seed $(SEED) $(SUBPACKAGES)

bench: $(VENV)/dev.stamp $(VENV)/core.stamp
	@for file in $(filter-out benchmarks/soak.py,$(wildcard benchmarks/*.py)); do echo "== $$file"; $(BIN)/python $$file || exit 1; done

outputs: $(VENV)/core.stamp
	@$(BIN)/python docs/outputs/make.py

pictures: $(VENV)/dev.stamp $(VENV)/core.stamp
	@$(BIN)/python docs/pictures/make.py

clean:
	rm -rf armctl/_core*.so $(VENV) .lowest .franka-sim build dist docs/_build run out .pytest_cache .ruff_cache .import_linter_cache .hypothesis MUJOCO_LOG.TXT
	find armctl tests -name __pycache__ -type d -prune -exec rm -rf {} +
