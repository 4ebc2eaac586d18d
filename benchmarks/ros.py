# SPDX-License-Identifier: Apache-2.0

"""Latency from a frame's last byte to the subscriber's callback: `make bench-ros`.

Three processes, as in use: this one is the digitizer behind a pseudo-terminal, the second is the
driver node, the third subscribes to ~/tactile. All read one monotonic clock. A frame's time begins
when the last byte of the packet with its last sample is written (raw frames: with the last sample
that line timing waits for), and ends in the subscriber's callback. So it holds reading, decoding,
publishing, DDS and the subscriber's deserialisation, and no code time.

"Floor" is what this takes at least: in place of the driver, a process reads the same bytes from
the same digitizer and publishes a finished message of the same size after the last byte of each
frame, which it counts up to without looking at any. "CPU" is that of the driver's, or of this
process.

A run that loses frames, or does not get so far, ends with one line that says so, and exit code 1.
"""

from __future__ import annotations

import multiprocessing
import os
import pty
import queue
import re
import select
import struct
import subprocess
import sys
import tempfile
import threading
import time
import tty
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from multiprocessing.synchronize import Event as EventType
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from tactile_cdma.config.parameters import Value
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.sim.scene import SCENES
from tactile_cdma.wire._protocol import TAIL_CHIPS
from tactile_cdma.wire.messages import Samples
from tactile_cdma.wire.packets import PacketParser
from tactile_cdma.wire.reader import READ_SIZE

from .report import QUICK, ROOT, Report, be_alone, configured
from .scale import streaming
from .skip import pressed
from .style import sheet

CASES: dict[int, dict[str, Value]] = {
    16: {},  # the paper's timing, 4 raw samples per chip
    256: {"nodes": 255, "chip_us": 5.0, "samples_per_chip": 1, "frame_period_ms": 20.0},
    # of order 1024
    1024: {"nodes": 1023, "chip_us": 1.5, "samples_per_chip": 1, "frame_period_ms": 20.0},
    4096: {
        "nodes": 4096,
        "order": 4160,
        "chip_us": 0.4,
        "samples_per_chip": 1,
        "frame_period_ms": 20.0,
    },
    900: configured("thousand_skin"),
    4000: configured("sparse_skin"),
}
"""Parameters of the driver for each number of nodes; all nodes talk in every frame."""
PRESSED = {4000: 0.08}
"""Share of the nodes that talk where codes are sparse: always the same ones, and no others."""
SIZES = (16, 4096) if QUICK else (16, 256, 1024, 4096)
TURNS, SECONDS = (1, 2.5) if QUICK else (3, 10.0)
"""How often floor and driver are measured by turns, since a machine's pace changes within minutes,
and how long each time, s."""
WARM_UP_S = 1.0
AT_REST_S = 3e-3
"""The virtual digitizer draws no samples for so long after a frame's last byte, s: a real one takes
no core of this machine. Chosen: longer than nearly all frames take to the callback."""
START_S = 30.0
"""Longest time until the first message arrives, s."""
CHUNK = 65_536
MOST_FRAMES = 8192
FLOOR, DRIVER = "floor", "driver"


class RunError(Exception):
    """Tells that a run did not measure what it should; the message is for whoever started it."""


class LateError(RunError):
    """Frames did not arrive, or not in time; says how busy the machine is."""

    def __str__(self) -> str:
        load = f"{os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
        return f"{super().__str__()}; other programs keep this machine busy? (load {load})"


@dataclass(frozen=True, slots=True)
class Result:
    """latency_ms: of every frame received, in order. sent, lost: frames. cpu: share of a core."""

    latency_ms: np.ndarray
    sent: int
    lost: int
    cpu: float

    @property
    def p50_ms(self) -> float:
        return float(np.median(self.latency_ms))

    @property
    def p99_ms(self) -> float:
        return float(np.percentile(self.latency_ms, 99))


class End(NamedTuple):
    """Says where a frame ends: after so many bytes of the stream. middle_us: its device time."""

    bytes: int
    middle_us: int


Results = dict[tuple[str, int], Result]


