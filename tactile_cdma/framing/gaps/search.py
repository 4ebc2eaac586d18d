# SPDX-License-Identifier: Apache-2.0

"""Recovers the chip clock of a burst, and chooses among all frames that it could be.

No stream state: `gap_timing` feeds it. Times are as in `fit`.

How a frame is found between two gaps. A frame has no preamble, its chip period is stretched by an
unknown 0…11 %, and where two nodes cancel its first or last chips look like the gap. But its loud
part [first, last] (`burst`) bounds start and end: last − k·N·T ≤ start ≤ first. Level changes
happen on the chip lattice only, so the squared differences of the line have a spectral line at
1/T, whose phase is the lattice's. That leaves a few whole-chip shifts for each of a few T. Among
these the most likely one (white noise) explains the most energy of the samples by words of
constant amplitude:

    E(start, T) = k·N·T · Σ_active nodes (mean over bits of |r|)²,      r = correlations.

A wrong shift or period makes |r| vary from bit to bit or leaves loud samples out, and both cost
energy. With the words known, every level change of the model tells by how much it comes late;
weighted linear regression over all of them gives the final start and T (and averages jitter that
does not accumulate).
"""

from __future__ import annotations

import math
from dataclasses import fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ...base import kernel
from ...base.arrays import Floats, Floats32
from ...code.amplitude import FAINT_SHARE
from ...code.frame import MAX_STRETCH, FrameSpec
from ...code.separate import NodeLevels
from ..fit import (
    BLUR,
    CHIPS_AT_ONCE,
    SETTLED_CHIPS,
    UNEVEN,
    Fit,
    Line,
    WordFit,
    code_of,
    integrate,
    read_words,
    refine,
)
from ..judge import RULED_OUT, Judgement, choose
from ..limits import LIMITS
from ..raster import WIDE, Expected
from ..timing import Rails, within_rails
from . import stray
from .burst import Beside, Burst, BurstSearch, Gap

_MOST_SHIFTS = 64
"""Largest number of silent chips that a frame may begin with; bounds the search. Chosen."""
_BEYOND = 2
"""Chips beyond the range that a burst's ends allow in which rivals are looked for: what a high-pass
leaves after a frame, and impulses beside it, are as loud as chips. Chosen."""
_TURNS = 4
"""Chips per block in the search for the chip clock: its band of 11 % then is 0.4 turns wide."""
_MAX_LINES = 12
"""Spectral lines that are tried at most. Chosen."""
_STILL_MISFIT = 1e-3
"""Misfit of a frame where it is expected below which it need not be refined. Chosen: edges 0.02
chip off; see LIMITS.carried_misfit."""
_LEAST_CHIP = 0.5
"""Share of an expected chip duration below which most edges were out of view. Chosen."""
_MOST_CARRIED = 16
"""Candidates that the kernel weighs: JUDGE_MOST in kernel/judge.h."""
_SILENT, _BURST, _FRAME = 0, 2, 3
"""What the kernel finds: enum gap_look there."""
_SHARED_LIMITS = (
    "distortion", "most", "most_deviations", "vote", "carried_noise", "carried_misfit", "doubt",
    "disturbed", "deafened", "spread", "left", "misfit",
)  # fmt: skip
"""Of `Limits`, and members of the kernel's rules by the same names."""


