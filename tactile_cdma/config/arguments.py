# SPDX-License-Identifier: Apache-2.0

"""Command-line arguments that several commands share: those that describe the skin."""

import argparse
import math
import threading
from collections.abc import Collection, Iterable
from itertools import pairwise
from pathlib import Path

from ..base.errors import ParameterError
from .parameters import BY_NAME, NATURAL_SIGNS, Value, read_file, read_sections, unknown

_NAMES = (
    *("nodes", "bits", "chip_us", "frame_period_ms", "order", "first_row", "sign_seed", "drive"),
    *("polarity", "amplitude_mv", "timing", "samples_per_chip", "vref_v", "parity", "scramble"),
    "codes",
)
"""Parameters that are options: --nodes, …, --vref-v, --parity and --no-parity, …"""
_SHORT = {"vref_v": ("--vref",)}
"""Other names that options have."""


def add_skin_options(
    parser: argparse.ArgumentParser,
    default: str = "as described by the recording, else the driver's; amplitude: estimated",
) -> None:
    """Add the skin's parameters as options; default: help text on where missing ones come from."""
    group = parser.add_argument_group(f"the skin (default: {default})")
    group.add_argument("--params", type=Path, metavar="FILE", help="ROS 2 parameter file")
    for name in _NAMES:
        parameter = BY_NAME[name]
        options = ("--" + name.replace("_", "-"), *_SHORT.get(name, ()))
        kind, text = type(parameter.default), parameter.description.replace("%", "%%")
        if kind is bool:
            either = argparse.BooleanOptionalAction
            group.add_argument(*options, action=either, default=None, dest=name, help=text)
        else:
            group.add_argument(*options, type=kind, dest=name, help=text)
    group.add_argument(
        "--natural-signs",
        action="store_const",
        const=NATURAL_SIGNS,
        dest="sign_seed",
        help="no row signs, as in the paper",
    )


def given(arguments: argparse.Namespace) -> dict[str, Value]:
    """Parameters from the file, overridden by those from options."""
    values = read_file(arguments.params) if arguments.params else {}
    options = {name: getattr(arguments, name) for name in _NAMES}
    return values | {name: value for name, value in options.items() if value is not None}


def check_launch_arguments(words: Iterable[str], known: Collection[str]) -> None:
    """Raise ParameterError for an argument `name:=value` that a launch file does not have.

    `ros2 launch` itself ignores these. words: of its command line.
    """
    for word in words:
        name, assignment, _ = word.partition(":=")
        if assignment and name not in known:
            names = ", ".join(sorted(known))
            is_parameter = (
                "; it is a parameter: write it into params_file" if name in BY_NAME else ""
            )
            raise ParameterError(
                f"{unknown(name, known, 'launch argument')}{is_parameter} (there are {names})"
            )


def params_of(words: Iterable[str]) -> list[Path]:
    """The parameter files that a command line of ROS 2 names."""
    return [Path(value) for option, value in pairwise(words) if option == "--params-file"]


def check_params_are_for(node: str, words: Iterable[str]) -> None:
    """Raise ParameterError where no parameter file of a command line has anything for the node.

    ROS 2 itself ignores such files, and the node would run with its defaults. node: its fully
    qualified name. words: of the command line; those of `ros2 launch` name a file with the
    parameters that override the user's, so a single file that fits suffices.
    """
    files = params_of(words)
    refusals = []
    for file in files:
        try:
            read_sections(file, node)
        except ParameterError as error:
            refusals.append(error)
    if files and len(refusals) == len(files):
        raise refusals[0]


def positive(text: str) -> float:
    """Parse a number above 0 that, as a time in s, a thread can wait for."""
    value = float(text)
    if not 0 < value <= threading.TIMEOUT_MAX:
        raise argparse.ArgumentTypeError(f"{text} is not a number above 0")
    return value


def finite(text: str) -> float:
    """Parse a finite number."""
    value = float(text)
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text} is not a finite number")
    return value
