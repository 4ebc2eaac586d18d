# SPDX-License-Identifier: Apache-2.0

"""The command `tactile-cdma`: decode, record, simulate, set up hardware, without ROS."""

import argparse
import io
import logging
import os
import signal
import sys
from collections.abc import Sequence
from importlib import import_module

from .. import __version__
from ..base.errors import TactileError

SUBCOMMANDS = {
    "view": "show the skin of a port in the terminal",
    "decode": "decode a recording or an oscilloscope capture",
    "record": "write the bytes of a port to a file",
    "info": "say what is in a recording or a bag",
    "export": "write frames as NPZ, CSV, Parquet, LeRobotDataset or bag",
    "simulate": "run a virtual digitizer behind a real tty",
    "node": "write or read what sensing nodes are programmed with",
    "amplifier": "values of the parts between the nodes and the digitizer",
    "ports": "list serial ports and the digitizers on them",
    "doctor": "check this installation or a port, and report problems",
    "layout": "check a layout file and draw it with node numbers",
    "calibrate": "fit the nodes' curves to known loads",
    "examples": "copy config, layouts and examples into a folder",
}
"""Subcommands and their help texts. The module of that name, of `doctor` its `command`, has
add_arguments(parser), and run(arguments), which returns the exit code."""
_MODULES = {
    name: import_module("..doctor.command" if name == "doctor" else f".{name}", __package__)
    for name in SUBCOMMANDS
}
INTERRUPTED = 128 + signal.SIGINT
"""The exit code that shells know."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # a terminal of another alphabet, odd file names
        sys.stdout.reconfigure(errors="backslashreplace")
    parser = make_parser()
    if "_ARGCOMPLETE" in os.environ:  # a shell asks, which its user told to
        import argcomplete

        argcomplete.autocomplete(parser)
    try:
        arguments = parser.parse_args(argv)
        if arguments.verbose:
            logging.basicConfig(format="%(name)s: %(message)s")
            logging.getLogger("tactile_cdma").setLevel(logging.DEBUG)
        code: int = arguments.run(arguments)
        sys.stdout.flush()
        return code
    except BrokenPipeError:  # the reader of our output has seen enough
        sys.stderr.close()
        return 0
    except (TactileError, OSError) as error:  # a full disk behind our output, for one
        print(f"tactile-cdma: {error}", file=sys.stderr)
        try:
            sys.stdout.flush()
        except OSError:  # discard what cannot be written; Python would try once more when it ends
            with open(os.devnull, "w") as nowhere:
                os.dup2(nowhere.fileno(), sys.stdout.fileno())
        return 1
    except KeyboardInterrupt:
        return INTERRUPTED


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of all subcommands; what it parses has run, and parser for errors."""
    parser = argparse.ArgumentParser(prog="tactile-cdma", description=__doc__)
    parser.add_argument("--version", action="version", version=__version__)
    text = "log what is read and found on stderr"
    parser.add_argument("-v", "--verbose", action="store_true", help=text)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, text in SUBCOMMANDS.items():
        module = _MODULES[name]
        subcommand = commands.add_parser(name, help=text)
        subcommand.set_defaults(run=module.run, parser=subcommand)
        module.add_arguments(subcommand)
    return parser


if __name__ == "__main__":
    sys.exit(main())
