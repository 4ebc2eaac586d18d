# SPDX-License-Identifier: Apache-2.0

"""Decodes marked frames."""

import logging
import math

import numpy as np

from ..base.arrays import Bools, Floats, Floats32
from ..code.frame import MAX_STRETCH, FrameSpec
from ..code.separate import node_levels
from ..code.transform import correlate, rows_of
from ..wire._protocol import TAIL_CHIPS
from .fit import (
    CHIPS_AT_ONCE,
    ChipEdges,
    Fit,
    Line,
    WordFit,
    even_words,
    integrate,
    read_words,
    refine,
)
from .frame_end import End, FrameEnds
from .judge import choose
from .limits import LIMITS
from .marked_timing import (
    CarriedTiming,
    MarkedFrame,
    MarkedLine,
    MarkedTiming,
    Recogniser,
    Verdict,
)
from .shifted import is_shifted, may_be_shifted
from .timing import MISFIT, NOISY, NOT_AT_REST, Rails

_log = logging.getLogger(__name__)

CARRIED_FRAMES = 63
"""Frames for which refined timing is reused while it explains them. Chosen: 0.8 s at 78 Hz, so that
the refinement, which costs about as much as 10 frames, adds a sixth to a frame."""
RESTART_STEP = 1 / 16
"""Step of the search for the common delay of nodes that restart within a frame, chips. Chosen: at
most 1/32 chip off, 0.3 dB of amplitude where every chip changes level."""
SEARCH_PER_S = 8e6
"""Chips that the search of all stretches may integrate per second of stream. At 0.04 µs each
(measured) that is 0.3 s: a disturbed line must not hold up the stream."""
LARGEST_SEARCH = 1 << 23
"""Most chips that one search may integrate: one second's worth."""
SURVIVORS = 8
"""Stretches that are searched near by all bits, of those that suit the first bits best. Chosen."""


class LineTiming(MarkedTiming):
    """Line timing of a plain or scrambled code."""

    def __init__(self, spec: FrameSpec, rate_hz: float, rails_v: Rails = None) -> None:
        """See MarkedLine."""
        line = MarkedLine(spec, rate_hz, rails_v)
        super().__init__(line, LineRecogniser(line))


