# SPDX-License-Identifier: Apache-2.0

"""The commands `tactile-cdma record` and `info`: recordings of a port's bytes."""

from __future__ import annotations

import argparse
import sys
import time
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ..base.errors import CaptureError, PortError, TactileError
from ..base.interrupt import stop_event
from ..base.plain_text import plain
from ..config.arguments import add_skin_options, given, positive
from ..config.parameters import BY_NAME, REPLAY, Value
from ..config.skin_config import SkinConfig
from ..driver.pipeline import Pipeline
from ..driver.session import Session
from ..recording.container import Description
from ..recording.offline import offline_values, raw_frames
from ..recording.recording_file import Recorder, describe, is_recording, survey
from ..replay.options import ReplayOptions
from ..wire.messages import Info
from ..wire.packets import PacketParser, diagnose
from ..wire.port import Port


def add_to(commands: Any) -> None:
    """Add the commands to those of the program (what argparse's add_subparsers returns)."""
    record = commands.add_parser("record", help="write the bytes of a port to a file")
    record.add_argument("port", help="pyserial URL: /dev/ttyACM0, sim://?scene=press, …")
    record.add_argument("file", type=Path, help="recording, usually named *.skin")
    record.add_argument("--seconds", type=positive, help="end after so long; else on Ctrl-C")
    record.add_argument("--baud", type=int, default=BY_NAME["baud"].default)
    record.add_argument("--force", action="store_true", help="overwrite the file")
    add_skin_options(record)
    record.set_defaults(run=_record)

    info = commands.add_parser("info", help="what a recording holds, and whether it is sound")
    info.add_argument("file", type=Path, help="recording")
    add_skin_options(info)
    info.set_defaults(run=_info)


def _record(arguments: argparse.Namespace) -> int:
    asked, path = given(arguments), arguments.file
    if path.exists() and not arguments.force:
        raise CaptureError(f"{path}: exists already; --force overwrites it")
    if _is_read_by(arguments.port, path):
        raise CaptureError(f"{path}: is what {arguments.port} reads; give another file")
    config = SkinConfig.of(asked) if asked else None
    session = Session(config)
    parser, start = PacketParser(), time.monotonic()
    described = False
    with Port(arguments.port, arguments.baud) as port, stop_event(arguments.seconds) as stop:
        try:
            with Recorder(path, arguments.port, arguments.baud, asked, arguments.force) as recorder:
                try:
                    port.write(session.open())
                    while not stop.is_set():
                        data, t_host = port.read()
                        recorder.write(data, t_host)
                        for packet in parser.feed(data):
                            if isinstance(packet, Info):
                                described = True
                                port.write(session.introduced(packet))
                                if config and (wrong := config.refusal(packet.digitizer_id)):
                                    raise PortError(f"{arguments.port}: {wrong}")
                    port.write(session.close())
                except PortError as error:
                    print(f"tactile-cdma: {error}; keeping what was recorded", file=sys.stderr)
        except OSError as error:
            raise CaptureError(f"{path}: {error.strerror}") from None
    counters = parser.counters
    print(
        f"seconds={time.monotonic() - start:.1f} bytes={counters.bytes} "
        f"packets={counters.packets} lost_packets={counters.lost_packets} "
        f"crc_errors={counters.crc_errors}"
    )
    if not described:
        reason = diagnose(counters)
        raise CaptureError(f"{path}: this capture cannot be decoded: {reason}")
    return 0


def _is_read_by(port: str, path: Path) -> bool:
    """Whether a file, under whatever name, is a port's recording or device."""
    source = ReplayOptions.from_url(port).path if port.startswith(REPLAY) else Path(port)
    with suppress(OSError, ValueError):  # not there, or no name of a file
        return path.samefile(source)
    return False


def _info(arguments: argparse.Namespace) -> int:
    path: Path = arguments.file
    try:
        if not is_recording(path):
            raise CaptureError(f"{path}: no recording; decode reads files of bytes alone")
    except OSError as error:
        raise CaptureError(f"{path}: {error.strerror}") from None
    description, found = describe(path), survey(path)
    for name, value in _about(description).items():
        print(f"{name}: {plain(value)}")
    print(f"length: {found.length_s:.3f} s, {found.bytes} bytes in {found.chunks} pieces")
    _say_frames(path, given(arguments))
    print("checksum: " + ("; ".join(found.notes) or "right"))
    return 1 if found.notes else 0


def _about(description: Description) -> dict[str, str]:
    begun = datetime.fromtimestamp(description.wall_ns * 1e-9, UTC)
    parameters = ", ".join(f"{name}: {value}" for name, value in description.parameters.items())
    return {
        "begun": begun.isoformat(timespec="milliseconds"),
        "port": f"{description.port} at {description.baud} baud",
        "recorded by": f"tactile_cdma {description.package_version}",
        "asked for": parameters or "nothing, the digitizer was taken as it was",
    }


def _say_frames(path: Path, asked: dict[str, Value]) -> None:
    """What decoding finds, or why it finds nothing."""
    try:
        pipeline = Pipeline(SkinConfig.of(offline_values(path, asked)), background=False)
    except TactileError as error:
        print(f"frames: none, {error}")
        return
    for _ in raw_frames(path, pipeline):
        pass
    counters, packets, spec = pipeline.counters, pipeline.parser.counters, pipeline.config.spec
    print(
        f"skin: {spec.nodes} nodes, {spec.bits} bits, order {spec.order}, "
        f"a frame every {spec.frame_period_s * 1e3:g} ms"
    )
    print(f"frames: {counters.frames}, lost {counters.lost_frames}")
    print(
        f"packets: {packets.packets}, lost {packets.lost_packets}, CRC errors {packets.crc_errors}"
    )
    print(f"samples: {counters.samples}, lost {counters.lost_samples}")
    if pipeline.problem:
        print(f"problem: {pipeline.problem}")
