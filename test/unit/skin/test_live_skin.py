# SPDX-License-Identifier: Apache-2.0

"""Live frames without ROS: contacts, the latest frame, async loops, a tare that waits."""

import asyncio
import time
from pathlib import Path

import numpy as np
import pytest

from tactile_cdma import Decoder, ParameterError, PortError, Refusal, RestError, Skin
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.sim import Sphere
from tactile_cdma.skin import LATEST_S
from test.support.simulated import stream
from test.support.waiting import PATIENCE_S

STEPPED = "sim://?scene=external&speed=0&threshold=0"  # every node speaks in every frame
BALL = Sphere(radius_m=0.02, position_m=(0.0, 0.0, 0.019))  # 1 mm deep
pytestmark = pytest.mark.xdist_group("public_skin")


def stepped(port: str = STEPPED) -> Skin:
    skin = Skin(port, nodes=16, contacts=True, timeout_s=PATIENCE_S).open()
    for _ in range(5):
        skin.step()
    return skin


def test_contacts_are_those_of_the_pressed_taxels() -> None:
    with stepped() as skin:
        rest = skin.step()
        assert (rest.touched, rest.untouched) == (False, True)
        assert rest.wrench.tolist() == [0.0] * 6
        for _ in range(3):
            pressed = skin.step(BALL)
    above = pressed.pressure_pa > 1e3
    normal_n = float(pressed.pressure_pa[above] @ skin.layout.areas_m2[above])
    assert (pressed.touched, pressed.untouched) == (True, False)
    assert pressed.contacts is not None and pressed.contacts.taxels[0].tolist() == [5, 6, 9, 10]
    assert np.flatnonzero(above).tolist() == [5, 6, 9, 10] and normal_n > 0.3
    assert pressed.wrench == pytest.approx([0, 0, -normal_n, 0, 0, 0], abs=1e-3)
    assert pressed.contacts.age_s == pytest.approx([2 * 12.8e-3])  # since the first of three frames
    assert pressed.grid.shape == (4, 4) and pressed.grid[2, 1] == pressed.pressure_pa[9]
    assert repr(skin.layout) == "Layout('grid of 4 × 4', 16 taxels)"
    assert len(repr(pressed)) < 80 and len(repr(pressed.contacts)) < 80


def test_a_skin_that_is_blind_in_part_does_not_claim_that_nothing_touches_it() -> None:
    with stepped(f"{STEPPED}&dead=6") as skin:
        unfelt = skin.step(Sphere(radius_m=2e-3, position_m=tuple(skin.layout.positions_m[5])))
        felt = skin.step(BALL)
    assert (unfelt.touched, unfelt.untouched) == (False, False)
    assert np.isnan(unfelt.wrench).all()
    assert (felt.touched, felt.untouched) == (True, False)
    assert felt.contacts is not None and felt.contacts.lower_bound.all()


def test_contacts_that_nobody_asked_for_are_refused_not_empty() -> None:
    with Skin(STEPPED, nodes=16) as skin:
        frame = skin.step()
    for name in ("touched", "untouched", "wrench"):
        with pytest.raises(ParameterError, match="contacts=True"):
            getattr(frame, name)


def test_the_latest_frame_comes_at_once_as_long_as_it_is_of_the_present() -> None:
    with Skin(STEPPED, nodes=16, timeout_s=60.0) as skin:
        assert (
            skin.latest() is None
        )  # no frame passes without a step; else it would wait, and raise
        frame = skin.step()
        assert skin.latest() is frame and skin.latest() is frame
        time.sleep(LATEST_S + 0.1)
        assert skin.latest() is None, "who feels no more does not feel what was last"
        assert skin.latest(max_age_s=None) is frame
    with pytest.raises(PortError, match="not open"):
        skin.latest()


def test_an_async_loop_gets_every_frame_while_other_tasks_run(tmp_path: Path) -> None:
    async def sequences(skin: Skin, many: int) -> list[int]:
        found = []
        async for frame in skin:
            found.append(frame.sequence)
            if len(found) == many:
                break
        return found

    async def both(skin: Skin) -> tuple[list[int], int]:
        task, turns = asyncio.create_task(sequences(skin, 20)), 0
        while not task.done():
            await asyncio.sleep(0.005)
            turns += 1
        return task.result(), turns

    async def cancelled(skin: Skin) -> None:
        """In the very turn in which a frame is told, too."""
        for turn in range(100):
            task = asyncio.create_task(sequences(skin, 10**6))
            await asyncio.sleep(turn * 1e-4)
            task.cancel()
            await asyncio.wait({task}, timeout=1)
            assert task.cancelled()

    with Skin("sim://", nodes=16) as skin:
        found, turns = asyncio.run(both(skin))
        assert found == list(range(found[0], found[0] + 20)) and turns > 2
        asyncio.run(cancelled(skin))
        assert skin.read().sequence > found[-1]
    with Skin(STEPPED, nodes=16, timeout_s=0.3) as skin, pytest.raises(PortError, match="no frame"):
        asyncio.run(sequences(skin, 1))


def test_a_tare_waits_for_what_passes_and_no_longer() -> None:
    idle = "sim://?scene=idle&heartbeat=2"
    with Skin(idle, nodes=16) as skin:  # not read for a second yet
        with pytest.raises(RestError) as early:
            skin.tare(wait_s=0.0)
        assert early.value.reason == Refusal.EARLY
        assert skin.tare(wait_s=10.0).shape == (16,)
    with Skin("sim://?scene=press&heartbeat=2&speed=4", nodes=16) as skin:
        while np.nanmax(skin.newest().pressure_pa, initial=0.0) < 5e3:
            pass
        begun_s = time.monotonic()
        with pytest.raises(RestError, match="not tared") as pressed:
            skin.tare(wait_s=0.3)
        assert pressed.value.reason in (Refusal.LOADED, Refusal.MOVING, Refusal.EARLY)
        assert time.monotonic() - begun_s >= 0.3


def test_a_decoder_finds_the_contacts_of_every_frame() -> None:
    """The fingertip of the scene comes and goes."""
    config = SkinConfig.of({"nodes": 16})
    data = stream(config, "sim://?scene=press&threshold=0", 200)
    frames = Decoder(nodes=16, contacts=True).feed(data, 0.0)
    assert {frame.touched for frame in frames} == {False, True}
    for frame in frames[1:-1]:
        assert frame.touched != frame.untouched
        assert frame.wrench[2] == pytest.approx(-sum(frame.contacts.load_n))
