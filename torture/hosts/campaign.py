# SPDX-License-Identifier: Apache-2.0

"""A body on three computers: a network with delay and loss, cuts, clocks that disagree.

Real drivers, a real body's node and DDS over UDP, in network namespaces. The left patch is
untouched; the right one is pressed for 2 s of 4.
"""

from __future__ import annotations

import math
import os
import re
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from ..outcome import Outcome, Plan, Tally
from .judge import (
    ARRAYS,
    BODY_CONTACTS,
    CONTACTS,
    SLACK_S,
    Heard,
    arrivals,
    deaf_claims,
    false_claims,
    untold,
)
from .network import Network, why_not
from .relay import Weather
from .rig import BRAIN, PATCHES, RIGHT, SIDES, STALE_AFTER_S, Rig

PATIENCE_S = 60.0
"""Time without progress that counts as a hang, s: six programs start at once, which takes 20 s on a
busy machine."""
FINE = Weather()
BAD = Weather(delay_s=0.01, jitter_s=0.005, loss=0.05)
"""A poor Wi-Fi; all later faults happen in it."""
OFFSET_S = 0.05
OLDEST_S = STALE_AFTER_S + SLACK_S
"""A body may rely on data up to this age, s."""
CUT_S = (4.0, 10.0)
LONG_CUT_S = 30.0
"""Longer than the 20 s after which Fast DDS forgets a participant: discovery starts anew."""
PRESSED_S = 0.5
"""Least time for which the right patch is pressed while the body has to know nothing of it, s."""
NOT_FOUND_S = 10.0
"""Time in which hosts must not find each other; with multicast they take 3 s at most."""
SERVER, SERVER_PORT = "fast-discovery-server", 11811
RATE = re.compile(r"([\d.]+) Hz")
AHEAD = re.compile(r"is ahead of this one's by ([\d.]+) s")
BEHIND = re.compile(r"its messages take ([\d.]+) s")


def run(plan: Plan) -> Iterator[Outcome]:
    """Run everything on one body, one after the other; then discovery without multicast."""
    if reason := why_not():
        yield Outcome("several computers: not tried", 0, said=reason)
        return
    hosts = *SIDES, BRAIN
    with TemporaryDirectory(prefix="hosts-") as name, Network(hosts, plan.seed) as network:
        folder = Path(name)
        with Rig(network, folder, PATIENCE_S) as rig:
            yield from _on_one_body(Trial(rig), plan)
        if not plan.quick:
            yield _discovery(network, folder)


def _on_one_body(trial: Trial, plan: Plan) -> Iterator[Outcome]:
    yield trial.weather("three computers, a sound network", FINE, 2.0 if plan.quick else 20.0)
    named = "10 ± 5 ms of delay, 5 % of the packets lost"
    yield trial.weather(named, BAD, 4.0 if plan.quick else 60.0)
    cut_s = CUT_S[not plan.quick]
    yield trial.cuts("the pressed patch", (RIGHT,), cut_s, 1 if plan.quick else 6)
    if not plan.quick:
        yield trial.cuts("both patches", SIDES, cut_s, 2)
        yield trial.cuts("the pressed patch", (RIGHT,), LONG_CUT_S, 2)
    yield trial.clocks(1 if plan.quick else 10)


