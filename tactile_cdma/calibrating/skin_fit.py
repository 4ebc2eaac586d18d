# SPDX-License-Identifier: Apache-2.0

"""Fits a curve to every node of a skin, or says why a node has none."""

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from ..base.arrays import Bools, Floats, Indices, Int64s
from ..readings.calibration import AdcScale, PressureCurve
from ..readings.calibration_file import HEADROOM
from .curve_fit import LEAST_LEVELS, CurveFit, fit_curves, fit_power_laws, levels_of
from .load_points import LoadPoints, directions

FIRST_LOAD = 0.25
"""Bound of the smallest load, as a share of the largest; chosen: the curve has to reach 0."""
WIDEST_GAP = 0.5
"""Widest gap between neighbouring loads, share of the largest; chosen: a knee hides in more."""
LEAST_FALL = 8.0
"""Least fall of a node's voltage, LSB; chosen: well above quantisation and a flickering code."""
MOST_OUTLIERS = 0.2
"""Largest share of outliers in a node's points; chosen: beyond it is not clear which are right."""
MOST_NOISE = 0.1
"""Largest noise from point to point, as a share of a curve's fall; chosen. Hysteresis is none."""
POWER_LAW = 0
"""Number of pieces that stands for a power law, of a force sensing resistor in its divider."""
POINTS_AT_ONCE = 50_000
"""Points fitted together; chosen: keeps the arrays within a cache or two."""


@dataclass(frozen=True, eq=False)
class SkinFit:
    """Curves of a skin's nodes, and how they fit m points.

    curves: by node. refused: by node, why it has none. pieces: of each curve, or POWER_LAW.
    residual_v, residual_pa: (m,) voltage minus curve, V, and pressure read minus applied, Pa; NaN
    where a node was refused or the converter at an end of its range. outlier: (m,) bool.
    piece: (m,) int64, number of the piece that a point was fitted with, from 0; −1: it was not.
    sigma_v, loop: by node: standard deviation of its points, V; widest difference of unloading
    and loading as a share of the fall, NaN where loads only rose.
    """

    points: LoadPoints
    adc: AdcScale
    pieces: int
    curves: dict[int, PressureCurve]
    refused: dict[int, str]
    residual_v: Floats
    residual_pa: Floats
    outlier: Bools
    piece: Int64s
    sigma_v: dict[int, float]
    loop: dict[int, float]


