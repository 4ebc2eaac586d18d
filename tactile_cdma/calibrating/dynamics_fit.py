# SPDX-License-Identifier: Apache-2.0

"""Dynamics from a reference recorded beside loading cycles, and the report on them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..base.arrays import Bools
from ..base.errors import CalibrationError
from ..readings.calibration import Calibration
from .identify import Identified, identify
from .plateaus import Recording, Reference
from .report import picture

LEAST_COMMON_S = 5.0
"""Overlap of reference and capture, s; chosen: three cycles of one to two seconds."""
MOST_GAP_S = 0.1
"""Between readings of the reference, s; chosen: interpolated straight, a cycle of a second or two
keeps its shape."""


def find_dynamics(
    calibration: Calibration,
    reference: Reference,
    recording: Recording,
    offset_s: float,
    uncertain_s: float = 0.0,
) -> Identified:
    """Identify the dynamics of sensors whose curves are known from loading cycles.

    offset_s: recording's time minus the reference's, s. uncertain_s: bound of its error, s. Frames
    outside the time of the reference are left out.
    Raises CalibrationError, with the reason, where the record cannot tell.
    """
    t_s = reference.t_s + offset_s
    within = (recording.t_s >= t_s[0]) & (recording.t_s <= t_s[-1])
    _check(reference, recording, within)
    rows = recording.voltage_v[within]
    pressure_pa = np.array([calibration.curves.pressure(row) for row in rows])
    pressure_pa[~np.isfinite(rows) | calibration.uncalibrated] = np.nan
    frames_s = recording.t_s[within]
    reference_pa = np.interp(frames_s, t_s, reference.pressure_pa)
    try:
        return identify(frames_s, reference_pa, pressure_pa, uncertain_s)
    except CalibrationError as error:
        raise reference.refusal(str(error)) from None


def _check(reference: Reference, recording: Recording, within: Bools) -> None:
    if reference.node is not None:
        raise reference.refusal(
            "there is a column node, but dynamics are those of all nodes: load all alike and leave "
            "the column out"
        )
    common_s = np.ptp(recording.t_s[within]) if within.any() else 0.0
    if common_s < LEAST_COMMON_S:
        raise reference.refusal(
            f"{common_s:.1f} s of it lie within the capture, {LEAST_COMMON_S:g} s or more are "
            "needed: do they belong together, and is --offset right?"
        )
    gap = int(np.argmax(np.diff(reference.t_s)))
    gap_s = float(reference.t_s[gap + 1] - reference.t_s[gap])
    if gap_s > MOST_GAP_S:
        raise reference.refusal(
            f"{gap_s:.2g} s from the reading before; dynamics take {1 / MOST_GAP_S:.0f} readings "
            "per second or more",
            gap + 1,
        )


def describe(found: Identified) -> str:
    """The report for people."""
    dynamics = found.dynamics
    opened = np.expm1(np.dot(dynamics.widths, dynamics.weights))
    return (
        f"dynamics from {found.cycles} loading cycles, which move the offset of the clocks by "
        f"{-found.late_s * 1e3:+.0f} ms\n"
        f"lag: rising {dynamics.rise_s * 1e3:.0f} ms, falling {dynamics.fall_s * 1e3:.0f} ms\n"
        f"hysteresis: falling loads read up to {opened:.1%} more than rising ones\n"
        f"error on the last third, which was not fitted: {found.before_pa:.0f} Pa rms without, "
        f"{found.after_pa:.0f} Pa with compensation ({found.removed:.0%} removed)\n"
        f"noise grows up to {dynamics.noise_gain:.1f} times while a pressure rises"
    )


def results(found: Identified) -> dict[str, str]:
    """The report's numbers, for programs."""
    return {
        "rise_ms": f"{found.dynamics.rise_s * 1e3:.1f}",
        "fall_ms": f"{found.dynamics.fall_s * 1e3:.1f}",
        "hysteresis_removed": f"{found.removed:.3f}",
        "rms_before_pa": f"{found.before_pa:.1f}",
        "rms_after_pa": f"{found.after_pa:.1f}",
    }


def draw(found: Identified, path: Path) -> None:
    """The part that was not fitted, over time and over the known pressure, as a PNG."""
    known_kpa = found.reference_pa / 1e3
    with picture(path, (2, 1)) as (time_axes, loop_axes):
        time_axes.plot(found.t_s, known_kpa, "k", lw=2, label="reference")
        for pressure_pa, colour, name in (
            (found.static_pa, "C1", "curves alone"),
            (found.compensated_pa, "C0", "with compensation"),
        ):
            middle_kpa = np.nanmedian(pressure_pa, axis=1) / 1e3
            time_axes.plot(found.t_s, middle_kpa, colour, lw=1, label=name)
            loop_axes.plot(known_kpa, middle_kpa - known_kpa, colour, lw=0.8)
        time_axes.set(
            xlabel="time of the capture / s", ylabel="pressure / kPa", title="median of the nodes"
        )
        time_axes.legend()
        loop_axes.set(xlabel="reference / kPa", ylabel="off by / kPa", title="loops")
