# SPDX-License-Identifier: Apache-2.0

"""The subcommand `tactile-cdma view`: shows the skin of a port in the terminal, live."""

import argparse
import os
import sys
import time
from functools import partial
from typing import Any

from ..base.errors import ParameterError
from ..base.interrupt import Stop, stop_event
from ..config.arguments import add_skin_options, given, positive
from ..config.parameters import SIMULATION
from ..skin import Frame, Skin
from ..views.live import DRAW_PERIOD_S, KEY_HELP, Course, can_draw, live, look_for, over, unread
from ..views.terminal import Look, Reading, scale, screen, status_lines

OLD_S = 1.0
"""Time without a frame after which none is shown as of now, s; chosen as the ROS viewers'."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand."""
    text = "device path, usb://SERIAL, replay://FILE or another pyserial URL (sim://)"
    parser.add_argument("port", nargs="?", help=text)
    parser.add_argument("--seconds", type=positive, help="duration [s] (until q)")
    parser.add_argument("--max-kpa", type=positive, default=140.0, help="top of the colour scale")
    add_skin_options(parser, "the driver's")


def run(arguments: argparse.Namespace) -> int:
    """View until a key or Ctrl-C ends it; returns the exit code, 1 if nothing arrived."""
    if not can_draw():
        raise ParameterError("no terminal to draw on; tactile-cdma decode prints frames as lines")
    values: dict[str, Any] = {"port": SIMULATION, **given(arguments)}
    values["port"] = arguments.port or values["port"]
    shown = Shown(Skin(**values))
    look = look_for(sys.stdout.encoding, arguments.max_kpa * 1e3)
    with shown.skin, stop_event(arguments.seconds) as stop:
        live(look, lambda: shown.waited(stop), partial(draw, shown))
        silence = shown.skin.silence
    if shown.latest is None:
        print(f"tactile-cdma: {values['port']}: no frame: {silence}", file=sys.stderr)
    return int(shown.latest is None)


class Shown:
    """Keeps the newest frame of a skin, what force and peak were before, and how many were lost."""

    def __init__(self, skin: Skin) -> None:
        self.skin, self.course = skin, Course()
        self.latest: Frame | None = None
        self.lost, self._heard_s = 0, 0.0

    def waited(self, stop: Stop) -> bool:
        """Wait for DRAW_PERIOD_S and take what has come; returns whether to go on."""
        time.sleep(DRAW_PERIOD_S)
        for frame in self.skin.waiting():
            self._heard_s = time.monotonic()
            self.lost += frame.sequence - self.latest.sequence - 1 if self.latest else 0
            self.course.add(self._heard_s, frame.pressure_pa, frame.status, self.skin.layout)
            self.latest = frame
        return not (stop.is_set() or self.skin.ended)

    @property
    def is_of_now(self) -> bool:
        """Tell whether the newest frame shows the skin as it is."""
        return time.monotonic() - self._heard_s < OLD_S

    def reading(self, frame: Frame) -> Reading:
        """Read the newest frame; once it is old, no taxel is read."""
        pressure_pa, status = frame.pressure_pa.copy(), frame.status.copy()
        if not self.is_of_now:
            unread(pressure_pa, status)
        return Reading(pressure_pa, status, self.skin.layout.raster, self.skin.layout.nodes)


def draw(shown: Shown, look: Look, of_force: bool, size: os.terminal_size) -> str:
    """Draw a screen as text. of_force: show the curve of the force, not of the peak."""
    frame, problem = shown.latest, shown.skin.problem or ""
    if frame is None:
        return over(["waiting for the first frame ...", problem])
    reading = shown.reading(frame)
    title = f"tactile_cdma  {shown.skin.port}  {len(shown.skin.layout)} taxels, kPa"
    notes = [
        *filter(None, [problem]),
        scale(look, size.columns),
        f"lost {shown.lost}   noise {frame.noise_rms_v * 1e3:.2f} mV",
        shown.course.line(of_force, shown.is_of_now, size.columns, look.unicode),
        *status_lines(reading, look, size.columns),
        KEY_HELP,
    ]
    return over(screen(reading, look, title, notes, size.columns, size.lines))
