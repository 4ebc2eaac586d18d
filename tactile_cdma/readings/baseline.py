# SPDX-License-Identifier: Apache-2.0

"""What a skin reads at rest: tare and slow drift, which are taken off its readings."""

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Bools, Floats, Floats32
from ..base.errors import Refusal, RestError
from ..base.text import listed
from ..places.layout import Layout
from .calibration import Curves

LOOK_S = 0.125
"""Interval of the looks at the skin for tare and drift, s; chosen: rare enough to cost nothing."""
LOOKS = 8
"""Looks that a tare is taken from: those of the last second."""
MOVING_LSB = 2.5
"""A node moves if its voltage changed by more within the last second, LSB: codes that flicker
between neighbours differ by 1 or 2."""
_Numbers = NDArray[np.floating]
_NAMED = 8
"""Nodes named in a refusal: as many as a person reads."""
ALL = "all"
"""Force that takes readings for rest that are not certain, too."""
_OTHERWISE = ", or, if this is how the skin rests, tare with force: true"
_CAUSES = {
    Refusal.MOVING: ("moving: {}; wait until nothing moves them", 1e3, "mV"),
    Refusal.LOADED: ("under load: {}; take away what touches them" + _OTHERWISE, 1e-3, "kPa"),
    Refusal.SENSOR: (
        "before where their curves begin: {}; check their sensors" + _OTHERWISE,
        *(1e3, "mV"),
    ),
}
"""Text with a place for nodes, factor and unit of what is told of each."""


@dataclass(frozen=True, slots=True)
class RestRules:
    """Limits of what counts as rest.

    drift_pa_per_min: fastest drift that is followed, Pa/min; 0: none. contact_pa: a node that reads
    more is under load, Pa. release_pa: where a node reads more, Pa, drift is followed neither there
    nor on the nodes beside it.
    """

    drift_pa_per_min: float
    contact_pa: float
    release_pa: float


class Baseline:
    """Holds what is taken off each node's readings, and the last second, of which a tare is made.

    tare_pa: (n,) float32, Pa, pressure at rest (mounting, preload), subtracted from readings.
    drift_v: (n,) float32, V, added to measured voltages to undo what temperature and age do.
    rest_v: (n,) float32, V, the voltage, drift added, at which the tare was taken; None: no tare.
    least_pa: (n,) float32, Pa, the lowest tare since the first or a forced one, taken at least_v,
    (n,) float32, V, as rest_v. tared_drift_v: (n,) float32, V, the drift at that one. From these
    counts what is taken for rest unasked.

    These arrays are replaced, never written to: a reference to one is a snapshot.
    """

    def __init__(self, nodes: int) -> None:
        self.tare_pa = self.least_pa = np.zeros(nodes, dtype=np.float32)
        self.drift_v = np.zeros(nodes, dtype=np.float32)
        self.tared_drift_v = np.zeros(nodes, dtype=np.float32)
        self.rest_v: Floats32 | None = None
        self.least_v: Floats32 | None = None
        self._looks = deque[tuple[Floats32, Floats32, Bools]](maxlen=LOOKS)

    def clear(self) -> None:
        """Forget tare and drift, and the looks taken while they were in force."""
        self.forget()
        self.tare_pa = self.least_pa = np.zeros_like(self.tare_pa)
        self.drift_v = self.tared_drift_v = np.zeros_like(self.drift_v)
        self.rest_v = self.least_v = None

    @property
    def tared(self) -> bool:
        return self.rest_v is not None

    def forget(self) -> None:
        """Forget the looks: they are too old."""
        self._looks.clear()

    def look(self, voltage_v: Floats32, pressure_pa: Floats32, valid: Bools) -> None:
        """Remember what the skin reads now, for the next LOOKS looks.

        voltage_v: (n,) V, without drift_v. pressure_pa: (n,) Pa, before the tare. valid: (n,) bool.
        """
        self._looks.append((voltage_v.copy(), pressure_pa.copy(), valid.copy()))

    @property
    def seen(self) -> bool:
        """Tell whether the skin has been looked at often enough for a tare."""
        return len(self._looks) == LOOKS

    @property
    def last_second(self) -> tuple[Floats32, Floats32, Bools]:
        """Return the last looks, (l, n) each: V without drift_v, Pa before the tare, validity."""
        voltage_v, pressure_pa, valid = map(np.array, zip(*self._looks, strict=True))
        return voltage_v, pressure_pa, valid


