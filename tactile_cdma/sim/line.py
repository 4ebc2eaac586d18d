# SPDX-License-Identifier: Apache-2.0

"""The digitized line: what the converter reads in every frame period."""

from collections.abc import Iterator
from itertools import chain
from typing import Protocol

import numpy as np

from ..base.arrays import Counts, Floats, Floats32
from .channel import chip_means, first_sample, point_samples, waveforms
from .nodes import NodeFrame, RollCalls, frame_start_s, node_frames
from .options import Setup, SimOptions
from .scene import EXTERNAL, LOADS, SCENES, Scene, idle

Waveform = tuple[Floats32, Floats]
"""Levels (c,) V between edges (c + 1,) s."""


class Disturbance(Protocol):
    """A fault on the line, made by tests: it comes between the nodes and the converter."""

    def added(self, frame: NodeFrame, edges_s: Floats) -> Iterator[Waveform]:
        """Waveforms to add to those of the nodes; edges_s: (span_chips + 1,), nominal."""
        ...

    def disturbed(self, frame: NodeFrame, volts: Floats32, t_s: Floats) -> Floats32:
        """The line, (m,) V at (m,) s since START, as it reaches the amplifier."""
        ...


def truth(
    options: SimOptions,
    setup: Setup,
    roll_calls: RollCalls | None = None,
    scene: Scene | None = None,
) -> Iterator[NodeFrame]:
    """What the nodes measure and send in every frame since START, endlessly.

    scene: what touches the skin; None: what the options say, of "external" the untouched skin.
    """
    scenes = SCENES | LOADS | {EXTERNAL: idle}
    spec = setup.spec
    return node_frames(
        spec,
        scene or scenes[options.scene],
        options.skin(spec.nodes, spec.first_row),
        options.rules(spec),
        options.sensors,
        start_phase=options.start_phase,
        roll_calls=roll_calls,
    )


def line_counts(
    options: SimOptions, setup: Setup, frame: NodeFrame, disturbance: Disturbance | None = None
) -> Counts:
    """Readings of the converter in one frame period, (m,) int16 counts.

    Raw: all samples from the start of the frame to the start of the next. Integrated: the mean of
    every coded chip, m = spec.chips.
    """
    spec, channel = setup.spec, options.channel
    rng = np.random.default_rng([options.seed, frame.number])
    clocks = options.clocks.at(spec.nodes, frame.start_s)
    edges_s = channel.edges(spec, rng)
    if setup.integrated:
        first, stop, averaged = 0, spec.chips, setup.samples_per_chip
        nominal = clocks is None and not (channel.stretch or channel.jitter)

        def seen(levels: Floats32, own_s: Floats) -> Floats32:
            if nominal and own_s is edges_s:
                return levels[spec.places]
            return chip_means(levels, own_s, spec.chip_s)[spec.places]
    else:
        edges_s += frame.start_s
        next_s = frame_start_s(spec, frame.number + 1, options.start_phase)
        first, stop = np.maximum(first_sample([frame.start_s, next_s], setup.rate_hz), 0).tolist()
        averaged = 1

        def seen(levels: Floats32, own_s: Floats) -> Floats32:
            return point_samples(levels, own_s, setup.rate_hz, first, stop)

    line_v = np.zeros(stop - first, np.float32)
    added = disturbance.added(frame, edges_s) if disturbance else ()
    for levels, own_s in chain(waveforms(spec, frame.codes, frame.active, edges_s, clocks), added):
        line_v += seen(levels, own_s)
    if disturbance:
        t_s = (np.arange(first, stop, dtype=np.float64) + 0.5) / setup.rate_hz
        if setup.integrated:
            t_s = np.asarray(frame.start_s + (spec.places + 0.5) * spec.chip_s, np.float64)
        line_v = disturbance.disturbed(frame, line_v, t_s)
    return channel.digitize(line_v, spec, rng, averaged)
