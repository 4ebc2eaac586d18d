# SPDX-License-Identifier: Apache-2.0

"""Taxels out of service: masked by whoever may, or dead for long and left out by dead_share."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.base.errors import ParameterError, SpecError
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.places.layout import Layout
from tactile_cdma.readings.baseline import Baseline, RestRules
from tactile_cdma.readings.calibration import AdcScale, Calibration, PressureCurve
from tactile_cdma.readings.contact import Contacts, ContactTracker
from tactile_cdma.readings.drift import DriftTracker, nodes_beside
from tactile_cdma.readings.pressure import PressureChain
from tactile_cdma.readings.status import Status
from tactile_cdma.readings.taxels import Taxels
from tactile_cdma.words.health import NodeHealth
from tactile_cdma.words.words import Words, silent
from test.support.examples import examples
from test.support.simulated import stream

STALE_S, NODES = 0.3, 16


def felt(url: str, frames: int = 70, **values: object) -> list[tuple[TactileFrame, Contacts]]:
    """Frames of a simulated skin, and what touches it."""
    config = SkinConfig.of({"stale_after_s": STALE_S, **values})  # type: ignore[dict-item]
    pipeline, tracker = Pipeline(config), ContactTracker(config.layout, config.contact)
    shown = pipeline.feed(stream(config, url, frames), 0.0) + pipeline.flush()
    return [(frame, tracker.update(frame.readings, frame.t_middle)) for frame in shown]


@pytest.mark.parametrize(
    ("dead", "share", "left_out"),
    [("3", 0.0, 0), ("3", 0.06, 0), ("3", 1 / 16, 1), ("3,7", 0.1, 0), ("3,7", 0.125, 2)],
)
@pytest.mark.parametrize("scene", ["idle", "all"])
def test_as_many_dead_taxels_as_allowed_hold_up_nothing_and_more_leave_all_unknown(
    dead: str, share: float, left_out: int, scene: str
) -> None:
    url = f"sim://?scene={scene}&seed=1&heartbeat=8&dead={dead}"
    numbers = [int(number) - 1 for number in dead.split(",")]
    begun_s, shown = 0.0, felt(url, dead_share=share)
    for frame, contacts in shown:
        if frame.sequence < 21:
            begun_s = begun_s or frame.t_middle
            continue  # not all were heard for certain
        is_left_out = left_out and frame.t_middle - begun_s > STALE_S + 1e-6
        status = frame.readings.status
        assert contacts.taxels_in_service == NODES - left_out * bool(is_left_out)
        assert contacts.taxels_valid == NODES - len(numbers)
        assert (status[numbers] & Status.STALE != 0).all()
        assert (status[numbers] & Status.MASKED != 0).all() == bool(is_left_out)
        assert np.isnan(frame.readings.pressure_pa[numbers]).all()
        if scene == "all":  # pressed all over, also where nobody reads
            assert contacts.touched and contacts.contacts[0].lower_bound
        else:
            assert contacts.untouched == bool(is_left_out)
            assert np.isfinite(contacts.wrench).all() == bool(is_left_out)


@given(
    spoken=st.lists(st.integers(0, 7), min_size=20, max_size=70),
    share=st.sampled_from([0.0, 0.34, 0.5]),
    quiet_from=st.integers(0, 70),
)
@examples(60)
def test_a_taxel_is_left_out_from_a_stale_time_after_it_went_stale_until_it_speaks(
    spoken: list[int], share: float, quiet_from: int
) -> None:
    """Bits of spoken: which of three nodes speak in a frame. Silent frames take a short cut."""
    layout, rules = Layout.grid(3, 1, 3, 7e-3, 5e-3), RestRules(60.0, 1e3, 500.0)
    tracker = DriftTracker(AdcScale(10), nodes_beside(layout, 3), rules)
    chain = PressureChain(Calibration.default(PressureCurve.two_stage(), 3), Baseline(3), tracker)
    taxels = Taxels(3, AdcScale(10), chain, layout, 1.0)
    taxels.dead_share = share
    health = NodeHealth(FrameSpec(nodes=3, chip_s=1e-5, frame_period_s=0.25))
    heard_s, named_s = [-np.inf] * 3, [np.inf] * 3
    for number, bits in enumerate(spoken):
        now_s = 0.25 * number
        active = np.array([bits >> i & 1 and number < quiet_from for i in range(3)], dtype=bool)
        words = silent(3, 1e-3)
        if active.any():
            values = {name: getattr(words, name) for name in Words.__dataclass_fields__}
            words = Words(**values | {"active": active, "codes": np.full(3, 700, np.int32)})
            readings = taxels.update(words, now_s, health)
        else:
            readings = taxels.update_silent(words, now_s, health)
        for i in range(3):
            heard_s[i] = now_s if active[i] else heard_s[i]
            is_stale = now_s - heard_s[i] > 1.0
            named_s[i] = min(named_s[i], now_s) if is_stale else np.inf
        dead = [i for i in range(3) if now_s - named_s[i] > 1.0]
        expected = dead if 0 < len(dead) <= share * 3 else []
        assert np.flatnonzero(readings.status & Status.MASKED).tolist() == expected
        assert taxels.retired == tuple(i + 1 for i in expected)


@pytest.mark.parametrize("value", [(7, 3), "7 3", "3, 7,3", [3, 7]])
def test_numbers_of_nodes_are_taken_as_people_write_them(value: object) -> None:
    assert SkinConfig.of({"masked": value}).masked == (3, 7)  # type: ignore[dict-item]


def test_numbers_that_are_no_nodes_are_refused() -> None:
    for wrong in ("3-7", "0", [-1], [True], "99999", 2.0):
        with pytest.raises(ParameterError, match="must be numbers of nodes"):
            SkinConfig.of({"masked": wrong})  # type: ignore[dict-item]
    with pytest.raises(SpecError, match="masked has node 17, but the skin has 16 nodes"):
        SkinConfig.of({"masked": 17})
