# SPDX-License-Identifier: Apache-2.0

"""Recordings and bags ──▶ one dataset: episodes on one clock, touch beside cameras."""

from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ...base.errors import CaptureError
from ..alignment import Aligner, Row, TouchStream
from ..episodes import Episode, samples_of
from ..formats import OpenWriter, RowWriter
from ..progress import Progress
from ..samples import (
    DERIVED,
    NANO,
    Kind,
    SampleSource,
    SampleStream,
    check_taxels,
    differences,
    patches_of,
)
from ..sources.opening import Wanted, has_times, open_source
from .features import cells, column, obstacle
from .meta import DatasetMeta

PAUSE_S = 10.0
"""Rows end so long after the last sample of any stream, s, until there is another: the recorder was
paused, or a time of recording is wrong. Chosen: far above the intervals of what is recorded."""
LONGEST_S = 1024
"""An episode has no rows beyond, s: from there on, float32 seconds are 122 µs apart, and LeRobot
tolerates 100 µs between the steps of its timestamps and 1 / fps."""
RATE_S = 5.0
"""How much of a file is read to learn the rate of a clock's topic, s; chosen."""
ODD_RATE = 5e-4
"""Share by which a rate is off a whole number for that to be told. Chosen: cameras of 29.97 Hz are
1e-3 off, and crystals 1e-4."""


@dataclass(frozen=True, slots=True)
class Plan:
    """Choices of an export; see docs/recording.md.

    episodes: of a file. fps: ticks per s; None with a clock: the topic whose stamps are the ticks.
    mode, policy: see alignment. from_first_complete: leave out what is before every taxel in
    service has had a valid reading.
    """

    episodes: Callable[[SampleSource], Sequence[Episode]]
    fps: int | None
    clock: str | None
    mode: str
    policy: str
    from_first_complete: bool


@dataclass(slots=True)
class Outcome:
    """What was written. left_out: rows by the reason. late: samples that missed their row."""

    episodes: int = 0
    frames: int = 0
    fps: int = 0
    left_out: Counter[str] = field(default_factory=Counter)
    late: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)


def write_dataset(
    output: Path,
    paths: Sequence[Path],
    wanted: Wanted,
    plan: Plan,
    progress: Progress,
    open_writer: OpenWriter,
) -> Outcome:
    """Write a dataset of all episodes of some files; it appears when it is complete.

    Raises CaptureError where files do not fit together or hold no episode, MissingPackageError,
    OSError.
    """
    sources = [open_source(path, wanted) for path in paths]
    for path in paths:
        if not has_times(path):
            raise CaptureError(f"{path}: bytes alone have no times, which a dataset needs")
    if not patches_of(sources[0].streams):
        raise CaptureError(f"{paths[0]}: no frames of a skin in this bag")
    layout = _Layout(sources, plan)
    meta, fps = layout.meta, layout.meta.fps
    outcome = Outcome(fps=fps)
    if abs(fast := fps / layout.rate_hz - 1) > ODD_RATE:
        outcome.notes.append(
            f"{plan.clock} has {layout.rate_hz:.2f} messages per s, and LeRobot wants a whole "
            f"number: timestamp counts {fps}, and is {abs(fast):.2%} "
            f"{'slow' if fast > 0 else 'fast'}; unix_time_ns has the true times"
        )
    outcome.notes += [
        f"{path}: no {name}, which is left out" for name, path in layout.lacking.items()
    ]
    with open_writer(output, meta.features, fps) as writer:
        files: list[str] = []
        about: list[dict[str, Any]] = []
        firsts: dict[str, dict[str, Any]] = {}  # by patch
        for source in sources:
            before = writer.frames
            _export(source, layout, writer, outcome, progress)
            if writer.frames == before:
                outcome.notes.append(f"{source.path}: no row in its episodes")
                continue
            files.append(source.path.name)
            for patch in patches_of(source.streams).values():  # as all of the file tells
                about.append(dict(patch.about) | {"patch": patch.name})
                first = firsts.setdefault(patch.name, about[-1])
                others = differences(patch.name, first, patch.about)
                outcome.notes += [f"{source.path}: {difference}" for difference in others]
        if not writer.frames:
            problem = sources[0].problem or "no sample lies in an episode"
            reason = "; ".join(outcome.left_out) or problem
            raise CaptureError(f"{paths[0]}: no row is whole: {reason}")
        clock = plan.clock or f"{fps} per s from the beginning of each episode"
        content = meta.content(clock, plan.from_first_complete)
        writer.finish(content | {"patches": about, "files": files})
        outcome.notes += [
            f"{name}: {count} values are not finite, and not in its statistics"
            for name, count in writer.not_finite.items()
        ]
        outcome.episodes, outcome.frames = writer.episodes, writer.frames
    return outcome


