# SPDX-License-Identifier: Apache-2.0

"""Command-line arguments that several commands share: those that describe the skin."""

import argparse
import math
import threading
from collections.abc import Iterable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

from ..base.errors import ParameterError, TactileError
from .parameters import (
    BY_NAME,
    NATURAL_SIGNS,
    TRUTH,
    Value,
    of_text,
    read_file,
    read_sections,
    unknown,
)

_NAMES = (
    *("nodes", "bits", "chip_us", "frame_period_ms", "order", "first_row", "sign_seed", "drive"),
    *("polarity", "amplitude_mv", "timing", "samples_per_chip", "vref_v", "parity", "scramble"),
    *("codes", "rate_hz", "node_kind", "sync_wire"),
)
"""Parameters that are options: --nodes, …, --vref-v, --parity and --no-parity, …"""
SIM_TIME = "use_sim_time"
"""A parameter that every ROS node has, and that files which include others' often pass on."""


def add_skin_options(
    parser: argparse.ArgumentParser,
    default: str = "as described by the recording, else the driver's; amplitude: estimated",
) -> None:
    """Add the skin's parameters as options; default: help text on where missing ones come from."""
    group = parser.add_argument_group(f"the skin (default: {default})")
    group.add_argument("--params", type=Path, metavar="FILE", help="ROS 2 parameter file")
    for name in _NAMES:
        parameter = BY_NAME[name]
        option, kind = "--" + name.replace("_", "-"), type(parameter.default)
        values = f"{{{','.join(map(str, parameter.choices))}}}" if parameter.choices else "N"
        how: dict[str, Any] = {"type": kind, "metavar": values}
        if kind is bool:
            how = {"action": argparse.BooleanOptionalAction, "default": None}
        group.add_argument(option, **how, help=parameter.description.replace("%", "%%"))
    signs: dict[str, Any] = {"action": "store_const", "const": NATURAL_SIGNS, "dest": "sign_seed"}
    group.add_argument("--natural-signs", **signs, help="no row signs, as in the paper")


def given(arguments: argparse.Namespace) -> dict[str, Value]:
    """Read parameters from the file, overridden by those from options."""
    values = read_file(arguments.params) if arguments.params else {}
    options = {name: getattr(arguments, name) for name in _NAMES}
    return values | {name: value for name, value in options.items() if value is not None}


def refuse_given(
    arguments: argparse.Namespace,
    names: Iterable[str],
    reason: str,
    error: type[TactileError] = ParameterError,
) -> None:
    """Raise the error where one of these options, by destination, has not its default."""
    for name in names:
        if getattr(arguments, name) != arguments.parser.get_default(name):
            raise error(f"--{name.replace('_', '-')} {reason}")


def launch_values(
    given: Mapping[str, str], own: Mapping[str, str]
) -> tuple[dict[str, str], dict[str, Value]]:
    """Return the arguments of a launch file, and the driver's parameters beside them.

    given: texts by name, which `ros2 launch` itself takes whatever the name. own: arguments that
    the file has, with their defaults. Raises ParameterError for a name that is neither such an
    argument nor a parameter, and for a text that is no value of the parameter.
    """
    values: dict[str, Value] = {}
    for name in given.keys() - own.keys():
        if name == SIM_TIME:
            values[name] = true_or_false(name, given[name])
        elif name in BY_NAME:
            values[name] = of_text(name, given[name])
        else:
            text = unknown(name, [*own, *BY_NAME], "launch argument")
            raise ParameterError(
                f"{text} (there are {', '.join(sorted(own))}, and the parameters of the driver)"
            )
    return {name: given.get(name, default) for name, default in own.items()}, values


def true_or_false(name: str, text: str) -> bool:
    """Tell what an argument says; True, yes and ON will do. Raises ParameterError."""
    if (found := TRUTH.get(text.lower())) is None:
        raise ParameterError(f"{name} is {text!r}; it must be true or false")
    return found


def params_of(words: Iterable[str]) -> list[Path]:
    """List the parameter files that a command line of ROS 2 names."""
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
