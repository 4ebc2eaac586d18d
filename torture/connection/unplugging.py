# SPDX-License-Identifier: Apache-2.0

"""Ports that are unplugged, and digitizers that are reset, at any moment."""

from __future__ import annotations

import gc
import os
import threading
from collections.abc import Callable
from pathlib import Path

from ..outcome import Outcome, Plan
from ..process_watch import memory_kb
from .plug import Tty
from .trial import Rng, Started, Trial, Turns, rng_of, side_by_side, some_skin

WARM = 20
"""Replugs after which nothing may grow any more."""
MOST_GROWTH_KB = 10_000
"""By which 1000 replugs may add to the memory of this process: 10 kB each."""
GONE = ("unplugged", "no such port")
"""What the driver says of a port that is gone: one of these."""


def unplugged(plan: Plan, folder: Path) -> Outcome:
    """1000 replugs, alone: it is counted what this process holds."""
    trial = Trial("unplugged and plugged in again", plan, Tty(folder / "replugged"))
    side_by_side(
        [trial.run(lambda trial: replugs(trial, rng_of(plan, 0), 40 if plan.quick else 1000))]
    )
    return trial.outcome()


def replugs(trial: Trial, rng: Rng, times: int) -> Turns:
    """Unplug at any moment: before it is asked, as it is, within a packet, at rest."""
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
    """Whether the driver has written: what it writes waits while this is looked at."""
    plug.stalled = True

    def asked() -> bool:
        plug.stalled = not plug.asked
        return not plug.stalled

    return asked


def _held() -> int:
    """Threads and descriptors of this process."""
    return threading.active_count() + len(os.listdir("/proc/self/fd"))


def _settled_kb() -> int:
    gc.collect()  # what waits for that is not growth
    return memory_kb(os.getpid())


def reset(plan: Plan, folder: Path) -> list[Started]:
    """Digitizers that are reset while the port stays."""
    single = Trial("digitizer reset, port stays", plan, Tty(folder / "reset"))
    loop = Trial("digitizer reset again and again", plan, Tty(folder / "loop"))
    times, loops = (20, 2) if plan.quick else (300, 40)
    return [
        (single, single.run(lambda trial: resets(trial, rng_of(plan, 1), times))),
        (loop, loop.run(lambda trial: reset_loops(trial, rng_of(plan, 2), loops))),
    ]


def resets(trial: Trial, rng: Rng, times: int) -> Turns:
    """Put a digitizer that was just powered up in the place of one that streams."""
    trial.plug.plug(trial.digitizer(some_skin(rng)))
    yield from trial.resumes()
    for _ in range(times):
        yield from trial.after(rng.uniform(0, 0.25))
        trial.plug.step(int(rng.integers(1, 200)))
        trial.plug.swap(trial.digitizer(some_skin(rng)))
        trial.tally.times += 1
        yield from trial.resumes()
    trial.said = trial.took


def reset_loops(trial: Trial, rng: Rng, loops: int) -> Turns:
    """Digitizers that live for 1 to 80 ms, in the handshake or later."""
    trial.plug.plug(trial.digitizer(some_skin(rng)))
    yield from trial.resumes()
    for _ in range(loops):
        for _ in range(20):
            trial.plug.swap(trial.digitizer(some_skin(rng)))
            trial.tally.times += 1
            yield from trial.after(rng.uniform(1e-3, 80e-3))
        yield from trial.resumes()
    trial.said = trial.took
