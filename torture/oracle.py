# SPDX-License-Identifier: Apache-2.0

"""Knows what the nodes of simulated skins really said, and holds published frames against it."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import TactileFrame
from tactile_cdma.sim.line import truth
from tactile_cdma.sim.nodes import NodeFrame
from tactile_cdma.sim.options import Setup, SimOptions

from .outcome import Tally

KEPT = 4096
"""True frames kept for published ones that come late."""
NEAR = 0.25
"""Share of a frame period by which a published frame may be off its true start."""


@dataclass
class Stream:
    """The true frames from a START on. started_s: device time of the START."""

    options: SimOptions
    setup: Setup
    started_s: float
    _coming: Iterator[NodeFrame] = field(init=False)
    _past: deque[NodeFrame] = field(init=False, default_factory=lambda: deque(maxlen=KEPT))

    def __post_init__(self) -> None:
        self._coming = truth(self.options, self.setup)

    def frame_at(self, t_start: float) -> NodeFrame | None:
        """The frame whose first chip begins about then, device s; None if there is none."""
        period_s = self.setup.spec.frame_period_s
        since_s = t_start - self.started_s
        while not self._past or self._past[-1].start_s < since_s - period_s / 2:
            self._past.append(next(self._coming))
        before = (self._past[-1].start_s - since_s) / period_s
        place = len(self._past) - 1 - round(before)
        if not 0 <= place < len(self._past):
            return None
        frame = self._past[place]
        return frame if abs(frame.start_s - since_s) < NEAR * period_s else None

    def spoke(self, first: int, stop: int) -> NDArray[np.bool_]:
        """(n,) bool: nodes that spoke in any kept frame of these numbers, [first, stop)."""
        spoke = np.zeros(self.setup.spec.nodes, bool)
        for frame in self._past if first < stop else ():
            if first <= frame.number < stop:
                spoke |= frame.active
        return spoke


@dataclass(frozen=True, slots=True)
class Verdict:
    """What is to be said of one published frame.

    number: of the true frame since START; None: there was no such frame, all its words are wrong.
    stream: which START it belongs to, counted from 0.
    wrong: (n,) bool, nodes that are published with another word than they sent, or that were
        silent. missed: (n,) bool, nodes that spoke and were not published.
    lost: true frames since the last published one of the same stream; None for a stream's first.
    uncounted: by how much the published sequence differs from that.
    """

    number: int | None
    stream: int
    wrong: NDArray[np.bool_]
    missed: NDArray[np.bool_]
    lost: int | None
    uncounted: int


class Oracle:
    """Tells of every published frame, in their order, what is wrong with it."""

    def __init__(self) -> None:
        self.streams: list[Stream] = []
        self._last: tuple[int, int, int] | None = None  # stream, number, sequence

    def began(self, options: SimOptions, setup: Setup, started_s: float) -> None:
        """A digitizer obeyed START, at this time of its clock."""
        self.streams.append(Stream(options, setup, started_s))

    def check(self, frame: TactileFrame) -> Verdict:
        """What is to be said of a published frame."""
        index, true = self._find(frame)
        words = frame.words
        if true is None:
            return Verdict(None, index, words.active, np.zeros_like(words.active), None, 0)
        wrong = words.active & (~true.active | (words.codes != true.codes))
        lost, uncounted = None, 0
        if self._last is not None and self._last[0] == index:
            lost = true.number - self._last[1] - 1
            uncounted = abs(frame.sequence - self._last[2] - 1 - lost)
        self._last = (index, true.number, frame.sequence)
        return Verdict(true.number, index, wrong, true.active & ~words.active, lost, uncounted)

    def _find(self, frame: TactileFrame) -> tuple[int, NodeFrame | None]:
        """The newest stream that has such a frame, and that frame.

        After a restart frames of the old stream may still come; clocks that start anew can make
        both plausible, and then the words decide.
        """
        found: tuple[int, NodeFrame | None] = (len(self.streams) - 1, None)
        oldest = self._last[0] if self._last else 0
        for index in range(len(self.streams) - 1, oldest - 1, -1):
            true = self.streams[index].frame_at(frame.t_start)
            if true is None:
                continue
            spoke = frame.words.active
            if np.array_equal(frame.words.codes[spoke], true.codes[spoke]):
                return index, true
            if found[1] is None:
                found = (index, true)
        return found


class Judge:
    """Judges the frames that one driver publishes by what the nodes really said.

    What campaigns look at besides, times, pressures, counts, is added by their own judges.
    tally: what was found so far.
    """

    def __init__(self) -> None:
        self.tally = Tally()
        self.oracle = Oracle()

    def check(self, frame: TactileFrame) -> Verdict:
        """What is to be said of the next published frame; its wrong words are counted."""
        verdict = self.oracle.check(frame)
        self.tally.frames += 1
        self.tally.wrong_values += int(verdict.wrong.sum() + verdict.missed.sum())
        return verdict


def pressures(config: SkinConfig) -> NDArray[np.float64]:
    """What every code of every node means by its curve, (n, codes) Pa.

    The highest code says "so much or more": no pressure, where the sensor rests above it.
    """
    volts = config.adc.voltage(np.arange(1 << config.adc.bits))
    curves = [config.calibration.curves[node] for node in range(config.spec.nodes)]
    volts[-1] = max(volts[-1], *(curve.voltage_v[0] for curve in curves))
    return np.array([curve.pressure(volts) for curve in curves])


class Held:
    """What a driver reads that has heard these words: the last one of every node.

    pressure_pa: (n,) float64, Pa; NaN where it is not known.
    """

    def __init__(self, config: SkinConfig) -> None:
        self._pressure_of = pressures(config)
        self._nodes = np.arange(config.spec.nodes)
        self.pressure_pa = np.full(config.spec.nodes, np.nan)

    def after(
        self, active: NDArray[np.bool_], codes: NDArray[np.integer[Any]]
    ) -> NDArray[np.float64]:
        """What pressure_pa would be after these words, (n,) each."""
        return np.where(active, self._pressure_of[self._nodes, codes], self.pressure_pa)

    def hear(self, active: NDArray[np.bool_], codes: NDArray[np.integer[Any]]) -> None:
        """Take in words, (n,) each."""
        self.pressure_pa = self.after(active, codes)

    def miss(self, nodes: NDArray[np.bool_]) -> None:
        """Words of these nodes, (n,) bool, may have been lost."""
        self.pressure_pa[nodes] = np.nan
