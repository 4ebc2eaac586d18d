# SPDX-License-Identifier: Apache-2.0

"""The subcommand `tactile-cdma decode`: prints the words of a recording or oscilloscope capture."""

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import CaptureError, SpecError
from ..base.program import tell
from ..base.text import listed
from ..code.encode import word_bits
from ..code.frame import SPARSE
from ..config.arguments import add_skin_options, given, positive
from ..config.parameters import BY_NAME, GAP, Value
from ..config.skin_config import SkinConfig
from ..recording.offline import RawCapture, decode_scope
from ..recording.recording_file import capture_notes, is_text
from ..recording.scope_csv import read_scope_csv
from ..words.words import Words


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand."""
    text = "recording, raw bytes of a port, or an oscilloscope's CSV"
    parser.add_argument("file", type=Path, help=text)
    parser.add_argument("--json", action="store_true", help="one JSON object per frame")
    scope = parser.add_argument_group("an oscilloscope's CSV")
    scope.add_argument("--channel", help="column to read: heading, or number from 1 (the first)")
    text = "sampling rate, where the file does not tell it or is wrong"
    scope.add_argument("--rate", type=positive, metavar="HZ", help=text)
    add_skin_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Print every frame, then on stderr what the file held; returns the exit code."""
    path, asked = arguments.file, given(arguments)
    raw = None if is_text(path) else RawCapture(path, asked)
    if raw is None:
        config = _scope_config(asked)
        scope = read_scope_csv(path, arguments.channel, arguments.rate)
        notes, frames = (scope.taken, *scope.notes), decode_scope(scope, config)
    else:
        if arguments.channel or arguments.rate:
            raise SpecError("--channel and --rate are for an oscilloscope's CSV")
        config, notes = raw.config, capture_notes(path)
        frames = ((frame.t_start, frame.words) for frame in raw.frames())
    for note in notes:
        tell(f"{path}: {note}")
    count = 0
    for t_start, words in frames:
        count += 1
        frame = describe_frame(t_start, words, config)
        print(json.dumps(frame) if arguments.json else _line(frame), flush=arguments.json)
    reason = "no frame found: check chip duration, order, bits and the frame period"
    if raw is not None:
        counters, packets = raw.pipeline.counters, raw.pipeline.parser.counters
        print(
            f"frames={count} lost_frames={counters.lost_frames} packets={packets.packets} "
            f"lost_packets={packets.lost_packets} crc_errors={packets.crc_errors} "
            f"rejected={raw.pipeline.rejections.total}",
            file=sys.stderr,
        )
        reason = raw.pipeline.problem or reason
    if not count:
        raise CaptureError(f"{path}: {reason}")
    return 0


def describe_frame(t_start: float, words: Words, config: SkinConfig) -> dict[str, Any]:
    """Describe a frame for people and JSON: who spoke, or may have; from 1 on as in the paper."""
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
        "doubtful_silence": (np.flatnonzero(words.doubtful & ~words.active) + 1).tolist(),
    }


def _scope_config(asked: dict[str, Value]) -> SkinConfig:
    if asked.get("codes") == SPARSE:
        raise SpecError(
            "sparse codes are decoded by the digitizer's frame marks, which a scope's capture "
            "lacks: record the digitizer"
        )
    if asked.get("timing", GAP) != GAP:
        raise SpecError("an oscilloscope capture holds nothing but the waveform: use --timing gap")
    # Only a digitizer integrates chips; the capture's own rate is what counts here.
    of_scope = {"timing": GAP, "samples_per_chip": BY_NAME["samples_per_chip"].default}
    return SkinConfig.of({"amplitude_mv": 0.0} | asked | of_scope)


def _line(frame: dict[str, Any]) -> str:
    words = [
        f"{node['node']}: {node['bits']} {node['voltage']:.2f} V "
        f"{node['pressure_pa'] / 1e3:.1f} kPa ({node['snr_db']:.0f} dB"
        f"{', doubtful' if node['doubtful'] else ''})"
        for node in frame["nodes"]
    ]
    if nodes := frame["doubtful_silence"]:
        words.append(f"silence doubtful: {listed(nodes, 'node')}")
    return f"{frame['t']:.6f} s  {'  '.join(words) or 'all silent'}"
