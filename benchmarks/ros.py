# SPDX-License-Identifier: Apache-2.0

"""Latency from a frame's last byte to the subscriber's callback: `make bench-ros`.

Three processes, as in use: this one is the digitizer behind a pseudo-terminal, the second is the
driver node, the third subscribes to ~/tactile. All read one monotonic clock. A frame's time begins
when the last byte of the packet with its last sample is written (raw frames: with the last sample
that line timing waits for), and ends in the subscriber's callback. So it holds reading, decoding,
publishing, DDS and the subscriber's deserialisation, and no code time. "bare" is what a process
takes that does nothing but publish finished messages of 16 taxels at the same rate: the floor.
"CPU" is that of the whole driver process, or of the one that only publishes. A run of its own, in
which the driver notes the time as a frame passes, tells how the latency divides into stages.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import pty
import select
import subprocess
import sys
import tempfile
import threading
import time
import tty
from array import array
from collections.abc import Mapping
from dataclasses import dataclass
from multiprocessing.synchronize import Event as EventType
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from tactile_cdma.config.parameters import Value
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.steady import Waited
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.wire._protocol import TAIL_CHIPS
from tactile_cdma.wire.messages import Samples
from tactile_cdma.wire.packets import PacketParser

from .report import QUICK, ROOT, Report

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
}
"""Parameters of the driver for each number of nodes; all nodes talk in every frame."""
SIZES = (16, 4096) if QUICK else tuple(CASES)
SECONDS = 2.5 if QUICK else 30.0
WARM_UP_S = 1.0
DOMAIN = 77
PAPER_PERIOD_US = 12_800
CHUNK = 65_536
STAGES = ("bytes → read", "→ separated", "→ decoded", "→ received", "of it publishing")


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


def main() -> None:
    report = Report("ros", "Last byte of a frame in → subscriber's callback in another process")
    os.environ["ROS_DOMAIN_ID"] = str(DOMAIN)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    bare = measure_bare()
    results: dict[int | str, Result] = {nodes: measure(CASES[nodes]) for nodes in SIZES}
    named = {"bare": bare, **results}
    report.table(
        ["nodes", "frames", "lost", "p5 ms", "p50", "p90", "p99", "max", "p50 − bare", "CPU %"],
        [row(name, some, bare) for name, some in named.items()],
    )
    report.table(
        ["nodes", *(f"{stage}, ms" for stage in STAGES)],
        [[nodes, *stages_ms(CASES[nodes])] for nodes in (SIZES[:1] if QUICK else SIZES)],
    )
    report.finish(
        picture(named),
        p50_ms_bare=bare.p50_ms,
        p50_ms_16=results[16].p50_ms,
        p50_ms_4096=results[4096].p50_ms,
        p99_ms_16=float(np.percentile(results[16].latency_ms, 99)),
        p99_ms_4096=float(np.percentile(results[4096].latency_ms, 99)),
        cpu_bare=round(bare.cpu, 4),
        cpu_node_16=round(results[16].cpu, 4),
        cpu_node_4096=round(results[4096].cpu, 4),
        lost=sum(some.lost for some in (bare, *results.values())),
    )


def row(name: int | str, some: Result, bare: Result) -> list[object]:
    """A row of the table."""
    times_ms = np.percentile(some.latency_ms, [5, 50, 90, 99, 100]).round(3)
    beyond_ms = round(some.p50_ms - bare.p50_ms, 3)
    return [name, some.sent, some.lost, *times_ms.tolist(), beyond_ms, 100 * some.cpu]


def measure(values: dict[str, Value]) -> Result:
    """Measure a live skin for SECONDS."""
    sent, received, cpu = live(values)
    return match(sent, received, SkinConfig.of(values).spec.frame_period_s * 1e6, cpu)


def stages_ms(values: dict[str, Value]) -> list[float]:
    """Median duration of every stage, ms."""
    with tempfile.TemporaryDirectory() as folder:
        notes = Path(folder) / "stages.json"
        sent, received, _ = live(values, notes)
        passed = np.array(json.loads(notes.read_text()))
    arrived = dict(received)
    sent_us = np.array(list(sent))
    times = []
    for middle_us, read, separated, decoded, published in passed[
        passed[:, 0] > passed[0, 0] + WARM_UP_S * 1e6
    ]:
        nearest_us = int(sent_us[np.argmin(np.abs(sent_us - middle_us))])
        if int(middle_us) in arrived:
            begun = sent[nearest_us]
            # The subscriber may be served before publishing returns.
            received_s = arrived[int(middle_us)] - decoded
            times.append(
                [
                    read - begun,
                    separated - read,
                    decoded - separated,
                    received_s,
                    published - decoded,
                ]
            )
    medians: list[float] = np.median(times, axis=0).tolist()
    return [round(1e3 * seconds, 3) for seconds in medians]


def live(
    values: dict[str, Value], notes: Path | None = None
) -> tuple[dict[int, float], list[tuple[int, float]], float]:
    """Run a live skin for SECONDS: what was sent, what was received, the driver's share of a core.

    notes: file for the times of stages; None: the driver as it is.
    """
    config = SkinConfig.of(values)
    context = multiprocessing.get_context("spawn")
    stop, receiving = context.Event(), context.Event()
    queue = context.Queue()
    subscriber = context.Process(target=subscribe, args=(stop, receiving, queue), daemon=True)
    subscriber.start()
    with tempfile.TemporaryDirectory() as folder:
        digitizer = Digitizer(config, Path(folder) / "skin")
        with digitizer, driver(values, digitizer.path, Path(folder), notes) as pid:
            assert receiving.wait(30), "no frame arrived"
            time.sleep(WARM_UP_S)
            cpu = cpu_share(pid)
    time.sleep(0.3)
    stop.set()
    received = sorted(queue.get(timeout=20))
    subscriber.join(10)
    return digitizer.sent, received, cpu


def measure_bare() -> Result:
    """Measure messages of a process that does nothing but publish."""
    context = multiprocessing.get_context("spawn")
    stop, receiving, ended = context.Event(), context.Event(), context.Event()
    queue, sent = context.Queue(), context.Queue()
    subscriber = context.Process(target=subscribe, args=(stop, receiving, queue), daemon=True)
    publisher = context.Process(target=publish, args=(ended, sent), daemon=True)
    subscriber.start()
    publisher.start()
    assert receiving.wait(30), "no message arrived"
    time.sleep(WARM_UP_S)
    assert publisher.pid is not None
    cpu = cpu_share(publisher.pid)
    ended.set()
    published = dict(sent.get(timeout=20))
    time.sleep(0.3)
    stop.set()
    received = sorted(queue.get(timeout=20))
    subscriber.join(10)
    publisher.join(10)
    return match(published, received, PAPER_PERIOD_US, cpu)


def cpu_share(pid: int) -> float:
    """Share of a core that a process takes during SECONDS from now on."""

    def spent_s() -> float:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return sum(map(int, fields[11:13])) / os.sysconf("SC_CLK_TCK")  # utime, stime

    begin_s, before_s = time.monotonic(), spent_s()
    time.sleep(SECONDS)
    return (spent_s() - before_s) / (time.monotonic() - begin_s)


def publish(ended: EventType, sent: multiprocessing.Queue[object]) -> None:
    """Publish finished messages at the paper's rate; note (device time, µs; monotonic s)."""
    import rclpy
    from rclpy.qos import qos_profile_sensor_data

    from tactile_cdma.msg import TactileArray

    rclpy.init()
    node = rclpy.create_node("skin")
    publisher = node.create_publisher(TactileArray, "/skin/tactile", qos_profile_sensor_data)
    message = TactileArray(pressure=array("f", [0.0] * 16), status=array("B", [0] * 16))
    times: list[tuple[int, float]] = []
    while not ended.wait(PAPER_PERIOD_US * 1e-6):
        message.device_time_us += PAPER_PERIOD_US
        times.append((message.device_time_us, time.monotonic()))
        publisher.publish(message)
    sent.put(times)


