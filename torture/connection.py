# Copyright 2026 tactile_cdma maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Ports and digitizers that go away, stall, are reset or are others, and come back."""

from __future__ import annotations

import fcntl
import gc
import os
import statistics
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions

from .outcome import Outcome, Plan
from .plug import Host, Tty, as_ordinary_user
from .strangers import STRANGERS, Rng
from .trial import Trial, Turns, side_by_side, together

WARM = 20
"""Replugs after which nothing may grow any more."""
STALLS_S = {0.01: (5, 50), 0.1: (3, 30), 1.0: (1, 10), 10.0: (0, 2)}
"""Length of a stall: how many, quick and full."""
GONE = ("unplugged", "no such port")
SCENES = ("moving", "press", "all")


def run(plan: Plan) -> Iterator[Outcome]:
    """Everything that a connection may suffer."""
    with TemporaryDirectory() as folder:
        yield _replugs(plan, Path(folder))
        kinds = (_stalls, _resets, _hosts, _ports, _strangers)  # the longest first
        yield from outcomes([trial for kind in kinds for trial in kind(plan, Path(folder))])
    with TemporaryDirectory() as folder, as_ordinary_user(Path(folder)):
        yield from outcomes(_permission(plan, Path(folder)))


def outcomes(started: list[tuple[Trial, Turns]]) -> Iterator[Outcome]:
    """What comes of these trials, those of one fault together."""
    side_by_side(turns for _, turns in started)
    for fault in dict.fromkeys(trial.fault for trial, _ in started):
        yield together(trial.outcome() for trial, _ in started if trial.fault == fault)


def _rng(plan: Plan, *place: int) -> Rng:
    return np.random.default_rng([plan.seed, *place])


def some_skin(rng: Rng) -> SimOptions:
    """A skin that is touched, another one each time."""
    return SimOptions(seed=int(rng.integers(1 << 32)), scene=str(rng.choice(SCENES)))


# Unplugging


def _replugs(plan: Plan, folder: Path) -> Outcome:
    trial = Trial("unplugged and plugged in again", plan, Tty(folder / "replugged"))
    side_by_side(
        [trial.run(lambda trial: replugs(trial, _rng(plan, 0), 40 if plan.quick else 1000))]
    )
    return trial.outcome()


def replugs(trial: Trial, rng: Rng, times: int) -> Turns:
    """Unplug at any moment: before it is asked, as it is, within a packet, at rest."""
    assert isinstance(trial.plug, Tty)
    before, memory_kb = _held(), _memory_kb()
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
        trial.times += 1
        yield from trial.after(rng.uniform(0, 0.03))
        if count == WARM:
            yield from trial.told(*GONE)
            before, memory_kb = _held(), _memory_kb()
    yield from trial.until(lambda: _held() <= before)
    trial.said = f"{_took(trial)}; memory {_memory_kb() - memory_kb:+d} kB"


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


def _memory_kb() -> int:
    gc.collect()  # what waits for that is not growth
    resident = Path("/proc/self/statm").read_text().split()[1]
    return int(resident) * os.sysconf("SC_PAGE_SIZE") // 1024


def _took(trial: Trial) -> str:
    took_ms = [1e3 * seconds for seconds in trial.resumed_s]
    missing = max(trial.judge.missing, default=0)
    return (
        f"frames after {statistics.median(took_ms):.0f} ms (at most {max(took_ms):.0f}), "
        f"{missing} missing at most"
    )


# The digitizer is reset


def _resets(plan: Plan, folder: Path) -> list[tuple[Trial, Turns]]:
    single = Trial("digitizer reset, port stays", plan, Tty(folder / "reset"))
    loop = Trial("digitizer reset again and again", plan, Tty(folder / "loop"))
    times, loops = (20, 2) if plan.quick else (300, 40)
    return [
        (single, single.run(lambda trial: resets(trial, _rng(plan, 1), times))),
        (loop, loop.run(lambda trial: reset_loops(trial, _rng(plan, 2), loops))),
    ]


def resets(trial: Trial, rng: Rng, times: int) -> Turns:
    """Put a digitizer that was just powered up in the place of one that streams."""
    trial.plug.plug(trial.digitizer(some_skin(rng)))
    yield from trial.resumes()
    for _ in range(times):
        yield from trial.after(rng.uniform(0, 0.25))
        trial.plug.step(int(rng.integers(1, 200)))
        trial.plug.swap(trial.digitizer(some_skin(rng)))
        trial.times += 1
        yield from trial.resumes()
    trial.said = _took(trial)


