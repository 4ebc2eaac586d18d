# SPDX-License-Identifier: Apache-2.0

"""Puts strips into a frame, as assemblers take them: rails, fiducials, tabs that break off.

Strips lie one below the other and hang in the frame by their ends, at tabs where no part is near;
between them a router goes. Holes along a tab let it break outside of the board. Every strip keeps
its copper; its parts are numbered R101-1, R101-2, …, and so are its nets.
"""

from __future__ import annotations

import re
import uuid
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from kicad_file import KicadFileError

GAP_MM, RAIL_MM = 2.0, 5.0
"""Width of the router's way, and of the frame. Chosen: what assemblers ask for."""
HOLES_MM = (-0.8, 0.0, 0.8)
HOLE_MM, TAB_MM = 0.5, 2.4
"""Places of a tab's holes along it, their diameter, and the tab's width."""
OFF_MM = 0.25
"""From the board's edge to the middle of a hole: what stays does not reach over the edge."""
TOOLING_MM, FIDUCIAL_MM = 2.0, 1.0
Point = tuple[float, float]
Span = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Outline:
    """Is a board's outline, and where its tabs are at its left and right end, mm."""

    left: float
    top: float
    right: float
    bottom: float
    left_tabs: tuple[float, float]
    right_tabs: tuple[float, float]

    @property
    def pitch(self) -> float:
        """Return the distance from a board to the next one."""
        return self.bottom - self.top + GAP_MM

    def size(self, count: int) -> Point:
        """Return width and height of a panel."""
        around = 2 * (GAP_MM + RAIL_MM)
        return self.right - self.left + around, count * self.pitch - GAP_MM + around


STRIP_TABS = ((7.0, 13.0), (7.2, 18.4))
"""Middles of a strip's tabs at its connectors' end and at the other one, mm from its origin."""
TABS = {"strip-fast": ((7.0, 13.0), (11.6, 17.6))}
"""Tabs of strips that have parts at the usual ones."""


def outline_of(layout: str, tabs: tuple[tuple[float, float], tuple[float, float]]) -> Outline:
    """Read the outline of a board, which is a rectangle. Raises KicadFileError."""
    edges = [item for item in _items(layout) if _is_edge(item)]
    points = [tuple(map(float, p)) for item in edges for p in _ENDS.findall(item)]
    if len(edges) != 4 or len(set(points)) != 4:
        raise KicadFileError(f"a board of a panel has to be a rectangle, not {len(edges)} lines")
    xs, ys = zip(*points, strict=True)
    return Outline(min(xs), min(ys), max(xs), max(ys), *tabs)


def panel(layout: str, board: Outline, count: int) -> str:
    """Write a panel of so many boards below each other, as KiCad's file."""
    items = [*_items(layout)]
    head = [item for item in items if not _COPIED.match(item)]
    nets = [
        item for item in items if item.startswith("\t(net ") and not item.startswith("\t(net 0 ")
    ]
    rest = [item for item in items if _COPIED.match(item) and item not in nets]
    body = [
        _copied(item, number, len(nets), number * board.pitch)
        for number in range(count)
        for item in (*nets, *(item for item in rest if not _is_edge(item)))
    ]
    nets_first = sorted(body, key=lambda item: not item.startswith("\t(net "))
    own = [*_outline(board, count), *_holes(board, count), *_marks(board, count)]
    return "\n".join(["(kicad_pcb", *head, *nets_first, *own, ")", ""])


def reference(name: str, number: int) -> str:
    """Name a part of a board on a panel, counted from 0."""
    return f"{name}-{number + 1}"


_COPIED = re.compile(r"\t\((net (?!0 )|footprint|segment|via|zone|gr_)")
_ENDS = re.compile(r"\((?:start|end) ([-\d.]+) ([-\d.]+)\)")
_PLACE = re.compile(r"\((at|start|end|center|mid|xy) ([-\d.]+) ([-\d.]+)")
_OWN_PLACE = re.compile(r"(?m)^(\t\t\(at [-\d.]+) ([-\d.]+)")


def _items(layout: str) -> Iterator[str]:
    """Yield what a layout consists of, as KiCad indents it."""
    yield from re.findall(r"(?ms)^\t\(.*?(?<=\))$(?=\n\t\(|\n\))", layout)


def _is_edge(item: str) -> bool:
    return item.startswith("\t(gr_line") and '"Edge.Cuts"' in item


def _copied(item: str, number: int, nets: int, down: float) -> str:
    """Move an item, and tell its nets, its parts and itself from those of other copies."""

    def net(match: re.Match[str]) -> str:
        index = int(match[1])
        return f"(net {index + number * nets if index else 0}"

    item = re.sub(r"\(net (\d+)", net, item)
    item = re.sub(r'(\(net \d+ "|\(net_name ")(?=[^"])', rf"\g<1>{number + 1}:", item)
    item = re.sub(r'\(uuid "([^"]+)"\)', lambda m: _uuid(f"{m[1]} {number}"), item)
    if item.startswith("\t(footprint"):
        item = re.sub(
            r'\(property "Reference" "([^"]+)"',
            lambda m: f'(property "Reference" "{reference(m[1], number)}"',
            item,
        )
        return _OWN_PLACE.sub(lambda m: f"{m[1]} {float(m[2]) + down:.9g}", item, count=1)
    return _PLACE.sub(lambda m: f"({m[1]} {m[2]} {float(m[3]) + down:.9g}", item)