def match(
    sent: dict[int, float], received: list[tuple[int, float]], period_us: float, cpu: float
) -> Result:
    """Both sides' times of the same frames; device times agree to a fraction of a chip.

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
    assert latency_ms, "no frame of those sent was received"
    return Result(np.array(latency_ms), count, count - len(latency_ms), cpu)


class Digitizer:
    """The virtual digitizer on a pty, which notes when the last byte of each frame was written.

    sent: monotonic time, s, for each frame's middle in device time, µs.
    """

    def __init__(self, config: SkinConfig, path: Path) -> None:
        self.path = path
        self.sent: dict[int, float] = {}
        self._config = config
        self._digitizer = VirtualDigitizer(SimOptions.from_url("sim://?scene=all&threshold=0"))
        self._parser = PacketParser()
        self._end: int | None = None  # index of the last sample of the awaited frame
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
        outgoing = b""
        while not self._stop.is_set():
            wait_s = self._digitizer.advance(CHUNK)
            outgoing = outgoing or self._digitizer.take(CHUNK)
            readable, writable, _ = select.select(
                [self._host], [self._host] if outgoing else [], [], min(wait_s, 0.1)
            )
            if readable:
                self._digitizer.receive(os.read(self._host, CHUNK))
            if writable:
                now = time.monotonic()  # before, as the reader may be served before write returns
                count = os.write(self._host, outgoing)
                for packet in self._parser.feed(outgoing[:count]):
                    if isinstance(packet, Samples):
                        self._note(packet, now)
                outgoing = outgoing[count:]

    def _note(self, packet: Samples, now: float) -> None:
        spec, per_chip = self._config.spec, self._config.samples_per_chip
        if packet.sync:
            tail = TAIL_CHIPS if per_chip > 1 else 0
            self._end = packet.first_index + (spec.span_chips + tail) * per_chip - 1
            self._middle_us = packet.device_time_us + round(spec.frame_s / 2 * 1e6)
        if self._end is not None and packet.first_index + len(packet.counts) > self._end:
            self.sent[self._middle_us] = now
            self._end = None


class driver:  # noqa: N801  # used like a function
    """The driver node in its own process."""

    def __init__(
        self, values: dict[str, Value], port: Path, folder: Path, notes: Path | None
    ) -> None:
        program = [str(ROOT / "scripts" / "skin_driver")]
        if notes is not None:
            program = ["-m", "benchmarks.ros", str(notes)]
        command = [sys.executable, *program, "--ros-args"]
        for name, value in {**values, "port": str(port)}.items():
            command += ["-p", f"{name}:={value}"]
        self._log = (folder / "driver.log").open("w+")
        self._command = command

    def __enter__(self) -> int:
        """Start it; returns its process id."""
        self._process = subprocess.Popen(
            self._command, cwd=ROOT, stdout=self._log, stderr=self._log
        )
        return self._process.pid

    def __exit__(self, *_: object) -> None:
        alive = self._process.poll() is None
        self._process.terminate()
        self._process.wait(10)
        self._log.seek(0)
        log = self._log.read()
        self._log.close()
        assert alive, f"the driver ended by itself:\n{log}"


def noting_driver(notes: Path) -> None:
    """Run the driver node, and write when each frame passed each stage.

    notes: rows of device time of the frame's middle, µs, then monotonic times, s.
    """
    from tactile_cdma.ros.driver.node import SkinNode
    from tactile_cdma.ros.driver.node import main as run

    rows: list[list[float]] = []
    read = separated = 0.0
    feed, wait, publish_frame = Pipeline.feed, Pipeline.wait, SkinNode._publish_frame

    def noting_feed(
        self: Pipeline, data: bytes, t_host: float, backlog: bool = False
    ) -> list[TactileFrame]:
        nonlocal read, separated
        read = separated = t_host  # the stages are not told apart
        return feed(self, data, t_host, backlog)

    def noting_wait(self: Pipeline, file: int, timeout_ms: int) -> Waited:
        nonlocal read, separated
        waited = wait(self, file, timeout_ms)
        read, separated = waited.t_host, time.monotonic()
        return waited

    def noting_publish(self: SkinNode, frame: TactileFrame) -> None:
        decoded = time.monotonic()
        publish_frame(self, frame)
        rows.append([round(1e6 * frame.t_middle), read, separated, decoded, time.monotonic()])

    Pipeline.feed, Pipeline.wait = noting_feed, noting_wait  # type: ignore[method-assign]
    SkinNode._publish_frame = noting_publish  # type: ignore[method-assign]
    try:
        run()
    finally:
        notes.write_text(json.dumps(rows))


def subscribe(stop: EventType, receiving: EventType, queue: multiprocessing.Queue[object]) -> None:
    """Note the arrival of every array: (device time of the frame's middle in µs, monotonic s)."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import QoSProfile, ReliabilityPolicy

    from tactile_cdma.msg import TactileArray

    rclpy.init()
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
    queue.put(received)


def picture(results: Mapping[int | str, Result]) -> Figure:
    figure = Figure(figsize=(7, 4))
    axes = figure.add_subplot()
    for name, result in results.items():
        share = np.arange(1, result.latency_ms.size + 1) / result.latency_ms.size
        axes.plot(
            np.sort(result.latency_ms),
            100 * share,
            label=name if name == "bare" else f"{name} nodes",
        )
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("")
    axes.set_xlabel("last byte in → callback, ms")
    axes.set_ylabel("share of frames, %")
    axes.grid(True, which="both", alpha=0.3)
    axes.legend()
    return figure


if __name__ == "__main__":
    if len(sys.argv) > 1:
        noting_driver(Path(sys.argv.pop(1)))
    else:
        main()
