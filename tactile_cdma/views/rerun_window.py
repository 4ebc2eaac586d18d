# SPDX-License-Identifier: Apache-2.0

"""Opens the Rerun viewer, in a window or a browser, or a file of what it would show."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from ..base.errors import TactileError, needed_for

if TYPE_CHECKING:
    import rerun as rr

RATE_HZ = 30.0
"""Updates of the viewer per second; chosen: what a screen shows smoothly."""
WEB_PORT = 9090
"""The port that Rerun's web viewer has by default."""


def add_rerun_options(parser: argparse.ArgumentParser) -> None:
    """Add what `recording` looks at."""
    parser.add_argument("--memory", default="1GB", help="limit at which Rerun drops the oldest")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--web", action="store_true", help="Rerun in a browser")
    where.add_argument("--save", metavar="FILE.rrd", help="for Rerun, to be opened later")


@contextmanager
def recording(arguments: argparse.Namespace) -> Iterator[rr.RecordingStream]:
    """Yield what is shown, or saved; raises TactileError where it cannot be.

    A window; without a display, or if asked to, the viewer is served for browsers.
    """
    with needed_for("the Rerun viewer", "rerun", "rerun-sdk"):
        import rerun as rr
    stream = rr.RecordingStream("tactile_cdma")
    display = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
    try:
        if arguments.save:
            stream.save(arguments.save)
        elif display and not arguments.web:
            # That of a venv is not on the path unless it is activated.
            viewer = Path(sys.executable).with_name("rerun")
            path = str(viewer) if viewer.exists() else None
            rr.spawn(memory_limit=arguments.memory, executable_path=path, recording=stream)
        else:
            if not arguments.web:
                print("no display here: serving the viewer for browsers instead", flush=True)
            source = stream.serve_grpc(server_memory_limit=arguments.memory)
            rr.serve_web_viewer(web_port=WEB_PORT, open_browser=display, connect_to=source)
            print(f"open http://localhost:{WEB_PORT}/?url={source}", flush=True)
    except (OSError, RuntimeError, ValueError) as error:
        raise TactileError(f"the viewer cannot be started: {error}") from None
    try:
        yield stream
    finally:
        stream.flush(timeout_sec=5.0)
        stream.disconnect()