def reset_loops(trial: Trial, rng: Rng, loops: int) -> Turns:
    """Digitizers that live for 1 to 80 ms, in the handshake or later."""
    trial.plug.plug(trial.digitizer(some_skin(rng)))
    yield from trial.resumes()
    for _ in range(loops):
        for _ in range(20):
            trial.plug.swap(trial.digitizer(some_skin(rng)))
            trial.times += 1
            yield from trial.after(rng.uniform(1e-3, 80e-3))
        yield from trial.resumes()
    trial.said = _took(trial)


# Stalls


def _stalls(plan: Plan, folder: Path) -> list[tuple[Trial, Turns]]:
    started = []
    for number, (stall_s, counts) in enumerate(STALLS_S.items()):
        times = counts[0 if plan.quick else 1]
        for name, stall in (("line", line_stalls), ("consumer", consumer_stalls)):
            plug = Tty(folder / f"{name}{number}")
            trial = Trial(f"{name} stalls for {stall_s:g} s", plan, plug)
            rng = _rng(plan, 3, number, len(name))
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
            trial.times += 1
            yield from stall(trial, stall_s)
            yield from trial.caught_up()
        yield from trial.counted(
            lambda: trial.driver.pipeline.packet_counts["lost_packets"],
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


# Others on the port


def _strangers(plan: Plan, folder: Path) -> list[tuple[Trial, Turns]]:
    started = []
    for number, name in enumerate(STRANGERS):
        fault = "wrong baud rate" if "baud" in name else "another device on the port"
        trial = Trial(fault, plan, Tty(folder / f"stranger{number}"))
        rng = _rng(plan, 4, number)
        faults = visits(name, rng, 1 if plan.quick else 10)
        trial.said = "named, and none of it published; then the digitizer"
        started.append((trial, trial.run(faults)))
    return started


def visits(name: str, rng: Rng, times: int) -> Callable[[Trial], Turns]:
    """A stranger comes, is found out, and goes; then the digitizer comes."""
    make, texts = STRANGERS[name]

    def faults(trial: Trial) -> Turns:
        for _ in range(times):
            trial.plug.plug(make(rng))
            trial.times += 1
            yield from trial.told(*texts)
            if rng.integers(2):
                trial.plug.unplug()
                trial.plug.plug(trial.digitizer(some_skin(rng)))
            else:
                trial.plug.swap(trial.digitizer(some_skin(rng)))
            yield from trial.resumes()
            trial.plug.unplug()
            yield from trial.told(*GONE)

    return faults


# Ports that do not open, or take nothing; digitizers of other skins


def _ports(plan: Plan, folder: Path) -> list[tuple[Trial, Turns]]:
    times = 1 if plan.quick else 10
    kinds: tuple[tuple[str, Callable[[Trial, Rng], Turns], dict[str, object]], ...] = (
        ("port busy", busy, {}),
        ("port takes no bytes", unwritable, {}),
        ("another skin's digitizer", others, {"digitizer_id": _OURS.hex()}),
        ("digitizer set otherwise", otherwise, {}),
    )
    started = []
    for number, (fault, faults, parameters) in enumerate(kinds):
        trial = Trial(fault, plan, Tty(folder / f"port{number}"), parameters)
        rng = _rng(plan, 5, number)
        started.append((trial, trial.run(_several(faults, rng, times))))
    return started


def _permission(plan: Plan, folder: Path) -> list[tuple[Trial, Turns]]:
    trial = Trial("permission taken away", plan, Tty(folder / "port"))
    return [(trial, trial.run(_several(forbidden, _rng(plan, 6), 2 if plan.quick else 20)))]


def _several(
    fault: Callable[[Trial, Rng], Turns], rng: Rng, times: int
) -> Callable[[Trial], Turns]:
    def faults(trial: Trial) -> Turns:
        for _ in range(times):
            trial.times += 1
            yield from fault(trial, rng)
            yield from trial.resumes()
            trial.plug.unplug()
            yield from trial.told(*GONE)
        trial.said = _took(trial)

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


def forbidden(trial: Trial, rng: Rng) -> Turns:
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


# Network


def _hosts(plan: Plan, folder: Path) -> list[tuple[Trial, Turns]]:
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
        started.append((trial, trial.run(hosted(fault, _rng(plan, 7, number), times))))
    return started


def hosted(fault: Callable[[Trial, Rng], Turns], rng: Rng, times: int) -> Callable[[Trial], Turns]:
    def faults(trial: Trial) -> Turns:
        trial.plug.plug(trial.digitizer(some_skin(rng)))
        yield from trial.resumes()
        for _ in range(times):
            yield from trial.after(rng.uniform(0, 0.05))
            trial.times += 1
            yield from fault(trial, rng)
            yield from trial.resumes()
        trial.said = _took(trial)

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
