# SPDX-License-Identifier: Apache-2.0

"""A body on three computers: a network with delay and loss, cuts, clocks that disagree.

Real drivers, a real body's node and DDS over UDP, in network namespaces. The left patch is
untouched; the right one is pressed for 2 s of 4.
"""

from __future__ import annotations

import re
import statistics
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

from ..outcome import Outcome, Plan, Tally
from .judge import NETWORK_S, arrivals, false_claims, not_missed
from .listener import ARRAYS, BODY_CONTACTS, CONTACTS, Heard
from .network import Network, why_not
from .relay import Counts, Weather
from .rig import BRAIN, LEFT, PATCHES, RIGHT, SIDES, STALE_AFTER_S, Rig

PATIENCE_S = 30.0
"""Time without progress that counts as a hang, s."""
FINE = Weather()
BAD = Weather(delay_s=0.01, jitter_s=0.005, loss=0.05)
"""A poor Wi-Fi, less its multicast troubles; it is what all later faults happen in."""
OFFSET_S = 0.05
OLDEST_S = STALE_AFTER_S + NETWORK_S
"""A body may rely on data up to this age, s."""
CUT_S = (3.0, 10.0)
LONG_CUT_S = 30.0
"""Longer than the 20 s after which Fast DDS forgets a participant: discovery starts anew."""
PRESSED_S = 0.5
"""Least time for which a patch is pressed while it is cut off, s."""
RATE = re.compile(r"([\d.]+) Hz")
AHEAD = re.compile(r"is ahead of this one's by ([\d.]+) s")
BEHIND = re.compile(r"its messages take ([\d.]+) s")


def run(plan: Plan) -> Iterator[Outcome]:
    """Run everything on one body, one after the other."""
    if reason := why_not():
        yield Outcome("several computers: not tried", 0, said=reason)
        return
    with (
        TemporaryDirectory(prefix="hosts-") as folder,
        Network((*SIDES, BRAIN), plan.seed) as network,
        Rig(network, Path(folder), PATIENCE_S) as rig,
    ):
        trial = Trial(rig)
        rig.waits_for(rig.is_whole)
        yield trial.weather("three computers, a sound network", FINE, 2.0 if plan.quick else 20.0)
        named = "10 ± 5 ms of delay, 5 % of the packets lost"
        yield trial.weather(named, BAD, 4.0 if plan.quick else 120.0)
        cut_s = CUT_S[not plan.quick]
        yield trial.cuts("a pressed patch", (RIGHT,), cut_s, 1 if plan.quick else 6)
        if not plan.quick:
            yield trial.cuts("both patches", SIDES, cut_s, 2)
            yield trial.cuts("a pressed patch", (RIGHT,), LONG_CUT_S, 2)
        yield trial.clocks(1 if plan.quick else 10)


