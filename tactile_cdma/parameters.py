"""Every user-visible parameter, once: name, default, limits, unit, meaning.

The ROS node declares its parameters from this table, the command line takes its defaults from it,
and the parameter file is read against it.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from .baseline import RestRules
from .calibration import AdcScale, Calibration, PressureCurve
from .calibration_file import read_calibration
from .contact import ContactThresholds
from .dynamics import Compensator
from .errors import ParameterError, SpecError
from .frame import BIPOLAR, DEFAULT_AMPLITUDE_V, MAX_STRETCH, UNIPOLAR, FrameSpec
from .layout import Layout
from .layout_file import read_layout
from .layout_nodes import Wiring

Value = bool | int | float | str
NATURAL_SIGNS = -1
LINE, GAP = "line", "gap"
STANDARD_PARAMETERS = ("use_sim_time", "start_type_description_service", "qos_overrides.")
"""Beginnings of the names of parameters that every ROS 2 node has."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter. limits are inclusive; live parameters may change while the node is active."""

    name: str
    default: Value
    text: str
    unit: str = ""
    limits: tuple[float, float] | None = None
    choices: tuple[Value, ...] = ()
    live: bool = False

    def check(self, value: object) -> Value:
        """The value in this parameter's type.

        Raises ParameterError, naming the value, the limit and the unit.
        """
        kind = type(self.default)
        if kind is float and type(value) is int:
            value = float(value)
        if type(value) is not kind:
            raise ParameterError(
                f"{self.name} must be {_KIND_NAMES[kind]}, got {value!r} ({type(value).__name__})"
            )
        assert isinstance(value, bool | int | float | str)
        if self.choices and value not in self.choices:
            raise ParameterError(
                f"{self.name} is {value!r}; it must be one of "
                + ", ".join(str(choice) for choice in self.choices)
            )
        if self.limits and not isinstance(value, str | bool):
            low, high = self.limits
            if not (math.isfinite(value) and low <= value <= high):
                unit = f" {self.unit}" if self.unit else ""
                raise ParameterError(
                    f"{self.name} is {value:g}{unit}; it must lie within {low:g}…{high:g}{unit}"
                )
        return value


_KIND_NAMES = {bool: "true or false", int: "an integer", float: "a number", str: "a text"}

