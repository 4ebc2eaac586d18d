# SPDX-License-Identifier: Apache-2.0

"""The whole byte path in real time: CPU share and latency by number of nodes: `make bench-scale`.

A virtual digitizer in a process of its own samples a skin on which every node speaks in every
frame, or none does, and writes to a pty; a second process runs the driver on that pty. Measured is
all that this second process costs, and what it delivers is compared with what the simulated nodes
said. "Floor" is what it costs when it only reads the same bytes from the same pty, half of the time
before the driver runs and half of it after. Ratios of the two hold on any machine. A core that just
woke up is slow: "replay" is what parsing and decoding such bytes costs without pauses.

"Growth" is replay from 16 to 16,384 nodes, all active in 50 frames per second: more than a pty
carries. Its exponent is that of time against nodes since the row before.
"""

from __future__ import annotations

import multiprocessing
import os
import select
import statistics
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import log
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Event
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.report import QUICK, Report
from benchmarks.skip import record
from benchmarks.style import sheet
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.digitizer import quiet_uv
from tactile_cdma.driver.driver import Driver
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.stream import Decisions
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.line import truth
from tactile_cdma.sim.options import Setup, SimOptions
from tactile_cdma.sim.pty import serve
from tactile_cdma.wire._protocol import SyncMode
from tactile_cdma.wire.messages import Start
from tactile_cdma.wire.packets import PacketWriter
from tactile_cdma.wire.reader import READ_SIZE
from test.support.simulated import configuration

ALL = "scene=all&threshold=0&seed=1"
SILENT = "scene=idle&heartbeat=0&seed=1"
PAPER_NODES = 16
FRAME_S, PERIOD_S = 18.4e-3, 20e-3
"""Times of skins larger than the paper's: their chips are as long as this allows."""
WARM_UP_S = 0.7 if QUICK else 2.0
MEASURED_S = 1.5 if QUICK else 10.0
FLOOR_S = 1.0 if QUICK else 5.0
"""Time of each half, s."""
SIZES = (16, 4096) if QUICK else (16, 64, 256, 1024, 4096, 8192)
SKINS = [(n, ALL) for n in SIZES] + [(16, SILENT), (4096, SILENT)]
GROWTH = (16, 64, 256, 1024, 4096, 16_384)
GROWTH_FRAMES = 8 if QUICK else 50
"""Least number; small skins take more, so that what a pipeline learns first does not count."""
BAUD = 2_000_000


@dataclass(frozen=True)
class Delivered:
    """Is a frame as the driver's callback saw it; t_call, s, on the machine's monotonic clock."""

    t_call: float
    sequence: int
    t_start: float
    codes: np.ndarray
    active: np.ndarray


@dataclass(frozen=True)
class Run:
    """Holds what the measured process says of itself after the warm-up.

    cpu, floor: shares of a core, of the driver and of reading alone. received: bytes. read,
    searched: frames that were read, and those of them whose timing had to be searched for.
    """

    wall_s: float
    cpu: float
    floor: float
    received: int
    read: int
    searched: int
    frames: list[Delivered]


def main() -> None:
    report = Report("scale", "Driver on a pty, virtual digitizer in another process, in real time")
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # of the processes below, as skin_driver sets it
    rows = {skin: measure(*skin) for skin in SKINS}
    report.table([*next(iter(rows.values()))], [[*row.values()] for row in rows.values()])
    grown = growth()
    report.table(
        ["nodes", "µs/frame", "exponent"], [[nodes, *grown_row(grown, nodes)] for nodes in GROWTH]
    )
    shares = {
        f"{name}_{nodes}": round(rows[nodes, scene][column] / 100, 5)
        for scene, names in ((ALL, ("cpu", "floor")), (SILENT, ("silent", "silent_floor")))
        for nodes in (16, 4096)
        for name, column in zip(names, ("CPU %", "floor %"), strict=True)
    }
    report.finish(
        figure([row for (_, scene), row in rows.items() if scene == ALL], grown),
        **shares,
        replay_us_16=1e6 * grown[16],
        replay_us_4096=1e6 * grown[4096],
        latency_ms_4096=rows[4096, ALL]["latency ms"],
        exponent=log(grown[16_384] / grown[1024]) / log(16),
        wrong_words=sum(row["wrong words"] for row in rows.values()),
        lost_frames=sum(row["lost frames"] for row in rows.values()),
        searched_share=searched_share([*rows.values()]),
    )


def searched_share(rows: list[dict[str, Any]]) -> float:
    """Return the share of the frames of all rows whose timing was searched for."""
    searched, read = (sum(row[column] for row in rows) for column in ("searched", "read"))
    return float(searched / max(1, read))


def growth() -> dict[int, float]:
    """CPU time per frame of replay by number of nodes, s."""
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


def parameters(nodes: int) -> dict[str, Any]:
    """Return the paper's timing for its own size; one value per chip for larger skins."""
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


