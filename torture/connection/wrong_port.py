# SPDX-License-Identifier: Apache-2.0

"""Others on the port, and ports that do not open or take nothing."""

from __future__ import annotations

import fcntl
from collections.abc import Callable
from pathlib import Path

from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions

from ..outcome import Plan
from .interruptions import GONE, Fault
from .plug import Tty
from .strangers import STRANGERS
from .trial import Rng, Trial, Turns, rng_of, some_skin


def strange(plan: Plan, folder: Path) -> list[Trial]:
    """Every stranger, and the digitizer after it."""
    return [
        Trial(
            "wrong baud rate" if "baud" in name else "another device on the port",
            plan,
            Tty(folder / f"stranger{number}"),
            visits(name, rng_of(plan, 4, number), 1 if plan.quick else 10),
        )
        for number, name in enumerate(STRANGERS)
    ]


def visits(name: str, rng: Rng, times: int) -> Callable[[Trial], Turns]:
    """A stranger comes, is found out, and goes; then the digitizer comes."""
    make, texts = STRANGERS[name]

    def faults(trial: Trial) -> Turns:
        for _ in range(times):
            trial.plug.plug(make(rng))
            trial.tally.times += 1
            yield from trial.told(*texts)
            if rng.integers(2):
                trial.plug.unplug()
                trial.plug.plug(trial.digitizer(some_skin(rng)))
            else:
                trial.plug.swap(trial.digitizer(some_skin(rng)))
            yield from trial.resumes()
            trial.plug.unplug()
            yield from trial.told(*GONE)
        trial.said = "named, and none of it published; then the digitizer"

    return faults


def unusable(plan: Plan, folder: Path) -> list[Trial]:
    """Ports and digitizers that will not do for now."""
    times = 1 if plan.quick else 10
    kinds: tuple[tuple[str, Fault, dict[str, object]], ...] = (
        ("port busy", busy, {}),
        ("port takes no bytes", unwritable, {}),
        ("another skin's digitizer", others, {"digitizer_id": _OURS.hex()}),
        ("digitizer set otherwise", otherwise, {}),
    )
    return [
        Trial(
            name,
            plan,
            Tty(folder / f"port{number}"),
            _several(fault, rng_of(plan, 5, number), times),
            parameters,
        )
        for number, (name, fault, parameters) in enumerate(kinds)
    ]


def forbidden(plan: Plan, folder: Path) -> list[Trial]:
    """Ports that nobody may open; to be run as an ordinary user."""
    faults = _several(without_permission, rng_of(plan, 6), 2 if plan.quick else 20)
    return [Trial("permission taken away", plan, Tty(folder / "port"), faults)]


def _several(fault: Fault, rng: Rng, times: int) -> Callable[[Trial], Turns]:
    def faults(trial: Trial) -> Turns:
        for _ in range(times):
            trial.tally.times += 1
            yield from fault(trial, rng)
            yield from trial.resumes()
            trial.plug.unplug()
            yield from trial.told(*GONE)
        trial.said = trial.took

    return faults


def busy(trial: Trial, rng: Rng) -> Turns:
    """Another program has the port."""
    assert isinstance(trial.plug, Tty)
    trial.plug.make()
    trial.plug.lock(fcntl.LOCK_EX)
    trial.plug.show(trial.digitizer(some_skin(rng)))
    yield from trial.told("busy: another program")
    yield from trial.after(rng.uniform(0, 0.5))
    trial.plug.lock(fcntl.LOCK_UN)


def without_permission(trial: Trial, rng: Rng) -> Turns:
    """The port may not be opened, as before udev has seen it."""
    assert isinstance(trial.plug, Tty)
    trial.plug.make()
    trial.plug.permit(0)
    trial.plug.show(trial.digitizer(some_skin(rng)))
    yield from trial.told("no permission")
    trial.plug.permit(0o600)


def unwritable(trial: Trial, rng: Rng) -> Turns:
    """The port opens, but nothing can be written."""
    assert isinstance(trial.plug, Tty)
    trial.plug.make()
    trial.plug.fill()
    trial.plug.stalled = True
    trial.plug.show(trial.digitizer(some_skin(rng)))
    yield from trial.told("takes no bytes")
    trial.plug.stalled = False


def others(trial: Trial, rng: Rng) -> Turns:
    """Another skin's digitizer, plugged in instead or put in its place; then the right one."""
    trial.plug.plug(trial.digitizer(SimOptions(seed=7)))
    yield from trial.resumes()
    other = trial.digitizer(SimOptions(seed=8 + int(rng.integers(100))))
    if rng.integers(2):
        trial.plug.unplug()
        trial.plug.plug(other)
    else:
        trial.plug.swap(other)
    yield from trial.told("wrong digitizer")
    trial.plug.swap(trial.digitizer(SimOptions(seed=7)))


_OURS = VirtualDigitizer(SimOptions(seed=7)).info().digitizer_id


def otherwise(trial: Trial, rng: Rng) -> Turns:
    """A digitizer that cannot be set to the parameters; then one that can."""
    trial.plug.plug(trial.digitizer(SimOptions(seed=1, order=24)))
    yield from trial.told("order 24 (parameters: 20)")
    trial.plug.swap(trial.digitizer(some_skin(rng)))
