# SPDX-License-Identifier: Apache-2.0

"""The subcommand `tactile-cdma ports`: which digitizer is on which port."""

import argparse
import json
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

from ..base.errors import TactileError
from ..config.parameters import BY_NAME
from ..wire.discovery import USB, SerialPort, leave_alone_if_open, serial_ports
from ..wire.identity import is_demonstrator, is_simulated, shown_id
from ..wire.introduction import described_info, introduction
from ..wire.messages import Info
from ..wire.port import Port

MOST_AT_ONCE = 64
"""Ports that are asked at the same time, a thread each; chosen."""


@dataclass(frozen=True, slots=True)
class Answer:
    """A port and its digitizer's INFO, or the reason why there is none."""

    port: SerialPort
    info: Info | None = None
    reason: str = ""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand."""
    parser.description = (
        "Lists serial ports and the digitizers on them. Ports are opened and listened "
        "to; nothing is sent to a device that does not speak our protocol, and a port that another "
        "program has open is left alone. Boards that reset when their port is opened will reset."
    )
    parser.add_argument("port", nargs="*", help="device paths or pyserial URLs (all serial ports)")
    parser.add_argument("--list", action="store_true", help="list the ports without opening them")
    parser.add_argument("--baud", type=int, default=BY_NAME["baud"].default, help="baud rate")
    parser.add_argument("--json", action="store_true", help="print a JSON array")


def run(arguments: argparse.Namespace) -> int:
    """List ports and the digitizers on them; returns the exit code."""
    ports = chosen(arguments.port, serial_ports())
    if arguments.list:
        answers = [Answer(port) for port in ports]
    else:
        with ThreadPoolExecutor(MOST_AT_ONCE) as pool:
            answers = list(pool.map(partial(_ask, baud=arguments.baud), ports))
    if arguments.json:
        print(json.dumps([as_values(answer) for answer in answers], indent=2))
    else:
        print("\n".join(map(described, answers)) or "no serial ports on this machine")
    return 0


def chosen(urls: Iterable[str], ports: Iterable[SerialPort]) -> list[SerialPort]:
    """Return the ports with these names, or all; a URL that is no serial port stands for itself."""
    if not urls:
        return list(ports)
    known = {name: port for port in ports for name in (port.device, *port.links)}
    return [known.get(url, SerialPort(url, "")) for url in urls]


def _ask(port: SerialPort, baud: int) -> Answer:
    try:
        leave_alone_if_open(port.device)
        with Port(port.device, baud) as opened:
            return Answer(port, introduction(opened))
    except TactileError as error:
        return Answer(port, reason=str(error).removeprefix(f"{port.device}: "))


def described(answer: Answer) -> str:
    """Return a port and its digitizer as lines of text."""
    lines = [str(answer.port)]
    if answer.info is not None:
        lines.append(f"    digitizer {described_info(answer.info)}")
    elif answer.reason:
        lines.append(f"    no digitizer: {answer.reason}")
    if answer.port.usb_serial:
        lines.append(f"    {USB}{answer.port.usb_serial}")
    return "\n".join([*lines, *(f"    {link}" for link in answer.port.links)])


def as_values(answer: Answer) -> dict[str, Any]:
    """Return a port and its digitizer as plain values, for programs."""
    values: dict[str, Any] = asdict(answer.port)
    if (info := answer.info) is not None:
        values |= {
            "digitizer_id": shown_id(info.digitizer_id),
            "simulated": is_simulated(info.digitizer_id),
            "demonstrator": is_demonstrator(info.digitizer_id),
            "firmware": f"{info.firmware_major}.{info.firmware_minor}",
            "protocol_version": info.version,
            "sample_rate_hz": info.sample_rate_hz,
            "frame": asdict(info.frame),
        }
    elif answer.reason:
        values["reason"] = answer.reason
    return values
