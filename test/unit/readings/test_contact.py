# SPDX-License-Identifier: Apache-2.0

"""Contacts: taxels against a plain search, forces against integrals, ids over time."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tactile_cdma.base.errors import SpecError
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.places.layout import Layout
from tactile_cdma.places.layout_shapes import cylinder
from tactile_cdma.readings.contact import (
    RIM,
    SMOOTHING_S,
    Contacts,
    ContactThresholds,
    ContactTracker,
    Gatherer,
    moments_of,
)
from tactile_cdma.readings.status import Status
from tactile_cdma.readings.taxels import Coverage, Readings
from tactile_cdma.words.health import NodeHealth
from tactile_cdma.words.words import silent
from test.support.examples import examples
from test.support.simulated import run, stream

PITCH_M, TAXEL_M = 7e-3, 5.5e-3
ROWS, COLUMNS = 6, 8
GRID = Layout.grid(ROWS * COLUMNS, ROWS, COLUMNS, PITCH_M, TAXEL_M)
THRESHOLDS = ContactThresholds(contact_pa=1000.0, release_pa=500.0)
PERIOD_S = 0.0128


def readings(pressure_pa: NDArray[np.float64]) -> Readings:
    pressure = pressure_pa.astype(np.float32)
    return Readings(pressure, pressure, np.zeros(len(pressure_pa), dtype=np.uint8))


def pressed(places: dict[tuple[int, int], float]) -> Readings:
    """Pressures in kPa at some (row, column) of GRID."""
    pressure_pa = np.zeros((ROWS, COLUMNS))
    for place, kpa in places.items():
        pressure_pa[place] = kpa * 1e3
    return readings(pressure_pa.ravel())


def contacts_of(*frames: dict[tuple[int, int], float]) -> list[Contacts]:
    tracker = ContactTracker(GRID, THRESHOLDS)
    return [tracker.update(pressed(frame), i * PERIOD_S) for i, frame in enumerate(frames)]


def taxels(contacts: Contacts) -> list[list[int]]:
    return [indices.tolist() for indices in contacts.taxels]


# Which taxels


TOUCHES = st.lists(
    st.lists(st.tuples(st.integers(0, ROWS - 1), st.integers(0, COLUMNS - 1)), max_size=20),
    max_size=8,
)
"""Touched (row, column) frame by frame."""


def test_thresholds_are_checked_and_take_effect_at_once() -> None:
    tracker, touch = ContactTracker(GRID, THRESHOLDS), pressed({(0, 0): 2.0})
    assert len(tracker.update(touch, 0.0)) == 1
    tracker.thresholds = ContactThresholds(3000.0, 2500.0)
    assert len(tracker.update(touch, PERIOD_S)) == 0
    tracker.thresholds = THRESHOLDS
    assert len(tracker.update(touch, 2 * PERIOD_S)) == 1
    with pytest.raises(SpecError, match=r"release_kpa is 0.5 kPa, above contact_kpa.* 0.4 kPa"):
        SkinConfig.of({"contact_kpa": 0.4})
    assert SkinConfig.of({"contact_kpa": 0.5}).contact == ContactThresholds(500.0, 500.0)
    [contacts] = contacts_of({(0, 0): 0.9})
    assert len(contacts) == 0
    assert np.isnan(contacts.centre_m).all()
    assert contacts.total_force_n.tolist() == [0, 0, 0]


# Blind taxels

HEARTBEAT_S = 78 * PERIOD_S
"""The simulator's: until then a node at rest was not heard."""
PRESS_S = 0.8, 3.2
"""When the fingertip of the scene "press" touches node 6."""


def felt(port: str, seconds: float = 4.0, **parameters: float) -> list[tuple[float, Contacts]]:
    """What the chain from bytes to contacts makes of a simulated skin of 16: device time, s."""
    config = SkinConfig.of(parameters)
    tracker = ContactTracker(config.layout, config.contact)
    frames = run(config, stream(config, f"sim://{port}", round(seconds / PERIOD_S)))
    assert frames[-1].t_middle > seconds - 0.1
    return [(f.t_middle, tracker.update(f.readings, f.t_middle)) for f in frames]


