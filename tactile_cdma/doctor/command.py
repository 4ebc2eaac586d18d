# SPDX-License-Identifier: Apache-2.0

"""The subcommand `tactile-cdma doctor`. Standard library only, until a port is to be examined."""

import argparse
import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from .installation import installation
from .report import Check, Grade, problem

MOST_SECONDS = 600.0
"""Longest examination, s; chosen, its bytes are held in memory."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand."""
    parser.description = (
        "Checks this installation or, if a port is given, the port with its digitizer and skin. "
        "Exit code 1 if there is a problem."
    )
    add = parser.add_argument
    text = "a port to examine instead of the installation: /dev/ttyACM0, usb://SERIAL, sim://, …"
    add("port", nargs="?", help=text)
    text = "the driver's ROS 2 parameter file, to compare"
    add("--params", type=Path, metavar="FILE", help=text)
    add("--baud", type=int, help="baud rate (as in the parameters)")
    add("--seconds", type=_seconds, default=3.0, help="time to listen to the skin [s] (3)")
    add("--json", action="store_true", help="print a JSON array")


def _seconds(text: str) -> float:
    value = float(text)
    if not 0 < value <= MOST_SECONDS:
        raise argparse.ArgumentTypeError(f"{text} does not lie within 0…{MOST_SECONDS:g} s")
    return value


def run(arguments: argparse.Namespace) -> int:
    """Run the checks and print each at once; returns the exit code."""
    checks = []
    try:
        for check in _examination(arguments):
            checks.append(check)
            if not arguments.json:
                print(f"{check.verdict:<8} {check.subject}: {check.text}", flush=True)
    except KeyboardInterrupt:
        checks.append(problem("doctor", "interrupted: what follows was not checked"))
    number = Counter(check.verdict for check in checks)
    if arguments.json:
        print(json.dumps([asdict(check) for check in checks], indent=2))
    else:
        counted = (
            f"{number[grade] or 'no'} {grade}{'s' * (number[grade] != 1)}"
            for grade in (Grade.PROBLEM, Grade.WARNING)
        )
        print(f"{', '.join(counted)}, {number[Grade.OK]} ok")
    return int(number[Grade.PROBLEM] > 0)


def _examination(arguments: argparse.Namespace) -> Iterator[Check]:
    if not arguments.port and not arguments.params:
        yield from installation()
        return
    try:
        from .port import examine  # needs the packages that may be missing
    except ImportError as error:
        yield problem("packages", f"{error}; python -m tactile_cdma.doctor tells what is missing")
        return
    yield from examine(arguments.port, arguments.params, arguments.baud, arguments.seconds)
