# SPDX-License-Identifier: Apache-2.0

"""Interruptions: ports unplugged, digitizers reset, network hosts gone, stalls."""

from __future__ import annotations

import gc
import os
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from ..outcome import Outcome, Plan
from ..process_watch import memory_kb
from .plug import Host, Tty
from .trial import Rng, Trial, Turns, outcomes, rng_of, some_skin

Fault = Callable[[Trial, Rng], Turns]

WARM = 20
"""Replugs after which nothing may grow any more."""
MOST_GROWTH_KB = 10_000
"""Chosen: growth of this process's memory by 1000 replugs; 10 kB each."""
GONE = ("unplugged", "no such port")
"""The driver's problem with a removed port has one of these texts."""
STALLS_S = {0.01: (5, 50), 0.1: (3, 30), 1.0: (1, 10), 10.0: (0, 2)}
"""Length of a stall, s: number of them, quick and full."""


def again_and_again(
    fault: Fault, rng: Rng, times: int, most_between_s: float
) -> Callable[[Trial], Turns]:
    """Put a fault in repeatedly, at random moments after frames have come."""

    def faults(trial: Trial) -> Turns:
        trial.plug.plug(trial.digitizer(some_skin(rng)))
        yield from trial.resumes()
        for _ in range(times):
            yield from trial.after(rng.uniform(0, most_between_s))
            yield from fault(trial, rng)
            yield from trial.resumes()
        trial.said = trial.took

    return faults


# ---- Unplugged


def unplugged(plan: Plan, folder: Path) -> Outcome:
    """1000 replugs; alone, because memory and descriptors of this process are compared."""
    rng, times = rng_of(plan, 0), 40 if plan.quick else 1000
    plug = Tty(folder / "replugged")
    trial = Trial("unplugged and plugged in again", plan, plug, lambda t: replugs(t, rng, times))
    return next(outcomes([trial]))


def replugs(trial: Trial, rng: Rng, times: int) -> Turns:
    """Unplug at any moment: before the first command, during it, within a packet, later."""
    assert isinstance(trial.plug, Tty)
    before, before_kb = _held(), _settled_kb()
    for count in range(times):
        trial.plug.plug(trial.digitizer(some_skin(rng)))
        match rng.choice(("at once", "asked", "answering", "streaming")):
            case "at once":
                yield from trial.after(rng.uniform(0, 0.03))
            case "asked":
                yield from trial.until(_asked(trial.plug))
            case "answering":
                yield from trial.until(_asked(trial.plug))
                trial.plug.step(int(rng.integers(1, 200)))
            case _:
                yield from trial.resumes()
                yield from trial.after(rng.uniform(0, 0.02))
                trial.plug.step(int(rng.integers(1, 200)))
        trial.plug.unplug()
        trial.tally.times += 1
        yield from trial.after(rng.uniform(0, 0.03))
        if count == WARM:
            yield from trial.told(*GONE)
            before, before_kb = _held(), _settled_kb()
    yield from trial.until(lambda: _held() <= before)
    grown_kb = _settled_kb() - before_kb
    trial.tally.crashes += grown_kb > MOST_GROWTH_KB
    trial.said = f"{trial.took}; memory {grown_kb:+d} kB"


def _asked(plug: Tty) -> Callable[[], bool]:
    """A condition: the driver has written. Stalls the line meanwhile, to keep the command."""
    plug.stalled = True

    def asked() -> bool:
        plug.stalled = not plug.asked
        return not plug.stalled

    return asked


def _held() -> int:
    """Threads and descriptors of this process."""
    return threading.active_count() + len(os.listdir("/proc/self/fd"))


def _settled_kb() -> int:
    gc.collect()  # garbage is not growth
    return memory_kb(os.getpid())


# ---- Reset


def reset(plan: Plan, folder: Path) -> list[Trial]:
    """Digitizers that are reset while the port stays."""
    times, loops = (20, 2) if plan.quick else (300, 40)
    single = again_and_again(reset_once, rng_of(plan, 1), times, 0.25)
    loop = again_and_again(reset_often, rng_of(plan, 2), loops, 0.0)
    return [
        Trial("digitizer reset, port stays", plan, Tty(folder / "reset"), single),
        Trial("digitizer reset again and again", plan, Tty(folder / "loop"), loop),
    ]


def reset_once(trial: Trial, rng: Rng) -> Turns:
    """Replace a streaming digitizer by one that was just powered up."""
    trial.plug.step(int(rng.integers(1, 200)))
    trial.plug.swap(trial.digitizer(some_skin(rng)))
    trial.tally.times += 1
    yield


def reset_often(trial: Trial, rng: Rng) -> Turns:
    """Digitizers that live for 1 to 80 ms, in the handshake or later."""
    for _ in range(20):
        trial.plug.swap(trial.digitizer(some_skin(rng)))
        trial.tally.times += 1
        yield from trial.after(rng.uniform(1e-3, 80e-3))


# ---- A host in the network


def networked(plan: Plan, folder: Path) -> list[Trial]:
    """What a host may do to its client."""
    times = 3 if plan.quick else 50
    kinds: dict[str, Fault] = {
        "vanishes and comes back": vanish,
        "resets the connection": lambda trial, rng: _host_does(trial, Host.reset),
        "hangs up": lambda trial, rng: _host_does(trial, Host.hang_up),
        "closes its half": lambda trial, rng: _host_does(trial, Host.half_close),
    }
    return [
        Trial(
            f"network host {what}",
            plan,
            Host(),
            again_and_again(fault, rng_of(plan, 7, number), times, 0.05),
        )
        for number, (what, fault) in enumerate(kinds.items())
    ]


def vanish(trial: Trial, rng: Rng) -> Turns:
    """Nobody listens for a while; then there is a digitizer that was just powered up."""
    trial.tally.times += 1
    trial.plug.unplug()
    yield from trial.told("unplugged", "refused")
    yield from trial.after(rng.uniform(0, 0.3))
    trial.plug.plug(trial.digitizer(some_skin(rng)))


def _host_does(trial: Trial, what: Callable[[Host], None]) -> Turns:
    """End the connection; the digitizer streams on, and gets new commands."""
    assert isinstance(trial.plug, Host)
    trial.tally.times += 1
    streams = trial.judge.streams
    what(trial.plug)
    yield from trial.until(lambda: trial.judge.streams > streams)


# ---- Stalled


def stalled(plan: Plan, folder: Path) -> list[Trial]:
    """Stalls of all lengths."""
    return [
        Trial(
            f"{name} stalls for {stall_s:g} s",
            plan,
            Tty(folder / f"{name}{number}"),
            stalls(stall, rng_of(plan, 3, number, len(name)), stall_s, counts[not plan.quick]),
        )
        for number, (stall_s, counts) in enumerate(STALLS_S.items())
        for name, stall in (("line", line_stalls), ("consumer", consumer_stalls))
        if counts[not plan.quick]
    ]


def stalls(
    stall: Callable[[Trial, float], Turns], rng: Rng, stall_s: float, times: int
) -> Callable[[Trial], Turns]:
    """Stalls of one length, and an account of the packets lost by them."""

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
    """No byte gets through; the digitizer runs on, and drops what it has no room for."""
    trial.plug.stalled = True
    yield from trial.stall(stall_s)
    trial.plug.stalled = False


def consumer_stalls(trial: Trial, stall_s: float) -> Turns:
    """The consumer of frames blocks the driver's thread, so that nobody reads the port."""
    trial.hold_s = stall_s
    yield from trial.until(lambda: not trial.hold_s)
    trial.plug.hasty = True
    yield from trial.stall(stall_s)
    trial.plug.hasty = False
