# SPDX-License-Identifier: Apache-2.0

"""Nodes whose value does not change while their neighbours' values do."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.places.layout import Layout
from tactile_cdma.places.layout_file import read_layout
from tactile_cdma.places.layout_nodes import Wiring
from tactile_cdma.readings.status import Status
from tactile_cdma.readings.stuck import LOOK_S, SWINGS, StuckNodes
from tactile_cdma.readings.taxels import Readings
from test.support.examples import examples

CONTACT_PA = 1e3
COUNT_PA = 100.0
SIDE = 6
GRID = Layout.grid(SIDE * SIDE, SIDE, SIDE, 0.007, 0.0055)
CYLINDER = read_layout(
    Path(__file__).resolve().parents[3] / "config" / "layouts" / "cylinder.yaml", Wiring()
)
INNER, EDGE, CORNER = SIDE + 1, 2, 0
SWING = (0.0, 30e3)  # Pa


class Skin:
    """Feeds a StuckNodes of this layout, look by look."""

    def __init__(self, layout: Layout = GRID) -> None:
        self.stuck = StuckNodes(layout)
        self.status = np.zeros(len(layout), dtype=np.uint8)
        self._t_s = 0.0

    def show(self, pressure_pa: np.ndarray, voltage_v: np.ndarray | None = None) -> list[int]:
        """Pressures in Pa; the nodes' words are these in counts unless given."""
        counts = np.rint(pressure_pa / COUNT_PA) if voltage_v is None else voltage_v
        readings = Readings(
            pressure_pa.astype(np.float32), counts.astype(np.float32), self.status.copy()
        )
        self._t_s += 1.01 * LOOK_S
        self.stuck.look(readings, self._t_s, CONTACT_PA)
        return self.stuck.nodes


def pressed(
    skin: Skin, taxels: int, held: dict[int, float], times: int, loads_pa: tuple[float, ...] = SWING
) -> list[int]:
    """The whole skin under one load after another, except for the taxels that do not change."""
    for number in range(times):
        pressure_pa = np.full(taxels, loads_pa[number % len(loads_pa)])
        for taxel, value in held.items():
            pressure_pa[taxel] = value
        skin.show(pressure_pa)
    return skin.stuck.nodes


