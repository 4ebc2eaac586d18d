# SPDX-License-Identifier: Apache-2.0

"""A terminal viewer: subscribes to a skin's topics like any other client.

On a terminal it draws the skin live; otherwise, or with --seconds, it prints a line per second
and ends with a summary of `key=value` pairs.
"""

import argparse
import math
import os
import sys
import time
from functools import partial

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from rclpy.node import Node

from tactile_cdma.msg import TactileArray, TactileSkinInfo

from ...base.program import Drawn, program, tell
from ...config.arguments import positive
from ...config.body_file import full_name
from ...places.layout import Layout
from ...readings.status import is_in_service
from ...views.live import DRAW_PERIOD_S, OLD_S, Course, can_draw, live, look_for, over, page, unread
from ...views.terminal import Look, Reading
from ..common.convert import layout_of, nanoseconds, readings_of
from ..common.newest import Newest, Rivals
from ..common.nodes import all_or_nothing
from ..common.process import PATIENCE_S, Running, own_words, running
from ..common.qos import LATCHED, QUEUE
from .watched import LEVELS, Complaints, Tally, summary

COMPLAINTS = 3
"""Complaints of the driver that are shown, the worst first: few, to leave room for the skin."""


class Viewer(Node):
    """Keeps the latest frame, a history of force and peak, and the driver's diagnostics.

    patch: fully qualified name of the driver. rivals: whether several drivers publish the topic.
    """

    @all_or_nothing
    def __init__(self, topic: str) -> None:
        super().__init__("skin_view")
        self.tally, self.newest = Tally(), Newest(self.get_clock(), OLD_S)
        self.course = Course()
        self.latest: TactileArray | None = None
        self.layout: Layout | None = None
        self._topic = topic
        self.patch = driver = topic.rpartition("/")[0]
        self.complaints = Complaints(driver.strip("/"))
        self.create_subscription(TactileArray, topic, self._receive, QUEUE)
        self.create_subscription(TactileSkinInfo, f"{driver}/info", self._inform, LATCHED)
        self.create_subscription(DiagnosticArray, "/diagnostics", self.complaints.take, 10)
        self.rivals = Rivals(self, topic)

    @property
    def complaint(self) -> str:
        return self.rivals.problem or self.newest.refused or self.complaints.worst

    @property
    def other_topics(self) -> list[str]:
        kind, topics = "tactile_cdma/msg/TactileArray", self.get_topic_names_and_types()
        others = (name for name, kinds in topics if kind in kinds and name != self._topic)
        return sorted(others)

    def _inform(self, message: TactileSkinInfo) -> None:
        self.layout = layout_of(message)

    def _receive(self, message: TactileArray, about: dict[str, int | None]) -> None:
        self.rivals.hear(about)
        pressure_pa, status = readings_of(message)
        now_s = time.monotonic()
        stamp_ns = nanoseconds(message.header.stamp)
        age_ns = self.get_clock().now().nanoseconds - stamp_ns
        self.tally.add(message.info_id, message.sequence, age_ns * 1e-9, now_s)
        frame = message.info_id, message.sequence
        if not self.newest.take(stamp_ns, frame, message.stamp_uncertainty):
            return
        self.latest = message
        self.course.add(now_s, pressure_pa, status, self.layout)

    @property
    def silent_s(self) -> float:
        """Return the time without a frame of now, s; 0 while there is one."""
        return 0.0 if self.newest.is_of_now else self.newest.silent_s

    def reading(self, message: TactileArray) -> Reading:
        """Read the last frame, to draw: by its layout, or by rows and columns until that came.

        Once it is older than OLD_S, all taxels are stale.
        """
        pressure_pa, status = readings_of(message)
        if self.silent_s:
            unread(pressure_pa, status)
        taxels = np.arange(len(pressure_pa), dtype=np.int32)
        raster, nodes = taxels.reshape(message.height, message.width), taxels + 1
        if self.layout is not None and len(self.layout) == len(taxels):
            raster, nodes = self.layout.raster, self.layout.nodes
        return Reading(pressure_pa, status, raster, nodes)


