# SPDX-License-Identifier: Apache-2.0

"""The table of all user-visible parameters, with units and limits, and how their values are read.

The ROS node declares its parameters from this table, the command line takes defaults and help texts
from it, and parameter files are checked against it. docs/parameters.md is generated from it.
"""

import logging
import re
import reprlib
from array import array
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

from ..base.errors import ParameterError, SpecError
from ..base.marked_yaml import Marked, read_marked
from ..base.text import listed, suggestion
from ..code.frame import BIPOLAR, DEFAULT_AMPLITUDE_V, ORTHOGONAL, SPARSE, UNIPOLAR
from ..readings.calibration import MOST_PA

_log = logging.getLogger(__name__)

Value = bool | int | float | str | tuple[float, ...]
Values = Mapping[str, Any]
"""Values by parameter name, each in its parameter's type."""
NATURAL_SIGNS = -1
"""sign_seed for rows without sign changes."""
SIMULATION = "sim://"
"""Prefix of ports that are simulated skins."""
REPLAY = "replay://"
"""Prefix of ports that are recordings."""
LINE, GAP = "line", "gap"
OWN, DATA = "own", "data"
DRIVES, HEARS = "drive", "hear"
"""Wires of the sync pulses."""
ANY = "any"
TINY, SLOW, FAST = KINDS = "tiny", "slow", "fast"
"""Kinds of nodes of one sensor, those of firmware/, the slower ones first."""
FOUR = "four"
"""Kind of nodes of four sensors."""
TRUTH = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}
"""Words for true and false, in lower case, as in YAML 1.1."""
STANDARD_PARAMETERS = ("use_sim_time", "start_type_description_service", "qos_overrides")
"""Name prefixes of the parameters that every ROS 2 node has."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter. limits are inclusive; live parameters may change while the node is active.

    If the default is a tuple, values have its length and limits apply to every element.
    pair: two numbers are taken as well as one. numbers: a text of whole numbers above 0; one number
    and a list are taken, too.
    """

    name: str
    default: Value
    text: str
    unit: str = ""
    limits: tuple[float, float] | None = None
    choices: tuple[Value, ...] = ()
    live: bool = False
    pair: bool = False
    numbers: bool = False

    @property
    def description(self) -> str:
        return self.text + (f" [{self.unit}]" if self.unit else "")

    def check(self, value: object) -> Value:
        """Return the value in this parameter's type.

        Raises ParameterError, which names the value, the limit and the unit.
        """
        if self.pair and isinstance(value, list | tuple | array):
            return replace(self, default=(0.0, 0.0), pair=False).check(value)
        if self.numbers:
            value = ", ".join(map(str, self.numbers_of(value)))
        kind = type(self.default)
        if type(value) is int and value.bit_length() > 63:
            raise ParameterError(f"{self.name} is an integer of {value.bit_length()} bits")
        if kind is float and type(value) is int:
            value = float(value)
        elif kind is tuple and isinstance(value, list | array):
            value = tuple(value)
        if type(value) is not kind:
            raise ParameterError(
                f"{self.name} must be {_KIND_NAMES[kind]}, "
                f"got {_shown(value)} ({type(value).__name__})"
            )
        assert isinstance(value, bool | int | float | str | tuple)
        if not isinstance(value, tuple):
            return self._within(value)
        assert isinstance(self.default, tuple)
        if len(value) != len(self.default):
            raise ParameterError(
                f"{self.name} is {_shown(value)}; it must be {len(self.default)} numbers"
            )
        element = partial(replace, self, default=0.0)
        checked: Any = [element(name=f"{self.name}[{i}]").check(v) for i, v in enumerate(value)]
        return tuple(checked)

    def numbers_of(self, value: object) -> list[int]:
        """Read whole numbers above 0: one, a list, or a text of them; raises ParameterError."""
        parts = value if isinstance(value, list | tuple | array) else [value]
        if isinstance(value, str):
            parts = [int(word) if word.isdecimal() else word for word in _GAPS.split(value) if word]
        if wrong := [part for part in parts if type(part) is not int or not 0 < part < 1 << 16]:
            raise ParameterError(
                f"{self.name} has {_shown(wrong[0])}; it must be numbers of nodes, such as 3, 7"
            )
        return sorted(set(parts))

    def _within(self, value: bool | int | float | str) -> Value:
        if self.choices and value not in self.choices:
            raise ParameterError(
                f"{self.name} is {_shown(value)}; it must be one of "
                + ", ".join(str(choice) for choice in self.choices)
            )
        if self.name in _FRAMES and str(value).startswith("/"):
            raise ParameterError(
                f"{self.name} is {_shown(value)}: tf wants a name, without a leading slash"
            )
        if self.limits and not isinstance(value, str | bool):
            low, high = self.limits
            if not low <= value <= high:  # NaN is not, either
                unit = f" {self.unit}" if self.unit else ""
                raise ParameterError(
                    f"{self.name} is {value:g}{unit}; it must lie within {low:g}…{high:g}{unit}"
                )
        return value


