# SPDX-License-Identifier: Apache-2.0

"""What a fit of a skin's curves is worth: in words, as key=value, and as a picture."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.listing import listed
from ..readings.calibration import PressureCurve
from .curve_fit import Floats
from .picture import picture
from .skin_fit import SkinFit

WORST = 5
"""Nodes that are named."""
BENT = 0.3
"""Variance from load to load, of that of all residuals, below which the curve is too simple."""
POOR = 0.05
"""rms residual, of the largest load, that is more than a sensor's noise."""
UNSEEN = 0.01
"""Of the largest load: where the lightest is more, what is below was not measured."""
WRONG_UNIT = 5.0
"""Factor between a skin's sensitivity and that of the default curve."""
_MOST_REFUSALS = 40
_DRAWN_NODES = 64
_DRAWN_POINTS = 20_000


@dataclass(frozen=True, eq=False)
class Stage:
    """One piece of all n fitted curves.

    sensitivity_v_per_pa: (n,) V/Pa, positive. residual_pa: (n,) rms, Pa, NaN without a point.
    lsb_pa: what one count is worth there, median of the nodes, Pa.
    """

    sensitivity_v_per_pa: Floats
    residual_pa: Floats
    lsb_pa: float

    @property
    def limit_pa(self) -> float:
        """The rms error of a perfect curve behind this converter: LSB/√12."""
        return self.lsb_pa / math.sqrt(12)

    @property
    def rms_pa(self) -> float:
        """The rms residual of all nodes, Pa."""
        known = np.isfinite(self.residual_pa)
        return float(np.sqrt(np.mean(np.square(self.residual_pa[known])))) if known.any() else 0.0


def stages(fit: SkinFit) -> list[Stage]:
    """The pieces in their order."""
    residual_pa, piece = residuals_pa(fit)
    index_of = {node: index for index, node in enumerate(fit.curves)}
    used = np.isfinite(residual_pa) & ~fit.outlier
    row = np.array([index_of.get(node, 0) for node in fit.points.node.tolist()])
    result = []
    for number in range(fit.pieces):
        sensitivity = np.array([_fall(fit.curves[node], number) for node in fit.curves])
        own = used & (piece == number)
        count = np.bincount(row[own], minlength=len(fit.curves))
        squares = np.bincount(row[own], np.square(residual_pa[own]), minlength=len(fit.curves))
        rms = np.full(len(fit.curves), np.nan)
        rms[count > 0] = np.sqrt(squares[count > 0] / count[count > 0])
        result.append(Stage(sensitivity, rms, float(np.median(fit.adc.lsb_v / sensitivity))))
    return result


def residuals_pa(fit: SkinFit) -> tuple[Floats, NDArray[np.int64]]:
    """What every point is off in pressure, (m,) Pa, NaN where not fitted, and on which piece."""
    residual_pa = np.full(len(fit.points), np.nan)
    piece = np.zeros(len(fit.points), dtype=np.int64)
    order = np.argsort(fit.points.node, kind="stable")
    ends = np.searchsorted(fit.points.node[order], [*fit.curves, np.inf])
    stops = np.searchsorted(fit.points.node[order], list(fit.curves), side="right")
    for node, start, stop in zip(fit.curves, ends, stops, strict=False):
        own, corners = order[start:stop], fit.curves[node].pressure_pa
        piece[own] = np.searchsorted(corners[1:-1], fit.points.pressure_pa[own])
        slopes = np.array([_fall(fit.curves[node], number) for number in range(fit.pieces)])
        residual_pa[own] = -fit.residual_v[own] / slopes[piece[own]]
    return residual_pa, piece


