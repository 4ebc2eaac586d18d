# SPDX-License-Identifier: Apache-2.0

"""The command `tactile-cdma`: one subcommand per module of this folder."""

import argparse
import logging
import os
import sys
from collections.abc import Sequence
from importlib import import_module

from .. import __version__
from ..base.program import program

GROUPS = {
    "every day": {
        "view": "show the skin of a port in the terminal",
        "doctor": "check this installation, or a port and every node on it",
        "record": "write the bytes of a port to a file",
        "calibrate": "fit the nodes' curves to known loads",
    },
    "recordings and bags": {
        "info": "describe a recording or a bag",
        "decode": "print the frames of a recording or an oscilloscope capture",
        "export": "write tables, videos, datasets or bags",
        "plot": "draw pressure and force over time: PDF, SVG, PNG",
    },
    "building a skin": {
        "ports": "list serial ports and the digitizers on them",
        "node": "write or read what a sensing node is programmed with",
        "layout": "check a layout file, and draw it",
        "resistors": "compute a line without an amplifier, for up to 24 nodes",
    },
    "without a skin": {
        "simulate": "run a virtual digitizer behind a real tty",
        "examples": "copy parameter files, layouts and examples into a folder",
    },
}
SUBCOMMANDS = {name: text for group in GROUPS.values() for name, text in group.items()}
"""Subcommands and their help texts. The module of that name, or _ELSEWHERE, has
add_arguments(parser), and run(arguments), which returns the exit code."""
_ELSEWHERE = {"doctor": "..doctor.command", "plot": ".export"}
_MODULES = {
    name: import_module(_ELSEWHERE.get(name, f".{name}"), __package__) for name in SUBCOMMANDS
}


@program("tactile-cdma")
def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    parser = make_parser()
    if "_ARGCOMPLETE" in os.environ:  # a shell asks, which its user told to
        import argcomplete

        argcomplete.autocomplete(parser)
    arguments = parser.parse_args(argv)
    if arguments.verbose:
        logging.basicConfig(format="%(name)s: %(message)s")
        logging.getLogger("tactile_cdma").setLevel(logging.DEBUG)
    code: int = arguments.run(arguments)
    return code


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of all subcommands; what it parses has run, and parser for errors."""
    lines = ["Works with robot skins, their recordings and parts, without ROS."]
    for title, group in GROUPS.items():
        lines += [f"\n{title}:", *(f"  {name:<11}{text}" for name, text in group.items())]
    parser = argparse.ArgumentParser("tactile-cdma", description="\n".join(lines))
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--version", action="version", version=__version__)
    text = "log what is read and found on stderr"
    parser.add_argument("-v", "--verbose", action="store_true", help=text)
    commands = parser.add_subparsers(required=True, metavar="COMMAND", help="as listed above")
    for name, text in SUBCOMMANDS.items():
        module = _MODULES[name]
        subcommand = commands.add_parser(name, description=f"{text[0].upper()}{text[1:]}.")
        subcommand.set_defaults(run=module.run, parser=subcommand)
        module.add_arguments(subcommand)
    return parser


if __name__ == "__main__":
    sys.exit(main())
