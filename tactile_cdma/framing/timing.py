# SPDX-License-Identifier: Apache-2.0

"""Samples of the line in, frames out: what all kinds of timing share.

`line_timing` is told where frames start, `gap_timing` has nothing but the waveform. Both keep their
own samples; how the stream is cut into blocks changes nothing.
"""

from __future__ import annotations

import math
import operator
from dataclasses import astuple, dataclass, fields, replace
from typing import TypeAlias

import numpy as np

from ..base.arrays import Bools, Floats, Floats32
from ..base.stage import stage
from ..base.sums import copy_samples, outside
from ..code.frame import FrameSpec
from ..code.separate import NodeLevels
from .limits import LIMITS

Rails: TypeAlias = tuple[float, float] | None

ABSURD_V = 1e6
"""Level that no digitizer reports, V: such samples are treated like NaN. Chosen."""
RAIL_MARGIN = 1e-3
"""Distance from a rail, relative to the range, within which a sample counts as clipped. Chosen:
about one count of a 10-bit converter."""


@stage
class SampleBlock:
    """Consecutive samples of the line.

    first_index: index of volts[0] in the digitizer's sample stream.
    volts: (m,) float32, V. checked: absurd ones are NaN already.
    sync: volts[0] is the first sample of a frame (line timing). turn: whose frame it is; see
        docs/protocol.md.
    """

    first_index: int
    volts: Floats32
    sync: bool = False
    turn: int = 0
    checked: bool = False


@dataclass(frozen=True, slots=True)
class QuietBlock:
    """Consecutive samples in which no node transmitted, as the digitizer summed them up.

    first_index, sync, turn: as in SampleBlock. count: number of samples.
    mean_v, variance_v2: of the samples, V and V².
    """

    first_index: int
    count: int
    mean_v: float
    variance_v2: float
    sync: bool = False
    turn: int = 0

    def samples(self) -> SampleBlock:
        """Made-up samples of this mean; of this variance, too, if their number is even."""
        volts = np.full(self.count, self.mean_v, dtype=np.float32)
        deviation_v = math.sqrt(self.variance_v2)
        volts[::2] += deviation_v
        volts[1::2] -= deviation_v
        return SampleBlock(self.first_index, volts, self.sync, self.turn)


@stage
class FrameLevels:
    """One frame, or one silent slot.

    start: stream index, fractional, at which the first chip begins; sample i is instant i.
    chip_samples: recovered chip duration, samples.
    levels: of the nodes; None where there is nothing but offset and noise in this slot.
    noise_rms_v: noise of one chip's level, V; NaN where unknown.
    offset_v: the line's level in silence, V.
    clipped: share of the frame's samples at a rail, 0…1.
    doubtful: (n,) bool, nodes whose word, or whose silence, is a guess: other frames, some chips
        away, explain the samples as well, or a node was late and may be taken for another. None
        where no node's is.
    placed: a mark, or the raster of others, tells where it is; else its words alone do.
    turn: whose it is, where groups of nodes transmit by turns; 0: everybody's.
    """

    start: float
    chip_samples: float
    levels: NodeLevels | None
    noise_rms_v: float
    offset_v: float
    clipped: float
    doubtful: Bools | None = None
    placed: bool = True
    turn: int = 0

    def in_turn(self, turn: int) -> FrameLevels:
        """The same frame, of this turn."""
        return replace(self, turn=turn) if turn else self


_LEAST_STORE = 4096
"""Room of a new buffer, samples; it grows as needed."""


class SampleBuffer:
    """Samples still needed, by stream index: float64, V, NaN where absurd."""

    def __init__(self) -> None:
        self.begin = 0
        self.end = 0
        self._store = np.empty(_LEAST_STORE)
        self._at = 0  # place of `begin` in the store

    def restart(self, index: int) -> None:
        """Forget everything; the next sample has this index."""
        self.begin = self.end = index
        self._at = 0

    def append(self, volts: Floats32, checked: bool = False) -> None:
        """Add the samples that follow. checked: see SampleBlock."""
        kept = self.end - self.begin
        # At the front of the store, which the cache still holds, if that moves little.
        if self._at > 4 * kept or self._at + kept + volts.size > self._store.size:
            self._make_room(kept + volts.size)
        place = self._at + kept
        store = self._store[place : place + volts.size]
        if checked:
            store[:] = volts
        else:
            copy_samples(ABSURD_V, np.asarray(volts, np.float32), store)
        self.end += volts.size

    def take(self, begin: int, end: int) -> Floats:
        """Samples begin…end − 1, as far as they are kept; a view, valid until the next append."""
        first, stop = max(begin, self.begin), max(min(end, self.end), self.begin)
        return self._store[self._at + first - self.begin : self._at + max(stop, first) - self.begin]

    def drop(self, before: int) -> None:
        """Forget samples before an index."""
        count = min(before, self.end) - self.begin
        if count > 0:
            self.begin += count
            self._at += count

    def _make_room(self, size: int) -> None:
        """Move the kept samples to the front of a store of at least twice the size needed."""
        kept = self._store[self._at : self._at + self.end - self.begin]
        if 2 * size > self._store.size:
            self._store = np.empty(4 * size)
        self._store[: kept.size] = kept
        self._at = 0


