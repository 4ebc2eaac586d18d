# SPDX-License-Identifier: Apache-2.0

"""Decides when the sensing nodes send: clocks, turns, thresholds; records what they sent."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..base.arrays import Bools, Floats, Indices, Int64s
from ..readings.calibration import AdcScale
from .sensor import Sensor, SensorModel

_STEP_BITS = 16
"""In which a node counts steps of its rest: `steps` of firmware/core/event.h."""


@dataclass(frozen=True, slots=True)
class NodeFrame:
    """Ground truth of one frame. Arrays have one entry per node, (n,).

    number: frames since START. start_s: when its first chip begins, s since START.
    pressure_pa: float64, true pressure; voltage_v: float64, the sensors' output; both at start_s.
    codes: int64 ADC words. active: bool, nodes that send.
    turn, asked: as in wire.Stretch.
    """

    number: int
    start_s: float
    pressure_pa: Floats
    voltage_v: Floats
    codes: Int64s
    active: Bools
    turn: int = 0
    asked: bool = False


@dataclass(frozen=True, eq=False, slots=True)
class NodeClocks:
    """Clocks of n nodes that start with the sync edge and then count chips of their own.

    delay_chips: (n,) float64, from the sync edge to a node's first chip, nominal chips.
    rate_error: (n,) float64, duration of a node's chip over the nominal one, minus 1.
    """

    delay_chips: Floats
    rate_error: Floats

    def displacement(self, chips: Int64s) -> Floats:
        """Tell how late each node begins chips of these numbers, (n, c), nominal chips."""
        return np.asarray(self.delay_chips[:, None] + self.rate_error[:, None] * chips)


@dataclass
class Turns:
    """The turns by which groups of nodes send in the frames of a stream.

    divisions: frame, log2_groups, stop: from this frame on there are so many groups, and before
    frame `stop` all whose turn it is send. groups_log2: of groups, as they are wanted; None: as the
    divisions say. words_log2: all are to send from the next frame on, in so many turns at least.
    """

    divisions: list[tuple[int, int, int]] = field(default_factory=lambda: [(0, 0, 0)])
    groups_log2: int | None = None
    words_log2: int | None = None

    def turn(self, number: int) -> tuple[int, bool]:
        """Return the turn of a frame, as in wire.Stretch, and `asked`; frames come in order."""
        since, log2, stop = next(each for each in self.divisions[::-1] if each[0] <= number)
        groups = self.groups_log2 or 0
        if self.words_log2 is not None:
            log2, self.words_log2 = max(self.words_log2, groups), None
            since, stop = number, number + (1 << log2)
            self.divisions.append((since, log2, stop))
        elif self.groups_log2 is not None and groups != log2 and number >= stop:
            since, log2 = number, groups
            self.divisions.append((since, log2, stop))
        return (1 << log2) + (number - since) % (1 << log2) if log2 else 0, number < stop


@dataclass(frozen=True, slots=True)
class NodeRules:
    """When a node talks.

    threshold: LSB. A node talks while its code is farther than this from the code that it sent
        last, or, if it follows, from its code at rest. 0: always.
    heartbeat: a node also talks once in so many frames, all by evenly spread turns. 0: never.
    follow: in so many frames a node's rest moves 1 LSB towards its code; while that is n LSB off,
        more than the threshold, in 2^(n - 1) times as many. 0: its rest does not matter.
    """

    threshold: int = 1
    heartbeat: int = 78
    follow: int = 4688

    def has_news(self, codes: Any, rest: Any, last_sent: Any) -> Any:
        """Tell which nodes have news; arrays of any kind, of integers; threshold may be one."""
        always, least = self.threshold == 0, self.threshold
        is_off_rest = (self.follow != 0) & (abs(codes - rest) > least)
        return always | is_off_rest | (abs(codes - last_sent) > least)

    def followed(self, number: Any, codes: Any, rest: Any, xp: Any = np) -> Any:
        """Return the codes at rest after a frame; arrays as above, follow and number may be such.

        xp: the library of the arrays.
        """
        off, frames = abs(codes - rest), number + 1
        step = xp.maximum(self.follow, xp.ones_like(self.follow))
        may = frames // step % (1 << xp.clip(off - 1, 0, _STEP_BITS)) == 0
        may = (frames % step == 0) & (may | (off <= self.threshold))
        return xp.where(may, rest + xp.sign(codes - rest), rest)

    def beat(self, nodes: int) -> Indices:
        """Return (n,) in which frame of every heartbeat's period a node talks."""
        return np.arange(nodes) * self.heartbeat // nodes


def rest_codes(sensors: SensorModel, adc: AdcScale, nodes: int) -> Int64s:
    """Compute what the nodes measure at power-up, before anything touches the skin, (n,)."""
    rest = adc.code(Sensor(sensors, nodes).rest_v)
    stuck = sensors.indices(sensors.stuck, nodes)
    rest[stuck] = np.random.default_rng([sensors.seed, 3]).integers(1 << adc.bits, size=len(stuck))
    return rest
