# SPDX-License-Identifier: Apache-2.0

"""The file of tare and drift: written content is read back; other files are refused."""

import os
import stat
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tactile_cdma.base import whole_file
from tactile_cdma.base.errors import RestError
from tactile_cdma.readings.calibration import Curves, PressureCurve
from tactile_cdma.rest.rest_file import (
    RestState,
    calibration_path,
    read_rest,
    rest_path,
    set_aside,
    write_rest,
)

STATE = RestState(
    skin="left palm",
    simulated=True,
    scene="sim://?scene=idle",
    nodes=3,
    calibration="0123456789ab",
    curves="89abcdef",
    written="2026-11-21T16:00:00+01:00",
    tared="2026-11-21T15:00:00+01:00",
    rest_v=np.array([3.0, 2.9, 1.5], np.float32),
    drift_v=np.array([1e-3, -2e-6, 0.0], np.float32),
)


def values(limit: float) -> st.SearchStrategy[np.ndarray | None]:
    return st.none() | arrays(np.float32, 3, elements=st.floats(-limit, limit, width=32))


@given(*[values(8.0)] * 4)
def test_what_is_written_is_read_to_far_below_a_count(
    tmp_path_factory: pytest.TempPathFactory,
    rest_v: np.ndarray | None,
    drift_v: np.ndarray | None,
    tared_drift_v: np.ndarray | None,
    least_v: np.ndarray | None,
) -> None:
    path = tmp_path_factory.mktemp("rest") / "skin.rest.yaml"
    state = replace(
        STATE, rest_v=rest_v, drift_v=drift_v, tared_drift_v=tared_drift_v, least_v=least_v
    )
    write_rest(path, state)
    back = read_rest(path)
    assert back is not None
    for name in (
        "skin",
        "simulated",
        "scene",
        "nodes",
        "calibration",
        "curves",
        "written",
        "tared",
    ):
        assert getattr(back, name) == getattr(STATE, name)
    for name in ("rest_v", "drift_v", "tared_drift_v", "least_v"):
        ours, theirs = getattr(state, name), getattr(back, name)
        assert (ours is None) == (theirs is None)
        if ours is not None and theirs is not None:
            assert theirs.dtype == np.float32
            assert np.allclose(ours, theirs, rtol=1e-6, atol=1e-8)


def test_no_file_is_no_state(tmp_path: Path) -> None:
    assert read_rest(tmp_path / "none.yaml") is None