def main() -> None:
    report = Report("ros", "Last byte of a frame in → subscriber's callback in another process")
    be_alone()
    runs: dict[tuple[str, int], list[Result]] = {}
    for nodes in SIZES:
        for who in (FLOOR, DRIVER) * TURNS:
            runs.setdefault((who, nodes), []).append(measure(who, nodes))
    found = {which: joined(turns) for which, turns in runs.items()}
    report.table(
        ["nodes", "", "frames", "lost", "p5 ms", "p50", "p90", "p99", "max", "CPU %"],
        [
            [nodes, who, some.sent, some.lost, *spread_ms(some), 100 * some.cpu]
            for (who, nodes), some in found.items()
        ],
    )
    lost = sum(some.lost for some in found.values())
    report.finish(
        picture(found),
        p50_ms_floor_16=found[FLOOR, 16].p50_ms,
        p50_ms_16=found[DRIVER, 16].p50_ms,
        p50_ms_floor_4096=found[FLOOR, 4096].p50_ms,
        p50_ms_4096=found[DRIVER, 4096].p50_ms,
        p99_ms_16=found[DRIVER, 16].p99_ms,
        p99_ms_4096=found[DRIVER, 4096].p99_ms,
        cpu_floor_16=round(found[FLOOR, 16].cpu, 4),
        cpu_node_16=round(found[DRIVER, 16].cpu, 4),
        cpu_floor_4096=round(found[FLOOR, 4096].cpu, 4),
        cpu_node_4096=round(found[DRIVER, 4096].cpu, 4),
        lost=lost,
    )
    if lost:
        raise LateError(f"{lost} of {sum(some.sent for some in found.values())} frames were lost")


def joined(turns: list[Result]) -> Result:
    """Several runs as one."""
    return Result(
        np.concatenate([turn.latency_ms for turn in turns]),
        sum(turn.sent for turn in turns),
        sum(turn.lost for turn in turns),
        sum(turn.cpu for turn in turns) / len(turns),
    )


def spread_ms(some: Result) -> list[float]:
    """Return the 5th, 50th, 90th and 99th percentile, and the largest."""
    spread: list[float] = np.percentile(some.latency_ms, [5, 50, 90, 99, 100]).round(3).tolist()
    return spread


def measure(who: str, nodes: int) -> Result:
    """Measure the driver, or the floor, on a live skin for SECONDS."""
    context = multiprocessing.get_context("spawn")
    config = SkinConfig.of(CASES[nodes])
    ends = context.RawArray("q", 2 * MOST_FRAMES)
    stop, receiving, arrivals = context.Event(), context.Event(), context.Queue()
    with tempfile.TemporaryDirectory() as folder:
        digitizer = Digitizer(config, Path(folder) / "skin", ends, PRESSED.get(nodes))
        subscriber = context.Process(target=subscribe, args=(stop, receiving, arrivals))
        if who == DRIVER:
            publisher = driver(CASES[nodes], digitizer.path, Path(folder) / "driver.log")
        else:
            floor = context.Process(target=publish, args=(nodes, str(digitizer.path), ends))
            publisher = process(floor)
        with process(subscriber), digitizer, publisher as pid:
            until_s = time.monotonic() + START_S
            while not receiving.wait(0.5):
                cpu_s(pid)  # is it alive?
                if time.monotonic() > until_s:
                    raise LateError(f"nothing arrived from the {who} of {nodes} nodes")
            time.sleep(WARM_UP_S)
            cpu = cpu_share(pid)
            stop.set()
            try:
                received = sorted(arrivals.get(timeout=20))
            except queue.Empty:
                raise RunError("the subscriber ended without its times") from None
    return match(digitizer.sent, received, config.spec.frame_period_s * 1e6, cpu)


def cpu_share(pid: int) -> float:
    """Return the share of a core that a process takes during SECONDS from now on."""
    begin_s, before_s = time.monotonic(), cpu_s(pid)
    time.sleep(SECONDS)
    return (cpu_s(pid) - before_s) / (time.monotonic() - begin_s)