def claims_nothing(contacts: Contacts) -> bool:
    """Neither touched nor untouched, and no sum that could pass for either."""
    sums = [contacts.total_area_m2, *contacts.total_force_n, *contacts.total_torque_nm]
    nothing = not len(contacts) and not contacts.untouched
    return nothing and all(map(math.isnan, [*sums, *contacts.centre_m]))


def test_a_skin_that_is_read_is_touched_or_untouched() -> None:
    """What the next tests must not find: without faults the same scene is known all the time."""
    for t_s, contacts in felt("?scene=press"):
        if t_s > HEARTBEAT_S:
            assert contacts.coverage == Coverage(16, 16)
            assert contacts.untouched != (len(contacts) > 0)
            assert contacts.untouched == (not contacts.total_force_n.any())
            assert not contacts.lower_bound.any()
        else:
            assert len(contacts) or claims_nothing(contacts), "nodes at rest were not heard yet"
    assert {len(contacts) for _, contacts in felt("?scene=press")} == {0, 1}


def test_a_touch_is_unknown_once_the_touched_nodes_have_died() -> None:
    dead_s, stale_s = 2.0, 0.5
    dead = ",".join(str(node) for node in range(1, 17))
    course = felt(f"?scene=press&dead={dead}&dead_after={dead_s}", stale_after_s=stale_s)
    for t_s, contacts in course:
        if PRESS_S[0] + 0.3 < t_s < dead_s:
            assert len(contacts) == 1
        if t_s > dead_s + stale_s + PERIOD_S:  # the last frame began before dead_s
            assert claims_nothing(contacts)
            assert contacts.coverage == Coverage(0, 16)


def blind(touch: Readings, *unread: int, status: Status = Status.STALE) -> Readings:
    touch.pressure_pa[list(unread)] = np.nan
    touch.status[list(unread)] = status
    return touch


def doubted(touch: Readings, *doubtful: int, status: Status = Status.UNHEARD) -> Readings:
    touch.status[list(doubtful)] |= np.uint8(status)
    return touch


@pytest.mark.parametrize("status", [Status.UNHEARD, Status.LOW_SNR])
def test_beside_a_taxel_that_may_have_spoken_no_touch_is_not_claimed(status: Status) -> None:
    tracker = ContactTracker(GRID, THRESHOLDS)
    for doubtful in (0, ROWS * COLUMNS - 1):
        contacts = tracker.update(doubted(pressed({}), doubtful, status=status), 0.0)
        assert claims_nothing(contacts)
        assert contacts.coverage == Coverage(47, 48)
        masked = pressed({})
        masked.status[doubtful] = Status.LOW_SNR | Status.MASKED
        assert tracker.update(masked, 0.0).untouched


def test_a_touch_that_may_have_ended_unheard_is_not_claimed() -> None:
    """The press is (2, 2) and (2, 3); of one of them, of both, and of a third beside is doubted."""
    touch = {(2, 2): 3.0, (2, 3): 2.0}
    for unheard, felt_pa in (((18,), 2e3), ((18, 19), None), ((20,), 5e3), ((36,), 5e3)):
        contacts = ContactTracker(GRID, THRESHOLDS).update(doubted(pressed(touch), *unheard), 0.0)
        if felt_pa is None:
            assert claims_nothing(contacts)
            continue
        assert contacts.total_force_n[2] == pytest.approx(-felt_pa * PITCH_M**2)
        assert contacts.lower_bound.tolist() == [unheard != (36,)]
    tracker = ContactTracker(GRID, THRESHOLDS)
    first = tracker.update(pressed(touch), 0.0).ids[0]
    assert tracker.update(doubted(pressed(touch), 18), 0.1).ids.tolist() == [first]
    assert claims_nothing(tracker.update(doubted(pressed(touch), 18, 19), 0.2))


