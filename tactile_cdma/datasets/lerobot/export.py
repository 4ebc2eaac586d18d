# SPDX-License-Identifier: Apache-2.0

"""Recordings and bags ──▶ one LeRobotDataset: episodes on one clock, touch beside cameras."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ... import __version__
from ...base.errors import CaptureError
from ...base.whole_file import whole_folder
from ..alignment import Aligner, stale_s
from ..arrow import pyarrow
from ..episodes import FOREVER_NS, Episode, find_episodes
from ..frames import LATENESS_NS
from ..progress import Progress, fraction
from ..samples import ACTION, NANO, TACTILE, Source, Stream, check_taxels, patches_of, shown_taxels
from ..sources.opening import Wanted, has_times, open_source
from ..tables import known
from ..touch import HOLD, WINDOW, TouchStream, slots
from . import ABOUT
from .features import Feature, cells, column, features_of, obstacle
from .writer import DatasetWriter

RATE_S = 5.0
"""How much of a file is read to learn the rate of a clock's topic, s; chosen."""


@dataclass(frozen=True, slots=True)
class Plan:
    """Choices of an export; see docs/learning.md.

    fps: ticks per s; None with a clock: the topic whose stamps are the ticks. mode, policy: see
    touch. intervals, marks, start_s, end_s: see episodes. from_first_complete: leave out what is
    before every taxel in service has had a valid reading.
    """

    fps: int | None
    clock: str | None = None
    mode: str = WINDOW
    policy: str = HOLD
    task: str = ""
    intervals: Sequence[tuple[float, float]] = ()
    marks: str | None = None
    start_s: float | None = None
    end_s: float | None = None
    from_first_complete: bool = False


@dataclass(slots=True)
class Outcome:
    """What was written. left_out: rows by the reason. late: samples that missed their row."""

    episodes: int = 0
    frames: int = 0
    fps: int = 0
    left_out: Counter[str] = field(default_factory=Counter)
    late: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)


def write_lerobot(
    folder: Path, paths: Sequence[Path], wanted: Wanted, plan: Plan, progress: Progress
) -> Outcome:
    """Write a dataset of all episodes of some files; the folder appears when it is complete.

    Raises CaptureError for files that do not fit together or hold no episode, MissingPackageError
    without pyarrow, OSError.
    """
    pyarrow()
    for path in paths:
        if not has_times(path):
            raise CaptureError(f"{path}: bytes alone have no times, which a dataset needs")
    first = open_source(paths[0], wanted)
    if not patches_of(first):
        raise CaptureError(f"{paths[0]}: no frames of a skin in this bag")
    layout = _Layout.of(first, plan)
    outcome = Outcome(fps=layout.fps)
    with whole_folder(folder) as unfinished:
        writer = DatasetWriter(unfinished, layout.features, layout.fps)
        about: list[dict[str, Any]] = []
        for path in paths:
            source = first if path == paths[0] else open_source(path, wanted)
            layout.check(source)
            about += _export(source, plan, layout, writer, outcome, progress)
        if not writer.frames:
            reason = "; ".join(outcome.left_out) or "no sample lies in an episode"
            raise CaptureError(f"{paths[0]}: no row is whole: {reason}")
        writer.finish()
        content = _about(layout, plan, about) | {"files": [path.name for path in paths]}
        writer.write_json(ABOUT, content)
        outcome.notes += [
            f"{name}: {count} values are not finite, and not in its statistics"
            for name, count in writer.not_finite.items()
        ]
        outcome.episodes, outcome.frames = writer.episodes, writer.frames
    return outcome


@dataclass(frozen=True, slots=True)
class _Layout:
    """What all files of a dataset have in common, as the first one has it."""

    streams: Mapping[str, Stream]
    slots: Mapping[str, int]
    features: Sequence[Feature]
    fps: int

    @classmethod
    def of(cls, source: Source, plan: Plan) -> _Layout:
        clock = _clock(source, source.streams, plan)
        fps = plan.fps or _rate(source, str(clock))
        patches = {stream.key: stream for stream in patches_of(source)}
        counts = {
            key: slots(stream.patch, fps, plan.mode)
            for key, stream in patches.items()
            if stream.patch
        }
        streams = source.streams
        return cls(streams, counts, features_of(streams.values(), counts, plan.mode), fps)

    def check(self, source: Source) -> None:
        """Raises CaptureError for a file whose streams differ."""
        mine, its = (
            {column(stream): stream.shape for stream in streams.values()}
            for streams in (self.streams, source.streams)
        )
        for name in sorted(mine.keys() | its.keys()):
            if mine.get(name) != its.get(name):
                raise CaptureError(
                    f"{source.path}: {name} has shape {its.get(name, 'none')}, in the first file "
                    f"{mine.get(name, 'none')}: choose topics that all files have, or export them "
                    "one by one"
                )
        mine_by, its_by = (
            {stream.feature: stream.patch for stream in streams.values() if stream.patch}
            for streams in (self.streams, source.streams)
        )
        for feature, patch in mine_by.items():
            check_taxels(patch, its_by[feature], source.path)