PARAMETERS: tuple[Parameter, ...] = (
    Parameter(
        "port", "sim://", "pyserial URL of the digitizer: /dev/ttyACM0, sim://?scene=hand, …"
    ),
    Parameter("baud", 2_000_000, "baud rate; USB ports ignore it", "baud", (1_200, 20_000_000)),
    Parameter("nodes", 16, "sensing nodes on the wire", "", (1, 65_535)),
    Parameter("bits", 10, "word length of a node's ADC", "bit", (8, 16)),
    Parameter("parity", False, "every word is followed by a bit that makes its ones even"),
    Parameter("chip_us", 50.0, "pulse length: duration of one chip", "µs", (0.01, 1e6)),
    Parameter("frame_period_ms", 12.8, "from one frame's start to the next", "ms", (0.01, 1e5)),
    Parameter(
        "order",
        0,
        "code order (chips per bit); 0: the smallest that fits, or a bit more if that is faster",
        "",
        (0, 65_536),
    ),
    Parameter("first_row", 1, "code row of node 1; the paper uses 0", "", (0, 65_535)),
    Parameter(
        "sign_seed",
        1,
        "seed of the row signs; -1: natural signs, as in the paper",
        "",
        (-1, 2**32 - 1),
    ),
    Parameter(
        "resync_chips",
        0,
        "nodes start anew at a sync edge every so many chips; 0: at the frame's start only",
        "",
        (0, 65_535),
    ),
    Parameter("guard_chips", 0, "pause before each such restart, in chips", "", (0, 255)),
    Parameter("drive", BIPOLAR, "a node's chip is ±A or 0/A", choices=(BIPOLAR, UNIPOLAR)),
    Parameter("polarity", 1, "-1 where the amplifier inverts", choices=(1, -1)),
    Parameter(
        "amplitude_mv",
        DEFAULT_AMPLITUDE_V * 1e3,
        "level A of one node on the digitized line; 0: learnt from every frame",
        "mV",
        (0.0, 1e5),
    ),
    Parameter(
        "timing",
        LINE,
        "frame starts: marked by the digitizer, or found in the waveform",
        choices=(LINE, GAP),
    ),
    Parameter(
        "samples_per_chip", 4, "asked of the digitizer; 1: it sends one mean per chip", "", (1, 256)
    ),
    Parameter(
        "roll_call",
        False,
        "nodes have clocks of their own: measure these at the start, one node after the other",
    ),
    Parameter(
        "vref_v", 3.3, "reference of the nodes' ADC: V = code·vref/2^bits", "V", (0.1, 100.0)
    ),
    Parameter("v0_v", 3.3, "sensor voltage without pressure", "V", (0.01, 100.0)),
    Parameter("knee_kpa", 50.0, "end of the sensor's first stage", "kPa", (0.001, 1e5)),
    Parameter("range_kpa", 140.0, "end of the sensor's second stage", "kPa", (0.001, 1e5)),
    Parameter(
        "sensitivity1_v_per_kpa", 0.033, "fall of voltage, first stage", "V/kPa", (1e-6, 100.0)
    ),
    Parameter(
        "sensitivity2_v_per_kpa", 0.0059, "fall of voltage, second stage", "V/kPa", (1e-6, 100.0)
    ),
    Parameter(
        "threshold",
        0.5,
        "a node spoke where its amplitude exceeds this share of amplitude_mv",
        "",
        (0.1, 0.9),
        live=True,
    ),
    Parameter(
        "stale_after_s",
        3.0,
        "a node silent for longer is stale (pressure NaN)",
        "s",
        (0.1, 86_400.0),
        live=True,
    ),
    Parameter(
        "skin",
        "",
        "name of this very skin; files made for another one are refused; empty: not checked",
    ),
    Parameter(
        "calibration_file",
        "",
        "curves of the single taxels, from tactile-cdma calibrate; set it again to read it again; "
        "empty: the curve above for all",
        live=True,
    ),
    Parameter(
        "compensation",
        False,
        "undo hysteresis and lag as the calibration file describes them",
        live=True,
    ),
    Parameter(
        "drift_pa_per_min",
        60.0,
        "fastest drift of a taxel at rest that is followed; 0: none",
        "Pa/min",
        (0.0, 1e5),
        live=True,
    ),
    Parameter(
        "state_folder",
        "",
        "where tare and drift are kept; empty: $ROS_HOME/tactile_cdma, ~/.ros/tactile_cdma",
    ),
    Parameter(
        "contact_kpa",
        1.0,
        "a contact begins where a taxel exceeds this",
        "kPa",
        (0.01, 1e5),
        live=True,
    ),
    Parameter(
        "release_kpa",
        0.5,
        "and takes in the taxels beside it that exceed this, until none does",
        "kPa",
        (0.01, 1e5),
        live=True,
    ),
    Parameter(
        "layout_file",
        "",
        "places of the taxels, for skins that are no flat grid; empty: rows, columns, pitch_mm",
    ),
    Parameter("rows", 0, "taxel rows of the skin; 0: as square as fits", "", (0, 4_096)),
    Parameter("columns", 0, "taxel columns of the skin; 0: as square as fits", "", (0, 4_096)),
    Parameter("pitch_mm", 7.0, "distance of neighbouring taxels", "mm", (0.01, 1_000.0)),
    Parameter("taxel_mm", 5.5, "edge length of a taxel's sensing area", "mm", (0.01, 1_000.0)),
    Parameter("frame_id", "skin", "tf frame of the skin"),
    Parameter("publish_voltage", False, "also fill TactileArray.voltage", live=True),
    Parameter(
        "idle_rate_hz",
        0.0,
        "frames in which no node spoke are published at most so often; 0: all are",
        "Hz",
        (0.0, 1e5),
        live=True,
    ),
    Parameter("heatmap_rate_hz", 30.0, "most heatmaps per second", "Hz", (0.1, 30.0)),
    Parameter(
        "heatmap_max_kpa",
        140.0,
        "pressure at the top of the colour scale",
        "kPa",
        (0.1, 1e5),
        live=True,
    ),
    Parameter(
        "heatmap_pixels", 16, "edge length of a taxel in the heatmap", "px", (1, 256), live=True
    ),
    Parameter("autostart", True, "configure and activate without being asked"),
)
BY_NAME = {parameter.name: parameter for parameter in PARAMETERS}


