# SPDX-License-Identifier: Apache-2.0

"""Scores a candidate frame (start, chip duration) against the samples.

Functions of samples only, no stream state. Times are in samples relative to the stretch, and
sample i is the line's level at instant i: it stands for [i − ½, i + ½).
"""

from __future__ import annotations

import math
from dataclasses import fields
from functools import cached_property, lru_cache

import numpy as np

from ..base import kernel
from ..base.arrays import Floats, Floats32, Indices, Int32s
from ..base.stage import stage
from ..code.amplitude import (
    ACTIVE_SHARE,
    FAINT_SHARE,
    LOUDEST_FLOOR,
    usual_amplitude,
)
from ..code.frame import FrameSpec
from ..code.separate import frame_fields, frame_settings
from ..code.transform import Transform, chips_of, rows_of
from .limits import LIMITS

UNEVEN = 0.02
"""Spread of the words beyond which the chips' middle is tried, too: ρ < 7 if it were noise."""
MIDDLE = 0.78
"""Share of a chip's duration taken as its middle. Chosen: clear of edges up to 0.1 chip off their
ideal position, at a cost of 1.1 dB of noise."""
MORE_EVEN = 0.6
"""Spread of the middles over that of whole chips below which the middles are taken. Noise alone
gives 1/MIDDLE = 1.3, so that chance hardly gets there. Chosen."""
REACHES = np.array([0.5, 0.5, 0.25, 0.12])
"""Part of a chip on either side of an edge in which samples tell how late it comes: first as wide
as an edge may be off, and again for those that were farther off, last as narrow as edges a tenth of
a chip off ideal allow. Chosen."""
SETTLED_CHIPS = 0.02
"""Change of a frame's edges, chips, below which refinement ends. Chosen: an error of that size
leaves 1e-3 of the words' power over."""
BLUR = 0.3
"""Samples around an edge of which it is uncertain on which side of it they were taken. Chosen: a
sample counts in full beyond 0.15 samples from an edge."""


CHIPS_AT_ONCE = 1 << 18
"""Chips that a search integrates at once: bounds its memory to some 10 MB. Chosen."""


class Line:
    """Samples of a line and their running integral, evaluated at fractional instants.

    received: (m,) float64, V; the line is taken to be at rest outside. level_v: of rest, V.
    """

    def __init__(self, received: Floats, level_v: float = 0.0) -> None:
        self.received, self.level_v = received, level_v

    @cached_property
    def volts(self) -> Floats:
        """(m,) float64, V, without the level of rest."""
        return self.received - self.level_v if self.level_v else self.received

    @cached_property
    def sums(self) -> Floats:
        """Running integral, (m + 1,); float64 keeps 1e-16·m relative, far below any ADC count."""
        sums = np.empty(self.received.size + 1)
        sums[0] = 0.0
        np.cumsum(self.volts, out=sums[1:])
        return sums

    def means(self, edges: Floats) -> Floats32:
        """Mean level between consecutive edges, V: (…, e) samples to (…, e − 1) float32."""
        whole, share = _split(edges, self.volts.size)
        total, number = self.sum_before(whole, share), whole + share
        number = np.maximum(number[..., 1:] - number[..., :-1], 0.5)
        levels: Floats = (total[..., 1:] - total[..., :-1]) / number
        return levels.astype(np.float32)

    def sum_before(self, whole: Indices | Int32s, share: Floats) -> Floats:
        """Sum of so many whole samples and a share of the next one, V."""
        return self.sums[whole] + share * self.volts[whole]


class ChipEdges:
    """The edges of one fit's chips, worked out once for many lines of the same length."""

    def __init__(self, fit: Fit, spec: FrameSpec) -> None:
        self.fit, self._spec = fit, spec
        self._edges: Floats = fit.start + fit.chip * np.arange(spec.span_chips + 1.0)
        self._places = spec.places.astype(np.int32)
        self._size = 0  # samples of the lines for which the rest is known

    def chips(self, line: Line) -> Floats32:
        """As integrate gives them: (k, N) float32, V."""
        whole, share, number, places = self.within(line.received.size)
        levels: Floats = np.diff(line.sum_before(whole, share)) / number
        chips = levels[places].astype(np.float32)
        return chips.reshape(self._spec.line_bits, self._spec.order)

    def within(self, size: int) -> tuple[Int32s, Floats, Floats, Int32s]:
        """The edges in a line of so many samples.

        (e,) whole samples before each, and share of the next one, see _split; (e − 1,) samples
        between edges; (c,) numbers of the edges that chips begin at, rising.
        """
        if size != self._size:
            self._size = size
            whole, self._share = _split(self._edges, size)
            self._whole = whole.astype(np.int32)
            self._number = np.maximum(np.diff(whole + self._share), 0.5)
        return self._whole, self._share, self._number, self._places