def fit_skin(points: LoadPoints, nodes: int, adc: AdcScale, pieces: int = 2) -> SkinFit:
    """Fit the curves of nodes 1…nodes; problems of single nodes are in `refused`.

    pieces: of each curve, or POWER_LAW.
    """
    # At an end of its range the converter says "this or more", which is no value to fit.
    usable = points.voltage_v < adc.vref_v - 1.5 * adc.lsb_v
    usable &= points.voltage_v > 0.5 * adc.lsb_v
    rows = points.by_node(nodes)
    good, refused = dict[int, Indices](), dict[int, str]()
    for node, own in rows.items():
        if reason := _unfit(points, own, usable, adc, pieces):
            refused[node] = reason
        else:
            good[node] = own[usable[own]]
    residual_v, residual_pa = np.full((2, len(points)), np.nan)
    piece = np.full(len(points), -1)
    result = SkinFit(
        points, adc, pieces, {}, refused, residual_v, residual_pa, piece > 0, piece, {}, {}
    )
    size = max(1, POINTS_AT_ONCE // max(map(len, good.values()), default=1))
    for i in range(0, len(good), size):
        _fit_nodes(result, dict(list(good.items())[i : i + size]))
    return replace(result, refused=dict(sorted(refused.items())))


def _fit_nodes(result: SkinFit, rows: dict[int, Indices]) -> None:
    """Enter curves of the nodes that have these rows, or why they have none."""
    points, adc = result.points, result.adc
    pressure_pa = np.full((len(rows), max(map(len, rows.values()))), np.nan)
    voltage_v = pressure_pa.copy()
    for index, own in enumerate(rows.values()):
        pressure_pa[index, : len(own)] = points.pressure_pa[own]
        voltage_v[index, : len(own)] = points.voltage_v[own]
    noise_v = adc.lsb_v / math.sqrt(12)
    if result.pieces == POWER_LAW:
        whole = fit_power_laws(pressure_pa, voltage_v, adc.vref_v, noise_v)
    else:
        whole = fit_curves(pressure_pa, voltage_v, result.pieces, noise_v)
    for index, (node, own) in enumerate(rows.items()):
        fit = whole.sensor(index, len(own))
        if reason := _unsound(points, own, fit, adc, result.pieces):
            result.refused[node] = reason
            continue
        corner_pa, corner_v = fit.corner_pa, fit.corner_v
        load_pa, used = points.pressure_pa[own], fit.used
        piece = np.searchsorted(corner_pa[1:-1], load_pa)
        gain = (np.diff(corner_pa) / np.diff(corner_v))[piece]
        known = _errors(load_pa[used], fit.residual_v[used], gain[used], adc)
        corners = tuple(corner_pa.tolist()), tuple(corner_v.tolist())
        result.curves[node] = PressureCurve(*corners, *known)
        result.piece[own], result.outlier[own] = np.where(used, piece, -1), ~used
        result.residual_v[own] = fit.residual_v
        result.residual_pa[own] = fit.residual_v * gain
        result.sigma_v[node] = float(fit.sigma_v)
        loop_v = _loop_v(load_pa[used], fit.residual_v[used])
        result.loop[node] = loop_v / abs(float(corner_v[0] - corner_v[-1]))


def _unfit(
    points: LoadPoints, own: Indices, usable: Bools, adc: AdcScale, pieces: int
) -> str | None:
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
    if len(levels_pa) < LEAST_LEVELS * max(pieces, 1):
        return (
            f"{len(levels_pa)} different loads; a curve of {max(pieces, 1)} pieces needs "
            f"{LEAST_LEVELS * max(pieces, 1)}"
        )
    if pieces and levels_pa[0] > FIRST_LOAD * largest_pa:
        return f"no load below {levels_pa[0] / 1e3:g} kPa: the curve begins at 0, add light loads"
    gap = int(np.argmax(np.diff(levels_pa)))
    if pieces and levels_pa[gap + 1] - levels_pa[gap] > WIDEST_GAP * largest_pa:
        return (
            f"no load between {levels_pa[gap] / 1e3:g} and {levels_pa[gap + 1] / 1e3:g} kPa: "
            "add some there"
        )
    heavy, voltage_v = load_pa > 0.5 * (load_pa.min() + largest_pa), points.voltage_v[own]
    change_v = abs(np.median(voltage_v[~heavy]) - np.median(voltage_v[heavy]))
    if change_v < LEAST_FALL * adc.lsb_v:
        return (
            f"the voltage changes by {change_v * 1e3:.0f} mV only, between loads below and above "
            f"{largest_pa / 2e3:g} kPa: was the load on this node?"
        )
    return None


def _unsound(
    points: LoadPoints, own: Indices, fit: CurveFit, adc: AdcScale, pieces: int
) -> str | None:
    corner_pa, corner_v, used = fit.corner_pa, fit.corner_v, fit.used
    if np.count_nonzero(~used) > MOST_OUTLIERS * len(own):
        return (
            f"{np.count_nonzero(~used)} of {len(own)} points contradict the others "
            f"({points.lines(own[~used])})"
        )
    fall_v = abs(corner_v[0] - corner_v[-1])
    rises = corner_v[-1] > corner_v[0]
    noise_v = math.sqrt(np.mean(np.square(np.diff(fit.residual_v[used]))) / 2)
    if noise_v > MOST_NOISE * fall_v:
        return (
            f"too noisy: {noise_v:.3f} V rms from point to point on a curve that changes by "
            f"{fall_v:.3f} V; do pressures and voltages belong together?"
        )
    own = own[used]
    load_pa = points.pressure_pa[own]
    slack_pa = 1e-6 * corner_pa[-1]
    if pieces == POWER_LAW:
        return None if fit.knee_found else "the voltages follow no power law"
    for (begin_pa, begin_v), (end_pa, end_v) in pairwise(zip(corner_pa, corner_v, strict=True)):
        within = (load_pa >= begin_pa - slack_pa) & (load_pa <= end_pa + slack_pa)
        where = f"from {begin_pa / 1e3:.1f} to {end_pa / 1e3:.1f} kPa"
        if (end_v - begin_v if rises else begin_v - end_v) < 2 * adc.lsb_v:
            return (
                f"the voltage does not {'rise' if rises else 'fall'} {where} "
                f"({points.lines(own[within])}): saturated, or loads mixed up?"
            )
        if not within.any() or len(levels_of(load_pa[within])) < LEAST_LEVELS:
            return f"fewer than {LEAST_LEVELS} loads on the piece {where}: add some there"
    if not fit.knee_found:
        return (
            f"no knee up to {corner_pa[-1] / 1e3:g} kPa: the loads do not reach it; go higher, or "
            f"fit a curve of {len(corner_pa) - 2} pieces"
        )
    beyond_v = HEADROOM * adc.vref_v * (np.arange(len(corner_v)) == 0)
    if np.any((corner_v < -beyond_v) | (corner_v > adc.vref_v + beyond_v)):
        return (
            f"the curve runs from {corner_v[0]:.2f} to {corner_v[-1]:.2f} V, the converter's range "
            f"is 0…{adc.vref_v:g} V"
        )
    return None


def _errors(
    load_pa: Floats, residual_v: Floats, gain: Floats, adc: AdcScale
) -> tuple[float, float]:
    """Find PressureCurve's residual_v and loop, of points in the order in which they were taken.

    Squares of residuals, Pa, are fitted by a part that is alike in V and one that is alike as a
    share of the load, weighted as if these were a count and 5 %. gain: (m,), Pa/V.
    """
    rms_v = math.sqrt(np.mean(np.square(residual_v)))
    if min(np.count_nonzero(directions(load_pa) < 0), np.count_nonzero(load_pa)) < 2:
        return rms_v, math.nan  # loads only rose
    parts = np.stack([np.square(gain), np.square(load_pa)])
    weight = 1 / (parts[0] * adc.lsb_v**2 + parts[1] * 0.05**2)
    parts, found = parts * weight, np.square(residual_v * gain) * weight
    residual_v2, loop2 = np.linalg.lstsq(parts.T, found, rcond=None)[0]
    if loop2 < 0:
        return rms_v, 0.0
    if residual_v2 < 0:
        residual_v2, loop2 = 0.0, (parts[1] @ found) / (parts[1] @ parts[1])
    return math.sqrt(residual_v2), math.sqrt(loop2)


def _loop_v(pressure_pa: Floats, residual_v: Floats) -> float:
    """Find the widest difference of unloading and loading at one load, V; NaN: none came twice.

    pressure_pa, residual_v: (m,), in the order in which they were taken. Residuals of loads that
    were reached from above are compared with those interpolated between loads from below.
    """
    direction = directions(pressure_pa)
    up, down = direction >= 0, direction < 0
    if np.count_nonzero(down) < 2 or np.count_nonzero(up) < 2:
        return math.nan
    order = np.argsort(pressure_pa[up], kind="stable")
    loading_v = np.interp(pressure_pa[down], pressure_pa[up][order], residual_v[up][order])
    return float(np.max(np.abs(residual_v[down] - loading_v)))
