# make run           a simulated skin, live in the terminal; PORT=/dev/ttyACM0: a real one; PARAMS=file; q ends
# make view          the same in the Rerun viewer, which it installs; WEB=1: in a browser
# make example-grip  a gripper in MuJoCo grips by the skin of a finger; BLIND=1: without its cue for slip; SPEED=max
# make check         lint and the core's tests, in less than a minute
#
# run and view also take PATCHES=config/body.yaml (many patches) and FIRMWARE=1 (real firmware, emulated);
# run SECONDS=n. DISTRO=kilted with any target: ROS 2 Kilted instead of Jazzy, in .venv-kilted
#
# Building a skin
#   make demo              the image that makes a Pico a skin; copies it to the board, or to the one at PORT
#   make amplifier         resistors, op-amps and amplitude_mv: NODES=64, CHIP_US=2, PARAMS=file; CIRCUIT=paper; SYNC=data
#   make boards            check schematics and layouts, list parts; with KiCad: its rules, pictures
#   make order             with KiCad: a zip per board for makers, in firmware/build/boards
#   make spice             simulate the circuit for 16 to 4,000 nodes, with cables and discharges; QUICK=1; CIRCUIT=paper; SYNC=data: one wire
#   make scope             pictures of what an oscilloscope should show
# Firmware
#   make firmware          build all images, into firmware/build
#   make firmware-test     run them in emulators, 16 nodes on one wire; make demo-test: the demonstrator; SYNC=data; SENSORS=4
#   make firmware-thousand 900 fast nodes in half a minute; NODES=4000: sparse codes, some minutes; QUICK=1: fewer
#   make firmware-body     13 patches of 72 fast nodes, whose frames begin together: 7 min; QUICK=1: 1.5 min
#   make firmware-figures  share of time awake, load of the digitizer
#   make firmware-mutants  mistakes planted in the firmware that its tests find: a quarter of an hour; QUICK=1: a minute
# Developing
#   make test              lint and all tests;  make lint: ruff, mypy, import-linter, lizard
#   make docs-check        the pages: code blocks run, commands, links and figures hold
#   make mutants           wrong operators in what changed SINCE=HEAD~1 that no test detects; COUNT=24
#   make portable-test     unit tests of what needs no tty, without what Python lacks on Windows
#   make lerobot-test      the LeRobot plugin in LeRobot 0.4 and 0.6, which it installs (gigabytes)
#   make dist              sdist and wheels in dist/, installed in empty environments
#   make audit             known advisories for installed packages
#   make setup             only create .venv, as all targets do first;  make clean: remove it and all build products
# Measuring: full runs write docs/, QUICK=1 writes build/benchmarks/ in less than 40 s each
#   make bench-NAME        NAME: batch, body, contact, doubt, edge, error, loss, pareto, pictures, pressure, rivals, ros,
#                          scale, skip, sparse, speaking, speed, timing; from 8 s (skip) to 9 min (doubt); bench-doubt ONLY=hum: a part
#   make paper             the paper's figures and claims beside this project's: docs/paper.md
#   make torture           faults of every kind against the truth, 30 min; SEED=n, ONLY="line day"; QUICK=1: two minutes
#   make soak              the driver node in real time for SECONDS=3600
#   make fuzz              hostile inputs to every reader of data: COUNT=1000000

PYTHON ?= python3
DISTRO ?=
BLIND ?=
SPEED ?=
VENV ?= .venv$(addprefix -,$(filter-out jazzy,$(DISTRO)))
PORT ?=
PARAMS ?=
PATCHES ?=
WEB ?=
SECONDS ?=
FIRMWARE ?=
ONLY ?=
NODES ?=
CHIP_US ?=
CIRCUIT ?=
SYNC ?=
SENSORS ?=
SEED ?= 1
COUNT ?= 1000000
SINCE ?= HEAD~1
PYTEST ?= -n 6 --dist loadgroup --timeout 900
# Folders that `make check` tests: from bytes to frames.
CORE = base code places wire words framing readings config views driver rest skin
# Folders that `make portable-test` tests: from bytes to datasets, without ttys.
PORTABLE = base code places words framing readings config views rest recording datasets sim
export LC_ALL ?= C.UTF-8
# Hundreds of processes import the same modules, which all would compile where this is set.
export PYTHONDONTWRITEBYTECODE =

