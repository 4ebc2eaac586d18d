# SPDX-License-Identifier: Apache-2.0

"""The whole byte path in real time: CPU share and latency by number of nodes: `make bench-scale`.

A virtual digitizer in a process of its own samples a skin on which every node speaks in every
frame, and writes to a pty; a second process runs the driver on that pty. Measured is all that this
second process costs, and what it delivers is compared with what the simulated nodes said. "Floor"
is what it costs before, when it only reads the same bytes from the same pty. A core that just woke
up is slow: "replay" is what parsing and decoding the same bytes cost without pauses, and
sleep_slowdown what a pause of one frame does to a plain loop. "Wake-ups" are the times that any of
the process's threads had waited. "Kernel" is the one call that waits, reads, parses and separates,
"frames" what the rest of the pipeline does with its outcome.

"Growth" is replay from 16 to 16,384 nodes, all active in 50 frames per second: more than a pty
carries. Its exponent is that of time against nodes since the row before.
"""

from __future__ import annotations

import multiprocessing
import os
import resource
import select
import statistics
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from math import log
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Event
from typing import Any, cast

import numpy as np
from matplotlib.figure import Figure

from benchmarks.report import QUICK, Report
from benchmarks.skip import record
from tactile_cdma.base.kernel import VARIABLE, compiled
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.driver import Driver
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.quiet_limit import quiet_uv
from tactile_cdma.driver.steady import Waited
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.line import truth
from tactile_cdma.sim.options import Setup, SimOptions
from tactile_cdma.sim.pty import serve
from tactile_cdma.wire._protocol import SyncMode
from tactile_cdma.wire.messages import Configure, FrameLayout, Start
from tactile_cdma.wire.packets import PacketWriter
from tactile_cdma.wire.port import READ_SIZE, Port

ALL = "scene=all&threshold=0&seed=1"
SILENT = "scene=idle&heartbeat=0&seed=1"
PAPER_NODES = 16
FRAME_S, PERIOD_S = 18.4e-3, 20e-3
"""Of skins larger than the paper's: their chips are as long as this allows."""
WARM_UP_S = 0.7 if QUICK else 2.0
MEASURED_S = 1.5 if QUICK else 10.0
FLOOR_S = 0.7 if QUICK else 5.0
SIZES = (16, 4096) if QUICK else (16, 64, 256, 1024, 4096, 8192)
SKINS = [(n, ALL) for n in SIZES] + [(16, SILENT), (4096, SILENT)]
KERNELS = ("compiled", "numpy") if compiled else ("numpy",)
GROWTH = (16, 64, 256, 1024, 4096, 16_384)
GROWTH_FRAMES = 8 if QUICK else 50
"""Least number; small skins take more, so that what a pipeline learns first does not count."""
BAUD = 2_000_000


@dataclass(frozen=True)
class Delivered:
    """One frame as the driver's callback saw it; t_call, s, on the machine's monotonic clock.

    processing_s: since the read that brought the frame's last byte.
    """

    t_call: float
    processing_s: float
    sequence: int
    t_start: float
    codes: np.ndarray
    active: np.ndarray


@dataclass(frozen=True)
class Run:
    """Figures that the measured process collects about itself after the warm-up.

    cpu_s: CPU time by "process", all of it, and by "read", "parse" and "feed" (parse included).
    floor: share of a core that reading alone took. wake_ups: voluntary context switches.
    replay_s: CPU time per frame of feeding what came during the warm-up to another pipeline.
    """

    wall_s: float
    cpu_s: dict[str, float]
    floor: float
    wake_ups: int
    replay_s: float
    received: int
    frames: list[Delivered]