def describe(fit: SkinFit) -> str:
    """The report for people, several lines."""
    lines = [
        f"{len(fit.curves)} nodes fitted from {len(fit.points)} points, curves of "
        f"{fit.pieces} pieces; {np.count_nonzero(fit.outlier)} outliers left out"
    ]
    lines += _refusals(fit.refused)
    if not fit.curves:
        return "\n".join(lines)
    lines.append("stage  sensitivity (least to most)     1 LSB    LSB/√12   residual  over LSB/√12")
    for number, stage in enumerate(stages(fit), 1):
        each = stage.sensitivity_v_per_pa * 1e3
        lines.append(
            f"{number:5}  {np.median(each):.5f} V/kPa ({each.min():.5f}…{each.max():.5f})  "
            f"{stage.lsb_pa / 1e3:.3f} kPa  {stage.limit_pa / 1e3:.3f} kPa  "
            f"{stage.rms_pa / 1e3:.3f} kPa  {stage.rms_pa / stage.limit_pa:.2f}"
        )
    for number, knees in enumerate(_knees_pa(fit).T, 1):
        lines.append(
            f"knee {number}: {np.median(knees) / 1e3:.2f} kPa, {knees.min() / 1e3:.2f} to "
            f"{knees.max() / 1e3:.2f} kPa, standard deviation {knees.std() / 1e3:.2f} kPa"
        )
    loop = _widest_loop(fit)
    if math.isfinite(loop):
        node = max(fit.loop, key=lambda node: np.nan_to_num(fit.loop[node]))
        lines.append(
            f"loop between loading and unloading: up to {loop:.1%} of the fall (node {node}); the "
            "curve is in its middle"
        )
    else:
        lines.append("no falling loads: neither hysteresis nor creep shows")
    worst = sorted(fit.sigma_v, key=lambda node: -fit.sigma_v[node])[:WORST]
    lines.append(
        "farthest off: "
        + ", ".join(f"node {node} ({fit.sigma_v[node] / fit.adc.lsb_v:.2f} LSB)" for node in worst)
    )
    if fit.outlier.any():
        where = fit.points.lines(fit.outlier)
        lines.append(f"outliers: {fit.points.source}, {where}")
    return "\n".join(lines)


def _refusals(refused: Mapping[int, str]) -> list[str]:
    """A line for each reason, with the nodes that share it."""
    nodes_of: dict[str, list[int]] = {}
    for node, reason in refused.items():
        nodes_of.setdefault(reason, []).append(node)
    lines = [f"  {listed(nodes, 'node')}: no curve: {reason}" for reason, nodes in nodes_of.items()]
    more = len(lines) - _MOST_REFUSALS
    return lines[:_MOST_REFUSALS] + ([f"  and {more} reasons more"] if more > 0 else [])


def warnings(fit: SkinFit, default: PressureCurve) -> list[str]:
    """What was fitted and yet may be wrong, a line each. default: of sensors like these."""
    if not fit.curves:
        return []
    found, pieces = [], stages(fit)
    largest_pa = float(fit.points.pressure_pa.max())
    ratio = float(np.median(pieces[0].sensitivity_v_per_pa)) / _fall(default, 0)
    if not 1 / WRONG_UNIT < ratio < WRONG_UNIT:
        found.append(
            f"{ratio:.3g} times as sensitive as the parameters say: is the loads' unit right, and "
            "the area of forces?"
        )
    if (lightest_pa := float(fit.points.pressure_pa.min())) > UNSEEN * largest_pa:
        found.append(
            f"no load below {lightest_pa / 1e3:.3g} kPa: curves are extrapolated to 0; does the "
            "reference read 0 without a load?"
        )
    if bent := _bent(fit):
        found.append(
            f"{listed(bent, 'node')}: off to one side over whole stretches of load: more --pieces?"
        )
    residual_pa = max(stage.rms_pa for stage in pieces)
    if residual_pa > POOR * largest_pa:
        found.append(
            f"off by {residual_pa / 1e3:.1f} kPa rms, {residual_pa / largest_pa:.0%} of the "
            "largest load: noise, hysteresis, or loads and voltages of different moments?"
        )
    return found


def _bent(fit: SkinFit) -> list[int]:
    """Nodes whose residuals go on from load to load, and are more than quantisation.

    The statistic is von Neumann's ratio ("Distribution of the ratio of the mean square successive
    difference to the variance", Ann. Math. Stat. 12, 1941), halved: 1 for independent residuals.
    """
    order = np.argsort(fit.points.pressure_pa, kind="stable")
    order = order[np.isfinite(fit.residual_v[order]) & ~fit.outlier[order]]
    order = order[np.argsort(fit.points.node[order], kind="stable")]
    stops = np.cumsum(np.bincount(fit.points.node[order]))
    bent = []
    for node in fit.curves:
        residual_v = fit.residual_v[order[stops[node - 1] : stops[node]]]
        successive = 0.5 * float(np.mean(np.square(np.diff(residual_v))))
        if fit.sigma_v[node] > fit.adc.lsb_v and successive < BENT * np.var(residual_v):
            bent.append(node)
    return bent


