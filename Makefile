# make run     simulated skin and viewer; PORT=/dev/ttyACM0 for a real one, PARAMS=file, SECONDS=n to stop after n s
#              PATCHES=config/body.yaml: a body of many patches
#              FIRMWARE=1: the emulated skin, with real firmware on its nodes and in its digitizer
# make view    the same in the Rerun viewer, which it installs; WEB=1: in a browser
# make example-grip  a gripper in MuJoCo grips by the skin of a finger; BLIND=1: without its cue for slip; SPEED=max: without ROS
# make check   lint and the core's tests, in less than a minute; use it while you work
# make test    lint and all tests
# make portable-test  the unit tests of what needs no tty, without what Python lacks on Windows
# make mutants wrong operators in the modules changed SINCE=HEAD~1: lists those that no unit test detects; COUNT=24
# make firmware         build the images of nodes and digitizer, in firmware/build
# make firmware-test    run them in emulators, 16 nodes on one wire; the last line has the counts
# make firmware-thousand 900 fast nodes on one wire, to the pin, in half a minute; QUICK=1: 128 nodes;
#                         NODES=4000: with sparse codes, in some minutes; QUICK=1: 600 of their images
# make demo    the image that makes a Pico a skin; copied to a demonstrator, or to the board at PORT
# make demo-test  run it in an emulator, pins wired and nothing wired; the last line has the counts
# make spice            the analog circuit for 16, 64, 900 and 4,000 nodes, simulated, against what was computed
# make amplifier NODES=64  resistors, op-amps and amplitude_mv of a skin; CHIP_US=2, PARAMS=file; CIRCUIT=paper: the paper's
# make boards  checks schematics and layouts, lists parts; where KiCad is, its rules, and Gerbers in firmware/build/boards
# make scope   what an oscilloscope should show while a skin is put to work, from emulation and SPICE
# make firmware-figures measure them: share of time awake, load of the digitizer
# make setup   only create the environment in .venv; all other targets do this first
# make bench-error, -doubt, -speed, -skip, -timing, -scale, -ros, -pressure, -contact, -pictures,
#              -body, -pareto, -sparse, -batch
#              up to 7 min each, writes docs/img; QUICK=1: less than 40 s each, writes build/benchmarks
#              bench-doubt ONLY=hum: conditions with this in their name
# make paper   the paper's figures and claims beside this project's: docs/paper.md, docs/img/paper.png
# make torture faults of every kind, results compared with the truth; SEED=n, ONLY="line day"
#              up to 30 min; QUICK=1: a minute; docs/reliability.md has the results of the last full run
# make soak    the driver node in real time for SECONDS=3600
# make fuzz    hostile inputs to every reader of data: COUNT=1000000 for Python and for each C harness
# make dist    sdist and wheel of this processor, in dist/, installed in empty environments; needs no .venv
# make audit   known advisories for installed packages; upper bounds and lock files of requirements
# make lint    ruff, mypy, import-linter and lizard;  make clean: remove .venv and build products
# DISTRO=kilted with any of these: ROS 2 Kilted instead of Jazzy, in .venv-kilted

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
SEED ?= 1
COUNT ?= 1000000
SINCE ?= HEAD~1
PYTEST ?= -n 4 --dist loadgroup --timeout 900
# Folders that `make check` tests: from bytes to frames.
CORE = base code places wire words framing readings config views driver rest skin
# Folders that `make portable-test` tests: from bytes to datasets, without ttys.
PORTABLE = base code places words framing readings config views rest recording datasets sim
export LC_ALL ?= C.UTF-8
# Hundreds of processes import the same modules, which all would compile where this is set.
export PYTHONDONTWRITEBYTECODE =

# Variables of the command line, without those that exist: a misspelt one would be ignored.
VARIABLES = PYTHON DISTRO VENV PORT PARAMS PATCHES WEB BLIND SPEED SECONDS FIRMWARE ONLY NODES CHIP_US CIRCUIT SEED COUNT SINCE CORE PYTEST QUICK LC_ALL
UNKNOWN := $(filter-out $(VARIABLES),$(foreach v,$(.VARIABLES),$(if $(filter command%,$(origin $v)),$v)))
MEANT = from difflib import get_close_matches as near; from sys import argv; \
        print(*(f"; did you mean {name}?" for name in near(argv[1].upper(), argv[2:], 1)))
ifneq ($(UNKNOWN),)
$(error no variable $(firstword $(UNKNOWN))$(shell $(PYTHON) -c '$(MEANT)' $(firstword $(UNKNOWN)) $(VARIABLES)) (there are $(VARIABLES)))
endif

BIN = $(VENV)/bin
.DEFAULT_GOAL := help
.PHONY: help run example-grip check core-tests portable-test test all-tests mutants lint setup bench-setup view view-setup torture soak fuzz fuzz-setup fuzz-packages audit audit-packages clean firmware firmware-test firmware-thousand demo demo-test firmware-figures firmware-tools amplifier spice boards scope paper dist

help:
	@sed -n '/^$$/q; s/^# //p' Makefile

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

portable-test: setup
	@unset MAKEFLAGS; "$(BIN)/python" -m pytest -n 2 --dist loadgroup -q -p test.support.windows -m "not slow" --hypothesis-profile quick $(if $(filter command%,$(origin PYTEST)),$(PYTEST)) $(PORTABLE:%=test/unit/%)

test: setup fuzz-packages
	@"$(BIN)/python" tools/firmware_tools.py
	@$(MAKE) --no-print-directory -j2 lint all-tests

# Collected once, the tests are compiled when the workers collect them, which takes a third of the time.
all-tests:
	@"$(BIN)/python" -m pytest --collect-only -qq >/dev/null || true
	@unset MAKEFLAGS; "$(BIN)/python" -m pytest $(PYTEST)

# Limits of C are those that pyproject.toml gives ruff: ten paths through a function (`&&` makes none) and eight arguments.
LINT_C = --languages c --extension nonstrict --extension mccabe --CCN 10 --arguments 8 --warnings_only
# Kernel files that are being rewritten, and are looked at from then on.

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
	@"$(BIN)/python" firmware/sim/check.py

firmware-thousand: firmware
	@"$(BIN)/python" firmware/sim/thousand.py $(if $(filter-out 0,$(QUICK)),--quick) $(NODES:%=--nodes %)

amplifier: setup
	@"$(BIN)/python" firmware/analog/design_amplifier.py $(NODES:%=--nodes %) $(CHIP_US:%=--chip-us %) $(PARAMS:%=--params "%") $(CIRCUIT:%=--circuit %)

demo: firmware
	@"$(BIN)/python" tools/copy_demo.py firmware/build/rp2040/demo.uf2 "$(PORT)"

demo-test: firmware
	@"$(BIN)/python" firmware/sim/demo.py

spice: firmware-tools
	@"$(BIN)/python" firmware/analog/spice.py $(CIRCUIT:%=--circuit %)

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