def _split(times: Floats, size: int) -> tuple[Indices, Floats]:
    """Samples taken before each instant: how many whole ones, and the share of the next one.

    A sample tells the level at its own instant, so it counts on one side of an edge only: to
    share it by areas would blur every chip with its neighbours.
    """
    whole, share = _place(times, size)
    return whole, np.minimum(np.maximum((share - 0.5) / BLUR + 0.5, 0.0), 1.0)


def _place(times: Floats, size: int) -> tuple[Indices, Floats]:
    """The sample that each instant lies in, 0…size − 1, and the share of it that has passed."""
    shifted = np.minimum(np.maximum(times + 0.5, 0.0), float(size))
    whole = np.minimum(shifted.astype(np.intp), size - 1)
    return whole, shifted - whole


def integrate(
    line: Line, start: Floats, chip: Floats, spec: FrameSpec, share: float = 1.0
) -> Floats32:
    """Mean level of every chip for each candidate of start and chip duration.

    start, chip: (c,) float64, samples. share: middle part of each chip that is integrated.
    Returns (c, k, N) float32, V.
    """
    start, chip = start[:, None], chip[:, None]
    if share == 1.0:
        levels = line.means(start + chip * np.arange(spec.span_chips + 1))[:, spec.places]
    else:
        middle, reach = start + chip * (spec.places + 0.5), chip * (0.5 * share)
        levels = line.means(np.stack((middle - reach, middle + reach), axis=-1))
    return levels.reshape(-1, spec.line_bits, spec.order)


