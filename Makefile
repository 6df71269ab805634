# Each target sets up what it needs: a virtual environment in .venv with the versions of constraints.txt. That happens
# once, and again only after pyproject.toml or constraints.txt have changed.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
LEROBOT := .venv-lerobot

define WRONG_PYTHON
elastic-env needs Python 3.11, 3.12 or 3.13, and "$(PYTHON)" is none of them. Name one that is, for example:
    make $(or $(firstword $(MAKECMDGOALS)),test) PYTHON=python3.11
endef
export WRONG_PYTHON

.DEFAULT_GOAL := help
# tests start hundreds of processes: without bytecode on the disk each would compile all that it imports
unexport PYTHONDONTWRITEBYTECODE
.PHONY: help demo test test-all test-lerobot lint format typecheck bench residuals docs release-check clean

help: ## Show this text
	@echo "elastic-env: robots with elastic joints, simulated, compensated, identified"
	@echo
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-13s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))
	@echo
	@echo "The first call sets up $(VENV), which takes some minutes; later calls install nothing. Variables:"
	@echo
	@echo "  make demo PYTHON=python3.12             which Python $(VENV) is made with: 3.11, 3.12 or 3.13"
	@echo "  make test ARGS='-k stiffness -x'        arguments for pytest"
	@echo
	@echo "The command line behind it: $(BIN)/elastic --help"

demo: $(STAMP) ## Testbed and walker end to end: identify the spring, compensate it, show tables and figures
	$(BIN)/elastic demo

# logical: with psutil, which dask brings, "auto" would take one worker for two threads of a core
test: $(STAMP) ## Run the tests, without network or display
	$(BIN)/python -m pytest -n logical --maxprocesses 8 --dist worksteal $(ARGS)

test-all: $(STAMP) ## Run all tests, also the slow ones: real processes, kills, long trainings
	$(BIN)/python -m pytest -n logical --maxprocesses 8 --dist worksteal -m "" $(ARGS)

# lerobot 0.4.4 pins torch below 2.11 and brings several GB of CUDA packages. Its processor needs neither: tests/lerobot has
# what it imports, beside the torch of constraints.txt. With all of lerobot's own versions:
#     python -m venv full && full/bin/pip install -e '.[lerobot]' pytest hypothesis
#     full/bin/python -m pytest -o addopts= tests/lerobot
test-lerobot: $(LEROBOT)/.installed ## Run the tests of the processor steps within LeRobot, in .venv-lerobot
	$(LEROBOT)/bin/python -m pytest -o addopts= -q tests/lerobot tests/test_lerobot.py tests/test_lerobot_recordings.py $(ARGS)

$(LEROBOT)/.installed: pyproject.toml constraints.txt tests/lerobot/requirements.txt
	$(PYTHON) -m venv --clear $(LEROBOT)
	$(LEROBOT)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt setuptools wheel
	$(LEROBOT)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt --no-build-isolation \
	    -e . pytest hypothesis requests torch
	$(LEROBOT)/bin/python -m pip install --quiet --disable-pip-version-check --no-deps -r tests/lerobot/requirements.txt
	@touch $@

lint: $(STAMP) ## Check style, format and types; changes nothing
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-cache >/dev/null || $(BIN)/lint-imports --no-cache
	$(BIN)/pyright

format: $(STAMP) ## Format the code and repair what ruff can repair
	$(BIN)/ruff check --fix-only .
	$(BIN)/ruff format .

typecheck: $(STAMP) ## Check types only
	$(BIN)/pyright

bench: $(STAMP) ## Measure the speed of the simulation, then run the benchmarks if there are any
	$(BIN)/elastic speed
	$(if $(wildcard tests/benchmarks),$(BIN)/python -m pytest -o addopts= --benchmark-only tests/benchmarks $(ARGS))

residuals: $(STAMP) ## Train every residual of the package anew and compare it with the old one; takes hours
	$(BIN)/python -m tests.residuals_anew $(ARGS)

docs: $(STAMP) ## Build the site into docs/_build/html and run the tutorials; warnings are errors
	@$(BIN)/python -c 'import furo, myst_parser, sphinx_gallery' 2>/dev/null || \
	    $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt --no-build-isolation -e '.[docs]'
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html
	@echo "Open docs/_build/html/index.html"

release-check: $(STAMP) ## Build sdist and wheel into dist/, and try the wheel in an empty environment
	$(if $(REPOSITORY),REPOSITORY=$(REPOSITORY)) $(BIN)/python -m tests.release $(ARGS)

clean: ## Remove the virtual environment and all caches; results under runs/ stay
	rm -rf $(VENV) $(LEROBOT) build dist docs/_build docs/generated *.egg-info .pytest_cache .ruff_cache .hypothesis .benchmarks MUJOCO_LOG.TXT
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# An existing .venv is kept if it has pip and the wanted Python, and made anew otherwise. Setuptools comes first and
# builds the package itself, so that this step too uses the tested version.
$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' || { echo "$$WRONG_PYTHON" >&2; exit 1; }
	@version=$$($(PYTHON) -c 'import sys; print(*sys.version_info[:2], sep=".")'); \
	case "$$($(BIN)/python -m pip --version 2>/dev/null)" in \
	    *"(python $$version)"*) ;; \
	    *) echo "Making $(VENV) with Python $$version"; $(PYTHON) -m venv --clear $(VENV) ;; \
	esac
	@echo "Installing the versions of constraints.txt into $(VENV), once; this takes some minutes"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt setuptools wheel
	$(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt --no-build-isolation -e '.[dev]'
	@touch $@