_FRAMES = "frame_id", "parent_frame"
_GAPS = re.compile(r"[\s,]+")
_KIND_NAMES = {
    bool: "true or false",
    int: "an integer",
    float: "a number",
    str: "a text",
    tuple: "a list of numbers",
}

# fmt: off
PARAMETERS: tuple[Parameter, ...] = (
    Parameter("port", "",
        "port of the digitizer: /dev/ttyACM0, usb://SERIAL, sim://?scene=hand, replay://FILE or "
        "another pyserial URL; empty: the simulated skin, with a warning"),
    Parameter("digitizer_id", "",
        "accept only the digitizer with this id (in quotes; tactile-cdma ports lists ids); "
        "empty: any"),
    Parameter("baud", 2_000_000, "baud rate; USB ports ignore it", "baud", (1_200, 20_000_000)),
    Parameter("nodes", 16, "number of sensing nodes on the wire", "", (1, 65_535)),
    Parameter("bits", 10, "word length: resolution of the nodes' ADC", "bit", (8, 16)),
    Parameter("parity", False, "each word is followed by an even-parity bit"),
    Parameter("chip_us", 50.0, "duration of one chip, the paper's pulse length", "µs", (0.01, 1e6)),
    Parameter("frame_period_ms", 12.8,
        "time from frame start to frame start; 0, and where the default is too short: the shortest",
        "ms", (0.0, 1e5)),
    Parameter("rate_hz", 0.0,
        "frames per second, for which chips, period and restarts are chosen; 0: chip_us counts",
        "Hz", (0.0, 1e4)),
    Parameter("node_kind", ANY, "nodes that rate_hz is for", choices=(ANY, *KINDS, FOUR)),
    Parameter("codes", ORTHOGONAL,
        "orthogonal, or sparse: fewer chips per bit than nodes, of which few speak in a frame",
        choices=(ORTHOGONAL, SPARSE)),
    Parameter("order", 0,
        "chips per bit; 0: the fewest possible, or slightly more if faster to decode",
        "", (0, 65_536)),
    Parameter("first_row", 1, "code row of node 1; the paper uses 0", "", (0, 65_535)),
    Parameter("sign_seed", 1,
        "seed of the random row signs; -1: natural signs, as in the paper", "", (-1, 2**32 - 1)),
    Parameter("scramble", False,
        "all nodes flip their chips by one sequence, so that late nodes show; true in config/"),
    Parameter("resync_chips", 0,
        "chips between sync edges at which nodes restart their timers; 0: at the frame's start",
        "", (0, 65_535)),
    Parameter("guard_chips", 0, "pause before each such restart, in chips", "", (0, 255)),
    Parameter("drive", BIPOLAR,
        "levels of a node's chips: ±A (bipolar) or 0 and A (unipolar)",
        choices=(BIPOLAR, UNIPOLAR)),
    Parameter("polarity", 1, "-1 if the amplifier inverts", choices=(1, -1)),
    Parameter("amplitude_mv", DEFAULT_AMPLITUDE_V * 1e3,
        "level A of one node at the digitizer; 0: estimated from every frame", "mV", (0.0, 1e5)),
    Parameter("timing", LINE,
        "how frame starts are found: by the digitizer's sync edges, or the pauses between frames",
        choices=(LINE, GAP)),
    Parameter("sync", DRIVES,
        "whose frames set the time: the digitizer's, or another one's, which it hears",
        choices=(DRIVES, HEARS)),
    Parameter("sync_wire", OWN,
        "wire of the sync pulses: their own, or that of the data, pulled low between frames",
        choices=(OWN, DATA)),
    Parameter("samples_per_chip", 4,
        "samples per chip requested from the digitizer; 1: it sends the mean of each chip",
        "", (1, 256)),
    Parameter("nodes_repeat", False,
        "nodes transmit in every frame while they are not at rest, by the firmware's rule rest"),
    Parameter("vref_v", 3.3,
        "reference of the nodes' ADC: V = code·vref/2^bits; Arduino Uno, Nano: 5, as v0_v then",
        "V", (0.1, 100.0)),
    Parameter("v0_v", 3.3, "sensor voltage at zero pressure", "V", (0.0, 100.0), live=True),
    Parameter("knee_kpa", 50.0,
        "end of the sensor's first stage", "kPa", (0.001, MOST_PA / 1e3), live=True),
    Parameter("range_kpa", 140.0,
        "end of the sensor's second stage", "kPa", (0.001, MOST_PA / 1e3), live=True),
    Parameter("sensitivity1_v_per_kpa", 0.033,
        "voltage drop per pressure in the first stage; negative: it rises",
        "V/kPa", (-100.0, 100.0), live=True),
    Parameter("sensitivity2_v_per_kpa", 0.0059,
        "voltage drop per pressure in the second stage, of the same sign",
        "V/kPa", (-100.0, 100.0), live=True),
    Parameter("active_share", 0.5,
        "a node is active if its amplitude exceeds this fraction of amplitude_mv",
        "", (0.1, 0.9), live=True),
    Parameter("stale_after_s", 3.0,
        "a node silent for longer is stale (pressure NaN)", "s", (0.1, 86_400.0), live=True),
    Parameter("masked", "",
        "nodes out of service (3, 7), beside those that layout and ~/mask name",
        live=True, numbers=True),
    Parameter("dead_share", 0.0,
        "share of the taxels that are left out of service once dead for stale_after_s",
        "", (0.0, 0.5), live=True),
    Parameter("skin", "",
        "name of this individual skin; files made for another skin are refused; empty: not "
        "checked"),
    Parameter("calibration_file", "",
        "curves of individual taxels, from tactile-cdma calibrate; empty: the two-stage curve "
        "for all", live=True),
    Parameter("drift_pa_per_min", 60.0,
        "fastest drift of a taxel at rest that is followed; 0: drift is not followed",
        "Pa/min", (0.0, 1e5), live=True),
    Parameter("state_folder", "",
        "folder for saved tare and drift; empty: $ROS_HOME/tactile_cdma, else "
        "~/.ros/tactile_cdma"),
    Parameter("contact_kpa", 1.0,
        "a contact starts at a taxel above this", "kPa", (0.01, 1e5), live=True),
    Parameter("release_kpa", 0.5,
        "a contact extends over adjacent taxels above this", "kPa", (0.01, 1e5), live=True),
    Parameter("layout_file", "",
        "taxel positions, for skins other than a flat grid; empty: rows, columns, pitch_mm"),
    Parameter("rows", 0, "taxel rows; 0: as square as possible", "", (0, 4_096)),
    Parameter("columns", 0, "taxel columns; 0: as square as possible", "", (0, 4_096)),
    Parameter("pitch_mm", 7.0,
        "distance between neighbouring taxels; two numbers: from column to column, and from row to "
        "row", "mm", (0.01, 1_000.0), pair=True),
    Parameter("taxel_mm", 5.5, "edge of a taxel's sensing area; below the pitch, else unused",
        "mm", (0.01, 1_000.0)),
    Parameter("frame_id", "skin", "tf frame of the skin"),
    Parameter("parent_frame", "",
        "tf frame that the skin is mounted on; empty: the driver publishes no transform"),
    Parameter("mount_xyz_m", (0.0, 0.0, 0.0),
        "position of frame_id in parent_frame", "m", (-1e3, 1e3), live=True),
    Parameter("mount_rpy_rad", (0.0, 0.0, 0.0),
        "orientation of frame_id in parent_frame: roll, pitch, yaw, as in URDF",
        "rad", (-10.0, 10.0), live=True),
    Parameter("publish_voltage", False, "also fill TactileArray.voltage", live=True),
    Parameter("publish_sigma", False,
        "also tell how sure each pressure is, from what the calibration file knows", live=True),
    Parameter("publish_unknown_wrench", True,
        "~/wrench is NaN while force or torque is unknown; false: not published then", live=True),
    Parameter("idle_rate_hz", 0.0,
        "maximum rate of frames in which no node is active; 0: every frame is published",
        "Hz", (0.0, 1e5), live=True),
    Parameter("visual_rate_hz", 30.0, "maximum rate of pictures", "Hz", (0.1, 30.0), live=True),
    Parameter("colour_max_kpa", 140.0,
        "pressure at the top of the colour scale", "kPa", (0.1, 1e5), live=True),
    Parameter("colour_gamma", 0.5,
        "a share p of that pressure stands at p^colour_gamma of the colours; 1: linear",
        "", (0.1, 1.0), live=True),
    Parameter("heatmap_pixels", 32,
        "edge length of a taxel in the heatmap", "px", (1, 256), live=True),
    Parameter("autostart", True, "configure and activate when the node starts"),
)
# fmt: on
BY_NAME = {parameter.name: parameter for parameter in PARAMETERS}
DEFAULTS: Values = {parameter.name: parameter.default for parameter in PARAMETERS}


