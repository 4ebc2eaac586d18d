# SPDX-License-Identifier: Apache-2.0

"""`make fuzz`: searches all targets, on all cores, for inputs that crash, hang or deceive them."""

from __future__ import annotations

import argparse
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from .search import Found, search
from .targets import TARGETS

WEIGHTS = {"packets": 40, "bodies": 20, "line": 2, "digitizer": 4, "offline": 1, "commands": 1}
"""Shares of the inputs, more for faster targets; USUAL_WEIGHT for others."""
USUAL_WEIGHT = 4
LONGEST_S = 1_000_000


def main() -> int:
    """Search; 1 if anything was found."""
    names = list(TARGETS)
    parser = argparse.ArgumentParser(prog="python -m torture.fuzz", description=__doc__)
    parser.add_argument("target", nargs="*", choices=[*names, []], help="default: all")
    parser.add_argument("--count", type=int, default=1_000_000, help="inputs in all")
    parser.add_argument("--seconds", type=int, default=LONGEST_S, help="for each target, at most")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--folder", type=Path, default=Path("build/fuzz"), help="where inputs and finds are kept"
    )
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    arguments = parser.parse_args()
    wanted = arguments.target or names
    runs = shares(wanted, arguments.count)

    def one(name: str) -> Found:
        found = search(name, arguments.folder / name, runs[name], arguments.seconds, arguments.seed)
        print(found, flush=True)
        return found

    with ThreadPoolExecutor(arguments.jobs) as pool:
        results = list(pool.map(one, sorted(wanted, key=lambda name: -runs[name])))
    finds = sum(len(found.finds) for found in results)
    print(f"inputs={sum(found.inputs for found in results)} finds={finds}")
    return int(finds > 0)


def shares(names: list[str], count: int) -> dict[str, int]:
    """Number of inputs for each target."""
    weights = {name: WEIGHTS.get(name, USUAL_WEIGHT) for name in names}
    return {name: -(-count * weight // sum(weights.values())) for name, weight in weights.items()}


if __name__ == "__main__":
    sys.exit(main())
