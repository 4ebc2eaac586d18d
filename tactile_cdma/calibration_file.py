"""Calibration ↔ YAML file: curves of single nodes, whose they are, and a seal against damage."""

from __future__ import annotations

import hashlib
import json
import os
import re
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml

from .calibration import AdcScale, Calibration, PressureCurve
from .errors import CalibrationError
from .yaml_lines import LinedYaml

SCHEMA = "tactile_cdma/calibration"
VERSION = 1
UNITS = {"pressure": "Pa", "voltage": "V"}
MOST_CORNERS = 65
MOST_BYTES = 16 << 20
"""65,535 nodes of three corners take 6 MB."""
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
_OPTIONAL = ("made",)


@dataclass(frozen=True, slots=True)
class CalibrationContent:
    """What a calibration file holds.

    skin: name of the skin; empty: any. curves: by node, 1…nodes; a node without one is
    uncalibrated. adc: of the nodes that were calibrated.
    """

    skin: str
    nodes: int
    adc: AdcScale
    curves: Mapping[int, PressureCurve]

    @classmethod
    def of(cls, calibration: Calibration, adc: AdcScale, skin: str) -> CalibrationContent:
        """What is to be kept of a calibration; numbers as they will be written."""
        curves = {
            index + 1: _rounded(calibration.curves[index])
            for index in range(len(calibration.curves))
            if not calibration.uncalibrated[index]
        }
        return cls(skin, len(calibration.curves), adc, curves)

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
            },
            sort_keys=True,
        )
        return hashlib.sha256(canonical.encode()).hexdigest()[:12]

    def calibration(self, default: PressureCurve) -> Calibration:
        """For the decoding chain; nodes without a curve take the default one."""
        calibration = Calibration.of_nodes(self.curves, default, self.nodes)
        return replace(calibration, identity=self.identity)


def read_calibration(
    path: Path, nodes: int, adc: AdcScale, default: PressureCurve, skin: str = ""
) -> Calibration:
    """The calibration in a file, for a skin of so many nodes with this converter.

    default: curve of nodes that the file says are uncalibrated. skin: its name; empty: any.
    Raises CalibrationError, naming file, line, node and cause, for a file that is not what it
    should be, was changed since it was written, or was made for another skin.
    """
    file = LinedYaml(path.expanduser(), CalibrationError, MOST_BYTES)
    content, identity = _parse(file)
    root = file.mapping(file.root, "the file")
    for name, theirs, ours in (
        ("skin", content.skin, skin or content.skin),
        ("nodes", content.nodes, nodes),
        ("bits", content.adc.bits, adc.bits),
        ("vref_v", content.adc.vref_v, adc.vref_v),
    ):
        if theirs != ours:
            raise file.refusal(
                root[name],
                f"made for {name} {theirs or 'without a name'}, this skin has {name} {ours}: "
                "is this the file of another one?",
            )
    if identity != content.identity:
        raise file.refusal(
            root["identity"],
            f"the identity is {identity}, the content's is {content.identity}: the file was "
            "damaged, or edited; if that was meant, tactile-cdma calibrate --seal writes the "
            "identity anew",
        )
    return content.calibration(default)


def write_calibration(
    path: Path, calibration: Calibration, adc: AdcScale, skin: str = "", source: str = ""
) -> str:
    """Write a calibration, replacing a file at once or not at all; returns its identity.

    source: what it was made from, for people. Raises CalibrationError where it cannot be written.
    """
    content = CalibrationContent.of(calibration, adc, skin)
    _replace_file(path, _text(content, source))
    return content.identity


def seal_calibration(path: Path) -> str:
    """Write the identity of its content into a file that was edited; returns the identity.

    All else stays as it is. Raises CalibrationError where the content is not valid.
    """
    content, _ = _parse(LinedYaml(path, CalibrationError, MOST_BYTES))
    line = f"identity: '{content.identity}'"
    text = path.read_text(encoding="utf-8")
    _replace_file(path, re.sub(r"^identity:[^#\n]*", line, text, count=1, flags=re.MULTILINE))
    return content.identity