def test_files_are_named_after_their_node_below_ros_home(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("ROS_HOME", str(tmp_path / "ros"))
    assert rest_path("", "/skin") == tmp_path / "ros" / "tactile_cdma" / "skin.rest.yaml"
    monkeypatch.delenv("ROS_HOME")
    below_home = tmp_path / "home" / ".ros" / "tactile_cdma"
    assert rest_path("", "/left/hand/skin") == below_home / "left.hand.skin.rest.yaml"
    assert rest_path("~/skins", "/skin") == tmp_path / "home" / "skins" / "skin.rest.yaml"
    simulated = rest_path("~/skins", "/skin", simulated=True)
    assert simulated == tmp_path / "home" / "skins" / "skin-simulated.rest.yaml"


def test_no_two_nodes_share_a_file() -> None:
    nodes = ("/skin", "/a/rest/skin", "/a/calibration/skin", "/rest", "/calibration")
    rests = [rest_path("/state", node, kind) for node in nodes for kind in (False, True)]
    assert calibration_path(rests[0]) == Path("/state/skin.calibration.yaml")
    assert len({*rests, *map(calibration_path, rests)}) == 4 * len(nodes)


def test_a_home_that_nobody_has_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(
        RestError, match=r"~nobody-of-that-name/skins: tare .* the user after ~ has no home"
    ):
        rest_path("~nobody-of-that-name/skins", "/skin")
    monkeypatch.setenv("ROS_HOME", "~nobody-of-that-name")
    with pytest.raises(RestError, match="~nobody-of-that-name/tactile_cdma"):
        rest_path("", "/skin")


def test_writing_replaces_the_file_and_leaves_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "folder" / "skin.rest.yaml"
    write_rest(path, STATE)
    write_rest(path, replace(STATE, rest_v=None))
    back = read_rest(path)
    assert back is not None and back.rest_v is None
    assert os.listdir(path.parent) == [path.name]


def test_a_folder_that_cannot_be_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(RestError, match=r"file/skin\.yaml: tare and drift are not kept: "):
        write_rest(tmp_path / "file" / "skin.yaml", STATE)
    if getattr(os, "geteuid", int)() != 0:
        tmp_path.chmod(stat.S_IREAD | stat.S_IEXEC)
        with pytest.raises(RestError, match="not kept: Permission denied"):
            write_rest(tmp_path / "skin.yaml", STATE)


def test_files_that_are_set_aside_stay_whole_however_many(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And at no moment there is none: a kill before the next write loses nothing."""
    path = tmp_path / "skin.rest.yaml"
    assert set_aside(path) is None
    monkeypatch.setattr(whole_file, "MOST_ASIDE", 12)
    for number in range(1, 13):
        write_rest(path, replace(STATE, skin=f"skin {number}"))
        aside = set_aside(path)
        assert aside == tmp_path / f"skin.rest.yaml.old{number if number > 1 else ''}"
        for kept in (aside, path, tmp_path / "skin.rest.yaml.old"):
            state = read_rest(kept)
            assert state is not None and state.skin in (f"skin {number}", "skin 1")
    with pytest.raises(
        RestError, match=r"cannot be set aside: remove some of skin\.rest\.yaml\.old"
    ):
        set_aside(path)


def test_a_link_is_replaced_not_its_target(tmp_path: Path) -> None:
    target, path = tmp_path / "mine.yaml", tmp_path / "skin.rest.yaml"
    target.write_text("precious")
    path.symlink_to(target)
    write_rest(path, STATE)
    assert target.read_text() == "precious" and read_rest(path) is not None


GOOD = {
    "schema": "tactile_cdma/rest",
    "version": 1,
    "written": "",
    "skin": "",
    "simulated": "no",
    "nodes": 2,
    "calibration": "",
    "curves": "",
    "tared": "",
    "rest_v": [3, 2.9],
    "drift_v": None,
}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"schema": "something/else"}, "it must be 'tactile_cdma/rest'"),
        ({"version": 2}, "version is 2; this program reads version 1"),
        ({"nodes": "x"}, "line 4: nodes is 'x'; it must be a whole number"),
        ({"skin": [5]}, "skin is a list; it must be text"),
        ({"rest_v": [1.0]}, "rest_v has 1 entries; it must have 2"),
        ({"rest_v": "12"}, "rest_v is '12'; it must be a list"),
        ({"rest_v": [1.0, "x"]}, "number 2 of rest_v is 'x'"),
        ({"rest_v": [True, 1.0]}, "number 1 of rest_v is 'true'"),
        ({"rest_v": [1.0, float("nan")]}, "number 2 of rest_v is .nan"),
        ({"drift_v": [0.0, 101.0]}, "number 2 of drift_v is 101; it must lie within -100…100 V"),
    ],
)
def test_damaged_content_is_refused_with_the_file_and_the_cause(
    tmp_path: Path, change: dict[str, object], reason: str
) -> None:
    path = tmp_path / "skin.rest.yaml"
    path.write_text(yaml.safe_dump(GOOD))
    assert read_rest(path) is not None
    path.write_text(yaml.safe_dump({**GOOD, **change}))
    with pytest.raises(RestError) as refused:
        read_rest(path)
    assert reason in str(refused.value)
    assert str(path) in str(refused.value)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "empty"),
        (b"- a\n- b", "must be keys with values"),
        (b"a: b", "schema"),
        (b"a: [1, 2", "not a YAML file"),
        (b"!!python/object/apply:os.system ['true']", "must be keys with values"),
    ],
)
def test_files_of_any_other_kind_are_refused(tmp_path: Path, data: bytes, reason: str) -> None:
    """test_marked_yaml has what else is no plain YAML."""
    path = tmp_path / "skin.rest.yaml"
    path.write_bytes(data)
    with pytest.raises(RestError, match=reason):
        read_rest(path)
    assert path.read_bytes() == data


def test_a_state_fits_its_skin_only() -> None:
    def misfit(**present: Any) -> str:
        return STATE.misfit(replace(STATE, **{"skin": "", "scene": "", **present})) or ""

    assert STATE.misfit(STATE) is None
    assert not misfit()
    assert not misfit(simulated=None)
    assert replace(STATE, skin="").misfit(replace(STATE, skin="right palm")) is None
    assert "of skin 'left palm', this is 'right palm'" in misfit(skin="right palm")
    assert "of a simulated skin, this is a real one" in misfit(simulated=False)
    assert "of sim://?scene=idle, this is sim://?scene=" in misfit(scene="sim://?scene=press")
    assert "of 3 nodes, this one has 4" in misfit(nodes=4)
    assert "other curves (calibration 0123456789ab): tare again" in misfit(curves="00000000")


def test_curves_are_told_apart_by_their_checksum() -> None:
    one, other = PressureCurve.two_stage(), PressureCurve.two_stage(v0_v=3.299)
    sums = [Curves.of(pair).checksum for pair in ([one, one], [one, other], [other, one])]
    assert len(set(sums)) == 3
    assert Curves.of([one, other]).checksum == sums[1]
