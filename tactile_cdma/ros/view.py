"""A terminal viewer: subscribes to a skin's topic like any other client.

On a terminal it draws the skin live; otherwise, or with --seconds, it prints a line per second
and ends with a summary of `key=value` pairs.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import time
from collections import deque

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from numpy.typing import NDArray
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.utilities import remove_ros_args

from tactile_cdma.msg import TactileArray

from ..heatmap import colours

DRAW_PERIOD_S = 0.1
RATE_SPAN_S = 3.0
PATIENCE_S = 10.0
QUEUE = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=256, reliability=ReliabilityPolicy.BEST_EFFORT
)
_RESET, _HOME, _CLEAR_BELOW, _CLEAR_LINE = "\x1b[0m", "\x1b[H", "\x1b[J", "\x1b[K"
_ENTER, _LEAVE = "\x1b[?1049h\x1b[?25l", "\x1b[?25h\x1b[?1049l"
_CELL = 7
"""Width of a taxel with its value, in characters."""


class Tally:
    """Counts what arrived. Latency is a message's age: from the middle of its frame to here.

    published: frames that the driver counted between the first and the last one received; where it
        was started again, over all its runs.
    lost: those of them that did not arrive.
    """

    def __init__(self) -> None:
        self.received = 0
        self.published = 0
        self.latency_ms: deque[float] = deque(maxlen=100_000)
        self._run: tuple[int, int] | None = None  # info_id and sequence of the last message
        self._arrivals_s: deque[float] = deque(maxlen=512)
        self._begin_s = self._end_s = 0.0

    def add(self, info_id: int, sequence: int, age_s: float, now_s: float) -> None:
        """One message arrived."""
        continues = self._run is not None and self._run[0] == info_id and sequence > self._run[1]
        self.published += sequence - self._run[1] if continues and self._run else 1
        self._run = (info_id, sequence)
        self.received += 1
        self.latency_ms.append(age_s * 1e3)
        self._arrivals_s.append(now_s)
        self._begin_s = self._begin_s or now_s

    @property
    def lost(self) -> int:
        """Frames that did not arrive."""
        return self.published - self.received

    def end(self, now_s: float) -> None:
        """Nothing more is counted."""
        self._end_s = now_s

    @property
    def mean_rate_hz(self) -> float:
        """Messages per second from the first one to the end."""
        return (self.received - 1) / (self._end_s - self._begin_s) if self.received > 1 else 0.0

    def rate_hz(self, now_s: float) -> float:
        """Messages per second over the last few seconds."""
        recent = [t for t in self._arrivals_s if now_s - t < RATE_SPAN_S]
        span = now_s - recent[0] if len(recent) > 1 else 0.0
        return (len(recent) - 1) / span if span > 0 else 0.0

    def percentile_ms(self, percent: float, last: int | None = None) -> float:
        """A percentile of the latency, over all or the last few messages."""
        values = list(self.latency_ms)[-last:] if last else self.latency_ms
        return float(np.percentile(values, percent)) if values else float("nan")


class Viewer(Node):
    """Keeps the latest frame, the tally, and what the driver last said of itself."""

    def __init__(self, topic: str) -> None:
        super().__init__("skin_view")
        self.tally = Tally()
        self.latest: TactileArray | None = None
        self.complaint = ""
        self._driver = topic.strip("/").rpartition("/")[0]
        self.create_subscription(TactileArray, topic, self._receive, QUEUE)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._diagnose, 10)

    def _diagnose(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.startswith(f"{self._driver}:"):
                good = status.level == DiagnosticStatus.OK
                self.complaint = "" if good else status.message

    def _receive(self, message: TactileArray) -> None:
        now = self.get_clock().now().nanoseconds
        sent = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
        self.tally.add(message.info_id, message.sequence, (now - sent) * 1e-9, time.monotonic())
        self.latest = message

    def spin_for(self, seconds: float) -> None:
        """Receive for a while."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            rclpy.spin_once(self, timeout_sec=left)


