# SPDX-License-Identifier: Apache-2.0

"""The skin in characters: essentials stay visible, and no line exceeds the terminal."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.places.layout import Layout
from tactile_cdma.readings.status import Status
from tactile_cdma.views.heatmap import colours
from tactile_cdma.views.terminal import (
    Look,
    Numbers,
    Reading,
    picture,
    pooled,
    ranges,
    scale,
    screen,
    sparkline,
    status_lines,
)
from test.support.examples import examples

ESCAPES = re.compile(r"\x1b\[[0-9;]*m")
COLOURED, PLAIN = Look(140e3), Look(140e3, coloured=False, unicode=False)


def plain(lines: list[str]) -> list[str]:
    return [ESCAPES.sub("", line) for line in lines]


def grid(rows: int, columns: int, pressure_kpa: object = 0.0, status: object = 0) -> Reading:
    taxels = rows * columns
    return Reading(
        np.broadcast_to(np.float32(pressure_kpa) * 1000, taxels).astype(np.float32),
        np.broadcast_to(np.uint8(status), taxels).astype(np.uint8),
        np.arange(taxels, dtype=np.int32).reshape(rows, columns),
        np.arange(taxels, 0, -1).astype(np.int32),  # node numbers differ from taxel indices
    )


@given(
    rows=st.integers(1, 70),
    cells=st.integers(1, 70),
    columns=st.integers(1, 240),
    lines=st.integers(1, 80),
    look=st.sampled_from([COLOURED, PLAIN, Look(1e3, Numbers.NODES)]),
    seed=st.integers(0, 99),
)
@examples(60)
def test_a_screen_never_exceeds_its_terminal(
    rows: int, cells: int, columns: int, lines: int, look: Look, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    pressure_kpa = rng.choice([np.nan, -3.0, 0.04, 57.25, 140.0, 1234.5], rows * cells)
    reading = grid(rows, cells, pressure_kpa, rng.integers(0, 256, rows * cells))
    notes = [scale(look, columns), *status_lines(reading, look, columns), "a note " * 20]
    drawn = plain(screen(reading, look, "a title " * 20, notes, columns, lines))
    assert len(drawn) <= lines
    assert max(map(len, drawn)) <= columns
    if not look.coloured:
        assert all(line.isascii() and line.isprintable() for line in drawn)


def test_80_by_24_shows_values_marks_and_every_note_of_a_small_skin() -> None:
    pressure_kpa = np.linspace(0, 30, 16)
    pressure_kpa[5] = np.nan
    status = np.zeros(16, dtype=np.uint8)
    status[[5, 6, 7]] = Status.STALE, Status.SATURATED, Status.LOW_SNR | Status.WEAK
    notes = [f"note {i}" for i in range(7)]
    text = "\n".join(
        plain(screen(grid(4, 4, pressure_kpa, status), COLOURED, "title", notes, 80, 24))
    )
    for i in set(range(16)) - {5}:
        assert f" {pressure_kpa[i]:.1f}" in text
    assert "12.0!" in text and "14.0?w" in text and "--" in text
    assert all(note in text for note in ["title", *notes])


@pytest.mark.parametrize(
    ("numbers", "shown"), [(Numbers.TAXELS, range(12)), (Numbers.NODES, range(1, 13))]
)
def test_numbers_of_taxels_or_nodes_stand_in_their_cells(numbers: Numbers, shown: range) -> None:
    lines = plain(picture(grid(3, 4, 5.0), Look(140e3, numbers), 80, 12))
    found = [int(text) for line in lines for text in line.split() if text.isdigit()]
    assert sorted(found) == list(shown)
    assert found == (list(shown) if numbers is Numbers.TAXELS else list(shown)[::-1])
    assert " ".join(lines).count("5.0") == 12, "beside the values"


def test_cells_have_the_colours_of_the_heatmap() -> None:
    reading = grid(2, 2, [0.0, 70.0, 140.0, np.nan])
    [first, *_, last] = picture(reading, COLOURED, 16, 4)
    red, green, blue = colours(reading.pressure_pa, 140e3).T
    for i, line in ((0, first), (1, first), (2, last), (3, last)):
        assert f";48;2;{red[i]};{green[i]};{blue[i]}m" in line
    assert first.endswith("\x1b[0m")


def test_without_colours_harder_pressed_is_darker() -> None:
    reading = grid(1, 5, [0.0, 30.0, 60.0, 90.0, 139.0], Status.MASKED)  # masked: no label
    [line] = picture(reading, PLAIN, 5, 1)
    shades = [" .:-=+*#%@".index(cell) for cell in line]
    assert shades == sorted(set(shades)) and shades[0] == 0 and shades[-1] == 9


@given(
    rows=st.integers(1, 40),
    cells=st.integers(1, 40),
    columns=st.integers(1, 20),
    lines=st.integers(1, 20),
    pressed=st.integers(0, 1599),
)
def test_of_a_skin_too_large_the_taxel_pressed_most_is_still_seen(
    rows: int, cells: int, columns: int, lines: int, pressed: int
) -> None:
    pressure_kpa = np.zeros(rows * cells)
    pressure_kpa[::2] = np.nan
    pressure_kpa[pressed % len(pressure_kpa)] = 9.0
    drawn = pooled(grid(rows, cells, pressure_kpa), columns, lines)
    assert drawn.shape[0] <= lines and drawn.shape[1] <= columns
    assert pressed % len(pressure_kpa) in drawn


def test_of_a_skin_too_large_a_taxel_without_a_reading_is_seen_where_nothing_is_pressed() -> None:
    pressure_kpa, status = np.full(16, 0.4), np.zeros(16, dtype=np.uint8)
    pressure_kpa[[1, 7, 8, 9]] = np.nan
    pressure_kpa[6] = 5.0
    status[9] = Status.MASKED
    drawn = pooled(grid(4, 4, pressure_kpa, status), 2, 2)
    assert drawn[0].tolist() == [1, 6], "unread, pressed"
    assert drawn[1, 0] == 8, "unread rather than masked"


@pytest.mark.parametrize("look", [COLOURED, PLAIN])
@pytest.mark.parametrize("size", [(80, 12), (4, 4), (2, 2)])
def test_a_skin_without_readings_does_not_look_untouched(look: Look, size: tuple[int, int]) -> None:
    nothing = picture(grid(4, 4, np.nan, Status.STALE), look, *size)
    untouched = picture(grid(4, 4, 0.0), look, *size)
    assert len(nothing) == len(untouched)
    assert all(a != b for a, b in zip(nothing, untouched, strict=True))
    if not look.coloured:
        assert not any(" " in line for line in nothing), "no cell looks like one that reads 0"


def test_an_irregular_skin_is_drawn_as_it_lies() -> None:
    angle = np.linspace(0, 2 * np.pi, 7)[:-1]
    flat_m = (np.stack([np.cos(angle), np.sin(angle)], axis=1) * 0.01).astype(np.float32)
    ring = Layout(
        flat_m,
        np.pad(flat_m, ((0, 0), (0, 1))),
        np.tile(np.float32([0, 0, 1]), (6, 1)),
        np.full(6, 1e-4, np.float32),
        name="ring",
        rows=1,
        columns=6,
        nodes=np.arange(1, 7, dtype=np.int32),
        pitch_m=0.01,
        irregular=True,
    )
    reading = Reading(
        np.arange(11, 17).astype(np.float32) * 1e3, np.zeros(6, np.uint8), ring.raster, ring.nodes
    )
    lines = plain(picture(reading, COLOURED, 80, 18))
    at = {
        i: next(
            (y, line.index(f"{11 + i}.0")) for y, line in enumerate(lines) if f"{11 + i}.0" in line
        )
        for i in range(6)
    }
    for (i, a), (j, b) in [
        ((i, a), (j, b)) for i, a in enumerate(flat_m) for j, b in enumerate(flat_m)
    ]:
        if a[0] > b[0] + 1e-3:
            assert at[i][1] > at[j][1], "to the right is to the right"
        if a[1] > b[1] + 1e-3:
            assert at[i][0] < at[j][0], "up is up"


def test_statuses_are_listed_by_taxel_or_node() -> None:
    status = np.zeros(9, dtype=np.uint8)
    status[[0, 1, 2, 4]] = Status.SILENT
    status[8] = Status.STALE | Status.SILENT
    status[7] = Status.MASKED
    reading = grid(3, 3, 0.0, status)
    [line] = status_lines(reading, COLOURED, 200)
    assert line == "taxels   speaking 3   stale -: 8   silent: 0-2, 4, 8   masked: 7"
    [line] = status_lines(reading, Look(140e3, Numbers.NODES), 200)
    assert line == "nodes   speaking 3   stale -: 1   silent: 1, 5, 7-9   masked: 2"


@given(st.sets(st.integers(0, 300), min_size=1))
def test_ranges_say_the_numbers_they_were_made_of(numbers: set[int]) -> None:
    said: set[int] = set()
    for part in ranges(np.array(sorted(numbers))).split(", "):
        first, _, last = part.partition("-")
        said |= set(range(int(first), int(last or first) + 1))
    assert said == numbers


@given(st.lists(st.one_of(st.just(np.nan), st.floats(0, 1e6)), min_size=1, max_size=60))
def test_a_sparkline_rises_where_its_values_do(values: list[float]) -> None:
    line = sparkline(np.array(values), unicode=True)
    assert len(line) == len(values)
    known = [(v, bar) for v, bar in zip(values, line, strict=True) if not np.isnan(v)]
    assert all(bar == " " for v, bar in zip(values, line, strict=True) if np.isnan(v))
    for (a, low), (b, high) in zip(sorted(known), sorted(known)[1:], strict=False):
        assert a == b or low <= high
    if known and max(known)[0] > 0:
        assert max(known)[1] == "█"


def test_the_scale_names_its_ends_or_is_left_out() -> None:
    assert plain([scale(COLOURED, 80)])[0].split() == ["0", "35", "140", "kPa", "x→", "y↑"]
    for columns in range(80):
        assert len(plain([scale(COLOURED, columns)])[0]) <= columns
    assert scale(COLOURED, 8) == ""
