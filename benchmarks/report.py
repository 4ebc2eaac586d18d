# SPDX-License-Identifier: Apache-2.0

"""What every benchmark shares: how it measures, and how it tells what it measured.

A report is a table on the terminal, a picture docs/img/<name>.png with the numbers and the machine
in docs/img/<name>.json beside it, and a last line of key=value pairs.
"""

from __future__ import annotations

import json
import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib.figure import Figure

QUICK = os.environ.get("QUICK", "") not in ("", "0")
"""Asked for a result within 40 s: fewer repetitions, wider error bars."""
IMAGES = Path(__file__).resolve().parent.parent / "docs" / "img"


class Report:
    """Collects what a benchmark found; `finish` writes it and prints the last line."""

    def __init__(self, name: str, title: str) -> None:
        """name: of the make target and of the files. title: one line, above the table."""
        self.name, self.title = name, title
        self._tables: list[dict[str, Any]] = []
        self._started = time.monotonic()
        print(f"{title}{' (quick)' if QUICK else ''}")

    def table(self, headers: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
        """Print a table and keep it for the JSON file."""
        cells = [list(headers)] + [[_text(value) for value in row] for row in rows]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        for row in cells:
            print("  ".join(text.rjust(width) for text, width in zip(row, widths, strict=True)))
        print()
        self._tables.append({"headers": list(headers), "rows": [list(row) for row in rows]})

    def finish(self, figure: Figure, **results: float | int | str) -> None:
        """Write picture and JSON; print the results as the last line."""
        IMAGES.mkdir(parents=True, exist_ok=True)
        figure.savefig(IMAGES / f"{self.name}.png", dpi=110, bbox_inches="tight")
        content = {
            "title": self.title,
            "quick": QUICK,
            "seconds": round(time.monotonic() - self._started, 1),
            "machine": machine(),
            "tables": self._tables,
            "results": results,
        }
        text = json.dumps(content, indent=1, default=_plain, ensure_ascii=False)
        (IMAGES / f"{self.name}.json").write_text(text + "\n", encoding="utf-8")
        print(" ".join(f"{key}={_text(value)}" for key, value in results.items()))


def machine() -> dict[str, str | int | None]:
    """What this was measured on."""
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


def medians_s(
    subjects: Mapping[str, Callable[[], object]],
    rounds: int,
    least_s: float = 2e-3,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, float]:
    """Median time of one call of each subject, s, all measured in turn in every round.

    In turn, because machines get slower and faster: what is compared was measured at the same
    time. least_s: each measurement repeats its subject for at least so long.
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


def _text(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _plain(value: object) -> object:
    """Scalars and arrays of numpy for json."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} does not go into JSON")
