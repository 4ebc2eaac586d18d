# SPDX-License-Identifier: Apache-2.0

"""Reports the quality of a skin's fit: in words, as key=value, and as a picture."""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from ..base.arrays import Floats
from ..base.errors import CalibrationError, needed_for
from ..base.named_file import naming
from ..base.text import listed
from ..readings.calibration import Curves, PressureCurve
from .skin_fit import POWER_LAW, SkinFit, fit_skin

BENT = 0.3
"""Von Neumann's ratio, halved, below which a curve is too simple: 3 σ below the 1 of independent
residuals of 20 points, where σ is 1/√20."""
POOR = 0.05
"""Rms residual, as a share of the largest load, that is warned of; chosen: above noise."""
UNSEEN = 0.01
"""Lightest load, as a share of the largest, up to which the voltage at rest counts as measured."""
WRONG_UNIT = 5.0
"""Ratio of a skin's sensitivity to the default curve's; chosen: most units differ by 10 or more."""
ADVISED_NODES, BETTER = 16, 0.8
"""Nodes that other curves are tried on, and the share of the errors that is worth one; chosen."""
_MOST_REFUSALS, _DRAWN_NODES, _DRAWN_POINTS = 40, 64, 20_000
"""Most refusals listed, nodes and points drawn; chosen: as many as one can tell apart."""


@dataclass(frozen=True, eq=False)
class Stage:
    """One piece of all n fitted curves.

    sensitivity_v_per_pa: (n,), V/Pa, positive.
    lsb_pa: pressure of one count, median of nodes, Pa. rms_pa: residual of points on it, Pa.
    """

    sensitivity_v_per_pa: Floats
    lsb_pa: float
    rms_pa: float

    @property
    def limit_pa(self) -> float:
        """Return the rms error of a perfect curve behind this converter: LSB/√12."""
        return self.lsb_pa / math.sqrt(12)


def stages(fit: SkinFit) -> list[Stage]:
    """Return the pieces in their order; those of a power law are none."""
    result: list[Stage] = []
    if fit.pieces == POWER_LAW:
        return result
    for number, sensitivity in enumerate(_sensitivities(fit.curves.values()).T):
        residual_pa = fit.residual_pa[fit.piece == number]
        lsb_pa = float(np.median(fit.adc.lsb_v / sensitivity))
        rms_pa = math.sqrt(np.square(residual_pa).sum() / max(len(residual_pa), 1))
        result.append(Stage(sensitivity, lsb_pa, rms_pa))
    return result


def describe(fit: SkinFit) -> str:
    """Return the report for people, several lines."""
    kind = "power laws" if fit.pieces == POWER_LAW else f"curves of {fit.pieces} pieces"
    lines = [
        f"{len(fit.curves)} nodes fitted from {len(fit.points)} points, {kind}; "
        f"{np.count_nonzero(fit.outlier)} outliers left out"
    ]
    lines += _refusals(fit.refused)
    if not fit.curves:
        return "\n".join(lines)
    if rising := [node for node, curve in fit.curves.items() if curve.rises]:
        who = "all nodes" if len(rising) == len(fit.curves) else listed(rising, "node")
        lines.append(f"voltages rise with the pressure: {who}")
    if fit.pieces:
        lines.append(
            "stage  sensitivity (least to most)     1 LSB    LSB/√12   residual  over LSB/√12"
        )
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
    parts = [f"{rms_pa / 1e3:.3g} kPa to {end_pa / 1e3:.3g} kPa" for end_pa, rms_pa in errors(fit)]
    lines.append(
        f"expect errors, rms, of {', '.join(parts)}; in all {rms_pa(fit) / 1e3:.3g} kPa, "
        f"{rms_pa(fit) / float(fit.points.pressure_pa.max()):.1%} of the largest load"
    )
    loops = [(share, node) for node, share in fit.loop.items() if math.isfinite(share)]
    if loops:
        share, node = max(loops)
        lines.append(
            f"loop between loading and unloading: up to {share:.1%} of the change (node {node}); "
            "the curve is in its middle"
        )
    else:
        lines.append("no falling loads: neither hysteresis nor creep shows")
    if fit.outlier.any():
        lines.append(f"outliers: {fit.points.source}, {fit.points.lines(fit.outlier)}")
    return "\n".join(lines)


def rms_pa(fit: SkinFit) -> float:
    """Return the error of all points used, rms, Pa."""
    return math.sqrt(np.mean(np.square(fit.residual_pa[fit.piece >= 0])))


def errors(fit: SkinFit) -> list[tuple[float, float]]:
    """Return errors to expect: the end of each quarter of the range, and its rms error, Pa."""
    load_pa, off_pa = fit.points.pressure_pa[fit.piece >= 0], fit.residual_pa[fit.piece >= 0]
    ends_pa = load_pa.max() * np.arange(1, 5) / 4
    quarter = np.searchsorted(ends_pa * (1 + 1e-9), load_pa)
    return [
        (float(end_pa), math.sqrt(np.mean(np.square(off_pa[quarter == number]))))
        for number, end_pa in enumerate(ends_pa)
        if (quarter == number).any()
    ]