def test_sums_need_half_of_the_taxels_in_service() -> None:
    """40 of the 48 are in service."""
    for unread, has_sum in ((0, True), (20, True), (21, False), (39, False)):
        touch = blind(pressed({(0, 0): 2.0}), *range(40, 48), status=Status.MASKED)
        tracker = ContactTracker(GRID, THRESHOLDS)
        contacts = tracker.update(blind(touch, *range(1, 1 + unread)), 0.0)
        assert contacts.coverage == Coverage(40 - unread, 40)
        force_n = -contacts.force_n[0, 2]
        assert force_n == pytest.approx(2e3 * PITCH_M**2)
        sums = [contacts.total_area_m2, contacts.total_force_n[2], contacts.centre_m[0]]
        assert np.isfinite(sums).tolist() == [has_sum] * 3
        if has_sum:
            assert sums == pytest.approx([PITCH_M**2, -force_n, contacts.position_m[0, 0]])


def test_a_skin_of_which_no_taxel_is_in_service_claims_nothing() -> None:
    touch = blind(pressed({}), *range(48), status=Status.MASKED)
    assert claims_nothing(ContactTracker(GRID, THRESHOLDS).update(touch, 0.0))


# Force and place

TRIALS = 30
SIDE = 16
LARGE = Layout.grid(SIDE**2, SIDE, SIDE, PITCH_M, TAXEL_M)


def hertz(rho: NDArray[np.float64]) -> NDArray[np.float64]:
    """Two elastic bodies."""
    return np.sqrt(np.clip(1 - np.square(rho), 0, None))


def soft(rho: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same through a soft cover."""
    return hertz(rho) ** 3


Profile = Callable[[NDArray[np.float64]], NDArray[np.float64]]
SHARE = {hertz: 2 / 3, soft: 2 / 5}
"""Mean pressure over peak pressure: ∫ profile(ρ) 2ρ dρ."""


def at_taxels(
    profile: Profile, centre_m: NDArray[np.float64], radius_m: float, averaging: bool
) -> NDArray[np.float64]:
    """Relative pressure on the taxels of LARGE: over their sensing areas, or at their centres."""
    steps = (np.arange(9) - 4) / 9 * (TAXEL_M if averaging else 0.0)
    offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    places = LARGE.flat_m[:, None, :] + offsets - centre_m
    return np.asarray(profile(np.linalg.norm(places, axis=-1) / radius_m).mean(axis=1))


def errors(
    profile: Profile, pitches: float, peak_kpa: float, averaging: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Relative errors of the force and distances of the centre, in pitches, of random presses.

    Words of 10 bits through the chain with its default parameters.
    """
    config = SkinConfig.of({"nodes": SIDE**2, "chip_us": 1.0})
    skin, health = Pipeline(config).taxels, NodeHealth(config.spec)
    tracker = ContactTracker(LARGE, config.contact)
    everybody = replace(silent(SIDE**2, 0.0), active=np.ones(SIDE**2, dtype=bool))
    rng = np.random.default_rng([int(10 * pitches), int(peak_kpa)])
    force_n = peak_kpa * 1e3 * SHARE[profile] * np.pi * (pitches * PITCH_M) ** 2
    of_force, of_centre = [], []
    for trial in range(TRIALS):
        centre_m = rng.uniform(-2, 2, 2) * PITCH_M
        pressure_pa = peak_kpa * 1e3 * at_taxels(profile, centre_m, pitches * PITCH_M, averaging)
        codes = config.adc.code(config.curve.voltage(pressure_pa)).astype(np.int32)
        now_s = trial * PERIOD_S
        contact = tracker.update(skin.update(replace(everybody, codes=codes), now_s, health), now_s)
        assert len(contact) == 1
        of_force.append(-contact.force_n[0, 2] / force_n - 1)
        of_centre.append(np.linalg.norm(contact.centre_m[:2] - centre_m) / PITCH_M)
    return np.array(of_force), np.array(of_centre)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("profile", "pitches", "averaging"),
    [(hertz, 2.5, True), (hertz, 4, True), (soft, 2.5, True), (soft, 4, True), (soft, 2.5, False)],
)
@pytest.mark.parametrize("peak_kpa", [8.0, 20.0, 45.0, 120.0])  # the last two: up to stage two
def test_force_within_2_percent_and_centre_within_5_percent_of_a_pitch(
    profile: Profile, pitches: float, averaging: bool, peak_kpa: float
) -> None:
    """Taxels average, or sense at a point: then the steep edge of Hertz lies between points."""
    of_force, of_centre = errors(profile, pitches, peak_kpa, averaging)
    assert np.abs(of_force).max() < 0.02
    assert of_centre.max() < 0.05


