# SPDX-License-Identifier: Apache-2.0

"""Reads KiCad boards: which pads copper connects, without KiCad.

Two things of one net touch where the middle or an end of one lies in the copper of the other, as
these boards are drawn: a track ends in a pad, a via or on a track; a zone's filling, with its
spokes, reaches into its pads. test/firmware/test_boards.py compares the nets with the schematics'.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from kicad_file import Item, load
from netlist import Terminal

COPPER = ("F.Cu", "In1.Cu", "In2.Cu", "B.Cu")
NEAR_MM = 1e-3
"""Rounding of a board's file."""
Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Copper:
    """Is a piece of a net. points: ends, the middle of a pad or via, or an outline. mm.

    kind: pad, via, track or zone. half: half the width of a track; half the sides of a pad.
    terminal: of a pad.
    """

    kind: str
    net: str
    layers: frozenset[str]
    points: tuple[Point, ...]
    half: Point = (0.0, 0.0)
    turn: float = 0.0
    terminal: Terminal | None = None


def read_board(path: Path) -> list[Copper]:
    """Read all copper of a board that has a net. Raises KicadFileError."""
    tree = load(path)
    return [*_pads(tree), *_tracks(tree), *_zones(tree)]


def unconnected(copper: list[Copper]) -> list[tuple[str, list[set[Terminal]]]]:
    """List nets whose pads are not all connected, each with its parts."""
    found = []
    for net, items in _by_net(copper).items():
        parts = _parts(items)
        if len(parts) > 1:
            found.append((net, parts))
    return found


def nets(copper: list[Copper]) -> set[frozenset[Terminal]]:
    """Return pads by the net that the board says."""
    found: dict[str, set[Terminal]] = {}
    for item in copper:
        if item.terminal:
            found.setdefault(item.net, set()).add(item.terminal)
    return {frozenset(pads) for pads in found.values()}


def _by_net(copper: list[Copper]) -> dict[str, list[Copper]]:
    found: dict[str, list[Copper]] = {}
    for item in copper:
        found.setdefault(item.net, []).append(item)
    return found


def _parts(items: list[Copper]) -> list[set[Terminal]]:
    """Group the terminals of a net that are connected with each other."""
    above = list(range(len(items)))

    def root(i: int) -> int:
        while above[i] != i:
            above[i] = above[above[i]]
            i = above[i]
        return i

    for i, one in enumerate(items):
        for j in range(i):
            if root(i) != root(j) and one.layers & items[j].layers and _touch(one, items[j]):
                above[root(i)] = root(j)
    by_root: dict[int, set[Terminal]] = {}
    for i, item in enumerate(items):
        if item.terminal:
            by_root.setdefault(root(i), set()).add(item.terminal)
    merged: list[set[Terminal]] = []
    for part in by_root.values():  # pads of one number are one terminal
        same = [other for other in merged if other & part]
        merged = [other for other in merged if not other & part] + [part.union(*same)]
    return merged


def _touch(one: Copper, other: Copper) -> bool:
    if "zone" in (one.kind, other.kind):
        zone, item = (one, other) if one.kind == "zone" else (other, one)
        return any(_inside(p, zone.points) for p in item.points) or (
            item.kind == "pad" and any(_covers(item, p) for p in zone.points)
        )
    return any(_covers(one, p) for p in other.points) or any(_covers(other, p) for p in one.points)


def _covers(item: Copper, point: Point) -> bool:
    """Tell whether a point lies in a pad, a via or a track."""
    if item.kind == "zone":
        return _inside(point, item.points)
    if item.kind == "track":
        return _distance(point, *item.points) <= item.half[0] + NEAR_MM
    (x, y), turn = item.points[0], math.radians(item.turn)
    dx, dy = point[0] - x, point[1] - y
    across = abs(dx * math.cos(turn) - dy * math.sin(turn))
    along = abs(dx * math.sin(turn) + dy * math.cos(turn))
    if item.kind == "via":
        return math.hypot(dx, dy) <= item.half[0] + NEAR_MM
    return across <= item.half[0] + NEAR_MM and along <= item.half[1] + NEAR_MM


def _distance(point: Point, begin: Point, end: Point) -> float:
    """Return the distance from a point to a line's nearest one."""
    dx, dy = end[0] - begin[0], end[1] - begin[1]
    length = dx * dx + dy * dy
    share = ((point[0] - begin[0]) * dx + (point[1] - begin[1]) * dy) / length if length else 0.0
    share = min(max(share, 0.0), 1.0)
    return math.hypot(point[0] - begin[0] - share * dx, point[1] - begin[1] - share * dy)


