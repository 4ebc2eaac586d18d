# SPDX-License-Identifier: Apache-2.0

"""Recordings (.skin) and raw bytes as a source: decoded again, with contacts and wrench.

Its frames become samples as those of a running skin do: patch_info, samples_of.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ... import __version__
from ...base.errors import CaptureError
from ...config.parameters import Value
from ...config.skin_config import SkinConfig
from ...driver.digitizer import Source
from ...driver.pipeline import TactileFrame
from ...readings.contact import Contacts, ContactTracker
from ...recording.offline import RawCapture
from ...recording.recording_file import capture_notes, describe, is_recording, is_text, length_ns
from ..samples import (
    DERIVED,
    NANO,
    Kind,
    PatchInfo,
    Sample,
    SampleStream,
    SkinFrame,
    feature_name,
    skin_stream,
)


class RecordingSource:
    """A recording, or a port's raw bytes; see samples.SampleSource. Raw bytes have no wall time."""

    def __init__(self, path: Path, asked: dict[str, Value], derived: bool) -> None:
        """asked: parameters that override the file's. derived: contacts and wrench, too."""
        if is_text(path):
            raise CaptureError(
                f"{path}: is text; decode --json makes frames of an oscilloscope's capture"
            )
        self.path, self._derived = path, derived
        self.capture = RawCapture(path, asked)
        self.begin_ns = self.end_ns = 0
        if is_recording(path):
            length = length_ns(path)
            self.begin_ns = describe(path).wall_ns
            self.end_ns = self.begin_ns + length if length is not None else 0
        self.name = feature_name(self.capture.config.skin)

    @property
    def streams(self) -> Mapping[str, SampleStream]:
        """Return the skin's streams, as far as the file has been decoded; see patch."""
        kinds = (Kind.TACTILE, *DERIVED) if self._derived else (Kind.TACTILE,)
        return {kind: skin_stream(kind, kind, self.patch) for kind in kinds}

    @property
    def patch(self) -> PatchInfo:
        """Return the skin as far as the file is decoded: its digitizer introduces itself there."""
        about = {"file": self.path.name, "parameters": self.capture.values}
        return patch_info(self.capture.config, self.capture.source, self.name, about)

    @property
    def notes(self) -> tuple[str, ...]:
        return capture_notes(self.path)

    @property
    def problem(self) -> str | None:
        return self.capture.pipeline.problem

    def marks(self, topic: str) -> list[tuple[int, Any]]:
        raise CaptureError(f"{self.path}: a recording has no topics; --marks is for bags")

    def samples(self, begin_ns: int | None, end_ns: int | None) -> Iterator[Sample]:
        config = self.capture.config
        tracker = ContactTracker(config.layout, config.contact)
        for frame, wall_s in self.capture.timed_frames():
            stamp_ns = 0 if math.isnan(wall_s) else round(wall_s * NANO)
            found = tracker.update(frame.readings, frame.t_middle) if self._derived else None
            if (begin_ns is not None and stamp_ns < begin_ns) or (
                end_ns is not None and stamp_ns > end_ns
            ):
                continue  # every frame is decoded: a reading rests on all words before it
            keys = Kind.TACTILE, *DERIVED
            yield from samples_of(keys, skin_frame(frame, wall_s), found, stamp_ns, stamp_ns)


def skin_frame(frame: TactileFrame, wall_s: float) -> SkinFrame:
    """Make a SkinFrame of a decoded frame; wall_s: Unix time of its middle."""
    readings = frame.readings
    return SkinFrame(
        sequence=frame.sequence,
        device_time_s=frame.t_middle,
        wall_time_s=wall_s,
        stamp_uncertainty_s=math.nan if math.isnan(wall_s) else frame.stamp_uncertainty_s,
        noise_v=frame.words.noise_rms_v,
        pressure_pa=readings.pressure_pa,
        voltage_v=readings.voltage_v,
        status=readings.status,
    )


def patch_info(
    config: SkinConfig, source: Source, name: str, about: Mapping[str, Any]
) -> PatchInfo:
    """Describe a patch that is decoded here. source: who measures. about: what else is known."""
    layout = config.layout
    return PatchInfo(
        name=name,
        topic="",
        rows=layout.rows,
        columns=layout.columns,
        nodes=layout.nodes.astype(np.uint16),
        positions_m=layout.positions_m.astype(np.float32),
        normals=layout.normals.astype(np.float32),
        areas_m2=layout.areas_m2.astype(np.float32),
        frame_period_s=config.spec.frame_period_s,
        about={
            "origin": source.origin.name.lower(),
            "measured_by": source.measured_by.name.lower(),
            "skin": config.skin,
            "digitizer_id": (source.digitizer_id or b"").hex().upper(),
            "calibration_id": config.calibration.identity,
            "package_version": __version__,
            **about,
        },
    )


def samples_of(
    keys: Sequence[str], frame: SkinFrame, found: Contacts | None, stamp_ns: int, seen_ns: int
) -> Iterator[Sample]:
    """Yield samples of a frame and, unless None, of its contacts.

    keys: of the streams of touch, contacts and wrench.
    """
    tactile, contacts, wrench = keys
    yield Sample(tactile, stamp_ns, seen_ns, frame)
    if found is not None:
        counts = found.touched, found.untouched, len(found)
        values = [*map(float, counts), found.total_area_m2, *found.centre_m]  # by CONTACT_NAMES
        yield Sample(contacts, stamp_ns, seen_ns, np.array(values, dtype=np.float32))
        yield Sample(wrench, stamp_ns, seen_ns, found.wrench.astype(np.float32))