@dataclass(frozen=True, slots=True)
class SkinConfig:
    """The parameters of the decoding chain in the form that the stages take."""

    spec: FrameSpec
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
    def of(cls, values: Mapping[str, Value]) -> SkinConfig:
        """From parameter values; missing ones take their defaults.

        Raises ParameterError for a single bad value, SpecError for an impossible combination,
        CalibrationError for a calibration file that cannot be used.
        """
        checked = check_values(values)
        get: dict[str, Any] = {p.name: checked.get(p.name, p.default) for p in PARAMETERS}
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

    def compensator(self) -> Compensator | None:
        """What undoes the sensors' dynamics; None where that is not asked."""
        dynamics = self.calibration.dynamics
        if not self.compensation or dynamics is None:
            return None
        return Compensator(dynamics, self.calibration.curves.range_pa)

    def recalibrated(self, values: Mapping[str, Any]) -> SkinConfig:
        """With calibration_file, of all parameters' values, read anew, and compensation as there.

        Raises CalibrationError for a file that cannot be used, SpecError where it does not hold
        what compensation takes.
        """
        return replace(
            self,
            calibration=_calibration(values, self.spec, self.adc, self.curve),
            compensation=values["compensation"],
        )

    def adjusted(self, values: Mapping[str, Value]) -> SkinConfig:
        """With the live ones of these values, all of them; files are not read again."""
        return replace(
            self,
            rest=rest_rules(values),
            contact=contact_thresholds(values),
            threshold=float(values["threshold"]),
            stale_after_s=float(values["stale_after_s"]),
        )


def contact_thresholds(values: Mapping[str, Any]) -> ContactThresholds:
    """From all parameters' values; raises SpecError where they contradict each other."""
    return ContactThresholds(values["contact_kpa"] * 1e3, values["release_kpa"] * 1e3)


def rest_rules(values: Mapping[str, Any]) -> RestRules:
    """From all parameters' values."""
    return RestRules(
        drift_pa_per_min=values["drift_pa_per_min"],
        contact_pa=values["contact_kpa"] * 1e3,
        release_pa=values["release_kpa"] * 1e3,
    )


def check_values(values: Mapping[str, object]) -> dict[str, Value]:
    """Every value in its parameter's type; raises ParameterError for a bad name or value."""
    for name in values:
        if name not in BY_NAME:
            raise ParameterError(unknown(name, BY_NAME))
    return {name: BY_NAME[name].check(value) for name, value in values.items()}


def unknown(name: str, known: Iterable[str]) -> str:
    """What to say of a name that isn't there."""
    close = difflib.get_close_matches(name, list(known), n=1)
    return f"unknown parameter {name!r}" + (f"; did you mean {close[0]!r}?" if close else "")


def read_file(path: Path) -> dict[str, Value]:
    """Values of a ROS 2 parameter file (every node's `ros__parameters` merged in file order).

    Raises ParameterError, naming the file, for anything that is not such a file.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ParameterError(f"{path}: {error.strerror}") from None
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise ParameterError(f"{path}: not a YAML file: {' '.join(str(error).split())}") from None
    values: dict[str, object] = {}
    try:
        sections = list(_sections(content))
    except RecursionError:
        raise ParameterError(f"{path}: sections that contain themselves") from None
    if not sections:
        raise ParameterError(
            f"{path}: no 'ros__parameters' section; is this a ROS 2 parameter file?"
        )
    for section in sections:
        values.update(section)
    try:
        return check_values(values)
    except ParameterError as error:
        raise ParameterError(f"{path}: {error}") from None


def _sections(content: object) -> Iterable[Mapping[str, object]]:
    if isinstance(content, Mapping):
        for name, below in content.items():
            if name == "ros__parameters" and isinstance(below, Mapping):
                yield {
                    str(key): value
                    for key, value in below.items()
                    if not str(key).startswith(STANDARD_PARAMETERS)
                }
            else:
                yield from _sections(below)


def _layout(get: Mapping[str, Any]) -> Layout:
    """The layout file's; without one a flat grid."""
    pitch_m = get["pitch_mm"] * 1e-3
    if not get["layout_file"]:
        taxel_m = get["taxel_mm"] * 1e-3
        return Layout.grid(get["nodes"], get["rows"], get["columns"], pitch_m, taxel_m)
    path = _path("layout_file", get["layout_file"])
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


def _calibration(
    get: Mapping[str, Any], spec: FrameSpec, adc: AdcScale, curve: PressureCurve
) -> Calibration:
    """From a file; without one the default."""
    calibration, file = Calibration.default(curve, spec.nodes), get["calibration_file"]
    if file:
        path = _path("calibration_file", file)
        calibration = read_calibration(path, spec.nodes, adc, curve, get["skin"])
    if get["compensation"] and calibration.dynamics is None:
        raise SpecError(
            f"no dynamics in {file or 'the default curve'}, which compensation undoes: run "
            "tactile-cdma calibrate --dynamics, or set compensation to false"
        )
    return calibration


def _path(name: str, text: str) -> Path:
    """A parameter's path, from the working folder or the home folder (~) on."""
    try:
        return Path(text).expanduser()
    except RuntimeError:
        raise SpecError(f"{name} is {text}: no such user's home") from None


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
