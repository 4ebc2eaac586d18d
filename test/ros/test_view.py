# SPDX-License-Identifier: Apache-2.0

"""Viewers: names of patches, error messages of the driver, a terminal without colours."""

import math
import os
import re
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import count, product
from typing import Any

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from tactile_cdma.config.body_file import full_name
from tactile_cdma.msg import TactileArray, TactileContact, TactileContacts
from tactile_cdma.ros.common.newest import COUNT_S
from tactile_cdma.ros.common.qos import QUEUE
from tactile_cdma.ros.viewers.body_view import BodyViewer
from tactile_cdma.ros.viewers.body_view import line as body_line
from tactile_cdma.ros.viewers.view import Viewer, draw
from tactile_cdma.ros.viewers.watched import MOST_ENTRIES, Complaints
from tactile_cdma.views.live import look_for
from test.support.impostor import impostor
from test.support.programs import on_a_terminal, run_program, run_python, started
from test.support.skin_client import running
from test.support.spinning import living, spinning
from test.support.waiting import wait_for


@pytest.mark.parametrize(
    ("patch", "name"),
    [
        ("skin", "/skin"),
        ("/skin", "/skin"),
        ("left_palm", "/left_palm/skin"),
        ("/left_palm/skin", "/left_palm/skin"),
        ("robot/left_palm/skin", "/robot/left_palm/skin"),
    ],
)
def test_a_patch_is_called_by_its_namespace_or_its_whole_name(patch: str, name: str) -> None:
    assert full_name(patch) == name


def test_two_drivers_of_one_name_are_told_of() -> None:
    node, viewer = rclpy.create_node("drivers"), Viewer("/twice/skin/tactile")
    with spinning([node], [viewer]):
        node.create_publisher(TactileArray, "/twice/skin/tactile", QUEUE)
        time.sleep(3 * COUNT_S)
        assert viewer.complaint == ""
        node.create_publisher(TactileArray, "/twice/skin/tactile", QUEUE)
        wait_for(lambda: viewer.complaint.startswith("2 drivers publish /twice/skin/tactile"))


def status(name: str, level: bytes, message: str) -> DiagnosticStatus:
    return DiagnosticStatus(name=name, level=level, message=message)


def test_complaints_are_the_newest_of_one_node_the_worst_first() -> None:
    complaints = Complaints("skin")
    first = [
        status("skin: link", DiagnosticStatus.WARN, "CRC errors"),
        status("skin: nodes", DiagnosticStatus.ERROR, "dead"),
        status("skin: host", DiagnosticStatus.OK, "fine"),
        status("left/skin: nodes", DiagnosticStatus.ERROR, "of another patch"),
    ]
    assert len(complaints.take(DiagnosticArray(status=first))) == 3
    assert [entry.message for entry in complaints.worst_first()] == ["dead", "CRC errors"]
    again = [first[0], status("skin: nodes", DiagnosticStatus.OK, "fine")]
    assert complaints.take(DiagnosticArray(status=again)) == again[1:], "what has changed"
    assert [entry.message for entry in complaints.worst_first()] == ["CRC errors"]


def test_a_strangers_complaints_neither_break_nor_fill_the_viewer() -> None:
    complaints = Complaints("skin")
    strange = [status("skin: link", b"\x07", "of no level"), status("skin: a", b"\2", "\033[2J\n")]
    many = [status(f"skin: {number}", DiagnosticStatus.ERROR, "") for number in range(1000)]
    complaints.take(DiagnosticArray(status=strange + many))
    shown = complaints.worst_first()
    assert len(shown) == MOST_ENTRIES
    assert shown[0].message.isprintable()
    assert "skin: link" not in [entry.name for entry in shown]


def test_the_terminal_says_what_can_be_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NO_COLOR", raising=False)
    assert look_for("utf-8", 1e3).coloured and look_for("UTF-8", 1e3).unicode
    assert not look_for("iso-8859-1", 1e3).unicode
    monkeypatch.setenv("NO_COLOR", "1")
    assert not look_for("utf-8", 1e3).coloured


