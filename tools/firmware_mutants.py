#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0

"""Mutation testing of the firmware, `make firmware-mutants`: names mistakes that pass its tests.

firmware/mutants.toml has the mistakes, and the tests that have to find each. They are run in a copy
of the checkout, first without a mistake. Exit code 1 where fewer than 95 % were caught. --quick
takes every tenth.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import tomllib
from dataclasses import dataclass
from pathlib import Path

from mutants import ROOT, copy_of_checkout

TABLE = ROOT / "firmware" / "mutants.toml"
EMULATOR = Path("firmware/sim/node_modules")
LEAST_SHARE = 0.95
"""Share of the mistakes that tests have to find. Chosen: one in twenty may need a real board."""
TIMEOUT_S = 180
"""Tests that a mistake keeps busy for longer, s, have found it: ten times what they need."""
QUICK = 10
"""Every so many-th mistake is a sample that takes about a minute."""


@dataclass(frozen=True, slots=True)
class Mutant:
    """Is a mistake: the text that stands once in a file of firmware/, and what takes its place."""

    name: str
    file: str
    old: str
    new: str
    tests: list[str]
    """Tests of test/firmware."""

    def plant(self, firmware: Path) -> str:
        """Change the file; returns its text from before. Raises ValueError for an old table."""
        text = (firmware / self.file).read_text(encoding="utf-8")
        if text.count(self.old) != 1:
            raise ValueError(
                f"{TABLE.name}, {self.name}: `old` stands {text.count(self.old)} times in "
                f"{self.file}, not once; has that file changed?"
            )
        (firmware / self.file).write_text(text.replace(self.old, self.new), encoding="utf-8")
        return text


def read_table() -> list[Mutant]:
    """Read the mistakes."""
    table = tomllib.loads(TABLE.read_text(encoding="utf-8"))
    return [Mutant(**row) for row in table["mutant"]]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a sample, in about a minute")
    parser.add_argument("--only", default="", help="mistakes with this in their names")
    arguments = parser.parse_args()
    mutants = [mutant for mutant in read_table() if arguments.only in mutant.name]
    mutants = mutants[:: QUICK if arguments.quick else 1]
    with tempfile.TemporaryDirectory() as folder:
        copied = copy_of_checkout(Path(folder))
        if (ROOT / EMULATOR).is_dir():
            (copied / EMULATOR).symlink_to(ROOT / EMULATOR)
        if found(copied, sorted({test for mutant in mutants for test in mutant.tests})):
            print("firmware-mutants: error: tests fail, or are skipped, without a mistake")
            return 1
        survivors = 0
        for number, mutant in enumerate(mutants, 1):
            before = mutant.plant(copied / "firmware")
            caught = found(copied, mutant.tests)
            (copied / "firmware" / mutant.file).write_text(before, encoding="utf-8")
            survivors += not caught
            verdict = "caught  " if caught else "SURVIVED"
            print(f"{number:3}/{len(mutants)} {verdict} {mutant.name}", flush=True)
    share = 1 - survivors / len(mutants)
    print(f"mutants={len(mutants)} caught_share={share:.3f}")
    return int(share < LEAST_SHARE)


def found(copied: Path, tests: list[str]) -> bool:
    """Tell whether a test fails on the copy, or none ran."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider"]
    paths = [f"test/firmware/{test}" for test in tests]
    try:
        run = subprocess.run(
            [*command, *paths], cwd=copied, capture_output=True, text=True, timeout=TIMEOUT_S
        )
    except subprocess.TimeoutExpired:
        return True
    return run.returncode != 0 or " passed" not in run.stdout


if __name__ == "__main__":
    sys.exit(main())