def cpu_s(pid: int) -> float:
    """CPU time of a process's threads so far, s; raises RunError where it has ended."""
    if "(zombie)" in Path(f"/proc/{pid}/status").read_text():
        raise RunError(
            f"process {pid}, which was to be measured, ended by itself; what it said is above"
        )
    threads = Path(f"/proc/{pid}/task").glob("*/schedstat")
    return sum(int(thread.read_text().split()[0]) for thread in threads) / 1e9


def match(
    sent: dict[int, float], received: list[tuple[int, float]], period_us: float, cpu: float
) -> Result:
    """Pair both sides' times of the same frames; device times agree to a fraction of a chip.

    From the first frame on that was received, a second of warm-up aside, to the last one.
    """
    middles_us = np.array([us for us, _ in received])
    first_us, last_us = middles_us[0] + WARM_UP_S * 1e6, middles_us[-1] + period_us / 2
    latency_ms, count = [], 0
    for us, t_sent in sorted(sent.items()):
        if first_us <= us <= last_us:
            count += 1
            nearest = int(np.argmin(np.abs(middles_us - us)))
            if abs(middles_us[nearest] - us) < period_us / 4:
                latency_ms.append(1e3 * (received[nearest][1] - t_sent))
    if not latency_ms:
        raise LateError(f"none of {count} frames was received in time")
    return Result(np.array(latency_ms), count, count - len(latency_ms), cpu)


class Digitizer:
    """Is the virtual digitizer on a pty; notes when the last byte of each frame was written.

    sent: monotonic time, s, for each frame's middle in device time, µs. ends: shared memory for
    MOST_FRAMES of End, in which each stands before the frame's last byte is written.
    """

    def __init__(
        self, config: SkinConfig, path: Path, ends: Any, pressed_share: float | None
    ) -> None:
        """pressed_share: of the nodes, which talk; None if all do."""
        self.path, scene = path, "scene=all&threshold=0"
        if pressed_share is not None:
            SCENES["press"], scene = pressed(pressed_share), "scene=press&heartbeat=0"
        self.sent: dict[int, float] = {}
        self._config, self._ends, self._frames = config, ends, 0
        self._digitizer = VirtualDigitizer(SimOptions.from_url(f"sim://?{scene}"))
        self._parser = PacketParser()
        self._last: int | None = None  # index of the last sample of the awaited frame
        self._middle_us = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Digitizer:
        self._host, self._device = pty.openpty()
        tty.setraw(self._device)
        os.set_blocking(self._host, False)
        self.path.symlink_to(os.ttyname(self._device))
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        os.close(self._host)
        os.close(self._device)

    def _run(self) -> None:
        outgoing, written, waiting = b"", 0, list[End]()
        while not self._stop.is_set():
            wait_s = self._digitizer.advance(CHUNK)
            if not outgoing:
                outgoing = self._digitizer.take(CHUNK)
                waiting += self._frame_ends(outgoing, written)
            readable, writable, _ = select.select(
                [self._host], [self._host] if outgoing else [], [], min(wait_s, 0.1)
            )
            if readable:
                self._digitizer.receive(os.read(self._host, CHUNK))
            if writable:
                now = time.monotonic()  # before, as the reader may be served before write returns
                count = os.write(self._host, outgoing)
                outgoing, written = outgoing[count:], written + count
                while waiting and waiting[0].bytes <= written:
                    self.sent[waiting.pop(0).middle_us] = now
                    self._stop.wait(AT_REST_S)

    def _frame_ends(self, outgoing: bytes, begin: int) -> Iterator[End]:
        """Note and yield the ends of frames among bytes that follow the first `begin` ones."""
        for piece in re.findall(rb"[^\0]*\0|[^\0]+", outgoing):
            begin += len(piece)
            for packet in self._parser.feed(piece):
                if isinstance(packet, Samples) and self._ends_frame(packet):
                    at = 2 * self._frames
                    self._ends[at : at + 2] = end = End(begin, self._middle_us)
                    self._frames += 1
                    yield end

    def _ends_frame(self, packet: Samples) -> bool:
        spec, per_chip = self._config.spec, self._config.samples_per_chip
        if packet.sync:
            # One value per chip: guards have none.
            count = (spec.span_chips + TAIL_CHIPS) * per_chip if per_chip > 1 else spec.chips
            self._last = packet.first_index + count - 1
            self._middle_us = packet.device_time_us + round(spec.frame_s / 2 * 1e6)
        if self._last is None or packet.first_index + len(packet.counts) <= self._last:
            return False
        self._last = None
        return True