def advice(fit: SkinFit, nodes: int) -> str | None:
    """Tell which other curve would fit better, with fewer pieces first; None: this one does.

    By the mean error of all points, outliers too, of some nodes that both fit.
    """
    some = np.unique(fit.points.node)
    own = np.isin(fit.points.node, some[:: math.ceil(len(some) / ADVISED_NODES)])
    points = fit.points.of_rows(own)
    first = best = fit_skin(points, nodes, fit.adc, fit.pieces)
    for pieces in (POWER_LAW, 1, 2, 3, 4):
        other = fit_skin(points, nodes, fit.adc, pieces)
        more = len(other.curves) - len(best.curves)
        if more > 0 or (more == 0 and _mean_error_pa(other) < BETTER * _mean_error_pa(best)):
            best = other
    if best is first:
        return None
    option = f"--pieces {best.pieces}" if best.pieces else "--power-law"
    instead = f", not {_mean_error_pa(first) / 1e3:.3g} kPa" if first.curves else ""
    return f"{option} would be off by {_mean_error_pa(best) / 1e3:.3g} kPa on average{instead}"


def _mean_error_pa(fit: SkinFit) -> float:
    """Return the mean |error| of all points, Pa, enlarged by what the curves' freedom takes off."""
    off_pa = np.abs(fit.residual_pa[np.isfinite(fit.residual_pa)])
    free = len(off_pa) - 2 * max(fit.pieces, 1) * len(fit.curves)
    return float(off_pa.mean() * math.sqrt(len(off_pa) / max(free, 1))) if len(off_pa) else math.inf


def difference_pa(curve: PressureCurve, other: PressureCurve) -> float:
    """Return the most that another curve reads beside what this one does, Pa."""
    pressure_pa = np.union1d(curve.pressure_pa, np.linspace(0, curve.pressure_pa[-1], 200))
    return float(np.abs(other.pressure(curve.voltage(pressure_pa)) - pressure_pa).max())


def _refusals(refused: Mapping[int, str]) -> list[str]:
    nodes_of = defaultdict[str, list[int]](list)
    for node, reason in refused.items():
        nodes_of[reason].append(node)
    lines = [f"  {listed(nodes, 'node')}: no curve: {reason}" for reason, nodes in nodes_of.items()]
    if (more := len(lines) - _MOST_REFUSALS) > 0:
        lines[_MOST_REFUSALS:] = [f"  and {more} reasons more"]
    return lines


def warnings(fit: SkinFit, default: PressureCurve, contact_pa: float) -> list[str]:
    """Return what was fitted and yet may be wrong, a line each.

    default: curve of sensors like these. contact_pa: lightest contact, Pa.
    """
    if not fit.curves:
        return []
    found, pieces = [], stages(fit)
    largest_pa = float(fit.points.pressure_pa.max())
    sensitivity = np.median(_sensitivities(fit.curves.values())[:, 0])
    ratio = float(sensitivity / _sensitivities([default])[0, 0])
    if fit.pieces and not 1 / WRONG_UNIT < ratio < WRONG_UNIT:
        found.append(
            f"{ratio:.3g} times as sensitive as the parameters say: is the loads' unit right, and "
            "the area of forces?"
        )
    if (lightest_pa := float(fit.points.pressure_pa.min())) > UNSEEN * largest_pa:
        found.append(
            f"no load below {lightest_pa / 1e3:.3g} kPa: curves are extrapolated to 0; does the "
            "reference read 0 without a load?"
        )
    if off_rest := _off_rest(fit, contact_pa):
        found.append(
            f"{listed(off_rest, 'node')}: at rest before where the curve begins, thus no reading "
            "there (FAULTY): other --pieces, or --power-law?"
        )
    if numb_pa := _numb_pa(fit, contact_pa):
        found.append(
            f"loads up to {numb_pa / 1e3:.3g} kPa leave a converter at the end of its range, where "
            "the curve reads no contact: such touches are not felt"
        )
    if bent := _bent(fit):
        found.append(
            f"{listed(bent, 'node')}: off to one side over whole stretches of load: more --pieces?"
        )
    residual_pa = max([stage.rms_pa for stage in pieces] or [rms_pa(fit)])
    if residual_pa > POOR * largest_pa:
        found.append(
            f"off by {residual_pa / 1e3:.1f} kPa rms, {residual_pa / largest_pa:.0%} of the "
            "largest load: noise, hysteresis, or loads and voltages of different moments?"
        )
    return found


def _off_rest(fit: SkinFit, contact_pa: float) -> list[int]:
    """Find nodes whose voltages under their lightest loads lie before the start of their curves.

    It counts as in the driver: by more than contact_pa would pull them from there.
    """
    points, curves = fit.points, Curves.of(list(fit.curves.values()))
    rows = points.by_node(max(fit.curves))
    lightest = [rows[node][np.argmin(points.pressure_pa[rows[node]])] for node in fit.curves]
    before_v = curves.sign * (points.voltage_v[lightest] - curves.begin_v)
    off = before_v > curves.pull_v(contact_pa)
    return [node for node, is_off in zip(fit.curves, off, strict=True) if is_off]