class LineRecogniser(Recogniser):
    """Takes all nodes to keep time together.

    At one sample per chip the digitizer integrates whole chips, and these are the frame. Raw
    samples are a frame of the timing before, as long as that leaves no more than noise. Else
    others are proposed, and the judge chooses: the timing before, refined on the frame's own
    edges; then, of the stretches that end where the line falls silent and of all up to 11 %, those
    that explain the most energy. These take the samples that such a frame would have, and are left
    out once a frame is accepted: another chip duration would have its edges elsewhere. Frames with
    restarts are not stretched: sync edges place their chips, or all of them a bit later.
    """

    def __init__(self, line: MarkedLine) -> None:
        super().__init__(line)
        self._ends = FrameEnds(self._spec)
        self._nominal = ChipEdges(line.nominal, self._spec)
        self._carried: ChipEdges | None = None  # of an earlier frame
        self._uses = 0  # how often they may still be reused
        self._budget = float(LARGEST_SEARCH)  # chips that may be searched

    @property
    def _due(self) -> int:
        """A frame takes its samples and, between chips that are not integrated, a silent tail."""
        line = self._line
        if line.integrated:
            return line.size
        end = self._carried.fit.end(self._spec) if self._carried else 0.0
        return max(line.size, round(end + 0.5)) + math.ceil(TAIL_CHIPS * line.chip)

    def note(self, frame: MarkedFrame) -> None:
        """Take in how many frames there were since one was last asked about."""
        # Stretches may be searched in a share of the stream's time.
        earned = frame.opened * SEARCH_PER_S * self._spec.frame_period_s
        self._budget = min(self._budget + earned, LARGEST_SEARCH)
        self._ends.silent += frame.ended
        self._uses -= frame.carried

    def forget(self) -> None:
        """See Recogniser."""
        self._carried = None

    @property
    def carried(self) -> CarriedTiming:
        """See Recogniser."""
        return CarriedTiming(self._due, self._carried, self._uses if self._carried else 0)

    def recognise(self, frame: MarkedFrame) -> Verdict:
        """See Recogniser."""
        self.note(frame)
        if verdict := self._line.gate(frame):
            return verdict
        if self._line.integrated:
            return self._integrated(frame)
        line = Line(frame.volts, self._line.level_v)
        return self._by_carried(frame, line) or self._proposed(frame, line)

    def _integrated(self, frame: MarkedFrame) -> Verdict:
        """The frame of samples that are chips already: accepted as it is, or rejected."""
        spec, volts = self._spec, frame.volts[: self._spec.chips]
        chips = np.subtract(volts, self._line.level_v, dtype=np.float32)
        chips = chips.reshape(spec.line_bits, spec.order)
        words = read_words(chips[None], spec)
        levels = node_levels(words.rows[0], spec, self._line.level_known)
        if self._line.is_silent(words.amplitude[0]):
            if self._is_astray(words):
                return Verdict(rejected=MISFIT)
            return self._line.silent(frame, self._line.sample_power(volts), levels)
        if not words.believable(spec):
            return Verdict(rejected=MISFIT)
        doubtful = self._doubtful(chips, words, words.is_clear(spec))
        if frame.volts.size > spec.chips:  # a value was taken twice
            doubtful = np.ones(spec.nodes, bool)
        return self._line.heard(frame, self._line.nominal, levels, doubtful)

    def _by_carried(self, frame: MarkedFrame, line: Line) -> Verdict | None:
        """The frame by an earlier frame's timing, if that explains the samples."""
        carried = self._carried
        if carried is None or self._uses <= 0:
            return None
        self._uses -= 1
        chips = carried.chips(line)
        words = read_words(chips[None], self._spec)
        if not (self._is_explained(words) and self._is_kept(frame, words)):
            return None
        doubtful = self._doubtful(chips, words, True)
        return self._ended(frame, line, carried.fit, words, doubtful)

    def _doubtful(self, chips: Floats32, words: WordFit, is_clear: bool) -> Bools | None:
        """All nodes, where their words may be those of a frame that is some chips off.

        is_clear: the words leave nothing but noise.
        """
        if is_clear and not may_be_shifted(chips, words, self._spec):
            return None
        return np.ones(self._spec.nodes, bool) if is_shifted(chips, words, self._spec) else None

    def _is_explained(self, words: WordFit) -> bool:
        """Whether the words of a frame leave no more than the noise of the gap.

        What makes words uneven is left over, too, so this also bounds their spread.
        """
        power = words.power.item()
        left = words.misfit.item() * power
        most = LIMITS.carried_noise * self._line.noise + LIMITS.carried_misfit * power
        return left < most and not self._line.is_silent(words.amplitude[0])

    def _is_kept(self, frame: MarkedFrame, words: WordFit) -> bool:
        """Whether chips have the power of their samples; misplaced ones change within."""
        power = self._line.sample_power(frame.volts[: self._line.size])
        rows = words.rows[0]
        chip_power = float(np.einsum("kr,kr->", rows, rows)) / len(rows)
        return chip_power >= LIMITS.kept * (power - self._line.sample_noise_v**2)

    def _proposed(self, frame: MarkedFrame, line: Line) -> Verdict:
        """The likeliest of the frames that are proposed, or silence."""
        spec, size = self._spec, line.volts.size
        chips = self._nominal.chips(line)  # at nominal timing, without an unknown offset
        power = float(chips.var() if spec.first_row > 0 else np.square(chips).mean())
        if power <= self._line.least_power:
            return self._faint(frame, line, power)
        fits = [self._usual(line)]
        verdict = self._chosen(frame, line, fits)
        if verdict.over or verdict.due:
            return verdict
        if power <= self._line.noise * (1 + LIMITS.faint_scatter * math.sqrt(2 / spec.chips)):
            if verdict.rejected:
                return Verdict(over=frame.start + size, rejected=NOISY)
            return self._faint(frame, line, power)
        rejected, longest = verdict.rejected, size
        if not spec.resync_chips:
            longest = math.ceil((1 + MAX_STRETCH) * (spec.chips + TAIL_CHIPS) * self._line.chip)
            if size < longest and not frame.final:
                return Verdict(due=frame.start + longest)
            for proposer in (self._by_loud_end, self._all_stretches):
                if verdict.rejected is None:
                    fits.clear()  # faint words explain noise better than those of a few nodes
                chip = proposer(line)
                if chip.size:
                    best = np.argmax(self._gains(line, chip, spec.line_bits))
                    fits.append(self._refined(line, float(chip[best])))
                    verdict = self._chosen(frame, line, fits)
                    if verdict.over or verdict.due:
                        return verdict
                    rejected = verdict.rejected or rejected
        if rejected is None:
            return self._faint(frame, line, power)
        return Verdict(over=frame.start + longest + math.ceil(self._line.chip), rejected=rejected)

    def _usual(self, line: Line) -> Fit:
        """The timing before, refined; with restarts, as it is or as late as explains the most."""
        carried = self._carried
        if not self._spec.resync_chips:
            return self._refined(line, carried.fit.chip if carried else self._line.chip)
        if carried and self._uses > 0:
            return carried.fit
        nominal = self._line.nominal
        start = nominal.start + np.arange(0, 1, RESTART_STEP) * nominal.chip
        chip = np.full(start.size, nominal.chip)
        power = read_words(integrate(line, start, chip, self._spec), self._spec).power
        return Fit(float(start[np.argmax(power)]), nominal.chip)

    def _chosen(self, frame: MarkedFrame, line: Line, fits: list[Fit]) -> Verdict:
        """The likeliest of these frames, if it is one, or a request for samples.

        Else others may be it: then it is not said when it is over, nor a reason to reject it where
        no node of it speaks.
        """
        spec, start = self._spec, np.array([fit.start for fit in fits])
        chip = np.array([fit.chip for fit in fits])
        found = choose(line, start, chip, spec, self._line.noise)
        words = even_words(line, found.fit, spec, found.words)
        if self._line.is_silent(words.amplitude[0]):
            return Verdict(rejected=MISFIT if self._is_astray(words) else None)
        if not words.believable(spec, self._line.noise):
            return Verdict(rejected=MISFIT)
        doubtful = found.doubtful
        if doubtful is None:
            start, chip = np.array([found.fit.start]), np.array([found.fit.chip])
            chips = integrate(line, start, chip, spec)[0]
            doubtful = self._doubtful(chips, found.words, self._is_explained(words))
        if not self._is_kept(frame, found.words):
            doubtful = np.ones(spec.nodes, bool)
        ended = self._ended(frame, line, found.fit, words, doubtful)
        if ended is None:
            return Verdict(rejected=NOT_AT_REST)
        carried = self._carried
        if ended.frame and carried is None:
            _log.debug("frame at %d has chips of %.6g samples", frame.start, found.fit.chip)
        if ended.frame and not (carried and self._uses > 0 and carried.fit == found.fit):
            self._carried, self._uses = ChipEdges(found.fit, spec), CARRIED_FRAMES
        return ended

    def _is_astray(self, words: WordFit) -> bool:
        """Whether somebody speaks on a row that no node has, as one that is late may do."""
        spare = words.rows[0, :, self._spec.spare_rows]
        return spare.size > 0 and not self._line.is_silent(
            np.abs(spare).mean(axis=0, dtype=np.float32)
        )

    def _faint(self, frame: MarkedFrame, line: Line, power: float) -> Verdict:
        """A frame of no word that is loud enough, from the power of its chips, V²."""
        levels = None
        if power > self._line.silent_power:
            edges = self._carried or self._nominal
            levels = node_levels(rows_of(edges.chips(line), self._spec), self._spec)
        return self._line.silent(frame, power * self._line.chip, levels)

    def _ended(
        self, frame: MarkedFrame, line: Line, fit: Fit, words: WordFit, doubtful: Bools | None
    ) -> Verdict | None:
        """The frame of a fit, if the line is at rest after it; see FrameEnds.

        Or a request for the samples that show it, if they may still come.
        """
        missing = fit.end(self._spec) + TAIL_CHIPS * fit.chip - frame.volts.size
        if missing > 0.5 and not frame.final:
            return Verdict(due=frame.start + frame.volts.size + math.ceil(missing))
        levels = node_levels(words.rows[0], self._spec)
        known = self._line.level_known  # a level that is not known yet has no noise either
        noise = self._line.noise if known else levels.noise_v**2 * self._spec.order
        end = self._ends.observe(line, fit, words.amplitude[0], noise, known)
        if end == End.OTHER:
            return None
        if end == End.MISLED:
            doubtful = np.ones(self._spec.nodes, bool)
        return self._line.heard(frame, fit, levels, doubtful)

    def _refined(self, line: Line, chip: float) -> Fit:
        """Timing refined from the mark and a chip duration; unrefined if that leads astray."""
        fit = refine(line, Fit(-0.5, chip), self._spec, earliest=-1.0, latest=0.5)
        return fit if LIMITS.possible(fit.chip / self._line.chip) else Fit(-0.5, chip)

    def _by_loud_end(self, line: Line) -> Floats:
        """Chip durations with which a frame ends where the line falls silent, or a bit later."""
        nominal = self._line.chip
        limit = 5 * self._line.sample_noise_v
        least = 0.3 * math.sqrt(self._line.least_power)
        loud = np.flatnonzero(np.abs(line.volts) > max(limit, least))
        end = int(loud[-1]) + 1 if loud.size else self._line.size
        chip: Floats = (end + nominal * np.arange(-1.0, 3.0, 0.5)) / self._spec.chips
        return np.clip(chip, nominal, (1 + MAX_STRETCH) * nominal)

    def _all_stretches(self, line: Line) -> Floats:
        """All chip durations of frames that end within the samples.

        If these are more than the budget has: those near the best by so many bits as it has for
        all. None if these are fewer than two, of which any chips make words.
        """
        spec, budget = self._spec, max(0.0, self._budget)
        bits = min(int(math.sqrt(budget / (2 * MAX_STRETCH)) / spec.order), spec.line_bits)
        if bits < 2:
            return np.empty(0)
        step = 0.5 / (bits * spec.order)
        chip: Floats = self._line.chip * np.arange(1, 1 + MAX_STRETCH + step, step)
        chip = chip[chip * spec.chips <= line.volts.size + self._line.chip]
        self._budget -= chip.size * bits * spec.order
        if bits < spec.line_bits:
            best = chip[np.argsort(-self._gains(line, chip, bits))[:SURVIVORS]]
            fine, reach = 0.5 * self._line.chip / spec.chips, math.ceil(spec.line_bits / bits)
            chip = fine * np.unique(np.rint(best[:, None] / fine + np.arange(-reach, reach + 1)))
            self._budget -= chip.size * spec.chips
        return chip

    def _gains(self, line: Line, chip: Floats, bits: int) -> Floats:
        """The energy that words of constant amplitude explain of the first bits, (c,).

        Of all nodes, even if faint: what noise has there is the same for all chip durations.
        """
        spec, gains = self._spec, []
        edges = np.arange(bits * spec.order + 1.0)
        for some in np.array_split(chip, 1 + chip.size * edges.size // CHIPS_AT_ONCE):
            chips = line.means(some[:, None] * edges - 0.5).reshape(-1, bits, spec.order)
            flipped = chips if spec.flips is None else chips * spec.flips[:bits]
            level = np.abs(correlate(flipped, spec.book)[..., spec.node_slice]).sum(axis=1)
            gains.append(np.einsum("cn,cn->c", level, level) * some)
        return np.concatenate(gains)