def _uuid(what: str) -> str:
    return f'(uuid "{uuid.uuid5(uuid.NAMESPACE_OID, what)}")'


def _outline(board: Outline, count: int) -> Iterator[str]:
    """Yield the panel's rim, and the router's ways between tabs."""
    left, right = board.left - GAP_MM, board.right + GAP_MM
    top, bottom = board.top - GAP_MM, board.top + count * board.pitch
    rim = left - RAIL_MM, top - RAIL_MM, right + RAIL_MM, bottom + RAIL_MM
    yield from _closed(_rectangle(*rim))
    half, begins = TAB_MM / 2, [number * board.pitch for number in range(count)]
    sides = ((left, board.left, board.left_tabs), (board.right, right, board.right_tabs))
    for down in begins:
        for outer, inner, (first, last) in sides:
            yield from _closed(_rectangle(outer, down + first + half, inner, down + last - half))
    for number in range(count + 1):
        above, below = (number - 1) * board.pitch, number * board.pitch
        gap = board.top + below - GAP_MM, board.top + below
        spans = [
            (
                above + last + half if number else gap[0],
                below + first - half if number < count else gap[1],
            )
            for _, _, (first, last) in sides
        ]
        yield from _closed(_way(left, board.left, board.right, right, gap, spans))


def _way(
    left: float, begin: float, end: float, right: float, gap: Span, spans: list[Span]
) -> list[Point]:
    """Draw the way between two boards, with its ends along theirs."""
    (a, b), (c, d), (y0, y1) = *spans, gap
    upper = [(left, a), (begin, a), (begin, y0), (end, y0), (end, c), (right, c)]
    lower = [(right, d), (end, d), (end, y1), (begin, y1), (begin, b), (left, b)]
    return [
        p for p, q in zip(upper + lower, [*(upper + lower)[1:], upper[0]], strict=True) if p != q
    ]


def _rectangle(left: float, top: float, right: float, bottom: float) -> list[Point]:
    return [(left, top), (right, top), (right, bottom), (left, bottom)]


def _closed(points: list[Point]) -> Iterator[str]:
    for (x0, y0), (x1, y1) in zip(points, points[1:] + points[:1], strict=True):
        yield (
            f"\t(gr_line (start {x0:.6g} {y0:.6g}) (end {x1:.6g} {y1:.6g}) (stroke (width 0.05) "
            f'(type default)) (layer "Edge.Cuts") {_uuid(f"edge {x0} {y0} {x1} {y1}")})'
        )


def _holes(board: Outline, count: int) -> Iterator[str]:
    """Yield the holes of all tabs, and those for the assembler's pins."""
    places = [
        (x, number * board.pitch + tab + along)
        for number in range(count)
        for x, tabs in (
            (board.left - OFF_MM, board.left_tabs),
            (board.right + OFF_MM, board.right_tabs),
        )
        for tab in tabs
        for along in HOLES_MM
    ]
    yield _part("tabs", _hole(places, HOLE_MM))
    yield _part("tooling", _hole(_corners(board, count, RAIL_MM / 2), TOOLING_MM))


def _marks(board: Outline, count: int) -> Iterator[str]:
    """Yield three fiducials on either side of the rails, not symmetrical to any turn."""
    corners = _corners(board, count, RAIL_MM / 2)
    places = [(x + (5.0 if x < 0 else -5.0), y) for x, y in corners[:3]]
    for side in "FB":
        pads = [
            f'(pad "" smd circle (at {x:.6g} {y:.6g}) (size {FIDUCIAL_MM:g} {FIDUCIAL_MM:g}) '
            f'(layers "{side}.Cu" "{side}.Mask") (solder_mask_margin 0.5) '
            f"{_uuid(f'{side} {x} {y}')})"
            for x, y in places
        ]
        yield _part(f"fiducials {side}", pads, side)


def _corners(board: Outline, count: int, inside: float) -> list[Point]:
    """Return places in the rails' corners: both upper ones, then the lower ones."""
    left, right = board.left - GAP_MM - RAIL_MM + inside, board.right + GAP_MM + RAIL_MM - inside
    top = board.top - GAP_MM - RAIL_MM + inside
    bottom = board.top + count * board.pitch + RAIL_MM - inside
    return [(left, top), (right, top), (left, bottom), (right, bottom)]


def _hole(places: Iterable[Point], size: float) -> list[str]:
    return [
        f'(pad "" np_thru_hole circle (at {x:.6g} {y:.6g}) (size {size:g} {size:g}) '
        f'(drill {size:g}) (layers "*.Cu" "*.Mask") {_uuid(f"hole {x} {y}")})'
        for x, y in places
    ]


def _part(name: str, pads: list[str], side: str = "F") -> str:
    """Write a footprint at the origin that is the panel's own."""
    font = "(effects (font (size 1 1) (thickness 0.15)))"
    hidden = f'(at 0 0 0) (layer "{side}.Fab") (hide yes)'
    fields = [
        f'(property "{field}" "{name}" {hidden} {_uuid(f"{name} {field}")} {font})'
        for field in ("Reference", "Value")
    ]
    attributes = "(attr board_only exclude_from_pos_files exclude_from_bom)"
    head = f'\t(footprint "panel:{name}" (layer "{side}.Cu") {_uuid(name)} (at 0 0)'
    return "\n\t\t".join([head, *fields, attributes, *pads]) + "\n\t)"