def _numb_pa(fit: SkinFit, contact_pa: float) -> float:
    """Find the largest load that a converter at its end reads as no contact, Pa; 0: none."""
    points, end = fit.points, np.isnan(fit.residual_v)
    columns = zip(points.node[end], points.pressure_pa[end], points.voltage_v[end], strict=True)
    felt = ((pa, float(fit.curves[n].pressure(v))) for n, pa, v in columns if n in fit.curves)
    return max(
        (float(pa) for pa, read_pa in felt if read_pa <= contact_pa < pa - read_pa), default=0.0
    )


def _bent(fit: SkinFit) -> list[int]:
    """Find nodes whose residuals go on from load to load, and are more than quantisation.

    The statistic is von Neumann's ratio ("Distribution of the ratio of the mean square successive
    difference to the variance", Ann. Math. Stat. 12, 1941), halved: 1 for independent residuals.
    """
    bent = []
    for node, own in fit.points.by_node(max(fit.curves)).items():
        own = own[fit.piece[own] >= 0]
        residual_v = fit.residual_v[own[np.argsort(fit.points.pressure_pa[own], kind="stable")]]
        successive = np.square(np.diff(residual_v)).sum() / 2
        noisy = fit.sigma_v.get(node, 0.0) > fit.adc.lsb_v
        if noisy and successive / (len(own) - 1) < BENT * np.var(residual_v):
            bent.append(node)
    return bent


def results(fit: SkinFit) -> dict[str, str]:
    """Return the report's numbers, for programs."""
    values = {
        "fitted": str(len(fit.curves)),
        "uncalibrated": str(len(fit.refused)),
        "points": str(len(fit.points)),
        "outliers": str(np.count_nonzero(fit.outlier)),
        "error_kpa": f"{rms_pa(fit) / 1e3:.4g}",
    }
    for number, stage in enumerate(stages(fit), 1):
        values[f"residual{number}_over_quantisation"] = f"{stage.rms_pa / stage.limit_pa:.3f}"
    return values


def draw(fit: SkinFit, path: Path) -> None:
    """Draw curves with points, and residuals, as a PNG.

    Raises CalibrationError where it cannot be written.
    """
    with needed_for("a picture", "matplotlib"):
        from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.5), layout="constrained")
    axes, beside = figure.subplots(1, 2)
    drawn = list(fit.curves)[:: math.ceil(len(fit.curves) / _DRAWN_NODES)]
    for node in drawn:
        curve = fit.curves[node]
        axes.plot(np.array(curve.pressure_pa) / 1e3, curve.voltage_v, lw=0.7, color="C0")
    shown, load_kpa = np.isin(fit.points.node, drawn), fit.points.pressure_pa / 1e3
    for mask, style, label in ((~fit.outlier, "k.", "points"), (fit.outlier, "rx", "outliers")):
        mask = mask & shown
        axes.plot(load_kpa[mask], fit.points.voltage_v[mask], style, ms=3, label=label)
    of = f" of {len(fit.curves)}" if len(drawn) < len(fit.curves) else ""
    title = f"curves of {len(drawn)}{of} nodes"
    axes.set(xlabel="pressure / kPa", ylabel="voltage / V", title=title)
    axes.legend()
    known = np.flatnonzero(fit.piece >= 0)
    known = known[:: math.ceil(len(known) / _DRAWN_POINTS)]
    beside.plot(load_kpa[known], fit.residual_pa[known] / 1e3, "k.", ms=2, alpha=0.5)
    ends_kpa = np.array([0, *np.median(_knees_pa(fit), axis=0), fit.points.pressure_pa.max()]) / 1e3
    for stage, (begin_kpa, end_kpa) in zip(stages(fit), pairwise(ends_kpa), strict=False):
        half_kpa = stage.lsb_pa / 2e3
        beside.hlines([-half_kpa, half_kpa], begin_kpa, end_kpa, "C1", lw=1)
    beside.set(xlabel="pressure / kPa", ylabel="off by / kPa", title="residuals; orange: ±½ LSB")
    with naming(path, CalibrationError):
        figure.savefig(path, format="png", dpi=110)


def _sensitivities(curves: Iterable[PressureCurve]) -> Floats:
    """Return the change of the voltage on every piece of n curves, (n, p) V/Pa, positive."""
    return np.array([np.abs(np.diff(c.voltage_v)) / np.diff(c.pressure_pa) for c in curves])


def _knees_pa(fit: SkinFit) -> Floats:
    """Return all curves' knees, (n, pieces − 1) Pa; a power law has none."""
    inner = slice(1, -1) if fit.pieces else slice(0)
    return np.array([curve.pressure_pa[inner] for curve in fit.curves.values()])
