# SPDX-License-Identifier: Apache-2.0

"""Read layout files: YAML or a table → Layout, checked so that no taxel is at a wrong place.

docs/patches.md describes the format.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..base.arrays import Floats
from ..base.errors import LayoutError, SpecError
from ..base.marked_yaml import Keys, Marked, read_marked
from ..base.named_file import expanded
from .adjacency import around, beside, cells, polygon_areas_m2, table, usual_distance_m
from .layout import Layout
from .layout_nodes import MOST_TAXELS, TaxelNode, Wiring, check_nodes, node_of_entry, nodes_of_grid
from .layout_shapes import (
    OVERLAP,
    Pitch,
    Surface,
    across_and_down,
    cylinder,
    plane,
    seen_from_outside,
    sphere,
)
from .position_table import SUFFIXES, read_positions
from .surface_file import first_hits, read_link, read_triangles

SCHEMA = "tactile_cdma/layout"
VERSION = 1
# Limits of lengths (mm) and areas (mm²), far beyond any skin on both sides: they catch positions
# given in another unit.
_LEAST_MM, _MOST_PITCH_MM, _MOST_MM = 1e-2, 1e3, 1e5
_LEAST_MM2, _MOST_MM2 = 1e-6, 1e6
_FARTHEST_M = 1e4
"""Largest coordinate of a corner, m; chosen: beyond any robot, in whatever unit its file may be."""
_MOST_NORMAL = 1e6
"""Largest component of a normal, which need not have unit length."""
_SHAPES: dict[str, Callable[..., Surface]] = {"grid": plane, "cylinder": cylinder, "sphere": sphere}
_LIST, _MESH = "list", "mesh"
_HEAD_KEYS = ("schema", "version", "name", "skin", "shape", "pitch_mm", "masked", "unplaced")
_GRID_KEYS = (*_HEAD_KEYS, "rows", "columns", "nodes", "code_rows", "area_mm2")
_KEYS = {
    "grid": _GRID_KEYS,
    "cylinder": (*_GRID_KEYS, "radius_mm"),
    "sphere": (*_GRID_KEYS, "radius_mm"),
    _MESH: (*_GRID_KEYS, "mesh", "scale", "urdf", "link", "at_mm", "out", "right"),
    _LIST: (*_HEAD_KEYS, "taxels"),
}
_LEAST_FACING = 0.25
"""Least cosine between a mesh's normal and the rectangle's: steeper, and pitches no longer hold."""
_TAXEL_KEYS = ("position_mm", "normal", "area_mm2", "node", "code_row")


def read_layout(path: Path, wiring: Wiring) -> Layout:
    """Read the layout in a file, for a skin with this wiring.

    Raises LayoutError, naming file, line, taxel and cause.
    """
    content = _content(path).mapping("the layout")
    content.check_schema(SCHEMA, VERSION)
    theirs = content.text("skin", wiring.skin)
    if wiring.skin and theirs != wiring.skin:
        raise content["skin"].refuse(
            f"this layout is of skin {theirs!r}, the driver's is {wiring.skin!r}"
        )
    shape = content.text("shape")
    if shape not in _KEYS:
        raise content["shape"].refuse(f"shape is {shape!r}; it must be one of {', '.join(_KEYS)}")
    content.check_keys(_KEYS[shape])
    if shape == _LIST:
        surface, pitch, places = _listed(content, wiring.first_row)
        rows, columns = 1, len(places)
    else:
        rows, columns = (content.whole(key, 1, MOST_TAXELS) for key in ("rows", "columns"))
        if rows * columns > MOST_TAXELS:
            size = f"{rows} rows × {columns} columns are {rows * columns} taxels"
            raise content["rows"].refuse(f"{size}; the limit is {MOST_TAXELS}")
        places = nodes_of_grid(content, rows, columns, wiring.first_row)
        if shape == _MESH:
            surface, pitch = _projected(content, path.parent, rows, columns, places)
        else:
            surface, pitch = _regular(content, shape, rows, columns)
    nodes, masked, unplaced = check_nodes(content, places, wiring)
    across_m, down_m = across_and_down(pitch)
    _check_apart(content, surface, min(across_m, down_m), places)
    return Layout(
        **vars(surface),
        name=content.text("name", path.stem),
        rows=rows,
        columns=columns,
        nodes=nodes,
        pitch_m=math.sqrt(across_m * down_m),
        aspect=across_m / down_m,
        masked=masked,
        unplaced=unplaced,
        irregular=shape == _LIST,
    )


def _content(path: Path) -> Marked:
    """Return what a file says; a table says what a list of its taxels would."""
    if path.suffix.lower() not in SUFFIXES:
        return read_marked(path, LayoutError)
    taxels = read_positions(path)
    said = {"schema": SCHEMA, "version": str(VERSION), "shape": _LIST}
    head = {key: replace(taxels, content=text) for key, text in said.items()}
    return replace(taxels, content=head | {"taxels": taxels})


def _regular(content: Keys, shape: str, rows: int, columns: int) -> tuple[Surface, Pitch]:
    """Place rows and columns on a plane, a cylinder or a sphere; returns the pitch, m, too."""
    pitch, radius_m = _pitch_m(content), []
    if "radius_mm" in _KEYS[shape]:
        radius_m.append(content.number("radius_mm", _LEAST_MM, _MOST_MM, "mm") * 1e-3)
    with (content.get("radius_mm") or content.value).refusing(SpecError):
        return _with_area(content, _SHAPES[shape](rows, columns, pitch, *radius_m)), pitch


def _with_area(content: Keys, surface: Surface) -> Surface:
    if content.get("area_mm2"):
        cell_mm2 = float(surface.areas_m2.min()) * 1e6
        most_mm2 = float(f"{cell_mm2 * 1.001:.4g}")  # admits a rounded cell area
        area_m2 = content.number("area_mm2", _LEAST_MM2, most_mm2, "mm²") * 1e-6
        surface = replace(surface, areas_m2=np.full_like(surface.areas_m2, area_m2))
    return surface


def _projected(
    content: Keys, folder: Path, rows: int, columns: int, places: list[TaxelNode]
) -> tuple[Surface, Pitch]:
    """Lay a rectangle's rows and columns on a mesh, against its normal; returns the pitch, too."""
    pitch, triangles = _pitch_m(content), _triangles(content, folder)
    out, right = (_direction(content[key], key) for key in ("out", "right"))
    right -= (right @ out) * out
    if not np.linalg.norm(right) > 1e-3:
        raise content["right"].refuse("right, the direction of columns, must not lie along out")
    right /= np.linalg.norm(right)
    grid = plane(rows, columns, pitch)
    at_m = np.array(_vector(content["at_mm"], "at_mm", _MOST_MM, "mm")) * 1e-3
    on_it_m = at_m + grid.flat_m @ np.stack([right, np.cross(out, right)])
    far_m = float((triangles @ out).max() - at_m @ out) + 1e-3  # from beyond the mesh
    with content["shape"].refusing(ValueError):
        distance_m, normals = first_hits(triangles, on_it_m + far_m * out, -out)
    facing = np.abs(normals @ out)
    normals *= np.where(normals @ out < 0, -1.0, 1.0)[:, None]
    for taxel in np.flatnonzero([place.node for place in places]).tolist():
        if not np.isfinite(distance_m[taxel]):
            raise content["at_mm"].refuse(f"{places[taxel].taxel} is beside the mesh")
        if facing[taxel] < _LEAST_FACING:
            raise content["at_mm"].refuse(
                f"{places[taxel].taxel} is where the mesh is too steep, "
                f"{math.degrees(math.acos(facing[taxel])):.0f}° from the rectangle"
            )
    empty = ~np.isfinite(distance_m)
    distance_m[empty], facing[empty], normals[empty] = far_m, 1.0, out
    positions_m = on_it_m + (far_m - distance_m)[:, None] * out
    areas_m2 = grid.areas_m2 / np.maximum(facing, _LEAST_FACING)
    surface = Surface.of(grid.flat_m.astype(np.float64), positions_m, normals, areas_m2)
    return _with_area(content, surface), pitch


