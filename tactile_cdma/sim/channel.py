# SPDX-License-Identifier: Apache-2.0

"""The analog line: from the chips of all nodes to digitized samples.

y(t) = offset + polarity · Σ aᵢ·xᵢ(t) + noise, clipped at the amplifier's rails, then quantised.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..base.arrays import Bools, Counts, Floats, Floats32, Int64s
from ..code.encode import frame_levels, line_chips
from ..code.frame import DEFAULT_AMPLITUDE_V, UNIPOLAR, FrameSpec
from .nodes import NodeClocks

MAX_JITTER = 0.25
"""Largest option `jitter`, in chips. Chosen: no chip is then shorter than half of its duration."""


@dataclass(frozen=True, slots=True)
class Channel:
    """Models what the line does to the chips.

    offset_v: level of silence, V. noise_rms_v: of one sample, V. stretch: the chips of a frame
    last up to this share longer, drawn per frame, the same for all nodes. jitter: largest
    displacement of a chip's edge, in chips, drawn per edge and not accumulating. rail_v: the
    amplifier saturates this far from the offset, V; 0 leaves room for every likely sum.
    adc_bits: the digitizer's converter, whose full scale just spans the rails.
    """

    offset_v: float = 0.0
    noise_rms_v: float = 0.005
    stretch: float = 0.0
    jitter: float = 0.0
    rail_v: float = 0.0
    adc_bits: int = 12

    def rail_of(self, spec: FrameSpec) -> float:
        """Rails of the amplifier about the offset, V.

        With random signs the sum of n nodes stays below 8·√n·A (5.4 at most in realistic
        scenes); with natural signs it reaches n·A.
        """
        if self.rail_v:
            return self.rail_v
        peak = float(spec.nodes)
        if spec.sign_seed is not None and spec.drive != UNIPOLAR:
            peak = min(peak, 8.0 * math.sqrt(peak))
        amplitude_v = DEFAULT_AMPLITUDE_V if spec.amplitude_v is None else spec.amplitude_v
        return 1.1 * peak * amplitude_v + 6.0 * self.noise_rms_v

    def volts_per_count(self, spec: FrameSpec) -> float:
        """Return one count of the digitized line, V, rounded to a float32 as on the wire."""
        finest = abs(self.offset_v) / 32_767  # zero_count is an int16 on the wire
        return float(np.float32(max(2.0 * self.rail_of(spec) / (1 << self.adc_bits), finest)))

    def zero_count(self, spec: FrameSpec) -> int:
        """Reading at 0 V: the middle of the converter's range is at the offset."""
        return round(-self.offset_v / self.volts_per_count(spec))

    @property
    def min_count(self) -> int:
        return -(1 << (self.adc_bits - 1))

    @property
    def max_count(self) -> int:
        return (1 << (self.adc_bits - 1)) - 1

    def edges(self, spec: FrameSpec, rng: np.random.Generator) -> Floats:
        """Start of every chip, and the last one's end: (span_chips + 1,), s from the start."""
        chip_s = spec.chip_s * (1.0 + self.stretch * rng.random())
        edges = np.arange(spec.span_chips + 1, dtype=np.float64)
        if self.jitter:
            edges[1:] += rng.uniform(-self.jitter, self.jitter, spec.span_chips)
        return edges * chip_s

    def digitize(
        self, volts: Floats32, spec: FrameSpec, rng: np.random.Generator, averaged: int = 1
    ) -> Counts:
        """Amplify and convert: noise, rails, offset, quantisation. (m,) V to (m,) counts.

        averaged: samples that one value is the mean of.
        """
        if self.noise_rms_v:
            noise = rng.standard_normal(len(volts), dtype=np.float32)
            volts = volts + np.float32(self.noise_rms_v / math.sqrt(averaged)) * noise
        rail_v = self.rail_of(spec)
        line_v = np.minimum(np.maximum(volts, -rail_v), rail_v) + np.float32(self.offset_v)
        counts = np.rint(line_v / np.float32(self.volts_per_count(spec))) + self.zero_count(spec)
        return np.asarray(np.clip(counts, self.min_count, self.max_count), np.int16)

    def volts(self, counts: Counts, spec: FrameSpec) -> Floats32:
        """Convert counts (m,) to V, (m,) float32."""
        # int16 minus int16 needs 17 bits: widen before subtracting.
        volts = (counts.astype(np.int32) - self.zero_count(spec)) * self.volts_per_count(spec)
        return volts.astype(np.float32)


def waveforms(
    spec: FrameSpec, codes: Int64s, active: Bools, edges_s: Floats, clocks: NodeClocks | None = None
) -> Iterator[tuple[Floats32, Floats]]:
    """Yield waveforms whose sum is the line in one frame: levels (c,) V between edges (c + 1,) s.

    codes, active: (n,). edges_s: (span_chips + 1,) where a nominal clock puts them. Without
    clocks of their own all nodes share these edges; else each active node has its own.
    """
    if clocks is None:
        yield frame_levels(line_chips(spec, codes, active), spec), edges_s
        return
    since = np.arange(edges_s.size)  # chips counted since the last sync edge
    if spec.resync_chips:
        since %= spec.resync_chips + spec.guard_chips
    late_s = clocks.displacement(since) * spec.chip_s
    for node in np.flatnonzero(active):
        alone = np.arange(spec.nodes) == node
        own_s = edges_s + late_s[node]
        # A sync edge cuts off what a slow node has not finished.
        own_s = np.minimum.accumulate(own_s[::-1])[::-1]
        yield frame_levels(line_chips(spec, codes, alone), spec), own_s


def point_samples(
    levels: Floats32, edges_s: Floats, rate_hz: float, first: int, stop: int
) -> Floats32:
    """Return the line as a converter samples it at instants, (stop − first,) float32, V.

    levels: (c,) V; edges_s: (c + 1,) s on the stream's clock. Sample i is taken in the middle of
    its period, at (i + ½)/rate_hz; before the first and after the last chip the line is at 0. The
    0.1 to 0.2 µs that an edge takes are neglected.
    """
    begins = np.empty(len(edges_s) + 2, dtype=np.int64)
    begins[0], begins[-1] = first, stop
    begins[1:-1] = np.maximum(np.minimum(first_sample(edges_s, rate_hz), stop), first)
    heights = np.zeros(len(levels) + 2, dtype=np.float32)
    heights[1:-1] = levels
    return np.repeat(heights, begins[1:] - begins[:-1])


def chip_means(levels: Floats32, edges_s: Floats, chip_s: float) -> Floats32:
    """Return the mean of the line over every nominal chip of a frame, (c,) float32, V.

    levels: (c,) V; edges_s: (c + 1,) s after the frame's start. This is what a digitizer
    integrates: it does not know that the chips stretch or jitter.
    """
    integral = np.concatenate(([0.0], np.cumsum(levels * np.diff(edges_s))))
    windows = np.arange(len(levels) + 1) * chip_s
    return np.asarray(np.diff(np.interp(windows, edges_s, integral)) / chip_s, np.float32)


def first_sample(t_s: ArrayLike, rate_hz: float) -> Int64s:
    """Index of the first sample taken at or after t_s."""
    return np.asarray(np.ceil(np.asarray(t_s, np.float64) * rate_hz - 0.5), np.int64)
