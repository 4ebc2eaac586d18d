# SPDX-License-Identifier: Apache-2.0

"""The patches of a body file as one skin, without ROS."""

import doctest
import math
import sys
import time
from collections.abc import Iterator
from dataclasses import fields, replace
from itertools import dropwhile, islice, pairwise
from pathlib import Path

import numpy as np
import pytest

from tactile_cdma import (
    Body,
    BodyError,
    BodyFrame,
    Contact,
    Frame,
    ParameterError,
    PortError,
    Skin,
    Status,
)
from tactile_cdma.sim import Sphere
from test.support.waiting import wait_for

pytestmark = pytest.mark.xdist_group("public_skin")
FILE = """
frame_id: torso
patches:
  left: {parameters: {port: "sim://?scene=all", mount_xyz_m: [1.0, 0.0, 0.0], rows: 2, columns: 8}}
  right: {parameters: {port: "sim://?nodes=24", nodes: 24, frame_period_ms: 16.0}}
  away: {parameters: {port: /dev/no_such_port, mount_xyz_m: [0.0, 0.0, 0.0]}}
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "body.yaml"
    path.write_text(FILE)
    return path


def test_the_example_of_the_docstring_runs() -> None:
    result = doctest.testmod(sys.modules[Body.__module__])
    assert (result.failed, result.attempted) == (0, 2)


def noted(skin: Skin) -> list[int]:
    """The numbers of the frames that a skin hands over, which on a busy machine have gaps."""
    numbers, waiting = list[int](), skin.waiting

    def give() -> list[Frame]:
        frames = waiting()
        numbers.extend(frame.sequence for frame in frames)
        return frames

    skin.waiting = give  # type: ignore[method-assign]
    return numbers


def test_a_patch_that_is_away_is_missing_and_the_others_lose_nothing(file: Path) -> None:
    with Body(file, contacts=True) as body:
        came = {name: noted(skin) for name, skin in body.skins.items()}
        begun = dropwhile(lambda frame: frame.missing != ("away",), body)  # others may be late
        frames = list(islice(begun, 60))
    assert all("away" in frame.missing for frame in frames)
    last = frames[-1]
    left, right, away = (body.parts[name] for name in ("left", "right", "away"))
    assert (left, right, away) == (slice(0, 16), slice(16, 40), slice(40, 56))
    assert np.array_equal(
        last.pressure_pa[right], last.patches["right"].pressure_pa, equal_nan=True
    )
    assert np.isnan(last.pressure_pa[away]).all() and (last.status[away] == Status.STALE).all()
    assert np.nanmax(last.pressure_pa[left]) > 1e3 and last.patches["left"].touched
    for name in ("left", "right"):
        seen = [frame.patches[name].sequence for frame in frames if name in frame.patches]
        seen = list(dict.fromkeys(seen))
        first = came[name].index(seen[0])
        assert seen == came[name][first : first + len(seen)], "no frame is skipped"
    assert all(b.t_host >= a.t_host for a, b in pairwise(frames))
    assert body.positions_m[left, 0].mean() == pytest.approx(1.0)
    assert np.isnan(body.positions_m[right]).all(), "mounted nowhere"
    assert "missing: away" in repr(last) and len(repr(last)) < 80


def test_a_body_of_which_nothing_comes_names_every_reason(file: Path) -> None:
    with Body(file, only="away", timeout_s=0.3) as body, pytest.raises(PortError) as silent:
        body.read()
    assert "away: " in str(silent.value) and "/dev/no_such_port" in str(silent.value)
    with pytest.raises(BodyError, match="no patch 'lft'"):
        Body(file, only="lft")
    with pytest.raises(PortError, match="not open"):
        body.read()


PRESSED = """
stale_after_s: 0.4
defaults: {parameters: {port: "sim://?scene=external&threshold=0"}}
patches:
  top: {parameters: {mount_xyz_m: [0.0, 0.5, 1.0]}}
  front: {parameters: {mount_xyz_m: [1.0, 0.0, 0.2], mount_rpy_rad: [0.0, 1.5707963267948966, 0.0]}}
"""
BALL = Sphere(radius_m=0.02, position_m=(0.0, 0.0, 0.018))
"""Presses on the middle of a patch."""


@pytest.fixture
def pressed(tmp_path: Path) -> Iterator[Body]:
    """A body of two patches, which nothing touches yet."""
    (tmp_path / "body.yaml").write_text(PRESSED)
    with Body(tmp_path / "body.yaml", contacts=True, timeout_s=3.0) as body:
        wait_for(lambda: body.read().untouched)
        yield body


def silence(body: Body, *names: str) -> None:
    """Have these patches deliver nothing any more."""
    for name in names:
        body.skins[name].waiting = list  # type: ignore[method-assign]
        body._waiting[name].clear()


def test_contacts_of_a_body_are_where_its_patches_are_mounted(pressed: Body) -> None:
    """By hand: a force along −z at the top, along −x in front, each at a patch's middle."""
    top, front = pressed.skins.values()
    top.press(BALL)
    front.press(Sphere(radius_m=0.02, position_m=(0.0, 0.0, 0.0175)))
    wait_for(lambda: len(pressed.read().contacts or ()) == 2)
    frame = pressed.read()
    down_n, back_n = (-frame.patches[name].wrench[2] for name in ("top", "front"))
    found = frame.contacts
    assert found is not None and frame.touched and not frame.untouched
    assert back_n > down_n > 1.0
    assert frame.wrench == pytest.approx(
        [-back_n, 0.0, -down_n, -0.5 * down_n, -0.2 * back_n, 0.0], abs=1e-9
    )
    stronger, weaker = found.contacts
    assert (stronger.patch, weaker.patch) == ("front", "top")
    assert stronger.position == pytest.approx([1.0, 0.0, 0.2], abs=1e-9)
    assert weaker.position == pytest.approx([0.0, 0.5, 1.0], abs=1e-9)
    assert stronger.normal == pytest.approx([1.0, 0.0, 0.0], abs=1e-9)
    assert stronger.force == pytest.approx([-back_n, 0.0, 0.0], abs=1e-9)
    own = frame.patches["front"].contacts
    assert own is not None and stronger.taxels.tolist() == own.taxels[0].tolist()
    assert (found.taxels_valid, found.taxels_in_service) == (32, 32)


