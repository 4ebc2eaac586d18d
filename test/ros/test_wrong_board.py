# SPDX-License-Identifier: Apache-2.0

"""A driver node and the wrong board, over real DDS: it is refused, reported, and replaced."""

import json
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from serial.tools import list_ports

from tactile_cdma.commands.cli import main
from tactile_cdma.ros import doctor
from test.support.boards import board, board_id, plugged, usb_port
from test.support.skin_client import hurrying
from test.support.waiting import wait_for


def test_the_wrong_board_is_refused_and_the_right_one_taken(tmp_path: Path) -> None:
    link = tmp_path / "tty"
    with hurrying(port=str(link), digitizer_id=board_id(1)) as (node, client):

        def told(text: str) -> bool:
            return any(
                text in status.message and status.level == DiagnosticStatus.ERROR
                for status in client.diagnostics
            )

        with plugged(board(2), link):
            node._start()  # it tries by itself every 2 s
            wait_for(lambda: told("wrong digitizer"))
            assert told(board_id(1))
            assert told(board_id(2))
            assert client.arrays == []
            assert client.state() == "active"
        with plugged(board(1), link):
            wait_for(lambda: len(client.arrays) > 20)


def test_a_node_finds_its_board_by_usb_number_on_whichever_port(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    kernel: list[tuple[str, str]] = []
    monkeypatch.setattr(list_ports, "comports", lambda: [usb_port(*port) for port in kernel])
    wanted = {"port": "usb://0A", "digitizer_id": board_id(1)}
    with plugged(board(1)) as first, hurrying(**wanted) as (node, client):
        wait_for(lambda: client.says("USB serial number"))
        kernel[:] = [(first, "0A")]
        node._start()
        wait_for(lambda: len(client.arrays) > 20)


def test_two_programs_meet(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--json"]) == 0
    found = {f["subject"]: f for f in json.loads(capsys.readouterr().out)}
    assert "two programs met" in found["DDS"]["text"]
    for subject in ("Python", "numpy", "our messages", "ROS_DOMAIN_ID"):
        assert found[subject]["verdict"] == "ok"


@pytest.mark.parametrize(
    ("name", "value", "verdict"),
    [
        ("ROS_DOMAIN_ID", "0", "ok"),
        ("ROS_DOMAIN_ID", "150", "warning"),
        ("ROS_DOMAIN_ID", "233", "problem"),
        ("ROS_DOMAIN_ID", "-1", "problem"),
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCAL", "problem"),
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF", "warning"),
        ("ROS_LOCALHOST_ONLY", "1", "warning"),
    ],
)
def test_settings_of_discovery(
    monkeypatch: pytest.MonkeyPatch, name: str, value: str, verdict: str
) -> None:
    monkeypatch.setenv(name, value)
    [check] = [check for check in doctor.environment() if check.subject == name]
    assert check.verdict == verdict


def test_messages_that_changed_since_they_were_built_are_named(tmp_path: Path) -> None:
    checkout, prefix = tmp_path / "src", tmp_path / "install"
    built = prefix / "share" / "tactile_cdma"
    for folder in (checkout, built):
        (folder / "msg").mkdir(parents=True)
        (folder / "package.xml").touch()
        for name in ("A", "B"):
            (folder / "msg" / f"{name}.msg").write_text("float32 pressure\n")
    prefixes = ["", str(tmp_path / "nothing"), str(prefix)]
    assert doctor.stale_messages(checkout, prefixes) == []
    (checkout / "msg" / "B.msg").write_text("float64 pressure\n")
    (checkout / "msg" / "C.msg").touch()
    assert doctor.stale_messages(checkout, prefixes) == ["B.msg", "C.msg"]
