# SPDX-License-Identifier: Apache-2.0

"""Finds what inexact parts make of a front end: many skins, drawn from the parts' classes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amplifier import CREST, RAIL_V, TOLERANCE, FrontEnd
from tactile_cdma.base.arrays import Floats

COARSE = 0.05
"""Tolerance of the resistors in many drawers, which the calculator compares with TOLERANCE."""
SKINS = 1000
"""Skins that are drawn; chosen: shares are known to 1 to 2 %."""
MOST_DRAWN = 2_000_000
"""Nodes drawn at most, of all skins; fewer skins then. Chosen: a second."""


@dataclass(frozen=True, slots=True)
class Scatter:
    """Skins whose resistors are off by up to their tolerance, uniformly.

    skins: drawn. left: share of them of which a sum leaves the converter's range or comes too near
    to a supply: of all nodes, or CREST·√n of them. rest_v: standard deviation of the rest of the
    line, V. level: largest deviation of a node's level from A, relative.
    """

    skins: int
    left: float
    rest_v: float
    level: float


def scatter(
    front: FrontEnd,
    half_tolerance: float | None = None,
    seed: int = 1,
    tolerance: float = TOLERANCE,
) -> Scatter:
    """Draw skins. tolerance: of resistors; half_tolerance: of those that make half the supply."""
    half = front.half_tolerance if half_tolerance is None else half_tolerance
    rng = np.random.default_rng(seed)
    skins = max(1, min(SKINS, MOST_DRAWN // front.nodes))
    outputs = [_output(front, tolerance, half, rng) for _ in range(skins)]
    rest_v = np.array([rest for rest, _ in outputs])
    levels_v = np.array([levels for _, levels in outputs])
    if front.talking <= CREST**2:
        swing_v = np.abs(levels_v).sum(axis=1) * (front.talking / front.nodes)
    else:
        share = front.talking / front.nodes
        swing_v = CREST * np.sqrt(np.square(levels_v).sum(axis=1) * share)
    top_v = min(front.supply_v - RAIL_V, front.adc_volts)
    left = (rest_v + swing_v > top_v) | (rest_v - swing_v < RAIL_V)
    return Scatter(
        skins,
        float(left.mean()),
        float(rest_v.std()),
        float(np.abs(np.abs(levels_v) / front.amplitude_v - 1).max()),
    )


def _output(
    front: FrontEnd, tolerance: float, half_tolerance: float, rng: np.random.Generator
) -> tuple[float, Floats]:
    """Compute the middle of one skin's output, V, and what each node adds to it, (n,) V."""

    def parts(ohm: float, shape: int | tuple[int, ...], tolerance: float = tolerance) -> Floats:
        return ohm * (1 + rng.uniform(-tolerance, tolerance, shape))

    n, supply_v = front.nodes, front.supply_v
    rests_v, levels_v = np.full(n, supply_v / 2), np.full(n, supply_v / 2)
    if front.attenuator:
        to_supply, to_ground = (1 / parts(front.attenuator.bias_ohm, n) for _ in range(2))
        to_pin = 1 / parts(front.attenuator.series_ohm, n)
        rests_v = supply_v * to_supply / (to_supply + to_ground)
        levels_v = supply_v / 2 * to_pin / (to_supply + to_ground + to_pin)
    stage, size = front.nodes_stage, front.nodes_stage.inputs
    group = np.arange(n) // size
    groups = int(group[-1]) + 1
    gains = parts(stage.feedback_ohm, groups)[group] / parts(stage.input_ohm, n)
    half_v = _half(supply_v, parts(1.0, (2, groups), half_tolerance))
    outputs_v = half_v + np.bincount(group, gains * (half_v[group] - rests_v))
    levels_v = -levels_v * gains
    if front.groups_stage is None:
        return float(outputs_v[0]), levels_v
    last = front.groups_stage
    group_gains = parts(last.feedback_ohm, 1) / parts(last.input_ohm, groups)
    (half_v,) = _half(supply_v, parts(1.0, (2, 1), half_tolerance))
    output_v = half_v + np.sum(group_gains * (half_v - outputs_v))
    return float(output_v), -levels_v * group_gains[group]


def _half(supply_v: float, pair: Floats) -> Floats:
    """Return a divider's output, V, of two resistors (2, m)."""
    upper, lower = pair
    half_v: Floats = supply_v * lower / (upper + lower)
    return half_v