def main() -> None:
    report = Report("scale", "Driver on a pty, virtual digitizer in another process, in real time")
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # of the processes below, as skin_driver sets it
    rows, runs = [], {}
    for kernel in KERNELS:
        for nodes, scene in SKINS:
            if kernel == KERNELS[0] or not QUICK:
                runs[nodes, scene, kernel] = measure(nodes, scene, kernel)
                rows.append(runs[nodes, scene, kernel])
    report.table(list(rows[0]), [list(row.values()) for row in rows])
    grown = {kernel: growth(kernel) for kernel in KERNELS}
    report.table(
        ["nodes", *(f"{kernel} {unit}" for kernel in KERNELS for unit in ("µs/frame", "exponent"))],
        [
            [nodes, *(value for kernel in KERNELS for value in grown_row(grown[kernel], nodes))]
            for nodes in GROWTH
        ],
    )
    first = KERNELS[0]
    active, silent = (
        {nodes: runs[nodes, scene, first] for nodes in (16, 4096)} for scene in (ALL, SILENT)
    )
    report.finish(
        figure([row for row in rows if (row["scene"], row["kernel"]) == ("all", first)], grown),
        cpu_16=active[16]["CPU %"] / 100,
        cpu_4096=active[4096]["CPU %"] / 100,
        silent_16=silent[16]["CPU %"] / 100,
        silent_4096=silent[4096]["CPU %"] / 100,
        floor_16=active[16]["floor %"] / 100,
        floor_4096=active[4096]["floor %"] / 100,
        replay_us_16=active[16]["replay µs"],
        replay_us_4096=active[4096]["replay µs"],
        latency_ms_4096=active[4096]["latency ms"],
        exponent=log(grown[first][16_384] / grown[first][1024]) / log(16),
        sleep_slowdown=sleep_slowdown(),
        wrong_words=sum(row["wrong words"] for row in rows),
        lost_frames=sum(row["lost frames"] for row in rows),
    )


def growth(kernel: str) -> dict[int, float]:
    """CPU time per frame of replay by number of nodes, s."""
    os.environ[VARIABLE] = kernel
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return dict(zip(GROWTH, pool.map(replayed, GROWTH, chunksize=1), strict=True))