def _inside(point: Point, outline: tuple[Point, ...]) -> bool:
    left, top, right, bottom = _box(outline)
    x, y = point
    if not (left <= x <= right and top <= y <= bottom):
        return False
    inside = False
    for (x0, y0), (x1, y1) in zip(outline, outline[1:] + outline[:1], strict=True):
        if (y0 > y) != (y1 > y) and x < x0 + (y - y0) / (y1 - y0) * (x1 - x0):
            inside = not inside
    return inside


@cache
def _box(outline: tuple[Point, ...]) -> tuple[float, float, float, float]:
    xs, ys = zip(*outline, strict=True)
    return min(xs), min(ys), max(xs), max(ys)


def _point(item: Item) -> Point:
    return item.number(), item.number(1)


def _turn(at: Item) -> float:
    """Return the turn of a place, degrees."""
    return at.number(2) if len(at.texts) > 2 else 0.0


def _outline(item: Item, points: Iterable[Point]) -> tuple[Point, ...]:
    outline = tuple(points)
    if len(outline) < 2:
        raise item.error("it has no outline")
    return outline


def _turned(middle: Point, offset: Point, turn: float) -> Point:
    """Turn a place that is off a middle with its part by an angle, rad."""
    (x, y), (dx, dy) = middle, offset
    cosine, sine = math.cos(turn), math.sin(turn)
    return x + dx * cosine + dy * sine, y - dx * sine + dy * cosine


def _layers(names: list[str]) -> frozenset[str]:
    """List the copper that "*.Cu" and names of layers stand for."""
    return frozenset(COPPER if "*.Cu" in names else (name for name in names if name in COPPER))


def _pads(tree: Item) -> Iterator[Copper]:
    for footprint in tree.all("footprint"):
        reference, at = footprint.field("Reference"), footprint.one("at")
        of_board = any("board_only" in attribute.texts for attribute in footprint.all("attr"))
        middle, turn = _point(at), math.radians(_turn(at))
        for pad in footprint.all("pad"):
            for net in pad.all("net"):
                # test points join copper, and are no part of the schematic
                terminal = None if of_board else (reference, pad.text())
                yield from _pad(pad, net.text(-1), terminal, middle, turn)


def _pad(
    pad: Item, net: str, terminal: Terminal | None, middle: Point, turn: float
) -> Iterator[Copper]:
    place = pad.one("at")
    at, own = _turned(middle, _point(place), turn), _turn(place)
    width, height = _point(pad.one("size"))
    layers = _layers(pad.one("layers").texts)
    yield Copper("pad", net, layers, (at,), (width / 2, height / 2), own, terminal)
    for primitives in pad.all("primitives"):  # of any shape: its box, about its middle
        left, top, right, bottom = _box(_outline(primitives, _places(primitives)))
        box, offset = (
            ((right - left) / 2, (bottom - top) / 2),
            ((left + right) / 2, (top + bottom) / 2),
        )
        centre = _turned(at, offset, math.radians(own))
        yield Copper("pad", net, layers, (centre,), box, own, terminal)


def _places(tree: Item) -> Iterator[Point]:
    """Yield every place in a drawing."""
    for item in tree.values:
        if isinstance(item, Item):
            if item.kind in ("xy", "start", "end", "center"):
                yield _point(item)
            else:
                yield from _places(item)


def _tracks(tree: Item) -> Iterator[Copper]:
    names = {net.text(): net.text(1) for net in tree.all("net")}
    for item in tree.all("segment"):
        points = (_point(item.one("start")), _point(item.one("end")))
        half, layers = item.one("width").number() / 2, _layers([item.one("layer").text()])
        yield Copper("track", _net(item, names), layers, points, (half, 0.0))
    for item in tree.all("via"):
        half, at = item.one("size").number() / 2, _point(item.one("at"))
        yield Copper("via", _net(item, names), frozenset(COPPER), (at,), (half, 0.0))


def _net(item: Item, names: dict[str, str]) -> str:
    number = item.one("net").text()
    if number not in names:
        raise item.error(f"there is no net {number}")
    return names[number]


def _zones(tree: Item) -> Iterator[Copper]:
    for zone in tree.all("zone"):
        net = zone.one("net_name").text()
        for filled in zone.all("filled_polygon"):
            points = _outline(filled, map(_point, filled.one("pts").all("xy")))
            yield Copper("zone", net, _layers([filled.one("layer").text()]), points)