def measure(nodes: int, scene: str) -> dict[str, Any]:
    """Measure one row of the table."""
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
    expected = round(run.wall_s / spec.frame_period_s)
    sequences = [f.sequence for f in run.frames]
    lost = sequences[-1] - sequences[0] + 1 - len(sequences) if sequences else expected
    return {
        "nodes": nodes,
        "scene": "all" if scene == ALL else "silent",
        "chips": spec.chips,
        "chip µs": spec.chip_s * 1e6,
        "kB/s": run.received / run.wall_s / 1e3,
        "frames": len(run.frames),
        "read": run.read,
        "searched": run.searched,
        "floor %": 100 * run.floor,
        "CPU %": 100 * run.cpu,
        "CPU / floor": run.cpu / run.floor,
        "latency ms": 1e3 * statistics.median(latencies) if latencies else float("nan"),
        "of it code": spec.frame_s * 1e3,
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
    frames: list[Delivered] = []

    def on_frame(frame: TactileFrame) -> None:
        words = frame.words
        frames.append(
            Delivered(time.monotonic(), frame.sequence, frame.t_start, words.codes, words.active)
        )

    config = SkinConfig.of(parameters(nodes))
    floor = read_only(config, path)
    with Driver(config, path, BAUD, on_frame, lambda problem: None) as driver:
        time.sleep(WARM_UP_S)
        first, counts = len(frames), driver.pipeline.packet_counts
        before = driver.pipeline.decisions.since(Decisions())
        begin_s, cpu_s = time.monotonic(), time.process_time()
        time.sleep(MEASURED_S)
        cpu_s, wall_s = time.process_time() - cpu_s, time.monotonic() - begin_s
        measured = frames[first:]
        received = int(driver.pipeline.packet_counts.bytes - counts.bytes)
        made = driver.pipeline.decisions.since(before)
    floor = (floor + read_only(config, path)) / 2
    run = Run(wall_s, cpu_s / wall_s, floor, received, made.frames, made.searches, measured)
    results.send(run)


def read_only(config: SkinConfig, path: str) -> float:
    """Return the share of a core that waiting for the digitizer's bytes and reading them takes."""
    with streaming(config, path) as (port, poll):
        time.sleep(FLOOR_S / 10)  # until it streams
        begin_s, cpu_s = time.monotonic(), time.process_time()
        while time.monotonic() < begin_s + FLOOR_S:
            if poll.poll(FLOOR_S * 1e3):
                os.read(port, READ_SIZE)
        return (time.process_time() - cpu_s) / (time.monotonic() - begin_s)


@contextmanager
def streaming(config: SkinConfig, path: str) -> Iterator[tuple[int, select.poll]]:
    """Open the port of a digitizer that was set and started, and what waits for its bytes."""
    writer, poll = PacketWriter(), select.poll()
    setting = configuration(config, quiet_uv(config.spec))
    port = os.open(path, os.O_RDWR | os.O_NOCTTY)
    try:
        os.write(port, writer.encode(setting) + writer.encode(Start()))
        poll.register(port, select.POLLIN)
        yield port, poll
    finally:
        os.close(port)


def replay(
    config: SkinConfig, recorded: list[tuple[bytes, float]], unmeasured: float = 0.0
) -> float:
    """CPU time per frame of feeding the recorded chunks to a new pipeline, s.

    unmeasured: share of them, from the first one on, that the time is not of.
    """
    pipeline, first = Pipeline(config), int(unmeasured * len(recorded))
    for data, t_host in recorded[:first]:
        pipeline.feed(data, t_host)
    frames, begin_s = pipeline.counters.frames, time.thread_time()
    for data, t_host in recorded[first:]:
        pipeline.feed(data, t_host)
    return (time.thread_time() - begin_s) / max(1, pipeline.counters.frames - frames)


def wrong_words(frames: list[Delivered], config: SkinConfig, query: str) -> int:
    """Return the number of words that differ from what nodes sent, missing ones included."""
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


def figure(rows: list[dict[str, Any]], grown: dict[int, float]) -> Figure:
    """CPU, latency beyond the code itself, and replay, against the number of nodes."""
    picture = sheet(420)
    cpu, latency, hot = picture.subplots(1, 3)
    nodes = [str(row["nodes"]) for row in rows]
    cpu.bar(nodes, [row["CPU %"] for row in rows], label="driver")
    cpu.bar(nodes, [row["floor %"] for row in rows], label="reading alone")
    cpu.set(title="CPU, % of a core")
    cpu.legend()
    latency.bar(nodes, [row["latency ms"] - row["of it code"] for row in rows])
    latency.set(title="last chip to TactileFrame, ms")
    hot.loglog(list(grown), [1e6 * s for s in grown.values()], "o-")
    hot.set(title="replay, µs per frame")
    for axes in (cpu, latency, hot):
        axes.set_xlabel("nodes")
        axes.tick_params(axis="x", rotation=45)
    return picture


if __name__ == "__main__":
    main()
