# SPDX-License-Identifier: Apache-2.0

"""What a driver node says of its source, and a board that prints numbers as a source."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus

from tactile_cdma.commands.cli import main
from tactile_cdma.msg import TactileContacts, TactileSkinInfo
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.srv import Tare
from test.support.boards import Board, plugged
from test.support.printing_board import checked, printing
from test.support.skin_client import Client, hurrying
from test.support.waiting import wait_for

OK, WARN = DiagnosticStatus.OK, DiagnosticStatus.WARN
BOARD, SIMULATED = TactileSkinInfo.ORIGIN_BOARD, TactileSkinInfo.ORIGIN_SIMULATED
REPLAYED, DEMONSTRATOR = TactileSkinInfo.ORIGIN_REPLAYED, TactileSkinInfo.ORIGIN_DEMONSTRATOR
NAMES = {BOARD: "board", SIMULATED: "simulated", DEMONSTRATOR: "demonstrator"}
OPTIONS = SimOptions(scene="press", seed=3)
SIMULATOR_ID = "73696D0003000000"
DEMO = "73696D00414201DE"
FIRST, SECOND = "E660000000000001", "E660000000000002"


def simulator() -> VirtualDigitizer:
    return VirtualDigitizer(OPTIONS)


def a_board(number: str) -> Callable[[], Board]:
    return lambda: Board(OPTIONS, number)


def told(client: Client, level: bytes, text: str) -> Callable[[], bool]:
    """Whether the newest entry says so at this level."""
    return lambda: client.entry("source").level == level and text in client.entry("source").message


def origin(client: Client) -> tuple[int, int, str]:
    info = client.infos[-1]
    return info.origin, info.measured_by, info.digitizer_id


def warnings(said: str) -> list[str]:
    """Lines of a log that warn of a source; others are of files that earlier tests left."""
    words = ("simulated", "digitizer")
    lines = [line for line in said.splitlines() if line.startswith("[WARN]")]
    lines = [line for line in lines if "tare and drift are those of" not in line]
    return [line for line in lines if any(word in line for word in words)]


def test_a_simulator_that_was_asked_for_is_named_and_no_warning(
    capfd: pytest.CaptureFixture[str],
) -> None:
    with hurrying(port="sim://?seed=3", skin="palm") as (_, client):
        wait_for(lambda: client.arrays)
        wait_for(told(client, OK, f"simulated, {SIMULATOR_ID}"))
        wait_for(lambda: origin(client) == (SIMULATED, SIMULATED, SIMULATOR_ID))
        assert client.infos[-1].skin == "palm"
        names = "skin", "digitizer", "origin", "measured by"
        said = [client.value("source", name) for name in names]
        assert said == ["palm", SIMULATOR_ID, "simulated", "simulated"]
        assert client.arrays[0].info_id == client.infos[-1].info_id, "who it is comes first"
    assert warnings(capfd.readouterr().err) == []


def test_a_simulation_that_nobody_asked_for_is_warned_of_once_and_for_as_long_as_it_lasts(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with hurrying(state_folder=str(tmp_path)) as (_, client):  # no tare that would be told of, too
        wait_for(told(client, WARN, "simulated, because no port is given"))
        assert client.change("deactivate")
        client.arrays.clear()
        client.entries.clear()
        assert client.change("activate")
        wait_for(lambda: len(client.arrays) > 80)
        wait_for(told(client, WARN, "simulated, because no port is given"))
        assert client.infos[-1].origin == SIMULATED
    [warning] = warnings(capfd.readouterr().err)
    assert "set port" in warning


def test_another_board_on_the_port_is_told_of_once(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    link = tmp_path / "ttyACM0"
    with hurrying(port=str(link), autostart=False) as (_, client):
        with plugged(a_board(FIRST), link):
            assert client.change("configure", "activate")
            wait_for(told(client, OK, f"board, {FIRST}"))
            wait_for(lambda: origin(client) == (BOARD, BOARD, FIRST))
        with plugged(a_board(SECOND), link):
            wait_for(told(client, WARN, f"{SECOND}, before {FIRST}"))
            wait_for(lambda: origin(client) == (BOARD, BOARD, SECOND))
            wait_for(told(client, OK, f"board, {SECOND}"))
        client.arrays.clear()
        with plugged(a_board(SECOND), link):  # the same one again: no news
            wait_for(lambda: len(client.arrays) > 20)
            wait_for(told(client, OK, f"board, {SECOND}"))
        assert client.value("source", "changes of the digitizer") == "1"
        assert client.change("deactivate")
        client.entries.clear()
        client.infos.clear()
        with plugged(a_board(FIRST), link):  # changed while the node did not look
            assert client.change("activate")
            wait_for(lambda: client.infos)
            assert {info.digitizer_id for info in client.infos} == {FIRST}, (
                "not who was there before"
            )
            wait_for(told(client, WARN, f"{FIRST}, before {SECOND}"))
    said = [line for line in warnings(capfd.readouterr().err) if ", before " in line]
    assert len(said) == 2
    assert f"{SECOND}, before {FIRST}" in said[0] and "Set digitizer_id" in said[0]


def test_a_replay_says_so_and_of_what(tmp_path: Path) -> None:
    kinds = ((a_board(FIRST), BOARD), (simulator, SIMULATED), (a_board(DEMO), DEMONSTRATOR))
    for number, (power_up, kind) in enumerate(kinds):
        path = tmp_path / f"{number}.skin"
        with plugged(power_up, tmp_path / "tty") as port:
            assert main(["record", port, str(path), "--seconds", "1", "--nodes", "16"]) == 0
        with hurrying(port=f"replay://{path}?loop=true") as (_, client):
            wait_for(told(client, OK, f"replayed from replay://{path}"))
            wait_for(lambda kind=kind: origin(client)[:2] == (REPLAYED, kind))
            assert client.value("source", "measured by") == NAMES[kind]


def test_a_demonstrators_tare_is_not_a_boards(tmp_path: Path) -> None:
    link, idle = tmp_path / "ttyACM0", SimOptions(scene="idle")
    with hurrying(port=str(link), state_folder=str(tmp_path)) as (_, client):
        with plugged(lambda: Board(idle, DEMO), link):
            wait_for(told(client, WARN, "is a demonstrator, whose nodes have no sensors"))
            wait_for(lambda: origin(client) == (DEMONSTRATOR, DEMONSTRATOR, DEMO))
            wait_for(lambda: client.arrays)
            wait_for(lambda: client.call(Tare, "tare", Tare.Request()).success)
            wait_for(lambda: len(client.infos[-1].tare) > 0)
        with plugged(lambda: Board(idle, FIRST), link):
            wait_for(lambda: origin(client) == (BOARD, BOARD, FIRST))
            wait_for(lambda: len(client.infos[-1].tare) == 0)


QUERY = "before=index,us&after=check"


def is_well(stream: DiagnosticStatus) -> bool:
    """Whether nothing is wrong with it, but that a busy computer is late."""
    return stream.level == DiagnosticStatus.OK or "this computer does not keep up" in stream.message


def test_a_printing_board_is_a_skin_on_all_topics() -> None:
    def line(made: int) -> bytes:
        codes = [1022] * 6 if made < 300 else [700, 1022, 1022, 700, 1022, 1022]
        return checked([made, made * 10_000, *codes])

    with printing(line) as device:
        port = f"text://{device}?{QUERY}"
        with hurrying(port=port, nodes=6, rows=2, columns=3) as (_, client):
            contacts = client.heard(TactileContacts, "/skin/contacts", 1000)
            wait_for(lambda: contacts[-1].touched)
            wait_for(lambda: is_well(client.entry("stream")))
            wait_for(lambda: abs(float(client.value("stream", "expected rate (Hz)")) - 100) < 2)
            array, origin = client.arrays[-1], client.infos[-1].measured_by
    assert origin == client.infos[-1].ORIGIN_BOARD
    pressure_pa = np.array(array.pressure)
    assert (pressure_pa[[0, 3]] > 10e3).all() and (pressure_pa[[1, 2, 4, 5]] < 2e3).all()
    assert math.isfinite(contacts[-1].wrench.force.z) and contacts[-1].contacts


def test_another_count_of_numbers_is_in_the_diagnostics() -> None:
    with (
        printing(lambda _: b"1,2,3\n") as device,
        hurrying(port=f"text://{device}", nodes=6) as (_, client),
    ):
        wait_for(lambda: client.says("lines of 3 numbers come, but nodes is 6"))
