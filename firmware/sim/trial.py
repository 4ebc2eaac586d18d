# SPDX-License-Identifier: Apache-2.0

"""An emulated skin against the driver: what was pressed, what its pipeline makes of the bytes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from emulated import EDGE, EmulatedNodes
from skin import PressedSkin
from tactile_cdma.code.encode import frame_levels, line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.wire.messages import Quiet, Samples
from tactile_cdma.wire.packets import PacketParser

STEP_NS = 20_000_000
SETTLING = 16
"""First frames, which don't count: nodes measure the sync edges' period and their code at rest."""
PATIENCE_NS = 3_000_000_000
"""Without a frame for so long a trial is over."""
BEFORE_MARK_NS = 200_000
"""So long before a frame its nodes have measured."""
MOST_WRONG_LSB = 1


@dataclass
class Trial:
    """What came of a trial.

    wrong: nodes' codes that were more than one LSB off or missing, over all frames.
    silent: times that a node did not talk.
    words: what every frame's nodes said, (n,) codes, by the time at which its first chip should
    have begun, ns.
    """

    wrong: int = 0
    silent: int = 0
    lost_samples: int = 0
    words: dict[int, NDArray[np.int32]] = field(default_factory=dict)

    @property
    def frames(self) -> int:
        """Frames that counted."""
        return len(self.words)


def press_and_decode(skin: PressedSkin, config: SkinConfig, frames: int) -> Trial:
    """Run until so many frames were decoded, or none comes any more."""
    trial, marks = Trial(), Marks(config)
    pipeline, parser = Pipeline(config, background=False), PacketParser()
    skin.write(Session(config).open())
    last_ns, settling = skin.now_ns, SETTLING
    while trial.frames < frames and skin.now_ns - last_ns < PATIENCE_NS:
        skin.run(skin.now_ns + STEP_NS)
        data = skin.read()
        for packet in parser.feed(data):
            marks.take(packet)
        for frame in pipeline.feed(data, skin.now_ns * 1e-9):
            last_ns, mark_ns = skin.now_ns, marks.nearest(frame)
            # From now on pressures change in the middle of frames, while nodes don't measure.
            skin.phase_ns = mark_ns + round(config.spec.frame_s * 0.5e9)
            if settling:
                settling -= 1
                continue
            trial.words[mark_ns] = frame.words.codes
            trial.silent += int(np.sum(~frame.words.active))
            trial.wrong += _wrong(frame, skin.codes(mark_ns - BEFORE_MARK_NS), config)
    trial.lost_samples = pipeline.counters.lost_samples
    return trial


def _wrong(frame: TactileFrame, truth: NDArray[np.int64], config: SkinConfig) -> int:
    codes = frame.readings.voltage_v / config.adc.lsb_v
    good = np.abs(codes - truth) <= MOST_WRONG_LSB + 1e-3  # NaN is not
    return int(np.sum(~good))


class Marks:
    """When frames should begin, by what the digitizer says of its samples; to the µs."""

    def __init__(self, config: SkinConfig) -> None:
        self._sample_us = config.spec.chip_s * 1e6 / config.samples_per_chip
        self._start_us = 0
        self._marks_ns: list[int] = []

    def take(self, packet: object) -> None:
        """Look at a packet."""
        if not isinstance(packet, Samples | Quiet):
            return
        if packet.first_index == 0:  # taken half a period after the stream's start
            self._start_us = packet.device_time_us - int(self._sample_us / 2)
        if packet.sync:
            mark_us = self._start_us + packet.first_index * self._sample_us
            self._marks_ns.append(round(1e3 * mark_us))

    def nearest(self, frame: TactileFrame) -> int:
        """The mark of a frame, ns."""
        return min(self._marks_ns[::-1], key=lambda mark: abs(mark - frame.t_start * 1e9))


def edge_errors(
    nodes: EmulatedNodes, spec: FrameSpec, words: dict[int, NDArray[np.int32]]
) -> list[NDArray[np.float64]]:
    """How far the edges of the nodes' pins are from where they should be: an array per burst, ns.

    words: as a Trial has them. Silent nodes have no edges. Raises AssertionError where edges are
    missing or too many.
    """
    chip_ns, errors = spec.chip_s * 1e9, []
    for node in range(spec.nodes):
        edges = nodes.edges(node)
        for mark_ns, codes in words.items():
            expected = expected_edges(spec, node, int(codes[node]))
            begin, end = np.searchsorted(
                edges["t_ns"], [mark_ns - chip_ns / 2, mark_ns + (spec.span_chips + 0.5) * chip_ns]
            )
            seen = edges[begin:end]
            if not len(seen):
                continue
            assert np.array_equal(seen["level"], expected["level"]), f"node {node + 1}: {seen}"
            errors.append(seen["t_ns"] - mark_ns - expected["t_ns"] * chip_ns)
    return errors


def expected_edges(spec: FrameSpec, node: int, code: int) -> NDArray[np.void]:
    """Changes of a node's pin in one frame, t_ns in chips from its start."""
    alone = np.arange(spec.nodes) == node
    chips = line_chips(spec, np.where(alone, code, 0), alone, amplitude_v=float(spec.polarity))
    levels = np.sign(frame_levels(chips, spec)).astype(np.int8)
    levels = np.concatenate(([0], levels, [0])).astype(np.int8)
    places = np.flatnonzero(np.diff(levels))
    edges = np.zeros(len(places), EDGE)
    edges["t_ns"], edges["level"] = places, levels[places + 1]
    return edges
