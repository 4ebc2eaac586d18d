# SPDX-License-Identifier: Apache-2.0

"""Which times of recording in a bag are believed: one that is damaged may be centuries off."""

from collections.abc import Iterable

from ..samples import NANO

FAR_NS = 86_400 * NANO
"""Messages farther than this, ns, from most others were not recorded when they say. Chosen: a day,
since hardly a recorder is paused for so long, and damage or a clock that is set makes years."""


def believed_span(times_ns: Iterable[int]) -> tuple[int, int]:
    """First and last of the times, at least one, that most of them are within FAR_NS of.

    Memory grows with the days that they lie in, not with their number.
    """
    days: dict[int, tuple[int, int, int]] = {}  # first, last, number
    for time_ns in times_ns:
        first, last, number = days.get(time_ns // FAR_NS, (time_ns, time_ns, 0))
        days[time_ns // FAR_NS] = min(first, time_ns), max(last, time_ns), number + 1
    runs: list[tuple[int, int, int]] = []
    for first, last, number in sorted(days.values()):
        if runs and first - runs[-1][1] <= FAR_NS:
            before = runs.pop()
            first, number = before[0], before[2] + number
        runs.append((first, last, number))
    first, last, _ = max(runs, key=lambda run: run[2])
    return first, last
