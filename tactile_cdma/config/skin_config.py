# SPDX-License-Identifier: Apache-2.0

"""The configuration of one skin: its parameters as the decoding chain's types, with files read."""

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

from ..base.errors import SpecError
from ..base.named_file import expanded
from ..code.frame import MAX_STRETCH, MEASURING_S, FrameSpec
from ..code.sparse import ORDERS
from ..framing.load import capacity, groups_for_all, told_apart
from ..places.layout import Layout
from ..places.layout_file import read_layout
from ..places.layout_nodes import Wiring
from ..places.layout_shapes import is_same, pitch_of, shown_mm
from ..readings.baseline import RestRules
from ..readings.calibration import AdcScale, Calibration, PressureCurve
from ..readings.calibration_file import read_calibration
from ..readings.contact import ContactThresholds
from ..wire._protocol import (
    SYNC_DIGIT,
    SYNC_LEAD,
    SYNC_UNIT_US,
    TAIL_CHIPS,
    TURN_ASKED,
    TURN_MOST_LOG2,
)
from ..wire.identity import is_source, parse_id, shown_id
from .frame_rate import HEARS_DATA_NS, chosen, slow_warning
from .parameters import BY_NAME, DATA, DEFAULTS, GAP, NATURAL_SIGNS, Values, check_values

_log = logging.getLogger(__name__)

FRAME_PARAMETERS = (
    *("nodes", "bits", "parity", "order", "first_row", "resync_chips", "guard_chips"),
    *("drive", "polarity", "scramble", "codes"),
)
"""Parameters that are fields of FrameSpec as they are."""
_AS_THEY_ARE = (
    *("timing", "sync", "sync_wire", "samples_per_chip", "node_kind", "nodes_repeat", "skin"),
)
"""Parameters that are fields of SkinConfig as they are."""
_LIVE_AS_THEY_ARE = "dead_share", "publish_sigma", "active_share", "stale_after_s"
"""Parameters that are fields of SkinConfig as they are, too, and count at once."""
PULSES_S = (SYNC_LEAD + TURN_ASKED.bit_length() * SYNC_DIGIT) * SYNC_UNIT_US * 1e-6
"""From a frame's earliest pulse, which asks, to the frame, s."""
CURVE_PARAMETERS = {
    *("v0_v", "knee_kpa", "range_kpa", "sensitivity1_v_per_kpa", "sensitivity2_v_per_kpa"),
    "calibration_file",
}
"""Parameters of the curves from voltage to pressure."""


@dataclass(frozen=True, slots=True)
class SkinConfig:
    """The configuration of the decoding chain, in the types that its stages take.

    choice: what was chosen for rate_hz, in a sentence; empty without one.
    """

    spec: FrameSpec
    digitizer_id: bytes | None
    timing: str
    sync: str
    sync_wire: str
    samples_per_chip: int
    node_kind: str
    nodes_repeat: bool
    adc: AdcScale
    curve: PressureCurve
    calibration: Calibration
    layout: Layout
    skin: str
    rest: RestRules
    active_share: float
    stale_after_s: float
    masked: tuple[int, ...]
    dead_share: float
    publish_sigma: bool
    contact: ContactThresholds
    choice: str

    @classmethod
    def of(cls, values: Values) -> Self:
        """Make a configuration of parameter values; missing ones take their defaults.

        Raises ParameterError for a single wrong value, SpecError for an impossible combination,
        LayoutError and CalibrationError for files that cannot be used.
        """
        get: Values = {**DEFAULTS, **check_values(values)}
        choice = ""
        if get["rate_hz"] and not is_source(get["port"]):
            free = _shape({**get, "resync_chips": 0, "guard_chips": 0})
            values, choice = chosen(free, get)
            get = {**get, **values}
        spec = _spec(get)
        if not get["rate_hz"] and (warning := slow_warning(spec)):
            _log.warning(warning)
        for is_so, reason in _contradictions(spec, get):
            if is_so:
                raise SpecError(reason)
        if spec.sparse and not groups_for_all(spec):
            most = told_apart(ORDERS[1]) << TURN_MOST_LOG2
            more = f"set order to more than {spec.order}"
            _log.warning(
                "if all %d nodes speak at once, their codes cannot be told apart, even in %d "
                "groups that take turns, and all is in doubt; a frame holds %d speakers: %s",
                *(spec.nodes, 1 << TURN_MOST_LOG2, capacity(spec)),
                more if spec.nodes <= most else f"no order is enough for more than {most} nodes",
            )
        if fills_period(spec, get["samples_per_chip"]):
            _log.warning(
                "a frame of %g ms fills its period of %g ms, and is decoded one period late, as "
                "only the samples after it show its end: set frame_period_ms to %g or more",
                spec.frame_s * 1e3,
                spec.frame_period_s * 1e3,
                spec.roomy_period_ms,
            )
        adc = AdcScale(get["bits"], get["vref_v"])
        return cls(
            spec=spec,
            digitizer_id=parse_id(get["digitizer_id"]) if get["digitizer_id"] else None,
            adc=adc,
            **_curves(get, spec, adc),
            layout=_layout(get),
            choice=choice,
            **{name: get[name] for name in _AS_THEY_ARE},
            **_live(get),
        )

    def refusal(self, digitizer_id: bytes) -> str | None:
        """Tell why a digitizer with this id is refused; None if it is accepted."""
        if self.digitizer_id is None or digitizer_id == self.digitizer_id:
            return None
        return (
            f"wrong digitizer: {shown_id(digitizer_id)} is on this port, digitizer_id is "
            f"{shown_id(self.digitizer_id)}; tactile-cdma ports lists which board is on which port"
        )

    def recalibrated(self, values: Values) -> Self:
        """Adopt CURVE_PARAMETERS among the values of all parameters; the file is read again.

        Raises SpecError for an impossible curve, CalibrationError for a file that cannot be used.
        """
        return replace(self, **_curves(values, self.spec, self.adc))

    def adjusted(self, values: Values) -> Self:
        """Adopt the live parameters among the values of all parameters; no file is read again."""
        return replace(self, **_live(values))