def _shown(value: object) -> str:
    """Show a value in a message, cut to a short length: a client may send a megabyte."""
    return reprlib.repr(list(value) if isinstance(value, array | tuple) else value)


RENAMED = {"threshold": "active_share"}
"""Parameters' names of earlier versions."""
REMOVED = {
    "roll_call": "nodes keep time by the sync line now, by discipline (see tactile-cdma node) or "
    "by restarts within the frame (resync_chips)"
}
"""Parameters of earlier versions that are gone, and what to do instead."""


def check_values(values: Mapping[str, object]) -> dict[str, Value]:
    """Convert values to their parameters' types; raises ParameterError for a bad name or value."""
    for name in values:
        if name not in BY_NAME:
            raise ParameterError(unknown(name, BY_NAME))
    return {name: BY_NAME[name].check(value) for name, value in values.items()}


def unknown(name: str, known: Iterable[str], kind: str = "parameter") -> str:
    """Tell of an unknown name: its present name, what replaced it, or the closest one."""
    if name in RENAMED and RENAMED[name] in known:
        return f"the {kind} {name} is called {RENAMED[name]} now"
    if name in REMOVED:
        return f"the {kind} {name} is gone: {REMOVED[name]}"
    return f"unknown {kind} {name!r}{suggestion(name, known)}"