class Trial:
    """What is done to a rig, and its judgement."""

    def __init__(self, rig: Rig) -> None:
        self._rig, self._weather = rig, FINE
        self._begin()

    def weather(self, fault: str, weather: Weather, seconds: float) -> Outcome:
        """Run in this weather for a while, and count what arrives."""
        self._set(weather)
        time.sleep(seconds)
        counts = self._set(weather)
        tally = Tally(times=counts.lost if weather.loss else counts.forwarded)
        words = []
        for kind in (ARRAYS, CONTACTS):
            found = [arrivals(kind, patch, self._truth, self._heard) for patch in PATCHES.values()]
            sent, arrived = sum(f.sent for f in found), sum(f.arrived for f in found)
            tally.uncounted_losses += sum(abs(f.lost - f.gaps) for f in found)
            tally.wrong_values += sum(f.disordered for f in found)
            tally.hangs += sum(not f.arrived for f in found)
            p50, p99 = (max(f.age_ms(percent) for f in found) for percent in (50, 99))
            words.append(f"{kind}: {arrived} of {sent} arrived, age {p50:.0f} ms, p99 {p99:.0f}")
        body = [h for h in self._heard if h.kind == BODY_CONTACTS]
        rates_hz = [float(rate[1]) for said in self._said() if (rate := RATE.match(said))]
        taken = statistics.mean(rates_hz[len(SIDES) :])  # the first reports are of before
        words.append(f"body {len(body) / seconds:.1f} Hz, of {taken:.1f} frames of each patch")
        # Only these: no delay explains a message from the future, but that the machine is too busy
        # may well look like a slow network.
        tally.wrong_values += sum(bool(AHEAD.search(said)) for said in self._said())
        return self._outcome(tally, fault, "; ".join(words))

    def cuts(self, what: str, cut: Sequence[str], seconds: float, times: int) -> Outcome:
        """Cut hosts off, each time while nothing touches the body; it is touched meanwhile."""
        rig, tally, told_s, back_s = self._rig, Tally(times=times), [], []
        gone = [PATCHES[side] for side in cut]
        lost = 0
        for _ in range(times):
            rig.waits_for(lambda: rig.newest and rig.newest.untouched)
            self._set(replace(self._weather, cut=tuple(cut)))
            begin_s = time.monotonic()
            rig.waits_for(lambda: rig.newest and set(gone).issubset(rig.newest.absent))
            told_s.append(time.monotonic() - begin_s)
            rig.waits_for(lambda: "silent" in rig.said(cut[0]) or "no driver" in rig.said(cut[0]))
            rig.waits_for(lambda: rig.feels(RIGHT, touched=True))
            time.sleep(max(PRESSED_S, begin_s + seconds - time.monotonic()))
            end_s = time.monotonic()
            self._set(replace(self._weather, cut=()))
            back_s.append(rig.waits_for(rig.is_whole))
            rig.waits_for(lambda: rig.newest and rig.newest.touched)
            rig.waits_for(partial(self._has_come, cut, end_s))
            tally.wrong_values += len(not_missed(self._heard, gone, begin_s, end_s, OLDEST_S))
        for side in cut:
            found = arrivals(CONTACTS, PATCHES[side], self._truth, self._heard)
            lost += found.lost
            tally.uncounted_losses += abs(found.lost - found.gaps)
        said = (
            f"absent after {max(told_s):.1f} s at most, back {max(back_s):.1f} s after its end; "
            f"{lost} frames lost and counted"
        )
        return self._outcome(tally, f"{what} cut off for {seconds:g} s", said)

    def clocks(self, times: int) -> Outcome:
        """Set the clock of one patch's host ahead, that of the other one back, and both right."""
        rig, tally, told_s = self._rig, Tally(times=2 * times), []
        sign = 1.0
        for _ in range(times):
            for side, offset_s in ((LEFT, sign * OFFSET_S), (RIGHT, -sign * OFFSET_S)):
                rig.set_clock(side, offset_s)
            ahead, behind = (LEFT, RIGHT) if sign > 0 else (RIGHT, LEFT)
            told_s.append(
                rig.waits_for(
                    lambda ahead=ahead, behind=behind: (
                        AHEAD.search(rig.said(ahead)) and BEHIND.search(rig.said(behind))
                    )
                )
            )
            # What a delay can only add to.
            for found, least, most in (
                (AHEAD.search(rig.said(ahead)), 0.0, OFFSET_S),
                (BEHIND.search(rig.said(behind)), OFFSET_S, PATIENCE_S),
            ):
                tally.wrong_values += found is None or not least < float(found[1]) < most
            for side in SIDES:
                rig.set_clock(side, 0.0)
            rig.waits_for(lambda: not any(AHEAD.search(rig.said(side)) for side in SIDES))
            sign = -sign
        said = f"both named after {max(told_s):.1f} s at most"
        return self._outcome(tally, f"clocks off by ±{1e3 * OFFSET_S:.0f} ms", said)

    def _has_come(self, cut: Sequence[str], since_s: float) -> bool:
        """Whether frames that these hosts sent after this time have come, reliably, in order."""
        return all(
            any(
                (h.kind, h.patch) == (CONTACTS, PATCHES[side]) and h.t_s - h.age_s > since_s
                for h in reversed(self._heard[-100:])
            )
            for side in cut
        )

    def _both_said(self, ahead: str, behind: str) -> bool:
        said = self._rig.said
        return bool(AHEAD.search(said(ahead)) and BEHIND.search(said(behind)))

    # ---- Judgement

    def _set(self, weather: Weather) -> Counts:
        """Change the weather; returns what was counted since the last outcome."""
        self._weather = weather
        counts = self._rig.network.set(weather)
        return Counts(
            counts.forwarded - self._counts.forwarded,
            counts.lost - self._counts.lost,
            counts.stopped - self._counts.stopped,
        )

    def _begin(self) -> None:
        """Judge from here on."""
        self._counts = self._rig.network.set(self._weather)
        self._heard_from, self._truth_from = len(self._rig.heard), len(self._rig.truth)

    @property
    def _heard(self) -> list[Heard]:
        return self._rig.heard[self._heard_from :]

    @property
    def _truth(self) -> list[Heard]:
        return self._rig.truth[self._truth_from :]

    def _said(self) -> list[str]:
        """All that the body said of its patches."""
        return [said for h in self._heard for said in h.said.values()]

    def _outcome(self, tally: Tally, fault: str, said: str) -> Outcome:
        """Sum up, with what holds in any weather, and begin anew."""
        rig = self._rig
        # The truth may be older than the first message that rests on it.
        false = false_claims(rig.truth, self._heard, PATCHES.values(), OLDEST_S)
        if false:
            tally.example = f"claimed falsely: {false[0]}"
        tally.wrong_values += len(false)
        numbers = [h.sequence for h in self._heard if h.kind == BODY_CONTACTS]
        tally.uncounted_losses += sum(after - before != 1 for before, after in pairwise(numbers))
        tally.crashes += rig.ended()
        tally.hangs, rig.hangs = tally.hangs + rig.hangs, 0
        self._begin()
        return tally.outcome(fault, said)