# On a curved skin

RADIUS_M = 0.06
AROUND, ALONG = 40, 16


def bent() -> Layout:
    """A patch of a cylinder around the y axis, centred at the top: x = z = 0 on the axis."""
    surface, nodes = cylinder(ALONG, AROUND, PITCH_M, RADIUS_M), np.arange(1, AROUND * ALONG + 1)
    surface = replace(surface, positions_m=surface.positions_m + np.float32([0, 0, RADIUS_M]))
    shape = {"name": "cylinder", "rows": ALONG, "columns": AROUND, "pitch_m": PITCH_M}
    return Layout(**vars(surface), **shape, nodes=nodes.astype(np.int32))


def test_force_and_torque_on_a_cylinder_are_the_integrals_over_its_surface() -> None:
    """A band 60 degrees wide under p = p0·cos(3θ)·cos(π·y/h), whose integrals have closed forms."""
    layout, peak_pa, half_m = bent(), 30e3, 0.045
    tracker = ContactTracker(layout, THRESHOLDS)
    for about, shift_m in [(0.0, 0.0), (0.5, 0.004), (-0.83, -0.0027)]:
        theta = layout.flat_m[:, 0].astype(np.float64) / RADIUS_M - about
        y = layout.flat_m[:, 1].astype(np.float64) - shift_m
        around = np.where(np.abs(theta) < np.pi / 6, np.cos(3 * theta), 0.0)
        along = np.where(np.abs(y) < half_m, np.cos(np.pi * y / (2 * half_m)), 0.0)
        tracker.forget()
        contacts = tracker.update(readings(peak_pa * around * along), 0.0)
        [force_n], [torque_nm], [normal] = contacts.force_n, contacts.torque_nm, contacts.normals
        # ∫ cos 3θ cos θ dθ over ±π/6 = 3√3/8;  ∫ cos(πy/2h) dy = 4h/π
        up = np.array([np.sin(about), 0.0, np.cos(about)])
        expected_n = -up * peak_pa * RADIUS_M * 4 * half_m / np.pi * 3 * np.sqrt(3) / 8
        size_n = np.linalg.norm(expected_n)
        assert np.linalg.norm(force_n - expected_n) < 0.02 * size_n
        # All forces point to the axis: the torque is that of the resultant at (0, shift, 0).
        expected_nm = np.cross([0.0, shift_m, 0.0], expected_n)
        assert np.linalg.norm(torque_nm - expected_nm) < 0.05 * PITCH_M * size_n
        assert normal @ up > 1 - 1e-4
        assert np.linalg.norm(normal) == pytest.approx(1.0)


def test_torque_is_that_of_the_force_at_the_centre_of_pressure_on_a_flat_skin() -> None:
    [contacts] = contacts_of({(1, 6): 9.0, (1, 7): 5.0, (2, 6): 2.0})
    expected = np.cross(contacts.position_m[0], contacts.force_n[0])
    assert contacts.torque_nm[0] == pytest.approx(expected, abs=1e-9)


# Lives


@given(TOUCHES)
@examples(60)
def test_ids_are_never_used_twice(frames: list[list[tuple[int, int]]]) -> None:
    ended: set[int] = set()
    last: dict[int, set[int]] = {}
    for contacts in contacts_of(*(dict.fromkeys(frame, 2.0) for frame in frames)):
        ids = contacts.ids.tolist()
        assert len(set(ids)) == len(ids)
        now = dict(zip(ids, map(set, taxels(contacts)), strict=True))
        ended |= last.keys() - now.keys()
        assert not ended & now.keys()
        for name, indices in now.items():
            assert name not in last or indices & last[name]
        last = now


