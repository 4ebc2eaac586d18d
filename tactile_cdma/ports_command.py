# Copyright 2026 tactile_cdma maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The subcommand `tactile-cdma ports`: which digitizer is on which port."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from typing import Any

from .errors import TactileError
from .identity import shown_id
from .introduction import introduction
from .messages import Info
from .parameters import BY_NAME
from .plain_text import plain
from .source import USB, Port, SerialPort, leave_alone_if_open, serial_ports

MOST_AT_ONCE = 64


@dataclass(frozen=True, slots=True)
class Answer:
    """What is known of one port: of a digitizer its INFO, else why there is none."""

    port: SerialPort
    info: Info | None = None
    reason: str = ""


def add_to(commands: Any) -> None:
    """Add it to the command line's subcommands."""
    parser = commands.add_parser(
        "ports",
        help="list serial ports and the digitizers on them",
        description="Lists serial ports and the digitizers on them. Ports are opened and listened "
        "to; nothing is sent to what does not speak our protocol, and a port that another program "
        "has open is left alone. Boards that reset when their port is opened, do so.",
    )
    parser.add_argument("port", nargs="*", help="only these; device paths or pyserial URLs")
    parser.add_argument("--list", action="store_true", help="open none of them")
    parser.add_argument("--baud", type=int, default=BY_NAME["baud"].default)
    parser.add_argument("--json", action="store_true", help="as a JSON array")
    parser.set_defaults(run=_ports)


def _ports(arguments: argparse.Namespace) -> int:
    answers = answers_of(
        chosen(arguments.port, serial_ports()), None if arguments.list else arguments.baud
    )
    if arguments.json:
        print(json.dumps([as_values(answer) for answer in answers], indent=2))
    else:
        print("\n".join(map(described, answers)) or "no serial ports on this machine")
    return 0


def chosen(urls: Iterable[str], ports: Iterable[SerialPort]) -> list[SerialPort]:
    """The ports of these names, all without one; others than serial ports by their URL alone."""
    if not urls:
        return list(ports)
    known = {name: port for port in ports for name in (port.device, *port.links)}
    return [known.get(url, SerialPort(url, "")) for url in urls]


def answers_of(ports: list[SerialPort], baud: int | None) -> list[Answer]:
    """Ask all of them at the same time; without a baud rate, none."""
    if baud is None:
        return [Answer(port) for port in ports]
    with ThreadPoolExecutor(MOST_AT_ONCE) as pool:
        return list(pool.map(lambda port: _ask(port, baud), ports))


def _ask(port: SerialPort, baud: int) -> Answer:
    try:
        leave_alone_if_open(port.device)
        with Port(port.device, baud) as opened:
            return Answer(port, introduction(opened))
    except TactileError as error:
        return Answer(port, reason=str(error).removeprefix(f"{port.device}: "))


def described(answer: Answer) -> str:
    """A port and who is on it, for people."""
    lines = [str(answer.port)]
    if answer.info is not None:
        lines.append(f"    digitizer {described_info(answer.info)}")
    elif answer.reason:
        lines.append(f"    no digitizer: {answer.reason}")
    if answer.port.usb_serial:
        lines.append(plain(f"    {USB}{answer.port.usb_serial}"))
    return "\n".join([*lines, *(plain(f"    {link}") for link in answer.port.links)])


def described_info(info: Info) -> str:
    """A digitizer and its set-up in one line."""
    frame = info.frame
    return (
        f"{shown_id(info.digitizer_id)}, firmware {info.firmware_major}."
        f"{info.firmware_minor}, set to {frame.nodes} nodes × {frame.bits} bits, order "
        f"{frame.order}, {frame.chip_ns / 1e3:g} µs chips, a frame every "
        f"{frame.frame_period_us / 1e3:g} ms"
    )


def as_values(answer: Answer) -> dict[str, Any]:
    """The same for programs."""
    values: dict[str, Any] = asdict(answer.port)
    if (info := answer.info) is not None:
        values |= {
            "digitizer_id": shown_id(info.digitizer_id),
            "firmware": f"{info.firmware_major}.{info.firmware_minor}",
            "protocol_version": info.version,
            "sample_rate_hz": info.sample_rate_hz,
            "frame": asdict(info.frame),
        }
    elif answer.reason:
        values["reason"] = answer.reason
    return values
