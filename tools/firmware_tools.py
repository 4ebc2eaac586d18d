#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0

"""Gets what firmware is built and emulated with: `make firmware-tools`. Standard library only.

Debian packages are installed where that needs no question (root, or sudo without a password), and
the RP2040's emulator comes from npm. What is missing and cannot be installed is named, and so is,
without --require, what `make test` will skip tests for.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

from setup_env import CHECKOUT, install

SIM = CHECKOUT / "firmware" / "sim"
NODE_VERSION = 18
PACKAGES = {  # Debian's name: what tells that it is there, a program or a file
    "gcc-avr": "avr-gcc",
    "avr-libc": "/usr/lib/avr/include/avr/io.h",
    "libsimavr-dev": "/usr/include/simavr/sim_avr.h",
    "libelf-dev": "/usr/include/libelf.h",
    "gcc-arm-none-eabi": "arm-none-eabi-gcc",
    "libnewlib-arm-none-eabi": "/usr/include/newlib/stdint.h",
    "qemu-system-arm": "qemu-system-arm",
    "cppcheck": "cppcheck",
    "avrdude": "avrdude",
    "ngspice": "ngspice",
    "make": "make",
    "gcc": "cc",
    "util-linux": "flock",
}
OPTIONAL = {  # module or program, without which tests are skipped: how to get it
    "launch_ros": "source an installation of ROS 2",
    "mujoco": "make example-grip",
    "rerun": "make view",
    "torch": "pip install torch",
    "lerobot": "pip install lerobot",
    "kicad-cli": "apt install kicad",
}


def main() -> int:
    """Install what is missing, as far as that goes; with --require, fail where it did not."""
    parser = argparse.ArgumentParser(description="Get what firmware is built and emulated with.")
    parser.add_argument("--require", action="store_true", help="missing tools are an error")
    parser.add_argument("--fuzz", action="store_true", help="libFuzzer, too, without a complaint")
    arguments = parser.parse_args()
    required = arguments.require
    install(missing())
    if arguments.fuzz:
        install_libfuzzer()
    problems = []
    if packages := missing():
        problems.append(f"sudo apt install {' '.join(packages)}")
    if problem := emulator_problem():
        problems.append(problem)
    for problem in problems:
        print(f"firmware: needed on this machine: {problem}", file=sys.stderr)
    if not required and (skipped := [*problems, *optional()]):
        print(f"make test: skips tests that need {'; '.join(skipped)}", flush=True)
    return int(required and bool(problems))


def optional() -> list[str]:
    """Return what tests can do without that this machine lacks, and how to get it."""
    return [
        f"{name} ({way})"
        for name, way in OPTIONAL.items()
        if not (find_spec(name) or shutil.which(name))
    ]


def missing() -> list[str]:
    """Return Debian names of the packages that this machine lacks."""
    return [name for name, sign in PACKAGES.items() if not present(sign)]


def present(sign: str) -> bool:
    """Tell whether a file, or a program of this name, is there."""
    return Path(sign).exists() if sign.startswith("/") else shutil.which(sign) is not None


def install_libfuzzer() -> None:
    """Install clang and the runtime of its version. Without them inputs are made by chance."""
    install([] if present("clang") else ["clang"])
    if not present("clang"):
        return
    runtime, version = (
        said_by("clang", option) for option in ("-print-runtime-dir", "-dumpversion")
    )
    if not list(Path(runtime).glob("libclang_rt.fuzzer*")):
        install([f"libclang-rt-{version.split('.')[0]}-dev"])


def emulator_problem() -> str | None:
    """Install the RP2040's emulator unless it is there; return why it cannot be had."""
    stamp, lock = SIM / "node_modules" / ".package-lock.json", SIM / "package-lock.json"
    if stamp.exists() and stamp.stat().st_mtime >= lock.stat().st_mtime:
        return None
    npm = shutil.which("npm")
    if npm is None or node_version() < NODE_VERSION:
        return f"Node.js {NODE_VERSION} or newer with npm, for the RP2040's emulator"
    print("firmware: npm ci (the RP2040's emulator)", flush=True)
    done = subprocess.run(
        [npm, "ci", "--no-audit", "--no-fund"], cwd=SIM, capture_output=True, text=True
    )
    if done.returncode:
        return f"the npm package in {SIM / 'package.json'}: {complaint(done.stderr)}"
    stamp.touch()
    return None


def node_version() -> int:
    """Return the major version of Node.js; 0: not there."""
    node = shutil.which("node")
    if node is None:
        return 0
    number = said_by(node, "--version").removeprefix("v").split(".")[0]
    return int(number) if number.isdecimal() else 0


def said_by(program: str, option: str) -> str:
    """Return what a program prints when it is asked about itself."""
    return subprocess.run([program, option], capture_output=True, text=True).stdout.strip()


def complaint(stderr: str) -> str:
    """Return the line in which npm says why: the last one only tells where its log is."""
    lines = stderr.strip().splitlines() or ["npm failed without a word"]
    errors = [line for line in lines if line.startswith(("npm error", "npm ERR!"))] or lines[-1:]
    return next((line for line in errors if "reason:" in line), errors[0])


if __name__ == "__main__":
    sys.exit(main())