# Variables of the command line, without those that exist: a misspelt one would be ignored.
VARIABLES = PYTHON DISTRO VENV PORT PARAMS PATCHES WEB BLIND SPEED SECONDS FIRMWARE ONLY NODES CHIP_US CIRCUIT SYNC SENSORS SEED COUNT SINCE CORE PYTEST QUICK LC_ALL
UNKNOWN := $(filter-out $(VARIABLES),$(foreach v,$(.VARIABLES),$(if $(filter command%,$(origin $v)),$v)))
MEANT = from difflib import get_close_matches as near; from sys import argv; \
        print(*(f"; did you mean {name}?" for name in near(argv[1].upper(), argv[2:], 1)))
ifneq ($(UNKNOWN),)
$(error no variable $(firstword $(UNKNOWN))$(shell $(PYTHON) -c '$(MEANT)' $(firstword $(UNKNOWN)) $(VARIABLES)) (there are $(VARIABLES)))
endif

BIN = $(VENV)/bin
.DEFAULT_GOAL := help
.PHONY: help run example-grip check core-tests docs-check portable-test lerobot-test test all-tests mutants lint setup bench-setup view view-setup torture soak fuzz fuzz-setup fuzz-packages audit audit-packages clean firmware firmware-test firmware-thousand firmware-body demo demo-test firmware-figures firmware-mutants firmware-tools amplifier spice boards order scope paper dist

help:
	@sed -n '/^$$/q; s/^# \{0,1\}//p' Makefile

setup:
	@command -v $(PYTHON) >/dev/null || { echo "setup: error: no $(PYTHON); apt install python3-venv"; exit 1; }
	@$(PYTHON) tools/setup_env.py --venv "$(VENV)" --distro "$(DISTRO)"

run: setup $(if $(filter-out 0,$(FIRMWARE)),firmware)
	@"$(BIN)/python" tools/run.py --port "$(PORT)" --params "$(PARAMS)" --seconds "$(SECONDS)" --firmware "$(FIRMWARE)" --patches "$(PATCHES)"

view-setup:
	@command -v $(PYTHON) >/dev/null || { echo "setup: error: no $(PYTHON); apt install python3-venv"; exit 1; }
	@$(PYTHON) tools/setup_env.py --venv "$(VENV)" --distro "$(DISTRO)" --extra view

view: view-setup $(if $(filter-out 0,$(FIRMWARE)),firmware)
	@"$(BIN)/python" tools/run.py --port "$(PORT)" --params "$(PARAMS)" --firmware "$(FIRMWARE)" --patches "$(PATCHES)" --rerun $(if $(filter-out 0,$(WEB)),web,window)

example-grip:
	@command -v $(PYTHON) >/dev/null || { echo "setup: error: no $(PYTHON); apt install python3-venv"; exit 1; }
	@$(PYTHON) tools/setup_env.py --venv "$(VENV)" --distro "$(DISTRO)" --extra mujoco
	@"$(BIN)/python" examples/mujoco_grip.py $(if $(filter-out 0,$(BLIND)),--blind) $(if $(filter max,$(SPEED)),--fast)

# Lint is one process for most of its time: tests run beside it, without make's jobs for makes of theirs.
check: setup
	@$(MAKE) --no-print-directory -j2 lint core-tests

core-tests:
	@unset MAKEFLAGS; "$(BIN)/python" -m pytest -n 2 --dist loadgroup -q -m "not slow" --hypothesis-profile quick $(if $(filter command%,$(origin PYTEST)),$(PYTEST)) $(CORE:%=test/unit/%)

docs-check: setup
	@"$(BIN)/python" tools/docs_check.py

portable-test: setup
	@unset MAKEFLAGS; "$(BIN)/python" -m pytest -n 2 --dist loadgroup -q -p test.support.windows -m "not slow" --hypothesis-profile quick $(if $(filter command%,$(origin PYTEST)),$(PYTEST)) $(PORTABLE:%=test/unit/%)

lerobot-test:
	@command -v $(PYTHON) >/dev/null || { echo "lerobot-test: error: no $(PYTHON)"; exit 1; }
	@$(PYTHON) tools/lerobot_test.py

test: setup fuzz-packages
	@"$(BIN)/python" tools/firmware_tools.py
	@$(MAKE) --no-print-directory -j2 lint all-tests

# Collected once, the tests are compiled when the workers collect them, which takes a third of the time.
all-tests:
	@"$(BIN)/python" -m pytest --collect-only -qq >/dev/null || true
	@unset MAKEFLAGS; "$(BIN)/python" -m pytest $(PYTEST)

# Limits of C are those that pyproject.toml gives ruff: ten paths through a function (`&&` makes none) and eight arguments.
LINT_C = --languages c --extension nonstrict --extension mccabe --CCN 10 --arguments 8 --warnings_only