def _parse(file: LinedYaml) -> tuple[CalibrationContent, str]:
    """Content and identity of a file that is right by itself."""
    root = file.mapping(file.root, "the file")
    if "schema" not in root or (schema := file.text(root["schema"], "schema")) != SCHEMA:
        found = f"its schema is {schema!r}" if "schema" in root else "it names no schema"
        raise file.refusal(file.root, f"not a calibration file: {found}, not {SCHEMA!r}")
    _check_version(file, root)
    root = file.mapping(file.root, "the file", _REQUIRED + _OPTIONAL)
    if missing := [name for name in _REQUIRED if name not in root]:
        raise file.refusal(file.root, f"{', '.join(missing)} is missing: is the file cut short?")
    units = file.mapping(root["units"], "units", tuple(UNITS))
    for name, unit in UNITS.items():
        if name not in units or (found := file.text(units[name], name)) != unit:
            given = found if name in units else "missing"
            raise file.refusal(root["units"], f"unit of {name} is {given}; it must be {unit}")
    nodes = file.whole(root["nodes"], "nodes", 1, 65_535)
    vref_v = file.number(root["vref_v"], "vref_v")
    if not 0 < vref_v <= 100:
        raise file.refusal(root["vref_v"], f"vref_v is {vref_v:g} V; it must lie within 0…100 V")
    content = CalibrationContent(
        skin=file.text(root["skin"], "skin"),
        nodes=nodes,
        adc=AdcScale(file.whole(root["bits"], "bits", 1, 16), vref_v),
        curves={
            _node(file, key, nodes): _curve(file, key, value, vref_v)
            for key, value in _entries(file, root["curves"])
        },
    )
    _check_complete(file, root, content)
    return content, file.text(root["identity"], "identity")


def _check_version(file: LinedYaml, root: Mapping[str, yaml.Node]) -> None:
    if "version" not in root:
        raise file.refusal(file.root, f"version is missing; this is version {VERSION}")
    version = file.whole(root["version"], "version", 0, 10**6)
    if version > VERSION:
        raise file.refusal(
            root["version"],
            f"version {version} was written by a newer program than this one, which reads "
            f"version {VERSION}: update it, or calibrate again with this one",
        )
    if version < VERSION:
        raise file.refusal(
            root["version"],
            f"version {version} is older than {VERSION}, the one that is read: fit the recorded "
            "loads again with tactile-cdma calibrate",
        )


def _entries(file: LinedYaml, curves: yaml.Node) -> list[tuple[yaml.Node, yaml.Node]]:
    file.mapping(curves, "curves")  # for its complaints: every node once
    pairs: list[tuple[yaml.Node, yaml.Node]] = curves.value
    return pairs


def _node(file: LinedYaml, key: yaml.Node, nodes: int) -> int:
    return file.whole(key, "a node's number", 1, nodes)


def _curve(file: LinedYaml, key: yaml.Node, node: yaml.Node, vref_v: float) -> PressureCurve:
    """One node's curve; the complaint names node, corner, line and cause."""
    what = f"node {key.value}"
    columns = file.mapping(node, what, tuple(UNITS))
    if missing := [name for name in UNITS if name not in columns]:
        raise file.refusal(node, f"{what}: {' and '.join(missing)} missing")
    pressures = file.items(columns["pressure"], f"{what}: pressure")
    voltages = file.items(columns["voltage"], f"{what}: voltage")
    if len(pressures) != len(voltages) or not 2 <= len(pressures) <= MOST_CORNERS:
        raise file.refusal(
            node,
            f"{what}: {len(pressures)} pressures and {len(voltages)} voltages; a curve needs two "
            f"or more corners ({MOST_CORNERS} at most), each with both",
        )
    pressure_pa = [file.number(item, f"{what}: pressure") for item in pressures]
    voltage_v = [file.number(item, f"{what}: voltage") for item in voltages]
    if pressure_pa[0] != 0:
        raise file.refusal(pressures[0], f"{what}: begins at {pressure_pa[0]:g} Pa, not at 0")
    for corner, volts in enumerate(voltage_v):
        most_v = vref_v if corner else HEADROOM * vref_v
        if not 0 <= volts <= most_v:
            raise file.refusal(
                voltages[corner],
                f"{what}, corner {corner + 1}: {volts:g} V; it must lie within 0…{most_v:g} V",
            )
    _check_order(file, what, pressures, pressure_pa, "Pa")
    _check_order(file, what, voltages, [-volts for volts in voltage_v], "V")
    return PressureCurve(tuple(pressure_pa), tuple(voltage_v))