def draw(
    message: TactileArray, tally: Tally, complaint: str, max_pa: float, size: os.terminal_size
) -> str:
    """One screen: a coloured cell per taxel, its pressure in kPa, and lines of state."""
    pressure = np.array(message.pressure, dtype=np.float32)
    status = np.array(message.status, dtype=np.uint8)
    paint = colours(pressure, max_pa)
    rows, columns, width = _arrange(message.height, message.width, size)
    tall = 3 if width == _CELL and 3 * rows + 6 <= size.lines else 1
    lines = [
        f"tactile_cdma  {message.header.frame_id}  {message.height} x {message.width} taxels, kPa",
        "",
    ]
    for row in range(min(rows, size.lines - 6)):
        for line in range(tall):
            cells = []
            begin = row * columns
            for i in range(begin, min(begin + columns, begin + size.columns // width, len(paint))):
                labelled = line == tall // 2 and width == _CELL
                text = _label(pressure[i], status[i]) if labelled else ""
                cells.append(_paint(text.center(width), paint[i]))
            lines.append("".join(cells) + _RESET)
    silent = int(np.count_nonzero(status & TactileArray.STATUS_SILENT))
    stale = int(np.count_nonzero(status & TactileArray.STATUS_STALE))
    doubtful = int(np.count_nonzero(status & TactileArray.STATUS_LOW_SNR))
    saturated = int(np.count_nonzero(status & TactileArray.STATUS_SATURATED))
    lines += [
        "",
        f"{tally.rate_hz(time.monotonic()):6.1f} frames/s   "
        f"age {tally.percentile_ms(50, 256):5.2f} ms (p99 {tally.percentile_ms(99, 256):5.2f})   "
        f"received {tally.received}   lost {tally.lost}",
        f"speaking {status.size - silent}   silent {silent}   stale {stale}   "
        f"low SNR {doubtful}   saturated {saturated}   noise {message.noise_rms * 1e3:.2f} mV"
        "   Ctrl-C ends",
        f"DRIVER: {complaint}" if complaint else "",
    ]
    # Only lines of cells hold escape sequences, and those are not longer than the terminal.
    fitted = [line if "\x1b" in line else line[: size.columns] for line in lines]
    return _HOME + "".join(line + _CLEAR_LINE + "\n" for line in fitted) + _CLEAR_BELOW


def _arrange(height: int, taxels: int, size: os.terminal_size) -> tuple[int, int, int]:
    """Rows and columns to draw, and the width of a cell; a single row is wrapped to the screen."""
    widths = (_CELL, 2, 1)
    if height > 1:
        return height, taxels, next((w for w in widths if w * taxels <= size.columns), 1)
    for width in widths:
        columns = max(1, min(taxels, size.columns // width))
        rows = -(-taxels // columns)
        if rows <= size.lines - 6:
            break
    return rows, columns, width


def _label(pressure_pa: float, status: int) -> str:
    if np.isnan(pressure_pa):
        return "--"
    mark = "!" if status & TactileArray.STATUS_SATURATED else ""
    mark += "?" if status & TactileArray.STATUS_LOW_SNR else ""
    return f"{pressure_pa / 1e3:.1f}{mark}"


def _paint(text: str, rgb: NDArray[np.uint8]) -> str:
    red, green, blue = (int(channel) for channel in rgb)
    ink = "30" if red * 0.3 + green * 0.6 + blue * 0.1 > 110 else "97"
    return f"\x1b[{ink};48;2;{red};{green};{blue}m{text}"


def live(viewer: Viewer, max_pa: float) -> None:
    """Draw until interrupted."""
    sys.stdout.write(_ENTER)
    try:
        while rclpy.ok():
            viewer.spin_for(DRAW_PERIOD_S)
            if viewer.latest is None:
                reason = f"\n{viewer.complaint}" if viewer.complaint else ""
                screen = f"{_HOME}waiting for the first frame …{_CLEAR_LINE}{reason}{_CLEAR_BELOW}"
            else:
                size = shutil.get_terminal_size()
                screen = draw(viewer.latest, viewer.tally, viewer.complaint, max_pa, size)
            sys.stdout.write(screen)
            sys.stdout.flush()
    finally:
        sys.stdout.write(_LEAVE)
        sys.stdout.flush()


def report(viewer: Viewer, seconds: float) -> None:
    """A line per second for so many seconds, counted from the first frame.

    What the driver complains of for more than a line goes to stderr, once.
    """
    patience = time.monotonic() + PATIENCE_S
    while viewer.latest is None and time.monotonic() < patience:
        viewer.spin_for(0.05)
    start = time.monotonic()
    complaint = said = ""
    while viewer.latest is not None and (left := start + seconds - time.monotonic()) > 0:
        before = viewer.tally.received
        viewer.spin_for(min(1.0, left))
        new = viewer.tally.received - before
        pressure = in_use(viewer.latest)
        known = pressure[~np.isnan(pressure)]
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
            print(f"driver: {lasting}", file=sys.stderr, flush=True)
            said = lasting
        complaint = viewer.complaint


def in_use(message: TactileArray) -> NDArray[np.float32]:
    """Pressures of the taxels that are not out of service."""
    status = np.array(message.status, dtype=np.uint8)
    pressure = np.array(message.pressure, dtype=np.float32)
    return np.asarray(pressure[status & TactileArray.STATUS_MASKED == 0])


def summary(tally: Tally) -> str:
    """The last line: key=value pairs."""
    return (
        f"published={tally.published} received={tally.received} lost={tally.lost} "
        f"rate_hz={tally.mean_rate_hz:.2f} p50_ms={tally.percentile_ms(50):.2f} "
        f"p99_ms={tally.percentile_ms(99):.2f}"
    )


def main() -> int:
    """View until interrupted or for the time asked; exit code 1 if nothing arrived."""
    parser = argparse.ArgumentParser(prog="skin_view", description=__doc__)
    parser.add_argument("--topic", default="/skin/tactile", help="TactileArray topic")
    parser.add_argument("--seconds", type=float, help="print a line per second for so long")
    parser.add_argument("--max-kpa", type=float, default=140.0, help="top of the colour scale")
    arguments = parser.parse_args(remove_ros_args(sys.argv)[1:])
    rclpy.init(args=sys.argv)
    viewer = Viewer(arguments.topic)
    plain = arguments.seconds is not None or not (sys.stdin.isatty() and sys.stdout.isatty())
    try:
        if plain:
            report(viewer, arguments.seconds or 10.0)
        else:
            live(viewer, arguments.max_kpa * 1e3)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        viewer.tally.end(time.monotonic())
        viewer.destroy_node()
        rclpy.try_shutdown()
    if not viewer.tally.received:
        reason = viewer.complaint or "is the driver running and active?"
        print(f"no frame on {arguments.topic}: {reason}", file=sys.stderr)
    print(summary(viewer.tally))
    return 0 if viewer.tally.received else 1


if __name__ == "__main__":
    sys.exit(main())
