# SPDX-License-Identifier: Apache-2.0

"""Firmware to topic: images of 16 nodes, a digitizer and the driver node, pressed and read."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

pytest.importorskip("rclpy", reason="ROS 2 (rclpy) is not installed")

from emulated import EmulatedSkin, Node
from serve import LiveSkin
from skin import PressedSkin, reference_amplifier, reference_nodes
from tactile_cdma.config.parameters import read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.readings.status import Status
from tactile_cdma.sim.scene import SCENES
from test.support.boards import plugged
from test.support.skin_client import Client, running
from test.support.waiting import wait_for

pytestmark = pytest.mark.usefixtures("node_images", "ros")
ROOT = Path(__file__).resolve().parents[2]
PARAMETERS = read_file(ROOT / "config" / "wired_skin.yaml")
CONFIG = SkinConfig.of(PARAMETERS)
FRAMES = 200


def wired(nodes: list[Node], **board: Any) -> EmulatedSkin:
    """These nodes, with the digitizer's core on a virtual board."""
    return EmulatedSkin(nodes, reference_amplifier(CONFIG), **board)


@contextmanager
def driven(port: Path, emulated: EmulatedSkin) -> Iterator[tuple[PressedSkin, Client]]:
    """An emulated skin on a tty, in the host's time as far as it can follow, and its driver node.

    Gives the skin, and a client of the node.
    """
    with emulated:
        skin = PressedSkin(CONFIG, SCENES["moving"], emulated, emulated)
        parameters = {**PARAMETERS, "port": str(port), "publish_voltage": True}
        with plugged(lambda: LiveSkin(skin), port), running(**parameters) as (_, client):
            yield skin, client


def mark_ns(message: Any) -> int:
    """Start of the first chip of a message's frame, on the skin's clock."""
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
    """Have pressures change while nodes transmit, not while they measure; returns the first."""
    wait_for(lambda: len(client.arrays) > 5)
    skin.phase_ns = mark_ns(client.arrays[-1]) + round(CONFIG.spec.frame_s * 0.5e9)
    return len(client.arrays) + 10


def diagnosed(client: Client, name: str) -> str:
    """The newest value of this name in /diagnostics."""
    latest = client.diagnostics[-1:]
    values = {pair.key: pair.value for status in latest for pair in status.values}
    return str(values.get(name, ""))


def test_what_presses_the_emulated_skin_is_what_the_topic_says(tmp_path: Path) -> None:
    nodes = reference_nodes(CONFIG, threshold=0)
    with driven(tmp_path / "tty", wired(nodes)) as (skin, client):
        first = phase_lock(client, skin)
        wait_for(lambda: len(client.arrays) >= first + FRAMES)
        off = off_lsb(client, skin, first)
        info = client.infos[-1]
    assert info.origin == info.ORIGIN_SIMULATED, "an emulator does not pass for a board"
    assert len(off) >= FRAMES
    assert np.abs(off).max() <= 1.001  # and none is NaN
    status = np.array([message.status for message in client.arrays[first:]])
    assert not np.any(status & (Status.SILENT | Status.STALE))  # all were heard in every frame
    sequences = [message.sequence for message in client.arrays[first:]]
    assert np.array_equal(np.diff(sequences), np.ones(len(sequences) - 1))
    pressures = np.array([message.pressure for message in client.arrays[first:]])
    voltages = np.array([message.voltage for message in client.arrays[first:]])
    full = voltages > CONFIG.adc.voltage(1022.5)  # the highest code: rest, which lies above it
    expected = np.where(full, 0, CONFIG.curve.pressure(voltages))
    assert np.allclose(pressures, expected, rtol=1e-5, atol=1)
    assert np.ptp(pressures, axis=0).max() > 20e3  # something did move


class RailedSkin(EmulatedSkin):
    """The sensor of node 5 is shorted, that of node 9 open."""

    def press(self, volts: ArrayLike) -> None:
        volts = np.array(volts)
        volts[[4, 8]] = 0.0, 5.0
        super().press(volts)


def test_broken_nodes_are_named_and_harm_no_other(tmp_path: Path) -> None:
    """Node 3's memory is blank, node 7's corrupt; two sensors are at their rails."""
    nodes = reference_nodes(CONFIG, threshold=0)
    nodes[2] = replace(nodes[2], memory=b"")
    nodes[6] = replace(nodes[6], memory=bytes([nodes[6].memory[0] ^ 1, *nodes[6].memory[1:]]))
    railed = RailedSkin(nodes, reference_amplifier(CONFIG))
    with driven(tmp_path / "tty", railed) as (skin, client):
        first = phase_lock(client, skin)
        wait_for(lambda: len(client.arrays) >= first + 100)
        wait_for(lambda: diagnosed(client, "dead nodes") == "3, 7")
        off = off_lsb(client, skin, first)
        status = np.array([message.status for message in client.arrays[first:]])
        pressures = np.array([message.pressure for message in client.arrays[first:]])
    assert np.isnan(pressures[:, [2, 6]]).all()
    assert (status[:, 4] & Status.SATURATED).all()
    assert (pressures[:, 8] == 0).all()  # the highest code
    healthy = [node for node in range(16) if node not in (2, 4, 6, 8)]
    assert np.abs(off[:, healthy]).max() <= 1.001


def test_broken_commands_and_a_slow_link_show_in_the_diagnostics(tmp_path: Path) -> None:
    nodes = reference_nodes(CONFIG, threshold=0)
    port = tmp_path / "tty"
    # A frame of 1024 samples takes 2 kB: 60 kB/s carry some 30 of the 78 per second.
    with driven(port, wired(nodes, link_rate=60e3)) as (_, client):
        wait_for(lambda: client.arrays)
        with open(port, "wb") as second_program:
            second_program.write(b"\x05\x11garbage\0" + bytes(range(1, 200)) * 300 + b"\0")
        wait_for(lambda: diagnosed(client, "digitizer command errors") == "2")
        wait_for(lambda: int(diagnosed(client, "digitizer packets dropped") or 0) > 0)
        complaint = "the link or this computer is too slow for the digitizer's packets"
        wait_for(lambda: any(complaint in s.message for s in client.entries.get("link", [])))