def _shape(get: Values) -> FrameSpec:
    """Make the frame, without a period."""
    return FrameSpec(
        chip_s=get["chip_us"] * 1e-6,
        frame_period_s=math.inf,
        sign_seed=None if get["sign_seed"] == NATURAL_SIGNS else get["sign_seed"],
        amplitude_v=get["amplitude_mv"] * 1e-3 or None,
        **{name: get[name] for name in FRAME_PARAMETERS},
    )


def _spec(get: Values) -> FrameSpec:
    """Make the frame; a period of 0, or the default one if too short, becomes the shortest."""
    spec = _shape(get)
    if is_source(get["port"]):
        return chips_that_fit(spec, (get["frame_period_ms"] or DEFAULTS["frame_period_ms"]) * 1e-3)
    longest_s = spec.frame_s * (1 + MAX_STRETCH if get["timing"] == GAP else 1)
    period_s = get["frame_period_ms"] * 1e-3
    left_open = get["frame_period_ms"] in (0.0, DEFAULTS["frame_period_ms"])
    if left_open and period_s < longest_s:
        pause_s = MEASURING_S
        if get["sync_wire"] == DATA:
            pause_s = max(pause_s, _tail_s(spec, get["samples_per_chip"]) + PULSES_S)
        period_s = math.ceil((longest_s + pause_s) * 1e4 - 1e-6) / 1e4
        _log.info("a frame lasts %g ms; its period is %g ms", spec.frame_s * 1e3, period_s * 1e3)
    return replace(spec, frame_period_s=period_s)


