# SPDX-License-Identifier: Apache-2.0

"""Pictures of the readings: points, rasters, colours that eyes tell apart, curves, characters."""

import re
from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tactile_cdma.places.layout import Layout
from tactile_cdma.places.layout_shapes import sphere
from tactile_cdma.places.poses import Pose
from tactile_cdma.readings.status import Status
from tactile_cdma.views.cloud import BODY_POINT, POINT, Cloud
from tactile_cdma.views.heatmap import (
    NO_READING_RGB,
    NO_TAXEL_RGB,
    SCALE_RGB,
    colours,
    heatmap,
    pressure_raster,
    scale_steps,
)
from tactile_cdma.views.live import History
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

ROWS, COLUMNS, PITCH_M, MAX_PA = 3, 4, 7e-3, 140e3
COUNT = ROWS * COLUMNS
NODES = np.array([1, 2, 0, 3, 4, 5, 6, 7, 8, 9, 10, 11], dtype=np.int32)  # one place without
BALL = Layout(
    **vars(sphere(ROWS, COLUMNS, PITCH_M, 25e-3)),
    name="ball",
    rows=ROWS,
    columns=COLUMNS,
    nodes=NODES,
    pitch_m=PITCH_M,
)
FLAT = Layout.grid(12, 3, 4, PITCH_M, 5e-3)
HERE = Pose.of_rpy((0, 0, 0), (0, 0, 0))
triples = st.tuples(*[st.floats(-4, 4)] * 3)
pressures = arrays(np.float32, COUNT, elements=st.floats(-1e4, 3e5, width=32) | st.just(np.nan))


def patch(number: int = 0, pose: Pose = HERE) -> Cloud:
    return Cloud(pose.apply(FLAT.positions_m.astype(float)), pose.rotate(FLAT.normals), number)


def columns(points: np.ndarray, *names: str) -> np.ndarray:
    return np.stack([points[name] for name in names], axis=1)


@given(pressures)
def test_points_are_taxels_with_a_reading_in_the_heatmaps_colours(pressure_pa: np.ndarray) -> None:
    points = Cloud(BALL.positions_m, BALL.normals).points(pressure_pa, MAX_PA)
    taxels = points["taxel"]
    assert taxels.tolist() == np.flatnonzero(~np.isnan(pressure_pa)).tolist()
    assert np.array_equal(points["pressure"], pressure_pa[taxels])
    for letters, values in (
        (("x", "y", "z"), BALL.positions_m),
        (("normal_x", "normal_y", "normal_z"), BALL.normals),
    ):
        assert np.array_equal(columns(points, *letters), values[taxels])
    red_green_blue = np.stack([points["rgb"] >> shift & 255 for shift in (16, 8, 0)], axis=1)
    assert np.array_equal(red_green_blue, colours(pressure_pa, MAX_PA)[taxels])
    assert (points["rgb"] < 1 << 24).all()


def test_clouds_stay_as_they_are_when_the_next_is_made() -> None:
    cloud = Cloud(BALL.positions_m, BALL.normals)
    first = cloud.points(np.full(COUNT, 1e3, dtype=np.float32), MAX_PA)
    kept = first.copy()
    cloud.points(np.full(COUNT, 9e4, dtype=np.float32), MAX_PA)
    assert np.array_equal(first, kept)


@given(pressures)
def test_rasters_agree_with_the_heatmap_pixel_by_pixel(pressure_pa: np.ndarray) -> None:
    raster = pressure_raster(pressure_pa, BALL)
    picture = heatmap(pressure_pa, BALL, MAX_PA, pixels=1)
    assert raster.dtype == np.float32
    placed = BALL.raster >= 0
    assert np.isnan(raster[~placed]).all()
    assert not placed.all()
    assert np.array_equal(raster[placed], pressure_pa[BALL.raster[placed]], equal_nan=True)
    assert np.array_equal(colours(raster[placed], MAX_PA), picture[placed])


