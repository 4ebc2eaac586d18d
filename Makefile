# make run     simulated skin and viewer; PORT=/dev/ttyACM0 for a real one, PARAMS=file, SECONDS=n to end
# make test    lint and tests
# make setup   the environment in .venv only; everything else does this first
# make bench-error, -speed, -skip, -timing, -scale, -ros, -crest    QUICK=1: within 40 s each, else up to 7 min
# make lint    ruff and mypy;  make clean: remove .venv and what tests leave

PYTHON ?= python3
VENV ?= .venv
PORT ?=
PARAMS ?=
SECONDS ?=
PYTEST ?= -n 4
export LC_ALL ?= C.UTF-8

BIN = $(VENV)/bin
.DEFAULT_GOAL := help
.PHONY: help run test lint setup bench-setup clean

help:
	@sed -n 's/^# //p' Makefile

setup:
	@command -v $(PYTHON) >/dev/null || { echo "setup: error: no $(PYTHON); apt install python3-venv"; exit 1; }
	@$(PYTHON) tools/setup_env.py --venv "$(VENV)"

run: setup
	@"$(BIN)/python" tools/run.py --port "$(PORT)" --params "$(PARAMS)" --seconds "$(SECONDS)"

test: lint
	@"$(BIN)/python" -m pytest $(PYTEST)

lint: setup
	@"$(BIN)/ruff" check .
	@"$(BIN)/ruff" format --check --quiet .
	@"$(BIN)/mypy"

bench-setup:
	@command -v $(PYTHON) >/dev/null || { echo "setup: error: no $(PYTHON); apt install python3-venv"; exit 1; }
	@$(PYTHON) tools/setup_env.py --venv "$(VENV)" --bench

bench-%: bench-setup
	@"$(BIN)/python" -m benchmarks.$*

clean:
	rm -rf "$(VENV)" build install log dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