@contextmanager
def process(started: BaseProcess) -> Iterator[int]:
    """Start a process, give its number, and end it."""
    started.start()
    assert started.pid is not None
    try:
        yield started.pid
    finally:
        started.terminate()
        started.join()


@contextmanager
def driver(values: dict[str, Value], port: Path, log: Path) -> Iterator[int]:
    """Start the driver node in a process of its own, give its number, and end it."""
    command = [sys.executable, str(ROOT / "scripts" / "skin_driver"), "--ros-args"]
    for name, value in {**values, "port": str(port)}.items():
        command += ["-p", f"{name}:={value}"]
    with log.open("w") as output:
        started = subprocess.Popen(command, cwd=ROOT, stdout=output, stderr=output)
    try:
        yield started.pid
    finally:
        ended = started.poll() is not None
        started.terminate()
        started.wait(10)
        if ended:
            said = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
            raise RunError(f"the driver ended by itself: {said[-1] if said else 'it said nothing'}")


def publish(nodes: int, path: str, ends: Any) -> None:
    """Read the digitizer's bytes, and publish a finished message after those of each frame.

    ends: see Digitizer.
    """
    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    from rclpy.serialization import serialize_message
    from rclpy.signals import SignalHandlerOptions

    from tactile_cdma.msg import TactileArray

    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # ends when it is told to
    node = rclpy.create_node("skin")
    publisher = node.create_publisher(TactileArray, "/skin/tactile", qos_profile_sensor_data)
    message = TactileArray(pressure=array("f", [0.0] * nodes), status=array("B", [0] * nodes))
    message.header.frame_id, message.device_time_us = "skin", 0x0123456789ABCDEF
    content = bytearray(serialize_message(message))
    at, length, frames = content.index(struct.pack("<q", message.device_time_us)), 0, 0
    with streaming(SkinConfig.of(CASES[nodes]), path) as (port, poll):
        while True:
            poll.poll()
            length += len(os.read(port, READ_SIZE))
            while 0 < ends[2 * frames] <= length:
                struct.pack_into("<q", content, at, ends[2 * frames + 1])
                publisher.publish(bytes(content))
                frames += 1


def subscribe(stop: EventType, receiving: EventType, arrivals: multiprocessing.Queue[Any]) -> None:
    """Note the arrival of every array: (device time of the frame's middle in µs, monotonic s)."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from rclpy.signals import SignalHandlerOptions

    from tactile_cdma.msg import TactileArray

    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("subscriber")
    received: list[tuple[int, float]] = []
    node.create_subscription(
        TactileArray,
        "/skin/tactile",
        lambda message: received.append((message.device_time_us, time.monotonic())),
        QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT),
    )
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not stop.is_set():
        executor.spin_once(timeout_sec=0.1)
        if received:
            receiving.set()
    arrivals.put(received)


def picture(results: Results) -> Figure:
    figure = sheet(460)
    axes = figure.add_subplot()
    for (who, nodes), result in results.items():
        share = np.arange(1, result.latency_ms.size + 1) / result.latency_ms.size
        style = ":" if who == FLOOR else "-"
        colour, label = f"C{SIZES.index(nodes)}", f"{who}, {nodes} nodes"
        axes.plot(np.sort(result.latency_ms), 100 * share, style, color=colour, label=label)
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("")
    axes.set(xlabel="last byte in → callback, ms", ylabel="share of frames, %")
    axes.legend()
    return figure


if __name__ == "__main__":
    try:
        main()
    except RunError as error:
        print(f"bench-ros: {error}")
        sys.exit(1)