def results(fit: SkinFit) -> dict[str, str]:
    """The report's numbers, for programs."""
    values = {
        "fitted": str(len(fit.curves)),
        "uncalibrated": str(len(fit.refused)),
        "points": str(len(fit.points)),
        "outliers": str(np.count_nonzero(fit.outlier)),
    }
    for number, stage in enumerate(stages(fit), 1):
        values[f"sensitivity{number}_v_per_kpa"] = (
            f"{np.median(stage.sensitivity_v_per_pa) * 1e3:.5f}"
        )
        values[f"resolution{number}_kpa"] = f"{stage.lsb_pa / 1e3:.4f}"
        values[f"quantisation{number}_kpa"] = f"{stage.limit_pa / 1e3:.4f}"
        values[f"residual{number}_kpa"] = f"{stage.rms_pa / 1e3:.4f}"
        values[f"residual{number}_over_quantisation"] = f"{stage.rms_pa / stage.limit_pa:.3f}"
    for number, knees in enumerate(_knees_pa(fit).T, 1):
        values[f"knee{number}_kpa"] = f"{np.median(knees) / 1e3:.3f}"
    if math.isfinite(loop := _widest_loop(fit)):
        values["loop"] = f"{loop:.4f}"
    return values


def draw(fit: SkinFit, path: Path) -> None:
    """Curves with points, residuals, and knees as a PNG."""
    with picture(path, (1, 1, 1)) as (curve_axes, residual_axes, knee_axes):
        _draw_curves(fit, curve_axes)
        _draw_residuals(fit, residual_axes)
        for number, knees in enumerate(_knees_pa(fit).T, 1):
            knee_axes.plot(list(fit.curves), knees / 1e3, ".", label=f"knee {number}")
        knee_axes.set(xlabel="node", ylabel="knee / kPa", title="where the slope changes")


def _draw_curves(fit: SkinFit, axes: Any) -> None:
    drawn = list(fit.curves)[:: math.ceil(len(fit.curves) / _DRAWN_NODES)]
    for node in drawn:
        curve = fit.curves[node]
        axes.plot(np.array(curve.pressure_pa) / 1e3, curve.voltage_v, lw=0.7, color="C0")
    shown = np.isin(fit.points.node, drawn)
    for mask, style, label in (
        (shown & ~fit.outlier, "k.", "points"),
        (shown & fit.outlier, "rx", "outliers"),
    ):
        if mask.any():
            pressure_kpa, volts = fit.points.pressure_pa[mask] / 1e3, fit.points.voltage_v[mask]
            axes.plot(pressure_kpa, volts, style, ms=3, label=label)
    of = f" of {len(fit.curves)}" if len(drawn) < len(fit.curves) else ""
    axes.set(
        xlabel="pressure / kPa", ylabel="voltage / V", title=f"curves of {len(drawn)}{of} nodes"
    )
    axes.legend()


def _draw_residuals(fit: SkinFit, axes: Any) -> None:
    residual_pa, _ = residuals_pa(fit)
    known = np.flatnonzero(np.isfinite(residual_pa) & ~fit.outlier)
    known = known[:: math.ceil(len(known) / _DRAWN_POINTS)]
    axes.plot(fit.points.pressure_pa[known] / 1e3, residual_pa[known] / 1e3, "k.", ms=2, alpha=0.5)
    begin_pa = 0.0
    ends_pa = [*np.median(_knees_pa(fit), axis=0), fit.points.pressure_pa.max()]
    for stage, end_pa in zip(stages(fit), ends_pa, strict=True):
        for sign in (-0.5, 0.5):
            edge = sign * stage.lsb_pa / 1e3
            axes.plot([begin_pa / 1e3, end_pa / 1e3], [edge, edge], "C1", lw=1)
        begin_pa = end_pa
    axes.set(xlabel="pressure / kPa", ylabel="off by / kPa", title="residuals; orange: ±½ LSB")


def _fall(curve: PressureCurve, number: int) -> float:
    """Fall of a piece, V/Pa."""
    fall_v = curve.voltage_v[number] - curve.voltage_v[number + 1]
    return fall_v / (curve.pressure_pa[number + 1] - curve.pressure_pa[number])


def _knees_pa(fit: SkinFit) -> Floats:
    """(n, pieces − 1) Pa."""
    knees = [curve.pressure_pa[1:-1] for curve in fit.curves.values()]
    return np.array(knees).reshape(len(knees), fit.pieces - 1)


def _widest_loop(fit: SkinFit) -> float:
    loops = [loop for loop in fit.loop.values() if math.isfinite(loop)]
    return max(loops, default=math.nan)
