# SPDX-License-Identifier: Apache-2.0

"""Decodes marked frames of nodes that share one clock."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..base.arrays import Floats, Floats32
from ..code.frame import MAX_STRETCH, UNIPOLAR, FrameSpec
from ..code.separate import node_levels
from ..code.transform import correlate
from ..wire._protocol import TAIL_CHIPS
from .fit import (
    CHIPS_AT_ONCE,
    MAX_SPREAD,
    ChipEdges,
    Fit,
    Line,
    WordFit,
    dot,
    even_words,
    integrate,
    read_words,
    refine,
    word_floor,
)
from .frame_end import End, FrameEnds
from .marked_timing import MarkedFrame, MarkedLine, MarkedTiming, Verdict
from .timing import MISFIT, NOISY, NOT_AT_REST, Rails

CHIP_ERROR = 2e-3
"""Share by which chips may be shorter than nominal, or longer than the longest stretch. Chosen:
twenty times the 100 ppm of a crystal, so that fits of noisy frames are not refused at the ends."""
CLEAN_SPREAD = 0.08
"""Largest spread (see fit.WordFit) at which nominal timing is accepted while the gap's noise is not
known: white noise gives 1/ρ², so ρ > 3.5. Once it is known the limit is MAX_SPREAD."""
CARRIED_FRAMES = 15
"""Frames for which refined timing is reused while it explains them. Chosen: the refinement's cost
is then below 1/15 per frame."""
CARRIED_MISFIT = 3e-3
"""Power that reused timing may leave unexplained beside the noise, relative to the words' power:
edges 0.04 chip off leave as much (each of them changes one chip by 2a·0.04, and half of all edges
are level changes), and it costs 0.01 dB."""
RESTART_STEP = 1 / 16
"""Step of the search for the common delay of nodes that restart within a frame, chips. Chosen: at
most 1/32 chip off, 0.3 dB of amplitude where every chip changes level."""
SEARCH_PER_S = 2e6
"""Chips that the search of all stretches may integrate per second of stream. At 0.15 µs each
(measured when it was introduced) that is 0.3 s: a disturbed line must not hold up the stream."""
LARGEST_SEARCH = 1 << 21
"""Most chips that one search may integrate: one second's worth. For frames too long for that only
stretches that end where the line falls silent are tried."""
FAINT_POWER = 1.6
"""Power of the chips, relative to the gap's noise, below which no stretch is searched for: words
would be hidden in noise. Chosen."""


class LineTiming(MarkedTiming):
    """Line timing of nodes that share one clock."""

    def __init__(self, spec: FrameSpec, rate_hz: float, rails_v: Rails = None) -> None:
        """See MarkedLine."""
        line = MarkedLine(spec, rate_hz, rails_v)
        super().__init__(line, LineRecogniser(line))


@dataclass(slots=True)
class _Carried:
    """Timing of a frame that was refined on its own edges, and how often it was reused since."""

    fit: Fit
    edges: ChipEdges
    uses: int = 0


class LineRecogniser:
    """A Recogniser that takes all nodes to keep time together.

    At one sample per chip the digitizer integrates whole chips, and these are the frame. Raw
    samples are integrated with the timing of the frame before, as long as that leaves no more than
    noise; else with the nominal chip duration, refined on the frame's own edges. Only where words
    do not come out clean all stretches up to 11 % are searched, which takes the samples that such
    a frame would have. Frames with restarts within them need no refinement: the digitizer's sync
    edges place their chips.
    """

    def __init__(self, line: MarkedLine) -> None:
        """line: shared with the stream, which keeps its level and noise at rest up to date."""
        self._line, self._spec = line, line.spec
        self._carried: _Carried | None = None
        self._chip = line.chip  # of the last frame
        self._restarted, self._restart_uses = line.nominal, 0
        self._ends = FrameEnds(self._spec)
        self._budget = float(LARGEST_SEARCH)  # chips that may be searched

    def open(self, start: int, called: bool, since: int | None) -> int:
        """A frame takes its samples and, between chips that are not integrated, a silent tail."""
        earned = SEARCH_PER_S * self._spec.frame_period_s
        self._budget = min(self._budget + earned, LARGEST_SEARCH)
        line = self._line
        return line.size + (0 if line.integrated else math.ceil(TAIL_CHIPS * line.chip))

    def forget(self) -> None:
        """See Recogniser."""
        self._carried = None

    def recognise(self, frame: MarkedFrame) -> Verdict:
        """See Recogniser."""
        if verdict := self._line.gate(frame):
            return verdict
        if self._line.integrated:
            return self._integrated(frame)
        line = Line(frame.volts - self._line.level_v)
        if self._spec.resync_chips:
            return self._restarting(frame, line)
        return self._by_carried(frame, line) or self._by_edges(frame, line)

    def _integrated(self, frame: MarkedFrame) -> Verdict:
        """The frame of samples that are chips already: accepted as it is, or rejected."""
        spec, volts = self._spec, frame.volts[: self._spec.chips]
        chips = np.subtract(volts, self._line.level_v, dtype=np.float32)
        words = read_words(chips.reshape(1, spec.line_bits, spec.order), spec)
        if self._line.is_silent(words.amplitude[0]):
            if self._is_astray(words):
                return Verdict(rejected=MISFIT)
            return self._line.silent(frame, self._line.sample_power(volts))
        if words.believable(MAX_SPREAD, spec):
            return self._line.heard(frame, self._line.nominal, node_levels(words.rows[0], spec))
        return Verdict(rejected=MISFIT)

    def _restarting(self, frame: MarkedFrame, line: Line) -> Verdict:
        """The frame with restarts in it: its chips are in their places, or all a bit late."""
        if self._restart_uses % (CARRIED_FRAMES + 1) == 0:
            self._restarted = self._least_late(line)
        self._restart_uses += 1
        fit = self._restarted
        words = even_words(line, fit, self._spec)
        over = frame.start + self._line.size + math.ceil(self._line.chip)
        if self._line.is_silent(words.amplitude[0]):
            self._restart_uses = 0
            if self._is_astray(words):
                return Verdict(over=over, rejected=MISFIT)
            return self._faint(frame, self._chip_power(line), fit)
        if not words.believable(MAX_SPREAD, self._spec, self._line.noise):
            return Verdict(over=over, rejected=MISFIT)
        ended = self._ended(frame, line, fit, words.rows[0], words.amplitude[0])
        return ended or Verdict(over=over, rejected=NOT_AT_REST)

    def _least_late(self, line: Line) -> Fit:
        """The start, up to a chip late, that explains the most energy."""
        nominal = self._line.nominal
        start = nominal.start + np.arange(0, 1, RESTART_STEP) * nominal.chip
        chip = np.full(start.size, nominal.chip)
        power = read_words(integrate(line, start, chip, self._spec), self._spec).power
        return Fit(float(start[np.argmax(power)]), nominal.chip)

    def _by_carried(self, frame: MarkedFrame, line: Line) -> Verdict | None:
        """The frame by an earlier frame's timing, if that explains the samples."""
        carried = self._carried
        if carried is None or carried.uses >= CARRIED_FRAMES:
            return None
        if carried.edges.size != frame.volts.size:
            carried.edges = ChipEdges(carried.fit, self._spec, frame.volts.size)
        rows = correlate(carried.edges.chips(line), self._spec.book)
        amplitude = self._explained(rows)
        if amplitude is None:
            return None
        if unfinished := self._unfinished(frame, carried.fit):
            return unfinished
        verdict = self._ended(frame, line, carried.fit, rows, amplitude)
        carried.uses += verdict is not None
        return verdict

    def _explained(self, rows: Floats32) -> Floats32 | None:
        """Amplitudes (n,) of words that leave no more than the noise of the gap; else None.

        rows: (k, N) float32, V, all correlations. What makes words uneven is left over, too, so
        this also bounds their spread.
        """
        spec = self._spec
        level = np.abs(rows[:, spec.node_slice])
        amplitude: Floats32 = level.sum(axis=0) * np.float32(1 / spec.line_bits)
        amplitude *= amplitude > word_floor(amplitude, spec)
        power = dot(amplitude, amplitude)
        meant = rows
        if spec.drive == UNIPOLAR:
            power += (float(rows[:, 0].sum()) / spec.line_bits) ** 2
        elif spec.first_row > 0:
            meant = rows[:, 1:]
        total = float(np.einsum("kr,kr->", meant, meant)) / spec.line_bits
        left_over = total - power >= 1.5 * self._line.noise + CARRIED_MISFIT * power
        return None if left_over or self._line.is_silent(amplitude) else amplitude

    def _by_edges(self, frame: MarkedFrame, line: Line) -> Verdict:
        """The frame whose timing is refined on its own edges."""
        spec, size, noise = self._spec, line.volts.size, self._line.noise
        power = self._chip_power(line)
        if power <= self._line.least_power:
            return self._faint(frame, power)
        limit, somebody = MAX_SPREAD if noise else CLEAN_SPREAD, False
        for chip in dict.fromkeys((self._line.chip, self._chip)):
            fit = self._refined(line, chip)
            words = even_words(line, fit, spec)
            amplitude = words.amplitude[0]
            silent = self._line.is_silent(amplitude)
            somebody |= not silent
            if silent or not words.believable(limit, spec, noise):
                continue
            if unfinished := self._unfinished(frame, fit):
                return unfinished
            verdict = self._ended(frame, line, fit, words.rows[0], amplitude)
            if verdict and fit.end(spec) - size < 0.5 * chip:
                self._carried = _Carried(fit, ChipEdges(fit, spec, size))
                return verdict
        if power <= FAINT_POWER * noise:
            if somebody:
                return Verdict(over=frame.start + size, rejected=NOISY)
            return self._faint(frame, power)
        return self._by_search(frame, line, power, somebody)

    def _by_search(self, frame: MarkedFrame, line: Line, power: float, somebody: bool) -> Verdict:
        """The frame at the stretch that explains the most energy.

        power: of its chips, V². somebody: was heard at another stretch, if not understood.
        """
        spec, nominal = self._spec, self._line.chip
        # The tail shows the level, or that it has not changed: row 0 would take that for a word.
        tail = 0 if self._line.level_known and spec.first_row > 0 else TAIL_CHIPS
        longest = math.ceil((1 + MAX_STRETCH) * (spec.chips + tail) * nominal)
        if line.volts.size < longest and not frame.final:
            return Verdict(due=frame.start + longest)
        reason = MISFIT
        for stretched in (self._by_loud_end(line), self._all_stretches(line)):
            if not stretched.size:
                continue
            fit = self._refined(line, self._strongest(line, stretched))
            words = even_words(line, fit, spec)
            if self._line.is_silent(words.amplitude[0]):
                if somebody or self._is_astray(words):
                    break
                return self._faint(frame, power, fit)
            if not words.believable(MAX_SPREAD, spec, self._line.noise):
                continue
            if verdict := self._ended(frame, line, fit, words.rows[0], words.amplitude[0]):
                return verdict
            reason = NOT_AT_REST
        return Verdict(over=frame.start + longest + math.ceil(nominal), rejected=reason)

    def _is_astray(self, words: WordFit) -> bool:
        """Whether somebody speaks on a row that no node has, as one that is late may do."""
        spare = words.rows[0, :, self._spec.spare_rows]
        return spare.size > 0 and not self._line.is_silent(np.abs(spare).mean(axis=0))

    def _faint(self, frame: MarkedFrame, power: float, fit: Fit | None = None) -> Verdict:
        """A silent frame, from the power of its chips, V²."""
        return self._line.silent(frame, power * self._line.chip, fit)

    def _unfinished(self, frame: MarkedFrame, fit: Fit) -> Verdict | None:
        """A request for the tail after this fit's end, if it may still come."""
        missing = fit.end(self._spec) + TAIL_CHIPS * fit.chip - frame.volts.size
        if missing <= 0.5 or frame.final:
            return None
        return Verdict(due=frame.start + frame.volts.size + math.ceil(missing))

    def _ended(
        self, frame: MarkedFrame, line: Line, fit: Fit, rows: Floats32, amplitude: Floats32
    ) -> Verdict | None:
        """The frame of a fit, if the line is at rest after it; see FrameEnds.

        rows: (k, N) V, all correlations. amplitude: (n,) V, of every node's word, 0 where silent.
        """
        levels = node_levels(rows, self._spec)
        known = self._line.level_known  # a level that is not known yet has no noise either
        noise = self._line.noise if known else levels.noise_v**2 * self._spec.order
        end = self._ends.observe(line, fit, amplitude, noise, known)
        if end == End.OTHER:
            return None
        self._chip = fit.chip
        return self._line.heard(frame, fit, levels, guess=end == End.MISLED)

    def _refined(self, line: Line, chip: float) -> Fit:
        """Timing refined from the mark and a chip duration; unrefined if that leads astray."""
        fit = refine(line, Fit(-0.5, chip), self._spec, earliest=-1.0, latest=0.5)
        stretch = fit.chip / self._line.chip
        possible = 1 - CHIP_ERROR <= stretch <= (1 + CHIP_ERROR) * (1 + MAX_STRETCH)
        return fit if possible else Fit(-0.5, chip)

    def _by_loud_end(self, line: Line) -> Floats:
        """Chip durations with which a frame ends where the line falls silent, or a bit later."""
        nominal = self._line.chip
        limit = 5 * self._line.sample_noise_v
        least = 0.3 * math.sqrt(self._line.least_power)
        loud = np.flatnonzero(np.abs(line.volts) > max(limit, least))
        end = int(loud[-1]) + 1 if loud.size else self._line.size
        chip: Floats = (end + nominal * np.arange(-1.0, 3.0, 0.5)) / self._spec.chips
        return np.clip(chip, nominal, (1 + CHIP_ERROR) * (1 + MAX_STRETCH) * nominal)

    def _all_stretches(self, line: Line) -> Floats:
        """All chip durations of frames that end within the samples; none beyond the budget."""
        chips, step = self._spec.chips, 0.5 / self._spec.chips
        chip: Floats = self._line.chip * np.arange(1, 1 + MAX_STRETCH + step, step)
        chip = chip[chip * chips <= line.volts.size + self._line.chip]
        if chip.size * chips > self._budget:
            return np.empty(0)
        self._budget -= chip.size * chips
        return chip

    def _strongest(self, line: Line, chip: Floats) -> float:
        """The chip duration that explains the most energy."""
        spec = self._spec
        batches = np.array_split(chip, 1 + chip.size * spec.chips // CHIPS_AT_ONCE)
        gains = [
            read_words(integrate(line, np.full(some.size, -0.5), some, spec), spec).power * some
            for some in batches
        ]
        return float(chip[np.argmax(np.concatenate(gains))])

    def _chip_power(self, line: Line) -> float:
        """Mean power of the chips at nominal timing, V², without an unknown offset."""
        fit = self._line.nominal
        chips = integrate(line, np.array([fit.start]), np.array([fit.chip]), self._spec)
        return float(chips.var() if self._spec.first_row > 0 else np.square(chips).mean())