def _triangles(content: Keys, folder: Path) -> Floats:
    """Read corners (n, 3, 3), m, of mesh or link; paths are relative to the layout file."""
    mesh, urdf = content.get("mesh"), content.get("urdf")
    source = mesh or urdf
    if source is None or (mesh and urdf):
        raise content["shape"].refuse("shape mesh needs a mesh, or a urdf and a link, and not both")
    link = content.text("link") if urdf else ""
    scale = content.number("scale", 1e-9, 1e9) if mesh and content.get("scale") else 1.0
    with source.refusing(ValueError), np.errstate(over="ignore", invalid="ignore"):
        path = folder / expanded(content.text("mesh" if mesh else "urdf"))
        triangles = read_link(path, link) if urdf else read_triangles(path) * scale
        if not (np.abs(triangles) <= _FARTHEST_M).all():  # NaN is not, either
            raise ValueError(
                f"{path}: has sizes or corners beyond {_FARTHEST_M:g} m, or not finite"
            )
        return triangles


def _direction(value: Marked, what: str) -> Floats:
    """Make a unit vector (3,) of one of any length in the file."""
    direction = np.array(_vector(value, what, _MOST_NORMAL))
    if not np.linalg.norm(direction) > 1e-9:
        raise value.refuse(f"{what} has no direction: its length is 0")
    return np.asarray(direction / np.linalg.norm(direction))


