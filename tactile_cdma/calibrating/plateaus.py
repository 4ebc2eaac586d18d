# SPDX-License-Identifier: Apache-2.0

"""Points from a reference recorded beside a skin: plateaus of the load, offset of the clocks."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..base.arrays import Floats, Floats32, Int64s
from ..readings.calibration import AdcScale, PressureCurve
from .load_points import LoadFile, LoadPoints, node_numbers, pressures, read_table

STEADY = 0.005
"""A load stands still within ± this share of the largest; chosen: a controller's ripple."""
LEAST_FRAMES = 5
"""Frames of a plateau; chosen: a median of fewer does not leave outliers out."""
LEAST_PLATEAUS = 3
"""Loads; fewer are no curve (LEAST_LEVELS of curve_fit)."""
MATCH = 0.85
"""Least correlation of reference and skin at which their clock offset counts as found; chosen."""
RIVAL = 0.02
"""Two offsets whose scores differ by less are equally likely; chosen."""
APART_S = 1.0
"""Two offsets count as different from this difference on, s; chosen: longer than a sensor's lag."""
WHOLE = 0.7
"""An offset that overlaps less of all changes of load yields to a better match; chosen."""
_RASTER_S = 0.01
"""Step of the offsets that are tried, s: about a frame."""
_MOST_RASTER = 1 << 21
"""Steps of the longer recording: bounds memory; six hours have steps of _RASTER_S."""
_LEAST_SHARE = 1e-3
"""Least share of all changes of load that must overlap to be compared at all; chosen."""
_OVERLAP = 0.5
"""Share of the shorter recording that must lie within the other; chosen."""


@dataclass(frozen=True, eq=False)
class Reference(LoadFile):
    """Readings of a reference sensor: m of them, at rising times.

    t_s, pressure_pa: (m,) float64. node: (m,) int64, the node that was loaded; None: all alike.
    """

    t_s: Floats
    pressure_pa: Floats
    node: Int64s | None = None


@dataclass(frozen=True, eq=False)
class Recording:
    """Readings of a skin's nodes.

    t_s: (f,) float64, device time, s. voltage_v: (f, n) float32, V, NaN without a valid reading.
    """

    t_s: Floats
    voltage_v: Floats32


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """offset_s: recording's time minus the reference's, s. error_s: its uncertainty, ±s.

    match: correlation of the two at this offset.
    """

    offset_s: float
    error_s: float
    match: float


def read_reference(
    path: Path, nodes: int, area_m2: float | None = None, units: Sequence[str] = ()
) -> Reference:
    """Read a CSV with the columns time and pressure, or force, with area_m2; units: see read_table.

    It has a column node, too, where not all nodes are loaded alike. Raises CalibrationError, naming
    file, line and cause.
    """
    table = read_table(path, area_m2, units)
    table.require(", which goes with a capture", "time_s", "pressure_kpa")
    pressure_pa, t_s = pressures(table), table.columns["time"]
    if (np.diff(t_s) < 0).any():
        raise table.refusal("time runs backwards", int(np.argmax(np.diff(t_s) < 0)) + 1)
    node = node_numbers(table, nodes) if "node" in table.columns else None
    return Reference(path, table.line, t_s, pressure_pa, node)


def plateau_points(
    reference: Reference, recording: Recording, offset_s: float, settle_s: float, adc: AdcScale
) -> LoadPoints:
    """Make a point for every node on every plateau of the reference.

    offset_s: see ClockOffset. settle_s: readings that are left out after a load came to rest,
    because the sensor creeps, s; the load has to rest for longer.
    Raises CalibrationError where there are too few plateaus.
    """
    everyone = np.arange(1, recording.voltage_v.shape[1] + 1)
    found = []
    for first, last in _plateaus(reference):
        begin_s = reference.t_s[first] + offset_s + settle_s
        end_s = reference.t_s[last] + offset_s
        start, stop = np.searchsorted(recording.t_s, [begin_s, end_s])
        if stop - start < LEAST_FRAMES:
            continue
        voltage_v = steady_voltage(recording.voltage_v[start:stop], adc.lsb_v)
        pressure_pa = np.median(reference.pressure_pa[first : last + 1])
        loaded = everyone if reference.node is None else reference.node[[first]]
        heard = loaded[np.isfinite(voltage_v[loaded - 1])]
        row = (heard, pressure_pa, voltage_v[heard - 1], reference.line[first])
        found.append(np.broadcast_arrays(*row))
    if len(found) < LEAST_PLATEAUS:
        raise reference.refusal(
            f"{len(found)} loads rest for longer than the {settle_s:g} s left out for settling, "
            f"and lie within the capture; {LEAST_PLATEAUS} or more are needed: hold loads for "
            "longer, or lower --settle"
        )
    node, pressures_pa, volts, line = map(np.concatenate, zip(*found, strict=True))
    return LoadPoints(node, pressures_pa, volts, line, reference.path.name)