class Trial:
    """What is done to a rig, and its judgement."""

    def __init__(self, rig: Rig) -> None:
        self._rig, self._weather = rig, FINE
        rig.waits_for(rig.is_whole)
        rig.waits_for(rig.is_witnessed)
        self._begin()

    def weather(self, fault: str, weather: Weather, seconds: float) -> Outcome:
        """Run in this weather for a while, and count what arrives."""
        self._set(weather)
        self._begin()
        time.sleep(seconds)
        counts = self._rig.network.counts
        tally = Tally(times=counts.lost if weather.loss else counts.forwarded)
        words = []
        for kind in (ARRAYS, CONTACTS):
            found = [arrivals(kind, patch, self._heard) for patch in PATCHES.values()]
            sent, arrived = sum(f.sent for f in found), sum(f.arrived for f in found)
            tally.wrong_values += sum(f.disordered for f in found)
            tally.hangs += sum(not f.arrived for f in found)
            p50, p99 = (max(f.age_ms(percent) for f in found) for percent in (50, 99))
            words.append(f"{kind}: {arrived} of {sent} arrived, age {p50:.0f} ms, p99 {p99:.0f}")
        body = [h for h in self._heard if h.kind == BODY_CONTACTS]
        rates_hz = [float(rate[1]) for said in self._said() if (rate := RATE.match(said))]
        # The first report is of before, too; a starved body may have made no other one yet.
        taken_hz = statistics.fmean(rates_hz[len(SIDES) :] or [math.nan])
        words.append(f"body {len(body) / seconds:.1f} Hz, with {taken_hz:.1f} frames of each patch")
        # Only these: no delay explains a message from the future, but on a busy machine messages
        # do take long.
        tally.wrong_values += sum(bool(AHEAD.search(said)) for said in self._said())
        return self._outcome(tally, fault, "; ".join(words))

    def cuts(self, what: str, cut: Sequence[str], seconds: float, times: int) -> Outcome:
        """Cut hosts off, each time while nothing touches the body; it is touched meanwhile."""
        rig, tally, told_s, back_s = self._rig, Tally(times=times), [], []
        gone = [PATCHES[side] for side in cut]
        for _ in range(times):
            # A loss is a gap between two that came, and a lost packet holds the first one up.
            rig.waits_for(partial(self._has_come, cut, time.monotonic()))
            rig.waits_for(rig.is_untouched)
            self._set(replace(self._weather, cut=tuple(cut)))
            begin_s = time.monotonic()
            rig.waits_for(partial(rig.misses, cut))
            told_s.append(time.monotonic() - begin_s)
            rig.waits_for(partial(self._missing_said, cut))
            time.sleep(max(0.0, begin_s + OLDEST_S - time.monotonic()))
            rig.waits_for(partial(rig.feels, RIGHT))
            time.sleep(max(PRESSED_S, begin_s + seconds - time.monotonic()))
            end_s = time.monotonic()
            self._set(replace(self._weather, cut=()))
            back_s.append(rig.waits_for(rig.is_whole))
            rig.waits_for(rig.is_touched)
            rig.waits_for(partial(self._has_come, cut, end_s))
            false = deaf_claims(self._heard, gone, begin_s, end_s, OLDEST_S)
            self._note(tally, false)
        lost = sum(arrivals(CONTACTS, patch, self._heard).lost for patch in gone)
        said = (
            f"absent after {max(told_s):.1f} s at most, there {max(back_s):.1f} s after its end; "
            f"{lost} frames lost and counted"
        )
        return self._outcome(tally, f"{what} cut off for {seconds:g} s", said)

    def clocks(self, times: int) -> Outcome:
        """Set the clock of one patch's host ahead, that of the other one back, and both right."""
        rig, tally, told_s = self._rig, Tally(times=2 * times), []
        for number in range(times):
            ahead, behind = SIDES if number % 2 else SIDES[::-1]
            rig.clocks[ahead].set(OFFSET_S)
            rig.clocks[behind].set(-OFFSET_S)
            told_s.append(rig.waits_for(partial(self._both_said, ahead, behind)))
            # The network's delay can only make the one less and the other one more.
            said_ahead, said_behind = AHEAD.search(rig.said(ahead)), BEHIND.search(rig.said(behind))
            tally.wrong_values += said_ahead is None or float(said_ahead[1]) > OFFSET_S
            tally.wrong_values += said_behind is None or float(said_behind[1]) < OFFSET_S
            for side in SIDES:
                rig.clocks[side].set(0.0)
            rig.waits_for(self._none_said)
        said = f"both named after {max(told_s):.1f} s at most"
        return self._outcome(tally, f"clocks off by ±{1e3 * OFFSET_S:.0f} ms", said)

    # ---- Conditions

    def _missing_said(self, cut: Sequence[str]) -> bool:
        said = [self._rig.said(side) for side in cut]
        return all("silent" in text or "no driver" in text for text in said)

    def _has_come(self, cut: Sequence[str], since_s: float) -> bool:
        """Whether frames that these hosts sent after this time have come."""
        last = self._heard[-100:]
        came = {h.patch for h in last if h.kind == CONTACTS and h.sent_s > since_s}
        return came.issuperset(PATCHES[side] for side in cut)

    def _both_said(self, ahead: str, behind: str) -> bool:
        said = self._rig.said
        return bool(AHEAD.search(said(ahead)) and BEHIND.search(said(behind)))

    def _none_said(self) -> bool:
        return all(RATE.match(self._rig.said(side)) for side in SIDES)

    # ---- Judgement

    def _set(self, weather: Weather) -> None:
        self._weather = weather
        self._rig.network.set(weather)

    def _begin(self) -> None:
        """Judge from here on."""
        self._rig.network.count_anew()
        self._heard_from = len(self._rig.heard)

    @property
    def _heard(self) -> list[Heard]:
        return self._rig.heard[self._heard_from :]

    def _said(self) -> list[str]:
        """All that the body said of its patches."""
        return [said for h in self._heard for said in h.said.values()]

    def _note(self, tally: Tally, false: Sequence[Heard]) -> None:
        tally.wrong_values += len(false)
        if false:
            tally.example = f"claimed falsely: {false[0]}"

    def _outcome(self, tally: Tally, fault: str, said: str) -> Outcome:
        """Sum up, with what holds in any weather, and begin anew."""
        rig = self._rig
        # All of the truth: the first message may rest on what was before.
        false = false_claims(rig.truth, self._heard, PATCHES.values(), OLDEST_S)
        self._note(tally, false)
        tally.uncounted_losses += sum(
            untold(patch, rig.truth, self._heard) for patch in PATCHES.values()
        )
        tally.crashes += rig.ended()
        tally.hangs, rig.hangs = tally.hangs + rig.hangs, 0
        self._begin()
        return tally.outcome(fault, said)