@pytest.mark.parametrize("layout", [GRID, CYLINDER], ids=lambda layout: layout.name)
@pytest.mark.parametrize("value_pa", [0.0, 300.0, 45e3])
def test_a_node_that_never_moves_is_named_after_some_swings(
    layout: Layout, value_pa: float
) -> None:
    placed = np.flatnonzero(layout.nodes)
    taxel = int(placed[len(placed) // 2])
    skin = Skin(layout)
    assert pressed(skin, len(layout), {taxel: value_pa}, SWINGS) == []
    assert pressed(skin, len(layout), {taxel: value_pa}, 2) == [layout.nodes[taxel]]


@pytest.mark.parametrize("taxel", [INNER, EDGE, CORNER])
def test_a_stuck_node_is_found_at_any_place_with_any_value(taxel: int) -> None:
    loads_pa = (20e3, 60e3)  # a hand that rests there: never free
    assert pressed(Skin(), len(GRID), {taxel: 0.0}, 6, loads_pa) == [taxel + 1]
    assert pressed(Skin(), len(GRID), {taxel: 60e3}, 6, loads_pa) == [taxel + 1]


def test_two_side_by_side_are_found_and_no_sound_one_with_them() -> None:
    held = {INNER: 0.0, INNER + 3: 7e3, INNER + 4 * SIDE: 90e3}
    assert pressed(Skin(), len(GRID), held, 9) == sorted(taxel + 1 for taxel in held)
    beside = {INNER + SIDE + 1: 40e3, INNER + SIDE + 2: 50e3}
    assert pressed(Skin(), len(GRID), beside, 9, (20e3, 60e3)) == sorted(t + 1 for t in beside)


def test_a_change_of_one_count_clears_it() -> None:
    skin = Skin()
    assert pressed(skin, len(GRID), {INNER: 45e3}, 6)
    assert pressed(skin, len(GRID), {INNER: 45e3 + COUNT_PA}, 1) == []


def test_an_uncertain_word_is_no_movement() -> None:
    skin = Skin()
    assert pressed(skin, len(GRID), {INNER: 0.0}, 6)
    skin.status[INNER] = Status.LOW_SNR
    assert pressed(skin, len(GRID), {INNER: 12e3}, 1) == [INNER + 1]


def test_a_node_without_a_reading_is_not_stuck() -> None:
    assert pressed(Skin(), len(GRID), {INNER: np.nan}, 8) == []


def test_small_changes_around_say_nothing() -> None:
    assert pressed(Skin(), len(GRID), {INNER: 0.0}, 20, (2e3, 5e3)) == []


def test_too_few_neighbours_say_nothing() -> None:
    strip = Layout.grid(8, 1, 8, 0.007, 0.0055)
    assert pressed(Skin(strip), 8, {3: 0.0}, 8) == []


def test_a_node_beyond_its_range_is_named_only_if_it_stays_there() -> None:
    skin = Skin()
    skin.status[INNER] = Status.SATURATED
    assert pressed(skin, len(GRID), {INNER: 140e3}, 12, (60e3, 130e3)) == []
    assert pressed(skin, len(GRID), {INNER: 140e3}, 6) == [INNER + 1]


@examples(40)
@given(st.lists(st.sets(st.integers(0, SIDE * SIDE - 1)), min_size=1, max_size=6))
def test_what_neighbours_tell_does_not_depend_on_who_was_unreadable_before(
    unreadable: list[set[int]],
) -> None:
    rng = np.random.default_rng(len(unreadable))
    looks_pa = [rng.uniform(2e3, 40e3, len(GRID)) for _ in (*unreadable, None)]
    for pressure_pa, taxels in zip(looks_pa[1:], unreadable, strict=True):
        pressure_pa[list(taxels)] = np.nan
    old, fresh = Skin(), Skin()
    for pressure_pa in looks_pa:
        old.show(pressure_pa)
    fresh.show(looks_pa[-1])
    # A node that does not change while its neighbours do is reported.
    last_pa = np.where(np.arange(len(GRID)) % 7 == 0, looks_pa[-1], looks_pa[-1] + 1e3)
    for skin in (old, fresh):
        skin.show(last_pa)
    last = Readings(last_pa.astype(np.float32), last_pa.astype(np.float32), old.status)
    told_pa = [skin.stuck._expected(last, CONTACT_PA) for skin in (old, fresh)]
    np.testing.assert_array_equal(*told_pa)
    assert unreadable[-1] or np.isfinite(told_pa[0]).any()


@examples(60)
@given(
    st.lists(
        st.tuples(
            st.floats(-0.5, SIDE - 0.5),
            st.floats(-0.5, SIDE - 0.5),
            st.floats(0.8, 4.0),
            st.floats(5e3, 130e3),
        ),
        min_size=1,
        max_size=4,
    ),
    st.floats(0.5, 1.5),
)
def test_round_contacts_on_a_sound_skin_name_nobody(
    contacts: list[tuple[float, float, float, float]], power: float
) -> None:
    """They come and go at the same positions, with edges as steep as Hertz's and softer ones."""
    row, column = np.divmod(np.arange(len(GRID)), SIDE)
    fields = [
        peak * np.clip(1 - ((row - y) ** 2 + (column - x) ** 2) / radius**2, 0, None) ** power
        for x, y, radius, peak in contacts
    ]
    skin = Skin()
    for turn in range(4 * len(fields)):
        assert skin.show(fields[turn % len(fields)]) == []
        assert skin.show(np.zeros(len(GRID))) == []
