# SPDX-License-Identifier: Apache-2.0

"""The command `tactile-cdma`: decode, record, simulate, set up hardware, without ROS."""

from __future__ import annotations

import argparse
import io
import signal
import sys
from collections.abc import Sequence

from .. import __version__
from ..base.errors import TactileError
from ..calibrating import command as calibrate
from ..doctor import command as doctor
from ..sim import sensor_report
from . import amplifier, decode, export, info, layout, node, ports, record, simulate

SUBCOMMANDS = (
    *(decode, record, info, export, simulate, node, amplifier),
    *(ports, doctor, layout, calibrate, sensor_report),
)
"""Each has add_to(commands), which adds its parser, and run(arguments), its work."""
INTERRUPTED = 128 + signal.SIGINT
"""The exit code that shells know."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # a terminal of another alphabet, odd file names
        sys.stdout.reconfigure(errors="backslashreplace")
    parser = argparse.ArgumentParser(prog="tactile-cdma", description=__doc__)
    parser.add_argument("--version", action="version", version=__version__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for subcommand in SUBCOMMANDS:
        subcommand.add_to(commands)
    arguments = parser.parse_args(argv)
    try:
        code: int = arguments.run(arguments)
        return code
    except BrokenPipeError:  # the reader of our output has seen enough
        sys.stderr.close()
        return 0
    except (TactileError, OSError) as error:  # a full disk behind our output, for one
        print(f"tactile-cdma: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
