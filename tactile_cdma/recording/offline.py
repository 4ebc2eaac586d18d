# SPDX-License-Identifier: Apache-2.0

"""Decodes files: feeds the stages of a live skin from a recording or a scope's capture."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..base.errors import CaptureError
from ..code.frame import SPARSE
from ..config.parameters import GAP, LINE, NATURAL_SIGNS, Value
from ..config.skin_config import FRAME_PARAMETERS, SkinConfig
from ..driver.digitizer import Source
from ..driver.pipeline import Pipeline, TactileFrame
from ..driver.stream import ABSURD_V
from ..framing.frame_reader import FrameReader
from ..framing.gaps.gap_timing import SIDE_CHIPS, GapTiming
from ..wire._protocol import SyncMode
from ..wire.messages import Info
from ..wire.packets import PacketParser, diagnose
from ..words.words import Words
from .recording_file import describe, is_recording, read_bytes
from .scope_csv import ScopeCapture
from .whole_clock import fitted_clocks

_MIN_SAMPLES_PER_CHIP = 3
"""Chosen: with fewer, one of them at an edge, a chip may have no clean sample."""


def decode_scope(capture: ScopeCapture, config: SkinConfig) -> Iterator[tuple[float, Words]]:
    """Yield frames of a scope's capture: start of the first chip on the file's time axis, s; words.

    Raises CaptureError where the capture is too coarse to show single chips.
    """
    spec, samples_per_chip = config.spec, capture.rate_hz * config.spec.chip_s
    if samples_per_chip < _MIN_SAMPLES_PER_CHIP:
        raise CaptureError(
            f"{capture.rate_hz:g} samples/s are {samples_per_chip:.2g} per chip of "
            f"{spec.chip_s * 1e6:g} µs; {_MIN_SAMPLES_PER_CHIP} or more are needed: "
            "record faster, or correct the chip duration (is the first column in s?)"
        )
    for start_s, volts in capture.pieces:
        reader = FrameReader(
            spec, capture.rate_hz, active_share=config.active_share, side_chips=SIDE_CHIPS
        )
        timing = GapTiming(reader, capture.rate_hz)
        checked = np.where(np.abs(volts) < ABSURD_V, volts, np.float32(np.nan))
        for frame in timing.feed(0, checked) + timing.flush():
            if frame.words is not None and frame.speakers:
                yield start_s + frame.start / capture.rate_hz, frame.words


def described_parameters(path: Path) -> dict[str, Value]:
    """Read the frame layout that the digitizer described in a raw capture, as parameters.

    That is the first one that it said twice: one that it says as the port is opened may be of
    before it was configured.
    Raises CaptureError where the capture holds no such description.
    """
    parser, told = PacketParser(), None
    for packet in (packet for data, _ in read_bytes(path) for packet in parser.feed(data)):
        if isinstance(packet, Info):
            if packet == told:
                break
            told = packet
    if told is None:
        raise CaptureError(f"{path}: {diagnose(parser.counters)}")
    return parameters_of(told)


def parameters_of(info: Info) -> dict[str, Value]:
    """Return the frame layout that a digitizer describes, as parameters."""
    spec = info.frame.spec()
    return {
        **{name: getattr(spec, name) for name in FRAME_PARAMETERS},
        "rate_hz": 0.0,
        "chip_us": spec.chip_s * 1e6,
        "frame_period_ms": spec.frame_period_s * 1e3,
        "sign_seed": NATURAL_SIGNS if spec.sign_seed is None else spec.sign_seed,
        "sync_wire": info.sync_wire.name.lower(),
        "timing": GAP if info.sync_mode == SyncMode.NONE else LINE,
        "samples_per_chip": info.frame.samples_per_chip,
    }


def raw_frames(path: Path, pipeline: Pipeline) -> Iterator[TactileFrame]:
    """Yield frames of a raw capture, with readings."""
    for data, t_host in read_bytes(path):
        yield from pipeline.feed(data, t_host)
    yield from pipeline.flush()


class RawCapture:
    """A recording, or a port's raw bytes, opened to be decoded.

    values: the parameters that it is decoded with, config made of them. Raises CaptureError where
    it cannot be read or holds no description of the digitizer, SpecError for impossible values.
    """

    def __init__(self, path: Path, asked: dict[str, Value]) -> None:
        """asked: parameters that override what the digitizer described.

        That overrides what the recording says was asked of it. The amplitude is learnt unless it is
        given; that of sparse codes cannot be, and is the one that the driver had.
        """
        recorded = describe(path).parameters if is_recording(path) else {}
        described = described_parameters(path)
        self.path = path
        learnt: dict[str, Value] = {} if recorded.get("codes") == SPARSE else {"amplitude_mv": 0.0}
        self.values: dict[str, Value] = {**learnt, **recorded, **described, **asked}
        self.config = SkinConfig.of(self.values)
        self.pipeline = Pipeline(self.config)

    @property
    def source(self) -> Source:
        """Tell which digitizer was recorded, as far as it has been decoded."""
        info = self.pipeline.digitizer.info
        return Source(self.path.name, True, info.digitizer_id if info else None)

    def frames(self) -> Iterator[TactileFrame]:
        return raw_frames(self.path, self.pipeline)

    def timed_frames(self) -> Iterator[tuple[TactileFrame, float]]:
        """Yield all frames, once, each with the Unix time of its middle, s; NaN for raw bytes.

        The file is read twice: the clocks are fitted to all of it before the first frame is
        stamped.
        """
        description = describe(self.path) if is_recording(self.path) else None
        if description is not None:
            clocks = fitted_clocks(self.config, read_bytes(self.path))
            self.pipeline = Pipeline(self.config, clocks=clocks)
        for frame in self.frames():
            yield frame, description.wall_s(frame.t_host) if description else math.nan
