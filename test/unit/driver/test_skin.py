# SPDX-License-Identifier: Apache-2.0

"""Layout, taxel state, heatmap colours."""

from dataclasses import replace

import numpy as np
import pytest

from tactile_cdma.base.errors import SpecError
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.places.layout import Layout
from tactile_cdma.readings.status import Status
from tactile_cdma.readings.taxels import Taxels
from tactile_cdma.views.heatmap import NO_READING_RGB, colours, heatmap
from tactile_cdma.words.health import NodeHealth
from tactile_cdma.words.words import Words, silent

SPEC = FrameSpec(nodes=4)
HEALTH = NodeHealth(SPEC)


def words(codes: dict[int, int], doubtful: tuple[int, ...] = ()) -> Words:
    quiet = silent(SPEC.nodes, 0.0)
    active, values, doubt = quiet.active.copy(), quiet.codes.copy(), quiet.doubtful.copy()
    for node, code in codes.items():
        active[node], values[node] = True, code
    doubt[list(doubtful)] = True
    return replace(quiet, active=active, codes=values, doubtful=doubt)


def taxels() -> Taxels:
    return Pipeline(SkinConfig.of({"nodes": 4, "stale_after_s": 1.0})).taxels


def test_taxels_never_heard_have_no_reading() -> None:
    readings = taxels().update(silent(SPEC.nodes, 0.0), 0.0, HEALTH)
    assert np.isnan(readings.pressure_pa).all()
    assert (readings.status == Status.SILENT | Status.STALE).all()


def test_a_silent_taxel_holds_its_value_until_it_is_stale() -> None:
    skin = taxels()
    first = skin.update(words({1: 800}), 10.0, HEALTH)
    held = skin.update(words({2: 900}), 10.9, HEALTH)
    stale = skin.update(words({2: 900}), 11.1, HEALTH)
    assert first.status[1] == Status.OK
    assert held.status[1] == Status.SILENT
    assert held.pressure_pa[1] == first.pressure_pa[1] > 0
    assert stale.status[1] == Status.SILENT | Status.STALE
    assert np.isnan(stale.pressure_pa[1])
    assert not np.isnan(stale.pressure_pa[2])


@pytest.mark.parametrize("quiet", [False, True])
def test_a_dead_node_is_in_service_again_when_it_speaks(quiet: bool) -> None:
    """Node 3 is dead from 1.0 to 6.0 s, so stale from 2.0 s on, and retired from 3.0 s on.

    quiet: others speak at their heartbeats only, and frames between are read as silent ones.
    """
    skin, found = taxels(), []
    skin.dead_share = 0.25
    for number in range(100):
        now_s = 0.1 * number
        if quiet and number % 5:
            read = skin.update_silent(silent(SPEC.nodes, 0.0), now_s, HEALTH)
        else:
            alive = {0: 800, 1: 800, 3: 800} | ({} if 10 < number < 60 else {2: 800})
            read = skin.update(words(alive), now_s, HEALTH)
        found.append((read.coverage(1e3).valid, read.coverage(1e3).in_service, skin.retired))
    assert found[:20] == [(4, 4, [])] * 20
    assert found[22:30] == [(3, 4, [])] * 8
    assert found[32:60] == [(3, 3, [3])] * 28
    assert found[60:] == [(4, 4, [])] * 40


def test_more_dead_nodes_than_are_allowed_for_stay_in_service_and_unread() -> None:
    skin = taxels()
    skin.dead_share = 0.3
    for number in range(50):
        read = skin.update(words({0: 800, 1: 800}), 0.1 * number, HEALTH)
    assert (read.coverage(1e3).valid, read.coverage(1e3).in_service, skin.retired) == (2, 4, [])
    skin.dead_share = 0.5
    read = skin.update(words({0: 800, 1: 800}), 5.0, HEALTH)
    assert (read.coverage(1e3).in_service, skin.retired) == (2, [3, 4])


def test_a_device_clock_that_starts_again_makes_old_values_stale() -> None:
    skin = taxels()
    skin.update(words({0: 800}), 5000.0, HEALTH)
    skin.forget()
    assert np.isnan(skin.update(words({1: 800}), 0.0, HEALTH).pressure_pa[0])


def test_saturation_and_doubt_are_flagged_and_stay_with_the_held_value() -> None:
    skin = taxels()
    readings = skin.update(words({0: 100, 1: 600}, doubtful=(1,)), 0.0, HEALTH)
    assert readings.status[0] == Status.SATURATED
    assert readings.pressure_pa[0] == pytest.approx(140e3)
    assert readings.status[1] == Status.LOW_SNR
    assert (
        skin.update(silent(SPEC.nodes, 0.0), 0.1, HEALTH).status[0]
        == Status.SATURATED | Status.SILENT
    )


def test_a_silence_that_is_not_certain_stays_so_until_the_node_is_heard() -> None:
    """It may have spoken a new value: the one that it holds is no longer certain."""
    skin = taxels()
    skin.update(words({0: 800, 1: 800}), 0.0, HEALTH)
    missed = skin.update(words({}, doubtful=(1,)), 0.1, HEALTH)
    later = [skin.update(silent(SPEC.nodes, 0.0), t_s, HEALTH) for t_s in (0.2, 0.3)]
    for readings in (missed, *later):
        assert readings.status[0] == Status.SILENT
        assert readings.status[1] == Status.SILENT | Status.LOW_SNR
    assert skin.update(words({1: 700}), 0.4, HEALTH).status[1] == Status.OK


def test_earlier_readings_are_not_changed_by_later_frames() -> None:
    skin = taxels()
    first = skin.update(words({0: 800}), 0.0, HEALTH)
    before = first.pressure_pa.copy()
    skin.update(words({0: 500}), 0.1, HEALTH)
    assert np.array_equal(first.pressure_pa, before, equal_nan=True)


@pytest.mark.parametrize(("nodes", "shape"), [(16, (4, 4)), (12, (3, 4)), (7, (1, 7)), (1, (1, 1))])
def test_grids_are_as_square_as_they_can_be(nodes: int, shape: tuple[int, int]) -> None:
    grid = Layout.grid(nodes, 0, 0, 7e-3, 5.5e-3)
    assert (grid.rows, grid.columns) == shape


def test_grid_positions_are_centred_row_major() -> None:
    positions = Layout.grid(6, 2, 3, 10e-3, 5e-3).positions_m
    assert np.allclose(positions.mean(axis=0), 0, atol=1e-9)
    assert np.allclose(positions[1] - positions[0], [10e-3, 0, 0])
    assert np.allclose(positions[3] - positions[0], [0, -10e-3, 0])


def test_impossible_grids_are_refused() -> None:
    with pytest.raises(SpecError, match="3 rows × 5 columns has 15 places for 16 nodes"):
        Layout.grid(16, 3, 0, 7e-3, 5e-3)
    with pytest.raises(SpecError, match="overlap"):
        Layout.grid(16, 4, 4, 5e-3, 7e-3)


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


def test_heatmap_puts_taxel_row_zero_on_top() -> None:
    pressure = np.zeros(6, np.float32)
    pressure[5] = 1e5
    picture = heatmap(pressure, Layout.grid(6, 2, 3, 7e-3, 5e-3), 1e5, pixels=8)
    assert picture.shape == (16, 24, 3)
    assert picture[15, 23].sum() > picture[0, 0].sum()
    assert (picture[8:, 16:] == picture[15, 23]).all()
    large = Layout.grid(4096, 64, 64, 7e-3, 5e-3)
    assert heatmap(np.zeros(4096, np.float32), large, 1e5, pixels=256).size <= 3 << 20