@stage
class WordFit:
    """What chips say when every node is held to one amplitude per word, for c candidates.

    rows: (c, k, N) float32, V: correlations of all rows.
    amplitude: (c, n) float32, V: mean of |r| over the bits; 0 where the node is silent.
    pedestal: (c,) float32, V: the level that unipolar nodes add; 0 for bipolar drive.
    uneven: (c, n) float32, V²: variance of |r| within active words.
    power: (c,) float32, V²: mean power of the chips that these words account for.
    spread: (c,) float32: sum of `uneven` over the power of the words.
    misfit: (c,) float32: power of the chips that the words leave over, relative to `power`.
    """

    rows: Floats32
    amplitude: Floats32
    pedestal: Floats32
    uneven: Floats32
    power: Floats32
    spread: Floats32
    misfit: Floats32

    def of(self, candidate: int) -> WordFit:
        """Those of a single candidate."""
        one = slice(candidate, candidate + 1)
        return WordFit(*(getattr(self, item.name)[one] for item in fields(self)))

    def signs(self, spec: FrameSpec) -> Floats32:
        """What nodes say: (c, k, n) float32, ±1, 0 where silent."""
        return np.sign(self.rows[..., spec.node_slice]) * (self.amplitude > 0)[:, None]

    def chips(self, spec: FrameSpec) -> Floats32:
        """The chips of these words, without the pedestal: (c, k, N) float32, V."""
        symbols = np.zeros_like(self.rows)
        symbols[..., spec.node_slice] = self.signs(spec) * self.amplitude[:, None]
        return chips_of(symbols, spec)

    def believable(self, spec: FrameSpec, noise: float = 0.0) -> bool:
        """Whether the words of a single candidate are even, and leave nothing over but noise.

        noise: variance of a chip's level in the gap, V²; 0 where unknown. It makes words spread by
        1/ρ², estimated with active·(k − 1) degrees of freedom, and has to explain spread beyond
        half of the limit. If unknown it follows from the words: noise that makes them spread by s
        leaves s/active in each of the N rows. What is more, beside distortion, is not understood.

        A few words may be those of broken nodes, or of two on one row, while wrong timing makes
        all uneven: a frame that fails as a whole may pass without its most uneven words, but then
        what is left must be cleaner than distortion by slightly wrong timing.
        """
        odd = int(LIMITS.odd_share * (np.count_nonzero(self.amplitude) + 1))
        return self._explained(0, 1.0, spec, noise) or (
            odd > 0 and self._explained(odd, LIMITS.stricter, spec, noise)
        )

    def explained_by(self, noise: float) -> bool:
        """Whether the words of a single candidate leave no more than noise, as reused timing may.

        noise: variance of a chip's level in the gap, V².
        """
        limit = LIMITS.carried_noise * noise / max(self.power.item(), 1e-30)
        return self.misfit.item() < limit + LIMITS.carried_misfit

    def is_clear(self, spec: FrameSpec) -> bool:
        """Whether the words of a single candidate leave no more than noise, in all bits alike.

        Of few words that is the noise by which they spread. Of many, a frame beside its mark leaves
        two chips of each in a bit, unless their bits are equal: then one, in its first or last bit.
        """
        power, spread = self.power.item(), self.spread.item()
        active = max(1, int(np.count_nonzero(self.amplitude)))
        even_power = power - self.pedestal.item() ** 2
        left = self.misfit.item() * power
        if active > LIMITS.few:
            is_little = left * spec.order < LIMITS.chips * even_power
            least = 0.25 * even_power
        else:
            noise = LIMITS.carried_noise * spec.order / active * spread * even_power
            is_little = spread < LIMITS.clear_spread
            is_little &= left < noise + LIMITS.carried_misfit * power
            least = float(np.square(self.amplitude[self.amplitude > 0]).min(initial=even_power))
        rows = self.rows[0]
        meant = rows if spec.first_row == 0 else rows[:, 1:]
        of_bits: Floats32 = np.einsum("kr,kr->k", meant, meant)
        of_bits -= 2 * np.abs(rows[:, spec.node_slice]) @ self.amplitude[0]
        most = float(of_bits.max())  # what the bit that leaves the most leaves, V²
        more = most - (float(of_bits.sum()) - most) / (len(of_bits) - 1)
        return is_little and more * spec.order < 2 * LIMITS.chips * least

    def _explained(self, odd: int, stricter: float, spec: FrameSpec, noise: float) -> bool:
        """As believable, without the given number of most uneven words and with stricter limits."""
        power, misfit = max(self.power.item(), 1e-30), self.misfit.item()
        spread = self.spread.item()
        limit, active = LIMITS.spread / stricter, int(np.count_nonzero(self.amplitude))
        even_power = power - self.pedestal.item() ** 2
        if odd:
            uneven, word_power = self.uneven[0], np.square(self.amplitude[0])
            order = np.argsort(uneven)
            misfit -= float(uneven[order[-odd:]].sum()) / power
            uneven, word_power = uneven[order[:-odd]], word_power[order[:-odd]]
            active, even_power = int(np.count_nonzero(word_power)), float(word_power.sum())
            spread = float(uneven.sum()) / max(even_power, 1e-30)
        if not (active and even_power > 0):
            return False
        if noise:
            left = LIMITS.left * noise / power
            expected = noise * active / spec.order / even_power
            scatter = math.sqrt(2 / (active * (spec.line_bits - 1)))
            most = min(limit * (1.7 - 0.7 / active), limit / 2 + expected * (1.3 + 4 * scatter))
        else:
            left, most = LIMITS.left * spec.order / active * spread * even_power / power, limit
        return spread < most and misfit < left + LIMITS.misfit / stricter


def read_words(chips: Floats32, spec: FrameSpec) -> WordFit:
    """Words of each candidate: chips (c, k, N) float32, V."""
    return fit_words(rows_of(chips, spec), spec)


def fit_words(rows: Floats32, spec: FrameSpec) -> WordFit:
    """Words of each candidate: correlations of all rows (c, k, N) float32, V."""
    count, pointer = len(rows), kernel.pointer
    amplitude, uneven = np.empty((2, count, spec.nodes), np.float32)
    pedestal, power, spread, misfit = of_frames = np.empty((4, count), np.float32)
    kernel.lib.words_fit_all(
        frame_settings(spec),
        count,
        pointer(rows, count, spec.line_bits, spec.row_count),
        pointer(amplitude, count, spec.nodes),
        pointer(uneven, count, spec.nodes),
        *(pointer(values, count) for values in of_frames),
    )
    return WordFit(rows, amplitude, pedestal, uneven, power, spread, misfit)


