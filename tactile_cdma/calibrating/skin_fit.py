# SPDX-License-Identifier: Apache-2.0

"""The points of a whole skin → a curve for every node, or the reason why there is none."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..base.errors import CalibrationError
from ..readings.calibration import AdcScale, PressureCurve
from ..readings.calibration_file import HEADROOM
from .curve_fit import LEAST_LEVELS, Fit, Floats, Mask, fit_curves, levels_of
from .load_points import LoadPoints, directions

FIRST_LOAD = 0.25
"""The smallest load must lie below this share of the largest: the curve begins at 0."""
WIDEST_GAP = 0.5
"""Of the largest load, between neighbouring loads."""
LEAST_FALL = 8.0
"""LSB that a voltage must fall by."""
MOST_OUTLIERS = 0.2
"""Share of a node's points; if more contradict the others, it is not clear which are right."""
MOST_NOISE = 0.1
"""Share of a curve's fall. Noise is what differs from point to point: hysteresis is none."""


@dataclass(frozen=True, eq=False)
class SkinFit:
    """What m points say of a skin's nodes.

    curves: by node. refused: why a node has none, by node. pieces: of every curve.
    residual_v: (m,) voltage minus curve, V, NaN where a node was refused or the converter at its
        end. outlier: (m,) bool.
    sigma_v, loop: by node: standard deviation of its points, V; widest difference of unloading
        and loading as a share of the fall, NaN where loads only rose.
    """

    points: LoadPoints
    adc: AdcScale
    pieces: int
    curves: dict[int, PressureCurve]
    refused: dict[int, str]
    residual_v: Floats
    outlier: Mask
    sigma_v: dict[int, float]
    loop: dict[int, float]


def fit_skin(points: LoadPoints, nodes: int, adc: AdcScale, pieces: int = 2) -> SkinFit:
    """Fit the curves of nodes 1…nodes.

    Raises CalibrationError where the voltages of most nodes rise with the pressure. All else that
    is wrong is wrong with single nodes, and in `refused`.
    """
    # The converter says "this or more" there, which is no value to fit.
    usable = points.voltage_v < adc.vref_v - 1.5 * adc.lsb_v
    usable &= points.voltage_v > 0.5 * adc.lsb_v
    rows = points.by_node(nodes)
    _check_direction(points, rows, adc)
    refused: dict[int, str] = {}
    good: dict[int, NDArray[np.intp]] = {}
    for node, own in rows.items():
        if reason := _unfit(points, own, usable, adc, pieces):
            refused[node] = reason
        else:
            good[node] = own[usable[own]]
    result = SkinFit(
        points,
        adc,
        pieces,
        curves={},
        refused=refused,
        residual_v=np.full(len(points), np.nan),
        outlier=np.zeros(len(points), dtype=bool),
        sigma_v={},
        loop={},
    )
    if good:
        fit = _fit(points, good, adc, pieces)
        for index, (node, own) in enumerate(good.items()):
            if reason := _unsound(points, own, fit, index, adc):
                refused[node] = reason
            else:
                _accept(result, node, own, fit, index)
    return replace(result, refused=dict(sorted(refused.items())))


def _accept(result: SkinFit, node: int, own: NDArray[np.intp], fit: Fit, index: int) -> None:
    """Enter what was found for one node."""
    corner_pa, corner_v = fit.corner_pa[index], fit.corner_v[index]
    result.curves[node] = PressureCurve(tuple(corner_pa.tolist()), tuple(corner_v.tolist()))
    result.residual_v[own] = fit.residual_v[index, : len(own)]
    result.outlier[own] = ~fit.used[index, : len(own)]
    result.sigma_v[node] = float(fit.sigma_v[index])
    inliers = own[~result.outlier[own]]
    loop_v = _loop_v(result.points.pressure_pa[inliers], result.residual_v[inliers])
    result.loop[node] = loop_v / float(corner_v[0] - corner_v[-1])


def _fit(points: LoadPoints, rows: dict[int, NDArray[np.intp]], adc: AdcScale, pieces: int) -> Fit:
    """The nodes' points side by side, shorter rows filled up with NaN, and fitted."""
    longest = max(map(len, rows.values()))
    pressure_pa = np.full((len(rows), longest), np.nan)
    voltage_v = pressure_pa.copy()
    for index, own in enumerate(rows.values()):
        pressure_pa[index, : len(own)] = points.pressure_pa[own]
        voltage_v[index, : len(own)] = points.voltage_v[own]
    return fit_curves(pressure_pa, voltage_v, pieces, adc.lsb_v / math.sqrt(12))


def _check_direction(points: LoadPoints, rows: dict[int, NDArray[np.intp]], adc: AdcScale) -> None:
    rises = [
        rise_v > LEAST_FALL * adc.lsb_v
        for own in rows.values()
        if len(own) and np.isfinite(rise_v := _rise_v(points, own))
    ]
    if rises and np.mean(rises) > 0.5:
        raise CalibrationError(
            f"{points.source}: voltages rise with the pressure on {sum(rises)} of {len(rises)} "
            "nodes, they should fall: are the columns swapped, or is the sensor on the other side "
            "of its divider?"
        )


