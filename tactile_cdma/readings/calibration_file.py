# SPDX-License-Identifier: Apache-2.0

"""Calibration ↔ YAML file: curves of single nodes, whose they are, and a seal against damage."""

from __future__ import annotations

import collections.abc
import hashlib
import json
import re
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ..base.errors import CalibrationError, SpecError
from ..base.listing import listed
from ..base.marked_yaml import Mapping, Marked, read_marked
from ..base.whole_file import replace_file
from .calibration import AdcScale, Calibration, PressureCurve
from .dynamics import LIMITS, Dynamics

SCHEMA = "tactile_cdma/calibration"
VERSION = 1
UNITS = {"pressure": "Pa", "voltage": "V"}
MOST_CORNERS = 65
MOST_PLAYS = 64
MOST_PA = 1e9
HEADROOM = 1.25
"""A curve may begin above vref by this factor: its first corner is extrapolated to no load."""
_PRESSURE_DIGITS, _VOLTAGE_DIGITS = 3, 7
"""Decimals of Pa and V that are kept: far below any converter's resolution."""
_REQUIRED = (
    "schema",
    "version",
    "identity",
    "skin",
    "nodes",
    "bits",
    "vref_v",
    "units",
    "uncalibrated",
    "curves",
)
_OPTIONAL = ("made", "dynamics")
_PLAYS = ("widths", "weights")
_IDENTITY = re.compile(r"^identity: *('[^'\n]*'|\"[^\"\n]*\"|[^#\n]*[^#\s])", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class CalibrationContent:
    """What a calibration file holds.

    skin: name of the skin; empty: any. curves: by node, 1…nodes; a node without one is
    uncalibrated. adc: of the nodes that were calibrated. dynamics: of all sensors; None: not known.
    source: what it was made from, for people.
    """

    skin: str
    nodes: int
    adc: AdcScale
    curves: collections.abc.Mapping[int, PressureCurve]
    dynamics: Dynamics | None = None
    source: str = ""

    @classmethod
    def of(
        cls, calibration: Calibration, adc: AdcScale, skin: str = "", source: str = ""
    ) -> CalibrationContent:
        """What is to be kept of a calibration; numbers as they will be written."""
        curves = {
            index + 1: _rounded(calibration.curves[index])
            for index in range(len(calibration.curves))
            if not calibration.uncalibrated[index]
        }
        return cls(skin, len(calibration.curves), adc, curves, calibration.dynamics, source)

    @property
    def uncalibrated(self) -> list[int]:
        """Nodes without a curve of their own."""
        return [node for node in range(1, self.nodes + 1) if node not in self.curves]

    @property
    def identity(self) -> str:
        """Twelve digits of the SHA-256 of all that decides what a voltage is taken for."""
        canonical = json.dumps(
            {
                "skin": self.skin,
                "nodes": self.nodes,
                "bits": self.adc.bits,
                "vref_v": self.adc.vref_v,
                "curves": {
                    str(node): [curve.pressure_pa, curve.voltage_v]
                    for node, curve in self.curves.items()
                },
                "dynamics": _entries(self.dynamics) if self.dynamics else None,
            },
            sort_keys=True,
        )
        return hashlib.sha256(canonical.encode()).hexdigest()[:12]

    def calibration(self, default: PressureCurve) -> Calibration:
        """For the decoding chain; nodes without a curve take the default one."""
        calibration = Calibration.of_nodes(self.curves, default, self.nodes)
        return replace(calibration, identity=self.identity, dynamics=self.dynamics)


def read_calibration(
    path: Path, nodes: int, adc: AdcScale, default: PressureCurve, skin: str = ""
) -> Calibration:
    """The calibration in a file, for a skin of so many nodes with this converter.

    default: curve of nodes that the file says are uncalibrated. skin: its name; empty: any.
    Raises CalibrationError, naming file, line, node and cause, for a file that is not what it
    should be, was changed since it was written, or was made for another skin.
    """
    return read_content(path, nodes, adc, skin).calibration(default)


def read_content(path: Path, nodes: int, adc: AdcScale, skin: str = "") -> CalibrationContent:
    """All that is in a file; see read_calibration."""
    file = read_marked(path, CalibrationError)
    content, identity = _parse(file)
    root = file.mapping("the file")
    for name, theirs, ours in (
        ("skin", content.skin, skin or content.skin),
        ("nodes", content.nodes, nodes),
        ("bits", content.adc.bits, adc.bits),
        ("vref_v", content.adc.vref_v, adc.vref_v),
    ):
        if theirs != ours:
            raise root[name].refuse(
                f"made for {name} {theirs or 'without a name'}, this skin has {name} {ours}: "
                "is this the file of another one?"
            )
    if identity != content.identity:
        raise root["identity"].refuse(
            f"the identity is {identity[:40]}, the content's is {content.identity}: the file was "
            "damaged, or edited; if that was meant, tactile-cdma calibrate --seal writes the "
            "identity anew"
        )
    return content


def write_calibration(
    path: Path, calibration: Calibration, adc: AdcScale, skin: str = "", source: str = ""
) -> str:
    """Write a calibration, replacing a file at once or not at all; returns its identity.

    source: what it was made from, for people. Raises CalibrationError where it cannot be written.
    """
    return write_content(path, CalibrationContent.of(calibration, adc, skin, source))


def write_content(path: Path, content: CalibrationContent) -> str:
    """As write_calibration does."""
    _replace(path, _text(content))
    return content.identity


def seal_calibration(path: Path) -> str:
    """Write the identity of its content into a file that was edited; returns the identity.

    All else stays as it is. Raises CalibrationError where the content is not valid.
    """
    file = read_marked(path, CalibrationError)
    content, _ = _parse(file)
    line = f"identity: '{content.identity}'"
    text, found = _IDENTITY.subn(line, path.read_text(encoding="utf-8"), count=1)
    if not found:
        raise file.refuse("no line begins with 'identity: …': write one, with any text")
    _replace(path, text)
    return content.identity


def _parse(file: Marked) -> tuple[CalibrationContent, str]:
    """Content and identity of a file that is right by itself."""
    root = file.mapping("the file")
    schema = root.get("schema")
    if schema is None:
        raise file.refuse(f"not a calibration file: it names no schema, not {SCHEMA!r}")
    if (found := schema.text("schema")) != SCHEMA:
        raise schema.refuse(f"not a calibration file: its schema is {found!r}, not {SCHEMA!r}")
    _check_version(file, root)
    root.check_keys(_REQUIRED + _OPTIONAL)
    if missing := [name for name in _REQUIRED if root.get(name) is None]:
        raise file.refuse(f"{', '.join(missing)} is missing: is the file cut short?")
    _check_units(root["units"].mapping("units"))
    nodes = root["nodes"].whole("nodes", 1, 65_535)
    vref_v = root["vref_v"].number("vref_v", 0.1, 100.0, "V")
    made, dynamics = root.get("made"), root.get("dynamics")
    content = CalibrationContent(
        skin=root["skin"].text("skin"),
        nodes=nodes,
        adc=AdcScale(root["bits"].whole("bits", 8, 16), vref_v),
        curves={
            _node(name, curve, nodes): _curve(name, curve, vref_v)
            for name, curve in root["curves"].mapping("curves").entries.items()
        },
        dynamics=_dynamics(dynamics) if dynamics else None,
        source=_source(made) if made else "",
    )
    _check_complete(root, content)
    return content, root["identity"].text("identity")


def _check_units(units: Mapping) -> None:
    units.check_keys(UNITS)
    for name, unit in UNITS.items():
        if (theirs := units[name].text(f"the unit of {name}")) != unit:
            raise units[name].refuse(f"the unit of {name} is {theirs[:40]}; it must be {unit}")


def _check_version(file: Marked, root: Mapping) -> None:
    if root.get("version") is None:
        raise file.refuse(f"version is missing; this is version {VERSION}")
    version = root["version"].whole("version", 0, 10**6)
    if version > VERSION:
        raise root["version"].refuse(
            f"version {version} was written by a newer program than this one, which reads "
            f"version {VERSION}: update it, or calibrate again with this one"
        )
    if version < VERSION:
        raise root["version"].refuse(
            f"version {version} is older than {VERSION}, the one that is read: fit the recorded "
            "loads again with tactile-cdma calibrate"
        )


def _node(name: str, value: Marked, nodes: int) -> int:
    """The number of the node that an entry is of."""
    return replace(value, content=name, quoted=False).whole("a node's number", 1, nodes)


def _curve(node: str, value: Marked, vref_v: float) -> PressureCurve:
    """One node's curve; the complaint names node, corner, line and cause."""
    what = f"node {node}"
    columns = value.mapping(what)
    columns.check_keys(UNITS)
    pressures = columns["pressure"].items(f"{what}: pressure")
    voltages = columns["voltage"].items(f"{what}: voltage")
    if len(pressures) != len(voltages) or not 2 <= len(pressures) <= MOST_CORNERS:
        raise value.refuse(
            f"{what}: {len(pressures)} pressures and {len(voltages)} voltages; a curve needs two "
            f"or more corners ({MOST_CORNERS} at most), each with both"
        )
    pressure_pa = [
        item.number(f"{what}, corner {corner}: pressure", 0.0, MOST_PA, "Pa")
        for corner, item in enumerate(pressures, 1)
    ]
    if pressure_pa[0]:
        raise pressures[0].refuse(f"{what} begins at {pressure_pa[0]:g} Pa, not at 0")
    voltage_v = [
        item.number(f"{what}, corner {corner}: voltage", 0.0, most_v, "V")
        for corner, (item, most_v) in enumerate(
            zip(voltages, [HEADROOM * vref_v] + [vref_v] * len(voltages), strict=False), 1
        )
    ]
    _check_order(what, pressures, pressure_pa, "Pa")
    _check_order(what, voltages, [-volts for volts in voltage_v], "V")
    return PressureCurve(tuple(pressure_pa), tuple(voltage_v))


def _check_order(what: str, items: list[Marked], rising: list[float], unit: str) -> None:
    """Corners follow one another: rising, or negative and rising, that is falling."""
    for corner, (before, now) in enumerate(pairwise(rising), 2):
        if now <= before:
            raise items[corner - 1].refuse(
                f"{what}, corner {corner}: {abs(now):g} {unit} after {abs(before):g} {unit}; "
                "pressures must rise and voltages fall from corner to corner"
            )


def _dynamics(value: Marked) -> Dynamics:
    """Lag and hysteresis of all nodes."""
    entries = value.mapping("dynamics")
    entries.check_keys((*LIMITS, *_PLAYS))
    values: dict[str, Any] = {
        name: entries[name].number(name, *limits) for name, limits in LIMITS.items()
    }
    values |= {name: _shares(entries[name], name) for name in _PLAYS}
    try:
        return Dynamics(**values)
    except SpecError as error:
        raise entries[_PLAYS[0]].refuse(str(error)) from None


def _shares(value: Marked, name: str) -> tuple[float, ...]:
    """One number per play."""
    items = value.items(name)
    if len(items) > MOST_PLAYS:
        raise value.refuse(f"{name} has {len(items)} numbers; {MOST_PLAYS} plays are possible")
    return tuple(item.number(f"each of {name}", 0.0, 20.0) for item in items)


def _source(made: Marked) -> str:
    """What a file was made from; whoever edits that may write what he likes."""
    source = made.mapping("made").get("from")
    return source.text("from") if source else ""


def _check_complete(root: Mapping, content: CalibrationContent) -> None:
    """Every node has a curve or is said to have none."""
    without: set[int] = set()
    for item in root["uncalibrated"].items("uncalibrated"):
        node = item.whole("a node's number", 1, content.nodes)
        if node in without or node in content.curves:
            where = "listed twice" if node in without else "uncalibrated, but has a curve"
            raise item.refuse(f"node {node} is {where}")
        without.add(node)
    if missing := [node for node in content.uncalibrated if node not in without]:
        raise root["curves"].refuse(
            f"no curve for {listed(missing, 'node')}; calibrate them, or list them as uncalibrated"
        )


def _rounded(curve: PressureCurve) -> PressureCurve:
    return PressureCurve(
        tuple(round(float(value), _PRESSURE_DIGITS) for value in curve.pressure_pa),
        tuple(round(float(value), _VOLTAGE_DIGITS) for value in curve.voltage_v),
    )


def _text(content: CalibrationContent) -> str:
    head: dict[str, Any] = {
        "schema": SCHEMA,
        "version": VERSION,
        "identity": content.identity,
        "skin": content.skin,
        "nodes": content.nodes,
        "bits": content.adc.bits,
        "vref_v": content.adc.vref_v,
        "units": UNITS,
        "made": {
            "at": datetime.now().astimezone().isoformat(timespec="seconds"),
            "from": content.source,
        },
        "uncalibrated": content.uncalibrated,
    }
    lines = [
        f"  {node}: {{pressure: {_plain(curve.pressure_pa)}, voltage: {_plain(curve.voltage_v)}}}\n"
        for node, curve in content.curves.items()
    ]
    curves = "curves:\n" + "".join(lines) if lines else "curves: {}\n"
    if content.dynamics:
        head["dynamics"] = _entries(content.dynamics)
    top = yaml.safe_dump(head, sort_keys=False, allow_unicode=True, default_flow_style=None)
    return top + curves


def _entries(dynamics: Dynamics) -> dict[str, float | list[float]]:
    """As YAML and JSON know them."""
    return {name: np.array(value, float).tolist() for name, value in asdict(dynamics).items()}


def _plain(values: tuple[float, ...]) -> str:
    return "[" + ", ".join(repr(value) for value in values) + "]"


def _replace(path: Path, text: str) -> None:
    try:
        replace_file(path, text)
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be written: {error.strerror}") from None
