# SPDX-License-Identifier: Apache-2.0

"""Measures a node's clock from a frame in which it speaks alone.

Its row is known; its word, delay and clock error are not. A candidate for the latter two gives the
amplitude of each bit, and the mean of their magnitudes says how much of the samples' energy it
explains. A candidate is a pair of displacements, of the frame's begin and of its end:

1. Range search: all pairs on a raster of half chips. Over 16 chips no believable clock drifts by
   more than a third of a chip, so pieces of 16 chips are correlated once at each displacement,
   and candidates only add them up.
2. Zoom: a raster around the best, recentred and halved. Ideal edges make the energy fall off as
   |τ|, not τ²: the likelihood is about 1/(k·ρ²) chips wide, where regression on the areas around
   edges has 1/(ρ·√k).
3. The mean, weighted by likelihood, over a raster that is as wide as the likelihood.
"""

from dataclasses import dataclass
from math import ceil, sqrt

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Floats, Floats32
from ..base.errors import SpecError
from ..code.frame import FrameSpec
from .node_clocks import NodeClocks
from .sampling import RunningSum

LARGEST_DELAY = 1.0
"""Largest delay that is searched for, chips. Chosen: a node starts within its first chip."""
LARGEST_RATE_ERROR = 0.02
"""Largest relative clock error searched for. Chosen: calibrated RC oscillators keep about that."""
HEARD = 4.0
"""ρ from which on a node counts as heard; the best of 10⁴ candidates in noise alone has 2."""
MAX_LEFT = 0.15
"""Power beyond noise that a lone node may leave, relative to its own. Chosen, as limits.misfit."""
_PIECE = 16
"""Chips that are correlated at one displacement: at LARGEST_RATE_ERROR they drift by 0.32 chip."""
_WIDEST, _FINEST = 0.087, 0.004
"""Steps of the first and the last raster of the zoom, chips. Chosen: at 2 samples per chip and
little drift the energy is a staircase, and a wider raster may step over its top."""
_TIE = 1e-4
"""Relative difference of explained energies that counts as at least one unit of log-likelihood.
Chosen: bounds what a line without noise tells apart."""


@dataclass(frozen=True, slots=True)
class HeardClock:
    """A node's clock as one roll-call frame shows it.

    delay_chips, rate_error: as in NodeClocks. rho: amplitude over the noise of one bit's
    correlation. refusal: why this is no node speaking alone; empty if it is one.
    """

    delay_chips: float
    rate_error: float
    rho: float
    refusal: str


class RollCallListener:
    """Collects the clocks of all nodes while they are called one after the other."""

    def __init__(self, spec: FrameSpec, per_chip: float) -> None:
        """Raises SpecError below two samples per chip, and for frames with restarts in them."""
        if spec.resync_chips:
            raise SpecError(
                "nodes that start anew within a frame show too little of their clocks: a roll call "
                "takes resync_chips 0"
            )
        if per_chip < 1.9:
            raise SpecError(
                f"{per_chip:g} samples per chip: a roll call takes raw samples, 2 per chip or more"
            )
        self.spec, self.per_chip = spec, per_chip
        self.heard: dict[int, HeardClock] = {}

    @property
    def samples(self) -> int:
        """Samples of a frame that are looked at: until the slowest clock is through."""
        spec = self.spec
        longest = spec.chips * (1 + LARGEST_RATE_ERROR) + LARGEST_DELAY
        return int(self.per_chip * min(longest, spec.frame_period_s / spec.chip_s))

    def hear(self, node: int, samples: Floats32, noise_rms_v: float) -> HeardClock:
        """Measure the clock of a node, counted from 0, in its frame; a refused clock is not kept.

        samples: (≥ self.samples,) V, from the sync edge on, gap level removed. noise_rms_v: of one
        sample in the gap.
        """
        line = np.asarray(samples[: self.samples], dtype=np.float64)
        # One row at a time: those of all nodes of a large skin are gigabytes.
        (row,) = self.spec.book.rows([self.spec.rows[node]])
        clock = hear_node(line, row, self.spec, self.per_chip, noise_rms_v)
        if not clock.refusal:
            self.heard[node] = clock
        return clock

    def clocks(self) -> NodeClocks:
        """The clocks so far; for nodes not heard, the median of the others."""
        nodes = self.spec.nodes
        delay, rate, known = np.zeros(nodes), np.zeros(nodes), np.zeros(nodes, bool)
        for node, clock in self.heard.items():
            delay[node], rate[node], known[node] = clock.delay_chips, clock.rate_error, True
        if known.any():
            delay[~known], rate[~known] = np.median(delay[known]), np.median(rate[known])
        return NodeClocks(delay, rate, known)


def hear_node(
    line: Floats, row: NDArray[np.int8], spec: FrameSpec, per_chip: float, noise_rms_v: float
) -> HeardClock:
    """Delay and clock error of the one node that speaks in a frame.

    line: (m,) float64, V, from the sync edge on, gap level removed. row: (N,) of ±1, the node's.
    noise_rms_v: of one sample in the gap.
    """
    search = RowSearch(line, row, spec, per_chip)
    unit = 2 * noise_rms_v**2
    late, step, reach = search.coarse(), _WIDEST, 6  # as far as the coarse raster's neighbours
    while step > _FINEST:
        begins, ends = raster(late, step, reach)
        energy = search.energy(begins, ends)
        tops = np.flatnonzero(energy >= (1 - _TIE) * energy.max())
        middle = np.argmin(np.hypot(*(x[tops] - x[tops].mean() for x in (begins, ends))))
        late = np.array([begins[tops[middle]], ends[tops[middle]]])
        step, reach = step / 2, 2
    while True:
        begins, ends = raster(late, step, 2)
        energy = search.energy(begins, ends)
        weight = np.exp((energy - energy.max()) / max(unit, _TIE * energy.max(), 1e-30))
        weight /= weight.sum()
        mean = np.array([weight @ begins, weight @ ends])
        std = np.sqrt([weight @ np.square(begins - mean[0]), weight @ np.square(ends - mean[1])])
        if std.max() < 0.8 * step or step > _WIDEST:
            return _judged(search, line, mean, noise_rms_v)
        step *= 1.5