@given(st.lists(st.floats(-1e5, 1e6, width=32), min_size=2))
def test_more_pressure_is_never_a_lower_step(values: list[float]) -> None:
    steps = scale_steps(np.sort(np.array(values, dtype=np.float32)), MAX_PA)
    assert (np.diff(steps) >= 0).all()
    assert steps.min() >= 0
    assert steps.max() < len(SCALE_RGB) - 1


def test_points_are_those_of_the_patch_and_say_whose_they_are() -> None:
    pressure_pa = np.linspace(-1e3, 2e5, 12, dtype=np.float32)
    pressure_pa[[3, 7]] = np.nan
    points = patch(5).points(pressure_pa, 140e3)
    alone = Cloud(FLAT.positions_m, FLAT.normals).points(pressure_pa, 140e3)
    assert points.dtype == BODY_POINT
    assert POINT.names is not None
    for name in POINT.names:
        np.testing.assert_array_equal(points[name], alone[name])
    assert (points["patch"] == 5).all()
    assert points["taxel"].tolist() == [0, 1, 2, 4, 5, 6, 8, 9, 10, 11]


@given(triples, triples)
def test_normals_only_turn(
    xyz: tuple[float, float, float], rpy: tuple[float, float, float]
) -> None:
    pose = Pose.of_rpy(xyz, rpy)
    points = patch(0, pose).points(np.ones(12, dtype=np.float32), 1.0)
    places = FLAT.positions_m.astype(float) @ pose.rotation.T + xyz
    np.testing.assert_allclose(columns(points, "x", "y", "z"), places, atol=1e-5)
    normals = columns(points, "normal_x", "normal_y", "normal_z")
    np.testing.assert_allclose(normals, np.tile(pose.rotation[:, 2], (12, 1)), atol=1e-6)


TOP_PA = 140e3
LUMA = np.array([0.2126, 0.7152, 0.0722])
"""Of red, green and blue, ITU-R BT.709: what a picture in grey keeps."""


def luma(pressure_kpa: list[float], gamma: float | None = None) -> np.ndarray:
    """Of each pressure's colour, as shares of the way from zero's to the top's."""
    pressure_pa = np.array([0.0, TOP_PA / 1e3, *pressure_kpa], np.float32) * np.float32(1e3)
    options = {} if gamma is None else {"gamma": gamma}
    dark, light, *others = colours(pressure_pa, TOP_PA, **options) @ LUMA
    return (np.array(others) - dark) / (light - dark)


def test_light_and_firm_touches_are_told_apart_without_any_setting() -> None:
    two, five, hundred = luma([2.0, 5.0, 100.0])
    assert two >= 0.1
    assert five - two >= 0.05
    assert hundred <= 0.9


@pytest.mark.parametrize("gamma", [0.3, 0.5, 1.0])
def test_luma_is_a_power_of_the_pressure(gamma: float) -> None:
    pressures = [1.0, 2.0, 5.0, 20.0, 70.0, 120.0]
    expected = (np.array(pressures) * 1e3 / TOP_PA) ** gamma
    assert luma(pressures, gamma) == pytest.approx(expected, abs=0.015)


def test_no_pressure_looks_like_no_reading() -> None:
    """Nor do the pale colours of uncertain readings, which keep half of the difference."""
    scale, pale = SCALE_RGB[:256].astype(float), SCALE_RGB[257:].astype(float)
    for colour in (NO_READING_RGB, NO_TAXEL_RGB):
        assert np.linalg.norm(scale - colour, axis=1).min() > 20
    assert np.linalg.norm(pale - NO_READING_RGB, axis=1).min() > 20
    assert scale_steps(np.array([np.nan], np.float32), TOP_PA, gamma=0.1) == 256