def test_a_patch_that_fell_silent_is_known_in_time_and_claims_nothing(pressed: Body) -> None:
    """It is pressed right after its last frame, which says that nothing touches it."""
    assert pressed.stale_after_s == 0.4
    silence(pressed, "front")
    pressed.skins["front"].press(BALL)
    silent_s, frames = time.monotonic(), 0
    while not (frame := pressed.read()).missing:
        assert (frames := frames + 1) * 12.8e-3 < 0.8, "1 s without it"
    assert time.monotonic() - silent_s > 0.3 and frame.missing == ("front",)
    assert not frame.touched and not frame.untouched and np.isnan(frame.wrench).all()
    found = frame.contacts
    assert found is not None and (found.taxels_valid, found.taxels_in_service) == (16, 32)
    pressed.skins["top"].press(BALL)
    wait_for(lambda: pressed.read().touched)
    frame = pressed.read()
    assert frame.missing and frame.wrench[2] < -1.0, "a lower bound"
    # Now all are silent: that is said, too, and in the end it is an error.
    silence(pressed, "top")
    begun_s, told = time.monotonic(), list[BodyFrame]()
    with pytest.raises(PortError, match="no frame for 3 s"):
        while True:
            told.append(pressed.read())
    assert time.monotonic() - begun_s > 2.9
    assert len(told) > 3 and all(len(frame.missing) == 2 for frame in told)
    assert not any(frame.touched or frame.untouched for frame in told)
    assert all(np.isnan(frame.pressure_pa).all() for frame in told)
    del pressed.skins["top"].waiting
    assert "top" in pressed.read().patches
    assert Body(pressed.path, stale_after_s=7.0).stale_after_s == 7.0
    for wrong in (0.0, math.nan, "1", 1e9):
        with pytest.raises(ParameterError, match="stale_after_s"):
            Body(pressed.path, stale_after_s=wrong)  # type: ignore[arg-type]


def test_a_patch_of_which_no_stamp_is_of_now_is_missing_however_lately_it_came(
    pressed: Body,
) -> None:
    """As after a pause of the program, in which one patch fell silent and the other one did not."""
    patches = pressed.read().patches
    silence(pressed, *patches)
    for (name, frame), t_s in zip(patches.items(), (1e6, 1e6 + 0.5), strict=True):
        pressed._waiting[name].append(replace(frame, t_host=t_s, stamp_uncertainty_s=1e-3))
    found = pressed.read()
    assert found.missing == ("top",) and not found.untouched
    assert found.t_host == 1e6 + 0.5


def test_contacts_have_the_names_and_values_of_the_message() -> None:
    pytest.importorskip("rclpy")
    from rclpy.serialization import deserialize_message

    from tactile_cdma.messages.cdr import Heading
    from tactile_cdma.msg import TactileContact, TactileContacts
    from tactile_cdma.ros.driver.frames import contacts_message

    ball = Sphere(radius_m=0.005, position_m=(0.009, 0.009, 0.0035))
    with Skin("sim://?scene=external&speed=0&threshold=0&dead=3", contacts=True) as skin:
        frame = [skin.step(BALL, ball) for _ in range(3)][-1]
    assert frame.contacts is not None
    message = contacts_message(frame.contacts, frame, "", Heading(0, "skin"), 7)  # type: ignore[arg-type]
    told = deserialize_message(message, TactileContacts)
    assert (frame.contacts.taxels_valid, frame.contacts.taxels_in_service) == (15, 16)
    assert frame.contacts.taxels_valid == told.taxels_valid
    assert frame.contacts.taxels_in_service == told.taxels_in_service
    names = TactileContact.get_fields_and_field_types()
    assert [field.name for field in fields(Contact)] == list(names)
    for found, its in zip(frame.contacts.contacts, told.contacts, strict=True):
        for name in names:
            value, expected = getattr(found, name), getattr(its, name)
            if hasattr(expected, "x"):
                expected = [expected.x, expected.y, expected.z]
            if isinstance(value, np.ndarray | float):
                value, expected = pytest.approx(value, rel=1e-6), list(np.atleast_1d(expected))
                expected = expected if len(expected) > 1 or name == "taxels" else expected[0]
            assert expected == value, name
