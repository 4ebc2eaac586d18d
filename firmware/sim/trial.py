# SPDX-License-Identifier: Apache-2.0

"""Press an emulated skin and compare the driver's frames with what was pressed."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from emulated import EDGE, EmulatedNodes
from losses import LossyDriver
from skin import PressedSkin
from tactile_cdma.code.encode import frame_levels, line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.wire.messages import Quiet, Samples
from tactile_cdma.wire.packets import PacketParser

STEP_NS = 20_000_000
SETTLING_S = 0.2
"""Time in which nodes learn their code at rest (70 ms) and the sync period, s. Chosen."""
PATIENCE_NS = 1_000_000_000
"""A trial ends when no frame has come for this long, ns. Chosen."""
BEFORE_MARK_NS = 200_000
"""Nodes have measured by this time before a frame, ns: they begin 0.8 ms before its pulse."""
MOST_WRONG_LSB = 1


@dataclass
class Trial:
    """Result of a trial.

    wrong: number of codes that were missing or more than one LSB off, over all frames, and what a
        driver that lost frames claimed wrongly. lost: frames that it did.
    silent: number of times that a node did not transmit.
    words: codes of every frame, (n,), by the nominal time of its first chip, ns.
    """

    wrong: int = 0
    silent: int = 0
    lost_samples: int = 0
    lost: int = 0
    words: dict[int, NDArray[np.int32]] = field(default_factory=dict)

    @property
    def frames(self) -> int:
        """Return the number of frames counted."""
        return len(self.words)


def press_and_decode(
    skin: PressedSkin,
    config: SkinConfig,
    frames: int,
    settling: int | None = None,
    lose_every: int = 0,
) -> Trial:
    """Run until this many frames have been decoded, or none has come for PATIENCE_NS.

    settling: first frames, not counted; None: those of SETTLING_S. lose_every: frames, of which
    one is lost to a second driver, which asks all nodes to speak.
    """
    if settling is None:
        settling = math.ceil(SETTLING_S / config.spec.frame_period_s)
    trial, marks = Trial(), Marks(config)
    pipeline, parser, session = Pipeline(config), PacketParser(), Session(config)
    lossy = LossyDriver(config, session, lose_every) if lose_every else None
    heard: list[TactileFrame] = []
    skin.write(session.open())
    last_ns = skin.now_ns
    while trial.frames < frames and skin.now_ns - last_ns < PATIENCE_NS:
        skin.run(skin.now_ns + STEP_NS)
        data = skin.read()
        for packet in parser.feed(data):
            marks.take(packet)
        if lossy and (request := lossy.feed(data, skin.now_ns * 1e-9)):
            skin.write(request)
        for frame in pipeline.feed(data, skin.now_ns * 1e-9):
            heard.append(frame)
            last_ns, mark_ns = skin.now_ns, marks.nearest(frame)
            # From now on pressures change in the middle of frames, when nodes don't measure.
            skin.phase_ns = mark_ns + round(config.spec.frame_s * 0.5e9)
            if settling:
                settling -= 1
                continue
            trial.words[mark_ns] = frame.words.codes
            trial.silent += int(np.sum(~frame.words.active))
            trial.wrong += _wrong(frame, skin.codes(mark_ns - BEFORE_MARK_NS), config)
    trial.lost_samples = pipeline.counters.lost_samples
    if lossy:
        lossy.compare(heard)
        trial.wrong, trial.lost = trial.wrong + lossy.wrong + lossy.unflagged, lossy.lost
    return trial


def _wrong(frame: TactileFrame, truth: NDArray[np.int64], config: SkinConfig) -> int:
    codes = frame.readings.voltage_v / config.adc.lsb_v
    good = np.abs(codes - truth) <= MOST_WRONG_LSB + 1e-3  # NaN is not
    return int(np.sum(~good))


class Marks:
    """Nominal start times of frames, from the digitizer's packets; exact to 1 µs."""

    def __init__(self, config: SkinConfig) -> None:
        self._integrated = config.samples_per_chip == 1
        self._sample_us = config.spec.chip_s * 1e6 / config.samples_per_chip
        self._start_us = 0
        self.marks_ns: list[int] = []

    def take(self, packet: object) -> None:
        """Take note of a packet."""
        if not isinstance(packet, Samples | Quiet):
            return
        if packet.first_index == 0:  # taken half a period after the stream's start
            self._start_us = packet.device_time_us - int(self._sample_us / 2)
        if packet.sync and self._integrated:  # its index does not count the time of gaps
            self.marks_ns.append(1000 * packet.device_time_us)
        elif packet.sync:
            mark_us = self._start_us + packet.first_index * self._sample_us
            self.marks_ns.append(round(1e3 * mark_us))

    def nearest(self, frame: TactileFrame) -> int:
        """Return the mark of a frame, ns."""
        return min(self.marks_ns[::-1], key=lambda mark: abs(mark - frame.t_start * 1e9))


def edge_errors(
    nodes: EmulatedNodes, spec: FrameSpec, words: dict[int, NDArray[np.int32]]
) -> list[NDArray[np.float64]]:
    """Return the errors of the edges at the nodes' pins: an array per node and frame, ns.

    words: as in Trial. Silent nodes have no edges. Raises AssertionError if edges are missing or
    there are too many.
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
    """Yield changes of a node's pin in one frame, t_ns in chips from its start."""
    alone = np.arange(spec.nodes) == node
    chips = line_chips(spec, np.where(alone, code, 0), alone, amplitude_v=float(spec.polarity))
    levels = np.sign(frame_levels(chips, spec)).astype(np.int8)
    levels = np.concatenate(([0], levels, [0])).astype(np.int8)
    places = np.flatnonzero(np.diff(levels))
    edges = np.zeros(len(places), EDGE)
    edges["t_ns"], edges["level"] = places, levels[places + 1]
    return edges
