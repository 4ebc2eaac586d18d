# SPDX-License-Identifier: Apache-2.0

"""Claims of touch, by a skin whose nodes speak of changes, on lines of which not all is heard.

One press at a time, of a random taxel and pressure. Nodes speak by rules that were written from
docs/topics.md and docs/firmware.md: when their code has changed since they last spoke, at their
heartbeat, and, of the firmware's (`repeats`), in every frame while they are not at rest. Of every
frame that is published, three kinds of claims are compared with what was pressed while it was sent:
`touched`, `untouched`, and the pressure of each taxel that carries no flag but SILENT.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from tactile_cdma.readings.contact import ContactThresholds, ContactTracker
from tactile_cdma.readings.status import Status
from test.support.independent_line import SILENT, Digitizer, Floats, Ints, Line, Skin, Talk, render

from .tally import Tally
from .words import DAMAGED, LATE, LOST, REPEATED, TIMINGS, play

THRESHOLDS = ContactThresholds(1000, 500)
LIKE = 4
"""Frames for one of a condition of the line: claims of touch are few."""
LEAST_KPA, MOST_KPA = 5.0, 60.0
SHORTEST, LONGEST = 12, 60
"""Frames of a press, and between two of them."""
FIRST = 30
"""Frames before the first press."""
OFF_PA = 1500.0
"""Pa by which a value may differ from the truth: more than two counts of the paper's sensor."""


@dataclass(frozen=True)
class Presses(Talk):
    """Lets nodes of a pressed skin talk.

    threshold: LSB by which a code must differ to be told. heartbeat: frames. repeats: a node speaks
    in every frame while it is not at rest. press_seed: of what presses where.
    """

    threshold: int = 1
    heartbeat: int = 20
    repeats: bool = False
    press_seed: int = 0

    def pressures_kpa(self, skin: Skin, frames: int) -> Floats:
        """(frames, n), kPa."""
        rng = np.random.default_rng([self.press_seed, 1])
        pressures_kpa, at = np.zeros((frames, skin.nodes)), FIRST
        while at < frames:
            end = at + int(rng.integers(SHORTEST, LONGEST))
            pressures_kpa[at:end, rng.integers(skin.nodes)] = rng.uniform(LEAST_KPA, MOST_KPA)
            at = end + int(rng.integers(SHORTEST, LONGEST))
        return pressures_kpa

    def codes(self, skin: Skin, frames: int, rng: np.random.Generator) -> Ints:
        """(frames, n), SILENT or a word: the paper's sensor, a converter, and the rules."""
        pressures_kpa, top = self.pressures_kpa(skin, frames), 2**skin.bits
        volts = 3.3 - 0.033 * np.minimum(pressures_kpa, 50)
        volts -= 0.0059 * np.maximum(pressures_kpa - 50, 0)
        measured: Ints = np.clip(np.round(volts * top / 3.3), 0, top - 1).astype(int)
        rest, told = measured[0], measured[0].copy()
        turn = rng.permutation(skin.nodes) * self.heartbeat // skin.nodes
        said: Ints = np.full_like(measured, SILENT)
        for frame, codes in enumerate(measured):
            speaks = np.abs(codes - told) > self.threshold
            speaks |= turn == frame % self.heartbeat
            if self.repeats:
                speaks |= np.abs(codes - rest) > self.threshold
            said[frame, speaks] = told[speaks] = codes[speaks]
        return said


@dataclass(frozen=True)
class TouchCondition:
    """Says what is lost of a line, and how its nodes speak.

    lost: share of the packets. how: what becomes of these.
    """

    name: str
    line: Line = Line()  # noqa: RUF009  (frozen)
    talk: Presses = Presses()
    digitizer: Digitizer = Digitizer()  # noqa: RUF009
    skin: Skin = Skin()  # noqa: RUF009
    lost: float = 0.0
    how: str = LOST
    rough: bool = True

    def run(self, frames: int, seed: int) -> tuple[Tally, list[str]]:
        """Play a recording to the driver; also the first false claims."""
        seeds = [zlib.crc32(self.name.encode()), seed]
        talk = replace(self.talk, press_seed=seeds[0] + seed)
        frames *= LIKE
        recording = render(self.skin, talk, self.line, self.digitizer, frames, seeds)
        pressures_kpa = talk.pressures_kpa(self.skin, frames)
        starts = np.array([truth.start_chips for truth in recording.frames])
        tracker: ContactTracker | None = None
        stale, claims, unclaimed, complaints = 0, 0, 0, list[str]()
        for frame, pipeline in play(
            recording, lost=self.lost, seed=seed, how=self.how, nodes_repeat=talk.repeats
        ):
            tracker = tracker or ContactTracker(pipeline.config.layout, THRESHOLDS)
            contacts, readings = tracker.update(frame.readings, frame.t_middle), frame.readings
            number = int(np.argmin(np.abs(starts - frame.t_start / self.skin.chip_s)))
            truth_pa = 1e3 * pressures_kpa[number]
            unflagged = readings.status & ~np.uint8(Status.SILENT) == 0
            plain = unflagged & np.isfinite(readings.pressure_pa)
            false = plain & (np.abs(readings.pressure_pa - truth_pa) > OFF_PA)
            touched, untouched = len(contacts) > 0, contacts.untouched
            wrong = untouched if truth_pa.any() else touched
            claims += int(np.count_nonzero(plain)) + (touched or untouched)
            stale += int(np.count_nonzero(false)) + wrong
            unclaimed += not (touched or untouched)
            if wrong or false.any():
                held = f"{readings.pressure_pa[false]} of {truth_pa[false]} Pa"
                complaints.append(f"  frame {number}: {touched=} {untouched=}, {held}")
        return Tally(claims=claims, stale_claims=stale, unclaimed=unclaimed), complaints


SHARES = 0.05, 0.2, 0.4
"""Shares of the packets."""
SPIKES = Line(hum_v=0.6, impulses_hz=300)
"""Hum of 2 A and spikes, by which frames are rejected."""


def conditions() -> Iterator[TouchCondition]:
    """Yield all conditions; names begin with how frames are timed."""
    for timing, digitizer in TIMINGS.items():
        for how, talk in (("on change", Presses()), ("as the firmware", Presses(repeats=True))):
            heard = TouchCondition(f"{timing}: touch, {how}", talk=talk, digitizer=digitizer)
            for name, condition in {
                "sound": heard,
                **{
                    f"{share:.0%} of the packets lost": replace(heard, lost=share)
                    for share in SHARES
                },
                "5 losses/s": replace(heard, digitizer=replace(digitizer, losses_hz=5)),
                "hum of 2 A, spikes": replace(heard, line=SPIKES),
            }.items():
                yield replace(condition, name=f"{heard.name}, {name}")
    for how in (DAMAGED, REPEATED, LATE):
        yield TouchCondition(f"marks: touch, 20% of the packets {how}", lost=0.2, how=how)
