# SPDX-License-Identifier: Apache-2.0

"""The taxels of each contact and their sums, compared with a plain search from taxel to taxel."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.places.layout import Layout
from tactile_cdma.places.layout_shapes import cylinder
from tactile_cdma.readings.contact import RIM, Gatherer, moments_of
from tactile_cdma.readings.status import Status
from tactile_cdma.readings.taxels import Readings
from test.support.examples import examples

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
LEVELS_PA = [
    *(-1001.0, -1000.0, 0.0, 100.0, 150.0, 160.0, 500.0, 501.0, 999.0, 1000.0, 1001.0, 2e3, 7e4),
    np.nan,
]


def frames(layout: Layout, seed: int, density: float) -> list[Readings]:
    """Twenty frames in which some pressures change, taxels fall silent, and thresholds are hit."""
    rng = np.random.default_rng(seed)
    pressure_pa = np.zeros(len(layout), dtype=np.float32)
    found = []
    for _ in range(20):
        changed = rng.random(len(layout)) < density
        pressure_pa = np.where(changed, rng.choice(LEVELS_PA, len(layout)), pressure_pa)
        status = np.zeros(len(layout), np.uint8)
        for flag in (Status.SATURATED, Status.LOW_SNR, Status.MASKED):
            status[rng.random(len(layout)) < 0.05] |= np.uint8(flag)
        found.append(Readings(pressure_pa.astype(np.float32), pressure_pa, status))
    return found


class Searched:
    """The same, taxel by taxel."""

    def __init__(self, layout: Layout) -> None:
        self.beside = [set(near) - {i} for i, near in enumerate(layout.neighbours.tolist())]
        self.moments = moments_of(layout)
        self.held: dict[int, int] = {}  # contact of each taxel in the frame before
        self.unread = set(range(len(layout)))

    def gather(self, readings: Readings) -> list[dict[str, Any]]:
        pressure_pa = dict(enumerate(readings.pressure_pa.tolist()))
        saturated = {i for i, bits in enumerate(readings.status) if bits & Status.SATURATED}
        unread = {i for i, bits in enumerate(readings.status) if bits & Status.LOW_SNR}
        unread |= {i for i, pa in pressure_pa.items() if np.isnan(pa)}
        pressure_pa |= dict.fromkeys(unread, np.nan)
        dim = unread | saturated | {i for i, pa in pressure_pa.items() if pa < -CONTACT_PA}
        changed = unread ^ self.unread
        left, contacts = [i for i, pa in pressure_pa.items() if pa > RELEASE_PA], []
        while left:
            members = [left.pop(0)]
            for taxel in members:
                near = [i for i in left if i in self.beside[taxel]]
                left = [i for i in left if i not in near]
                members += near
            if any(pressure_pa[i] > CONTACT_PA or i in self.held for i in members):
                contacts.append(sorted(members))
        contacts.sort(key=lambda taxels: -sum(pressure_pa[i] * self.moments[i, 0] for i in taxels))
        before, self.unread = self.held, unread
        self.held = {i: number for number, taxels in enumerate(contacts) for i in taxels}
        rim: dict[int, list[int]] = {number: [] for number in range(len(contacts))}
        for i, pa in pressure_pa.items():
            owners = [self.held[j] for j in self.beside[i] if j in self.held]
            if owners and pa > RIM * RELEASE_PA and i not in self.held:
                rim[max(owners)].append(i)
        return [
            {
                "taxels": taxels,
                "places": [before.get(i, -1) for i in taxels],
                "moments": [
                    *sum(self.moments[i] * pressure_pa[i] for i in taxels + rim[number]),
                    sum(self.moments[i, 0] for i in taxels),
                ],
                "pressure_max_pa": max(pressure_pa[i] for i in taxels),
                "saturated": bool(saturated & set(taxels)),
                "lower_bound": bool(dim & around),
                "torn": bool(changed & around),
            }
            for number, taxels in enumerate(contacts)
            for around in [set(taxels).union(*(self.beside[i] for i in taxels))]
        ]


@examples(30)
@given(st.integers(0, 2), st.integers(0, 2**32), st.sampled_from([0.02, 0.2, 0.7]))
def test_contacts_are_those_of_a_search(which: int, seed: int, density: float) -> None:
    gatherer, searched = Gatherer(LAYOUTS[which]), Searched(LAYOUTS[which])
    for number, readings in enumerate(frames(LAYOUTS[which], seed, density)):
        if number == 15:
            gatherer.forget()
            searched.held, searched.unread = {}, set(range(len(LAYOUTS[which])))
        found = gatherer.gather(readings, CONTACT_PA, RELEASE_PA)
        expected = searched.gather(readings)
        assert len(found.moments) == len(expected) == len(found.bounds) - 1
        labels = np.arange(len(expected)).repeat(np.diff(found.bounds))
        assert found.goes_on == (found.places == labels).all()
        for contact, theirs in enumerate(expected):
            own = slice(*found.bounds[contact : contact + 2])
            for name, value in theirs.items():
                ours = getattr(found, name)[own if name in ("taxels", "places") else contact]
                np.testing.assert_allclose(ours, value, rtol=1e-9, atol=1e-14, err_msg=name)
        assert found.coverage == readings.coverage(CONTACT_PA)


def test_a_whole_skin_is_one_contact_and_what_was_given_stays() -> None:
    layout = Layout.grid(4096, 64, 64, 7e-3, 5e-3)
    gatherer = Gatherer(layout)
    pressed = Readings(*(np.full(4096, 2e3, dtype=np.float32),) * 2, np.zeros(4096, dtype=np.uint8))
    first = gatherer.gather(pressed, CONTACT_PA, RELEASE_PA)
    kept = first.moments.copy()
    pressed.pressure_pa[:2048] = 0.0
    second = gatherer.gather(pressed, CONTACT_PA, RELEASE_PA)
    assert (len(first.moments), len(first.taxels), len(second.taxels)) == (1, 4096, 2048)
    np.testing.assert_array_equal(first.moments, kept)
    assert first.moments[0, 0] == pytest.approx(2 * second.moments[0, 0])


@pytest.mark.parametrize("neighbour", [-1, 60, 2**31 - 1])
def test_a_neighbour_that_is_no_taxel_is_refused(neighbour: int) -> None:
    gatherer, pressure_pa = Gatherer(LAYOUTS[1]), np.full(60, 2e3, dtype=np.float32)
    gatherer._skin.at.neighbours[7 * gatherer._skin.at.near] = neighbour
    with pytest.raises(ValueError, match="neighbours: one is no taxel"):
        readings = Readings(pressure_pa, pressure_pa, np.zeros(60, dtype=np.uint8))
        gatherer.gather(readings, CONTACT_PA, RELEASE_PA)