def chips_that_fit(spec: FrameSpec, period_s: float) -> FrameSpec:
    """Return a frame of this period whose chips fill half of it: a source's, which sends none."""
    period_us = max(1, round(period_s * 1e6))
    chip_ns = max(10, 500 * period_us // spec.span_chips)  # 10 ns: the shortest that there is
    return replace(spec, chip_s=chip_ns / 1e9, frame_period_s=period_us / 1e6)


def fills_period(spec: FrameSpec, samples_per_chip: int) -> bool:
    """Tell whether a period ends before the samples that show that its frame is over."""
    return spec.frame_period_s < spec.frame_s + _tail_s(spec, samples_per_chip)


def _tail_s(spec: FrameSpec, samples_per_chip: int) -> float:
    """Return how long samples go on after a frame, s."""
    return TAIL_CHIPS * spec.chip_s if samples_per_chip > 1 else 0.0


def contact_thresholds(values: Values) -> ContactThresholds:
    """Make the thresholds of all parameters; raises SpecError where they contradict each other."""
    return ContactThresholds(values["contact_kpa"] * 1e3, values["release_kpa"] * 1e3)


def _live(values: Values) -> dict[str, Any]:
    """Return the fields of live parameters only; raises SpecError as contact_thresholds."""
    contact = contact_thresholds(values)
    masked = BY_NAME["masked"].numbers_of(values["masked"])
    if masked and masked[-1] > values["nodes"]:
        raise SpecError(f"masked has node {masked[-1]}, but the skin has {values['nodes']} nodes")
    return {
        "masked": tuple(masked),
        "rest": RestRules(values["drift_pa_per_min"], contact.contact_pa, contact.release_pa),
        "contact": contact,
        **{name: values[name] for name in _LIVE_AS_THEY_ARE},
    }


def _curves(get: Values, spec: FrameSpec, adc: AdcScale) -> dict[str, Any]:
    """Return the fields of curves: the two-stage one, which all have without calibration_file."""
    curve = PressureCurve.two_stage(
        v0_v=get["v0_v"],
        knee_pa=get["knee_kpa"] * 1e3,
        range_pa=get["range_kpa"] * 1e3,
        stage1_v_per_pa=get["sensitivity1_v_per_kpa"] * 1e-3,
        stage2_v_per_pa=get["sensitivity2_v_per_kpa"] * 1e-3,
        vref_v=get["vref_v"],
    )
    calibration = Calibration.default(curve, spec.nodes)
    if get["calibration_file"]:
        path = user_path("calibration_file", get["calibration_file"])
        calibration = read_calibration(path, spec.nodes, adc, curve, get["skin"])
    return {"curve": curve, "calibration": calibration}


def _layout(get: Values) -> Layout:
    """Read the layout in layout_file; without one return a flat grid."""
    if not get["layout_file"]:
        size = get["rows"], get["columns"], pitch_of(get["pitch_mm"])
        return Layout.grid(get["nodes"], *size, get["taxel_mm"] * 1e-3)
    path = user_path("layout_file", get["layout_file"])
    layout = read_layout(path, Wiring(get["nodes"], get["first_row"], get["skin"]))
    # ROS gives every parameter a value, so only one that differs from its default was set.
    for name, theirs in layout.said().items():
        if get[name] != DEFAULTS[name] and not is_same(get[name], theirs):
            raise SpecError(
                f"{name} is {shown_mm(get[name])}, but {shown_mm(theirs)} in layout_file {path}: "
                f"leave {name} at its default, {DEFAULTS[name]:g}, and the file decides"
            )
    return layout


def user_path(name: str, text: str) -> Path:
    """Make a path of a parameter: relative to the working folder or, with ~, the home folder."""
    try:
        return expanded(text)
    except ValueError as error:
        raise SpecError(f"{name} is {text}: {error}") from None


def _contradictions(spec: FrameSpec, get: Values) -> Iterator[tuple[bool, str]]:
    """Yield combinations that cannot work: whether it is this one, and what to say of it."""
    gap = get["timing"] == GAP
    samples_per_chip = get["samples_per_chip"]
    samples = f"samples_per_chip is {samples_per_chip}, it must be"
    line = "timing is 'gap', it must be 'line'"
    if spec.sparse:
        reason = "sparse codes are told apart by whole chips of marked frames"
        yield gap, f"{reason}: {line}"
        yield samples_per_chip != 1, f"{reason}: {samples} 1"
        yield (
            spec.amplitude_v is None,
            "sparse codes are told apart by how loud a node is: set amplitude_mv to what nodes "
            "have",
        )
    if get["sync_wire"] == DATA:
        yield from _of_one_wire(spec, gap, samples_per_chip)
    if gap:
        yield (
            spec.resync_chips > 0,
            f"resync_chips is {spec.resync_chips}: nodes that restart within a frame need a sync "
            "line, use timing 'line'",
        )
        reason = "timing 'gap' finds the chips in raw samples"
        yield samples_per_chip < 3, f"{reason}: {samples} 3 or more"
        longest_s = (1 + MAX_STRETCH) * spec.frame_s
        yield (
            longest_s >= spec.frame_period_s,
            f"timing 'gap' needs a silence between frames: a frame stretched by {MAX_STRETCH:.0%} "
            f"lasts {longest_s * 1e3:g} ms, its period is {spec.frame_period_s * 1e3:g} ms",
        )


def _of_one_wire(spec: FrameSpec, gap: bool, samples_per_chip: int) -> Iterator[tuple[bool, str]]:
    """Yield what sync pulses on the data wire do not go with, as _contradictions does."""
    yield (
        gap,
        "sync_wire is 'data', but timing 'gap' wants quiet gaps, in which the digitizer then pulls "
        "the line low: set timing to 'line' or sync_wire to 'own'",
    )
    chip_us, least_us = spec.chip_s * 1e6, HEARS_DATA_NS / 1e3
    yield (
        chip_us < least_us * (1 - 1e-9),
        f"sync_wire is 'data' and chip_us {chip_us:g}; it must be {least_us:g} or more, as nodes "
        "with shorter chips hear sync pulses only on a wire of their own: set sync_wire to 'own'",
    )
    least_s = spec.frame_s + _tail_s(spec, samples_per_chip) + PULSES_S
    yield (
        spec.frame_period_s < least_s,
        f"sync_wire is 'data' and frame_period_ms {spec.frame_period_s * 1e3:g}; it must be "
        f"{math.ceil(least_s * 1e4) / 10:g} or more, as pulses of a frame begin up to "
        f"{PULSES_S * 1e3:g} ms before it, on the wire on which the last one ends",
    )
