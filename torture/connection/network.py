# SPDX-License-Identifier: Apache-2.0

"""A host in the network that goes away, and comes back."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ..outcome import Plan
from .plug import Host
from .trial import Rng, Started, Trial, Turns, rng_of, some_skin


def networked(plan: Plan, folder: Path) -> list[Started]:
    """What a host may do to its client."""
    times = 3 if plan.quick else 50
    kinds = {
        "vanishes and comes back": vanish,
        "resets the connection": lambda trial, rng: _host_does(trial, rng, Host.reset),
        "hangs up": lambda trial, rng: _host_does(trial, rng, Host.hang_up),
        "closes its half": lambda trial, rng: _host_does(trial, rng, Host.half_close),
    }
    started = []
    for number, (what, fault) in enumerate(kinds.items()):
        trial = Trial(f"network host {what}", plan, Host())
        started.append((trial, trial.run(hosted(fault, rng_of(plan, 7, number), times))))
    return started


def hosted(fault: Callable[[Trial, Rng], Turns], rng: Rng, times: int) -> Callable[[Trial], Turns]:
    def faults(trial: Trial) -> Turns:
        trial.plug.plug(trial.digitizer(some_skin(rng)))
        yield from trial.resumes()
        for _ in range(times):
            yield from trial.after(rng.uniform(0, 0.05))
            trial.tally.times += 1
            yield from fault(trial, rng)
            yield from trial.resumes()
        trial.said = trial.took

    return faults


def vanish(trial: Trial, rng: Rng) -> Turns:
    """Nobody listens for a while; then a digitizer that was just powered up."""
    trial.plug.unplug()
    yield from trial.told("unplugged", "refused")
    yield from trial.after(rng.uniform(0, 0.3))
    trial.plug.plug(trial.digitizer(some_skin(rng)))


def _host_does(trial: Trial, rng: Rng, what: Callable[[Host], None]) -> Turns:
    """The connection ends; the digitizer streams on, and is asked anew."""
    assert isinstance(trial.plug, Host)
    streams = trial.judge.streams
    what(trial.plug)
    yield from trial.until(lambda: trial.judge.streams > streams)