class Look(NamedTuple):
    """What the kernel sees in a stretch of samples; whatever few ask for is made of that then.

    kind: enum gap_look. quiet, loud: the gap and the burst. proven: see GapSearch.proven; 0 where
    no frame is carried. place, unaided: of a carried frame that is beyond doubt. around: what lies
    beside that. clipped: share of its samples at a rail. is_sound: its words are even and leave
    nothing over, the line is at rest beside, and no rail hides words. noise_v: of a row's levels
    then. words: of it, valid until the next look.
    """

    kind: int
    quiet: tuple[float, float, int]
    loud: tuple[float, float, float, float, float, float]
    proven: float
    place: tuple[float, float]
    unaided: bool
    around: tuple[float, float, bool, float]
    is_sound: bool
    clipped: float
    noise_v: float
    words: WordFit

    @classmethod
    def of(cls, kind: int, seen: Any, words: WordFit) -> Look:
        """Return what the kernel's struct gap_seen says."""
        gap, burst, beside = seen.gap, seen.burst, seen.beside
        return cls(
            kind,
            (gap.level, gap.variance, gap.begin),
            (burst.first, burst.last, burst.slack, burst.power, burst.variance, burst.pause),
            seen.proven,
            (seen.fit.start, seen.fit.chip),
            seen.unaided,
            (beside.level, beside.variance, beside.quiet, beside.noise),
            seen.sound,
            seen.clipped,
            seen.noise,
            words,
        )

    @property
    def gap(self) -> Gap:
        """Its level, as `gaps` finds it."""
        return Gap(*self.quiet)

    @property
    def burst(self) -> Burst | None:
        """As `burst` finds it, where there is one, and certainly no other before it."""
        return Burst(*self.loud) if self.kind >= _BURST else None

    @property
    def is_silent(self) -> bool:
        """Whether there is no burst."""
        return self.kind == _SILENT

    @property
    def found(self) -> Judgement | None:
        """A carried frame that is beyond doubt."""
        if self.kind != _FRAME:
            return None
        words = replace(self.words, rows=self.words.rows.copy())
        return Judgement(Fit(*self.place), words, None, True, self.unaided)

    @property
    def beside(self) -> Beside | None:
        """What lies beside that frame."""
        return Beside(*self.around) if self.kind == _FRAME else None

    def levels(self, spec: FrameSpec) -> NodeLevels:
        """Those of a sound frame."""
        rows = self.words.rows[0].copy()
        return NodeLevels(rows[:, spec.node_slice], self.noise_v, rows=rows)


