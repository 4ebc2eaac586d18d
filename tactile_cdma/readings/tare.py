# SPDX-License-Identifier: Apache-2.0

"""Taking what a skin reads at rest for zero, unless something touches or moves it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.errors import RestError
from ..base.listing import listed
from ..places.layout import Layout
from .baseline import LOOK_S, LOOKS, Baseline
from .calibration import Curves

MOVING_LSB = 2.5
"""A node whose voltage changed by more within the last second moves: not if a code flickers."""
_MOST_NAMES = 8


def take_tare(
    baseline: Baseline,
    curves: Curves,
    layout: Layout,
    lsb_v: float,
    contact_pa: float,
    awaited: NDArray[np.bool_],
    force: bool = False,
) -> list[int]:
    """Make the median of the last second the zero of every node with valid readings.

    Pressure goes into the tare. A voltage above the curve's beginning is no pressure: what is
    above goes into the drift.
    lsb_v: one count of the nodes' converters, V. awaited: (n,) bool, nodes that may be heard soon.
    Returns the numbers of the nodes without valid readings, which keep what they had.

    Raises RestError, naming the taxels, where a node moves, reads more than contact_pa (Pa) above
    its present zero, or has yet to be heard for a second, unless forced; and where there is nothing
    to take a tare from.
    """
    if not baseline.seen:
        raise RestError(
            f"not tared: the skin has been read for less than {LOOKS * LOOK_S:g} s; try again"
        )
    valid, pressure_pa = baseline.valid, baseline.pressure_pa
    if not valid.any():
        raise RestError("not tared: no node has a valid reading; is the skin powered?")
    if not force:
        _refuse_early(np.flatnonzero(~valid & (awaited | baseline.ever_valid)) + 1)
        above_pa = pressure_pa - baseline.tare_pa
        moving = valid & (baseline.span_v > MOVING_LSB * lsb_v)
        _refuse("moving", moving, above_pa, layout, "wait until nothing moves them")
        loaded = valid & (above_pa > contact_pa)
        remedy = "take away what touches them, or, if this is how the skin rests, "
        _refuse("under load", loaded, above_pa, layout, remedy + "tare with force: true")
    begin_v = curves.voltage_v[0].astype(np.float32)
    rest_v = baseline.voltage_v + baseline.drift_v
    above_v = np.where(valid, np.maximum(rest_v - begin_v, 0), np.float32(0))
    before_v = begin_v if baseline.rest_v is None else baseline.rest_v
    baseline.drift_v = baseline.drift_v - above_v
    baseline.tare_pa = np.where(valid, pressure_pa, baseline.tare_pa)
    baseline.rest_v = np.where(valid, rest_v - above_v, before_v)
    unheard: list[int] = (np.flatnonzero(~valid) + 1).tolist()
    return unheard


def _refuse_early(numbers: NDArray[np.intp]) -> None:
    """Raises RestError where there are nodes, which would be left with another zero."""
    if not len(numbers):
        return
    raise RestError(
        f"not tared: not yet heard for {LOOKS * LOOK_S:g} s: {listed(numbers.tolist(), 'node')}; "
        "try again, or tare the others with force: true"
    )


def _refuse(
    state: str,
    nodes: NDArray[np.bool_],
    pressure_pa: NDArray[np.float32],
    layout: Layout,
    remedy: str,
) -> None:
    """Raises RestError where there are nodes, the most loaded first."""
    numbers = np.flatnonzero(nodes)
    if not len(numbers):
        return
    numbers = numbers[np.argsort(-pressure_pa[numbers], kind="stable")]
    names = listed(
        numbers.tolist(),
        most=_MOST_NAMES,
        show=lambda i: f"{_name(i, layout)} {pressure_pa[i] / 1e3:.2f} kPa",
    )
    raise RestError(f"not tared, {state}: {names}; {remedy}")


def _name(index: int, layout: Layout) -> str:
    """A node and where it is, for people."""
    taxel = int(np.flatnonzero(layout.nodes == index + 1)[0])
    if layout.rows == 1:
        return f"node {index + 1} (taxel {taxel})"
    return f"node {index + 1} (row {taxel // layout.columns}, column {taxel % layout.columns})"