VIEWER = [sys.executable, "-u", "-m", "tactile_cdma.ros.viewers.view"]


def test_terminals_without_colours_or_without_a_cursor_are_served_too() -> None:
    with running(port="sim://?scene=press"):
        shown = on_a_terminal(VIEWER, ("frames/s", b"q"), TERM="xterm", NO_COLOR="1")
        assert "\x1b[?1049l" in shown and "received=" in shown.splitlines()[-1]
        assert not re.search(r"\x1b\[[0-9;]*m", shown), "no colours"
        shown = on_a_terminal(VIEWER, ("taxels valid", b"\x03"), TERM="dumb")
        assert "\x1b" not in shown and "received=" in shown.splitlines()[-1]


DEAD = ",".join(str(node) for node in range(1, 17))


@pytest.mark.parametrize("frames_stop", [False, True])
def test_lines_of_a_skin_that_stops_or_dies_count_no_taxel_as_valid(frames_stop: bool) -> None:
    """At first all is read; then all nodes die, or frames stop."""
    port = f"sim://?scene=press&dead={DEAD}&dead_after={3600 if frames_stop else 4}"
    last = (not frames_stop, "--", 0)
    told: list[tuple[bool, str, int]] = []
    with started(VIEWER, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE) as viewer:
        with living(rclpy.create_node("observer")) as observer:
            wait_for(lambda: observer.count_subscribers("/skin/tactile"))
        with running(port=port, stale_after_s=1.5) as (_, client):
            assert viewer.stdout is not None
            for line in viewer.stdout:
                found = re.search(r"(\d+) frames .* peak +(\S+) kPa  (\d+)/16 taxels valid", line)
                assert found, line
                told.append((int(found[1]) > 0, found[2], int(found[3])))
                was_read = any(frames and valid == 16 for frames, _, valid in told)
                if was_read and frames_stop and client.state() == "active":
                    assert client.change("deactivate")
                if was_read and told[-1] == last:
                    break
    assert told[-1] == last
    assert all(peak == "--" for _, peak, valid in told if not valid)


def test_the_picture_of_a_skin_that_stops_turns_to_no_reading() -> None:
    with running(port="sim://?scene=all&threshold=0") as (_, client):
        stop = partial(client.change, "deactivate")
        steps = (r"force \d+\.\d\d N", stop), ("no frame for", b"q")
        shown = on_a_terminal(VIEWER, *steps, TERM="xterm", NO_COLOR="1")
    pictures = shown.split("\x1b[H")
    drawn = [picture for picture in pictures if "frames/s" in picture]
    before = [picture for picture in drawn if "no frame for" not in picture]
    after = next(picture for picture in drawn if "no frame for" in picture)
    assert "speaking 16" in before[-1] and re.search(r"force \d+\.\d\d N", before[-1])
    assert "speaking 0" in after and "force -- N" in after
    assert "//--//" in after and "//--//" not in before[-1]


@pytest.mark.parametrize("age_s", [7200.0, -7200.0])
def test_frames_that_are_not_of_now_are_not_shown_but_told(age_s: float) -> None:
    viewer, number = Viewer("/other/tactile"), count(1)
    look, size = look_for("ascii", 140e3), os.terminal_size((100, 40))
    with impostor() as other, spinning([viewer]):
        told = f"its stamps are {age_s:+.1f} s off"
        wait_for(lambda: other.send(next(number), age_s) or viewer.complaint.startswith(told))
        assert viewer.latest is None
        wait_for(lambda: other.send(next(number)) or (viewer.latest and not viewer.complaint))
        latest = viewer.latest
        assert latest is not None and not viewer.silent_s
        assert viewer.reading(latest).pressure_pa.tolist() == list(latest.pressure)
        wait_for(lambda: other.send(next(number), age_s) or viewer.silent_s)
        assert np.isnan(viewer.reading(viewer.latest).pressure_pa).all()
        assert told in draw(viewer, look, True, size)


