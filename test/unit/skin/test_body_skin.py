# SPDX-License-Identifier: Apache-2.0

"""The patches of a body file as one skin, without ROS."""

import doctest
import sys
from itertools import dropwhile, islice, pairwise
from pathlib import Path

import numpy as np
import pytest

from tactile_cdma import Body, BodyError, Frame, PortError, Skin, Status

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
