# SPDX-License-Identifier: Apache-2.0

"""Memory, threads and descriptors of a running process, and whether they grow."""

from __future__ import annotations

import os
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

SECTIONS = 12
"""Medians that a slope is fitted to: what comes and goes within a section does not bend it."""


@dataclass(frozen=True, slots=True)
class Slope:
    """Growth of memory, kB/h, and half the interquartile range of slopes between sections."""

    kb_per_h: float
    spread_kb_per_h: float

    def __str__(self) -> str:
        if np.isnan(self.kb_per_h):
            return "too short for a slope"
        return f"{self.kb_per_h:.0f} ± {self.spread_kb_per_h:.0f} kB/h"


@dataclass
class Watch:
    """Samples of a process.

    t_s, rss_kb: of every sample. alone: threads and descriptors, of samples without guests.
    """

    pid: int
    t_s: list[float] = field(default_factory=list)
    rss_kb: list[int] = field(default_factory=list)
    alone: list[tuple[int, int]] = field(default_factory=list)

    def look(self, alone: bool = True) -> None:
        """Take a sample, unless the process has ended. alone: no guests use it at the moment."""
        folder = Path("/proc") / str(self.pid)
        with suppress(OSError):
            held_kb = memory_kb(self.pid)
            threads = len(list((folder / "task").iterdir()))
            descriptors = len(list((folder / "fd").iterdir()))
            self.t_s.append(time.monotonic())
            self.rss_kb.append(held_kb)
            if alone:
                self.alone.append((threads, descriptors))

    @property
    def rss_mb(self) -> float:
        """Return the RSS of the last sample, MB."""
        return self.rss_kb[-1] / 1024 if self.rss_kb else np.nan

    @property
    def more_is_held(self) -> bool:
        """Whether even the fewest threads or descriptors lately exceed the most at first."""
        quarter = len(self.alone) // 4
        if not quarter:
            return False
        most = np.max(self.alone[:quarter], axis=0)
        return bool((np.min(self.alone[-quarter:], axis=0) > most).any())

    def slope(self, from_s: float) -> Slope:
        """Growth of memory since this time."""
        since = np.array(self.t_s) >= from_s
        return slope(np.array(self.t_s)[since], np.array(self.rss_kb, float)[since])


def memory_kb(pid: int) -> int:
    """Resident memory of a process, kB. Raises OSError if it has ended."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") // 1024


def waited_s(pid: int) -> float:
    """Time that the threads of a process have waited for a processor, s; 0 where nobody tells."""
    waited_ns = 0
    with suppress(FileNotFoundError):  # the process has ended
        for task in Path(f"/proc/{pid}/task").glob("*/schedstat"):
            with suppress(OSError, IndexError):  # the thread has ended
                waited_ns += int(task.read_text().split()[1])
    return waited_ns * 1e-9


def slope(t_s: NDArray[np.float64], kb: NDArray[np.float64]) -> Slope:
    """The Theil–Sen slope of section medians, which tolerates outliers in up to 29 % of them.

    NaN if there are fewer than two samples per section.

    t_s, kb: (m,) times and memory.
    """
    if len(t_s) < 2 * SECTIONS:
        return Slope(np.nan, np.nan)
    parts = list(zip(np.array_split(t_s, SECTIONS), np.array_split(kb, SECTIONS), strict=True))
    x = np.array([part.mean() for part, _ in parts]) / 3600
    y = np.array([np.median(part) for _, part in parts])
    first, second = np.triu_indices(SECTIONS, 1)
    slopes = (y[second] - y[first]) / (x[second] - x[first])
    low, middle, high = np.percentile(slopes, [25, 50, 75])
    return Slope(float(middle), float(high - low) / 2)
