# SPDX-License-Identifier: Apache-2.0

"""Readings of voltages that are given, as the driver reads words."""

import math
from dataclasses import replace

import numpy as np

from tactile_cdma.base.arrays import Bools, Floats32
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.places.layout import Layout
from tactile_cdma.readings.baseline import Baseline, RestRules
from tactile_cdma.readings.calibration import AdcScale, Calibration, PressureCurve
from tactile_cdma.readings.drift import DriftTracker, nodes_beside
from tactile_cdma.readings.pressure import PressureChain
from tactile_cdma.readings.taxels import Readings, Taxels
from tactile_cdma.words.health import NodeHealth, NodeState
from tactile_cdma.words.words import silent

ADC, RULES = AdcScale(), RestRules(60.0, 1e3, 500.0)


def chain_of(
    calibration: Calibration | PressureCurve,
    layout: Layout,
    rules: RestRules = RULES,
    adc: AdcScale = ADC,
) -> PressureChain:
    """Return the chain of a skin whose numbers of nodes are those of its taxels."""
    nodes = len(layout)
    if isinstance(calibration, PressureCurve):
        calibration = Calibration.default(calibration, nodes)
    tracker = DriftTracker(adc, nodes_beside(layout, nodes), rules)
    return PressureChain(calibration, Baseline(nodes), tracker)


class Voltages:
    """All nodes speak in every frame, and each one's word stands for the voltage that it has."""

    def __init__(self, chain: PressureChain, nodes: int) -> None:
        layout = Layout.grid(nodes, 1, nodes, 7e-3, 5e-3)
        self._taxels = Taxels(nodes, chain.tracker.adc, chain, layout, math.inf)
        # No code is an end of the converter's range, which would mean "so much or more".
        self._taxels._voltage_of = table_v = np.zeros(1 << (nodes + 2).bit_length(), np.float32)
        self._voltage_v = table_v[1 : nodes + 1]
        self._chain, self._health = chain, NodeHealth(FrameSpec(nodes=nodes, frame_period_s=10.0))
        self._words = replace(
            silent(nodes, 0.0),
            active=np.ones(nodes, bool),
            codes=np.arange(1, nodes + 1, dtype=np.int32),
        )

    def read(self, voltage_v: Floats32, valid: Bools | bool, t_s: float) -> Readings:
        """Read a frame of these voltages, (n,) V; those of the other nodes are no readings."""
        self._voltage_v[:] = voltage_v
        state = np.full(self._voltage_v.shape, NodeState.OK, np.uint8)
        state[~np.broadcast_to(valid, state.shape)] = NodeState.FAULTY
        if not np.array_equal(state, self._health.state):
            self._health.state = state
            self._health.invalid[:] = state == NodeState.FAULTY
        readings = self._taxels.update(self._words, t_s, self._health)
        readout = self._taxels._readout_of(self._health)
        self._chain.hold(*(values.copy() for values in readout.rest), readout.valid.copy())
        return readings
