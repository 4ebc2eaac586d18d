# SPDX-License-Identifier: Apache-2.0

"""The subcommand `tactile-cdma simulate`: a virtual digitizer behind a real tty."""

import argparse
from pathlib import Path

from ..base.errors import SpecError
from ..base.interrupt import stop_event
from ..config.arguments import positive
from ..config.parameters import SIMULATION
from ..sim.digitizer import VirtualDigitizer
from ..sim.options import SimOptions
from ..sim.pty import serve
from ..sim.scene import EXTERNAL


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand."""
    parser.add_argument("--pty", action="store_true", required=True, help="serve on a pty")
    parser.add_argument("--link", type=Path, help="also create a symbolic link to the tty")
    parser.add_argument("--seconds", type=positive, help="duration [s] (until Ctrl-C)")
    text = "port with options: 'sim://?scene=press&seed=1'"
    parser.add_argument("url", nargs="?", default=SIMULATION, help=text)


def run(arguments: argparse.Namespace) -> int:
    """Serve until the time is up or Ctrl-C."""
    options = SimOptions.from_url(arguments.url)
    if options.scene == EXTERNAL:
        raise SpecError(
            f"scene={EXTERNAL}: a skin behind a tty cannot be pressed; give this URL as port to "
            "the program, or to the driver, that presses it"
        )
    with stop_event(arguments.seconds) as stop:
        serve(
            lambda: VirtualDigitizer(options),
            arguments.link,
            stop,
            lambda path: print(f"serving on {path}", flush=True),
        )
    return 0
