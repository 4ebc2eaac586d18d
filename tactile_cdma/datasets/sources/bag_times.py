# SPDX-License-Identifier: Apache-2.0

"""Which times of recording in a bag are believed: one that is damaged may be centuries off."""

from __future__ import annotations

from collections.abc import Iterable

from ..samples import NANO

FAR_NS = 86_400 * NANO
"""Messages farther than this, ns, from most others were not recorded when they say. Chosen: a day,
since hardly a recorder is paused for so long, and damage or a clock that is set makes years."""


def believed_span(times_ns: Iterable[int]) -> tuple[int, int]:
    """First and last of the times, at least one, that most of them are within FAR_NS of.

    Memory does not grow with their number if they rise, as those of one file do.
    """
    runs: list[tuple[int, int, int]] = []  # first, last, number
    for time_ns in times_ns:
        first, last, number = runs[-1] if runs else (time_ns, time_ns, 0)
        if not first - FAR_NS <= time_ns <= last + FAR_NS:
            runs.append((time_ns, time_ns, 1))
            continue
        runs[-1:] = [(min(first, time_ns), max(last, time_ns), number + 1)]
    joined: list[tuple[int, int, int]] = []
    for first, last, number in sorted(runs):  # a bag of several files has runs in each
        if joined and first - joined[-1][1] <= FAR_NS:
            before = joined.pop()
            first, last, number = before[0], max(before[1], last), before[2] + number
        joined.append((first, last, number))
    first, last, _ = max(joined, key=lambda run: run[2])
    return first, last
