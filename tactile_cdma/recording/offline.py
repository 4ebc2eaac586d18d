# SPDX-License-Identifier: Apache-2.0

"""Decoding of captures without a digitizer: the same stages, fed from a file."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import CaptureError
from ..code.encode import word_bits
from ..config.parameters import GAP, LINE, NATURAL_SIGNS, Value
from ..config.skin_config import SkinConfig
from ..driver.pipeline import Pipeline, TactileFrame
from ..framing.gap_timing import GapTiming
from ..framing.timing import SampleBlock
from ..wire._protocol import SyncMode
from ..wire.messages import Info
from ..wire.packets import PacketParser, diagnose
from ..words.decode import Words, decode
from .capture import ScopeCapture, read_bytes, recorded_parameters

_MIN_SAMPLES_PER_CHIP = 3


def decode_scope(capture: ScopeCapture, config: SkinConfig) -> Iterator[tuple[float, Words]]:
    """Frames of a scope's capture: start of the first chip on the file's time axis (s), words.

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
        timing = GapTiming(spec, capture.rate_hz)
        for frame in timing.feed(SampleBlock(0, volts)) + timing.flush():
            if frame.levels is not None:
                words = decode(frame.levels, spec, config.threshold)
                if frame.tied:
                    words = words.doubted()
                yield start_s + frame.start / capture.rate_hz, words


def described_parameters(path: Path) -> dict[str, Value]:
    """The frame layout that the digitizer described in a raw capture, as parameters.

    Raises CaptureError where the capture holds no such description.
    """
    parser = PacketParser()
    for data, _ in read_bytes(path):
        for packet in parser.feed(data):
            if isinstance(packet, Info):
                return parameters_of(packet)
    reason = diagnose(parser.counters)
    raise CaptureError(f"{path}: {reason}")


def parameters_of(info: Info) -> dict[str, Value]:
    """The frame layout that a digitizer describes, as parameters."""
    spec = info.frame.spec()
    return {
        "nodes": spec.nodes,
        "bits": spec.bits,
        "order": spec.order,
        "chip_us": spec.chip_s * 1e6,
        "frame_period_ms": spec.frame_period_s * 1e3,
        "first_row": spec.first_row,
        "sign_seed": NATURAL_SIGNS if spec.sign_seed is None else spec.sign_seed,
        "drive": spec.drive,
        "polarity": spec.polarity,
        "timing": GAP if info.sync_mode == SyncMode.NONE else LINE,
        "samples_per_chip": info.frame.samples_per_chip,
        "parity": spec.parity,
        "resync_chips": spec.resync_chips,
        "guard_chips": spec.guard_chips,
    }


def offline_values(path: Path, asked: dict[str, Value]) -> dict[str, Value]:
    """The parameters to decode a raw capture with; what they leave open takes its default.

    Of what is asked, what the digitizer described, and what the recording says was asked of it,
    the first that says something counts. The amplitude is learnt unless it is given.
    Raises CaptureError where the capture holds no description.
    """
    learnt: dict[str, Value] = {"amplitude_mv": 0.0}
    return learnt | recorded_parameters(path) | described_parameters(path) | asked


def decode_raw(path: Path, pipeline: Pipeline) -> Iterator[tuple[float, Words]]:
    """Frames of a raw capture: start of the first chip in device time (s), words."""
    for frame in raw_frames(path, pipeline):
        yield frame.t_start, frame.words


def raw_frames(path: Path, pipeline: Pipeline) -> Iterator[TactileFrame]:
    """Frames of a raw capture, with readings."""
    for data, t_host in read_bytes(path):
        yield from pipeline.feed(data, t_host)
    yield from pipeline.flush()


def describe_frame(t_start: float, words: Words, config: SkinConfig) -> dict[str, Any]:
    """One frame for people and JSON: active nodes only, nodes counted from 1 as in the paper."""
    voltage_v = config.adc.voltage(words.codes)
    pressure_pa = config.calibration.curves.pressure(voltage_v.astype(np.float32))
    bits = word_bits(words.codes, config.spec.bits)
    confidence = words.confidence
    return {
        "t": round(t_start, 9),
        "nodes": [
            {
                "node": int(i) + 1,
                "bits": "".join(map(str, bits[i])),
                "code": int(words.codes[i]),
                "voltage": round(float(voltage_v[i]), 4),
                "pressure_pa": round(float(pressure_pa[i]), 1),
                "snr_db": round(20 * math.log10(float(words.rho[i])), 1),
                "confidence": round(float(confidence[i]), 6),
                "doubtful": bool(words.doubtful[i]),
            }
            for i in np.flatnonzero(words.active)
        ],
    }