def test_contacts_keep_their_ids_as_long_as_the_clock_goes_on() -> None:
    frames = contacts_of(*({(2, column): 2.0, (2, column + 1): 2.0} for column in range(6)))
    assert [c.ids.tolist() for c in frames] == [[1]] * 6
    assert [c.age_s[0] for c in frames] == pytest.approx([i * PERIOD_S for i in range(6)])
    left, right = {(0, 0): 2.0, (0, 1): 2.0}, {(0, 3): 9.0}
    apart, together = left | right, left | right | {(0, 2): 2.0}
    first, merged, split = contacts_of(apart, together, apart)
    assert dict(zip(first.ids.tolist(), taxels(first), strict=True)) == {1: [3], 2: [0, 1]}
    assert merged.ids.tolist() == [2]
    assert dict(zip(split.ids.tolist(), taxels(split), strict=True)) == {2: [0, 1], 3: [3]}
    assert not merged.velocity_m_s.any() and not split.velocity_m_s.any()
    tracker, touch = ContactTracker(GRID, THRESHOLDS), pressed({(0, 0): 2.0})
    assert tracker.update(touch, 50.0).ids.tolist() == [1]
    assert tracker.update(touch, 0.0).ids.tolist() == [2]


# Motion

Track = list[tuple[float, Contacts]]


def track(centre_m: Callable[[float], Any], force_n: Callable[[float], float]) -> Track:
    """A soft contact of 2.5 pitches through the ADC, with sensor noise of a third of a count."""
    config, rng = SkinConfig.of({"nodes": SIDE**2, "chip_us": 1.0}), np.random.default_rng(3)
    tracker, radius_m, result = ContactTracker(LARGE, THRESHOLDS), 2.5 * PITCH_M, []
    for now_s in np.arange(0.0, 1.0, PERIOD_S).tolist():
        peak_pa = force_n(now_s) / (SHARE[soft] * np.pi * radius_m**2)
        volts = config.curve.voltage(peak_pa * at_taxels(soft, centre_m(now_s), radius_m, True))
        volts += rng.normal(scale=0.3 * config.adc.lsb_v, size=volts.shape)
        pressure_pa = config.curve.pressure(config.adc.voltage(config.adc.code(volts)))
        result.append((now_s, tracker.update(readings(pressure_pa), now_s)))
    return result


def test_the_velocity_is_that_of_a_sliding_contact() -> None:
    velocity_m_s = np.array([0.02, -0.01])
    slide = track(lambda t: velocity_m_s * (t - 0.5), lambda _: 10.0)
    settled = [c.velocity_m_s[0] for t, c in slide if t > 5 * SMOOTHING_S]
    assert np.mean(settled, axis=0)[:2] == pytest.approx(velocity_m_s, rel=0.03)
    assert np.abs(np.array(settled)[:, :2] - velocity_m_s).max() < 2e-3
    assert not np.array(settled)[:, 2].any()


@pytest.mark.parametrize("speed_mm_s", [5.0, 20.0])
def test_a_slide_is_distinguished_from_a_changing_grip_within_100_ms(speed_mm_s: float) -> None:
    def speeds(history: Track) -> list[float]:
        return [float(np.linalg.norm(c.velocity_m_s[0])) for t, c in history if t > 0.25]

    grip = track(lambda t: np.array([1e-3, 2e-3]), lambda t: 10.0 + 3.0 * np.sin(2 * np.pi * t))
    limit = 1.2 * max(speeds(grip))
    start_s = 0.5
    slide = track(
        lambda t: np.array([max(0.0, t - start_s) * speed_mm_s * 1e-3, 0]), lambda _: 10.0
    )
    seen = [t - start_s for t, c in slide if t > 0.25 and np.linalg.norm(c.velocity_m_s) > limit]
    assert 0 < seen[0] < 0.1
    assert len(seen) * PERIOD_S > 0.4


def test_the_force_rate_is_that_of_rises_and_impacts() -> None:
    rise = track(lambda t: np.zeros(2), lambda t: 5.0 + 20.0 * t)
    rates = [c.force_rate_n_s[0] for t, c in rise if t > 6 * SMOOTHING_S]
    assert np.mean(rates) == pytest.approx(20.0, rel=0.02)
    still, hit = contacts_of({}, {(2, 2): 100.0})
    assert len(still) == 0
    force_n = 100e3 * PITCH_M**2
    share = 1 - np.exp(-PERIOD_S / SMOOTHING_S)
    assert hit.force_rate_n_s == pytest.approx([share * force_n / PERIOD_S])
    [first] = contacts_of({(2, 2): 100.0})
    assert first.force_rate_n_s.tolist() == [0.0]