class GapSearch(BurstSearch):
    """Finds a frame of one specification between gaps, at one sampling rate."""

    def __init__(self, spec: FrameSpec, rate_hz: float, rails_v: Rails = None) -> None:
        """See BurstSearch. rails_v: see share_clipped."""
        super().__init__(spec, rate_hz)
        self._rails_v = rails_v
        self._code = code_of(spec)
        self._values: Any = ()  # memory for the kernel
        self._make_room()

    def look(
        self, volts: Floats, raw: Floats, known: Gap, begin: float, expected: Expected | None
    ) -> Look | None:
        """What is in a stretch of samples, all in one call of the kernel.

        Gives what the other methods would, as far as it is beyond doubt; None where
        a sample is NaN, or all are too few. volts, raw: (m,) float64, V, without hum and as
        they came, from stream index `begin` on. expected: the next frame, if sure, in such indices.
        """
        code = self._code
        library, samples, pointer = kernel.lib, volts.size, kernel.pointer
        room = library.gap_values(self.settings.at, samples)
        if len(self._values) < room:
            self._values = pointer(np.empty(2 * room), 2 * room)
        quiet = kernel.ffi.new("struct burst_gap *")
        quiet.level, quiet.variance = known.level, known.variance
        place = kernel.ffi.new("struct gap_expected *")
        if expected is not None:
            place.start, place.scatter = expected.start - begin, expected.scatter
            place.chip, place.slips = expected.chip, expected.slips
        if not library.gap_look(
            code.at, self.settings.at, self._rules.at, code.refining.at,
            pointer(volts, samples), pointer(raw, samples), samples, self.least_power,
            quiet, place, self._seen, self._kind, self._values, self._scratch,
        ):  # fmt: skip
            return None
        return Look.of(self._kind[0], self._seen, self._words)

    def _make_room(self) -> None:
        """Arrays for the kernel's looks."""
        spec, one, code = self.spec, np.empty((4, 1), np.float32), self._code
        rows = np.empty((1, spec.line_bits, spec.order), np.float32)
        amplitude, uneven = np.empty((2, 1, spec.nodes), np.float32)
        self._words = WordFit(rows, amplitude, one[0], uneven, *one[1:])
        named = {item.name: getattr(self._words, item.name) for item in fields(self._words)}
        self._pointed = kernel.struct("judge_words", **named)  # keeps the arrays
        self._seen, self._kind = (
            kernel.ffi.new("struct gap_seen *"),
            kernel.ffi.new("enum gap_look *"),
        )
        self._seen.words = self._pointed.at[0]
        room = kernel.lib.gap_scratch(code.at, self.settings.at)
        self._scratch = kernel.pointer(np.empty(room, np.float32), room)

    @cached_property
    def _rules(self) -> kernel.Held:
        spec, spare = self.spec, self.spec.spare_rows
        rail_low, rail_high = within_rails(self._rails_v)
        return kernel.struct(
            "gap_rules",
            **{name: getattr(LIMITS, name) for name in _SHARED_LIMITS},
            blur=BLUR,
            settled_chips=SETTLED_CHIPS,
            shortest=self.shortest,
            longest=self.longest,
            bit=self.bit,
            period=self.period,
            beyond=_BEYOND,
            wide=WIDE,
            ruled_out=RULED_OUT,
            rail_low=rail_low,
            rail_high=rail_high,
            still_misfit=_STILL_MISFIT,
            least_chip=_LEAST_CHIP,
            uneven=UNEVEN,
            faint=FAINT_SHARE,
            near=stray.BESIDE_CHIPS[0],
            far=stray.BESIDE_CHIPS[1],
            beside=stray.PERHAPS[0],
            perhaps=stray.PERHAPS[1],
            inner=stray.INNER,
            turned=stray.TURNED,
            most_turned=stray.MOST_TURNED,
            scatter=stray.SCATTER,
            stray_left=stray.LEFT,
            clear=stray.CLEAR,
            twins=stray.has_twins(spec),
            spare=spare.start,
            spare_count=spare.stop - spare.start,
        )

    def frame(self, line: Line, burst: Burst, expected: Expected | None) -> Judgement | None:
        """The most likely frame around a burst; None where it has no frame's length.

        expected: where the frames before make one likely. The last chip duration is tried, too:
        words with few level changes show little of their own.
        """
        if not self._has_length(burst):
            return None
        carried = self.carried(line, expected)
        if carried and (found := self.explained(line, burst, carried, expected)):
            return found
        fit = self._by_search(line, burst, expected)
        return None if fit is None else self._judged(line, burst, fit, expected)

    def is_sure(self, expected: Expected | None) -> bool:
        """Whether a frame is expected so surely that it need not be searched for."""
        if expected is None or expected.slips > LIMITS.rare_slips:
            return False
        uncertain = expected.scatter + expected.change * self.spec.span_chips
        return uncertain <= LIMITS.known_place * expected.chip

    def carried(self, line: Line, expected: Expected | None) -> Fit | None:
        """The frame where it is surely expected, refined on its own edges."""
        if expected is None or not self.is_sure(expected):
            return None
        start, chip, spec = np.array([expected.start]), np.array([expected.chip]), self.spec
        fit = Fit(expected.start, expected.chip)
        if not read_words(integrate(line, start, chip, spec), spec).misfit.item() < _STILL_MISFIT:
            fit = refine(line, fit, spec)
        within = fit.start >= -0.5 and fit.end(self.spec) <= line.volts.size
        return fit if within and fit.chip > _LEAST_CHIP * expected.chip else None

    def explained(
        self, line: Line, burst: Burst, fit: Fit, expected: Expected | None
    ) -> Judgement | None:
        """A carried frame, if it leaves no more than the gap's noise and no other is likelier."""
        if not self._has_length(burst):
            return None
        found = self._judged(line, burst, fit, expected)
        noise = burst.variance * self.half / fit.chip
        return found if found.fit == fit and found.words.explained_by(noise) else None

    def proven(self, burst: Burst, fit: Fit) -> float:
        """Instant at which silence proves that a frame is over.

        Its chips are known, so that what may follow are the last chips of a rival: a frame that
        begins some whole chips later, in which our first chips are gap. Such a rival must begin at
        the burst's first loud sample at the latest, but for its uncertainty (a chip and a half),
        and, for the judge's caution, two chips beyond. Whether a rival's last chips are loud
        follows from its words: what so many chips after the frame do not tell apart, no longer
        silence would, for there a rival says silence, too. That is 3 or 4 chips, and as many more
        as the nodes cancel in at the start of every bit; noise widens it by 60/SNR chips. Without a
        known raster and words, silence proves nothing until it has lasted for a whole stretched
        bit: every bit has the same energy, but may have it in a single chip.
        """
        return fit.end(self.spec) + self._shifts_of(burst, fit)[1] * fit.chip

    def _has_length(self, burst: Burst) -> bool:
        """Whether a burst may be a frame that begins and ends with less than a bit's silence."""
        loud = burst.last - burst.first
        least = self.shortest - 1.5 * self.spec.order * self.chip
        return least - 2 * burst.slack <= loud <= self.longest + 2 * burst.slack

    def _shifts_of(self, burst: Burst, fit: Fit) -> tuple[int, int]:
        """Whole chips by which rivals may begin earlier (≤ 0), or later."""
        low, high = self._range(burst, fit.chip)
        earliest = min(0, math.ceil((low - fit.start) / fit.chip)) - _BEYOND
        latest = max(0, math.floor((high - fit.start) / fit.chip)) + _BEYOND
        return earliest, latest

    def _judged(self, line: Line, burst: Burst, fit: Fit, expected: Expected | None) -> Judgement:
        """The most likely one of this frame and of those that begin whole chips beside it."""
        noise = burst.variance * self.half / fit.chip
        earliest, latest = self._shifts_of(burst, fit)
        while True:
            shifts = earliest, latest
            start = fit.start + fit.chip * np.arange(earliest, latest + 1, dtype=np.float64)
            chip = np.full(start.size, fit.chip)
            # Two nodes that cancel at the start of every bit are possible, but not likely.
            unlikely = np.log1p(np.square((start - burst.first) / (0.5 * fit.chip)))
            found = choose(line, start, chip, self.spec, noise, unlikely, expected)
            shift = round((found.fit.start - fit.start) / fit.chip)
            earliest, latest = min(earliest, shift - _BEYOND), max(latest, shift + _BEYOND)
            if (earliest, latest) == shifts or latest - earliest > _MOST_SHIFTS:
                return found

    def _by_search(self, line: Line, burst: Burst, expected: Expected | None) -> Fit | None:
        """The frame that explains the most energy of all that could be there."""
        spec, loud = self.spec, burst.last - burst.first
        clocks = self._chip_lines(line.volts, burst)
        for chip in (loud / spec.span_chips, *((expected.chip,) if expected else ())):
            clocks += [(chip, burst.first), (chip, burst.last)]
        chip, edge = np.array(clocks).T
        starts, chips, power = self._shifts(line, burst, edge, chip)
        if not starts.size:
            return None
        # Log-likelihood in white noise, no sharper than distortion allows.
        energy = spec.chips * chips * power
        unit = 2 * LIMITS.distortion**2 / spec.chips * float(energy.max())
        score: Floats = energy / max(2 * self.half * burst.variance, unit, 1e-30)
        if expected is not None:
            score = score + expected.log_prior(starts)
        best = int(np.argmax(score))
        fit = refine(line, Fit(starts[best], chips[best]), spec)
        return fit if LIMITS.possible(fit.chip / self.chip) else None

    @cached_property
    def _tones(self) -> tuple[int, Floats]:
        """Length of a block of _TURNS chips of middling stretch; cosine, −sine, (block, 2)."""
        block = round(_TURNS * self.chip * (1 + MAX_STRETCH / 2))
        angle = 2 * np.pi * _TURNS * np.arange(block) / block
        return block, np.stack((np.cos(angle), -np.sin(angle)), axis=1)

    def _chip_lines(self, volts: Floats, burst: Burst) -> list[tuple[float, float]]:
        """(chip duration, instant of some chip edge) for each strong line of squared differences.

        To reduce noise, levels are averaged over half a chip on either side of a difference. Only
        frequencies near 1/chip matter: blocks of _TURNS chips are mixed down by a frequency of
        whole turns per block, and what is left varies slowly.
        """
        begin = max(0, int(burst.first - burst.slack))
        sums = np.concatenate(([0.0], np.cumsum(volts[begin : int(burst.last + burst.slack) + 2])))
        h = self.half if self.chip >= 5 else 1
        steps = np.square(sums[2 * h :] - 2 * sums[h:-h] + sums[: -2 * h])
        steps -= steps.sum() / steps.size
        block, tones = self._tones
        count = steps.size // block
        mixed = steps[: count * block].reshape(count, block) @ tones
        size = 1 << int(4 * count - 1).bit_length()
        spectrum = np.fft.fft(mixed[:, 0] + 1j * mixed[:, 1], size)
        low = math.floor((block / (self.chip * (1 + MAX_STRETCH) * 1.004) - _TURNS) * size)
        high = math.ceil((block / (self.chip * 0.996) - _TURNS) * size)
        bins = np.arange(low - 1, high + 2)
        band = spectrum[bins]  # negative ones are at its end
        power = np.abs(band)
        inner = power[1:-1]
        peaks = np.flatnonzero((inner >= power[:-2]) & (inner > power[2:]))
        peaks = peaks[inner[peaks] > 0.5 * inner.max()]
        peaks = peaks[np.argsort(-inner[peaks])][:_MAX_LINES]
        left, mid, right = power[peaks], power[peaks + 1], power[peaks + 2]
        shift = 0.5 * (left - right) / (left - 2 * mid + right)
        offset = (bins[peaks + 1] + shift) / size  # turns per block off the mixing frequency
        frequency = (_TURNS + offset) / block
        # The phase turns by about π·(count/size) per bin off the peak, and by the offset within
        # half a block.
        phase = np.angle(band[peaks + 1]) - np.pi * (
            shift * count / size + offset * (1 - 1 / block)
        )
        edge = begin + h - 0.5 - phase / (2 * np.pi * frequency)
        return list(zip((1 / frequency).tolist(), edge.tolist(), strict=True))

    def _shifts(
        self, line: Line, burst: Burst, edge: Floats, chip: Floats
    ) -> tuple[Floats, Floats, Floats32]:
        """Every whole-chip start that lets a frame cover the burst.

        edge, chip: (q,) an instant of some chip edge and the duration, for each clock. Returns
        starts, chip durations and powers of the words, (c,) each. A frame is taken to have less
        than a bit's silent chips at either end.
        """
        spec = self.spec
        low, high = np.array([self._range(burst, each) for each in chip.tolist()]).T
        low = edge + np.ceil((low - edge) / chip) * chip
        shifts = np.arange(max(1, int(np.max((high - low) / chip)) + 1))
        starts = low[:, None] + shifts * chip[:, None]
        possible = starts <= high[:, None]
        batches = min(chip.size, 1 + starts.size * spec.chips // CHIPS_AT_ONCE)
        powers = [
            self._powers(line, low[some], chip[some], shifts.size)
            for some in np.array_split(np.arange(chip.size), batches)
        ]
        power = np.concatenate(powers)[possible]
        return starts[possible], np.broadcast_to(chip[:, None], starts.shape)[possible], power

    def _range(self, burst: Burst, chip: float) -> tuple[float, float]:
        """Earliest and latest start with which a frame of such chips covers the burst."""
        length, bit = self.spec.span_chips * chip, self.spec.order * chip
        low = max(burst.last - length, burst.first - bit, burst.first - _MOST_SHIFTS * chip)
        return low - burst.slack, min(burst.first, burst.last + bit - length) + burst.slack

    def _powers(self, line: Line, low: Floats, chip: Floats, count: int) -> Floats32:
        """Power of the words for `count` starts, a chip apart, of each clock, (q, count)."""
        spec, span = self.spec, self.spec.span_chips
        levels = line.means(low[:, None] + chip[:, None] * np.arange(span + count))
        windows = np.lib.stride_tricks.sliding_window_view(levels, span, axis=1)
        chips = windows[..., spec.places].reshape(-1, spec.line_bits, spec.order)
        return read_words(chips, spec).power.reshape(-1, count)
