# SPDX-License-Identifier: Apache-2.0

"""A line, or whoever takes the frames, that stands still for a while."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from ..outcome import Plan
from .plug import Tty
from .trial import Rng, Started, Trial, Turns, rng_of, some_skin

STALLS_S = {0.01: (5, 50), 0.1: (3, 30), 1.0: (1, 10), 10.0: (0, 2)}
"""Length of a stall: how many, quick and full."""


def stalled(plan: Plan, folder: Path) -> list[Started]:
    """Stalls of all lengths."""
    started = []
    for number, (stall_s, counts) in enumerate(STALLS_S.items()):
        times = counts[0 if plan.quick else 1]
        for name, stall in (("line", line_stalls), ("consumer", consumer_stalls)):
            plug = Tty(folder / f"{name}{number}")
            trial = Trial(f"{name} stalls for {stall_s:g} s", plan, plug)
            rng = rng_of(plan, 3, number, len(name))
            if times:
                started.append((trial, trial.run(stalls(stall, rng, stall_s, times))))
    return started


def stalls(
    stall: Callable[[Trial, float], Turns], rng: Rng, stall_s: float, times: int
) -> Callable[[Trial], Turns]:
    """So many of one length, and an account of the packets that they cost."""

    def faults(trial: Trial) -> Turns:
        digitizer = trial.digitizer(replace(some_skin(rng), scene="all"))
        trial.plug.plug(digitizer)
        yield from trial.resumes()
        for _ in range(times):
            yield from trial.after(rng.uniform(0, 0.1))
            trial.tally.times += 1
            yield from stall(trial, stall_s)
            yield from trial.caught_up()
        yield from trial.counted(
            lambda: trial.driver.pipeline.packet_counts.lost_packets,
            lambda: digitizer.packets_dropped,
        )
        lost_frames = trial.driver.pipeline.counters.lost_frames
        trial.said = f"{digitizer.packets_dropped} packets lost, {lost_frames} frames"

    return faults


def line_stalls(trial: Trial, stall_s: float) -> Turns:
    """No byte gets through; the digitizer goes on, and drops what it has no room for."""
    trial.plug.stalled = True
    yield from trial.stall(stall_s)
    trial.plug.stalled = False


def consumer_stalls(trial: Trial, stall_s: float) -> Turns:
    """Whoever takes the frames holds the driver's thread up, so that nobody reads the port."""
    trial.hold_s = stall_s
    yield from trial.until(lambda: not trial.hold_s)
    trial.plug.hasty = True
    yield from trial.stall(stall_s)
    trial.plug.hasty = False
