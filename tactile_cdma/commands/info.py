# SPDX-License-Identifier: Apache-2.0

"""The subcommand `tactile-cdma info`: says what is in a recording or a bag."""

import argparse
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from ..base.errors import CaptureError, TactileError
from ..base.program import say
from ..config.arguments import add_skin_options, given
from ..config.parameters import Value
from ..datasets.episodes import samples_of
from ..datasets.progress import Progress
from ..datasets.samples import NANO, Completeness, Continuity, SkinFrame, patches_of
from ..datasets.sources.opening import Wanted, is_bag, open_source
from ..datasets.sources.recording_source import skin_frame
from ..readings.status import Status, is_in_service
from ..recording.offline import RawCapture
from ..recording.recording_file import RecordingParser, describe, is_recording, survey

Lines = Iterator[tuple[str, str]]
"""Names and texts."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand."""
    parser.add_argument("file", type=Path, help="recording or bag")
    add_skin_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Print all that can be said of a file; returns 1 for a recording that is damaged."""
    path, asked, damage = arguments.file, given(arguments), tuple[str, ...]()
    if is_bag(path):
        lines = _bag_lines(path, asked)
    elif is_recording(path):
        found = survey(path)
        lines, damage = _recording_lines(path, asked, found), found.losses
    else:
        raise CaptureError(
            f"{path}: neither a recording nor a bag; exported files say themselves where they come "
            "from: a table in `about`, a dataset in meta/tactile.json"
        )
    for name, value in lines:
        say(f"{name}: {value}")
    return 1 if damage else 0


def _bag_lines(path: Path, asked: dict[str, Value]) -> Lines:
    source = open_source(path, Wanted(asked))
    from ..datasets.sources.bag_source import BagSource  # slow to load, and needed here only

    assert isinstance(source, BagSource)
    length_s = (source.end_ns - source.begin_ns) / NANO
    messages = sum(number for _, number in source.counts.values())
    topics = _counted(len(source.counts), "topic")
    yield "bag", f"{length_s:.3f} s, {_counted(messages, 'message')} in {topics}"
    for topic, (kind, number) in sorted(source.counts.items()):
        rate = f", {(number - 1) / length_s:.2f} Hz" if length_s > 0 and number > 1 else ""
        yield topic, f"{kind}, {_counted(number, 'message')}{rate}"
    patches = patches_of(source.streams)
    surveys = {key: FrameSurvey() for key in patches}
    with Progress() as progress:
        for sample in samples_of(source, (), progress):
            if isinstance(sample.value, SkinFrame):
                surveys[sample.stream].take(sample.value)
    for key, patch in patches.items():
        yield f"patch {patch.name}", f"{patch.rows} × {patch.columns} taxels of {patch.topic}"
        about = patch.about
        yield "skin", str(about.get("skin") or "not named")
        curves = about.get("calibration_id")
        yield "calibration", "not known" if curves is None else str(curves) or "default curve"
        measured = about.get("measured_by", "unknown")
        simulated = ": no sensor measured this" if measured in ("simulated", "demonstrator") else ""
        yield "measured by", f"{measured} {about.get('digitizer_id', '')}".strip() + simulated
        yield from surveys[key].lines()
    for note in source.notes:
        yield "note", note


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _recording_lines(path: Path, asked: dict[str, Value], found: RecordingParser) -> Lines:
    description = describe(path)
    begun = datetime.fromtimestamp(description.wall_ns * 1e-9, UTC)
    asked_for = ", ".join(f"{name}: {value}" for name, value in description.parameters.items())
    yield "begun", begun.isoformat(timespec="milliseconds")
    yield "port", f"{description.port} at {description.baud} baud"
    yield "recorded by", f"tactile_cdma {description.package_version}"
    yield "asked for", asked_for or "nothing, the digitizer was taken as it was"
    yield "length", f"{found.time_ns * 1e-9:.3f} s, {found.bytes} bytes in {found.chunks} pieces"
    try:
        capture = RawCapture(path, asked)
    except TactileError as error:
        yield "frames", f"none, {error}"
    else:
        yield from _frame_lines(capture)
    yield "checksum", "; ".join(found.losses) or "right"


def _frame_lines(capture: RawCapture) -> Lines:
    frames = FrameSurvey()
    for frame, wall_s in capture.timed_frames():
        frames.take(skin_frame(frame, wall_s))
    yield "digitizer", capture.source.digitizer
    pipeline = capture.pipeline
    counters, packets, spec = pipeline.counters, pipeline.parser.counters, pipeline.config.spec
    signs = ", scrambled" if spec.scramble else ", not scrambled"
    codes = ", sparse codes" if spec.sparse else signs
    chips = f"order {spec.order}, {spec.chip_s * 1e6:g} µs chips{codes}"
    period = f"a frame every {spec.frame_period_s * 1e3:g} ms"
    yield "skin", f"{spec.nodes} nodes, {spec.bits} bits, {chips}, {period}"
    if load := pipeline.load:
        most = f"{load.peak} at most, capacity {load.capacity}"
        yield "nodes at once", f"{most}, {load.overloads} frames beyond it"
    yield "calibration", capture.config.calibration.identity or "default curve"
    for name, value in frames.lines():
        if name == "frames" and counters.frames:
            value = f"{counters.frames}, lost {counters.lost_frames}"
        yield name, value
    lost = f"lost {packets.lost_packets}, CRC errors {packets.crc_errors}"
    yield "packets", f"{packets.packets}, {lost}"
    lost = f"{counters.samples}, lost {counters.lost_samples}"
    yield "samples", lost if counters.samples else "none"
    if pipeline.problem:
        yield "problem", pipeline.problem


class FrameSurvey:
    """Takes all frames of a patch in order; memory does not grow."""

    def __init__(self) -> None:
        self._frames = 0
        self._continuity = Continuity()
        self._readings = np.zeros(4, dtype=np.int64)  # in service, invalid, held, saturated
        self._completeness = Completeness()
        self._complete_s: float | None = None

    def take(self, frame: SkinFrame) -> None:
        time_s = frame.device_time_s if np.isnan(frame.wall_time_s) else frame.wall_time_s
        self._continuity.take(frame.sequence, time_s)
        self._frames += 1
        in_service = is_in_service(frame.status)
        valid = in_service & frame.valid
        bits = np.uint8(Status.SILENT), np.uint8(Status.SATURATED)
        kinds = in_service, in_service & ~valid, *(valid & (frame.status & bit > 0) for bit in bits)
        self._readings += [np.count_nonzero(kind) for kind in kinds]
        if self._complete_s is None:
            self._completeness.take(frame)
            if self._completeness.is_complete:
                self._complete_s = self._continuity.length_s

    def lines(self) -> Iterator[tuple[str, str]]:
        """Yield names and texts; without a frame nothing can be said of gaps and readings."""
        if not self._frames:
            yield "frames", "none"
            return
        length_s = self._continuity.length_s
        rate = f", {(self._frames - 1) / length_s:.2f} Hz" if length_s > 0 else ""
        yield "frames", f"{self._frames} in {length_s:.3f} s{rate}"
        yield "gaps", "; ".join(self._said_gaps()) or "none"
        of, *some = self._readings.tolist()
        shares = [f"{one / of:.2%}" if of else "none" for one in some]
        yield "readings", "{} invalid, {} held, {} saturated".format(*shares)
        yield "complete", self._complete()

    def _said_gaps(self) -> Iterator[str]:
        gaps, restarts = self._continuity.gaps, self._continuity.restarts
        if gaps.number:
            missing = f"{self._continuity.missing} frame periods without a frame"
            yield f"{gaps.number}, {missing}, {gaps.longest}"
        if restarts.number:
            where = "where the sequence begins anew (did the driver restart?)"
            yield f"{restarts.number} {where}, {restarts.longest}"

    def _complete(self) -> str:
        if self._complete_s is None:
            return f"never: no valid reading of {self._completeness.unread}"
        if not self._complete_s:
            return "from the first frame on"
        return (
            f"after {self._complete_s:.3f} s: until then a node that had not spoken was unknown; "
            "export --from-first-complete leaves that out"
        )