def draw(viewer: Viewer, look: Look, of_force: bool, size: os.terminal_size) -> Drawn:
    """Draw a screen as text. of_force: show the history of the total force, not of the peak."""
    if (message := viewer.latest) is None:
        return over(["waiting for the first frame ...", viewer.complaint])
    reading, silent_s, tally = viewer.reading(message), viewer.silent_s, viewer.tally
    title = (
        f"tactile_cdma  {viewer.patch}  {message.header.frame_id}  "
        f"{message.height} x {message.width} taxels, kPa"
    )
    complaints = [
        f"{LEVELS[entry.level]} {entry.name.partition(': ')[2]}: {entry.message}"
        for entry in viewer.complaints.worst_first()
    ]
    silence = f"no frame for {silent_s:.0f} s" if silent_s else ""
    above = viewer.rivals.problem, viewer.newest.refused, silence, *complaints[:COMPLAINTS]
    state = (
        f"{tally.rate_hz(time.monotonic()):.1f} frames/s   lost {tally.lost}   "
        f"age {tally.percentile_ms(50, 256):.2f} ms (p99 {tally.percentile_ms(99, 256):.2f})   "
        f"noise {message.noise_rms * 1e3:.2f} mV"
    )
    curve = viewer.course.line(of_force, not silent_s, size.columns, look.unicode)
    return page(reading, look, size, title, *above, below=[state, curve])


def report(process: Running[Viewer], seconds: float) -> None:
    """Print a line per second for some seconds, counted from the first frame.

    A complaint of the driver that lasts longer than a line goes to stderr, once.
    """
    viewer, patience = process.node, time.monotonic() + PATIENCE_S
    while viewer.latest is None and time.monotonic() < patience and process.spin(0.05):
        pass
    start = time.monotonic()
    complaint = said = ""
    while viewer.latest is not None and (left := start + seconds - time.monotonic()) > 0:
        before = viewer.tally.received
        if not process.spin(min(1.0, left)):
            return
        new = viewer.tally.received - before
        pressure = in_use(viewer.latest)
        known = pressure[~np.isnan(pressure)] if new and not viewer.silent_s else pressure[:0]
        peak = f"{known.max() / 1e3:6.1f}" if known.size else "   --"
        age = f"{viewer.tally.percentile_ms(50, new):.2f}" if new else "--"
        print(
            f"{time.monotonic() - start:5.1f} s  {new:4d} frames  lost {viewer.tally.lost}  "
            f"age p50 {age} ms  peak {peak} kPa  "
            f"{known.size}/{pressure.size} taxels valid",
            flush=True,
        )
        lasting = complaint if complaint == viewer.complaint else ""
        if lasting and lasting != said:
            tell(lasting, "driver")
            said = lasting
        complaint = viewer.complaint


def in_use(message: TactileArray) -> NDArray[np.float32]:
    """Return pressures of the taxels that are not out of service."""
    pressure_pa, status = readings_of(message)
    return np.asarray(pressure_pa[is_in_service(status)])


@program("skin_view")
def main() -> int:
    """View until interrupted or for --seconds; returns the exit code, 1 if nothing arrived."""
    parser = argparse.ArgumentParser(prog="skin_view", description=__doc__)
    parser.add_argument("patch", nargs="?", default="skin", help="left_palm, or /left_palm/skin")
    parser.add_argument("--topic", help="TactileArray topic, instead of a patch")
    parser.add_argument("--seconds", type=float, help="print a line per second for so long")
    parser.add_argument("--max-kpa", type=positive, default=140.0, help="top of the colour scale")
    arguments = parser.parse_args(own_words())
    topic = arguments.topic or f"{full_name(arguments.patch)}/tactile"
    terminal = sys.stdin.isatty() and sys.stdout.isatty()
    with running(lambda: Viewer(topic)) as process:
        viewer = process.node
        if can_draw() and arguments.seconds is None:
            look = look_for(sys.stdout.encoding, arguments.max_kpa * 1e3)
            live(look, lambda: process.spin(DRAW_PERIOD_S), partial(draw, viewer))
        else:
            report(process, arguments.seconds or (math.inf if terminal else 10.0))
        viewer.tally.end(time.monotonic())
        others, complaint = [] if viewer.latest else viewer.other_topics, viewer.complaint
    if not viewer.latest:
        seen = f"there is {', '.join(others)}" if others else ""
        reason = complaint or seen or "is the driver running and active, and as this user?"
        tell(f"no frame on {topic}: {reason}", "skin_view")
    print(summary(viewer.tally))
    return 0 if viewer.latest else 1


if __name__ == "__main__":
    sys.exit(main())
