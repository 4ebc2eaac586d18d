# SPDX-License-Identifier: Apache-2.0

"""Fuzz targets: all files that users name."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from tactile_cdma.base.errors import (
    BodyError,
    CalibrationError,
    CaptureError,
    LayoutError,
    NodeMemoryError,
    ParameterError,
    RestError,
    TactileError,
)
from tactile_cdma.calibrating.load_points import read_table
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.body_file import read_body
from tactile_cdma.config.parameters import read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.hardware.node_memory import describe_memories, node_memory
from tactile_cdma.hardware.programmer import read_memory, write_memory
from tactile_cdma.places.layout_file import read_layout
from tactile_cdma.places.layout_nodes import Wiring
from tactile_cdma.readings.calibration import AdcScale, Calibration, PressureCurve
from tactile_cdma.readings.calibration_file import read_calibration
from tactile_cdma.recording.offline import RawCapture, decode_scope
from tactile_cdma.recording.recording_file import (
    Description,
    RecordingEncoder,
    RecordingParser,
    describe,
    is_text,
    length_ns,
    read_bytes,
    read_chunks,
    seek,
    survey,
)
from tactile_cdma.recording.scope_csv import read_scope_csv
from tactile_cdma.rest.rest_file import RestState, read_rest, write_rest
from test.support.calibrations import write_calibration

from .target import Target

CURVE = PressureCurve.two_stage()
ADC = AdcScale()
NODES = 3
ROOT = Path(__file__).resolve().parent.parent.parent


@cache
def _folder() -> TemporaryDirectory[str]:
    return TemporaryDirectory(prefix="tactile_cdma-")


def _in_file(read: Callable[[Path], object], suffix: str) -> Callable[[bytes], None]:
    """Make a target's run() of a function that reads a file."""

    def run(data: bytes) -> None:
        path = Path(_folder().name, f"input{suffix}")
        path.write_bytes(data)
        read(path)

    return run


def _written(write: Callable[[Path], object], suffix: str) -> bytes:
    """The bytes that a function writes to a file."""
    path = Path(_folder().name, f"seed{suffix}")
    path.unlink(missing_ok=True)
    write(path)
    return path.read_bytes()


def _read_scope(path: Path) -> None:
    if not is_text(path):
        return
    config = SkinConfig.of({"nodes": NODES, "bits": 8, "timing": "gap"})
    for _ in decode_scope(read_scope_csv(path), config):
        pass


def _read_recording(path: Path) -> None:
    """Read at once and in pieces, which must agree; then as the command line does."""
    data = path.read_bytes()
    at_once, one_by_one = RecordingParser(), RecordingParser()
    chunks = at_once.feed(data) + at_once.finish()
    size = 1 + len(data) % 61
    split = [
        chunk
        for begin in range(0, len(data), size)
        for chunk in one_by_one.feed(data[begin : begin + size])
    ]
    assert chunks == split + one_by_one.finish(), "other chunks when split otherwise"
    seen = [(p.description, p.end_ns, p.damaged, p.lost_bytes) for p in (at_once, one_by_one)]
    assert seen[0] == seen[1], "other counts when split otherwise"
    described, surveyed = describe(path), survey(path)
    described.wall_s(described.t_host(0))
    assert surveyed.bytes == sum(len(chunk.data) for chunk in chunks)
    length_ns(path)
    for _ in read_chunks(path, *seek(path, 10**9)):
        pass


def _read_capture(path: Path) -> None:
    """Read bytes and parameters; decoding is left to other targets."""
    for _ in read_bytes(path):
        pass
    RawCapture(path, {"nodes": NODES})


def _read_memory(path: Path) -> None:
    describe_memories(*read_memory(path))


def seeds_of_scope() -> Mapping[str, bytes]:
    time_s = np.arange(60) * 1e-5
    rows = [f"{t:.6f},{v:.3f}" for t, v in zip(time_s, np.sin(time_s * 1e5), strict=True)]
    text = "\n".join(rows)
    return {
        "plain": text.encode(),
        "headed": f"Source,CH1\nSecond,Volt\n{text}\n".encode(),
        "commas": text.replace(",", ";").replace(".", ",").encode(),
        "gaps": text.replace("0.000300,", "0.000800,").replace(",0.5", ",nan").encode(),
        "tabs": text.replace(",", "\t").encode(),
    }


def _recording(parts: list[bytes], **changes: object) -> bytes:
    about = Description(10**18, 10**9, "sim://", 2_000_000, {"nodes": NODES}, "1")
    encoder = RecordingEncoder(about, 7)
    pieces = [encoder.begin()]
    pieces += [encoder.chunk(part, 1.0 + i * 0.6) for i, part in enumerate(parts)]
    return b"".join([*pieces, encoder.end(4.0)])