class _Layout:
    """What all files of a dataset have in common.

    lacking: columns of contacts and wrench, but for the clock's, that a file does not have, and are
    left out: which file. meta: of the first file, of whose streams others have the columns, but
    perhaps by other keys: a recording's, a bag's. Raises CaptureError where a file's differ.
    """

    def __init__(self, sources: Sequence[SampleSource], plan: Plan) -> None:
        self.plan = plan
        derived = {
            column(stream)
            for source in sources
            for stream in source.streams.values()
            if stream.kind in DERIVED and stream.topic != plan.clock
        }
        self.lacking = {
            name: source.path
            for name in sorted(derived)
            for source in sources
            if name not in map(column, source.streams.values())
        }
        self.rate_hz = plan.fps or _rate_hz(sources[0], str(self.clock(sources[0])))
        fps, streams = round(self.rate_hz), self.taken(sources[0])
        self.meta = DatasetMeta.of_streams(streams, fps, plan.mode, plan.policy)
        for source in sources:
            self._check(source)

    def taken(self, source: SampleSource) -> dict[str, SampleStream]:
        """Return the streams of a file that become columns."""
        return {k: one for k, one in source.streams.items() if column(one) not in self.lacking}

    def clock(self, source: SampleSource) -> str | None:
        """Return the key of a stream of the clock's topic, None without; raises CaptureError."""
        if self.plan.clock is None:
            return None
        keys = {stream.topic: key for key, stream in self.taken(source).items()}
        if self.plan.clock not in keys:
            there = ", ".join(keys)
            raise CaptureError(f"{source.path}: {self.plan.clock} is not exported (but {there})")
        return keys[self.plan.clock]

    def _check(self, source: SampleSource) -> None:
        mine, its = (_shapes(streams) for streams in (self.meta.streams, self.taken(source)))
        for name in sorted(mine.keys() | its.keys()):
            if name not in its:
                problem = f"does not have {name}, which the first file has"
            elif name not in mine:
                problem = f"has {name}, which the first file does not have"
            elif mine[name] != its[name]:
                problem = f"{name} has {its[name]}, in the first file {mine[name]}"
            else:
                continue
            raise CaptureError(
                f"{source.path}: {problem}: choose topics that all files have, or export them one "
                "by one"
            )
        others = {patch.name: patch for patch in patches_of(source.streams).values()}
        for name, patch in self.meta.patches.items():
            check_taxels(patch, others[name], source.path)


def _shapes(streams: Mapping[str, SampleStream]) -> dict[str, str]:
    """Return what a file's columns hold, for people: shapes, or the names of vectors' elements."""
    elements: defaultdict[str, set[str]] = defaultdict(set)
    for stream in streams.values():
        if stream.kind in (Kind.STATE, Kind.ACTION):
            elements[column(stream)].update(stream.names)
    shapes = {column(stream): f"shape {stream.shape}" for stream in streams.values()}
    return shapes | {name: ", ".join(sorted(its)) for name, its in elements.items()}


