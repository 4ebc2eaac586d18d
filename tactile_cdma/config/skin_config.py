# SPDX-License-Identifier: Apache-2.0

"""The parameters of one skin in the form that the decoding chain takes, files read."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

from ..base.errors import SpecError
from ..base.named_file import expanded
from ..code.frame import MAX_STRETCH, FrameSpec
from ..places.layout import Layout
from ..places.layout_file import read_layout
from ..places.layout_nodes import Wiring
from ..readings.baseline import RestRules
from ..readings.calibration import AdcScale, Calibration, PressureCurve
from ..readings.calibration_file import read_calibration
from ..readings.contact import ContactThresholds
from ..readings.dynamics import Compensator
from ..wire.identity import parse_id, shown_id
from .parameters import BY_NAME, GAP, NATURAL_SIGNS, PARAMETERS, Values, check_values


@dataclass(frozen=True, slots=True)
class SkinConfig:
    """The parameters of the decoding chain in the form that the stages take."""

    spec: FrameSpec
    digitizer_id: bytes | None
    timing: str
    samples_per_chip: int
    roll_call: bool
    adc: AdcScale
    curve: PressureCurve
    calibration: Calibration
    compensation: bool
    layout: Layout
    skin: str
    rest: RestRules
    threshold: float
    stale_after_s: float
    contact: ContactThresholds

    @classmethod
    def of(cls, values: Values) -> SkinConfig:
        """From parameter values; missing ones take their defaults.

        Raises ParameterError for a single bad value, SpecError for an impossible combination,
        CalibrationError for a calibration file that cannot be used.
        """
        checked = check_values(values)
        get: Values = {p.name: checked.get(p.name, p.default) for p in PARAMETERS}
        spec = FrameSpec(
            nodes=get["nodes"],
            bits=get["bits"],
            order=get["order"],
            chip_s=get["chip_us"] * 1e-6,
            frame_period_s=get["frame_period_ms"] * 1e-3,
            first_row=get["first_row"],
            sign_seed=None if get["sign_seed"] == NATURAL_SIGNS else get["sign_seed"],
            drive=get["drive"],
            polarity=get["polarity"],
            amplitude_v=get["amplitude_mv"] * 1e-3 or None,
            parity=get["parity"],
            resync_chips=get["resync_chips"],
            guard_chips=get["guard_chips"],
        )
        if get["timing"] == GAP:
            _check_gap(spec, get["samples_per_chip"])
        if get["roll_call"]:
            _check_roll_call(spec, get["timing"], get["samples_per_chip"])
        curve = PressureCurve.two_stage(
            v0_v=get["v0_v"],
            knee_pa=get["knee_kpa"] * 1e3,
            range_pa=get["range_kpa"] * 1e3,
            stage1_v_per_pa=get["sensitivity1_v_per_kpa"] * 1e-3,
            stage2_v_per_pa=get["sensitivity2_v_per_kpa"] * 1e-3,
        )
        adc = AdcScale(get["bits"], get["vref_v"])
        return cls(
            spec=spec,
            digitizer_id=parse_id(get["digitizer_id"]) if get["digitizer_id"] else None,
            timing=get["timing"],
            samples_per_chip=get["samples_per_chip"],
            roll_call=get["roll_call"],
            adc=adc,
            curve=curve,
            calibration=_calibration(get, spec, adc, curve),
            compensation=get["compensation"],
            layout=_layout(get),
            skin=get["skin"],
            rest=rest_rules(get),
            threshold=get["threshold"],
            stale_after_s=get["stale_after_s"],
            contact=contact_thresholds(get),
        )

    def refusal(self, digitizer_id: bytes) -> str | None:
        """Why the digitizer of this id is not taken; None if it is the one asked for."""
        if self.digitizer_id is None or digitizer_id == self.digitizer_id:
            return None
        return (
            f"wrong digitizer: {shown_id(digitizer_id)} is on this port, digitizer_id is "
            f"{shown_id(self.digitizer_id)}; tactile-cdma ports tells which is where"
        )

    def compensator(self) -> Compensator | None:
        """What undoes the sensors' dynamics; None where that is not asked."""
        dynamics = self.calibration.dynamics
        if not self.compensation or dynamics is None:
            return None
        return Compensator(dynamics, self.calibration.curves.range_pa)

    def recalibrated(self, values: Values) -> SkinConfig:
        """With calibration_file, of all parameters' values, read anew, and compensation as there.

        Raises CalibrationError for a file that cannot be used, SpecError where it does not hold
        what compensation takes.
        """
        return replace(
            self,
            calibration=_calibration(values, self.spec, self.adc, self.curve),
            compensation=values["compensation"],
        )

    def adjusted(self, values: Values) -> SkinConfig:
        """With the live ones of these values, all of them; files are not read again."""
        return replace(
            self,
            rest=rest_rules(values),
            contact=contact_thresholds(values),
            threshold=values["threshold"],
            stale_after_s=values["stale_after_s"],
        )