def word_floor(mean: Floats32, spec: FrameSpec) -> Floats32:
    """Amplitude that the words of a frame exceed, V: (…, n) mean |r| of all nodes to (…, 1).

    That is ACTIVE_SHARE of the nodes' amplitude where it is known, else of the usual one.
    """
    loudest = mean.max(axis=-1, keepdims=True)
    if spec.node_swing_v is not None:
        usual = np.minimum(loudest, np.float32(spec.node_swing_v))
    else:
        usual = usual_amplitude(mean)
    floor: Floats32 = np.maximum(
        np.float32(LOUDEST_FLOOR) * loudest, np.float32(ACTIVE_SHARE) * usual
    )
    return floor


def least_power(swing_v: float | None) -> float:
    """Power below which there is no node of this amplitude, V²; 0 where that is unknown."""
    return (FAINT_SHARE * (swing_v or 0.0)) ** 2


@stage
class Fit:
    """A frame in a line: first chip's begin and duration of a chip, samples."""

    start: float
    chip: float

    def end(self, spec: FrameSpec) -> float:
        """Instant at which the last chip ends."""
        return self.start + spec.span_chips * self.chip


def even_words(line: Line, fit: Fit, spec: FrameSpec, words: WordFit) -> WordFit:
    """Words of one fit, of whole chips or of their middle.

    words: of whole chips, the matched filter. Their middle is blind to edges a tenth of a chip off;
    it is taken where it makes uneven words more even than noise would by chance.
    """
    if words.spread[0] > UNEVEN:
        start, chip = np.array([fit.start]), np.array([fit.chip])
        middle = read_words(integrate(line, start, chip, spec, MIDDLE), spec)
        if middle.spread[0] < MORE_EVEN * words.spread[0]:
            return middle
    return words


class Code(kernel.Held):
    """Tells the kernel how frames of a specification are spread and read: its struct fit_code.

    refining: how it refines their fit, its struct fit_refining.
    """

    def __init__(self, spec: FrameSpec) -> None:
        transforms = [Transform(spec.book.plan, spreading) for spreading in (False, True)]
        flips = kernel.ffi.NULL
        if spec.flips is not None:
            shape = spec.line_bits, spec.order
            flips = kernel.pointer(np.ascontiguousarray(spec.flips, np.float32), *shape)
        code = kernel.struct(
            "fit_code",
            **frame_fields(spec),
            span=spec.span_chips,
            correlate=transforms[0].at,
            spread=transforms[1].at,
            flips=flips,
            places=kernel.pointer(spec.places.astype(np.int32), spec.chips),
        )
        super().__init__(code.at, None, code, transforms)
        self.refining = kernel.struct(
            "fit_refining",
            blur=BLUR,
            settled_chips=SETTLED_CHIPS,
            turns=REACHES.size,
            reaches=REACHES,
        )


code_of = lru_cache(maxsize=8)(Code)


def refine(
    line: Line, fit: Fit, spec: FrameSpec, earliest: float = -np.inf, latest: float = np.inf
) -> Fit:
    """Move start and chip duration to where the level changes of the decided words are.

    Around edge j the area between line and model is (v[j−1] − v[j])·τ[j] for an edge that comes
    τ[j] late; τ = δstart + j·δchip is fitted by least squares, in which big steps count most. This
    is repeated ever closer to the edges, until nothing moves.
    earliest, latest: bounds of the start. Edges out of view are left out.
    """
    code = code_of(spec)
    size, library = line.volts.size, kernel.lib
    samples = kernel.struct(
        "fit_line",
        size=size,
        volts=kernel.pointer(line.volts, size),
        sums=kernel.pointer(line.sums, size + 1),
        level=0.0,
    )
    room = library.fit_scratch(code.at)
    scratch = kernel.pointer(np.empty(room, np.float32), room)
    begun = {"start": fit.start, "chip": fit.chip}
    found = library.fit_refine(
        code.at, samples.at, code.refining.at, begun, earliest, latest, scratch
    )
    return Fit(found.start, found.chip)
