# SPDX-License-Identifier: Apache-2.0

"""Shared by all benchmarks: timing of calls, and the report of what was measured.

A report is tables on the terminal, a figure NAME.png, a last line of key=value pairs, and an entry
of results.json: those pairs, the tables that documents quote, machine, day and commit. Full runs
write docs/, which is tracked; QUICK=1 writes build/benchmarks/, which is ignored.
"""

from __future__ import annotations

import json
import os
import platform
import re
import statistics
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from tactile_cdma.config.parameters import Value, read_file
from test.support.domains import own_domain

from . import style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

T = TypeVar("T")
QUICK = os.environ.get("QUICK", "") not in ("", "0")
"""A result within 40 s: fewer repetitions, wider error bars."""
ROOT = Path(__file__).resolve().parent.parent


class Report:
    """Collects the tables of a benchmark; `finish` writes the files and prints the last line."""

    def __init__(self, name: str, title: str, quick: bool = QUICK) -> None:
        """name: of the make target and of the files. title: one line, above the tables."""
        self.name, self.title, self.quick = name, title, quick
        self.tables: list[list[list[Any]]] = []
        self._started = time.monotonic()
        print(f"{title}{' (quick)' if quick else ''}")

    def table(
        self, headers: Sequence[str], rows: Sequence[Sequence[object]], keep: bool = True
    ) -> None:
        """Print a table. keep: in results.json, of which documents quote figures.

        Pictures that are drawn from kept tables alone can be drawn anew without a run.
        """
        cells = [list(headers)] + [[_text(value) for value in row] for row in rows]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        for row in cells:
            print("  ".join(text.rjust(width) for text, width in zip(row, widths, strict=True)))
        print()
        if keep:
            self.tables.append([list(headers), *(list(map(_short, row)) for row in rows)])

    def finish(self, figure: Figure, **results: float | int | str) -> None:
        """Write figure and JSON; print the results as the last line."""
        folder = ROOT / ("build/benchmarks" if self.quick else "docs")
        picture, kept = folder / "img" / f"{self.name}.png", folder / "results.json"
        style.save(figure, picture)
        content = json.loads(kept.read_text(encoding="utf-8")) if kept.exists() else {}
        content[self.name] = {
            "title": self.title,
            "quick": self.quick,
            "seconds": round(time.monotonic() - self._started, 1),
            "machine": machine(),
            "date": time.strftime("%Y-%m-%d"),
            "commit": commit(),
            "results": {key: _short(value) for key, value in results.items()},
            "tables": self.tables,
        }
        kept.write_text(_json(content) + "\n", encoding="utf-8")
        print(f"written: {picture}, {kept}")
        print(" ".join(f"{key}={_text(value)}" for key, value in results.items()))


def rows_of(tables: Sequence[list[list[Any]]], first: str) -> list[list[Any]]:
    """Return the rows of the table whose first column has this heading."""
    return next(table[1:] for table in tables if table[0][0] == first)


def machine() -> dict[str, str | int | None]:
    """Return the machine and versions that the figures belong to."""
    model = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next(line.split(":", 1)[1].strip() for line in lines if "model name" in line)
    except (OSError, StopIteration):
        pass
    return {
        "cpu": model,
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "numpy": np.__version__,
    }


def configured(name: str) -> dict[str, Value]:
    """Return the parameters of a file of config/, for any port, and the simulator's amplifier."""
    values = read_file(ROOT / "config" / f"{name}.yaml")
    return {key: value for key, value in values.items() if key not in ("port", "amplitude_mv")}


def be_alone() -> None:
    """Give the ROS nodes of this run a domain of their own, on this machine only."""
    os.environ["ROS_DOMAIN_ID"] = str(own_domain())
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"


def commit() -> str:
    """Return the commit that was measured, with a + if files differ from it; or nothing."""
    command = ["git", "-C", str(ROOT), "describe", "--always", "--dirty=+", "--exclude=*"]
    try:
        return subprocess.run(command, capture_output=True, text=True).stdout.strip()
    except OSError:
        return ""


def medians_s(
    subjects: Mapping[str, Callable[[], object]],
    rounds: int,
    least_s: float = 2e-3,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, float]:
    """Median time of one call of each subject, s.

    Every round measures all subjects in turn, because the speed of a machine drifts: what is
    compared was measured at the same time. least_s: duration of one measurement, which repeats
    its subject as often as that takes.
    """
    repeats = {}
    for name, call in subjects.items():
        call()  # warm up
        started = clock()
        call()
        repeats[name] = max(1, int(least_s / max(clock() - started, 1e-9)))
    times: dict[str, list[float]] = {name: [] for name in subjects}
    for _ in range(rounds):
        for name, call in subjects.items():
            started = clock()
            for _ in range(repeats[name]):
                call()
            times[name].append((clock() - started) / repeats[name])
    return {name: statistics.median(values) for name, values in times.items()}


def in_turn(update: Callable[[T, float], object], frames: Sequence[T]) -> Callable[[], object]:
    """Return a function that has one frame after the other processed, 20 ms apart."""
    numbers = count(1)

    def give() -> object:
        number = next(numbers)
        return update(frames[number % len(frames)], number * 20e-3)

    return give


def _text(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _short(value: Any) -> Any:
    """Return a figure as it is kept: five digits, and of numpy's types the plain one."""
    if isinstance(value, np.generic):
        value = value.item()
    return float(f"{value:.5g}") if isinstance(value, float) else value


def _json(value: object) -> str:
    """JSON with one line for each list of plain values, as rows of tables are."""
    text = json.dumps(value, indent=1, ensure_ascii=False)
    return re.sub(r"\[\n[^][{}]*\]", lambda found: re.sub(r"\n *", " ", found[0]), text)