def steady_voltage(voltage_v: Floats32, lsb_v: float) -> Floats:
    """Return the voltages of steady nodes: (f, n) frames → (n,) V, NaN for a node not heard.

    The mean of what lies near the median: outliers do not count, and where noise makes the code
    flicker the mean is finer than one count.
    """
    heard = np.isfinite(voltage_v)
    result = np.full(voltage_v.shape[1], np.nan)
    known = heard.any(axis=0)
    values = voltage_v[:, known].astype(np.float64)
    centre = np.nanmedian(values, axis=0)
    off = np.abs(values - centre)
    near = off <= np.maximum(2 * lsb_v, 3 * np.nanmedian(off, axis=0))  # False for NaN
    result[known] = np.where(near, values, 0.0).sum(axis=0) / near.sum(axis=0)
    return result


def find_offset(reference: Reference, recording: Recording, curve: PressureCurve) -> ClockOffset:
    """Find the offset of the two clocks: where reference and mean pressure correlate best.

    curve: roughly that of the sensors, rising or falling: on a wrong scale, a part of the loads
    could match another part better than itself. All offsets of one raster are tried.
    Raises CalibrationError where they match nowhere, or in several places.
    """
    longest_s = max(float(t_s[-1] - t_s[0]) for t_s in (reference.t_s, recording.t_s))
    raster_s = max(_RASTER_S, longest_s / _MOST_RASTER)
    load = _on_raster(reference.t_s, reference.pressure_pa, raster_s)
    for rises in (curve.rises, not curve.rises):  # as the parameters say, or else the other way
        felt_pa = _mean_pressure(recording.voltage_v, curve, rises)
        lags, match, score, whole = _match(load, _on_raster(recording.t_s, felt_pa, raster_s))
        best = int(np.argmax(score))
        if match[best] >= MATCH:
            break
    offset_s = float(recording.t_s[0] - reference.t_s[0] + lags[best] * raster_s)
    if match[best] < MATCH:
        raise reference.refusal(
            f"these loads are nowhere in the capture (best match {match[best]:.2f}, at an offset "
            f"of {offset_s:.2f} s): is it the right one? If so, give --offset"
        )
    below = np.flatnonzero(score < score[best] - 0.1)  # where the hill about its top ends
    edges, place = [-1, *below.tolist(), len(score)], int(np.searchsorted(below, best))
    first, last = edges[place] + 1, edges[place + 1] - 1
    rivals = np.delete(score, np.arange(first, last + 1))
    apart = np.abs(lags - lags[best]) * raster_s > APART_S
    # One part of a staircase looks much like another.
    in_part = whole[best] < WHOLE and (match[apart] > match[best]).any()
    if in_part or rivals.max(initial=0.0) > score[best] - RIVAL:
        raise reference.refusal(
            "these loads fit the capture in several places: one of the two is a part only, or they "
            "repeat themselves; give --offset"
        )
    # As far as a tenth more than what the best offset leaves unexplained, and one raster step.
    enough = match[best] - 0.1 * (1 - match[best]) - 1e-4
    width = np.count_nonzero(match[first : last + 1] >= enough)
    return ClockOffset(offset_s, 0.5 * width * raster_s, float(match[best]))