def take_tare(
    baseline: Baseline,
    curves: Curves,
    layout: Layout,
    lsb_v: float,
    contact_pa: float,
    may_yet_speak: Bools,
    sure_s: Floats,
    force: bool | str = False,
) -> list[int]:
    """Make the median of the last second the zero of every node with valid readings.

    Its pressure becomes the tare. A voltage before the start of the curve is no pressure: the rest
    becomes drift.
    lsb_v: one count of the nodes' converters, V. may_yet_speak: (n,) bool, nodes whose
    first word may still come. sure_s: (n,), for how long what was read has been certain, s.
    Returns the numbers of the nodes without valid readings, which keep the zero they had.

    Unless forced, raises RestError, naming the taxels, if a node moves, reads more than contact_pa
    (Pa) above its lowest zero since the first or a forced tare, so that many tares hide no more
    than two, rests before the start of its curve by more than that would pull it away, or has not
    been heard for a second; forced or not, if no node has readings. Force is for certain readings:
    where others would be refused, they are as if there were none, unless it is ALL.
    """
    if not baseline.seen:
        raise RestError(
            f"not tared: the skin has been read for less than {LOOKS * LOOK_S:g} s; try again",
            Refusal.EARLY,
        )
    voltages_v, pressures_pa, valids = baseline.last_second
    valid, pressure_pa = valids.all(axis=0), np.median(pressures_pa, axis=0)
    begin_v, rest_v = curves.begin_v, np.median(voltages_v, axis=0) + baseline.drift_v
    before_v = np.where(valid, np.maximum(curves.sign * (rest_v - begin_v), 0), np.float32(0))
    above_pa, moved_v = pressure_pa - baseline.least_pa, np.ptp(voltages_v, axis=0)
    moving = valid & (moved_v > MOVING_LSB * lsb_v)
    loaded = valid & (above_pa > contact_pa)
    torn = before_v > curves.pull_v(contact_pa)
    # What is certain now, and did not move, was right before it was certain.
    sure = (sure_s >= LOOKS * LOOK_S) | (sure_s > 0) & ~moving | (force == ALL)
    if force:
        valid &= sure | ~(moving | loaded | torn)
        before_v[~valid] = 0
    if not valid.any():
        text = "not tared: no node has a valid, certain reading; is the skin powered?"
        raise RestError(text, Refusal.NO_READING)
    if not force:
        if (awaited := ~valid & (may_yet_speak | valids.any(axis=0))).any():
            early = listed((np.flatnonzero(awaited) + 1).tolist(), "node")
            raise RestError(  # they would be left with another zero
                f"not tared: not yet heard for {LOOKS * LOOK_S:g} s: {early}; "
                "try again, or tare the others with force: true",
                Refusal.EARLY,
            )
        # Where something moves over the skin, the nodes that it has left need no naming.
        moving = moving & loaded if (moving & loaded).any() else moving
        # By voltage: a pressure does not move where it is clamped to 0.
        _refuse(Refusal.MOVING, layout, moving, moved_v, above_pa)
        _refuse(Refusal.LOADED, layout, loaded, above_pa, above_pa)
        _refuse(Refusal.SENSOR, layout, torn, before_v, before_v)
    excess_v, last_v = curves.sign * before_v, baseline.rest_v
    baseline.drift_v = baseline.drift_v - excess_v
    if force or not baseline.tared:
        begun = valid & sure
        baseline.least_pa = np.where(begun, pressure_pa, baseline.least_pa)
        baseline.tared_drift_v = np.where(begun, baseline.drift_v, baseline.tared_drift_v)
    baseline.tare_pa = np.where(valid, pressure_pa, baseline.tare_pa)
    baseline.rest_v = np.where(valid, rest_v - excess_v, begin_v if last_v is None else last_v)
    lowest = baseline.tare_pa <= baseline.least_pa
    baseline.least_pa = np.minimum(baseline.least_pa, baseline.tare_pa)
    least_v = baseline.rest_v if baseline.least_v is None else baseline.least_v
    baseline.least_v = np.where(lowest, baseline.rest_v, least_v)
    return [*map(int, np.flatnonzero(~valid) + 1)]


def _refuse(
    reason: Refusal, layout: Layout, nodes: Bools, amounts: _Numbers, ranks: _Numbers
) -> None:
    """Refuse the tare for these nodes, if there are any. amounts: (n,), V or Pa; ranks: (n,)."""
    own, (text, scale, unit) = np.flatnonzero(nodes), _CAUSES[reason]
    if own.size:
        worst = own[np.argsort(-ranks[own], kind="stable")].tolist()
        shown = {i: f"{_name(i, layout)} {amounts[i] * scale:.2f} {unit}" for i in worst[:_NAMED]}
        names = listed(worst, most=_NAMED, show=shown.__getitem__)
        raise RestError(f"not tared, {text.format(names)}", reason)


def _name(index: int, layout: Layout) -> str:
    taxel = int(np.flatnonzero(layout.nodes == index + 1)[0])
    if layout.rows == 1:
        return f"node {index + 1} (taxel {taxel})"
    return f"node {index + 1} (row {taxel // layout.columns}, column {taxel % layout.columns})"