def test_a_body_viewer_tells_of_messages_that_are_not_of_now() -> None:
    viewer = BodyViewer("/other")
    with impostor() as other, spinning([viewer]):
        wait_for(lambda: other.send(5) or viewer.newest.is_of_now)
        wait_for(lambda: other.send(5) or not viewer.newest.is_of_now)
        assert viewer.complaint == "frame 5 comes again, or after a later one"


@pytest.mark.parametrize(
    ("dead", "stale", "force"),
    [("6", "stale -: 5 ", r"force > \d+\.\d\d N"), (DEAD, "stale -: 0-15 ", "force -- N")],
)
def test_the_force_of_a_skin_with_dead_nodes_is_at_least_or_unknown(
    dead: str, stale: str, force: str
) -> None:
    with running(port=f"sim://?scene=press&dead={dead}"):
        viewer = Viewer("/skin/tactile")

        def shows_force() -> bool:
            """Frames that a busy machine loses leave it unknown; it is never said to be known."""
            if viewer.latest is None:
                return False
            look, size = look_for("ascii", 140e3), os.terminal_size((100, 40))
            screen = draw(viewer, look, True, size)
            assert not re.search(r"force \d", screen)
            return stale in screen and bool(viewer.layout and re.search(force, screen))

        with spinning([viewer]):
            wait_for(lambda: shows_force() and viewer.tally.received > 100)


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"taxels_valid": 80, "untouched": True}, " 50.0 Hz    0.0 N  no contact"),
        ({"taxels_valid": 79}, " 50.0 Hz     -- N  unknown  79 of 80 taxels valid"),
        ({"taxels_valid": 80, "absent": ["/a/skin"]}, " 50.0 Hz     -- N  unknown  absent: a"),
        (
            {"taxels_valid": 79, "touched": True, "contacts": [TactileContact(patch="/a/skin")]},
            " 50.0 Hz   >2.0 N  a 0.0 N (0 0 0 mm)  79 of 80 taxels valid",
        ),
    ],
)
def test_a_line_of_a_body_says_what_is_unknown(fields: dict[str, Any], text: str) -> None:
    message = TactileContacts(taxels_in_service=80, **fields)
    message.wrench.force.z = 2.0 if message.touched else 0.0 if message.untouched else math.nan
    assert body_line(message, 50.0, "") == text


def test_a_patch_that_is_not_there_is_answered_with_those_that_are() -> None:
    with running(port="sim://"):
        done = run_python("-m", "tactile_cdma.ros.viewers.view", "palm", "--seconds", "1")
    assert done.returncode == 1
    # The nodes of a test before may not be forgotten yet.
    assert re.search(r"no frame on /palm/skin/tactile: there is (.*, )?/skin/tactile", done.stderr)


CUT = {" | head -1": 0, ">/dev/full": 1, ">&-": 0}
"""Where the output goes, and the code of the viewer's end."""


def test_output_that_is_cut_full_or_closed_ends_a_viewer_in_one_line() -> None:
    def run(viewer: str, output: str) -> subprocess.CompletedProcess[str]:
        options = "--body /skin" * (viewer == "body_view")  # a driver's contacts are as a body's
        command = f"{sys.executable} -m tactile_cdma.ros.viewers.{viewer} {options} --seconds 3"
        return run_program("bash", "-c", f"set -o pipefail; {command} {output}")

    cases = list(product(("view", "body_view"), CUT))
    with running(port="sim://?scene=press"), ThreadPoolExecutor(len(cases)) as pool:
        ended = list(pool.map(lambda case: run(*case), cases))
    for (viewer, output), done in zip(cases, ended, strict=True):
        assert done.returncode == CUT[output], (viewer, output, done.stderr)
        assert len(done.stdout.splitlines()) == ("head" in output)
        assert "Traceback" not in done.stderr
        assert done.stderr.endswith("No space left on device\n") or not CUT[output]
