# SPDX-License-Identifier: Apache-2.0

"""Calibration files (YAML): the curves of single nodes, the skin they belong to, and a checksum."""

import hashlib
import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Self

import yaml

from ..base.errors import CalibrationError
from ..base.marked_yaml import MOST_BYTES, Keys, Marked, read_marked
from ..base.named_file import naming, read_text
from ..base.text import listed
from ..base.whole_file import replace_file
from .calibration import MOST_PA, AdcScale, Calibration, PressureCurve

SCHEMA = "tactile_cdma/calibration"
VERSION = 1
UNITS = {"pressure": "Pa", "voltage": "V"}
# Limits of a file, chosen: far above what calibration writes and what sensors reach.
MOST_CORNERS = 65
HEADROOM = 0.25
"""How far a curve's first corner may lie beyond 0…vref, in multiples of vref; chosen: that corner
is extrapolated to no load."""
MOST_V = 100.0
"""Greatest residual, V: the greatest vref."""
MOST_RANGES = 3.0
"""Highest pressure of a curve in multiples of range_kpa; chosen: wrong units differ by more."""
_ERRORS = {"residual": MOST_V, "loop": 1.0}
"""Keys of a curve beside those of UNITS, and the greatest value of each, V and a share."""
_PRESSURE_DIGITS, _VOLTAGE_DIGITS = 3, 7
"""Decimals of Pa and V that are written: 1 mPa and 0.1 µV are far below any ADC's resolution."""
_KEYS = (
    *("schema", "version", "identity", "skin", "nodes", "bits", "vref_v", "units"),
    *("made", "uncalibrated", "curves"),
)
_IDENTITY = re.compile(r"^identity: *('[^'\n]*'|\"[^\"\n]*\"|[^#\n]*[^#\s])", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class CalibrationContent:
    """The content of a calibration file.

    skin: name of the skin; empty: any. curves: by node, 1…nodes; a node without one is
    uncalibrated. adc: of the calibrated nodes. source: what the calibration was made from, for
    people.
    """

    skin: str
    nodes: int
    adc: AdcScale
    curves: Mapping[int, PressureCurve]
    source: str = ""

    @classmethod
    def of(cls, calibration: Calibration, adc: AdcScale, skin: str = "", source: str = "") -> Self:
        """Describe a calibration, with numbers rounded as they are written."""
        curves = {
            index + 1: _rounded(calibration.curves[index])
            for index in range(len(calibration.curves))
            if not calibration.uncalibrated[index]
        }
        return cls(skin, len(calibration.curves), adc, curves, source)

    @property
    def uncalibrated(self) -> list[int]:
        """Return numbers of the nodes without a curve of their own."""
        return [node for node in range(1, self.nodes + 1) if node not in self.curves]

    @property
    def made_for(self) -> dict[str, str | int | float]:
        """Return values that a skin must agree with, by key of the file."""
        bits, vref_v = self.adc.bits, self.adc.vref_v
        return {"skin": self.skin, "nodes": self.nodes, "bits": bits, "vref_v": vref_v}

    @property
    def identity(self) -> str:
        """Twelve digits of the SHA-256 of everything that determines readings."""
        canonical = json.dumps(
            {
                **self.made_for,
                "curves": {
                    str(node): [curve.pressure_pa, curve.voltage_v, *_known(curve).values()]
                    for node, curve in self.curves.items()
                },
                "dynamics": None,  # there once; kept, so that files stay valid
            },
            sort_keys=True,
        )
        return hashlib.sha256(canonical.encode()).hexdigest()[:12]

    def calibration(self, default: PressureCurve) -> Calibration:
        """Make the calibration for decoding; nodes without a curve take the default one."""
        calibration = Calibration.of_nodes(self.curves, default, self.nodes)
        return replace(calibration, identity=self.identity)


def read_calibration(
    path: Path, nodes: int, adc: AdcScale, default: PressureCurve, skin: str = ""
) -> Calibration:
    """Read the calibration of a skin with this number of nodes and this ADC.

    default: curve of the uncalibrated nodes. skin: the skin's name; empty: any.
    Raises CalibrationError, naming file, line, node and cause, for a file that is invalid, was
    changed since it was written, or was made for another skin, or with loads in another unit.
    """
    content = read_content(path, nodes, adc, skin)
    for node, curve in content.curves.items():
        if reason := out_of_range(curve.pressure_pa[-1], default.pressure_pa[-1]):
            raise CalibrationError(f"{path}: node {node}: {reason}")
    return content.calibration(default)


def out_of_range(largest_pa: float, range_pa: float) -> str | None:
    """Tell why loads up to the largest are not of a sensor that ends at range_pa, Pa, or None."""
    if largest_pa <= MOST_RANGES * range_pa:
        return None
    return (
        f"loads up to {largest_pa / 1e3:.4g} kPa are {largest_pa / range_pa:.3g} times range_kpa "
        f"({range_pa / 1e3:g}): is their unit right, and the area of forces? If so, set range_kpa "
        "to what the sensors bear, with sensitivities to match"
    )


def read_content(path: Path, nodes: int, adc: AdcScale, skin: str = "") -> CalibrationContent:
    """Read all that is in a file; see read_calibration."""
    content, root = _read(path)
    wanted = replace(content, skin=skin or content.skin, nodes=nodes, adc=adc).made_for
    for (name, theirs), ours in zip(content.made_for.items(), wanted.values(), strict=True):
        if theirs != ours:
            raise root[name].refuse(
                f"made for {name} {theirs or 'without a name'}, this skin has {name} {ours}: "
                "is this the file of another skin?"
            )
    return content


def read_any(path: Path) -> CalibrationContent:
    """Read all that is in the file of any skin; see read_calibration."""
    return _read(path)[0]


def _read(path: Path) -> tuple[CalibrationContent, Keys]:
    """Content of a file that is as it was written, and its keys."""
    content, identity, root = _parse(path)
    if identity != content.identity:
        raise root["identity"].refuse(
            f"the identity is {identity[:40]}, the content's is {content.identity}: the file was "
            "damaged, or edited; if it was edited on purpose, tactile-cdma calibrate --seal "
            "updates the identity"
        )
    return content, root


def write_content(path: Path, content: CalibrationContent) -> str:
    """Write content atomically; returns its identity. Raises CalibrationError if that fails."""
    with naming(path, CalibrationError, "cannot be written"):
        replace_file(path, _text(content))
    return content.identity


def seal_calibration(path: Path) -> str:
    """Update the identity in a file that was edited, and nothing else; returns the identity.

    Raises CalibrationError if the content is not valid.
    """
    content, _, root = _parse(path)
    line = f"identity: '{content.identity}'"
    with naming(path, CalibrationError, "cannot be written"):
        text, found = _IDENTITY.subn(line, read_text(path, MOST_BYTES), count=1)
        if not found:
            raise root.value.refuse("no line begins with 'identity: …': write one, with any text")
        replace_file(path, text)
    return content.identity


def _parse(path: Path) -> tuple[CalibrationContent, str, Keys]:
    """Content, stated identity and keys of a file that is valid in itself."""
    root = read_marked(path, CalibrationError).mapping("the file")
    root.check_schema(SCHEMA, VERSION)
    if old := root.get("dynamics"):
        raise old.refuse(
            "dynamics are no longer compensated (docs/paper.md says why): delete this entry, and "
            "run tactile-cdma calibrate --seal"
        )
    root.check_keys(_KEYS)
    units = root["units"].mapping("units")
    units.check_keys(UNITS)
    for name, unit in UNITS.items():
        if (theirs := units.text(name)) != unit:
            raise units[name].refuse(f"the unit of {name} is {theirs[:40]}; it must be {unit}")
    nodes, bits = root.whole("nodes", 1, 65_535), root.whole("bits", 8, 16)
    vref_v = root.number("vref_v", 0.1, 100.0, "V")
    made = root.get("made")
    content = CalibrationContent(
        skin=root.text("skin"),
        nodes=nodes,
        adc=AdcScale(bits, vref_v),
        curves={
            number.whole("a node's number", 1, nodes): _curve(f"node {name}", curve, vref_v)
            for name, curve in root["curves"].mapping("curves").entries.items()
            for number in [replace(curve, content=name, quoted=False)]
        },
        source=made.mapping("made").text("from", "") if made else "",
    )
    _check_complete(root, content)
    return content, root.text("identity"), root


def _curve(what: str, value: Marked, vref_v: float) -> PressureCurve:
    """Read one node's curve; errors name node, corner, line and cause."""
    columns = value.mapping(what)
    columns.check_keys((*UNITS, *_ERRORS))
    pressures, voltages = (columns[name].items(f"{what}: {name}") for name in UNITS)
    if len(pressures) != len(voltages) or not 2 <= len(pressures) <= MOST_CORNERS:
        raise value.refuse(
            f"{what}: {len(pressures)} pressures and {len(voltages)} voltages; a curve needs 2…"
            f"{MOST_CORNERS} corners, each with both"
        )
    pressure_pa, voltage_v = list[float](), list[float]()
    for corner, (pressure, voltage) in enumerate(zip(pressures, voltages, strict=True), 1):
        here, beyond_v = f"{what}, corner {corner}", 0.0 if corner > 1 else HEADROOM * vref_v
        pressure_pa.append(pressure.number(f"{here}: pressure", 0.0, math.inf, "Pa"))
        if pressure_pa[-1] > MOST_PA:
            raise pressure.refuse(
                f"{here}: pressure is {pressure_pa[-1]:g} Pa, more than skins bear ({MOST_PA:g}): "
                "was it in kPa, or were grams of a gauge read as newtons (column force_g)?"
            )
        most_v = vref_v + beyond_v
        voltage_v.append(voltage.number(f"{here}: voltage", 0.0 - beyond_v, most_v, "V"))
        if corner == 1 and pressure_pa[0]:
            raise pressure.refuse(f"{what} begins at {pressure_pa[0]:g} Pa, not at 0")
        for item, (*before, now), sign, unit in (
            (pressure, pressure_pa, 1, "Pa"),
            (voltage, voltage_v, -1 if voltage_v[:2][-1] < voltage_v[0] else 1, "V"),
        ):
            if before and sign * (now - before[-1]) <= 0:
                raise item.refuse(
                    f"{here}: {now:g} {unit} after {before[-1]:g} {unit}; pressures must rise "
                    "from corner to corner, and voltages fall, or rise, all along"
                )
    known = [
        columns.number(name, 0.0, most) if columns.get(name) else math.nan
        for name, most in _ERRORS.items()
    ]
    return PressureCurve(tuple(pressure_pa), tuple(voltage_v), *known)


def _check_complete(root: Keys, content: CalibrationContent) -> None:
    """Refuse nodes that neither have a curve nor are listed as uncalibrated, or both."""
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
        *(round(error, _VOLTAGE_DIGITS) for error in (curve.residual_v, curve.loop)),
    )


def _known(curve: PressureCurve) -> dict[str, float]:
    """Return what is known of a curve's errors, by key of the file."""
    errors = zip(_ERRORS, (curve.residual_v, curve.loop), strict=True)
    return {name: error for name, error in errors if not math.isnan(error)}


def _text(content: CalibrationContent) -> str:
    head: dict[str, Any] = {
        "schema": SCHEMA,
        "version": VERSION,
        "identity": content.identity,
        **content.made_for,
        "units": UNITS,
        "made": {
            "at": datetime.now().astimezone().isoformat(timespec="seconds"),
            "from": content.source,
        },
        "uncalibrated": content.uncalibrated,
    }
    lines = [
        f"  {node}: {{pressure: {[*curve.pressure_pa]}, voltage: {[*curve.voltage_v]}"
        + "".join(f", {name}: {error}" for name, error in _known(curve).items())
        + "}\n"
        for node, curve in content.curves.items()
    ]
    curves = "curves:\n" + "".join(lines) if lines else "curves: {}\n"
    top = yaml.safe_dump(head, sort_keys=False, allow_unicode=True, default_flow_style=None)
    return top + curves