def _export(
    source: Source,
    plan: Plan,
    layout: _Layout,
    writer: DatasetWriter,
    outcome: Outcome,
    progress: Progress,
) -> list[dict[str, Any]]:
    """Write the episodes of one file; returns what is to be said of its patches."""
    task = plan.task or "unnamed"
    episodes = find_episodes(source, task, plan.intervals, plan.marks, plan.start_s, plan.end_s)
    touch = {
        stream.key: TouchStream(stream.shape[0], layout.slots[stream.key], plan.mode, plan.policy)
        for stream in patches_of(source)
    }
    clock = _clock(source, source.streams, plan)
    aligner = Aligner(source.streams, touch, episodes, layout.fps, clock)
    streams = list(source.streams.values())
    actions = [stream for stream in streams if stream.kind == ACTION]
    going: int | None = None  # the episode that the last row belonged to
    last_ns = 0
    repeated: Counter[str] = Counter()  # commands that are older than others of their topics
    for row in _rows(source, aligner, episodes, progress):
        reason = obstacle(row, streams, source, plan.policy)
        if plan.from_first_complete and not all(
            one.completeness.is_complete for one in touch.values()
        ):
            reason = "a taxel had not had a valid reading yet"
        if reason is not None:  # rows of an episode follow one another without a gap
            outcome.left_out[reason] += 1
            going = None
            continue
        if row.tick.episode != going or row.tick.since_ns > last_ns:  # the clock had stopped
            going = row.tick.episode
            writer.begin(episodes[going].task)
        last_ns = row.tick.time_ns
        repeated.update(one.topic for one in actions if one.key in row.stopped)
        writer.add(cells(row, streams))
    for key, one in touch.items():
        name = source.streams[key].feature
        if plan.from_first_complete:
            one.completeness.check(source.path, name)
        elif missing := one.completeness.missing:
            taxels = shown_taxels(missing)
            outcome.notes.append(f"{source.path}: {name}: no valid reading of {taxels} at any time")
    for topic, rows in repeated.items():
        outcome.notes.append(
            f"{source.path}: action: the last command of {topic} is repeated in {rows} rows: it "
            "stopped, or is sent only when it changes"
        )
    outcome.late.update(aligner.late)
    outcome.notes += [f"{source.path}: {note}" for note in source.notes]
    return [
        dict(stream.patch.about) | {"patch": stream.feature}
        for stream in patches_of(source)
        if stream.patch
    ]


def _rows(
    source: Source, aligner: Aligner, episodes: Sequence[Episode], progress: Progress
) -> Iterator[Any]:
    end_ns = episodes[-1].end_ns
    until_ns = end_ns + LATENESS_NS if end_ns < FOREVER_NS else None
    # From the file's beginning on: what is held in an episode may be known from before it.
    for sample in source.samples(None, until_ns):
        progress.at(
            fraction(sample.seen_ns, source.begin_ns, source.end_ns),
            f"{source.path.name}: {(sample.seen_ns - source.begin_ns) / NANO:.0f} s",
        )
        yield from aligner.feed(sample)
    yield from aligner.finish()


def _clock(source: Source, streams: Mapping[str, Stream], plan: Plan) -> str | None:
    """The key of a stream of the clock's topic; None without one. Raises CaptureError."""
    if plan.clock is None:
        return None
    keys = {stream.topic: key for key, stream in streams.items()}
    if plan.clock not in keys:
        there = ", ".join(keys)
        raise CaptureError(f"{source.path}: {plan.clock} is not exported (but {there})")
    return keys[plan.clock]


def _rate(source: Source, key: str) -> int:
    """Ticks per s of a stream, from the first of its stamps; raises CaptureError."""
    until_ns = source.begin_ns + round(RATE_S * NANO)
    stamps = [
        sample.stamp_ns
        for sample in source.samples(source.begin_ns, until_ns)
        if sample.stream == key
    ]
    steps = np.diff(np.unique(stamps))
    if not len(steps):
        raise CaptureError(f"{source.path}: {key} has no two stamps in its first {RATE_S:g} s")
    if not (rate := round(NANO / float(np.median(steps)))):
        raise CaptureError(
            f"{source.path}: {np.median(steps) / NANO:.3f} s from message to message of {key}; a "
            "dataset has 1 row per s at least: --fps 1"
        )
    return rate


def _about(layout: _Layout, plan: Plan, patches: list[dict[str, Any]]) -> dict[str, Any]:
    taxels = {}
    for stream in layout.streams.values():
        if stream.kind == TACTILE and (patch := stream.patch) is not None:
            taxels[stream.feature] = {
                "rows": patch.rows,
                "columns": patch.columns,
                "node": patch.nodes.tolist(),
                "position_m": known(patch.positions_m),
                "normal": known(patch.normals),
                "area_m2": known(patch.areas_m2),
                "samples": layout.slots[stream.key],
            }
    return {
        "package_version": __version__,
        "samples": plan.mode,
        "nan": plan.policy,
        "stale_s": stale_s(layout.fps),
        "clock": plan.clock or f"{layout.fps} per s from the beginning of each episode",
        "from_first_complete": plan.from_first_complete,
        "units": {one.name: one.unit for one in layout.features if one.unit},
        "taxels": taxels,
        "patches": patches,
    }
