# SPDX-License-Identifier: Apache-2.0

"""The panel of strips: the same copper so many times, in a frame that nothing touches."""

import math
import re
import shutil
from collections import Counter
from pathlib import Path

import pytest

from kicad import check_rules
from kicad_file import KicadFileError
from layout import Copper, nets, read_board, unconnected
from order import PANEL, STRIPS
from panel import GAP_MM, RAIL_MM, STRIP_TABS, TAB_MM, TABS, Outline, outline_of, panel, reference
from test.support.firmware import KICAD, needs_kicad

TEXTS = {strip: (KICAD / f"{strip}.kicad_pcb").read_text() for strip in STRIPS}
OUTLINES = {strip: outline_of(TEXTS[strip], TABS.get(strip, STRIP_TABS)) for strip in STRIPS}
LEAST_MM = {"strip": 0.7, "strip-four": 0.7, "strip-fast": 0.6}
"""From a tab to the next pad that is soldered; measured, so that no part comes nearer."""


@pytest.fixture(scope="module", params=STRIPS)
def file(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A panel, in a file that is named by its strip."""
    path = tmp_path_factory.mktemp("panel") / f"{request.param}.kicad_pcb"
    path.write_text(panel(TEXTS[request.param], OUTLINES[request.param], PANEL))
    return path


def test_every_strip_has_its_copper_and_none_is_joined_with_another(file: Path) -> None:
    one, copies = read_board(KICAD / file.name), read_board(file)
    assert unconnected(copies) == []
    assert nets(copies) == {
        frozenset((reference(name, number), pin) for name, pin in net)
        for number in range(PANEL)
        for net in nets(one)
    }

    def place(mm: float) -> int:
        """In µm, rounded where no coordinate ends."""
        return round(1e3 * mm + 0.3337)

    def pieces(copper: list[Copper], down: float) -> Counter[tuple]:
        return Counter(
            (item.kind, item.layers, *((place(x), place(y + down)) for x, y in item.points))
            for item in copper
        )

    pitch = OUTLINES[file.stem].pitch
    moved = sum((pieces(one, number * pitch) for number in range(PANEL)), Counter())
    assert pieces(copies, 0.0) == moved


def test_nothing_in_its_file_is_there_twice(file: Path) -> None:
    text = file.read_text()
    for kind in (r'\(uuid "([^"]+)"\)', r'"Reference" "([^"]+)"', r"(?m)^\t\(net (\d+)"):
        found = Counter(re.findall(kind, text))
        assert found and max(found.values()) == 1, kind


def loops(text: str) -> list[list[tuple[float, float]]]:
    """The closed lines of an outline."""
    pattern = r'\(gr_line \(start (\S+) (\S+)\) \(end (\S+) (\S+)\).*"Edge.Cuts"'
    ahead = {(x0, y0): (x1, y1) for x0, y0, x1, y1 in re.findall(pattern, text)}
    found = []
    while ahead:
        (begin, at), loop = ahead.popitem(), []
        loop.append(begin)
        while at != begin:
            loop.append(at)
            at = ahead.pop(at)
        found.append([(float(x), float(y)) for x, y in loop])
    return found


def area(loop: list[tuple[float, float]]) -> float:
    ends = [*loop[1:], loop[0]]
    return abs(sum(p[0] * q[1] - q[0] * p[1] for p, q in zip(loop, ends, strict=True))) / 2


def test_frame_boards_and_tabs_are_all_that_the_router_leaves(file: Path) -> None:
    """By areas, computed by hand: it would also go through a board, or leave a bridge."""
    found = sorted((area(loop) for loop in loops(file.read_text())), reverse=True)
    assert len(found) == 1 + 2 * PANEL + PANEL + 1  # rim; sides of each; above, between, below
    outline = OUTLINES[file.stem]
    width, height = outline.size(PANEL)
    inner = (width - 2 * RAIL_MM) * (height - 2 * RAIL_MM)
    board = (outline.right - outline.left) * (outline.bottom - outline.top)
    assert found[0] == pytest.approx(width * height)
    assert sum(found[1:]) == pytest.approx(inner - PANEL * (board + 4 * TAB_MM * GAP_MM))


@pytest.mark.parametrize(
    ("strip", "pads"), [("strip", 400), ("strip-four", 150), ("strip-fast", 400)]
)
def test_no_part_is_near_a_tab(strip: str, pads: int) -> None:
    board = OUTLINES[strip]
    tabs = [(board.left, at) for at in board.left_tabs] + [
        (board.right, at) for at in board.right_tabs
    ]
    copper = [i for i in read_board(KICAD / f"{strip}.kicad_pcb") if i.terminal]
    soldered = [i for i in copper if i.layers == {"B.Cu"} and i.terminal[0][0] not in "J"]
    assert len(soldered) > pads
    for x, y in tabs:
        for item in soldered:
            (px, py), reach = item.points[0], max(item.half)
            beside = max(abs(py - y) - TAB_MM / 2, 0.0)
            assert math.hypot(px - x, beside) - reach > LEAST_MM[strip], (x, y, item.terminal)


def test_a_board_that_is_no_rectangle_is_refused() -> None:
    with pytest.raises(KicadFileError, match="rectangle, not 3 lines"):
        text = TEXTS["strip"].replace('"Edge.Cuts")\n\t\t(uuid', '"F.SilkS")\n\t\t(uuid', 1)
        outline_of(text, STRIP_TABS)


def test_a_panel_is_as_large_as_its_boards_gaps_and_rails() -> None:
    board = Outline(0.0, 0.0, 40.0, 20.0, (5.0, 15.0), (5.0, 15.0))
    assert board.size(3) == (40 + 2 * 2 + 2 * 5, 3 * 20 + 4 * 2 + 2 * 5)


@needs_kicad
def test_kicads_rules_find_nothing_on_the_panel(file: Path) -> None:
    shutil.copy(KICAD / f"{file.stem}.kicad_pro", file.with_suffix(".kicad_pro"))
    check_rules(file.parent, file.stem)
