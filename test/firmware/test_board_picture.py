# SPDX-License-Identifier: Apache-2.0

"""The picture of digitizer and strip shows pads where the layouts have them."""

import math
import re

from layout import Copper, read_board
from test.support.firmware import FIRMWARE, KICAD

PICTURE = (FIRMWARE.parent / "docs" / "img" / "boards.svg").read_text(encoding="utf-8")
NEAR_MM = 1.0
"""A reader finds a pad that far away."""
HALF_MM = 1.2
"""Half the side of a square that stands for a part."""


def shown(kind: str) -> list[tuple[str, float, float]]:
    """Return names and places, mm from the origin of their board: of squares the corner."""
    found = re.findall(rf'data-{kind}="([^"]+)" c?x="([-\d.]+)" c?y="([-\d.]+)"', PICTURE)
    return [(name, float(x), float(y)) for name, x, y in found]


def pads(board: str) -> list[Copper]:
    return [c for c in read_board(KICAD / f"{board}.kicad_pcb") if c.kind == "pad"]


def test_test_points_of_the_digitizer_are_where_the_picture_shows_them() -> None:
    points = [(pad.net, *pad.points[0]) for pad in pads("digitizer") if pad.terminal is None]
    assert {net for net, *_ in shown("net")} == {"/LINE", "/HALF", "/PULL", "GND", "+3V3", "+5V"}
    for net, x, y in shown("net"):
        assert min(math.dist((x, y), place) for own, *place in points if own == net) < NEAR_MM, net


def test_parts_to_look_at_are_where_the_picture_shows_them() -> None:
    assert {part for part, *_ in shown("part")} == {"U1", "U3", "Q1", "D1", "D2", "F1"}
    for part, left, top in shown("part"):
        places = [p.points[0] for p in pads("digitizer") if p.terminal and p.terminal[0] == part]
        middle = [(min(each) + max(each)) / 2 for each in zip(*places, strict=True)]
        assert math.dist(middle, (left + HALF_MM, top + HALF_MM)) < NEAR_MM, part


def test_pads_to_flash_are_where_the_picture_shows_them() -> None:
    places = {pad.terminal: pad.points[0] for pad in pads("strip")}
    assert len(shown("pad")) == 8 * 6
    for name, x, y in shown("pad"):
        assert math.dist((x, y), places[tuple(name.split("."))]) < 0.1, name


def test_enlarged_pads_are_in_the_order_of_the_layout() -> None:
    """Seen from the parts, which are on the lower side: rows from top to bottom, mirrored."""
    drawn = re.findall(r'class="s" x="([\d.]+)" y="([\d.]+)" [^>]*>(\w[\w. ]*)</text>', PICTURE)
    signals = {"3.3 V": "+3V3", "ground": "GND"}
    names = ("MOSI", "MISO", "SCK", "RESET", *signals)
    at = [(float(y), float(x), name) for x, y, name in drawn if name in names]
    for node, inset in ((1, [a for a in at if a[1] < 700]), (5, [a for a in at if a[1] > 700])):
        own = [pad for pad in pads("strip") if pad.terminal and pad.terminal[0] == f"J{node}02"]
        rows = sorted(own, key=lambda pad: (round(pad.points[0][1], 1), -pad.points[0][0]))
        nets = [pad.net.rpartition("/")[2] for pad in rows]
        assert [signals.get(name, name) for _, _, name in sorted(inset)] == nets