def raster(late: Floats, step: float, reach: int) -> tuple[Floats, Floats]:
    """Candidates around one: begins and ends, ((2·reach + 1)²,) each."""
    shifts = step * np.arange(-reach, reach + 1)
    return np.repeat(late[0] + shifts, shifts.size), np.tile(late[1] + shifts, shifts.size)


class RowSearch:
    """A row's amplitude in the samples, for displacements of the frame's begin and end."""

    def __init__(
        self, line: Floats, row: NDArray[np.int8], spec: FrameSpec, per_chip: float
    ) -> None:
        self.chips, self.bits = spec.chips, spec.line_bits
        self.row, self.sums = row, RunningSum(line, per_chip)
        flips = 1.0 if spec.flips is None else spec.flips
        self.rows = np.broadcast_to(row * flips, (self.bits, row.size)).astype(float)

    def explained(self, begin: Floats, end: Floats) -> tuple[Floats, Floats]:
        """Mean magnitude of the bits' amplitudes, V, and samples per bit; begin, end: (h,) chips.

        Samples count in fractions: else a shorter frame would win over a longer one that is alike.
        """
        rate = 1 + (end - begin) / self.chips
        edges = begin[:, None] + rate[:, None] * np.arange(self.chips + 1)
        sums, counts = self.sums.until(edges)
        chips = np.diff(sums).reshape(len(begin), self.bits, -1)
        levels = np.einsum("hkn,kn->hk", chips, self.rows)
        count = np.maximum(counts[:, -1] - counts[:, 0], 1.0) / self.bits
        return np.abs(levels).mean(axis=1) / count, count

    def energy(self, begin: Floats, end: Floats) -> Floats:
        """Energy that a word of equal amplitudes explains, V²·samples."""
        amplitude, count = self.explained(begin, end)
        return np.square(amplitude) * count * self.bits

    def coarse(self) -> Floats:
        """The best pair of displacements on a raster of half chips."""
        order, reach = self.row.size, ceil(LARGEST_RATE_ERROR * self.chips)
        halves = np.arange(-2 * reach, 2 * (reach + ceil(LARGEST_DELAY)) + 1)
        # Level of the chip that begins at each half chip of the line.
        begins = np.arange(halves[0], 2 * self.chips + halves[-1] + 1) / 2
        levels = self.sums.until(begins + 1)[0] - self.sums.until(begins)[0]
        displaced = np.lib.stride_tricks.sliding_window_view(levels, halves.size)[::2]
        starts = np.arange(0, order, _PIECE)
        begin, end = np.meshgrid(np.arange(0, LARGEST_DELAY + 0.25, 0.5), halves / 2, indexing="ij")
        possible = np.abs(end - begin) <= reach
        begin, end = begin[possible], end[possible]
        total = np.zeros(begin.size)
        for first, row in zip(range(0, self.chips, order), self.rows, strict=True):
            chips = displaced[first : first + order] * row[:, None]
            pieces = np.add.reduceat(chips, starts, axis=0)
            middles = first + np.append(starts[1:] + starts[:-1], starts[-1] + order) / 2
            late = begin[:, None] + (end - begin)[:, None] * (middles / self.chips)
            index = np.rint(2 * late).astype(np.intp) - halves[0]
            total += np.abs(pieces[np.arange(starts.size), index].sum(axis=1))
        best = int(np.argmax(total))
        return np.array([begin[best], end[best]])


def _judged(search: RowSearch, line: Floats, late: Floats, noise_rms_v: float) -> HeardClock:
    """The result of a search, with a refusal where the samples are not those of a lone node.

    late: (2,) displacements of begin and end, chips.
    """
    amplitude, count = (float(value[0]) for value in search.explained(late[:1], late[1:]))
    rho = amplitude / max(noise_rms_v / sqrt(count), 1e-12)
    # A residual offset, and the mean level of a unipolar node.
    level = 0.0
    if abs(int(search.row.sum())) < search.row.size:
        sums, _ = search.sums.until(late + np.array([0, search.chips]))
        level = float(sums[1] - sums[0]) / (count * search.bits)
    own = count * search.bits * (amplitude**2 + level**2)
    noise = line.size * noise_rms_v**2
    left = (float(np.square(line).sum()) - own - noise) / max(own, 1e-30)
    delay, rate = float(late[0]), float(late[1] - late[0]) / search.chips
    refusal = ""
    if not (-LARGEST_DELAY <= delay <= 2 * LARGEST_DELAY and abs(rate) <= 1.2 * LARGEST_RATE_ERROR):
        refusal = f"a delay of {delay:.2f} chips and a clock error of {rate:.1%} are out of range"
    elif rho < HEARD:
        refusal = f"nobody was heard: amplitude is {rho:.2g} times the noise"
    elif left > MAX_LEFT + 4 * sqrt(2 / line.size) * noise / own:
        refusal = (
            f"{left:.0%} of a node's power is left over: another one spoke, too, or the code row "
            "is a different one"
        )
    return HeardClock(delay, rate, rho, refusal)
