# SPDX-License-Identifier: Apache-2.0

"""CPU time per frame against the share of nodes that speak: `make bench-skip`.

The whole pipeline, from the digitizer's bytes to readings, on recorded bytes. A digitizer with
QUIET sends one short packet for a frame in which nobody spoke; one without sends every sample. Both
must give the same readings. "CPU %" is the share of a core that these frames take at their rate,
without reading them and without the pauses between them, after which a core is slower (see
bench-scale). "heartbeat": nothing touches the skin, but every node speaks once in 78
frames, as nodes do so that one that died is noticed.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tactile_cdma.config.parameters import Value
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.digitizer import quiet_uv
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.sim.scene import SCENES, SkinGeometry
from tactile_cdma.wire.messages import Start
from tactile_cdma.wire.packets import PacketWriter
from test.support.simulated import configuration

from . import style
from .report import QUICK, Report, medians_s, rows_of

SKINS: dict[int, dict[str, Value]] = {
    16: {},  # the paper's timing, 4 raw samples per chip
    # of order 1024
    1024: {"nodes": 1023, "chip_us": 1.5, "samples_per_chip": 1, "frame_period_ms": 20.0},
    4096: {"nodes": 4096, "chip_us": 0.4, "samples_per_chip": 1, "frame_period_ms": 20.0},
}
SHARES = (0.0, 0.003, 0.01, 0.05, 0.25, 1.0)
HEARTBEAT = "heartbeat"
KEYS: dict[str, float] = {"cpu_silent": 0.0, "cpu_5": 0.05, "cpu_25": 0.25, "cpu_full": 1.0}
FRAMES = {16: 200, 1024: 40, 4096: 20}
ROUNDS = 5 if QUICK else 25
READ = 4095
"""Largest read from a tty, bytes."""


@dataclass(frozen=True, slots=True)
class Recording:
    """Holds what a digitizer sent for one scene, read by read: a packet, or READ bytes of it.

    reads: host time, s, and bytes.
    """

    config: SkinConfig
    reads: tuple[tuple[float, bytes], ...]
    frames: int

    def play(self) -> list[TactileFrame]:
        """Decode it read by read."""
        pipeline, frames = Pipeline(self.config), []
        for t_host, data in self.reads:
            frames += pipeline.feed(data, t_host)
        return frames


def main() -> None:
    report = Report("skip", "CPU time per frame against the share of nodes that speak")
    rows, times, cpus, different = [], {}, {}, 0
    for nodes, values in SKINS.items():
        config = SkinConfig.of(values)
        recordings = {}
        for share in (*SHARES, HEARTBEAT):
            for quiet in (True, False):
                recordings[share, quiet] = record(config, share, quiet, FRAMES[nodes])
            different += compare(recordings[share, True], recordings[share, False])
        calls: dict[str, Callable[[], object]] = {
            f"{share} {quiet}": recording.play for (share, quiet), recording in recordings.items()
        }
        seconds = medians_s(calls, ROUNDS, clock=time.process_time)
        for (share, quiet), recording in recordings.items():
            times[nodes, share, quiet] = 1e3 * seconds[f"{share} {quiet}"] / recording.frames
        for share in (*SHARES, HEARTBEAT):
            with_quiet, without = times[nodes, share, True], times[nodes, share, False]
            full = times[nodes, 1.0, True]
            kilobytes = sum(len(data) for _, data in recordings[share, True].reads) / 1e3
            kilobytes /= recordings[share, True].frames
            period_ms = 1e3 * config.spec.frame_period_s
            cpu = [100 * ms / period_ms for ms in (with_quiet, without)]
            cpus[nodes, share] = cpu[0] / 100
            rows.append((nodes, share, with_quiet, with_quiet / full, *cpu, kilobytes))
    report.table(
        ["nodes", "share", "ms/frame", "of full", "CPU %", "without QUIET, %", "kB/frame"], rows
    )
    report.finish(
        picture(report.tables),
        idle_ratio_16=times[16, 0.0, True] / times[16, 1.0, True],
        idle_ratio_1024=times[1024, 0.0, True] / times[1024, 1.0, True],
        idle_ratio_4096=times[4096, 0.0, True] / times[4096, 1.0, True],
        **{
            f"{name}_{nodes}": round(cpus[nodes, share], 5)
            for nodes in (16, 4096)
            for name, share in KEYS.items()
        },
        different_readings=different,
    )


def record(config: SkinConfig, share: float | str, quiet: bool, frames: int) -> Recording:
    """Record frames of a skin with a share of its taxels pressed."""
    heartbeat = 78 if share == HEARTBEAT else 0
    SCENES["press"] = pressed(0.0 if share == HEARTBEAT else float(share))
    # The clock stands still, so that there is one report only, however long this takes.
    digitizer = VirtualDigitizer(
        SimOptions.from_url(f"sim://?scene=press&speed=0&heartbeat={heartbeat}"), lambda: 0.0
    )
    writer = PacketWriter()
    for command in (configuration(config, quiet_uv(config.spec) if quiet else 0), Start()):
        digitizer.receive(writer.encode(command))
    pipeline, reads, count = Pipeline(config), list[tuple[float, bytes]](), 0
    while count < frames:
        digitizer.advance(1)
        chunk = digitizer.take(digitizer.pending)
        count += len(pipeline.feed(chunk, 0.0))
        t_host = count * config.spec.frame_period_s
        for packet in chunk.split(b"\0")[:-1]:
            whole = packet + b"\0"
            reads += [(t_host, whole[at : at + READ]) for at in range(0, len(whole), READ)]
    return Recording(config, tuple(reads), count)


def pressed(share: float) -> Callable[[float, SkinGeometry], NDArray[np.float64]]:
    """Make a scene: this share of the taxels, here and there, under pressures that change."""

    def scene(t_s: float, skin: SkinGeometry) -> NDArray[np.float64]:
        count = len(skin.positions_m)
        chosen = np.random.default_rng(1).permutation(count)[: round(share * count)]
        pressure_pa = np.zeros(count)
        pressure_pa[chosen] = 60e3 + 40e3 * np.sin(7 * t_s + chosen)
        return pressure_pa

    return scene


def compare(some: Recording, others: Recording) -> int:
    """Return the number of frames that differ between two recordings of one scene."""
    pairs = zip(some.play(), others.play(), strict=False)
    return sum(not same(one, other) for one, other in pairs)


def same(one: TactileFrame, other: TactileFrame) -> bool:
    """Return whether two frames have the same readings, bit by bit."""
    return (
        one.sequence == other.sequence
        and np.array_equal(one.words.active, other.words.active)
        and np.array_equal(one.words.codes, other.words.codes)
        and np.array_equal(one.readings.status, other.readings.status)
        and np.array_equal(one.readings.pressure_pa, other.readings.pressure_pa, equal_nan=True)
    )


def picture(tables: list[list[list[Any]]]) -> Figure:
    """Draw a frame's time by how many speak, relative to that of a frame in which all do."""
    rows = rows_of(tables, "nodes")
    figure = style.sheet(430)
    axes = figure.subplots()
    at = np.arange(len(SHARES))
    for number, nodes in enumerate(SKINS):
        own = [row for row in rows if row[0] == nodes and row[1] in SHARES]
        label = f"{nodes} nodes: all, {own[-1][2]:.2f} ms"
        axes.plot(at, [row[3] for row in own], marker=style.MARKERS[number], label=label)
        for x, row in zip(at, own, strict=True):
            if row[3] > 1.5:
                text = f"{row[1] * nodes:.0f} of {nodes - 1} speak"
                axes.annotate(text, (x, row[3]), (10, -4), textcoords="offset points")
    axes.axhline(1, color=style.BLACK, lw=1, ls="--")
    axes.set_xticks(at, ["nobody", *(f"{100 * share:g} %" for share in SHARES[1:-1]), "all"])
    axes.set(xlabel="nodes that speak", ylabel="time of a frame, all = 1", ylim=(0, None))
    axes.legend()
    return figure


if __name__ == "__main__":
    main()