def read_file(path: Path, node: str | None = None) -> dict[str, Value]:
    """Read a ROS 2 parameter file.

    node: fully qualified name of the node whose parameters are read, as ROS 2 would; None: every
    node's `ros__parameters` are merged in file order.
    Raises ParameterError, which names file and line, if it is no such file, has nothing for the
    node, or a value is wrong.
    """
    values: dict[str, Value] = {}
    for section in read_sections(path, node):
        for name, value in section.items():
            if not name.startswith(STANDARD_PARAMETERS):
                values[name] = check_marked(name, value)
    return values


def read_sections(path: Path, node: str | None) -> list[Mapping[str, Marked]]:
    """Read the parameters of a file for a node, in file order; see read_file."""
    file = read_marked(path, ParameterError)
    sections = list(_sections(file))
    if not sections:
        raise file.refuse("no 'ros__parameters' section; is this a ROS 2 parameter file?")
    names = listed([name for name, _ in sections], show="{:.99}".format)
    _log.debug("%s has parameters for %s", path, names)
    if node is None:
        return [section for _, section in sections]
    taken = [section for name, section in sections if _fits(name, node)]
    if not taken:
        raise file.refuse(
            f"its parameters are for {names}, and this node is {node}: write {node} or /** there, "
            "or start the node with that name and namespace"
        )
    return taken