def _listed(content: Keys, first_row: int) -> tuple[Surface, Pitch, list[TaxelNode]]:
    """Read taxels given one by one; returns the pitch, m, and their places in the file, too."""
    entries = content["taxels"].items("taxels", 1, MOST_TAXELS)
    taxels = [_taxel(value, index, first_row) for index, value in enumerate(entries)]
    places, positions_mm, directions, areas_mm2 = map(list, zip(*taxels, strict=True))
    positions_m, normals = np.array(positions_mm) * 1e-3, np.array(directions)
    _, first, which = np.unique(positions_m, axis=0, return_index=True, return_inverse=True)
    earlier = first[which.ravel()]
    if len(again := np.flatnonzero(earlier != np.arange(len(places)))):
        place, other = places[again[0]], places[earlier[again[0]]]
        raise place.value.refuse(f"{place.taxel} is at the same place as {other.taxel}")
    pitch = _pitch_of_list_m(content, positions_m, normals)
    areas_m2 = np.array(areas_mm2, dtype=np.float64) * 1e-6  # NaN for None
    if (left_out := np.isnan(areas_m2)).any():
        pitch_m = math.sqrt(math.prod(across_and_down(pitch)))
        with content["taxels"].refusing(SpecError):
            neighbours = table(*around(positions_m, normals, pitch_m), len(positions_m))
            outlines = cells(positions_m, normals, neighbours, pitch_m)
        areas_m2[left_out] = polygon_areas_m2(outlines)[left_out]
    flat_m = seen_from_outside(positions_m, normals)
    return Surface.of(flat_m, positions_m, normals, areas_m2), pitch, places


def _taxel(
    value: Marked, index: int, first_row: int
) -> tuple[TaxelNode, list[float], Floats, float | None]:
    """Read an entry: its place, position (mm), normal and area (mm²; None: of its cell)."""
    what = f"taxel {index}"
    entry = value.mapping(what)
    entry.check_keys(_TAXEL_KEYS)
    normal, area = entry.get("normal"), entry.get("area_mm2")
    return (
        node_of_entry(entry, first_row),
        _vector(entry["position_mm"], f"the position of {what}", _MOST_MM, "mm"),
        _direction(normal, f"the normal of {what}") if normal else np.array([0.0, 0.0, 1.0]),
        area.number(f"the area of {what}", _LEAST_MM2, _MOST_MM2, "mm²") if area else None,
    )


def _vector(value: Marked, what: str, most: float, unit: str = "") -> list[float]:
    return value.numbers(what, -most, most, unit, 3, 3)


def _pitch_m(content: Keys) -> Pitch:
    """Read one number, or that from column to column and that from row to row."""
    limits = "pitch_mm", _LEAST_MM, _MOST_PITCH_MM, "mm"
    if isinstance(content["pitch_mm"].content, list):
        across_mm, down_mm = content["pitch_mm"].numbers(*limits, 2, 2)
        return across_mm * 1e-3, down_mm * 1e-3
    return content.number(*limits) * 1e-3


def _pitch_of_list_m(content: Keys, positions_m: Floats, normals: Floats) -> Pitch:
    """Return the pitch as given, else the median distance from a taxel to its nearest neighbour."""
    if content.get("pitch_mm"):
        return _pitch_m(content)
    with content["taxels"].refusing(SpecError):
        distance_m = usual_distance_m(positions_m, normals)
    if distance_m is None:
        raise content["taxels"].refuse("no neighbours to derive the pitch from: give pitch_mm")
    if not _LEAST_MM <= distance_m * 1e3 <= _MOST_PITCH_MM:
        raise content["taxels"].refuse(
            f"taxels are {distance_m * 1e3:.3g} mm apart; the limits are "
            f"{_LEAST_MM:g}…{_MOST_PITCH_MM:g} mm: are positions in mm?"
        )
    return distance_m


def _check_apart(content: Keys, surface: Surface, pitch_m: float, places: list[TaxelNode]) -> None:
    """Refuse taxels so close to each other that one of them must be wrong."""
    real = np.flatnonzero([place.node for place in places])
    with content.value.refusing(SpecError):
        pairs = beside(surface.positions_m[real], surface.normals[real], OVERLAP * pitch_m)
    for first, second, distance_m in zip(*pairs, strict=True):
        place, other = places[real[second]], places[real[first]]
        raise place.value.refuse(
            f"{place.taxel} is {distance_m * 1e3:.3g} mm from {other.taxel}; less than a quarter "
            f"of the pitch of {pitch_m * 1e3:g} mm is a mistake"
        )
