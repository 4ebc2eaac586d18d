"""What the sensing nodes do: measure, decide whether to talk, and say a word."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count

import numpy as np
from numpy.typing import NDArray

from ..calibration import AdcScale, PressureCurve
from ..frame import FrameSpec
from .scene import Scene, Skin


@dataclass(frozen=True, slots=True)
class NodeFrame:
    """Ground truth of one frame. Arrays have one entry per node, (n,).

    number: frames since START. start_s: when its first chip begins, s since START.
    pressure_pa, voltage_v: float64, at start_s. codes: int64 ADC words. active: bool, who talks.
    """

    number: int
    start_s: float
    pressure_pa: NDArray[np.float64]
    voltage_v: NDArray[np.float64]
    codes: NDArray[np.int64]
    active: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class NodeRules:
    """When a node talks.

    threshold: LSB. A node talks while its code is farther than this from its code at rest, or
        from the code that it sent last (so a release is told, too). 0: always.
    heartbeat: frames. A node also talks once in so many frames, each at a turn of its own; all
        have had theirs within the first period. 0: never.
    """

    threshold: int = 1
    heartbeat: int = 78


def node_frames(
    spec: FrameSpec,
    scene: Scene,
    skin: Skin,
    rules: NodeRules,
    curve: PressureCurve | None = None,
    start_phase: float = 0.0,
) -> Iterator[NodeFrame]:
    """All frames since START, endlessly; the same arguments give the same frames.

    start_phase: share of frame 0's period that has passed at START.
    """
    curve = curve or PressureCurve.two_stage()
    adc = AdcScale(spec.bits)
    rest = adc.code(curve.voltage(np.zeros(spec.nodes)))
    last_sent = rest.copy()
    turn = np.arange(spec.nodes) * rules.heartbeat // spec.nodes
    for number in count():
        start_s = frame_start_s(spec, number, start_phase)
        pressure_pa = scene(start_s, skin)
        voltage_v = curve.voltage(pressure_pa)
        codes = adc.code(voltage_v)
        active = np.abs(codes - rest) > rules.threshold
        active |= np.abs(codes - last_sent) > rules.threshold
        if rules.heartbeat:
            active |= turn == number % rules.heartbeat
        if rules.threshold == 0:
            active[:] = True
        last_sent[active] = codes[active]
        yield NodeFrame(number, start_s, pressure_pa, voltage_v, codes, active)


def frame_start_s(spec: FrameSpec, number: int, start_phase: float = 0.0) -> float:
    """When a frame's first chip begins, s since START."""
    return (number - start_phase) * spec.frame_period_s