def seeds_of_recordings() -> Mapping[str, bytes]:
    whole = _recording([b"abc", b"", b"defg" * 5])
    return {
        "whole": whole,
        "cut": whole[:-40],
        "damaged": whole[:-90] + b"?" + whole[-89:],
        "empty": _recording([]),
        "headless": whole[8:],
        "nested": _recording([whole]),
        "crafted": b"\x89SKIN\r\n\0" + struct.pack("<3scIIqQ", b"\xf1SK", b"D", 7, 999, 0, 0) * 9,
    }


def seeds_of_captures() -> Mapping[str, bytes]:
    from .streams import _true_stream

    stream = b"".join(_true_stream())
    return {"bytes": stream, "recording": _recording([stream])}


def seeds_of_calibrations() -> Mapping[str, bytes]:
    calibration = Calibration.of_nodes({1: CURVE, 3: CURVE}, CURVE, NODES)
    return {
        "sealed": _written(lambda path: write_calibration(path, calibration, ADC), ".yaml"),
    }


def seeds_of_layouts() -> Mapping[str, bytes]:
    files = sorted((ROOT / "config" / "layouts").glob("*.yaml"))
    return {file.stem: file.read_bytes() for file in files} | {
        "sphere": b"schema: tactile_cdma/layout\nversion: 1\nshape: sphere\nrows: 2\ncolumns: 2\n"
        b"pitch_mm: 5\nradius_mm: 40\nnodes: [[1, 2], [0, 3]]\nmasked: [2]\n",
        "list": b"schema: tactile_cdma/layout\nversion: 1\nshape: list\ntaxels:\n"
        b"- {position_mm: [0, 0, 0], node: 1}\n"
        b"- {position_mm: [5, 0, 1], normal: [0, 1, 1], area_mm2: 9, node: 2}\n",
    }


def seeds_of_bodies() -> Mapping[str, bytes]:
    return {
        "shipped": (ROOT / "config" / "body.yaml").read_bytes(),
        "small": b"frame_id: torso\npatches:\n  palm:\n    parameters: {port: 'sim://', nodes: 9,\n"
        b"      mount_xyz_m: [0, 0, 1.5], autostart: false}\n",
    }


def seeds_of_rests() -> Mapping[str, bytes]:
    rest_v = np.array([0.1, -0.2, 0], np.float32)
    state = RestState("a", True, "", NODES, "", "x", "2026-01-01", "", rest_v, None)
    return {"tared": _written(lambda path: write_rest(path, state), ".yaml")}


def seeds_of_parameters() -> Mapping[str, bytes]:
    return {
        "shipped": (ROOT / "config" / "skin.yaml").read_bytes(),
        "small": b"/**:\n  ros__parameters:\n    nodes: 9\n    chip_us: 5e1\n    parity: yes\n"
        b"    port: 'sim://'\n    mount_xyz_m: [0, 1, 2.5]\n    use_sim_time: false\n",
    }


def seeds_of_loads() -> Mapping[str, bytes]:
    return {
        "points": b"# loads\nnode,pressure_kpa,voltage_v\n1,0,3.3\n1,50,1.65\n2,0,3.2\n",
        "forces": b'"time_ms";"force_n"\n0;0,5\n10;1,5\n\n',
    }


def seeds_of_memories(suffix: str) -> Mapping[str, bytes]:
    data = node_memory(FrameSpec(nodes=NODES), 2)
    return {"node": _written(lambda path: write_memory(path, data), suffix)}


def _file(
    name: str,
    read: Callable[[Path], object],
    seeds: Callable[[], Mapping[str, bytes]],
    refuses: type[TactileError],
    suffix: str = ".yaml",
) -> Target:
    return Target(name, _in_file(read, suffix), seeds, (refuses,))


TARGETS = (
    _file("scope", _read_scope, seeds_of_scope, CaptureError, ".csv"),
    _file("recording", _read_recording, seeds_of_recordings, CaptureError, ".skin"),
    _file("capture", _read_capture, seeds_of_captures, TactileError, ".bin"),
    _file(
        "calibration",
        lambda path: read_calibration(path, NODES, ADC, CURVE),
        seeds_of_calibrations,
        CalibrationError,
    ),
    _file("layout", lambda path: read_layout(path, Wiring()), seeds_of_layouts, LayoutError),
    _file("body", read_body, seeds_of_bodies, BodyError),
    _file("rest", read_rest, seeds_of_rests, RestError),
    _file("parameters", read_file, seeds_of_parameters, ParameterError),
    _file("loads", lambda path: read_table(path, 1e-4), seeds_of_loads, CalibrationError, ".csv"),
    _file("hex", _read_memory, lambda: seeds_of_memories(".hex"), NodeMemoryError, ".hex"),
    _file("memory", _read_memory, lambda: seeds_of_memories(".bin"), NodeMemoryError, ".bin"),
)
