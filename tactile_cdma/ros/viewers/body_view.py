# SPDX-License-Identifier: Apache-2.0

"""Prints what touches a body: a line per second, and a summary of `key=value` pairs."""

import argparse
import math
import sys
import time
from collections.abc import Sequence

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Vector3
from rclpy.node import Node

from tactile_cdma.msg import TactileContact, TactileContacts

from ...base.program import program, say, tell
from ...base.text import listed
from ...config.body_file import short_name
from ..common.convert import nanoseconds
from ..common.newest import Newest
from ..common.nodes import all_or_nothing
from ..common.process import PATIENCE_S, Running, own_words, running
from ..common.qos import RELIABLE
from .watched import Complaints, Tally

LINE_S = 1.0
MOST_NAMED = 2
"""Contacts that a line names: more would not fit into the width of a terminal."""


class BodyViewer(Node):
    """Counts the body's messages and keeps the latest."""

    @all_or_nothing
    def __init__(self, body: str) -> None:
        super().__init__("body_viewer")
        self.latest: TactileContacts | None = None
        self.complaints = Complaints(body.strip("/"))
        self.tally, self.newest = Tally(), Newest(self.get_clock(), LINE_S)
        self.create_subscription(TactileContacts, f"{body}/contacts", self._take, RELIABLE)
        self.create_subscription(DiagnosticArray, "/diagnostics", self.complaints.take, 10)

    @property
    def complaint(self) -> str:
        return self.newest.refused or self.complaints.worst

    def _take(self, message: TactileContacts) -> None:
        self.tally.add(message.info_id, message.sequence, 0.0, time.monotonic())
        frame, stamp_ns = (message.info_id, message.sequence), nanoseconds(message.header.stamp)
        if self.newest.take(stamp_ns, frame, message.stamp_uncertainty):
            self.latest = message


def line(message: TactileContacts | None, rate_hz: float, complaint: str) -> str:
    """Return the line of a second: rate, resultant, strongest contacts, absent patches."""
    if message is None:
        return f"nothing yet{': ' + complaint if complaint else ''}"
    absent = listed([*map(short_name, message.absent)])
    valid, in_service = message.taxels_valid, message.taxels_in_service
    notes = [f"{valid} of {in_service} taxels valid"] if valid < in_service else []
    notes += [f"absent: {absent}"] if absent else []
    force_n = _length(message.wrench.force)
    force = "--" if math.isnan(force_n) else f"{'>' if notes else ''}{force_n:.1f}"
    found = _contacts(message.contacts) if message.touched else "no contact"
    if not message.touched and not message.untouched:
        found = "unknown"
    return "  ".join([f"{rate_hz:5.1f} Hz {force:>6} N", found, *notes])


def _contacts(contacts: Sequence[TactileContact]) -> str:
    named = [
        f"{short_name(contact.patch)} {_length(contact.force):.1f} N "
        f"({' '.join(f'{1e3 * getattr(contact.position, axis):z.0f}' for axis in 'xyz')} mm)"
        for contact in contacts[:MOST_NAMED]
    ]
    more = len(contacts) - len(named)
    return "; ".join(named) + (f"; {more} more" if more else "")


def _length(vector: Vector3) -> float:
    return math.hypot(vector.x, vector.y, vector.z)


def _report(process: Running[BodyViewer], seconds: float) -> None:
    viewer = process.node
    patience_s = time.monotonic() + PATIENCE_S
    while viewer.latest is None and time.monotonic() < patience_s:
        if not process.spin(LINE_S):
            return
        if viewer.latest is None:
            say(line(None, 0.0, viewer.complaint))
    end_s = time.monotonic() + (seconds if viewer.latest else seconds - PATIENCE_S)
    while (left_s := end_s - time.monotonic()) > 0 and process.spin(min(LINE_S, left_s)):
        if left_s < LINE_S:
            return
        if viewer.latest and not viewer.newest.is_of_now:
            since = f"for {viewer.newest.silent_s:.1f} s"
            say(viewer.newest.refused or f"no message {since}")
            continue
        rate_hz = viewer.tally.rate_hz(time.monotonic())
        say(line(viewer.latest, rate_hz, viewer.complaint))


@program("skin_body_view")
def main() -> int:
    """Print until interrupted or for --seconds; returns the exit code, 1 if nothing arrived."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--body", default="/body", help="the body's node")
    parser.add_argument("--seconds", type=float, default=math.inf, help="default: until Ctrl-C")
    arguments = parser.parse_args(own_words())
    with running(lambda: BodyViewer(arguments.body)) as process:
        _report(process, arguments.seconds)
    viewer = process.node
    latest = viewer.latest
    if latest is None:
        reason = viewer.complaint or "does the node body run?"
        tell(f"no message on {arguments.body}/contacts: {reason}", "skin_body_view")
    absent = len(latest.absent) if latest else 0
    print(f"received={viewer.tally.received} lost={viewer.tally.lost} absent={absent}")
    return 0 if latest else 1


if __name__ == "__main__":
    sys.exit(main())
