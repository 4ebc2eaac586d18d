# SPDX-License-Identifier: Apache-2.0

"""What is in a bag, in names and texts for people."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from .episodes import samples_of
from .progress import Progress
from .samples import NANO, SkinFrame, patches_of
from .sources.opening import Wanted, open_source
from .survey import FrameSurvey

Lines = Iterator[tuple[str, str]]


def contents(path: Path, progress: Progress) -> Lines:
    """The topics of a bag, and its patches. Raises CaptureError for what is none."""
    source = open_source(path, Wanted())
    from .sources.bag_source import BagSource  # slow to load, and needed here only

    assert isinstance(source, BagSource)
    length_s = (source.end_ns - source.begin_ns) / NANO
    messages = sum(number for _, number in source.counts.values())
    topics = _counted(len(source.counts), "topic")
    yield "bag", f"{length_s:.3f} s, {_counted(messages, 'message')} in {topics}"
    for topic, (kind, number) in sorted(source.counts.items()):
        rate = f", {(number - 1) / length_s:.2f} Hz" if length_s > 0 and number > 1 else ""
        yield topic, f"{kind}, {_counted(number, 'message')}{rate}"
    surveys = {stream.key: FrameSurvey() for stream in patches_of(source)}
    for sample in samples_of(source, (), progress):
        if isinstance(sample.value, SkinFrame):
            surveys[sample.stream].take(sample.value)
    for stream in patches_of(source):
        patch = stream.patch
        assert patch is not None
        yield f"patch {patch.name}", f"{patch.rows} × {patch.columns} taxels of {patch.topic}"
        yield from _skin(patch.about)
        yield from surveys[stream.key].lines()
    for note in source.notes:
        yield "note", note


def _skin(about: Mapping[str, Any]) -> Lines:
    """Which skin it was, and whether anything was touched."""
    yield "skin", str(about.get("skin") or "not named")
    calibration = about.get("calibration_id")
    yield "calibration", "not known" if calibration is None else str(calibration) or "default curve"
    measured = about.get("measured_by", "unknown")
    simulated = ": nothing was touched" if measured in ("simulated", "demonstrator") else ""
    yield "measured by", f"{measured} {about.get('digitizer_id', '')}".strip() + simulated


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
