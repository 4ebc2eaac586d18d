# SPDX-License-Identifier: Apache-2.0

"""The subcommand `tactile-cdma record`: writes the bytes of a port, with their times, to a file."""

import argparse
import time
from contextlib import suppress
from pathlib import Path

from ..base.errors import CaptureError, PortError
from ..base.interrupt import stop_event
from ..base.named_file import naming
from ..base.program import tell
from ..config.arguments import add_skin_options, given, positive
from ..config.parameters import BY_NAME, REPLAY
from ..config.skin_config import SkinConfig
from ..driver.session import Session
from ..recording.recording_file import Recorder
from ..replay.player import ReplayOptions
from ..wire.messages import Info
from ..wire.packets import PacketParser, diagnose
from ..wire.port import Port


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand."""
    parser.add_argument("port", help="pyserial URL: /dev/ttyACM0, sim://?scene=press, …")
    parser.add_argument("file", type=Path, help="recording, usually named *.skin")
    parser.add_argument("--seconds", type=positive, help="duration [s] (until Ctrl-C)")
    parser.add_argument("--baud", type=int, default=BY_NAME["baud"].default, help="baud rate")
    parser.add_argument("--force", action="store_true", help="overwrite an existing file")
    add_skin_options(parser, "the driver's; without any of these the digitizer is left as it is")


def run(arguments: argparse.Namespace) -> int:
    """Record until the time is up, Ctrl-C or a lost port; returns the exit code."""
    asked, path = given(arguments), arguments.file
    if path.exists() and not arguments.force:
        raise CaptureError(f"{path}: exists already; --force overwrites it")
    if _is_read_by(arguments.port, path):
        raise CaptureError(f"{path}: is what {arguments.port} reads; give another file")
    config = SkinConfig.of(asked) if asked else None
    session = Session(config)
    parser, start = PacketParser(), time.monotonic()
    described = False
    with (
        Port(arguments.port, arguments.baud) as port,
        stop_event(arguments.seconds) as stop,
        naming(path, CaptureError),
        Recorder(path, arguments.port, arguments.baud, asked, arguments.force) as recorder,
    ):
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
            tell(f"{error}; keeping what was recorded")
    counters = parser.counters
    print(
        f"seconds={time.monotonic() - start:.1f} bytes={counters.bytes} "
        f"packets={counters.packets} lost_packets={counters.lost_packets} "
        f"crc_errors={counters.crc_errors}"
    )
    if not described:
        raise CaptureError(f"{path}: this capture cannot be decoded: {diagnose(counters)}")
    return 0


def _is_read_by(port: str, path: Path) -> bool:
    """Tell whether a path leads to the recording or device that a port reads, by whatever name."""
    source = ReplayOptions.from_url(port).path if port.startswith(REPLAY) else Path(port)
    with suppress(OSError, ValueError):  # not there, or no name of a file
        return path.samefile(source)
    return False
