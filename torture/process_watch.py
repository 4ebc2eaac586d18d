# SPDX-License-Identifier: Apache-2.0

"""What a process holds while it runs: memory, threads, descriptors; and whether that grows."""

from __future__ import annotations

import os
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

SECTIONS = 12
"""A slope is that of so many medians: what comes and goes within a section does not bend it."""


@dataclass(frozen=True, slots=True)
class Slope:
    """Growth by time: kB per h, and half the middle range of what single pairs of sections say."""

    kb_per_h: float
    spread_kb_per_h: float

    def __str__(self) -> str:
        if np.isnan(self.kb_per_h):
            return "too short for a slope"
        return f"{self.kb_per_h:.0f} ± {self.spread_kb_per_h:.0f} kB/h"


@dataclass
class Watch:
    """Looks at a process from time to time.

    t_s, rss_kb: of every look. alone: threads and descriptors of those without guests.
    """

    pid: int
    t_s: list[float] = field(default_factory=list)
    rss_kb: list[int] = field(default_factory=list)
    alone: list[tuple[int, int]] = field(default_factory=list)

    def look(self, alone: bool = True) -> None:
        """Note what it holds now; nothing if it has ended."""
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
        """At the last look."""
        return self.rss_kb[-1] / 1024 if self.rss_kb else np.nan

    @property
    def more_is_held(self) -> bool:
        """Whether threads or descriptors are never again as few as they were, without guests."""
        quarter = len(self.alone) // 4
        if not quarter:
            return False
        most = np.max(self.alone[:quarter], axis=0)
        return bool((np.min(self.alone[-quarter:], axis=0) > most).any())

    def slope(self, from_s: float) -> Slope:
        """Of the memory, from this time on."""
        since = np.array(self.t_s) >= from_s
        return slope(np.array(self.t_s)[since], np.array(self.rss_kb, float)[since])


def memory_kb(pid: int) -> int:
    """Memory of a process. Raises OSError if it has ended."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") // 1024


def slope(t_s: NDArray[np.float64], kb: NDArray[np.float64]) -> Slope:
    """Theil and Sen's slope of medians of sections: half of them may be off, it holds. NaN if few.

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
