# SPDX-License-Identifier: Apache-2.0

"""Both ways to gather pressed taxels into contacts find the same, frame after frame."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.base import kernel
from tactile_cdma.places.layout import Layout
from tactile_cdma.places.layout_shapes import cylinder
from tactile_cdma.readings.gather import CompiledGatherer, NumpyGatherer
from tactile_cdma.readings.status import Status
from tactile_cdma.readings.taxels import Readings

pytestmark = pytest.mark.skipif(kernel.compiled is None, reason=kernel.why_numpy)
CONTACT_PA, RELEASE_PA = 1e3, 5e2
SLEEVE = Layout(
    **vars(cylinder(8, 12, 7e-3, 12 * 7e-3 / (2 * np.pi))),
    name="sleeve",
    nodes=np.append(np.arange(1, 91), [0] * 6).astype(np.int32),  # six taxels without a node
    pitch_m=7e-3,
    rows=8,
    columns=12,
)
LAYOUTS = Layout.grid(1, 1, 1, 7e-3, 5e-3), Layout.grid(60, 6, 10, 7e-3, 5e-3), SLEEVE


def frames(layout: Layout, seed: int, density: float) -> list[Readings]:
    """Twenty frames in which some pressures change, taxels fall silent, and thresholds are hit."""
    rng = np.random.default_rng(seed)
    levels_pa = [
        -1001.0,
        -1000.0,
        0.0,
        100.0,
        150.0,
        160.0,
        500.0,
        501.0,
        999.0,
        1000.0,
        1001.0,
        2e3,
        7e4,
        np.nan,
    ]
    pressure_pa = np.zeros(len(layout), dtype=np.float32)
    found = []
    for _ in range(20):
        changed = rng.random(len(layout)) < density
        pressure_pa = np.where(changed, rng.choice(levels_pa, len(layout)), pressure_pa)
        status = np.where(rng.random(len(layout)) < 0.05, Status.SATURATED, 0).astype(np.uint8)
        found.append(Readings(pressure_pa.astype(np.float32), pressure_pa, status))
    return found


@given(st.integers(0, 2), st.integers(0, 2**32), st.sampled_from([0.02, 0.2, 0.7]))
def test_compiled_is_as_numpy(which: int, seed: int, density: float) -> None:
    layout = LAYOUTS[which]
    by_numpy, compiled = NumpyGatherer(layout), CompiledGatherer(layout)
    for number, readings in enumerate(frames(layout, seed, density)):
        if number == 15:
            by_numpy.forget()
            compiled.forget()
        ours = compiled.gather(readings, CONTACT_PA, RELEASE_PA)
        theirs = by_numpy.gather(readings, CONTACT_PA, RELEASE_PA)
        for name, values in theirs._asdict().items():
            same = getattr(ours, name)
            assert same.shape == values.shape
            assert same.dtype == values.dtype
            if name in ("moments", "area_m2"):
                np.testing.assert_allclose(same, values, rtol=1e-12, atol=1e-14)
            else:
                np.testing.assert_array_equal(same, values)


def test_a_whole_skin_is_one_contact_and_what_was_given_stays() -> None:
    layout = Layout.grid(4096, 64, 64, 7e-3, 5e-3)
    gatherer = CompiledGatherer(layout)
    pressed = Readings(*(np.full(4096, 2e3, dtype=np.float32),) * 2, np.zeros(4096, dtype=np.uint8))
    first = gatherer.gather(pressed, CONTACT_PA, RELEASE_PA)
    kept = first.moments.copy()
    pressed.pressure_pa[:2048] = 0.0
    second = gatherer.gather(pressed, CONTACT_PA, RELEASE_PA)
    assert (len(first.starts), len(first.taxels), len(second.taxels)) == (1, 4096, 2048)
    np.testing.assert_array_equal(first.moments, kept)
    assert first.moments[0, 0] == pytest.approx(2 * second.moments[0, 0])


@pytest.mark.parametrize("neighbour", [-1, 60, 2**31 - 1])
def test_a_neighbour_that_is_no_taxel_is_refused(neighbour: int) -> None:
    gatherer = CompiledGatherer(LAYOUTS[1])
    gatherer._neighbours[7, 0] = neighbour
    for level_pa in (2e3, 2e2):  # in contact, and beside it
        pressure_pa = np.zeros(60, dtype=np.float32)
        pressure_pa[:7], pressure_pa[7] = 2e3, level_pa
        readings = Readings(pressure_pa, pressure_pa, np.zeros(60, dtype=np.uint8))
        with pytest.raises(ValueError, match="neighbours: one is no taxel"):
            gatherer.gather(readings, CONTACT_PA, RELEASE_PA)
