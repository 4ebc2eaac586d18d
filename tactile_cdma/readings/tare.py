# SPDX-License-Identifier: Apache-2.0

"""Tare: makes what a skin reads at rest its zero, unless something touches or moves it."""

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Bools, Floats
from ..base.errors import Refusal, RestError
from ..base.text import listed
from ..places.layout import Layout
from .baseline import LOOK_S, LOOKS, Baseline
from .calibration import Curves

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
        _check_heard(~valid & (may_yet_speak | valids.any(axis=0)))
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
    unheard: list[int] = (np.flatnonzero(~valid) + 1).tolist()
    return unheard


def _check_heard(awaited: Bools) -> None:
    """Refuse the tare if nodes are awaited: they would be left with another zero."""
    if early := (np.flatnonzero(awaited) + 1).tolist():
        raise RestError(
            f"not tared: not yet heard for {LOOKS * LOOK_S:g} s: {listed(early, 'node')}; "
            "try again, or tare the others with force: true",
            Refusal.EARLY,
        )


def _refuse(
    reason: Refusal, layout: Layout, nodes: Bools, amounts: _Numbers, ranks: _Numbers
) -> None:
    """Refuse the tare for these nodes, if there are any. amounts: (n,), V or Pa; ranks: (n,)."""
    own, (text, per_unit, unit) = np.flatnonzero(nodes), _CAUSES[reason]
    if own.size:
        worst = own[np.argsort(-ranks[own], kind="stable")].tolist()
        shown = {
            i: f"{_name(i, layout)} {amounts[i] * per_unit:.2f} {unit}" for i in worst[:_NAMED]
        }
        names = listed(worst, most=_NAMED, show=shown.__getitem__)
        raise RestError(f"not tared, {text.format(names)}", reason)


def _name(index: int, layout: Layout) -> str:
    """Return a node and its place on the skin."""
    taxel = int(np.flatnonzero(layout.nodes == index + 1)[0])
    if layout.rows == 1:
        return f"node {index + 1} (taxel {taxel})"
    return f"node {index + 1} (row {taxel // layout.columns}, column {taxel % layout.columns})"
