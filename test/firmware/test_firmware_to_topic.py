"""Firmware to topic: images of 16 nodes, a digitizer and the driver node, pressed and read."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS 2 (rclpy) is not installed")

from diagnostic_msgs.msg import DiagnosticStatus  # noqa: E402

from emulated import EmulatedSkin  # noqa: E402
from serve import LiveSkin  # noqa: E402
from skin import PressedSkin, reference_amplifier, reference_nodes  # noqa: E402
from skin_client import Client, running, wait_for  # noqa: E402
from tactile_cdma.parameters import SkinConfig, read_file  # noqa: E402
from tactile_cdma.sim.pty import serve  # noqa: E402
from tactile_cdma.sim.scene import SCENES  # noqa: E402
from tactile_cdma.taxels import Status  # noqa: E402

pytestmark = pytest.mark.ros
ROOT = Path(__file__).resolve().parents[2]
PARAMETERS = read_file(ROOT / "config" / "wired_skin.yaml")
CONFIG = SkinConfig.of(PARAMETERS)
FRAMES = 200


@pytest.fixture(scope="module", autouse=True)
def ros() -> Iterator[None]:
    rclpy.init()
    yield
    rclpy.shutdown()


@contextmanager
def live(port: Path, **how: Any) -> Iterator[PressedSkin]:
    """An emulated skin on a tty of this path, in the host's time."""
    stop, ready = threading.Event(), threading.Event()
    with EmulatedSkin(reference_nodes(CONFIG, **how), reference_amplifier(CONFIG)) as nodes:
        skin = PressedSkin(CONFIG, SCENES["moving"], nodes, nodes)
        server = threading.Thread(
            target=serve, args=(lambda: LiveSkin(skin), port, stop, lambda _: ready.set())
        )
        server.start()
        try:
            assert ready.wait(10)
            yield skin
        finally:
            stop.set()
            server.join()


@contextmanager
def driven(port: Path) -> Iterator[Client]:
    """The driver node on this port, and a client of it."""
    parameters = {**PARAMETERS, "port": str(port), "publish_voltage": True}
    with running(**parameters) as (_, client):
        yield client


def mark_ns(message: Any) -> int:
    """When the first chip of a message's frame began, on the skin's clock."""
    return int(message.device_time_us) * 1000 - round(CONFIG.spec.frame_s * 0.5e9)


def off_lsb(client: Client, skin: PressedSkin, first: int) -> np.ndarray:
    """How far the topic's codes are from what was pressed, (frames, n) LSB; NaN: no reading."""
    rows = []
    for message in client.arrays[first:]:
        codes = np.array(message.voltage) / CONFIG.adc.lsb_v
        # Nodes measure in the gap before their frame.
        rows.append(codes - skin.codes(mark_ns(message) - 200_000))
    return np.array(rows)


def phase_lock(client: Client, skin: PressedSkin) -> int:
    """Have pressures change while nodes talk, not while they measure; returns the first frame."""
    wait_for(lambda: len(client.arrays) > 5, 30)
    skin.phase_ns = mark_ns(client.arrays[-1]) + round(CONFIG.spec.frame_s * 0.5e9)
    return len(client.arrays) + 10


def test_what_presses_the_emulated_skin_is_what_the_topic_says(
    tmp_path: Path, built: Callable[[str], Path]
) -> None:
    built("node"), built("sim")
    port = tmp_path / "skin"
    with live(port, threshold=0) as skin, driven(port) as client:
        first = phase_lock(client, skin)
        wait_for(lambda: len(client.arrays) >= first + FRAMES, 60)
        off = off_lsb(client, skin, first)
    assert len(off) >= FRAMES
    assert np.abs(off).max() <= 1.001  # and none is NaN: all nodes were heard in every frame
    sequences = [message.sequence for message in client.arrays[first:]]
    assert np.array_equal(np.diff(sequences), np.ones(len(sequences) - 1))
    pressures = np.array([message.pressure for message in client.arrays[first:]])
    expected = CONFIG.curve.pressure([message.voltage for message in client.arrays[first:]])
    assert np.allclose(pressures, expected, rtol=1e-5, atol=1)
    assert np.ptp(pressures, axis=0).max() > 20e3  # something did move


def test_silent_nodes_are_held_and_within_their_threshold(
    tmp_path: Path, built: Callable[[str], Path]
) -> None:
    built("node"), built("sim")
    port = tmp_path / "skin"
    with live(port, threshold=2, heartbeat=16) as skin, driven(port) as client:
        first = phase_lock(client, skin) + 16
        wait_for(lambda: len(client.arrays) >= first + FRAMES, 60)
        off = off_lsb(client, skin, first)
        silent = np.array([message.status for message in client.arrays[first:]]) & Status.SILENT
    assert np.abs(off).max() <= 3.001
    assert silent.any() and not silent.all()


def test_without_discipline_the_same_skin_fails(
    tmp_path: Path, built: Callable[[str], Path]
) -> None:
    built("node"), built("sim")
    port = tmp_path / "skin"
    with live(port, threshold=0, discipline=False) as skin, driven(port) as client:
        wait_for(lambda: client.diagnostics and skin.now_ns > 4e9, 60)
        off = off_lsb(client, skin, 0)
        worst = max(status.level for status in client.diagnostics)
    good = (np.abs(off) <= 1.001).all(axis=1).sum() if len(off) else 0
    assert good < 0.1 * 4.0 / CONFIG.spec.frame_period_s
    assert worst >= DiagnosticStatus.WARN
