# SPDX-License-Identifier: Apache-2.0

"""`tactile-cdma view`: the skin of a port in the terminal, in lines, and in Rerun without ROS."""

import os
import re
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tactile_cdma.base.interrupt import Stop
from tactile_cdma.commands.view import Shown, draw
from tactile_cdma.skin import Skin
from tactile_cdma.views import live
from tactile_cdma.views.live import look_for, obeyed
from test.support.command_line import Printed, Refused
from test.support.programs import on_a_terminal
from test.support.waiting import wait_for

VIEW = [sys.executable, "-u", "-m", "tactile_cdma", "view"]
SIZE = os.terminal_size((100, 40))


def test_no_terminal_or_port_is_told(refused: Refused, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "no terminal to draw on" in refused("view", "sim://")
    monkeypatch.setattr("tactile_cdma.commands.view.can_draw", lambda: True)
    assert "no such port" in refused("view", "/dev/tactile-none")


def test_a_terminal_shows_the_skin_and_obeys_keys() -> None:
    command = [*VIEW, "sim://?scene=all&threshold=0", "--nodes", "16"]
    steps = (r"force \d+\.\d\d N", b"h"), (r"peak \d+\.\d\d kPa", b"n"), ("speaking 16", b"q")
    shown = on_a_terminal(command, *steps, TERM="xterm", NO_COLOR="1")
    assert "lost 0" in shown and "\x1b[?1049l" in shown
    assert not re.search(r"\x1b\[[0-9;]*m", shown), "no colours"


def test_of_a_skin_that_stops_the_picture_has_no_reading(monkeypatch: pytest.MonkeyPatch) -> None:
    look = replace(look_for("ascii", 140e3), coloured=False)
    with Skin("sim://?scene=all&threshold=0", nodes=16) as skin:
        shown = Shown(skin)
        assert "waiting for the first frame" in draw(shown, look, True, SIZE)
        wait_for(lambda: shown.waited(Stop()) and shown.course.coverage.is_whole)
        before = draw(shown, look, True, SIZE)
        monkeypatch.setattr("tactile_cdma.commands.view.OLD_S", 0.0)  # as if a second had passed
        after = draw(shown, look, True, SIZE)
    assert "speaking 16" in before and re.search(r"force \d+\.\d\d N", before)
    assert "speaking 0" in after and "force -- N" in after
    assert "//--//" in after and "//--//" not in before


def test_it_ends_with_a_recording_or_after_its_time(printed: Printed, tmp_path: Path) -> None:
    path = tmp_path / "touch.skin"
    printed("record", "sim://?scene=all&threshold=0", path, "--seconds", "1.5", "--nodes", "16")
    assert "speaking 16" in on_a_terminal([*VIEW, f"replay://{path}"], TERM="xterm")
    assert "speaking" in on_a_terminal([*VIEW, "sim://", "--seconds", "2"], TERM="xterm")


def test_keys_of_a_windows_console_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    typed = [*"n+q"]
    console = SimpleNamespace(kbhit=lambda: bool(typed), getwch=lambda: typed.pop(0))
    monkeypatch.setattr(live, "import_module", {"msvcrt": console}.__getitem__)
    monkeypatch.setitem(sys.modules, "termios", None)
    with live.typed_keys() as keys:
        assert keys() == "n+q" and keys() == ""
    look = look_for("utf-8", 1000.0)
    for key in "n+":
        look, _ = obeyed(key, look, True)
    assert look.numbers is not None and look.max_pa == 2000.0


# In Rerun


def test_that_rerun_is_missing_is_told(refused: Refused, monkeypatch: pytest.MonkeyPatch) -> None:
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
