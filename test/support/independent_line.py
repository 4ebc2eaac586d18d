# SPDX-License-Identifier: Apache-2.0

"""A second, plain implementation of what a digitizer samples, for tests and `make bench-doubt`.

It judges the decoder, so it imports nothing of the package and was written from docs/protocol.md,
firmware/codes.md and docs/signal-model.md alone: code books and row signs as defined there, nodes
as steps of voltage at instants of time, a line with the faults of real ones, and a digitizer's
samples. Truth and samples come out together:

    render(Skin(), Talk(), Line(low_pass_chips=0.3), Digitizer(), frames=100, seed=1) → Recording

Time is counted in nominal chips from the beginning of the recording.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise, product
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .sparse_codes import mixed, node_chips, scrambler

Floats: TypeAlias = NDArray[np.floating[Any]]
Ints: TypeAlias = NDArray[np.integer[Any]]

SILENT = -1
"""Code of a node that says nothing."""
LEAST_CELLS = 20
"""Cells per chip in which the line is computed: an instant's sample is the mean of 1/20 chip."""
RAMP_STEPS = 8
"""Small steps that make up the ramp of a slow edge."""


# The code book of every order, from firmware/codes.md


@cache
def code_book(order: int) -> NDArray[np.int8]:
    """C, (N, N) of ±1. Raises ValueError for an order without a code book."""
    parts = factors(order)
    if parts is None:
        raise ValueError(f"order {order} has no code book")
    book = np.ones((1, 1), dtype=np.int8)
    for part in parts:
        book = np.kron(book, _factor(part))
    return book


@cache
def factors(order: int) -> tuple[int, ...] | None:
    """The orders whose matrices make up the code book; None where there is no book."""
    return min(_ways(order, 2), key=lambda way: (sum(way), way), default=None)


def default_order(rows: int) -> int:
    """The host's choice for so many rows."""
    smallest = next(order for order in range(rows, 2 * rows + 1) if factors(order) is not None)
    for order in range(smallest, smallest * 102 // 100 + 1):
        parts = factors(order)
        if parts is not None and max(parts, default=1) <= 100:
            return order
    return smallest


def row_sign(row: int, seed: int | None) -> int:
    """Sign of a code row; seed None: natural signs."""
    return 1 if seed is None or mixed(row, seed) < 2**31 else -1


@cache
def flips(bits: int, order: int, seed: int) -> NDArray[np.int8]:
    """What scrambled nodes multiply their chips by, (bits, N) of ±1."""
    per_bit = -(-order // 8)
    taken = np.array(scrambler(bits * per_bit, seed), np.uint8).reshape(bits, per_bit)
    read = np.unpackbits(taken, axis=1, bitorder="little")[:, -order:]
    return 1 - 2 * read.astype(np.int8)


def _ways(order: int, least: int) -> Iterator[tuple[int, ...]]:
    """All ways to write the order as an ascending product of factors of `least` or more."""
    if order == 1:
        yield ()
    for factor in range(least, min(order, 1024) + 1):
        if order % factor == 0 and (factor == 2 or _paley_field(factor)):
            yield from ((factor, *rest) for rest in _ways(order // factor, factor))


def _paley_field(order: int) -> tuple[int, int, int] | None:
    """Construction (1 or 2), p and m of Paley's matrix of this order; None where there is none."""
    for construction, elements in ((1, order - 1), (2, order // 2 - 1)):
        if elements % 4 == (3 if construction == 1 else 1) and order % (2 * construction) == 0:
            p = next((p for p in range(3, elements + 1) if elements % p == 0), 2)
            m = next(m for m in range(1, 20) if p**m >= elements)
            if p**m == elements:
                return construction, p, m
    return None


def _factor(order: int) -> NDArray[np.int8]:
    """H₂, or Paley's matrix of this order."""
    field = _paley_field(order)
    if field is None:
        return np.array([[1, 1], [1, -1]], dtype=np.int8)
    construction, p, m = field
    chi = _characters(p, m)
    book = np.ones((len(chi) + 1, len(chi) + 1), dtype=np.int8)
    book[1:, 1:] = chi
    if construction == 1:
        book[1:, 0] = -1
        np.fill_diagonal(book, 1)
        return book
    doubled = np.kron(book, np.array([[1, 1], [1, -1]], dtype=np.int8))
    for i in range(len(book)):
        doubled[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [[1, -1], [-1, -1]]
    doubled[:, 1] *= -1
    return doubled


def _characters(p: int, m: int) -> NDArray[np.int8]:
    """χ(a − b) of all elements a, b of the field of pᵐ elements."""
    digits = np.array([[a // p**i % p for i in range(m)] for a in range(p**m)])
    modulus = _first_irreducible(p, m)
    value = p ** np.arange(m)
    chi = np.full(p**m, -1, dtype=np.int8)
    for element in digits:
        chi[value @ _remainder(np.convolve(element, element), modulus, p)[:m]] = 1
    chi[0] = 0
    differences: NDArray[np.int8] = chi[(digits[:, None] - digits) % p @ value]
    return differences


def _first_irreducible(p: int, m: int) -> Ints:
    """Coefficients from c₀ on of the first irreducible polynomial x^m + … + c₀."""
    smaller = [
        np.array([*low, 1]) for d in range(1, m // 2 + 1) for low in product(range(p), repeat=d)
    ]
    for low in product(range(p), repeat=m):
        candidate = np.array([*low, 1])
        if all(_remainder(candidate, divisor, p).any() for divisor in smaller):
            return candidate
    raise ValueError(f"no irreducible polynomial of degree {m} modulo {p}")


def _remainder(dividend: Ints, divisor: Ints, p: int) -> Ints:
    """Remainder of polynomials modulo p, coefficients from c₀ on; the divisor's last one is 1."""
    rest, degree = dividend % p, len(divisor) - 1
    for top in range(len(rest) - 1, degree - 1, -1):
        rest[top - degree : top + 1] = (rest[top - degree : top + 1] - rest[top] * divisor) % p
    return rest


# What is on the line


@dataclass(frozen=True)
class Skin:
    """How the nodes share the line; docs/protocol.md has the meaning of each field.

    period_chips: from frame start to frame start. drive: "bipolar" or "unipolar". sparse: codes
        are, which are scrambled by themselves. restart_chips: chips that nodes send before they
        pause for guard_chips, silent; 0: all.
    """

    nodes: int = 16
    order: int = 20
    bits: int = 10
    parity: bool = False
    first_row: int = 1
    sign_seed: int | None = 1
    chip_s: float = 50e-6
    period_chips: float = 256.0
    amplitude_v: float = 0.3
    drive: str = "bipolar"
    polarity: int = 1
    scramble: bool = False
    sparse: bool = False
    restart_chips: int = 0
    guard_chips: int = 0

    @property
    def places(self) -> Ints:
        """Where the chips that nodes send begin, (bits · order,) chips after the frame's start."""
        sent: Ints = np.arange((self.bits + self.parity) * self.order)
        return sent + sent // (self.restart_chips or sent.size) * self.guard_chips

    @property
    def chips(self) -> int:
        """Chips of one frame, with its pauses."""
        return int(self.places[-1]) + 1

    def waveforms(self, codes: Ints) -> Floats:
        """Chips of the nodes that send these words, (m, chips), V; codes: (n,), SILENT or a word.

        Row j belongs to the j-th node that is not silent.
        """
        nodes = np.flatnonzero(codes != SILENT)
        bits = codes[nodes, None] >> np.arange(self.bits - 1, -1, -1) & 1
        if self.parity:
            bits = np.column_stack((bits, bits.sum(axis=1) % 2))
        if self.sparse:
            chips = np.zeros((nodes.size, bits.shape[1], self.order))
            for sent, node in zip(chips, nodes, strict=True):
                sent[:] = _sparse_chips(self, int(node) + 1)
        else:
            signs = [row_sign(self.first_row + int(node), self.sign_seed) for node in nodes]
            rows = code_book(self.order)[self.first_row + nodes]
            chips = (np.array(signs)[:, None] * rows)[:, None, :]
        levels: Floats = (2.0 * bits - 1)[:, :, None] * chips
        if self.scramble:
            assert self.sign_seed is not None
            levels *= flips(bits.shape[1], self.order, self.sign_seed)
        if self.drive == "unipolar":
            levels = (levels + 1) / 2
        places = self.places
        flat = np.zeros((len(nodes), self.chips))
        flat[:, places] = self.polarity * self.amplitude_v * levels.reshape(-1, places.size)
        return flat


@cache
def _sparse_chips(skin: Skin, node: int) -> Floats:
    """What a node, counted from 1, sends for 1 bits, (bits, order) of ±1."""
    assert skin.sign_seed is not None
    bits = skin.bits + skin.parity
    return node_chips(node, skin.nodes, skin.order, bits, skin.sign_seed)


@dataclass(frozen=True)
class Talk:
    """What the nodes say.

    speakers: numbers, from 0 on, of the nodes that may ever transmit, or how many of them, drawn
        for each recording; None: all.
    share: of frames in which each of them does. stay: mean number of frames until that is decided
        anew (joining and leaving); 0: it is decided for every frame. together: in every frame so
        many of the speakers transmit, drawn anew; 0: each by its share.
    words: "random", "equal" (the same one from all nodes in a frame), "slow" (random walks), or
        "extreme" (the ends of the range, whose bits are nearly all the same).
    """

    speakers: tuple[int, ...] | int | None = None
    share: float = 1.0
    stay: float = 0.0
    together: int = 0
    words: str = "random"

    def codes(self, skin: Skin, frames: int, rng: np.random.Generator) -> Ints:
        """(frames, n), SILENT or a word."""
        size, top = (frames, skin.nodes), 2**skin.bits
        match self.words:
            case "random":
                codes = rng.integers(0, top, size)
            case "equal":
                codes = np.repeat(rng.integers(0, top, (frames, 1)), skin.nodes, axis=1)
            case "slow":
                walk = rng.integers(0, top, skin.nodes) + rng.integers(-3, 4, size).cumsum(axis=0)
                codes = np.clip(walk, 0, top - 1)
            case "extreme":
                codes = rng.choice([0, 1, top - 2, top - 1], size)
            case _:
                raise ValueError(f"words {self.words!r}: random, equal, slow or extreme")
        codes[~self._speaks(size, rng)] = SILENT
        return codes

    def _speaks(self, size: tuple[int, int], rng: np.random.Generator) -> NDArray[np.bool_]:
        """(frames, n): who transmits when."""
        speakers = self.speakers if self.speakers is not None else size[1]
        if isinstance(speakers, int):
            speakers = tuple(rng.choice(size[1], speakers, replace=False))
        lot = np.ones(size)
        lot[:, list(speakers)] = rng.random((size[0], len(speakers)))
        if self.together:
            return lot < np.sort(lot, axis=1)[:, self.together, None]
        speaks: NDArray[np.bool_] = lot < self.share
        if self.stay:
            decided = rng.random(size) < 1 / self.stay
            decided[0] = True
            last = np.maximum.accumulate(np.where(decided, np.arange(size[0])[:, None], 0), axis=0)
            speaks = np.take_along_axis(speaks, last, axis=0)
        return speaks


@dataclass(frozen=True)
class Line:
    """What time and the analog parts do to the nodes' waveforms; by default nothing.

    Times of frames and chips:
    start_jitter_chips: each frame starts late by up to this, uniform. slip_share: of frames at
        which the raster jumps by a chip, either way. stretch: each frame's chips last longer by up
        to this share, uniform. clock_error: of the nodes' chips and frames, relative.
    skew_chips: each node is late by up to this, uniform and fixed. late: (node, chips) pairs.
    slow: (node, share) pairs, whose chips last longer by this, relative to the others'.
    dropouts: (node, share) pairs: in this share of its words a node stops after its first bit.
    edge_jitter_chips: standard deviation of every edge, common to the nodes.

    Voltages:
    noise_v: standard deviation of the mean over one chip; white. offset_v: level in silence.
    spread: standard deviation of the nodes' amplitudes, relative. gains: (node, factor) pairs.
    gain: factor of all nodes' amplitudes.
    droop: share of the amplitude lost by the frame's end. ripple, ripple_hz: of the amplitudes,
        relative peak. rise_chips, fall_chips: duration of an edge's ramp.
    low_pass_chips: time constant. ringing, ringing_chips: overshoot of a step, relative, and its
        period. high_pass_hz: AC coupling.
    hum_v, hum_hz: peak. impulses_hz, impulse_v, impulse_chips: rate, height (either sign), width.
    bursts_hz, burst_v, burst_tone_hz, burst_s: rate, peak, frequency and decay of ringing.
    steps_hz, step_v: the baseline jumps, up and down in turn. drift_v_per_s: of the offset.
    amplifier_v: the amplifier's rails about its level in silence, which the digitizer cannot see.
    onset: share of the recording after which it sets in that nodes are late, slow or drop out,
        gain, gains, offset and drift, hum, impulses, bursts and jumps; and what the digitizer does.
    """

    start_jitter_chips: float = 0.0
    slip_share: float = 0.0
    stretch: float = 0.0
    clock_error: float = 0.0
    skew_chips: float = 0.0
    late: tuple[tuple[int, float], ...] = ()
    slow: tuple[tuple[int, float], ...] = ()
    dropouts: tuple[tuple[int, float], ...] = ()
    edge_jitter_chips: float = 0.0
    noise_v: float = 0.01
    offset_v: float = 0.0
    spread: float = 0.0
    gains: tuple[tuple[int, float], ...] = ()
    gain: float = 1.0
    droop: float = 0.0
    ripple: float = 0.0
    ripple_hz: float = 100.0
    rise_chips: float = 0.0
    fall_chips: float = 0.0
    low_pass_chips: float = 0.0
    ringing: float = 0.0
    ringing_chips: float = 0.5
    high_pass_hz: float = 0.0
    hum_v: float = 0.0
    hum_hz: float = 50.0
    impulses_hz: float = 0.0
    impulse_v: float = 1.0
    impulse_chips: float = 0.2
    bursts_hz: float = 0.0
    burst_v: float = 1.0
    burst_tone_hz: float = 20e3
    burst_s: float = 2e-4
    steps_hz: float = 0.0
    step_v: float = 0.0
    drift_v_per_s: float = 0.0
    amplifier_v: float = np.inf
    onset: float = 0.0

    def starts(self, skin: Skin, frames: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """Start of every frame, chips, and the duration of its chips, nominal ones."""
        raster = (1 + self.clock_error) * skin.period_chips * (np.arange(frames) + 1.5)
        slips = rng.choice([-1.0, 1.0], frames) * (rng.random(frames) < self.slip_share)
        jitter = rng.uniform(0, 1, frames) * self.start_jitter_chips
        chip = (1 + self.clock_error) * (1 + rng.uniform(0, 1, frames) * self.stretch)
        return raster + rng.uniform(0, 1) + slips.cumsum() + jitter, chip


@dataclass(frozen=True)
class Digitizer:
    """How the line is sampled.

    samples_per_chip: raw samples, or those that are averaged into one value per chip (integrated).
    marked: the first sample of every frame is marked. rail_v: readings end at ±rail_v. adc_bits:
    of a reading. losses_hz: rate at which samples are lost, up to 200 in a row.
    mark_shifts: chips by which marks are late, one of them drawn for each of a share of the frames
        (mark_share). slip_share: of frames within which one sample is dropped or doubled, and not
        counted.
    """

    samples_per_chip: int = 4
    integrated: bool = False
    marked: bool = True
    rail_v: float = 6.0
    adc_bits: int = 14
    losses_hz: float = 0.0
    mark_shifts: tuple[float, ...] = ()
    mark_share: float = 0.3
    slip_share: float = 0.0

    @property
    def volts_per_count(self) -> float:
        return self.rail_v / float(2 ** (self.adc_bits - 1))


@dataclass(frozen=True)
class Run:
    """Consecutive samples.

    first_index: of the first sample in the stream. t_chips: when it was taken, or, if integrated,
    when its chip began. marked: a frame begins with it.
    """

    first_index: int
    t_chips: float
    counts: NDArray[np.int16]
    marked: bool


@dataclass(frozen=True)
class Truth:
    """One frame as it was sent.

    start_chips, chip: of the frame's first chip, and the duration of its chips, nominal chips.
    codes: (n,), SILENT or a word. clipped: share of the frame's samples at a rail.
    """

    start_chips: float
    chip: float
    codes: Ints
    clipped: float


@dataclass(frozen=True)
class Recording:
    """What the digitizer sent, and what was true."""

    skin: Skin
    digitizer: Digitizer
    runs: tuple[Run, ...]
    frames: tuple[Truth, ...]

    @property
    def never(self) -> NDArray[np.bool_]:
        """(n,), nodes that never transmitted."""
        silent: NDArray[np.bool_] = np.stack([frame.codes for frame in self.frames]) == SILENT
        never: NDArray[np.bool_] = np.all(silent, axis=0)
        return never


def render(
    skin: Skin, talk: Talk, line: Line, digitizer: Digitizer, frames: int, seed: int | list[int]
) -> Recording:
    """Samples of so many frames, with a period and a half of silence before and after them."""
    rng = np.random.default_rng(seed)
    codes = talk.codes(skin, frames, rng)
    starts, chips = line.starts(skin, frames, rng)
    if digitizer.marked:
        # The first sample of a frame is taken half a sample after the frame's first edge.
        starts = np.round(starts * digitizer.samples_per_chip) / digitizer.samples_per_chip
    # An odd number of cells per sample: raw samples lie in the middle of a cell.
    cells = digitizer.samples_per_chip * (1 + 2 * (LEAST_CELLS // digitizer.samples_per_chip // 2))
    length = int(starts[-1] + 2.5 * skin.period_chips)
    volts = _line_volts(skin, line, codes, starts, chips, length, cells, rng)
    told, begin = starts, line.onset * length
    if digitizer.mark_shifts:
        is_late = (rng.random(frames) < digitizer.mark_share) & (starts >= begin)
        told = starts + is_late * rng.choice(digitizer.mark_shifts, frames)
    instants, marks = _sampling(skin, digitizer, told, length)
    if digitizer.slip_share:
        can_slip = starts >= begin
        taken, marks = _slipped(skin, digitizer, len(instants), marks, can_slip, rng)
        instants = instants[taken]
    sigma_v = line.noise_v * np.sqrt(digitizer.samples_per_chip)
    read = volts[(instants * cells).astype(np.int64)]
    phase = 2 * np.pi * (line.hum_hz * skin.chip_s * instants + rng.uniform(0, 1))
    drift_v = line.drift_v_per_s * skin.chip_s * (instants - begin)
    disturbed = instants >= begin
    read += disturbed * (line.offset_v + drift_v + line.hum_v * np.sin(phase))
    read += sigma_v * rng.standard_normal(instants.shape)
    lsb_v, top = digitizer.volts_per_count, 2 ** (digitizer.adc_bits - 1)
    counts = np.clip(np.round(read / lsb_v), -top, top - 1)
    at_rail = (counts == -top) | (counts == top - 1)
    if digitizer.integrated:
        counts, at_rail = counts.mean(axis=1).round(), at_rail.mean(axis=1)
        instants = instants[:, 0] - 0.5 / digitizer.samples_per_chip
    first, last = np.searchsorted(instants, (starts, starts + skin.chips * chips))
    truth = tuple(
        Truth(
            float(starts[f]), float(chips[f]), codes[f], float(at_rail[first[f] : last[f]].mean())
        )
        for f in range(frames)
    )
    runs = _runs(skin, digitizer, instants, counts.astype(np.int16), marks, rng)
    return Recording(skin, digitizer, tuple(runs), truth)


def _line_volts(
    skin: Skin,
    line: Line,
    codes: Ints,
    starts: Floats,
    chips: Floats,
    length: int,
    cells: int,
    rng: np.random.Generator,
) -> Floats:
    """Mean voltage of every cell, without offset, hum and noise; (length · cells,)."""
    skew = rng.uniform(0, 1, skin.nodes) * line.skew_chips
    usual = 1 + line.spread * rng.standard_normal(skin.nodes)
    delay, gain, begin = skew.copy(), usual * line.gain, line.onset * length
    for node, chip in line.late:
        delay[node] += chip
    for node, factor in line.gains:
        gain[node] *= factor
    before = replace(line, slow=(), dropouts=()), skew, usual
    steps = [
        _frame_steps(
            skin, codes[f], starts[f], chips[f],
            *((line, delay, gain) if starts[f] >= begin else before), rng,
        )
        for f in range(len(codes))
    ]  # fmt: skip
    at, height = (np.concatenate(parts) for parts in zip(*steps, strict=True))
    at, height = _ramped(at, height, height > 0, line.rise_chips)
    at, height = _ramped(at, height, height < 0, line.fall_chips)
    volts = np.clip(
        _filtered(_stairs(at, height, length, cells), skin, line, cells),
        -line.amplifier_v,
        line.amplifier_v,
    )
    duration_s = (length - begin) * skin.chip_s
    if line.impulses_hz:
        at = rng.uniform(begin, length, rng.poisson(line.impulses_hz * duration_s))
        height = line.impulse_v * rng.choice([-1.0, 1.0], at.size)
        ends = np.append(at, at + line.impulse_chips)
        volts += _stairs(ends, np.append(height, -height), length, cells)
    if line.bursts_hz:
        volts += _ringing(skin, line, length, cells, rng)
    if line.steps_hz:
        at = np.sort(rng.uniform(begin, length, rng.poisson(line.steps_hz * duration_s)))
        volts += _stairs(at, line.step_v * (1 - 2 * (np.arange(at.size) % 2)), length, cells)
    return volts


def _frame_steps(
    skin: Skin,
    codes: Ints,
    start: float,
    chip: float,
    line: Line,
    delay: Floats,
    gain: Floats,
    rng: np.random.Generator,
) -> tuple[Floats, Floats]:
    """Instants, chips, and heights, V, of all steps of the nodes in one frame."""
    nodes, count = np.flatnonzero(codes != SILENT), np.arange(skin.chips)
    levels = skin.waveforms(codes) * gain[nodes, None] * (1 - line.droop * count / skin.chips)
    t_s = (start + chip * count) * skin.chip_s
    levels *= 1 + line.ripple * np.sin(2 * np.pi * line.ripple_hz * t_s)
    for node, share in line.dropouts:
        if rng.random() < share:
            levels[nodes == node, rng.integers(skin.order, skin.chips) :] = 0.0
    jitter = line.edge_jitter_chips * rng.standard_normal(skin.chips + 1)
    longer = np.ones(skin.nodes)
    for node, share in line.slow:
        longer[node] += share
    # Nodes that keep time together are one, unless each has ramps of its own.
    times, of = np.unique(np.stack((longer, delay))[:, nodes], axis=1, return_inverse=True)
    if line.rise_chips or line.fall_chips:
        times, of = np.stack((longer, delay))[:, nodes], np.arange(nodes.size)
    heights = np.zeros((times.shape[1], skin.chips + 1))
    np.add.at(heights, of.ravel(), np.diff(levels, axis=1, prepend=0.0, append=0.0))
    edges = start + chip * times[0][:, None] * (np.arange(skin.chips + 1) + jitter)
    return (edges + times[1][:, None]).ravel(), heights.ravel()


def _ringing(skin: Skin, line: Line, length: int, cells: int, rng: np.random.Generator) -> Floats:
    """Bursts of a decaying tone, V, (length · cells,)."""
    cell_s, volts = skin.chip_s / cells, np.zeros(length * cells)
    begin = line.onset * length
    bursts = rng.poisson(line.bursts_hz * (length - begin) * skin.chip_s)
    t_s = np.arange(round(6 * line.burst_s / cell_s)) * cell_s
    for at in rng.uniform(begin, length, bursts):
        phase = 2 * np.pi * (line.burst_tone_hz * t_s + rng.uniform(0, 1))
        shape = line.burst_v * np.exp(-t_s / line.burst_s) * np.sin(phase)
        into = volts[int(at * cells) :][: t_s.size]
        into += shape[: into.size]
    return volts


def _ramped(
    at: Floats, height: Floats, chosen: NDArray[np.bool_], chips: float
) -> tuple[Floats, Floats]:
    """The steps with the chosen ones spread over so many chips."""
    if not chips:
        return at, height
    ramp = (np.arange(RAMP_STEPS) + 0.5) / RAMP_STEPS * chips
    small = np.repeat(height[chosen] / RAMP_STEPS, RAMP_STEPS)
    spread = (at[chosen, None] + ramp).ravel()
    return np.append(at[~chosen], spread), np.append(height[~chosen], small)


def _stairs(at: Floats, height: Floats, length: int, cells: int) -> Floats:
    """Mean of every cell of a line that steps by these heights at these instants; exact."""
    cell, part = np.divmod(np.minimum(at, length) * cells, 1.0)
    cell, size = cell.astype(np.int64), length * cells + 2
    rises = np.bincount(cell, height * (1 - part), size)
    rises += np.bincount(cell + 1, height * part, size)
    stairs: Floats = rises.cumsum()[: length * cells]
    return stairs


def _filtered(volts: Floats, skin: Skin, line: Line, cells: int) -> Floats:
    """The line behind its low-pass, resonance and coupling capacitor."""
    from scipy.signal import lfilter  # slow to load, and needed here only

    if line.low_pass_chips:
        kept = np.exp(-1 / (line.low_pass_chips * cells))
        volts = lfilter([1 - kept], [1, -kept], volts)
    if line.ringing:
        # Two poles; a step overshoots by exp(−π·damping/frequency) after half a period.
        turn = 2 * np.pi / (line.ringing_chips * cells)
        pole = np.exp(turn * (np.log(line.ringing) / np.pi + 1j))
        poles = [1, -2 * pole.real, abs(pole) ** 2]
        volts = lfilter([sum(poles)], poles, volts)
    if line.high_pass_hz:
        kept = np.exp(-2 * np.pi * line.high_pass_hz * skin.chip_s / cells)
        volts = volts - lfilter([1 - kept], [1, -kept], volts)
    return volts


def _sampling(skin: Skin, digitizer: Digitizer, starts: Floats, length: int) -> tuple[Floats, Ints]:
    """Instants of all samples, chips, and which of them begin frames.

    Integrated: (frames · chips, m) instants, of the samples that are averaged into each value.
    """
    per_chip = digitizer.samples_per_chip
    middles = (np.arange(per_chip) + 0.5) / per_chip
    if digitizer.integrated:
        begins = (starts[:, None] + np.arange(skin.chips)).ravel()
        return begins[:, None] + middles, np.arange(0, begins.size, skin.chips)
    instants = (np.arange(length)[:, None] + middles).ravel()
    return instants, np.searchsorted(instants, starts)


def _slipped(
    skin: Skin,
    digitizer: Digitizer,
    samples: int,
    marks: Ints,
    can_slip: NDArray[np.bool_],
    rng: np.random.Generator,
) -> tuple[Ints, Ints]:
    """Which samples are taken, some of them twice, and where marks are then.

    can_slip: (frames,), those in which that may happen.
    """
    per_chip = 1 if digitizer.integrated else digitizer.samples_per_chip
    times = np.ones(samples, dtype=np.int64)
    for mark in marks[(rng.random(marks.size) < digitizer.slip_share) & can_slip]:
        times[mark + rng.integers(1, skin.chips * per_chip - 1)] = rng.choice([0, 2])
    return np.repeat(np.arange(samples), times), np.concatenate(([0], times.cumsum()))[marks]


def _runs(
    skin: Skin,
    digitizer: Digitizer,
    instants: Floats,
    counts: NDArray[np.int16],
    marks: Ints,
    rng: np.random.Generator,
) -> Iterator[Run]:
    """Cuts the stream where it has holes and at the marks, or once a period if it has no marks."""
    per_chip = 1 if digitizer.integrated else digitizer.samples_per_chip
    kept = np.ones(counts.size, dtype=bool)
    duration_s = counts.size / per_chip * skin.chip_s
    for at in rng.integers(0, counts.size, rng.poisson(digitizer.losses_hz * duration_s)):
        kept[at : at + rng.integers(1, 201)] = False
    if not digitizer.marked:
        marks = np.arange(0, counts.size, int(skin.period_chips * per_chip))
    holes = np.flatnonzero(np.diff(kept)) + 1
    cuts = np.unique(np.concatenate(([0], marks, holes, [counts.size])))
    for begin, end in pairwise(cuts):
        if kept[begin]:
            marked = digitizer.marked and begin in marks
            yield Run(int(begin), float(instants[begin]), counts[begin:end], bool(marked))
