# SPDX-License-Identifier: Apache-2.0

"""Layout files: YAML → Layout, with everything checked that could put a taxel in a wrong place.

docs/layout.md describes the format.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..base.errors import LayoutError, SpecError
from ..base.marked_yaml import Mapping, Marked, read_marked
from .layout import Layout
from .layout_nodes import MOST_TAXELS, Place, Wiring, check_nodes, node_of_entry, nodes_of_grid
from .layout_shapes import OVERLAP, Surface, cylinder, plane, seen_from_outside, sphere
from .proximity import beside, usual_distance_m

SCHEMA = "tactile_cdma/layout"
VERSION = 1
_LEAST_MM, _MOST_PITCH_MM, _MOST_MM = 1e-2, 1e3, 1e5
_LEAST_MM2, _MOST_MM2 = 1e-6, 1e6
_REGULAR: dict[str, Callable[..., Surface]] = {
    "grid": plane,
    "cylinder": cylinder,
    "sphere": sphere,
}
_LIST = "list"
_HEAD_KEYS = ("schema", "version", "name", "skin", "shape", "pitch_mm", "masked", "unplaced")
_GRID_KEYS = (*_HEAD_KEYS, "rows", "columns", "nodes", "code_rows", "area_mm2")
_KEYS = {
    "grid": _GRID_KEYS,
    "cylinder": (*_GRID_KEYS, "radius_mm"),
    "sphere": (*_GRID_KEYS, "radius_mm"),
    _LIST: (*_HEAD_KEYS, "taxels"),
}
_TAXEL_KEYS = ("position_mm", "normal", "area_mm2", "node", "code_row")


def read_layout(path: Path, wiring: Wiring) -> Layout:
    """The layout that a file describes, for a skin wired so.

    Raises LayoutError, naming file, line, taxel and cause.
    """
    content = read_marked(path, LayoutError).mapping("the layout")
    _check_head(content, wiring.skin)
    shape = content["shape"].text("shape")
    if shape not in _KEYS:
        raise content["shape"].refuse(f"shape is {shape!r}; it must be one of {', '.join(_KEYS)}")
    content.check_keys(_KEYS[shape])
    first_row, irregular = wiring.first_row, shape == _LIST
    skin = _list(content, first_row) if irregular else _regular(content, shape, first_row)
    nodes, masked, unplaced = check_nodes(content, skin.places, wiring)
    _check_apart(content, skin)
    title = content.get("name")
    name = title.text("name") if title else path.stem
    layout = Layout.on(skin.surface, name, skin.rows, skin.columns, nodes, skin.pitch_m)
    return replace(layout, masked=masked, unplaced=unplaced, irregular=irregular)


@dataclass(frozen=True, slots=True)
class _Skin:
    """What a shape comes to; pitch_m as in Layout."""

    surface: Surface
    rows: int
    columns: int
    pitch_m: float
    places: list[Place]


def _check_head(content: Mapping, skin: str) -> None:
    """Whether this is a layout file, of this version, of this skin."""
    schema, version, theirs = content["schema"], content["version"], content.get("skin")
    if schema.text("schema") != SCHEMA:
        raise schema.refuse(f"schema is {schema.content!r}; a layout file has {SCHEMA!r}")
    number = version.whole("version", 1, 10**6)
    if number != VERSION:
        raise version.refuse(
            f"version is {number}; this driver reads version {VERSION}: update the driver"
        )
    if theirs and theirs.text("skin") != (skin or theirs.content):
        raise theirs.refuse(f"this layout is of skin {theirs.content!r}, the driver's is {skin!r}")


def _regular(content: Mapping, shape: str, first_row: int) -> _Skin:
    """Rows and columns on a plane, a cylinder or a sphere."""
    rows = content["rows"].whole("rows", 1, MOST_TAXELS)
    columns = content["columns"].whole("columns", 1, MOST_TAXELS)
    if rows * columns > MOST_TAXELS:
        raise content["rows"].refuse(
            f"{rows} rows × {columns} columns are {rows * columns} taxels; at most {MOST_TAXELS} "
            "are possible"
        )
    pitch_m = _pitch_m(content["pitch_mm"])
    dimensions = [pitch_m]
    if "radius_mm" in _KEYS[shape]:
        radius_mm = content["radius_mm"].number("radius_mm", _LEAST_MM, _MOST_MM, "mm")
        dimensions.append(radius_mm * 1e-3)
    try:
        surface = _REGULAR[shape](rows, columns, *dimensions)
    except SpecError as error:
        raise content["radius_mm"].refuse(str(error)) from None
    if area := content.get("area_mm2"):
        cell_mm2 = float(surface.areas_m2.min()) * 1e6
        most_mm2 = float(f"{cell_mm2 * 1.001:.4g}")  # what is rounded fits
        area_mm2 = area.number("area_mm2", _LEAST_MM2, most_mm2, "mm²")
        surface = replace(surface, areas_m2=np.full_like(surface.areas_m2, area_mm2 * 1e-6))
    places = nodes_of_grid(content, rows, columns, first_row)
    return _Skin(surface, rows, columns, pitch_m, places)


def _list(content: Mapping, first_row: int) -> _Skin:
    """Taxels one by one."""
    entries = content["taxels"].items("taxels")
    if not 1 <= len(entries) <= MOST_TAXELS:
        raise content["taxels"].refuse(
            f"taxels has {len(entries)} entries; 1…{MOST_TAXELS} are possible"
        )
    taxels = [_taxel(value, i, first_row) for i, value in enumerate(entries)]
    places = [taxel.place for taxel in taxels]
    positions_m = np.array([taxel.position_mm for taxel in taxels]) * 1e-3
    normals = np.array([taxel.normal for taxel in taxels])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    _check_same_place(positions_m, places)
    pitch_m = _pitch_of_list_m(content, positions_m, normals)
    areas_mm2 = [taxel.area_mm2 or pitch_m**2 * 1e6 for taxel in taxels]
    surface = Surface(
        flat_m=seen_from_outside(positions_m, normals).astype(np.float32),
        positions_m=positions_m.astype(np.float32),
        normals=normals.astype(np.float32),
        areas_m2=(np.array(areas_mm2) * 1e-6).astype(np.float32),
    )
    return _Skin(surface, 1, len(taxels), pitch_m, places)


@dataclass(frozen=True, slots=True)
class _Taxel:
    """An entry of a list. area_mm2 None: the square of the pitch."""

    place: Place
    position_mm: list[float]
    normal: list[float]
    area_mm2: float | None


def _taxel(value: Marked, index: int, first_row: int) -> _Taxel:
    what = f"taxel {index}"
    entry = value.mapping(what)
    entry.check_keys(_TAXEL_KEYS)
    normal, area = entry.get("normal"), entry.get("area_mm2")
    direction = _vector(normal, f"the normal of {what}", 1e6) if normal else [0.0, 0.0, 1.0]
    if normal and not np.linalg.norm(direction) > 1e-9:
        raise normal.refuse(f"the normal of {what} has no direction: its length is 0")
    return _Taxel(
        place=node_of_entry(entry, first_row),
        position_mm=_vector(entry["position_mm"], f"the position of {what}", _MOST_MM, "mm"),
        normal=direction,
        area_mm2=area.number(f"the area of {what}", _LEAST_MM2, _MOST_MM2, "mm²") if area else None,
    )


def _vector(value: Marked, what: str, most: float, unit: str = "") -> list[float]:
    items = value.items(what)
    if len(items) != 3:
        raise value.refuse(f"{what} has {len(items)} numbers; it must be [x, y, z]")
    return [item.number(what, -most, most, unit) for item in items]


def _pitch_m(value: Marked) -> float:
    return value.number("pitch_mm", _LEAST_MM, _MOST_PITCH_MM, "mm") * 1e-3


def _pitch_of_list_m(
    content: Mapping,
    positions_m: NDArray[np.float64],
    normals: NDArray[np.float64],
) -> float:
    """As given; else the median distance of a taxel to its nearest."""
    if given := content.get("pitch_mm"):
        return _pitch_m(given)
    try:
        distance_m = usual_distance_m(positions_m, normals)
    except SpecError as error:
        raise content["taxels"].refuse(str(error)) from None
    if distance_m is None:
        raise content["taxels"].refuse("no two taxels to tell the pitch by: give pitch_mm")
    if not _LEAST_MM <= distance_m * 1e3 <= _MOST_PITCH_MM:
        raise content["taxels"].refuse(
            f"taxels are {distance_m * 1e3:.3g} mm apart; {_LEAST_MM:g}…{_MOST_PITCH_MM:g} mm are "
            "possible: are positions in mm?"
        )
    return distance_m


def _check_same_place(positions_m: NDArray[np.float64], places: list[Place]) -> None:
    _, first, which = np.unique(positions_m, axis=0, return_index=True, return_inverse=True)
    earlier = first[which.ravel()]
    again = np.flatnonzero(earlier != np.arange(len(places)))
    if len(again):
        place, other = places[again[0]], places[earlier[again[0]]]
        raise place.value.refuse(f"{place.taxel} is at the same place as {other.taxel}")


def _check_apart(content: Mapping, skin: _Skin) -> None:
    """No two taxels at one place, or so close that one of them must be wrong."""
    places, surface = skin.places, skin.surface
    real = np.flatnonzero([place.node for place in places])
    try:
        pairs = beside(surface.positions_m[real], surface.normals[real], OVERLAP * skin.pitch_m)
    except SpecError as error:
        raise content.value.refuse(str(error)) from None
    for first, second, distance_m in zip(*pairs, strict=True):
        place, other = places[real[second]], places[real[first]]
        raise place.value.refuse(
            f"{place.taxel} is {distance_m * 1e3:.3g} mm from {other.taxel}; less than a quarter "
            f"of the pitch of {skin.pitch_m * 1e3:g} mm is a mistake"
        )
