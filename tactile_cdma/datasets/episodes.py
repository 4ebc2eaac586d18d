# SPDX-License-Identifier: Apache-2.0

"""Where episodes begin and end: whole files, intervals that are given, or a topic's marks."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from ..base.errors import CaptureError, ParameterError
from .progress import Progress
from .samples import NANO, Sample, SampleSource

EMPTY = "std_msgs/msg/Empty"
MARKS = ("std_msgs/msg/Bool", "std_msgs/msg/String", EMPTY)
"""Types of topics that mark episodes."""
FOREVER_NS = 1 << 62
"""An end that is not known yet."""
LATENESS_NS = NANO
"""Messages are read for so long after an episode's end, as they are recorded after their stamp;
chosen, far above what that takes."""


@dataclass(frozen=True, slots=True)
class Episode:
    """An interval of a source, Unix time in ns, both ends included, and what was done in it."""

    begin_ns: int
    end_ns: int
    task: str


def number_at(episodes: Sequence[Episode], time_ns: int) -> int | None:
    """Return the number of the episode that a time lies in, the first one of two; None: in none."""
    within = (n for n, e in enumerate(episodes) if e.begin_ns <= time_ns <= e.end_ns)
    return next(within, None)


def parse_interval(text: str) -> tuple[float, float]:
    """Parse START:END in s from the beginning of a file. Raises ParameterError."""
    start, colon, end = text.partition(":")
    try:
        begin_s, end_s = float(start), float(end)
    except ValueError:
        begin_s = end_s = float("nan")
    if not colon or not 0 <= begin_s < end_s < float("inf"):
        raise ParameterError(f"episode {text!r} must be START:END in s, such as 12.5:30")
    return begin_s, end_s


def find_episodes(
    source: SampleSource,
    task: str,
    intervals: Sequence[tuple[float, float]] = (),
    marks: str | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
) -> list[Episode]:
    """Find the episodes of a source, in order: given intervals, a topic's marks, else all of it.

    start_s, end_s: bounds, s from the file's beginning. Raises CaptureError where episodes overlap,
    or none is left.
    """
    bounded = start_s is not None or end_s is not None or intervals
    if bounded and not source.begin_ns:
        raise CaptureError(
            f"{source.path}: bytes alone have no times; record with tactile-cdma record"
        )
    # A stamp is the middle of a frame, before the file's first record perhaps.
    first_ns = 0 if start_s is None else source.begin_ns + round(start_s * NANO)
    last_ns = FOREVER_NS if end_s is None else source.begin_ns + round(end_s * NANO)
    if marks is not None:
        found = _marked(source.marks(marks), marks, task, source.end_ns)
    elif intervals:
        found = [
            Episode(source.begin_ns + round(a * NANO), source.begin_ns + round(b * NANO), task)
            for a, b in sorted(intervals)
        ]
    else:
        found = [Episode(first_ns, last_ns, task)]
    for one, next_ in pairwise(found):
        if next_.begin_ns < one.end_ns:
            begin_s = (next_.begin_ns - source.begin_ns) / NANO
            raise CaptureError(f"{source.path}: the episode at {begin_s:g} s begins within another")
    cut = [
        Episode(max(first_ns, one.begin_ns), min(last_ns, one.end_ns), one.task) for one in found
    ]
    if not (kept := [one for one in cut if one.begin_ns < one.end_ns]):
        raise CaptureError(f"{source.path}: no episode" + (f" in {marks}" if marks else ""))
    return kept


def samples_of(
    source: SampleSource, episodes: Sequence[Episode], progress: Progress
) -> Iterator[Sample]:
    """Yield a file's samples up to the end of its last episode; without episodes, all.

    From the file's beginning on: what is held in an episode may be known from before it.
    """
    end_ns = episodes[-1].end_ns if episodes else FOREVER_NS
    for sample in source.samples(None, end_ns + LATENESS_NS if end_ns < FOREVER_NS else None):
        passed_s = (sample.seen_ns - source.begin_ns) / NANO
        text = f"{source.path.name}: {passed_s:.0f} s" if source.begin_ns else source.path.name
        length_s = (source.end_ns - source.begin_ns) / NANO  # not above 0: the end is not known
        progress.at(passed_s / length_s if length_s > 0 else math.nan, text)
        yield sample


def _marked(marks: list[tuple[int, Any]], topic: str, task: str, end_ns: int) -> list[Episode]:
    """Find episodes by messages of Bool, String or Empty.

    Bool: true begins, false ends. String: a text begins an episode and is its task, an empty one
    ends it. Empty: each ends one episode and begins the next.
    """
    episodes: list[Episode] = []
    begun: tuple[int, str] | None = None
    for time_ns, message in marks:
        if (kind := message.__msgtype__) not in MARKS:
            raise CaptureError(f"{topic} is {kind}; marks are {', '.join(MARKS)}")
        said = True if kind == EMPTY else message.data
        if begun is not None:
            episodes.append(Episode(begun[0], time_ns - 1, begun[1]))
        begun = (time_ns, said if isinstance(said, str) else task) if said else None
    if begun is not None:
        episodes.append(Episode(begun[0], end_ns, begun[1]))
    return episodes