@pytest.mark.parametrize("unread", [(2, 2), (2, 3), (2, 4), (3, 4)])
def test_a_reading_that_goes_or_comes_is_neither_slide_nor_impact(unread: tuple[int, int]) -> None:
    tracker, press = ContactTracker(GRID, THRESHOLDS), {(2, 2): 5.0, (2, 3): 9.0, (3, 4): 2.0}
    taxel, jumps = unread[0] * COLUMNS + unread[1], []
    for frame in range(12):
        is_read = frame % 6 < 3
        touch = pressed(press) if is_read else blind(pressed(press), taxel)
        contacts = tracker.update(touch, frame * PERIOD_S)
        assert not contacts.velocity_m_s.any()
        assert not contacts.force_rate_n_s.any()
        assert contacts.lower_bound.any() == (not is_read)
        jumps.append(contacts.centre_m[0])
    assert (np.ptp(jumps) > 1e-3) == (unread in press)


def test_velocities_on_a_curved_skin_are_along_it() -> None:
    layout = bent()
    tracker = ContactTracker(layout, THRESHOLDS)
    for frame in range(40):
        away = np.linalg.norm(layout.flat_m - [0.04, 0.0] - frame * np.array([4e-4, 0]), axis=1)
        contacts = tracker.update(readings(30e3 * soft(away / 0.02)), frame * PERIOD_S)
    [velocity], [normal] = contacts.velocity_m_s, contacts.normals
    assert abs(velocity @ normal) < 1e-12
    # The centre of a curved contact lies slightly below the surface and moves that much less.
    inside = np.linalg.norm(contacts.position_m[0, [0, 2]]) / RADIUS_M
    assert np.linalg.norm(velocity) == pytest.approx(inside * 4e-4 / PERIOD_S, rel=0.02)


def test_frames_that_share_readings_give_the_same_as_frames_that_repeat_them() -> None:
    start, then = {(2, 2): 5.0}, {(2, 2): 4.0, (2, 3): 4.0}
    sharing, repeating = (ContactTracker(GRID, THRESHOLDS) for _ in range(2))
    shared = pressed(then)
    for tracker in (sharing, repeating):
        tracker.update(pressed(start), 0.0)
        tracker.update(shared, PERIOD_S)
    for frame in range(2, 6):
        one = sharing.update(shared, frame * PERIOD_S)
        other = repeating.update(pressed(then), frame * PERIOD_S)
        assert one.velocity_m_s == pytest.approx(other.velocity_m_s, rel=1e-9)
        assert one.force_rate_n_s == pytest.approx(other.force_rate_n_s, rel=1e-9)
        assert one.age_s == pytest.approx(other.age_s)
        assert one.force_n.tolist() == other.force_n.tolist()
        assert one.velocity_m_s.any() and one.force_rate_n_s.any()


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
    pressed = readings(np.full(4096, 2e3))
    first = gatherer.gather(pressed, CONTACT_PA, RELEASE_PA)
    kept = first.moments.copy()
    pressed.pressure_pa[:2048] = 0.0
    second = gatherer.gather(pressed, CONTACT_PA, RELEASE_PA)
    assert (len(first.moments), len(first.taxels), len(second.taxels)) == (1, 4096, 2048)
    np.testing.assert_array_equal(first.moments, kept)
    assert first.moments[0, 0] == pytest.approx(2 * second.moments[0, 0])


@pytest.mark.parametrize("neighbour", [-1, 60, 2**31 - 1])
def test_a_neighbour_that_is_no_taxel_is_refused(neighbour: int) -> None:
    gatherer = Gatherer(LAYOUTS[1])
    gatherer._skin.at.neighbours[7 * gatherer._skin.at.near] = neighbour
    with pytest.raises(ValueError, match="neighbours: one is no taxel"):
        gatherer.gather(readings(np.full(60, 2e3)), CONTACT_PA, RELEASE_PA)
