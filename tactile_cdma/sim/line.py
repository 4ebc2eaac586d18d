# SPDX-License-Identifier: Apache-2.0

"""In every frame period: what the nodes send, and what the converter reads of the line."""

from collections.abc import Iterator
from itertools import chain, count
from typing import Protocol

import numpy as np

from ..base.arrays import Counts, Floats, Floats32
from ..wire._protocol import SYNC_LEAD, SYNC_UNIT_US, SyncWire
from .channel import chip_means, first_sample, point_samples, waveforms
from .nodes import NodeFrame, Turns, rest_codes
from .options import Setup, SimOptions
from .scene import EXTERNAL, LOADS, SCENES, Scene, idle
from .sensor import Sensor

LEAD_S = SYNC_LEAD * SYNC_UNIT_US * 1e-6
"""From a pulse's edge to what it announces, s."""
Waveform = tuple[Floats32, Floats]
"""Levels (c,) V between edges (c + 1,) s."""


class Disturbance(Protocol):
    """A fault on the line, made by tests: it comes between the nodes and the converter."""

    def added(self, frame: NodeFrame, edges_s: Floats) -> Iterator[Waveform]:
        """Yield waveforms to add to those of the nodes; edges_s: (span_chips + 1,), nominal."""
        ...

    def disturbed(self, frame: NodeFrame, volts: Floats32, t_s: Floats) -> Floats32:
        """Return the line, (m,) V at (m,) s since START, as it reaches the amplifier."""
        ...


def truth(
    options: SimOptions, setup: Setup, turns: Turns | None = None, scene: Scene | None = None
) -> Iterator[NodeFrame]:
    """Yield what the nodes measure and send in every frame since START, endlessly.

    The same arguments give the same frames. turns: may be asked for while frames are drawn.
    scene: instead of the options', whose "external" is idle.
    """
    spec, sensors, rules = setup.spec, options.sensors, options.rules(setup.spec)
    skin, turns = options.skin(spec.nodes, spec.first_row), turns or Turns()
    scene = scene or (SCENES | LOADS | {EXTERNAL: idle})[options.scene]
    sensor, adc = Sensor(sensors, spec.nodes), sensors.adc(spec.bits)
    rest = rest_codes(sensors, adc, spec.nodes)
    dead, stuck = (sensors.indices(each, spec.nodes) for each in (sensors.dead, sensors.stuck))
    at_rest, last_sent = rest, rest.copy()
    beat = rules.beat(spec.nodes)
    owed = np.zeros(spec.nodes, bool)  # heartbeats that came out of turn
    nodes = np.arange(1, spec.nodes + 1)
    for number in count():
        start_s = (number - options.start_phase) * spec.frame_period_s
        pressure_pa = scene(start_s, skin)
        voltage_v = sensor.step(pressure_pa, start_s)
        codes = adc.code(voltage_v)
        codes[stuck] = rest[stuck]
        active = rules.has_news(codes, at_rest, last_sent)
        due = np.zeros(spec.nodes, bool)
        if rules.heartbeat:
            due = beat == number % rules.heartbeat
        turn, asked = turns.turn(number)
        active |= due | owed | asked
        if turn:
            others = (nodes ^ turn) & ((1 << turn.bit_length() - 1) - 1) != 0
            active &= ~others
            owed |= due & others
        owed &= ~active
        if start_s >= sensors.dead_after_s:
            active[dead] = False
        last_sent[active] = codes[active]
        at_rest = rules.followed(number, codes, at_rest)
        yield NodeFrame(number, start_s, pressure_pa, voltage_v, codes, active, turn, asked)


def line_counts(
    options: SimOptions, setup: Setup, frame: NodeFrame, disturbance: Disturbance | None = None
) -> Counts:
    """Readings of the converter in one frame period, (m,) int16 counts.

    Raw: all samples from the frame's start to the next one's. Integrated: means of the coded chips.
    """
    spec, channel = setup.spec, options.channel
    rng = np.random.default_rng([options.seed, frame.number])
    clocks = options.clocks(spec.nodes)
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
        next_s = (frame.number + 1 - options.start_phase) * spec.frame_period_s
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
    counts = channel.digitize(line_v, spec, rng, averaged)
    if setup.wire == SyncWire.DATA and not setup.integrated:
        slot = spec.resync_chips + spec.guard_chips or spec.span_chips
        restarts = range(slot, spec.span_chips, slot)
        ends_s = [*(frame.start_s + chip * spec.chip_s for chip in restarts), next_s]
        hold(counts, first, ends_s, setup.rate_hz)
    return counts


def hold(counts: Counts, first: int, ends_s: list[float], rate_hz: float) -> None:
    """Hold the last sample before each pulse on the data wire up to what the pulse announces.

    first: index of the first sample since START. ends_s: when what is announced begins. Of the
    pulses before a frame, those of its turn are left out.
    """
    for end_s in ends_s:
        start, stop = np.maximum(first_sample([end_s - LEAD_S, end_s], rate_hz) - first, 0)
        counts[start:stop] = counts[max(start - 1, 0)]
