# SPDX-License-Identifier: Apache-2.0

"""`tactile-cdma view --viewer rerun`: the skin of a port in Rerun, without ROS."""

import sys
from pathlib import Path

import numpy as np
import pytest

from tactile_cdma.skin import Skin
from test.support.command_line import Printed, Refused


def test_without_rerun_it_says_what_is_missing(
    refused: Refused, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert "pip install rerun-sdk" in refused("view", "sim://", "--viewer", "rerun")


def test_what_it_saves_are_the_frames_and_contacts(printed: Printed, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk is not installed (make view)")
    from test.support.rerun_files import columns_of

    skin, shown = tmp_path / "touch.skin", tmp_path / "touch.rrd"
    printed("record", "sim://?scene=presses", skin, "--seconds", "2", "--nodes", "16")
    printed("view", f"replay://{skin}", "--nodes", "16", "--viewer", "rerun", "--save", shown)
    with Skin(f"replay://{skin}", nodes=16, contacts=True) as replayed:
        frames = list(replayed)
    saved = columns_of(shown)

    peak_kpa = [np.nanmax(frame.pressure_pa) / 1e3 for frame in frames]
    np.testing.assert_allclose(np.ravel(saved["/skin/peak", "Scalars:scalars"]), peak_kpa)
    found = [frame.contacts for frame in frames]
    force_n = [np.linalg.norm(each.total_force_n) for each in found]
    assert np.nanmax(force_n) > 1.0
    np.testing.assert_allclose(np.ravel(saved["/skin/force", "Scalars:scalars"]), force_n)
    [corners_m] = saved["/skin/surface", "Mesh3D:vertex_positions"]
    np.testing.assert_allclose(np.reshape(corners_m, (-1, 6, 3)), replayed.layout.squares_m)
    arrows = {len(forces) for forces in saved["/skin/contacts", "Arrows3D:vectors"]}
    assert 1 in arrows and arrows <= {len(each) for each in found}