lint: setup
	@"$(BIN)/ruff" check .
	@"$(BIN)/ruff" format --check --quiet .
	@"$(BIN)/mypy"
	@"$(BIN)/lint-imports" --no-logo --no-cache
	@"$(BIN)/lizard" $(LINT_C) kernel firmware/core firmware/node firmware/digitizer

mutants: setup
	@"$(BIN)/python" tools/mutants.py --since "$(SINCE)" --count $(if $(filter command%,$(origin COUNT)),$(COUNT),24) --core $(CORE)

firmware-tools: setup
	@"$(BIN)/python" tools/firmware_tools.py --require

firmware: firmware-tools
	@$(MAKE) --no-print-directory -s -C firmware
	@ls firmware/build/node/*.hex firmware/build/rp2040/*.uf2

firmware-test: firmware
	@"$(BIN)/python" firmware/sim/check.py $(SYNC:%=--sync-wire %) $(SENSORS:%=--sensors %)

firmware-mutants: firmware
	@"$(BIN)/python" tools/firmware_mutants.py $(if $(filter-out 0,$(QUICK)),--quick)

firmware-thousand: firmware
	@"$(BIN)/python" firmware/sim/thousand.py $(if $(filter-out 0,$(QUICK)),--quick) $(NODES:%=--nodes %)

firmware-body: firmware
	@"$(BIN)/python" firmware/sim/whole_body.py $(if $(filter-out 0,$(QUICK)),--quick)

amplifier: setup
	@"$(BIN)/python" firmware/analog/design_amplifier.py $(NODES:%=--nodes %) $(CHIP_US:%=--chip-us %) $(PARAMS:%=--params "%") $(CIRCUIT:%=--circuit %) $(SYNC:%=--sync-wire %)

demo: firmware
	@"$(BIN)/python" tools/copy_demo.py firmware/build/rp2040/demo.uf2 "$(PORT)"

demo-test: firmware
	@"$(BIN)/python" firmware/sim/demo.py $(SYNC:%=--sync-wire %)

spice: firmware-tools
	@"$(BIN)/python" firmware/analog/spice.py $(CIRCUIT:%=--circuit %) $(SYNC:%=--sync-wire %) $(if $(filter-out 0,$(QUICK)),--quick)

order: setup
	@"$(BIN)/python" firmware/boards/make_boards.py --order

boards: setup
	@"$(BIN)/python" firmware/boards/make_boards.py

scope: firmware
	@"$(BIN)/python" firmware/boards/scope.py

firmware-figures: firmware
	@"$(BIN)/python" firmware/sim/figures.py

bench-setup:
	@command -v $(PYTHON) >/dev/null || { echo "setup: error: no $(PYTHON); apt install python3-venv"; exit 1; }
	@$(PYTHON) tools/setup_env.py --venv "$(VENV)" --distro "$(DISTRO)" --extra bench

paper: bench-setup firmware
	@PYTHONPATH=firmware/analog:firmware/boards:firmware/sim "$(BIN)/python" -m benchmarks.paper

bench-%: bench-setup
	@"$(BIN)/python" -m benchmarks.$*

torture: fuzz-setup
	@"$(BIN)/python" -m torture $(ONLY) --seed $(SEED)

soak: setup
	@"$(BIN)/python" -m torture.load.soak --seconds $(or $(SECONDS),3600)

fuzz: fuzz-setup
	@"$(BIN)/python" -m torture.fuzz --count $(COUNT) --seed $(SEED)
	@$(MAKE) --no-print-directory -s -C firmware fuzz COUNT=$(COUNT) SEED=$(SEED)

fuzz-setup: fuzz-packages
	@# Install the tools of coverage-guided fuzzing and build the emulated images before the clock starts.
	@"$(BIN)/python" tools/firmware_tools.py --fuzz
	@$(MAKE) --no-print-directory -s -k -C firmware fuzz-harnesses replay-native node sim || true

fuzz-packages audit-packages:
	@command -v $(PYTHON) >/dev/null || { echo "setup: error: no $(PYTHON); apt install python3-venv"; exit 1; }
	@$(PYTHON) tools/setup_env.py --venv "$(VENV)" --distro "$(DISTRO)" --extra $(@:-packages=)

audit: audit-packages
	@"$(BIN)/python" tools/audit.py

dist:
	@"$(PYTHON)" tools/dist.py

clean:
	$(MAKE) -C firmware clean
	rm -rf "$(VENV)" .venv .venv-kilted build install log dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
	rm -rf firmware/sim/node_modules
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