def _export(
    source: SampleSource, layout: _Layout, writer: RowWriter, outcome: Outcome, progress: Progress
) -> None:
    plan, fps = layout.plan, layout.meta.fps
    patches, taken = patches_of(source.streams), layout.taken(source)
    episodes, streams = plan.episodes(source), list(taken.values())
    touch = {
        key: TouchStream(len(patch), layout.meta.slots[patch.name], plan.mode, plan.policy)
        for key, patch in patches.items()
    }
    aligner = Aligner(taken, touch, episodes, fps, layout.clock(source))
    going: int | None = None  # the episode that the last row belonged to
    last_ns = 0
    parts = 0  # episodes that were begun because the one before was too long
    stopped: Counter[str] = Counter()  # rows with an old command, or nothing valid, by stream
    for row, is_in_pause in _rows(source, taken, aligner, episodes, progress):
        reason = obstacle(row, streams, plan.policy, source.begin_ns, source.path)
        if is_in_pause and reason is None:
            reason = f"nothing had been recorded for {PAUSE_S:g} s"
        if plan.from_first_complete and not all(
            one.completeness.is_complete for one in touch.values()
        ):
            reason = "a taxel had not had a valid reading yet"
        if reason is not None:  # rows of an episode follow one another without a gap
            outcome.left_out[reason] += 1
            going = None
            continue
        is_long = row.tick.episode == going and writer.length >= LONGEST_S * fps
        if row.tick.episode != going or row.tick.since_ns > last_ns or is_long:
            going = row.tick.episode  # it begins, or goes on after the clock had stopped
            writer.begin(episodes[going].task)
            parts += is_long
        last_ns = row.tick.time_ns
        stopped.update(one.key for one in streams if one.key in row.stopped)
        writer.add(cells(row, streams, layout.meta.features, plan.policy))
    notes = []
    for key, one in touch.items():
        if plan.from_first_complete:
            one.completeness.check(source.path, patches[key].name)
        elif one.completeness.missing:
            taxels = one.completeness.unread
            notes.append(f"{patches[key].name}: no valid reading of {taxels} at any time")
    notes += [_said_of_stopped(taken[key], rows) for key, rows in stopped.items()]
    if parts:
        notes.append(
            f"{parts} episodes begin only because the one before is {LONGEST_S} s long: LeRobot's "
            "float32 timestamps would be off by more than it tolerates"
        )
    outcome.late.update(aligner.late)
    outcome.notes += [f"{source.path}: {note}" for note in (*notes, *source.notes)]


def _said_of_stopped(stream: SampleStream, rows: int) -> str:
    if stream.kind == Kind.ACTION:
        return (
            f"action: the last command of {stream.topic} is repeated in {rows} rows: it stopped, "
            "or is sent only when it changes"
        )
    return f"{column(stream)}: {stream.topic} had stopped in {rows} rows, where nothing is valid"


def _rows(
    source: SampleSource,
    streams: Collection[str],
    aligner: Aligner,
    episodes: Sequence[Episode],
    progress: Progress,
) -> Iterator[tuple[Row, bool]]:
    last_ns = source.begin_ns
    for sample in samples_of(source, episodes, progress):
        if sample.stream not in streams:
            continue
        pause_ns = last_ns + round(PAUSE_S * NANO)
        for row in aligner.feed(sample):
            yield row, pause_ns < row.tick.time_ns < sample.stamp_ns
        last_ns = sample.seen_ns
    for row in aligner.finish():
        yield row, False


def _rate_hz(source: SampleSource, key: str) -> float:
    """Measure the ticks per s of a stream by its first stamps; raises CaptureError."""
    until_ns = source.begin_ns + round(RATE_S * NANO)
    stamps = [
        sample.stamp_ns
        for sample in source.samples(source.begin_ns, until_ns)
        if sample.stream == key
    ]
    steps = np.diff(np.unique(stamps))
    if not len(steps):
        raise CaptureError(f"{source.path}: {key} has no two stamps in its first {RATE_S:g} s")
    step_s = float(steps[steps < 1.5 * np.median(steps)].mean()) / NANO  # where none is missing
    if not round(1 / step_s):
        raise CaptureError(
            f"{source.path}: {step_s:.3f} s from message to message of {key}; a dataset has 1 row "
            "per s at least: --fps 1"
        )
    return 1 / step_s