def replayed(nodes: int) -> float:
    """CPU time per frame of a recording in which all nodes speak, s."""
    config = SkinConfig.of(long_frame(nodes))
    recording = record(config, 1.0, True, max(GROWTH_FRAMES, 2_000 // nodes))
    chunks = [(data, t_host) for t_host, data in recording.reads]
    return statistics.median(replay(config, chunks) for _ in range(3))


def grown_row(seconds: dict[int, float], nodes: int) -> tuple[float, float | str]:
    """Time per frame, µs, and the exponent since the size before."""
    before = GROWTH[max(0, GROWTH.index(nodes) - 1)]
    ratio = seconds[nodes] / seconds[before]
    return 1e6 * seconds[nodes], log(ratio) / log(nodes / before) if nodes > before else ""


def sleep_slowdown(rounds: int = 40, loops: int = 3000) -> float:
    """CPU time of a plain loop after a pause of one frame, over its time without a pause."""

    def loop_s() -> float:
        begin_s, total = time.thread_time(), 0
        for number in range(loops):
            total += number
        return time.thread_time() - begin_s

    warm = statistics.median(loop_s() for _ in range(5 * rounds))
    paused = []
    for _ in range(rounds):
        time.sleep(12.8e-3)
        paused.append(loop_s())
    return statistics.median(paused) / warm


def parameters(nodes: int) -> dict[str, Any]:
    """The paper's timing for its own size; one value per chip for larger skins."""
    return {"nodes": nodes} if nodes == PAPER_NODES else long_frame(nodes)


def long_frame(nodes: int) -> dict[str, Any]:
    """50 frames per second, of one value per chip."""
    shape = FrameSpec(nodes, chip_s=1e-8, frame_period_s=1.0)
    chip_ns = int(FRAME_S * 1e9 / shape.chips)
    period_ms = PERIOD_S * 1e3
    return {
        "nodes": nodes,
        "chip_us": chip_ns / 1e3,
        "frame_period_ms": period_ms,
        "samples_per_chip": 1,
    }


def measure(nodes: int, scene: str, kernel: str) -> dict[str, Any]:
    """Measure one row of the table."""
    os.environ[VARIABLE] = kernel
    config = SkinConfig.of(parameters(nodes))
    query = f"sim://?{scene}"
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    here, there = context.Pipe()
    digitizer = context.Process(target=digitize, args=(query, stop, there))
    digitizer.start()
    try:
        path, powered_up = here.recv()
        driver = context.Process(target=drive, args=(nodes, path, there))
        driver.start()
        run: Run = here.recv()
        driver.join()
    finally:
        stop.set()
        digitizer.join()
    spec = config.spec
    latencies = [f.t_call - powered_up - f.t_start for f in run.frames]
    share = Counter({name: 100 * cpu_s / run.wall_s for name, cpu_s in run.cpu_s.items()})
    expected = round(run.wall_s / spec.frame_period_s)
    sequences = [f.sequence for f in run.frames]
    lost = sequences[-1] - sequences[0] + 1 - len(sequences) if sequences else expected
    return {
        "nodes": nodes,
        "scene": "all" if scene == ALL else "silent",
        "kernel": kernel,
        "chips": spec.chips,
        "chip µs": spec.chip_s * 1e6,
        "kB/s": run.received / run.wall_s / 1e3,
        "frames": len(run.frames),
        "floor %": 100 * run.floor,
        "CPU %": share["process"],
        "kernel %": share["wait"] + share["read"],
        "frames %": share["take"] + share["feed"],
        "replay µs": 1e6 * run.replay_s,
        "wake-ups/frame": run.wake_ups / expected,
        "latency ms": _median_ms(latencies),
        "of it code": spec.frame_s * 1e3,
        "processing ms": _median_ms([f.processing_s for f in run.frames]),
        "wrong words": wrong_words(run.frames, config, query),
        "lost frames": lost,
    }


def digitize(query: str, stop: Event, ready: Connection) -> None:
    """Run the digitizer's process; sends its tty and the host time of its time 0."""

    def on_ready(path: object) -> None:
        ready.send((str(path), time.monotonic()))

    serve(lambda: VirtualDigitizer(SimOptions.from_url(query)), None, stop, on_ready)  # type: ignore[arg-type]


def drive(nodes: int, path: str, results: Connection) -> None:
    """Run the driver's process."""
    spent: Counter[str] = Counter()
    read_s = [0.0]  # when the last bytes came
    time_stage(Port, "read", "read", spent)
    for method in ("feed", "wait", "take"):
        time_stage(Pipeline, method, method, spent)
    timed_feed, timed_wait = Pipeline.feed, Pipeline.wait
    recorded: list[tuple[bytes, float]] = []
    warm_s = 0.0  # end of the warm-up, in which all bytes come through `feed`

    def feed(
        self: Pipeline, data: bytes, t_host: float, backlog: bool = False
    ) -> list[TactileFrame]:
        read_s[0] = t_host
        if time.monotonic() < warm_s:
            recorded.append((data, t_host))
        return timed_feed(self, data, t_host, backlog)

    def wait(self: Pipeline, file: int, timeout_ms: int) -> Waited:
        waited = timed_wait(self, file, timeout_ms)
        read_s[0] = waited.t_host
        return waited

    has_file = cast(Callable[[Port], bool], cast(property, Port.has_file).fget)
    Pipeline.feed, Pipeline.wait = feed, wait  # type: ignore[method-assign]
    Port.has_file = property(  # type: ignore[assignment, method-assign]
        lambda port: time.monotonic() >= warm_s and has_file(port)
    )
    frames: list[Delivered] = []

    def on_frame(frame: TactileFrame) -> None:
        now = time.monotonic()
        words = frame.words
        frames.append(
            Delivered(
                now, now - read_s[0], frame.sequence, frame.t_start, words.codes, words.active
            )
        )

    config = SkinConfig.of(parameters(nodes))
    floor = read_only(config, path)
    warm_s = time.monotonic() + WARM_UP_S
    with Driver(config, path, BAUD, on_frame, lambda problem: None) as driver:
        time.sleep(WARM_UP_S)
        begin_s, before, counts = time.monotonic(), Counter(spent), driver.pipeline.packet_counts
        first, cpu_s, waits = len(frames), time.process_time(), wake_ups()
        time.sleep(MEASURED_S)
        waits = wake_ups() - waits
        spent["process"] = time.process_time() - cpu_s  # type: ignore[assignment]
        after, wall_s = Counter(spent), time.monotonic() - begin_s
        measured = frames[first:]
        received = driver.pipeline.packet_counts.bytes - counts.bytes
    after.subtract(before)
    replay_s = replay(config, recorded)
    results.send(Run(wall_s, dict(after), floor, waits, replay_s, int(received), measured))


def read_only(config: SkinConfig, path: str) -> float:
    """Share of a core that it takes to wait for the digitizer's bytes and to read them."""
    integrated = config.samples_per_chip == 1
    layout = FrameLayout.of(config.spec, config.samples_per_chip)
    writer, poll = PacketWriter(), select.poll()
    setting = Configure(layout, SyncMode.DRIVE, integrated, quiet_uv(config.spec))
    port = os.open(path, os.O_RDWR | os.O_NOCTTY)
    try:
        os.write(port, writer.encode(setting) + writer.encode(Start()))
        poll.register(port, select.POLLIN)
        time.sleep(FLOOR_S / 10)  # until it streams
        begin_s, cpu_s = time.monotonic(), time.process_time()
        while time.monotonic() < begin_s + FLOOR_S:
            if poll.poll(FLOOR_S * 1e3):
                os.read(port, READ_SIZE)
        return (time.process_time() - cpu_s) / (time.monotonic() - begin_s)
    finally:
        os.close(port)


def wake_ups() -> int:
    """Voluntary context switches of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_nvcsw


def replay(config: SkinConfig, recorded: list[tuple[bytes, float]]) -> float:
    """CPU time per frame of feeding the recorded chunks to a new pipeline, s."""
    pipeline = Pipeline(config)
    begin_s = time.thread_time()
    for data, t_host in recorded:
        pipeline.feed(data, t_host)
    return (time.thread_time() - begin_s) / max(1, pipeline.counters.frames)


def time_stage(owner: type, method: str, stage: str, spent: Counter[str]) -> None:
    """Add the CPU time of a method's calls to that of a stage."""
    original: Callable[..., Any] = getattr(owner, method)

    def timed(*args: Any) -> Any:
        begin_s = time.thread_time()
        result = original(*args)
        spent[stage] += time.thread_time() - begin_s  # type: ignore[assignment]
        return result

    setattr(owner, method, timed)


def wrong_words(frames: list[Delivered], config: SkinConfig, query: str) -> int:
    """Number of words that differ from what the simulated nodes sent, missing words included."""
    if not frames:
        return 0
    options = SimOptions.from_url(query)
    integrated = config.samples_per_chip == 1
    setup = options.setup(Setup(config.spec, config.samples_per_chip, SyncMode.DRIVE, integrated))
    period_s = config.spec.frame_period_s
    numbers = [round((f.t_start - frames[0].t_start) / period_s) for f in frames]
    sent = []
    said = truth(options, setup)
    most = numbers[-1] + round((WARM_UP_S + 10) / period_s)
    for _ in range(most):
        frame = next(said)
        sent.append((frame.active, frame.codes))

    def wrong(frame: Delivered, number: int) -> int:
        active, codes = sent[number]
        differs = (frame.codes != codes) & active
        return int(np.count_nonzero((frame.active != active) | differs))

    # The stream began at a START that the host did not time: its frame 0 is where words agree.
    first = min(range(most - numbers[-1]), key=lambda number: wrong(frames[0], number))
    return sum(wrong(f, first + n) for f, n in zip(frames, numbers, strict=True))


def figure(rows: list[dict[str, Any]], grown: dict[str, dict[int, float]]) -> Figure:
    """CPU by stage, latency beyond the code itself, and replay, against the number of nodes."""
    picture = Figure(figsize=(13, 3.6), layout="constrained")
    cpu, latency, hot = picture.subplots(1, 3)
    nodes = [str(row["nodes"]) for row in rows]
    bottom = np.zeros(len(rows))
    for stage in ("kernel", "frames"):
        height = np.array([row[f"{stage} %"] for row in rows])
        cpu.bar(nodes, height, bottom=bottom, label=stage)
        bottom += height
    cpu.bar(nodes, [row["CPU %"] for row in rows] - bottom, bottom=bottom, label="rest")
    cpu.plot(nodes, [row["floor %"] for row in rows], "k_", ms=24, label="floor: reading alone")
    cpu.set(xlabel="nodes, all speaking in every frame", ylabel="CPU, % of a core")
    cpu.legend()
    beyond = [row["latency ms"] - row["of it code"] for row in rows]
    latency.bar(nodes, beyond, label="last chip ends → TactileFrame")
    latency.bar(nodes, [row["processing ms"] for row in rows], label="of it processing")
    latency.set(xlabel="nodes", ylabel="median, ms")
    latency.legend()
    for kernel, seconds in grown.items():
        hot.loglog(list(seconds), [1e6 * s for s in seconds.values()], "o-", label=kernel)
    hot.set(xlabel="nodes, 50 frames/s", ylabel="replay, µs per frame")
    hot.grid(True, alpha=0.3)
    hot.legend()
    return picture


def _median_ms(seconds: list[float]) -> float:
    return statistics.median(seconds) * 1e3 if seconds else float("nan")


if __name__ == "__main__":
    main()