def _check_order(
    file: LinedYaml, what: str, items: list[yaml.Node], rising: list[float], unit: str
) -> None:
    """Corners follow one another: rising, or negative and rising, that is falling."""
    for corner, (before, now) in enumerate(pairwise(rising), 2):
        if now <= before:
            raise file.refusal(
                items[corner - 1],
                f"{what}, corner {corner}: {abs(now):g} {unit} after {abs(before):g} {unit}; "
                "pressures must rise and voltages fall from corner to corner",
            )


def _check_complete(
    file: LinedYaml, root: Mapping[str, yaml.Node], content: CalibrationContent
) -> None:
    """Every node has a curve or is said to have none."""
    listed: set[int] = set()
    for item in file.items(root["uncalibrated"], "uncalibrated"):
        node = _node(file, item, content.nodes)
        if node in listed or node in content.curves:
            where = "listed twice" if node in listed else "uncalibrated, but has a curve"
            raise file.refusal(item, f"node {node} is {where}")
        listed.add(node)
    if missing := [node for node in content.uncalibrated if node not in listed]:
        raise file.refusal(
            root["curves"],
            f"no curve for {numbers(missing)}; calibrate them, or list them as uncalibrated",
        )


def numbers(nodes: list[int], most: int = 10) -> str:
    """Nodes in a sentence: "node 3", "nodes 3, 4, 9 and 12 more"."""
    shown = ", ".join(map(str, nodes[:most]))
    more = f" and {len(nodes) - most} more" if len(nodes) > most else ""
    return f"node{'s' if len(nodes) > 1 else ''} {shown}{more}"


def _rounded(curve: PressureCurve) -> PressureCurve:
    return PressureCurve(
        tuple(round(value, _PRESSURE_DIGITS) for value in curve.pressure_pa),
        tuple(round(value, _VOLTAGE_DIGITS) for value in curve.voltage_v),
    )


def _text(content: CalibrationContent, source: str) -> str:
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
            "from": source,
        },
        "uncalibrated": content.uncalibrated,
    }
    lines = [
        f"  {node}: {{pressure: {_plain(curve.pressure_pa)}, voltage: {_plain(curve.voltage_v)}}}\n"
        for node, curve in content.curves.items()
    ]
    curves = "curves:\n" + "".join(lines) if lines else "curves: {}\n"
    top = yaml.safe_dump(head, sort_keys=False, allow_unicode=True, default_flow_style=None)
    return top + curves


def _plain(values: tuple[float, ...]) -> str:
    return "[" + ", ".join(repr(value) for value in values) + "]"


def _replace_file(path: Path, text: str) -> None:
    """All or nothing: a crash while writing leaves the old file."""
    try:
        # mkstemp's file is for its owner only; this one is for whoever may read the folder.
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        try:
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                file.write(text)
                os.fchmod(file.fileno(), 0o644)
                file.flush()
                os.fsync(file.fileno())
            Path(name).replace(path)
        except BaseException:
            Path(name).unlink()
            raise
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be written: {error.strerror}") from None
