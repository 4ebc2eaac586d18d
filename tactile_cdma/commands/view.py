# SPDX-License-Identifier: Apache-2.0

"""The subcommand `tactile-cdma view`: shows the skin of a port in the terminal or Rerun, live."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from functools import partial
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.errors import ParameterError
from ..base.interrupt import Stop, stop_event
from ..base.program import Drawn, tell
from ..config.arguments import add_skin_options, given, positive
from ..config.parameters import SIMULATION
from ..skin import Frame, Skin
from ..views.live import DRAW_PERIOD_S, OLD_S, Course, can_draw, live, look_for, over, page, unread
from ..views.rerun_window import RATE_HZ, add_rerun_options, recording

if TYPE_CHECKING:
    from ..views.rerun_scene import PatchScene
from ..views.terminal import Look, Reading

RERUN = "rerun"
"""Name of the viewer that is not in a terminal, and needs no other package of ours."""
VIEWERS = "tactile_cdma.viewers"
"""Entry points of viewers in other packages: they get a Skin, and show it until it ends."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand."""
    text = "device path, usb://SERIAL, replay://FILE or another pyserial URL (sim://)"
    parser.add_argument("port", nargs="?", help=text)
    parser.add_argument("--seconds", type=positive, help="duration [s] (until q)")
    text = (
        f"instead of the terminal: {RERUN} (pip install rerun-sdk), or an entry point in {VIEWERS}"
    )
    parser.add_argument("--viewer", metavar="NAME", help=text)
    parser.add_argument("--max-kpa", type=positive, default=140.0, help="top of the colours [kPa]")
    add_rerun_options(parser)
    add_skin_options(parser, "the driver's")


def run(arguments: argparse.Namespace) -> int:
    """View until a key or Ctrl-C ends it; returns the exit code, 1 if nothing arrived."""
    values: dict[str, Any] = {"port": SIMULATION, **given(arguments)}
    values["port"] = arguments.port or values["port"]
    if arguments.viewer == RERUN:
        return in_rerun(arguments, Skin(contacts=True, **values))
    if arguments.viewer:
        viewer = viewer_of(arguments.viewer)
        with Skin(**values) as skin:
            viewer(skin)
        return 0
    if not can_draw():
        raise ParameterError("no terminal to draw on; tactile-cdma decode prints frames as lines")
    shown = Shown(Skin(**values))
    look = look_for(sys.stdout.encoding, arguments.max_kpa * 1e3)
    with shown.skin, stop_event(arguments.seconds) as stop:
        live(look, lambda: shown.waited(stop), partial(draw, shown))
        silence = shown.skin.silence
    return exit_code(shown.latest is not None, shown.skin, silence)


def exit_code(has_come: bool, skin: Skin, silence: str) -> int:
    """Return 0 if a frame has come, else 1, and tell why there was none."""
    if not has_come:
        tell(f"{skin.port}: no frame: {silence}")
    return int(not has_come)


def in_rerun(arguments: argparse.Namespace, skin: Skin) -> int:
    """Show a skin that finds contacts in Rerun until Ctrl-C; returns the exit code."""
    with recording(arguments) as stream, skin, stop_event(arguments.seconds) as stop:
        from ..views.rerun_scene import PatchScene, blueprint

        scene = PatchScene(stream, "skin", 0, arguments.max_kpa * 1e3)
        scene.place(skin.layout)
        stream.send_blueprint(blueprint({scene: "skin"}))
        since_ns = time.time_ns() - time.monotonic_ns()
        has_come, problem = False, None
        while not (stop.is_set() or skin.ended):
            time.sleep(1 / RATE_HZ)
            for frame in skin.waiting():
                has_come = True
                log(scene, frame, since_ns)
            if skin.problem != problem:
                problem = skin.problem
                level = "WARN" if problem else "INFO"
                scene.say(time.time_ns(), problem or "frames arrive", level)
            scene.flush()
        return exit_code(has_come, skin, skin.silence)


def log(scene: PatchScene, frame: Frame, since_ns: int) -> None:
    """Let a scene take a frame and its contacts.

    since_ns: Unix time at which the monotonic clock was 0.
    """
    from ..views.rerun_scene import Touches

    found, stamp_ns = frame.contacts, since_ns + round(frame.t_host * 1e9)
    assert found is not None
    scene.take_frame(stamp_ns, round(frame.t_device * 1e6), frame.pressure_pa, frame.status)
    bounds = found.lower_bound.tolist()
    touches = Touches(found.ids.tolist(), found.position_m, found.force_n, bounds)
    scene.take_contacts(stamp_ns, touches, float(np.linalg.norm(found.total_force_n)))


def viewer_of(name: str) -> Callable[[Skin], object]:
    """Load the viewer of another package; raises ParameterError where there is none."""
    points = {point.name: point for point in entry_points(group=VIEWERS)}
    if name not in points:
        there = ", ".join(points) or "none"
        raise ParameterError(f"no installed package has a viewer {name!r}; there are: {there}")
    found: Callable[[Skin], object] = points[name].load()
    return found


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
        return time.monotonic() - self._heard_s < OLD_S

    def reading(self, frame: Frame) -> Reading:
        """Read the newest frame; once it is old, no taxel is read."""
        pressure_pa, status = frame.pressure_pa.copy(), frame.status.copy()
        if not self.is_of_now:
            unread(pressure_pa, status)
        return Reading(pressure_pa, status, self.skin.layout.raster, self.skin.layout.nodes)


def draw(shown: Shown, look: Look, of_force: bool, size: os.terminal_size) -> Drawn:
    """Draw a screen as text. of_force: show the curve of the force, not of the peak."""
    frame, problem = shown.latest, shown.skin.problem or ""
    if frame is None:
        return over(["waiting for the first frame ...", problem])
    reading = shown.reading(frame)
    title = f"tactile_cdma  {shown.skin.port}  {len(shown.skin.layout)} taxels, kPa"
    state = f"lost {shown.lost}   noise {frame.noise_rms_v * 1e3:.2f} mV"
    curve = shown.course.line(of_force, shown.is_of_now, size.columns, look.unicode)
    return page(reading, look, size, title, problem, below=[state, curve])
