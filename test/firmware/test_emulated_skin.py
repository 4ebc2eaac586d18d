# SPDX-License-Identifier: Apache-2.0

"""Sixteen nodes' real images, the analog line, the digitizer's core, and the host's own decoder."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from emulated import Amplifier, EmulatedSkin, Node
from skin import reference_nodes
from tactile_cdma.base.errors import SpecError
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.hardware.node_memory import node_memory
from tactile_cdma.wire.messages import Quiet, RollCall, Samples
from tactile_cdma.wire.packets import PacketParser, PacketWriter
from test.support.firmware import need

MS = 1_000_000
NODES, GAIN, SUPPLY_V = 16, 0.05, 3.3
LISTENING = 4
"""First frames of a stream, in which nodes measure the period and do not transmit."""


@pytest.fixture(scope="module")
def images(built: Callable[[str], Path], emulator: None) -> Path:
    need("avr-gcc")
    return built("node") / "node"


def config(**values: object) -> SkinConfig:
    amplitude_mv = GAIN * SUPPLY_V / 2 * 1e3
    return SkinConfig.of({"nodes": NODES, "amplitude_mv": amplitude_mv, **values})


def skin_of(images: Path, config: SkinConfig, clocks: np.ndarray, threshold: int = 0) -> list[Node]:
    """Nodes of either kind with these relative clock errors and a known code at rest."""
    nodes = []
    for number, error in enumerate(clocks, start=1):
        mcu = ("atmega328p", "attiny85")[number % 2]
        record = node_memory(
            config.spec, number, threshold=threshold, heartbeat=0, rest=1000, mcu=mcu
        )
        image = images / f"node-{mcu}.elf"
        nodes.append(Node(image, mcu, record, 8e6 * (1 + error), SUPPLY_V, GAIN))
    return nodes


def volts(codes: np.ndarray) -> np.ndarray:
    return codes * SUPPLY_V / 1024


class Host:
    """Decodes what a skin sends."""

    def __init__(self, skin: EmulatedSkin, config: SkinConfig) -> None:
        self.skin, self.pipeline = skin, Pipeline(config, background=False)
        self.parser = PacketParser()
        self.packets: list[object] = []
        skin.write(Session(config).open())

    def run(self, t_ns: int) -> list[TactileFrame]:
        frames = []
        while self.skin.now_ns < t_ns:
            self.skin.run(min(t_ns, self.skin.now_ns + 10 * MS))
            data = self.skin.read()
            self.packets += self.parser.feed(data)
            frames += self.pipeline.feed(data, self.skin.now_ns / 1e9)
        assert self.pipeline.problem is None
        return frames


# Clocks that are off by up to 5 %: nodes follow the period of the sync edges.
@pytest.mark.parametrize("samples_per_chip", [1, 4])
def test_every_word_of_every_node_is_right(images: Path, samples_per_chip: int) -> None:
    rng = np.random.default_rng(samples_per_chip)
    setup = config(samples_per_chip=samples_per_chip)
    clocks = rng.uniform(-0.05, 0.05, NODES)
    with EmulatedSkin(skin_of(images, setup, clocks), Amplifier(noise_v=0.003)) as skin:
        host = Host(skin, setup)
        pressed = rng.integers(0, 1024, (4, NODES))
        said = []
        for i, codes in enumerate(pressed):
            skin.press(volts(codes))
            frames = host.run((i + 1) * 10 * 12_800_000)
            said += [frame.words for frame in frames[LISTENING:]]
        assert len(said) >= 4 * (9 - LISTENING)
        assert all(words.active.all() for words in said)
        heard = [words.codes.tolist() for words in said]
        assert [
            codes for i, codes in enumerate(heard) if codes != (heard[i - 1] if i else None)
        ] == (pressed.tolist())
        assert host.pipeline.counters.lost_frames == 0


def test_the_host_sees_pressed_nodes_only(images: Path) -> None:
    setup = config(samples_per_chip=2)
    with EmulatedSkin(skin_of(images, setup, np.zeros(NODES), threshold=8)) as skin:
        host = Host(skin, setup)
        codes = np.full(NODES, 1000)
        skin.press(volts(codes))
        silent = host.run(150 * MS)[LISTENING:]
        assert not any(frame.words.active.any() for frame in silent)
        assert any(isinstance(packet, Quiet) and packet.sync for packet in host.packets)
        codes[[3, 11]] = [400, 77]
        skin.press(volts(codes))
        frames = host.run(200 * MS)
        active = np.array([frame.words.active for frame in frames])
        assert set(np.flatnonzero(active.any(axis=0))) == {3, 11}
        last = frames[-1].words
        assert last.codes[[3, 11]].tolist() == [400, 77]
        for node in range(NODES):
            assert (skin.edges(node).size > 0) == (node in (3, 11))


def test_every_node_speaks_alone_in_a_roll_call(images: Path) -> None:
    setup = config(samples_per_chip=4)
    with EmulatedSkin(skin_of(images, setup, np.zeros(NODES))) as skin:
        host = Host(skin, setup)
        skin.press(volts(np.arange(NODES) * 60))
        host.run(100 * MS)
        skin.write(PacketWriter(3).encode(RollCall()))
        host.run(400 * MS)
        called = [
            packet for packet in host.packets if isinstance(packet, Samples) and packet.called
        ]
        assert len(called) == NODES
        period_ns = 12_800_000
        for turn, packet in enumerate(called):
            start_ns = packet.device_time_us * 1000
            speaking = [
                np.any((start_ns < edges["t_ns"]) & (edges["t_ns"] < start_ns + period_ns - MS))
                for edges in map(skin.edges, range(NODES))
            ]
            assert np.flatnonzero(speaking).tolist() == [turn]


def test_a_digitizer_with_another_clock_is_followed(images: Path) -> None:
    setup = config(samples_per_chip=1)
    codes = np.arange(NODES) * 61 + 5
    nodes = skin_of(images, setup, np.full(NODES, -0.01))
    with EmulatedSkin(
        [replace(node, start_ns=137_000) for node in nodes], clock_error=0.02
    ) as skin:
        skin.press(volts(codes))
        frames = Host(skin, setup).run(200 * MS)[LISTENING:]
        assert len(frames) >= 10
        assert all((frame.words.codes == codes).all() for frame in frames)


def test_amplitude_of_an_emulated_skin_must_be_known() -> None:
    with pytest.raises(SpecError, match="amplitude_mv is 0"):
        reference_nodes(config(amplitude_mv=0.0))