@dataclass(frozen=True, slots=True)
class Rejections:
    """Stretches of the line of which nothing is claimed, neither words nor silence, by reason.

    incomplete: cut off by a hole in the stream, a mark or its end. absurd: NaN, or volts that no
    digitizer reports. at_rail: so many samples that whoever spoke may not show. noisy: noise would
    hide words. misfit: something was sent that no words explain. not_at_rest: words, but the line
    is not silent before or after them.
    """

    incomplete: int = 0
    absurd: int = 0
    at_rail: int = 0
    noisy: int = 0
    misfit: int = 0
    not_at_rest: int = 0

    def __add__(self, other: Rejections) -> Rejections:
        return Rejections(*map(operator.add, astuple(self), astuple(other)))

    @property
    def leading(self) -> Rejections:
        """One rejection for the most frequent reason."""
        names = [item.name for item in fields(self)]
        return Rejections(**{max(names, key=lambda name: int(getattr(self, name))): 1})

    @property
    def total(self) -> int:
        """All of them."""
        counts = self.incomplete, self.absurd, self.at_rail, self.noisy, self.misfit
        return sum(counts, self.not_at_rest)  # astuple takes 15 times as long


INCOMPLETE, ABSURD, AT_RAIL = Rejections(incomplete=1), Rejections(absurd=1), Rejections(at_rail=1)
NOISY, MISFIT = Rejections(noisy=1), Rejections(misfit=1)
NOT_AT_REST = Rejections(not_at_rest=1)


class Timing:
    """A stream of samples, cut into blocks of any size.

    rejections: of all of it so far.
    """

    def __init__(self) -> None:
        self.rejections = Rejections()
        self._samples = SampleBuffer()
        self._fresh = True

    def reset(self) -> None:
        """Forget the frame in progress, since the stream has a hole."""
        self._fresh = True

    def _join(self, block: SampleBlock | QuietBlock) -> bool:
        """Continue the stream with a block; False where it starts anew there, after a hole."""
        if not self._fresh and block.first_index == self._samples.end:
            return True
        if not self._fresh:
            self.reset()
        self._samples.restart(block.first_index)
        self._fresh = False
        return False


def silence_hidden(clipped: float, noise_rms_v: float, spec: FrameSpec) -> Rejections | None:
    """Why a frame without words cannot be called silent: a node that spoke might not show.

    clipped: share of its samples at a rail. noise_rms_v: of one chip's level, V; NaN if unknown.
    """
    if clipped > LIMITS.deafened:
        return AT_RAIL
    return NOISY if noise_rms_v > blinding_noise_v(spec) else None


def blinding_noise_v(spec: FrameSpec) -> float:
    """Noise of one chip's level, V RMS, beyond which words may be missed; infinite if unknown."""
    if spec.node_swing_v is None:
        return math.inf
    return spec.node_swing_v * math.sqrt(spec.order) / LIMITS.blind_rho


def share_clipped(volts: Floats, rails_v: Rails) -> float:
    """Share of samples at a rail, within RAIL_MARGIN.

    rails_v: lowest and highest level that the amplifier or the converter can give, V; None where
    unknown (nothing counts as clipped then).
    """
    return outside(*within_rails(rails_v), volts) / volts.size if volts.size else 0.0


def within_rails(rails_v: Rails) -> tuple[float, float]:
    """Levels between which samples do not count as clipped, V; infinite where unknown."""
    low, high = rails_v or (-math.inf, math.inf)
    margin = RAIL_MARGIN * (high - low) if rails_v else 0.0
    return low + margin, high - margin
