# SPDX-License-Identifier: Apache-2.0

"""Where the firmware is, and the programs that build it."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

import pytest

from emulated import Node
from test.support.programs import run_program

FIRMWARE = Path(__file__).resolve().parents[2] / "firmware"
CORE = FIRMWARE / "core"
KICAD = FIRMWARE / "boards" / "kicad"
SIMAVR = Path("/usr/include/simavr/sim_avr.h")
C_LIBRARIES = {"arm-none-eabi-gcc": Path("/usr/include/newlib/stdint.h")}  # packages of their own
STRICT = ("-std=gnu99", "-Wall", "-Wextra", "-Werror", "-I", str(CORE))
SANITIZE = ("-fsanitize=address,undefined", "-fno-sanitize-recover=undefined")
SANITIZED = "TACTILE_SANITIZE"
"""Environment variable, set if the core is to be built with sanitizers (test_checks.py)."""
needs_kicad = pytest.mark.skipif(
    shutil.which("kicad-cli") is None, reason="no kicad-cli on this machine (Debian 13: kicad)"
)
needs_ngspice = pytest.mark.skipif(
    shutil.which("ngspice") is None, reason="no ngspice on this machine: apt install ngspice"
)
Specimen: TypeAlias = Callable[..., Node]
"""Compiles a program of specimens.c for an MCU; returns the node that runs it."""


def need(tool: str) -> str:
    """Path of a program; skips the test where it, or a compiler's C library, is not installed."""
    path = shutil.which(tool)
    if path is None or not C_LIBRARIES.get(tool, FIRMWARE).exists():
        pytest.skip(f"no {tool} on this machine; `make firmware-tools` tells how to get it")
    return path


def run(*command: str | Path, cwd: Path | None = None, timeout: float = 300) -> str:
    """Run a command that has to succeed; return what it printed."""
    result = run_program(*command, timeout=timeout, cwd=cwd)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout
