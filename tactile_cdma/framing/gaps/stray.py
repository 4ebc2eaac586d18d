# SPDX-License-Identifier: Apache-2.0

"""Finds nodes that are late or early by half chips and more, of which a frame's rows show little.

A node whose chips alternate leaves nothing in chips that reach from the middle of one of its own to
the next. In Paley's orders a row is another one's shift, or nearly, so that a node a chip late says
another one's word, and of equal bits only the frame's ends show that. So each word is asked whether
another node, late or early, explains the chips as well, and the frame is read between its chips.
"""

import math
from functools import lru_cache
from operator import mul
from typing import NamedTuple

import numpy as np

from ...base.arrays import Bools, Floats, Floats32, Indices
from ...base.sums import dot
from ...code.frame import FrameSpec
from ...code.transform import chips_of, rows_of
from ..fit import Fit, Line, WordFit, integrate
from .burst import Beside

BESIDE_CHIPS = 0.25, 1.25
"""From where to where, chips, a line is looked at for chips of such nodes, behind a frame and
before it. Chosen: clear of a low-pass of 0.3 chip; a node that is a chip late shows."""
PERHAPS, SURELY = (0.3, 2.5), (0.5, 3.7)
"""Mean level there, of a node's amplitude, and deviations of noise, beyond both of which words are
asked, and a node is believed to be out of time. Chosen: one a chip late has 0.75 there; of sound
frames at ρ = 12 one in 1,000 is in doubt."""
LEFT = 2.0
"""Energy that words may leave over in a bit, in squares of a node's amplitude, before they are
asked. Chosen: a quarter of what UNLIKE chips leave."""
CLEAR = 0.15
"""Noise of a chip, of a node's amplitude, beyond which words of at most one change of bits are
asked. Chosen: below, a frame's ends show a node by PERHAPS but for one in 100."""
TURNED, INNER, MOST_TURNED = 1.0, 0.35, 512
"""Mean square by which the line's level changes in the middle of a chip, in squares of a node's
amplitude, beyond which a frame is read between its chips; share of a chip before and behind its
middle that is compared; chips that are, at most. All chosen: a node half a chip off leaves 2 there,
or 4 if its chips alternate; edges 0.15 chip off leave nothing; more chips tell little more."""
MOST_LATE, UNLIKE = 2, 2
"""Chips by which a node may be late or early, to be taken for another; chips of a bit that differ
then. Both chosen: beyond, its chips show beside the frame, and in the noise."""
SURE = 6.0
"""Log-odds that a word is in time. Derived: two such hypotheses of normal noise are then told apart
wrongly once in 4,000 tries at worst, √(2·6) = 3.5 deviations."""
LATE_SHARE = 0.35
"""Share of a node's amplitude with which a word shows when it is read as late as it is. Chosen: one
between two readings, half a chip apart, has 0.5."""
BY_CHANCE = 4.0
"""Standard deviations by which it must exceed other nodes' rows. Chosen."""
SCATTER = 4.0
"""Deviations by which powers that are estimated may exceed what they are. Chosen."""


class _Twins(NamedTuple):
    """Rows that are those of other nodes, or their own inverted, but late: (h,) each.

    late: chips. own, other: nodes. sign: -1 where inverted. same_bit, next_bit: agreeing less
    differing chips where a bit overlaps with the other's same one, and with that beside it.
    """

    late: Indices
    own: Indices
    other: Indices
    sign: Floats32
    same_bit: Floats32
    next_bit: Floats32

    def of(self, some: Bools | Indices) -> "_Twins":
        """Some of them."""
        return _Twins._make(each[some] for each in self)


def strays(
    line: Line,
    fit: Fit,
    words: WordFit,
    beside: Beside,
    least: float,
    placed: bool,
    spec: FrameSpec,
) -> Bools | None:
    """Nodes that may not be where they seem, (n,) bool; None where there is no trace of any.

    least: amplitude of a node, V. placed: others tell where the frame is. kernel/gap.c asks first,
    so that frames without a trace of any do not come here.
    """
    noise, volts = max(beside.noise, 1e-30), line.volts - beside.level
    units = least, math.sqrt(noise / fit.chip)
    edge = max(map(abs, _beside_levels(volts, fit, spec)))
    perhaps, surely = (edge > max(map(mul, most, units)) for most in (PERHAPS, SURELY))
    if surely:
        return np.ones(spec.nodes, np.bool_)
    found, silent = np.zeros(spec.nodes, np.bool_), words.amplitude[0] == 0
    asks = perhaps or not placed
    if has_twins(spec) and (asks or _asks(words, noise / fit.chip, least, spec)):
        found = _of_others(Line(volts), fit, words, noise / fit.chip, placed, spec)
    if _turned(line, fit, noise, spec) > TURNED * least**2:
        found |= _between(line, fit, words, least, spec)
    return found | silent if found.any() else None


def has_twins(spec: FrameSpec) -> bool:
    """Whether a node out of time may be taken for another one."""
    return not spec.scramble and spec.span_chips == spec.chips and _twins(spec).own.size > 0


def _beside_levels(volts: Floats, fit: Fit, spec: FrameSpec) -> list[float]:
    """Mean level of a chip before a frame and of one behind it, V; impulses are single samples."""
    near, far = BESIDE_CHIPS
    found = []
    for begin in (fit.start - far * fit.chip, fit.end(spec) + near * fit.chip):
        end = math.ceil(begin + (far - near) * fit.chip)
        chip = np.sort(volts[max(0, math.ceil(begin)) : max(0, end)])
        # Without the sample that is farthest off.
        means = (chip[1:].mean(), chip[:-1].mean()) if chip.size > 1 else (0.0,)
        found.append(float(min(means, key=abs)))
    return found


def _asks(words: WordFit, noise: float, least: float, spec: FrameSpec) -> bool:
    """Whether words leave more than noise, of that variance, V², or too little shows in noise."""
    left = words.misfit.item() * words.power.item() - noise * (
        1 + SCATTER * math.sqrt(2 / spec.chips)
    )
    if left > LEFT * least**2 / spec.order:
        return True
    is_set = words.rows[0, :, spec.node_slice][:, words.amplitude[0] > 0] > 0
    changes_once = np.count_nonzero(is_set[1:] != is_set[:-1], axis=0) <= 1
    return noise > (CLEAR * least) ** 2 and bool(changes_once.any())


def _turned(line: Line, fit: Fit, noise: float, spec: FrameSpec) -> float:
    """Mean square by which levels change within chips, beyond noise, V²: noise of a sample, V²."""
    places = np.arange(min(spec.span_chips, MOST_TURNED))[:, None] + [0.5 - INNER, 0.5, 0.5 + INNER]
    edges: Floats = fit.start + fit.chip * places
    turns = np.diff(line.means(edges), axis=1)[:, 0]
    by_noise = 2 * noise / (INNER * fit.chip)
    return dot(turns, turns) / turns.size - by_noise * (1 + SCATTER * math.sqrt(2 / turns.size))


def _of_others(
    line: Line, fit: Fit, words: WordFit, noise: float, placed: bool, spec: FrameSpec
) -> Bools:
    """Words that may be those of other nodes, (n,) bool. noise: of a chip, V²."""
    edges: Floats = np.arange(-MOST_LATE, spec.chips + MOST_LATE + 1, dtype=np.float64)
    left = line.means(fit.start + fit.chip * edges)
    left[MOST_LATE:-MOST_LATE] -= words.chips(spec).ravel() + words.pedestal[0]
    found, twins = np.zeros(spec.nodes, np.bool_), _twins(spec)
    level = words.signs(spec)[0] * words.amplitude[0]
    for late in set(twins.late.tolist()):
        of_active = twins.of((twins.late == late) & (words.amplitude[0][twins.own] > 0))
        own = of_active.own
        power = _power(of_active, level, spec)
        fits = _along(left, of_active, late, level, spec)
        found[own[fits - power / 2 > -SURE * noise]] = True
        if placed or not own.size:
            continue
        # Or all may be, where nothing else tells where the frame is, but for one that is late.
        each = np.unique(own, return_index=True)[1]
        everyone = _change(of_active.of(each), late, level, spec)
        one = each if each.size > 1 else each[:0]
        less = power - 2 * _along(everyone, of_active, late, level, spec)
        powers = dot(everyone, everyone) + np.append(0, less[one])
        if (fits[each].sum() - np.append(0, fits[one]) - powers / 2 > -SURE * noise).any():
            return np.ones(spec.nodes, np.bool_)
    return found


def _change(twins: _Twins, late: int, level: Floats32, spec: FrameSpec) -> Floats:
    """By how much chips, from MOST_LATE before a frame on, change if all words are the others'.

    level: (k, n) V, of every bit.
    """
    change = np.zeros(spec.chips + 2 * MOST_LATE)
    moved = twins.sign * level[:, twins.own]
    for shift, nodes, values in ((0, twins.own, -level[:, twins.own]), (late, twins.other, moved)):
        symbols = np.zeros((spec.line_bits, spec.order), np.float32)
        np.add.at(symbols[:, spec.node_slice].T, nodes, values.T)
        change[MOST_LATE + shift :][: spec.chips] += chips_of(symbols, spec).ravel()
    return change


def _along(
    chips: Floats | Floats32, twins: _Twins, late: int, level: Floats32, spec: FrameSpec
) -> Floats:
    """Product of chips with the change that each of these words makes alone, (h,) V²."""
    both = np.stack([chips[MOST_LATE + shift :][: spec.chips] for shift in (0, late)])
    rows = rows_of(both.astype(np.float32).reshape(2, spec.line_bits, spec.order), spec)
    in_time, out_of_time = rows[..., spec.node_slice]
    seen = twins.sign * out_of_time[:, twins.other] - in_time[:, twins.own]
    product: Floats = np.einsum("kh,kh->h", level[:, twins.own], seen, dtype=np.float64)
    return spec.order * product


def _power(twins: _Twins, level: Floats32, spec: FrameSpec) -> Floats:
    """Sum of squares of each of these changes, (h,) V²: of two words that overlap as rows do."""
    own = level[:, twins.own].astype(np.float64)
    squares, steps = np.square(own).sum(axis=0), (own[1:] * own[:-1]).sum(axis=0)
    words = spec.order * (1 + np.abs(twins.sign))  # sign is 0 where rows of order 4 agree in half
    power: Floats = squares * (words - 2 * twins.same_bit) - 2 * steps * twins.next_bit
    return power


@lru_cache(maxsize=8)
def _twins(spec: FrameSpec) -> _Twins:
    rows, order, found = spec.node_rows.astype(np.float32), spec.order, []
    for late in (*range(-MOST_LATE, 0), *range(1, MOST_LATE + 1)):
        moved = np.roll(rows, late, axis=1)
        alike = moved @ rows.T
        alike[np.diag_indices(spec.nodes)] = np.minimum(alike.diagonal(), 0)  # says the same
        other, own = np.nonzero(np.abs(alike) >= order - 2 * UNLIKE)
        sign = np.sign(alike[other, own])
        wrapped = np.s_[:late] if late > 0 else np.s_[late:]
        next_bit = sign * np.einsum("hc,hc->h", moved[other, wrapped], rows[own, wrapped])
        same_bit = np.abs(alike[other, own]) - next_bit
        found.append((np.full(own.size, late), own, other, sign, same_bit, next_bit))
    return _Twins(*(np.concatenate(each) for each in zip(*found, strict=True)))


def _between(line: Line, fit: Fit, words: WordFit, least: float, spec: FrameSpec) -> Bools:
    """Nodes whose words show between chips, or in those of neighbours, (n,) bool.

    What words that are in time leave there is fitted by shares of the nearest chips.
    """
    chips, found = words.chips(spec).ravel(), np.zeros(spec.nodes, np.bool_)
    reach = MOST_LATE + 2
    around = np.pad(chips, reach)
    for halves in (*range(-2 * MOST_LATE - 1, 0), *range(1, 2 * MOST_LATE + 2)):
        first = reach + halves // 2
        near = np.stack([around[first + i :][: chips.size] for i in (-1, 0, 1, 2)])
        start = np.array([fit.start + 0.5 * halves * fit.chip])
        read = integrate(line, start, np.array([fit.chip]), spec)[0]
        share = np.linalg.lstsq(near @ near.T, near @ read.ravel(), rcond=None)[0]
        left = read - (share.astype(np.float32) @ near).reshape(read.shape)
        mean = np.abs(rows_of(left, spec)[:, spec.node_slice]).mean(axis=0)
        # Noise, as which all else shows: mean of |r|, and how far it scatters by chance.
        noise = float(np.median(mean)) * (1 + BY_CHANCE * 0.76 / math.sqrt(spec.line_bits))
        found |= mean > max(LATE_SHARE * least, noise)
    return found