def contact_thresholds(values: Values) -> ContactThresholds:
    """From all parameters' values; raises SpecError where they contradict each other."""
    return ContactThresholds(values["contact_kpa"] * 1e3, values["release_kpa"] * 1e3)


def rest_rules(values: Values) -> RestRules:
    """From all parameters' values."""
    return RestRules(
        drift_pa_per_min=values["drift_pa_per_min"],
        contact_pa=values["contact_kpa"] * 1e3,
        release_pa=values["release_kpa"] * 1e3,
    )


def _layout(get: Values) -> Layout:
    """The layout file's; without one a flat grid."""
    pitch_m = get["pitch_mm"] * 1e-3
    if not get["layout_file"]:
        taxel_m = get["taxel_mm"] * 1e-3
        return Layout.grid(get["nodes"], get["rows"], get["columns"], pitch_m, taxel_m)
    path = user_path("layout_file", get["layout_file"])
    layout = read_layout(path, Wiring(get["nodes"], get["first_row"], get["skin"]))
    # Defaults say nothing: ROS gives every parameter a value.
    for name, theirs in (
        ("rows", layout.rows),
        ("columns", layout.columns),
        ("pitch_mm", layout.pitch_m * 1e3),
    ):
        if get[name] != BY_NAME[name].default and not math.isclose(get[name], theirs, rel_tol=1e-3):
            raise SpecError(
                f"{name} is {get[name]:g}, but {theirs:g} in layout_file {path}: leave "
                f"{name} at {BY_NAME[name].default:g}, the file says it"
            )
    return layout


def _calibration(get: Values, spec: FrameSpec, adc: AdcScale, curve: PressureCurve) -> Calibration:
    """From a file; without one the default."""
    calibration, file = Calibration.default(curve, spec.nodes), get["calibration_file"]
    if file:
        path = user_path("calibration_file", file)
        calibration = read_calibration(path, spec.nodes, adc, curve, get["skin"])
    if get["compensation"] and calibration.dynamics is None:
        raise SpecError(
            f"no dynamics in {file or 'the default curve'}, which compensation undoes: run "
            "tactile-cdma calibrate --dynamics, or set compensation to false"
        )
    return calibration


def user_path(name: str, text: str) -> Path:
    """A parameter's path, from the working folder or the home folder (~) on."""
    try:
        return expanded(text)
    except ValueError as error:
        raise SpecError(f"{name} is {text}: {error}") from None


def _check_roll_call(spec: FrameSpec, timing: str, samples_per_chip: int) -> None:
    for fault, remedy in (
        (timing == GAP, "timing is 'gap', it must be 'line'"),
        (samples_per_chip < 2, f"samples_per_chip is {samples_per_chip}, it must be 2 or more"),
        (
            spec.resync_chips > 0,
            f"resync_chips is {spec.resync_chips}, it must be 0 (restarts make up for the clocks)",
        ),
    ):
        if fault:
            raise SpecError(f"roll_call measures clocks by raw samples of marked frames: {remedy}")


def _check_gap(spec: FrameSpec, samples_per_chip: int) -> None:
    if spec.resync_chips:
        raise SpecError(
            f"resync_chips is {spec.resync_chips}: nodes that start anew within a frame take a "
            "sync line, use timing 'line'"
        )
    if samples_per_chip < 3:
        raise SpecError(
            f"timing 'gap' needs raw samples to find the chips in: samples_per_chip is "
            f"{samples_per_chip}, it must be 3 or more"
        )
    longest_s = (1 + MAX_STRETCH) * spec.frame_s
    if longest_s >= spec.frame_period_s:
        raise SpecError(
            f"timing 'gap' needs a silence between frames: a frame stretched by "
            f"{MAX_STRETCH:.0%} lasts {longest_s * 1e3:g} ms, its period is "
            f"{spec.frame_period_s * 1e3:g} ms"
        )
