# SPDX-License-Identifier: Apache-2.0

"""Builds and runs the harnesses of firmware/fuzz, and classifies what they find.

With clang, libFuzzer searches for inputs that reach new code. Without clang, the kept inputs and
mutants of them are run, which finds much less.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

from . import corpus

ROOT = Path(__file__).resolve().parents[2]
FIRMWARE = ROOT / "firmware"
BUILD = FIRMWARE / "build"
SIMAVR = Path("/usr/include/simavr/sim_avr.h")
BUILD_S = 300

Kind = Literal["libfuzzer", "standalone"]
Fault = Literal["", "wrong value", "uncounted loss", "crash", "hang"]


@dataclass(frozen=True, slots=True)
class Fuzzed:
    """inputs: number run. fault: shown by the last one; said: its description."""

    inputs: int
    fault: Fault
    said: str


def best_kind() -> Kind:
    """Choose libFuzzer if this machine has it."""
    if shutil.which("clang") is None:
        return "standalone"
    asked = subprocess.run(["clang", "-print-runtime-dir"], capture_output=True, text=True)
    runtime = list(Path(asked.stdout.strip()).glob("libclang_rt.fuzzer*"))
    return "libfuzzer" if runtime else "standalone"


def harnesses() -> list[str]:
    """Names of the harnesses that can be built here; the emulated board needs simavr."""
    names = sorted(file.stem.removeprefix("fuzz_") for file in (FIRMWARE / "fuzz").glob("fuzz_*.c"))
    return [name for name in names if name != "board" or SIMAVR.exists()]


def build(target: str) -> None:
    """Build a target of firmware/Makefile; one process at a time."""
    BUILD.mkdir(exist_ok=True)
    make = ["make", "-s", f"-j{os.cpu_count()}", "-C", str(FIRMWARE), target]
    command = ["flock", str(BUILD / ".lock"), *make]
    done = subprocess.run(command, capture_output=True, text=True, timeout=BUILD_S)
    if done.returncode:
        raise RuntimeError(f"make -C firmware {target}: {done.stderr}")


def fuzz(program: Path, kind: Kind, count: int, seed: int, seconds: float, hang_s: int) -> Fuzzed:
    """Run a harness on its kept inputs and `count` new ones, for about `seconds` at most.

    program: the harness; its file name is that of the target. An input that takes hang_s is a hang.
    Seconds are those of the processor where the kind is standalone.
    """
    command = [str(program), f"-runs={count}", f"-seed={seed}"]
    command += [f"-max_total_time={seconds:.0f}", f"-timeout={hang_s}"]
    with TemporaryDirectory() as kept, TemporaryDirectory() as new:
        corpus.unpack(f"firmware_{program.name}", Path(kept))
        if kind == "libfuzzer":
            command += ["-print_final_stats=1", f"-artifact_prefix={new}/", new]
        command.append(kept)
        done = subprocess.run(command, capture_output=True, text=True, errors="replace")
    return Fuzzed(_inputs(done.stdout + done.stderr), *_fault(done.returncode, done.stderr))


def _inputs(text: str) -> int:
    found = re.search(r"number_of_executed_units: (\d+)|(\d+) inputs", text)
    return int(found[1] or found[2]) if found else 0


def _fault(returncode: int, text: str) -> tuple[Fault, str]:
    """Classify by the messages of MUST(), a sanitizer or libFuzzer."""
    if returncode == 0:
        return "", ""
    if broken := re.search(r"^\S+: (wrong value|uncounted loss): .*", text, re.MULTILINE):
        return ("wrong value" if broken[1] == "wrong value" else "uncounted loss"), broken[0]
    summary = re.search(r"^SUMMARY: .*|^.*: runtime error: .*", text, re.MULTILINE)
    said = summary[0] if summary else text[-200:]
    return ("hang" if "timeout" in said else "crash"), said
