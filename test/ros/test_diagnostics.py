# SPDX-License-Identifier: Apache-2.0

"""/diagnostics of a driver with faults, over real DDS."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import Log
from rclpy.qos import DurabilityPolicy, QoSProfile

from tactile_cdma.code.encode import frame_levels, line_chips
from tactile_cdma.ros.driver.diagnostics import ENTRIES, NO_FRAMES
from tactile_cdma.sim import line
from tactile_cdma.sim.digitizer import VirtualDigitizer
from test.support.boards import plugged
from test.support.skin_client import Client, hurrying, running
from test.support.waiting import PATIENCE_S, wait_for

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
STALE = DiagnosticStatus.STALE
PAST = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def says(client: Client, entry: str, level: bytes, text: str) -> Callable[[], bool]:
    """Whether an entry has said so at this level."""
    return lambda: any(
        status.level == level and text in status.message for status in client.entries.get(entry, [])
    )


def complaint(entry: str, level: bytes, text: str, **parameters: Any) -> Client:
    """Run a driver until it says so; its client."""
    with hurrying(**parameters) as (_, client):
        wait_for(says(client, entry, level, text))
    return client


def test_a_sound_skin_has_four_entries_that_are_ok_and_complete() -> None:
    def number(entry: str, key: str) -> float:
        return float(client.value(entry, key))

    for _ in range(5):  # a busy machine may lose frames
        with running(port="sim://?scene=moving&threshold=0&seed=7") as (_, client):
            wait_for(lambda: len(client.entries.get("host", [])) >= 4)
            wait_for(lambda: {client.entry(entry).level for entry in ENTRIES} == {OK})
        if client.value("stream", "lost frames") == "0" and number("stream", "rate (Hz)") > 55:
            break
    assert number("stream", "rate (Hz)") == pytest.approx(78.1, rel=0.3)
    assert set(client.entries) == set(ENTRIES)
    assert {client.entry(entry).name for entry in ENTRIES} == {f"skin: {e}" for e in ENTRIES}
    identity = (b"sim\0" + (7).to_bytes(4, "little")).hex().upper()
    assert {client.entry(entry).hardware_id for entry in ENTRIES} == {identity}

    stages = ("line and link", "decoding", "publishing")
    parts_ms = [number("stream", f"latency: {stage} (ms)") for stage in stages]
    assert number("stream", "latency (ms)") == pytest.approx(sum(parts_ms), abs=0.01)
    assert 0 < number("stream", "latency (ms)") <= number("stream", "latency, slowest (ms)")
    assert parts_ms[0] >= 5.0 - 0.1, "half a code frame of 10 ms passes before it is all there"
    # Means of the 4 samples of a chip, of 5 mV each.
    assert number("stream", "noise floor (V rms)") == pytest.approx(2.5e-3, rel=0.2)
    assert number("nodes", "SNR of the weakest node (dB)") == pytest.approx(
        20 * np.log10(0.3 * np.sqrt(20) / 2.5e-3), abs=2.0
    )
    assert 1 <= number("nodes", "weakest node") <= 16
    kinds = ("dead", "stale", "weak", "faulty", "doubled", "stuck")
    assert {client.value("nodes", f"{kind} nodes") for kind in kinds} == {""}
    assert number("link", "bytes (per s)") > 0.9 * number("stream", "rate (Hz)") * 1600
    assert number("stream", "expected rate (Hz)") == pytest.approx(78.125, abs=0.01)
    lossless = ("crc errors", "framing errors", "lost packets", "digitizer packets dropped")
    assert [client.value("link", name) for name in lossless] == ["0"] * 4
    assert client.value("stream", "lost frames") == "0"
    assert number("link", "crc errors (per s)") == number("link", "framing errors (per s)") == 0
    assert 0 < number("host", "CPU of the driver's thread (%)") <= 100
    assert number("host", "CPU of the process (%)") > 0


def test_dead_nodes_are_told_from_those_that_fall_silent() -> None:
    """Nodes 3 and 7 never speak, the others at a heartbeat of a second."""
    port = "sim://?scene=idle&dead=3,7"
    with hurrying(port=port, stale_after_s=1.5) as (_, client):
        wait_for(says(client, "nodes", WARN, "never heard: nodes 3, 7;"))
        wait_for(lambda: client.value("nodes", "dead nodes") == "3, 7")
        wait_for(lambda: client.value("nodes", "stale nodes") == "")
        assert client.set(stale_after_s=0.6) == (True, "")
        wait_for(says(client, "nodes", WARN, "fell silent: "))
        wait_for(lambda: client.value("nodes", "stale nodes"))
        assert {"3", "7"}.isdisjoint(client.value("nodes", "stale nodes").split(", "))
        assert client.set(stale_after_s=1.5) == (True, "")
        wait_for(lambda: "fell silent" not in client.entry("nodes").message)
    assert client.entry("nodes").level == WARN, "two are still dead"


@pytest.fixture
def on_the_line(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[..., Any]], None]:
    """Adds to the line of the simulated skin what a function makes of the chips of its nodes."""
    waveforms = line.waveforms

    def add(extra: Callable[..., Any]) -> None:
        def with_extra(spec: Any, codes: Any, active: Any, edges_s: Any, clocks: Any) -> Any:
            def chips(number: int) -> Any:
                return line_chips(spec, codes, active & (np.arange(1, spec.nodes + 1) == number))

            yield from waveforms(spec, codes, active, edges_s, clocks)
            yield frame_levels(extra(chips), spec), edges_s

        monkeypatch.setattr(line, "waveforms", with_extra)

    return add


def test_weak_and_contradictory_nodes_are_named(
    on_the_line: Callable[[Callable[..., Any]], None],
) -> None:
    """Node 12 is weak; of node 14 every third bit is nearly gone."""

    def broken(chips: Callable[[int], Any]) -> Any:
        dropped = 0.9 * chips(14)
        dropped[1::3] = dropped[2::3] = 0
        return -0.65 * chips(12) - dropped

    on_the_line(broken)
    with hurrying(port="sim://?scene=all&threshold=0&seed=4") as (_, client):
        wait_for(says(client, "nodes", WARN, "than they should be: node 12"))
        wait_for(says(client, "nodes", WARN, "words contradict the code: node 14"))
        wait_for(lambda: client.value("nodes", "weakest node") == "12")
    kinds = ("weak", "faulty", "doubled")
    assert [client.value("nodes", f"{kind} nodes") for kind in kinds] == ["12", "14", ""]


def test_two_nodes_on_one_row_are_named(on_the_line: Callable[[Callable[..., Any]], None]) -> None:
    """What was meant to be another node says on row 9 what node 9 does: both are at rest."""
    on_the_line(lambda chips: chips(9))
    text = "two nodes speak on one code row: node 9"
    client = complaint("nodes", WARN, text, port="sim://?scene=idle&heartbeat=16")
    assert client.value("nodes", "doubled nodes") == "9"


def test_a_skin_that_nobody_hears_is_an_error() -> None:
    port = f"sim://?dead={','.join(map(str, range(1, 17)))}"
    client = complaint("nodes", ERROR, "no node was heard", port=port, stale_after_s=1.0)
    assert client.value("nodes", "dead nodes") == ", ".join(map(str, range(1, 17)))
    assert client.value("nodes", "weakest node") == ""


def test_a_stuck_node_is_named() -> None:
    port = "sim://?scene=hand&stuck=6&seed=2&speed=4&threshold=0"
    client = complaint("nodes", WARN, "node 6; check sensor", port=port)
    assert client.value("nodes", "stuck nodes") == "6"


def test_noise_drowns_the_weakest_node() -> None:
    complaint("nodes", WARN, "dB above the noise", port="sim://?scene=all&noise=0.8")


def test_clipping_says_by_how_much() -> None:
    client = complaint("stream", WARN, "are at a rail", port="sim://?scene=all&threshold=0&rail=1")
    assert float(client.value("stream", "clipped samples (%)")) > 1


def test_more_nodes_at_once_than_sparse_codes_tell_apart_speak_by_turns() -> None:
    skin: dict[str, Any] = {"codes": "sparse", "nodes": 120, "order": 32, "samples_per_chip": 1}
    port = "sim://?scene=all&threshold=0"
    with hurrying(port=port, frame_period_ms=20.0, **skin) as (_, client):
        wait_for(lambda: client.value("stream", "groups by turns") == "16")
        assert client.value("stream", "nodes at once, capacity") == "13"
        wait_for(lambda: 0 < int(client.value("stream", "nodes at once")) <= 13)
        assert int(client.value("stream", "frames beyond the capacity")) > 0


def test_why_frames_are_in_doubt_is_told_while_they_are() -> None:
    """The line of a skin under load is clipped; when nobody speaks, nothing is left to doubt."""
    with hurrying(port="sim://?scene=all&threshold=0&rail=1") as (_, client):
        wait_for(lambda: client.value("stream", "why in doubt") != "")
        assert float(client.value("stream", "frames in doubt (%)")) > 10
        assert int(client.value("stream", "frames in doubt")) > 0
    with hurrying(port="sim://?scene=idle&heartbeat=0") as (_, client):
        wait_for(lambda: client.value("stream", "frames in doubt (%)") == "0.0")
        wait_for(lambda: client.value("stream", "why in doubt") == "")
        assert client.value("stream", "timings searched for") == "0"


def test_a_wrong_rate_is_told() -> None:
    with hurrying(port="sim://?scene=press&speed=0.7") as (_, client):
        wait_for(says(client, "stream", WARN, "of their rate"))

        def rate_is_true() -> bool:
            expected_hz = float(client.value("stream", "expected rate (Hz)"))
            return abs(float(client.value("stream", "rate (Hz)")) / expected_hz - 0.7) < 0.14

        wait_for(rate_is_true)


def test_a_clock_that_runs_off_is_told_in_ppm(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tactile_cdma.driver.clock.SURE_INTERVALS", 12)  # 3 s, not 10
    with hurrying(port="sim://?scene=idle&speed=1.0008") as (_, client):
        wait_for(says(client, "link", WARN, "ppm off"))

        def drift_ppm() -> float:
            return float(client.value("link", "digitizer clock drift (ppm)") or "nan")

        wait_for(lambda: abs(drift_ppm() - 800) < 150)


def test_an_unplugged_port_is_an_error_of_the_stream_and_no_news_of_the_rest_nor_frames(
    tmp_path: Path,
) -> None:
    path = tmp_path / "tty"
    with hurrying(port=str(path)) as (_, client):
        wait_for(says(client, "stream", ERROR, f"{path}: no such port"))
        assert client.arrays == []
        with plugged(VirtualDigitizer, path):
            wait_for(lambda: client.entry("stream").message == "receiving")
            wait_for(lambda: len(client.arrays) > 20)
        wait_for(lambda: client.entry("stream").level == ERROR)
        assert str(path) in client.entry("stream").message
        for entry in ("nodes", "link"):
            wait_for(lambda entry=entry: client.entry(entry).level == STALE)
            assert client.entry(entry).message == NO_FRAMES
        assert client.entry("host").level == OK
        before = len(client.arrays)
        time.sleep(0.3)
        assert len(client.arrays) == before
        with plugged(VirtualDigitizer, path):
            wait_for(lambda: client.entry("stream").level == OK)
            wait_for(lambda: client.entry("link").level == OK)
            wait_for(lambda: len(client.arrays) > before + 20)
    assert client.value("link", "connections") == "2"
    sequences = [message.sequence for message in client.arrays]
    assert sequences == sorted(set(sequences))


def test_two_drivers_of_one_name_are_told_of_by_both() -> None:
    told: list[str] = []
    with hurrying() as (_, client), hurrying():
        client.create_subscription(Log, "/rosout", lambda log: told.append(log.msg), PAST)
        wait_for(says(client, "host", WARN, "2 drivers have this name"))
        wait_for(lambda: client.value("host", "drivers of this name") == "2")
        wait_for(lambda: sum("2 drivers have this name" in text for text in told) == 2)
    with hurrying() as (_, client):
        wait_for(says(client, "host", OK, "ok"))


def test_frames_that_wait_are_late_and_their_bytes_a_backlog(tmp_path: Path) -> None:
    path = tmp_path / "tty"
    with plugged(VirtualDigitizer, path), hurrying(port=str(path)) as (node, client):
        wait_for(lambda: client.entry("stream").message == "receiving")
        driver = node._driver
        assert driver is not None
        deadline, backlog = time.monotonic() + PATIENCE_S, 0
        # On a busy machine frames may be late before they are held up.
        while backlog <= 1000 or not says(client, "stream", WARN, " ms late")():
            assert time.monotonic() < deadline, f"held up; what is said to wait: {backlog} bytes"
            with driver.between_frames():
                time.sleep(0.2)
            time.sleep(0.1)  # enough to catch up on a busy machine
            values = [pair for status in client.entries["link"] for pair in status.values]
            waited = [int(pair.value) for pair in values if pair.key == "backlog (bytes)"]
            backlog = max(waited, default=0)
