"""An emulated skin against the driver: what was pressed, what its pipeline makes of the bytes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from emulated import EDGE, EmulatedNodes
from skin import PressedSkin
from tactile_cdma.driver import Session
from tactile_cdma.encode import frame_levels, line_chips
from tactile_cdma.frame import FrameSpec
from tactile_cdma.messages import Quiet, Samples, Status
from tactile_cdma.parameters import SkinConfig
from tactile_cdma.pipeline import Pipeline, TactileFrame
from tactile_cdma.protocol import PacketParser

STEP_NS = 20_000_000
PATIENCE_NS = 3_000_000_000
"""Without a frame for so long a trial is over."""
BEFORE_MARK_NS = 200_000
"""So long before a frame its nodes have measured."""
MOST_WRONG_LSB = 1


@dataclass
class Trial:
    """What came of a trial.

    wrong: nodes' codes that were more than one LSB off or missing, over all frames.
    marks_ns: when each frame's first chip should begin. codes: (n,) as decoded, by frame.
    """

    frames: int = 0
    wrong: int = 0
    lost_samples: int = 0
    marks_ns: list[int] = field(default_factory=list)
    codes: list[NDArray[np.int32]] = field(default_factory=list)


def press_and_decode(skin: PressedSkin, config: SkinConfig, frames: int) -> Trial:
    """Run until so many frames were decoded, or none comes any more."""
    spec, trial = config.spec, Trial()
    pipeline, parser = Pipeline(config, background=False), PacketParser()
    skin.write(Session(config).open())
    start_us, last_ns = None, skin.now_ns
    while trial.frames < frames and skin.now_ns - last_ns < PATIENCE_NS:
        skin.run(skin.now_ns + STEP_NS)
        data = skin.read()
        for packet in parser.feed(data):
            if not isinstance(packet, Samples | Quiet):
                continue
            if packet.first_index == 0:
                start_us = packet.device_time_us - _half_sample_us(config)
            if packet.sync and start_us is not None:
                mark_us = start_us + packet.first_index * _sample_us(config)
                trial.marks_ns.append(round(1e3 * mark_us))
                # From now on pressures change in the middle of frames, while nodes don't measure.
                skin.phase_ns = trial.marks_ns[-1] + round(spec.frame_s * 0.5e9)
        for frame in pipeline.feed(data, skin.now_ns * 1e-9):
            last_ns = skin.now_ns
            trial.frames += 1
            trial.codes.append(frame.words.codes)
            trial.wrong += _wrong(frame, skin, config)
    trial.lost_samples = pipeline.counters.lost_samples
    status: Status | None = pipeline.status
    if status is not None:
        trial.lost_samples += status.samples_lost
    return trial


def _wrong(frame: TactileFrame, skin: PressedSkin, config: SkinConfig) -> int:
    mark_ns = round(frame.t_start * 1e9)
    truth = skin.codes(mark_ns - BEFORE_MARK_NS)
    codes = frame.readings.voltage_v / config.adc.lsb_v
    return int(np.sum(~(np.abs(codes - truth) <= MOST_WRONG_LSB)))  # NaN is wrong, too


def _sample_us(config: SkinConfig) -> float:
    return config.spec.chip_s * 1e6 / config.samples_per_chip


def _half_sample_us(config: SkinConfig) -> int:
    return int(_sample_us(config) / 2)


def edge_errors(
    nodes: EmulatedNodes, spec: FrameSpec, marks_ns: list[int], codes: list[NDArray[np.int32]]
) -> list[NDArray[np.float64]]:
    """How far every edge of every node's pin is from where it should be: a row per burst, ns.

    Of frames in which all nodes talk. Raises AssertionError where edges are missing or too many.
    """
    chip_ns, errors = spec.chip_s * 1e9, []
    for node in range(spec.nodes):
        edges = nodes.edges(node)
        for mark_ns, word in zip(marks_ns, codes, strict=True):
            expected = _expected_edges(spec, node, int(word[node]))
            begin = np.searchsorted(edges["t_ns"], mark_ns - chip_ns / 2)
            seen = edges[begin : begin + len(expected)]
            assert np.array_equal(seen["level"], expected["level"]), f"node {node + 1}: {seen}"
            errors.append(seen["t_ns"] - mark_ns - expected["t_ns"] * chip_ns)
    return errors


def _expected_edges(spec: FrameSpec, node: int, code: int) -> NDArray[np.void]:
    """Changes of a node's pin in one frame, t in chips from its start."""
    alone = np.arange(spec.nodes) == node
    chips = line_chips(spec, np.where(alone, code, 0), alone, amplitude_v=float(spec.polarity))
    levels = np.sign(frame_levels(chips, spec)).astype(np.int8)
    levels = np.concatenate(([0], levels, [0])).astype(np.int8)
    places = np.flatnonzero(np.diff(levels))
    edges = np.zeros(len(places), EDGE)
    edges["t_ns"], edges["level"] = places, levels[places + 1]
    return edges