def _plateaus(reference: Reference) -> list[tuple[int, int]]:
    """Find the first and last reading of every stretch in which a node's load stands still."""
    t_s, most_pa = reference.t_s, 2 * STEADY * float(reference.pressure_pa.max())
    node = np.zeros_like(reference.line) if reference.node is None else reference.node
    found, first = [], 0
    low = high = reference.pressure_pa[0]
    for i, pressure_pa in enumerate(np.append(reference.pressure_pa, np.inf).tolist()):
        low, high = min(low, pressure_pa), max(high, pressure_pa)
        if high - low > most_pa or node[i] != node[first]:
            if t_s[i - 1] > t_s[first]:
                found.append((first, i - 1))
            first, low, high = i, pressure_pa, pressure_pa
    return found


def _mean_pressure(voltage_v: Floats32, curve: PressureCurve, rises: bool) -> Floats:
    """Estimate the mean pressure of the nodes heard, (f,) Pa, roughly.

    Every node's highest voltage, or lowest where they rise, counts as unloaded, and the curve's
    last piece is extrapolated, so that one that is somewhat wrong still tells heavy loads apart.
    """
    voltage_v = voltage_v[:, np.isfinite(voltage_v).any(axis=0)]
    heard = np.isfinite(voltage_v)
    rest_v = (np.nanmin if rises else np.nanmax)(voltage_v, axis=0)
    fall_v = np.where(heard, np.abs(voltage_v - rest_v), 0.0)
    falls_v = np.abs(curve.voltage_v[0] - np.array(curve.voltage_v))
    last_gain = (curve.pressure_pa[-1] - curve.pressure_pa[-2]) / (falls_v[-1] - falls_v[-2])
    beyond_pa = np.maximum(fall_v - falls_v[-1], 0.0) * last_gain
    felt_pa = np.interp(fall_v, falls_v, curve.pressure_pa) + beyond_pa
    return np.asarray(felt_pa.sum(axis=1) / np.maximum(heard.sum(axis=1), 1))


def _on_raster(t_s: Floats, values: Floats, raster_s: float) -> Floats:
    count = max(2, math.ceil((t_s[-1] - t_s[0]) / raster_s))
    return np.asarray(np.interp(t_s[0] + raster_s * np.arange(count), t_s, values))


def _match(load: Floats, felt: Floats) -> tuple[Int64s, Floats, Floats, Floats]:
    """Tell how well load[i] and felt[i + lag], both in Pa, match for every lag.

    Returns the lags; the correlation of what overlaps; this as a score, reduced where much of what
    changes lies outside the overlap; and the share of both that lies within.
    """
    size = 1 << (len(load) + len(felt) - 1).bit_length()
    load, felt = load - load.mean(), felt - felt.mean()

    def slide(a: Floats, b: Floats) -> Floats:
        product = np.fft.irfft(np.conj(np.fft.rfft(a, size)) * np.fft.rfft(b, size), size)
        return np.concatenate((product[size - len(a) + 1 :], product[: len(b)]))

    ones_load, ones_felt = np.ones(len(load)), np.ones(len(felt))
    count = np.maximum(slide(ones_load, ones_felt).round(), 1)
    sum_load, sum_felt = slide(load, ones_felt), slide(ones_load, felt)
    covariance = slide(load, felt) - sum_load * sum_felt / count
    of_load = slide(load**2, ones_felt) - sum_load**2 / count
    of_felt = slide(ones_load, felt**2) - sum_felt**2 / count
    share_load = of_load / max(np.square(load).sum(), 1.0)  # of 0 Pa² where nothing changes
    share_felt = of_felt / max(np.square(felt).sum(), 1.0)
    enough = (share_load > _LEAST_SHARE) & (share_felt > _LEAST_SHARE)
    enough &= count >= _OVERLAP * min(len(load), len(felt))
    match = np.zeros(len(count))
    match[enough] = covariance[enough] / np.sqrt(of_load[enough] * of_felt[enough])
    score = match * np.sqrt(np.clip(np.maximum(share_load, share_felt), 0.0, 1.0))
    return np.arange(1 - len(load), len(felt)), match, score, np.minimum(share_load, share_felt)
