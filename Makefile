# `make help` lists what there is. Needs make, Python >= 3.11 with venv and pip, and a package index.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Handed to every pip install; PIP_ARGS="--extra-index-url https://download.pytorch.org/whl/cpu" takes the CPU build of torch.
PIP_ARGS ?=
DEMO_ARGS ?= --realtime --episodes 10
TEST_ARGS ?=
BENCH_ARGS ?=

PIP_INSTALL = $(BIN)/python -m pip install -qq --disable-pip-version-check --no-input -c constraints.txt $(PIP_ARGS)
# A virtual environment is up to date if its stamp is newer than what was asked of pip.
VENV_STAMP := $(VENV)/pyvenv.cfg
BASE_STAMP := $(VENV)/.installed-base
DEV_STAMP := $(VENV)/.installed-dev
REQUIREMENTS := pyproject.toml constraints.txt

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo test soak mutants lint format bench clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "  make %-8s %s\n", $$1, $$2}' $(firstword $(MAKEFILE_LIST))
	@echo "  Variables: PYTHON=$(PYTHON) PIP_ARGS DEMO_ARGS TEST_ARGS BENCH_ARGS"

demo: $(BASE_STAMP) ## drive simulated robots in real time with the shipped networks (installs no torch)
	@$(BIN)/python deploy/run_loop.py $(DEMO_ARGS)

test: $(DEV_STAMP) ## run the tests, slow and real-time ones left out
	@$(BIN)/python -m pytest $(TEST_ARGS)

soak: $(DEV_STAMP) ## a million ticks of the loop under random faults (five to thirty minutes)
	@$(BIN)/python -m pytest -m slow -s tests/runtime/test_soak.py

mutants: $(DEV_STAMP) ## switch each watchdog off in turn; the test of its fault must fail
	@$(BIN)/python -m pytest -m slow tests/runtime/test_mutations.py

lint: $(DEV_STAMP) ## check style, formatting and types
	@$(BIN)/ruff check
	@$(BIN)/ruff format --check
	@$(BIN)/mypy

format: $(DEV_STAMP) ## rewrite the files in the project's style
	@$(BIN)/ruff check --fix
	@$(BIN)/ruff format

bench: $(DEV_STAMP) ## measure the speed of simulation, planning and control
	@$(BIN)/python tools/bench.py $(BENCH_ARGS)

clean: ## remove the virtual environment, build outputs and caches; runs/ stays
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV_STAMP):
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; v >= (3, 11) or sys.exit("PYTHON=$(PYTHON) is Python %d.%d; 3.11 or newer is needed" % v)'
	@echo "Creating the virtual environment $(VENV) with $(PYTHON)"
	@$(PYTHON) -m venv $(VENV)

$(BASE_STAMP): $(REQUIREMENTS) | $(VENV_STAMP)
	@echo "Installing hiernav with its base packages (about 700 MB, no torch)"
	@$(PIP_INSTALL) -e .
	@touch $@

$(DEV_STAMP): $(REQUIREMENTS) | $(VENV_STAMP)
	@echo "Installing hiernav with what training, tests and checks need (torch among them: 1 to 5 GB)"
	@$(PIP_INSTALL) -e '.[dev]'
	@touch $@ $(BASE_STAMP)
