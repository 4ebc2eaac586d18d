# SPDX-License-Identifier: Apache-2.0

"""Captures of an oscilloscope on a simulated line."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.code.encode import frame_levels, line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.sim.channel import Channel, first_sample, point_samples


def scope_capture(
    spec: FrameSpec,
    frames: Sequence[tuple[NDArray[np.int64], NDArray[np.bool_]]],
    rate_hz: float,
    channel: Channel | None = None,
    lead_s: float = 1e-3,
    seed: int = 0,
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """What an oscilloscope on the line records of some frames, as in the paper's experiments.

    frames: (codes, active) of each frame, (n,) each. lead_s: recorded before the first frame, s.
    Returns time_s (m,) float64, 0 at the first sample, and volts (m,) float32.
    """
    channel = channel or Channel()
    volts = []
    first = 0
    for number, (codes, active) in enumerate(frames):
        start_s = lead_s + number * spec.frame_period_s
        stop = int(first_sample(start_s + spec.frame_period_s, rate_hz))
        rng = np.random.default_rng([seed, number])
        edges_s = start_s + channel.edges(spec, rng)
        levels = frame_levels(line_chips(spec, codes, active), spec)
        line_v = point_samples(levels, edges_s, rate_hz, first, stop)
        volts.append(channel.volts(channel.digitize(line_v, spec, rng), spec))
        first = stop
    return np.arange(first) / rate_hz, np.concatenate(volts)
