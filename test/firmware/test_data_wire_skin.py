# SPDX-License-Identifier: Apache-2.0

"""Sync pulses on the data wire: the skin is as good as with a wire of their own; its faults."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest

from check import PARAMS, Edges, on_rp2040, on_virtual_board, press
from emulated import EmulatedSkin, EmulationError, Node
from skin import DATA_DELAY_S, PressedSkin, reference_amplifier, reference_nodes
from tactile_cdma.config.frame_rate import TINY_ON_DATA
from tactile_cdma.config.parameters import DATA, OWN, read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver import checkup
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.driver.vitals import Vitals
from tactile_cdma.readings.status import is_certain
from tactile_cdma.sim.scene import SCENES
from tactile_cdma.wire.messages import Status
from tactile_cdma.wire.packets import PacketParser
from trial import Trial, press_and_decode

pytestmark = pytest.mark.usefixtures("node_images")
FRAMES = 40
CYCLE_US = 0.125
MOST_US = 0.5
"""Largest error of an edge, µs, by a sync wire of its own: edges are sharper there."""
PERIOD_NS = 12_800_000
NODES = 16
STEP_NS = 20_000_000


def config_on(wire: str) -> SkinConfig:
    return SkinConfig.of(read_file(PARAMS) | {"sync_wire": wire})


def all_right(trial: Trial) -> bool:
    counted = trial.wrong, trial.silent, trial.lost_samples
    return trial.frames >= FRAMES and counted == (0, 0, 0)


def largest_us(edges: Edges) -> float:
    return float(max(np.abs(errors).max() for errors in edges.errors_us))


@pytest.mark.parametrize(
    "mcus", [("atmega328p", "atmega328p"), ("attiny85", TINY_ON_DATA)], ids=["atmega328p", "tiny"]
)
def test_words_jitter_and_losses_are_as_on_a_wire_of_their_own(mcus: tuple[str, str]) -> None:
    """Edges differ from node to node by what resistors and comparators do, and by a cycle."""
    tried = {
        wire: on_virtual_board(config_on(wire), mcu, FRAMES)
        for wire, mcu in zip((OWN, DATA), mcus, strict=True)
    }
    assert all(all_right(trial) for trial, _ in tried.values())
    own, data = (edges for _, edges in tried.values())
    assert 0 < own.jitter_us < 0.3 and largest_us(own) <= MOST_US
    assert data.jitter_us <= own.jitter_us + 0.02
    delays_us = (DATA_DELAY_S[1] - DATA_DELAY_S[0]) * 1e6
    assert own.spread_us < data.spread_us < own.spread_us + delays_us + CYCLE_US


@pytest.mark.parametrize("wire", [OWN, DATA])
def test_so_they_are_with_the_rp2040(rp2040_image: object, wire: str) -> None:
    trial, edges = on_rp2040(config_on(wire), FRAMES)
    assert all_right(trial)
    assert edges.jitter_us < 0.3
    assert wire == DATA or largest_us(edges) <= MOST_US


def test_a_driver_that_loses_frames_has_all_speak() -> None:
    """The digit that asks is heard on the data wire: what was lost is made good."""
    lost = {}
    for wire in (OWN, DATA):
        config = config_on(wire)
        with EmulatedSkin(reference_nodes(config), reference_amplifier(config)) as skin:
            pressed = PressedSkin(config, SCENES["moving"], skin, skin)
            trial = press_and_decode(pressed, config, 2 * FRAMES, lose_every=11)
        assert (trial.wrong, trial.lost_samples) == (0, 0)
        lost[wire] = trial.lost
    assert lost[OWN] == lost[DATA] > 0


def listen(
    nodes: list[Node], config: SkinConfig, seconds: float, fault_s: float = 0.5
) -> tuple[list[TactileFrame], list[Status], list[str]]:
    """Frames, reports, and what the driver finds in the second since fault_s, of a skin at rest.

    The data wire is stuck low from then on.
    """
    pipeline, parser, session = Pipeline(config), PacketParser(), Session(config)
    vitals, frames, reports = Vitals(), list[TactileFrame](), list[Status]()
    found: list[str] = []
    with EmulatedSkin(nodes, reference_amplifier(config)) as skin:
        skin.press(np.array([node.supply_v for node in nodes]) * 0.5)
        skin.write(session.open())
        while skin.now_ns < seconds * 1e9:
            since_ns = skin.now_ns - fault_s * 1e9
            if 0 <= since_ns < STEP_NS:
                skin.stick(skin.now_ns + 1)
                vitals.take(pipeline)
            if 1e9 <= since_ns < 1e9 + STEP_NS:
                found = [finding.text for finding in checkup.link(pipeline, vitals.take(pipeline))]
            skin.run(skin.now_ns + STEP_NS)
            data = skin.read()
            frames += pipeline.feed(data, skin.now_ns * 1e-9)
            reports += [packet for packet in parser.feed(data) if isinstance(packet, Status)]
    return frames, reports, found


def test_a_line_that_is_stuck_low_is_told_of_within_a_second() -> None:
    """All pulses of its frames are missing, and no word is made up."""
    config = config_on(DATA)
    frames, reports, found = listen(reference_nodes(config, threshold=0), config, 2.5)
    before = [report.sync_faults for report in reports if report.uptime_us < 500_000]
    after = [report.sync_faults for report in reports if report.uptime_us > 1_400_000]
    assert set(before) == {0}
    assert after[0] > 50
    assert any("the line is stuck at" in text for text in found), found
    spoke = [frame for frame in frames if frame.t_start > 0.2]
    heard = [np.any(frame.words.active & ~frame.words.doubtful) for frame in spoke]
    assert [frame.t_start < 0.5 for frame in spoke] == heard


def test_a_node_that_never_sees_pulses_is_silent_and_harms_nobody() -> None:
    config = config_on(DATA)
    nodes = reference_nodes(config, threshold=0)
    nodes[4] = replace(nodes[4], bandgap_v=0.05)
    frames, reports, _ = listen(nodes, config, 1.2, fault_s=9.0)
    spoke = [frame for frame in frames if frame.t_start > 0.2]
    assert len(spoke) > 70
    for frame in spoke:
        assert frame.words.active.tolist() == [node != 4 for node in range(NODES)]
        assert not frame.words.doubtful.any()
    assert reports[-1].sync_faults == 0


@pytest.mark.parametrize("bandgap_v", [1.0, 1.2])
def test_a_line_that_hum_brings_near_the_bandgap_is_no_pulse(bandgap_v: float) -> None:
    config = config_on(DATA)
    nodes = [replace(node, bandgap_v=bandgap_v) for node in reference_nodes(config, threshold=0)]
    low = replace(reference_amplifier(config), offset_v=1.25, high_v=3.3)
    with EmulatedSkin(nodes, low) as skin:
        assert all_right(press(skin, skin, config, FRAMES))


def test_pulses_of_a_second_digitizer_make_no_wrong_word() -> None:
    """They come amid frames, at any time: frames are doubtful or missing, or right."""
    config = config_on(DATA)
    nodes = reference_nodes(config, threshold=0)
    pipeline, session = Pipeline(config), Session(config)
    frames: list[TactileFrame] = []
    rng = np.random.default_rng(3)
    with EmulatedSkin(nodes, reference_amplifier(config)) as skin:
        pressed = PressedSkin(config, lambda t, place: np.zeros(NODES), skin, skin)
        pressed.write(session.open())
        pressed.run(300_000_000)
        while skin.now_ns < 2_000_000_000:
            pressed.run(skin.now_ns + int(rng.integers(3_000_000, 13_000_000)))
            with contextlib.suppress(EmulationError):  # a pulse of the first one is there
                skin.sync(skin.now_ns + 1_000, True)
                skin.sync(skin.now_ns + 33_000, False)
            frames += pipeline.feed(skin.read(), skin.now_ns * 1e-9)
        truth = pressed.codes(skin.now_ns)
    certain = wrong = 0
    for frame in frames:
        sure = is_certain(frame.readings.status) & frame.words.active & ~frame.words.doubtful
        certain += int(sure.sum())
        wrong += int(np.sum(np.abs(frame.words.codes[sure] - truth[sure]) > 1))
    assert wrong == 0
    assert certain > 0
    assert pipeline.rejections.total + sum(bool(f.words.doubtful.any()) for f in frames) > 10