def test_lines_are_drawn_between_taxels_and_nowhere_else() -> None:
    grid = Layout.grid(6, 2, 3, 7e-3, 5e-3)
    picture = heatmap(np.full(6, TOP_PA, np.float32), grid, TOP_PA, pixels=32)
    assert picture.shape == (64, 96, 3)
    line = (picture == NO_TAXEL_RGB).all(axis=2)
    assert np.flatnonzero(line.all(axis=1)).tolist() == [31]
    assert np.flatnonzero(line.all(axis=0)).tolist() == [31, 63]
    assert np.count_nonzero(line) == 96 + 2 * 64 - 2
    assert (picture[~line] == SCALE_RGB[255]).all()
    assert not (heatmap(np.zeros(6, np.float32), grid, TOP_PA, 7) == NO_TAXEL_RGB).all(axis=2).any()


def test_bins_keep_the_greatest_of_their_time_and_forget_what_is_old() -> None:
    history = History(span_s=4.0)
    for now_s, value in ((0.0, 99.0), (6.5, 1.0), (7.1, 5.0), (7.2, 2.0), (9.9, 3.0)):
        history.add(now_s, value)
    history.add(10.0, float("nan"))
    np.testing.assert_array_equal(history.bins(10.0, 4), [1.0, 5.0, np.nan, 3.0])
    np.testing.assert_array_equal(history.bins(12.0, 4), [np.nan, 3.0, np.nan, np.nan])


def test_a_history_of_nothing_is_unknown() -> None:
    history = History(span_s=1.0)
    assert np.isnan(history.bins(5.0, 3)).all()
    assert np.isnan(history.latest)
    history.add(4.0, 7.0)
    assert history.latest == 7.0
    history.add(5.5, float("nan"))
    assert np.isnan(history.latest), "not the last that was known"
    assert np.isnan(history.bins(5.5, 3)).all()


def test_colours_rise_with_pressure_on_a_fixed_scale() -> None:
    pressure = np.array([-1, 0, 30e3, 70e3, 140e3, 1e9], np.float32)
    light = colours(pressure, 140e3).astype(int).sum(axis=1)
    assert light[0] == light[1]
    assert light[4] == light[5]
    assert (np.diff(light[1:5]) > 0).all()
    assert tuple(colours(np.array([np.nan], np.float32), 1.0)[0]) == NO_READING_RGB
    pale = colours(pressure, 140e3, unsure=np.ones(len(pressure), bool)).astype(int)
    middle = (colours(pressure, 140e3) + np.array(NO_READING_RGB)) / 2
    assert np.abs(pale - middle).max() <= 1
    assert tuple(colours(np.array([np.nan], np.float32), 1.0, unsure=True)[0]) == NO_READING_RGB


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


def test_cells_have_the_colours_of_the_heatmap_or_its_shades() -> None:
    reading = grid(2, 2, [0.0, 70.0, 140.0, np.nan])
    [first, *_, last] = picture(reading, COLOURED, 16, 4)
    red, green, blue = colours(reading.pressure_pa, 140e3).T
    for i, line in ((0, first), (1, first), (2, last), (3, last)):
        assert f";48;2;{red[i]};{green[i]};{blue[i]}m" in line
    assert first.endswith("\x1b[0m")
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
    grid_of_6 = Layout.grid(6, 1, 6, 0.01, 0.01)
    ring = replace(
        grid_of_6, flat_m=flat_m, positions_m=np.pad(flat_m, ((0, 0), (0, 1))), irregular=True
    )
    values_pa = np.arange(11, 17).astype(np.float32) * 1e3
    reading = Reading(values_pa, np.zeros(6, np.uint8), ring.raster, ring.nodes)
    lines = plain(picture(reading, COLOURED, 80, 18))
    said = [f"{11 + i}.0" for i in range(6)]
    at = [next((y, x.index(each)) for y, x in enumerate(lines) if each in x) for each in said]
    for i, j in permutations(range(6), 2):
        if flat_m[i, 0] > flat_m[j, 0] + 1e-3:
            assert at[i][1] > at[j][1], "to the right is to the right"
        if flat_m[i, 1] > flat_m[j, 1] + 1e-3:
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