def _fits(name: str, node: str) -> bool:
    """Tell whether a section is for a node: * is a name between slashes, ** any number of them."""
    names = node.split("/")[1:]
    ends = {0}  # numbers of names that the parts so far may stand for
    for part in name.split("/")[1:]:
        if part == "**":
            ends = set(range(min(ends, default=len(names) + 1), len(names) + 1))
        else:
            ends = {end + 1 for end in ends if part in ("*", *names[end : end + 1])}
    return len(names) in ends


def _sections(file: Marked, node: str = "") -> Iterator[tuple[str, Mapping[str, Marked]]]:
    """Yield what a file has for each node: its name, from the root on, and the parameters."""
    if isinstance(file.content, dict):
        for name, below in file.content.items():
            if name == "ros__parameters" and isinstance(below.content, dict):
                yield node, below.content
            else:
                yield from _sections(below, f"{node}/{name.strip('/')}")


def check_marked(name: str, value: Marked) -> Value:
    """Check a parameter's value from a file; a wrong name or value raises the file's error."""
    with value.refusing(ParameterError):
        return check_values({name: _typed(value)})[name]


def _typed(value: Marked) -> object:
    """Return a value in the type that ROS 2's own reader of parameter files gives it."""
    if isinstance(value.content, list):
        return [_typed(item) for item in value.content]
    if isinstance(value.content, dict):
        raise value.refuse("keys with values where a single value is expected")
    if value.quoted:
        return value.content
    return None if value.is_null else _scalar(value.content)


def of_text(name: str, text: str) -> Value:
    """Read a parameter's value as it is typed in a command; a list in brackets or without.

    Raises ParameterError.
    """
    parameter = BY_NAME[name]
    if isinstance(parameter.default, str):
        return parameter.check(text)
    if isinstance(parameter.default, tuple):
        return parameter.check([_scalar(part.strip()) for part in text.strip(" []").split(",")])
    return parameter.check(_scalar(text.strip()))


def _scalar(text: str) -> object:
    """Return a text without quotes in the type that YAML gives it."""
    if _INTEGER.fullmatch(text):
        return int(text, 16 if "x" in text else 10)
    if _NUMBER.fullmatch(text):
        return float(text)
    return TRUTH.get(text.lower(), text)


_INTEGER = re.compile("[-+]?(0|[1-9][0-9]{0,17}|0x[0-9a-fA-F]{1,15})")
_NUMBER = re.compile(r"[-+]?([0-9]+\.[0-9]*|\.[0-9]+|[0-9]+(?=[eE]))([eE][-+]?[0-9]{1,3})?")


def parse_options(query: str, options: Iterable[Parameter], scheme: str) -> dict[str, Any]:
    """Read the options that a query gives, each in its parameter's type.

    Raises SpecError for an option that is unknown, given twice or of a wrong value.
    """
    known, values = {option.name: option for option in options}, dict[str, Any]()
    for name, text in parse_qsl(query, keep_blank_values=True):
        if name not in known:
            hint = suggestion(name, known, f"options: {', '.join(known)}")
            raise SpecError(f"{scheme} has no option {name!r}{hint}")
        if name in values:
            raise SpecError(f"option {name!r} is given twice")
        values[name] = check_option(known[name], _of_url(known[name], text))
    return values


def check_option(option: Parameter, value: Value) -> Value:
    """Check an option's value. Raises SpecError, naming value, limits and near choices."""
    try:
        return option.check(value)
    except ParameterError as error:
        hint = suggestion(str(value), map(str, option.choices))
        raise SpecError(f"option {error}{hint}") from None


def _of_url(option: Parameter, text: str) -> Value:
    if option.name == "sign_seed" and text == "natural":
        return NATURAL_SIGNS
    kind: Any = type(option.default)
    try:
        if option.pair and "," in text:
            return tuple(map(float, text.strip("[]").split(",")))
        truth = TRUTH | {"1": True, "0": False}
        value: Value = truth[text.lower()] if kind is bool else kind(text)
    except (ValueError, KeyError):
        wanted = {bool: "true or false (0 or 1)", int: "an integer", float: "a number"}[kind]
        given = reprlib.repr(text)
        raise SpecError(f"option {option.name} is {given}; it must be {wanted}") from None
    return value