# ---- Discovery


def _discovery(network: Network, folder: Path) -> Outcome:
    """Without multicast, hosts must not meet by themselves, but by what docs/patches.md names."""
    brain = network.hosts[BRAIN].address
    tally, words = Tally(), []
    network.set(Weather(multicast=False))
    with Rig(network, folder, NOT_FOUND_S) as rig:
        rig.waits_for(rig.is_whole)
        tally.wrong_values += not rig.hangs  # multicast got through
    with _server(network):
        for name, environment in (
            ("ROS_STATIC_PEERS", {"ROS_STATIC_PEERS": brain}),
            ("ROS_DISCOVERY_SERVER", {"ROS_DISCOVERY_SERVER": f"{brain}:{SERVER_PORT}"}),
        ):
            met = _met(network, folder, environment)
            tally += met
            words.append(f"{name} {'failed' if met.hangs else 'worked'}")
    return tally.outcome("no multicast", ", ".join(words))


def _met(network: Network, folder: Path, environment: Mapping[str, str]) -> Tally:
    with Rig(network, folder, PATIENCE_S, environment) as rig:
        rig.waits_for(rig.is_whole)
        return Tally(times=1, hangs=rig.hangs, crashes=rig.ended())


@contextmanager
def _server(network: Network) -> Iterator[None]:
    """Run a discovery server on the third host."""
    beside = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    program = shutil.which(SERVER, path=beside)
    if program is None:
        raise FileNotFoundError(f"no {SERVER}, which is part of Fast DDS")
    host = network.hosts[BRAIN]
    command = [program, "-i", "0", "-l", host.address, "-p", str(SERVER_PORT)]
    process = host.start(command, os.environ, stdout=subprocess.DEVNULL)
    try:
        yield
    finally:
        process.kill()
        process.wait()