def _rise_v(points: LoadPoints, own: NDArray[np.intp]) -> float:
    """From the lighter to the heavier half of a node's loads, V: outliers do not turn it round."""
    pressure_pa, voltage_v = points.pressure_pa[own], points.voltage_v[own]
    middle_pa = 0.5 * (pressure_pa.min() + pressure_pa.max())
    heavy = pressure_pa > middle_pa
    if not heavy.any():
        return math.nan
    return float(np.median(voltage_v[heavy]) - np.median(voltage_v[~heavy]))


def _unfit(
    points: LoadPoints, own: NDArray[np.intp], usable: Mask, adc: AdcScale, pieces: int
) -> str | None:
    """Why a node's points cannot be fitted, or None."""
    if not len(own):
        return "no points"
    at_end = own[~usable[own]]
    if len(at_end) > 0.5 * len(own):
        return (
            f"{len(at_end)} of {len(own)} voltages are at an end of the converter's range "
            f"({points.lines(at_end)}): is the sensor connected?"
        )
    own = own[usable[own]]
    load_pa = points.pressure_pa[own]
    largest_pa = float(load_pa.max())
    if largest_pa == 0:
        return "no load but 0"
    levels_pa = levels_of(load_pa)
    if len(levels_pa) < LEAST_LEVELS * pieces:
        return (
            f"{len(levels_pa)} different loads; a curve of {pieces} pieces needs "
            f"{LEAST_LEVELS * pieces}"
        )
    if levels_pa[0] > FIRST_LOAD * largest_pa:
        return f"no load below {levels_pa[0] / 1e3:g} kPa: the curve begins at 0, add light loads"
    gap = int(np.argmax(np.diff(levels_pa)))
    if levels_pa[gap + 1] - levels_pa[gap] > WIDEST_GAP * largest_pa:
        return (
            f"no load between {levels_pa[gap] / 1e3:g} and {levels_pa[gap + 1] / 1e3:g} kPa: "
            "add some there"
        )
    fall_v = 0.0 - _rise_v(points, own)
    if fall_v < LEAST_FALL * adc.lsb_v:
        return (
            f"the voltage falls by {fall_v * 1e3:.0f} mV only, between loads below and above "
            f"{largest_pa / 2e3:g} kPa: was the load on this node?"
        )
    return None


def _unsound(
    points: LoadPoints, own: NDArray[np.intp], fit: Fit, index: int, adc: AdcScale
) -> str | None:
    """Why the curve that fits a node's points best is none to rely on, or None."""
    corner_pa, corner_v = fit.corner_pa[index], fit.corner_v[index]
    used = fit.used[index, : len(own)]
    if np.count_nonzero(~used) > MOST_OUTLIERS * len(own):
        return (
            f"{np.count_nonzero(~used)} of {len(own)} points contradict the others "
            f"({points.lines(own[~used])})"
        )
    fall_v = corner_v[0] - corner_v[-1]
    residual_v = fit.residual_v[index, : len(own)][used]
    noise_v = math.sqrt(np.mean(np.square(np.diff(residual_v))) / 2)
    if noise_v > MOST_NOISE * abs(fall_v):
        return (
            f"too noisy: {noise_v:.3f} V rms from point to point on a curve that falls by "
            f"{fall_v:.3f} V; do pressures and voltages belong together?"
        )
    used_rows = own[used]
    load_pa = points.pressure_pa[used_rows]
    slack_pa = 1e-6 * corner_pa[-1]
    for piece, (begin_pa, end_pa) in enumerate(pairwise(corner_pa)):
        within = (load_pa >= begin_pa - slack_pa) & (load_pa <= end_pa + slack_pa)
        where = f"from {begin_pa / 1e3:.1f} to {end_pa / 1e3:.1f} kPa"
        if corner_v[piece] - corner_v[piece + 1] < 2 * adc.lsb_v:
            return (
                f"the voltage does not fall {where} ({points.lines(used_rows[within])}): "
                "saturated, or loads mixed up?"
            )
        if not within.any() or len(levels_of(load_pa[within])) < LEAST_LEVELS:
            return f"fewer than {LEAST_LEVELS} loads on the piece {where}: add some there"
    if not fit.knee_found[index]:
        return (
            f"no knee up to {corner_pa[-1] / 1e3:g} kPa: the loads do not reach it; go higher, or "
            f"fit a curve of {len(corner_pa) - 2} pieces"
        )
    if corner_v[-1] < 0 or corner_v[0] > HEADROOM * adc.vref_v:
        return (
            f"the curve runs from {corner_v[0]:.2f} to {corner_v[-1]:.2f} V, the converter's range "
            f"is 0…{adc.vref_v:g} V"
        )
    return None


def _loop_v(pressure_pa: Floats, residual_v: Floats) -> float:
    """Widest difference between unloading and loading at one load, V; NaN where none came twice.

    pressure_pa, residual_v: (m,), in the order in which they were taken. Residuals of loads that
    were reached from below and from above are compared, so that equal loads need not be the same.
    """
    direction = directions(pressure_pa)
    up, down = direction >= 0, direction < 0
    if np.count_nonzero(down) < 2 or np.count_nonzero(up) < 2:
        return math.nan
    order = np.argsort(pressure_pa[up], kind="stable")
    loading_v = np.interp(pressure_pa[down], pressure_pa[up][order], residual_v[up][order])
    return float(np.max(np.abs(residual_v[down] - loading_v)))
