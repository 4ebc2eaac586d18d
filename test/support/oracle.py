# SPDX-License-Identifier: Apache-2.0

"""The truth: what the nodes of simulated skins really sent. Compares published frames with it."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import TactileFrame
from tactile_cdma.sim.line import truth
from tactile_cdma.sim.nodes import NodeFrame, Turns
from tactile_cdma.sim.options import Setup, SimOptions

KEPT = 4096
"""True frames that are kept, for published frames that come late."""
NEAR = 0.25
"""Tolerance of a frame's start for telling which frame it is, in frame periods; < 0.5."""


@dataclass
class Stream:
    """The true frames since a START. started_s: device time of that START.

    turns: of the digitizer, which enters there in which frames it asks all nodes to speak.
    """

    options: SimOptions
    setup: Setup
    started_s: float
    turns: Turns = field(default_factory=Turns)
    _coming: Iterator[NodeFrame] = field(init=False)
    _past: deque[NodeFrame] = field(init=False, default_factory=lambda: deque(maxlen=KEPT))

    def __post_init__(self) -> None:
        self._coming = truth(self.options, self.setup, Turns(self.turns.divisions))

    def frame_at(self, t_start: float) -> NodeFrame | None:
        """The frame whose first chip begins near this device time, s; None if there is none."""
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
    """The comparison of one published frame with the truth.

    number: of the true frame since START; None if there is no such frame: all its words are wrong.
    stream: index of the START it belongs to.
    wrong: (n,) bool, nodes published with a word they did not send. missed: (n,) bool, nodes that
        sent a word that was not published.
    lost: true frames since the last published one of the same stream; None for a stream's first.
    uncounted: difference between that and what the published sequence says.
    """

    number: int | None
    stream: int
    wrong: NDArray[np.bool_]
    missed: NDArray[np.bool_]
    lost: int | None
    uncounted: int


class Oracle:
    """Compares every published frame, in order, with the streams that began so far."""

    def __init__(self) -> None:
        self.streams: list[Stream] = []
        self._last: tuple[int, int, int] | None = None  # stream, number, sequence

    def began(self, options: SimOptions, setup: Setup, started_s: float, turns: Turns) -> None:
        """Note that a digitizer obeyed START, at this time of its clock, s."""
        self.streams.append(Stream(options, setup, started_s, turns))

    def check(self, frame: TactileFrame) -> Verdict:
        """Compare the next published frame."""
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
        """The newest stream with a frame at this time, and that frame.

        After a restart, frames of the old stream may still come. If both streams have a frame at
        that time of their clocks, the words decide.
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


def pressures(config: SkinConfig) -> NDArray[np.float64]:
    """The pressure of every code of every node, (n, codes) Pa, from the calibration's curves.

    The highest code means "this voltage or more": rest, if the sensor rests above it.
    """
    volts = config.adc.voltage(np.arange(1 << config.adc.bits))
    curves = [config.calibration.curves[node] for node in range(config.spec.nodes)]
    volts[-1] = max(volts[-1], *(curve.voltage_v[0] for curve in curves))
    return np.array([curve.pressure(volts) for curve in curves])


class Held:
    """The readings that a driver must hold: those of every node's last word.

    pressure_pa: (n,) float64, Pa; NaN if unknown.
    """

    def __init__(self, config: SkinConfig) -> None:
        self._pressure_of = pressures(config)
        self._nodes = np.arange(config.spec.nodes)
        self.pressure_pa = np.full(config.spec.nodes, np.nan)

    def after(
        self, active: NDArray[np.bool_], codes: NDArray[np.integer[Any]]
    ) -> NDArray[np.float64]:
        """pressure_pa after these words, (n,) each."""
        return np.where(active, self._pressure_of[self._nodes, codes], self.pressure_pa)

    def hear(self, active: NDArray[np.bool_], codes: NDArray[np.integer[Any]]) -> None:
        """Take in words, (n,) each."""
        self.pressure_pa = self.after(active, codes)

    def miss(self, nodes: NDArray[np.bool_]) -> None:
        """Forget these nodes, (n,) bool, whose words may have been lost."""
        self.pressure_pa[nodes] = np.nan
