# SPDX-License-Identifier: Apache-2.0

"""Claims of zero, by a skin that is tared whatever presses it, or whose sensors tear.

What presses is known, and so is the voltage of a sensor like the paper's, which stays at the end of
its range under more. All nodes speak in every frame. A zero is false while a node carries more or
less than when it was tared, and while its sensor is torn: `untouched`, and every reading below the
threshold of contacts without a flag.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from tactile_cdma.readings.contact import ContactThresholds, ContactTracker
from tactile_cdma.readings.status import Status
from test.support.independent_line import Digitizer, Floats, Ints, Line, Skin, Talk, render

from .tally import Tally
from .words import play

TARED = 100
"""Frame after which the skin is tared: a tare takes a second."""
HELD = 20
"""Frames of every load after that."""
CONTACT_PA = 1000.0
THRESHOLDS = ContactThresholds(CONTACT_PA, 500.0)
SLACK_KPA = 2.0
"""What more or less is no zero, kPa: a contact, and two counts of the paper's second stage."""
V_PER_KPA = 0.033, 0.0059
KNEE_KPA, END_KPA, VREF_V = 50.0, 140.0, 3.3


@dataclass(frozen=True)
class Tared(Talk):
    """Puts nodes under loads, of which the first is tared.

    loads_kpa: on the pressed nodes, one after the other; below 0: torn by as much. all_pressed: all
    nodes are; else one, drawn for each recording. rest_v: voltage of a sensor without load.
    """

    loads_kpa: tuple[float, ...] = (0.0,)
    all_pressed: bool = False
    rest_v: float = 3.0
    node_seed: int = 0

    def pressures_kpa(self, skin: Skin) -> Floats:
        """(frames, n), kPa."""
        times = [TARED + 1, *[HELD] * (len(self.loads_kpa) - 1)]
        loads_kpa = np.repeat(self.loads_kpa, times)[:, None]
        node = np.random.default_rng([self.node_seed, 1]).integers(skin.nodes)
        pressures_kpa: Floats = loads_kpa * (self.all_pressed | (np.arange(skin.nodes) == node))
        return pressures_kpa

    def codes(self, skin: Skin, frames: int, rng: np.random.Generator) -> Ints:
        """(frames, n), words."""
        kpa, top = self.pressures_kpa(skin), 2**skin.bits
        volts = self.rest_v - V_PER_KPA[0] * np.minimum(kpa, KNEE_KPA)
        volts -= V_PER_KPA[1] * np.clip(kpa - KNEE_KPA, 0, END_KPA - KNEE_KPA)
        codes: Ints = np.clip(np.round(volts * top / VREF_V), 0, top - 1).astype(int)
        return codes


@dataclass(frozen=True)
class ZeroCondition:
    """Says what presses, and what the user sets and does.

    v0_v: the parameter. is_tared: with force, after the first load. rough: see Condition.
    """

    name: str
    talk: Tared
    v0_v: float = 3.0
    is_tared: bool = True
    rough: bool = True
    skin: Skin = field(default_factory=Skin)

    def run(self, frames: int, seed: int) -> tuple[Tally, list[str]]:
        """Play a recording to the driver, which is tared in it; also the first false zeros."""
        seeds = [zlib.crc32(self.name.encode()), seed]
        talk = replace(self.talk, node_seed=seeds[0] + seed)
        truth_kpa = talk.pressures_kpa(self.skin)
        digitizer = Digitizer(integrated=True, samples_per_chip=8)
        recording = render(self.skin, talk, Line(), digitizer, len(truth_kpa), seeds)
        tracker: ContactTracker | None = None
        zero_kpa = np.zeros(self.skin.nodes)
        claims = false = unclaimed = 0
        complaints = list[str]()
        for frame, pipeline in play(recording, v0_v=self.v0_v):
            tracker = tracker or ContactTracker(pipeline.config.layout, THRESHOLDS)
            number, readings = frame.sequence, frame.readings
            contacts = tracker.update(readings, frame.t_middle)
            off = np.abs(truth_kpa[number] - zero_kpa) > SLACK_KPA
            plain = readings.status & ~np.uint8(Status.SILENT) == 0
            zeros = plain & (np.abs(readings.pressure_pa) <= CONTACT_PA)
            wrong = int(np.count_nonzero(zeros & off)) + (contacts.untouched and off.any())
            claims += int(np.count_nonzero(zeros)) + contacts.untouched
            unclaimed += not (len(contacts) or contacts.untouched)
            false += wrong
            if wrong:
                loads_kpa = np.unique(truth_kpa[number][off])
                complaints.append(f"  frame {number}: {loads_kpa} kPa, {contacts.untouched=}")
            if self.is_tared and number == TARED:
                pipeline.taxels.tare(CONTACT_PA, force=True)
                zero_kpa = truth_kpa[number]
        return Tally(claims=claims, false_zeros=false, unclaimed=unclaimed), complaints


FINE = Skin(bits=12, period_chips=320)
END = Tared(loads_kpa=(200, 400, 150, 100, 0))
UNDER_LOAD = Tared(loads_kpa=(30, 25, 27, 10, 0, 33))
TORN = Tared(loads_kpa=(0, -8.8, 0, -2.5, 5))
LIGHT = Tared(loads_kpa=(0, 4, 2.5, 5), all_pressed=True, rest_v=3.2)


def every(talk: Tared) -> Tared:
    """Have a talk press all nodes."""
    return replace(talk, all_pressed=True)


CASES = (
    ZeroCondition(
        "mounted under 20 kPa", every(Tared(loads_kpa=(20, 20, 25, 60, 20))), rough=False
    ),
    ZeroCondition("at rest, then pressed", Tared(loads_kpa=(0, 0, 3, 60, 0)), rough=False),
    ZeroCondition("tared at the end of the range", END),
    ZeroCondition("all tared at the end of the range", every(END)),
    ZeroCondition("tared at the end of the range, 12 bits", END, skin=FINE),
    ZeroCondition("tared near the end of the range", Tared(loads_kpa=(139, 400, 142, 100))),
    ZeroCondition("tared under 30 kPa", UNDER_LOAD),
    ZeroCondition("all tared under 30 kPa", every(UNDER_LOAD)),
    ZeroCondition("tared under 70 kPa", Tared(loads_kpa=(70, 65, 45, 30, 0))),
    ZeroCondition("torn", TORN),
    ZeroCondition("all torn", every(TORN)),
    ZeroCondition("torn, never tared", TORN, is_tared=False),
    ZeroCondition("torn, tared under load", Tared(loads_kpa=(30, -8.8, 0))),
    ZeroCondition("rest 0.2 V above v0_v, never tared", LIGHT, is_tared=False),
    ZeroCondition(
        "rest 0.2 V above the converter", replace(LIGHT, rest_v=3.5), v0_v=3.5, is_tared=False
    ),
    ZeroCondition("rest 0.2 V above the converter, tared", replace(LIGHT, rest_v=3.5), v0_v=3.5),
)


def conditions() -> Iterator[ZeroCondition]:
    """Yield all conditions."""
    for condition in CASES:
        yield replace(condition, name=f"zeros: {condition.name}")
