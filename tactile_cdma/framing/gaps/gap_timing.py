# SPDX-License-Identifier: Apache-2.0

"""Finds frames in nothing but the waveform: between gaps, stretched at random."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ...base.arrays import Bools, Floats
from ...base.errors import SpecError
from ...base.sums import dot, sums
from ...code.amplitude import FAINT_SHARE, rises
from ...code.frame import FrameSpec
from ...code.separate import NodeLevels, node_levels
from ..fit import Fit, Line, WordFit, even_words, integrate, least_power, read_words
from ..judge import Judgement
from ..limits import LIMITS
from ..raster import Expected, Raster
from ..timing import (
    ABSURD,
    AT_RAIL,
    INCOMPLETE,
    MISFIT,
    NOISY,
    NOT_AT_REST,
    FrameLevels,
    QuietBlock,
    Rails,
    Rejections,
    SampleBlock,
    Timing,
    share_clipped,
    silence_hidden,
)
from .burst import Beside, Burst, Gap
from .hum import Hum, without_impulses
from .search import GapSearch, Look
from .stray import strays

_log = logging.getLogger(__name__)

FORGET = 0.999
"""Factor on a learnt amplitude's power in each silent slot. Chosen: halves it in 9 s at 78 Hz."""
SURE_SHARE, SURE_NOISE = 0.5, 0.3
"""A silent slot holds no faint word if its power, and so much of its noise, stays below the power
of a word of this share of FAINT_SHARE. Chosen: an eighth of a node's amplitude; the variances of
slot and gap are right to a tenth. A slot of far less power than the gap's noise says that this is
none, but hum, which may hide a word."""
AGAIN_PERIODS = 12
"""Frame periods of rejected samples kept until hum is known. Chosen: that takes 4 to 8."""


@dataclass(frozen=True, slots=True)
class _Failure:
    """Why a stretch holds no frame, and the instant at which its burst is first silent."""

    reason: Rejections
    pause: float


class GapTiming(Timing):
    """Frames from nothing but the waveform: they stand between gaps, stretched by 0…11 %.

    Samples from `_cursor` on are undecided. At stream index `due`, when they hold the frame that is
    expected next, the search decides: nothing, a frame, or something else. Decisions depend on
    sample positions only, so any cutting into blocks gives the same frames.
    """

    def __init__(self, spec: FrameSpec, rate_hz: float, rails_v: Rails = None) -> None:
        """Raises SpecError where frames leave no gap to find, or at too low a rate.

        rate_hz: samples per second. rails_v: see share_clipped.
        """
        super().__init__()
        self._spec, self._rails_v = spec, rails_v
        search = self._search = GapSearch(spec, rate_hz, rails_v)
        if not search.chip >= 2.5:
            raise SpecError(
                f"{search.chip:.2g} samples per chip are too few to find frames by their gaps: "
                f"sample at {3 / spec.chip_s:.3g} Hz or more, or use line timing"
            )
        gap_chips = (search.period - search.shortest) / search.chip
        if gap_chips < spec.order / 2:
            raise SpecError(
                f"a gap of {gap_chips:.1f} chips is too short to find frames of order "
                f"{spec.order} by; lengthen frame_period_s or use line timing"
            )
        # From a frame's first loud sample to the instant at which it must be over.
        self._reach = math.ceil(search.longest + 3 * search.chip)
        self._most_again = AGAIN_PERIODS * search.period
        self._most_held = search.period + 2 * self._reach
        # From the start of a frame that the raster places until it is usually proven to be over.
        self._proof_chips = spec.span_chips + 4
        self._gap: Gap | None = None
        self._heard_one = False  # a frame, since the raster began
        self._raster = Raster(search.period)
        self._hum = Hum(rate_hz)
        self._waiting = True  # until it is known whether there is hum
        self._again = (0, 0.0, self.rejections)
        self._cursor = 0
        self._seen = 0  # end of the samples that were looked at last
        self.due = 0
        self._expected: Expected | None = None  # the next frame
        self._sure = False  # whether the raster places it
        self._next = 0.0  # start of the next slot
        self._failures = 0

    def feed(self, block: SampleBlock) -> list[FrameLevels]:
        """Take samples in; return the frames and silent slots that they complete."""
        if not self._join(block):
            self._begin_at(block.first_index)
        frames: list[FrameLevels] = []
        volts, slice_size = block.volts, 2 * math.ceil(self._search.period)
        for begin in range(0, volts.size, slice_size):  # keeps the buffer bounded
            self._samples.append(volts[begin : begin + slice_size], block.checked)
            while self._samples.end >= self.due:
                frames += self._decide(self.due)
        return frames

    def quiet(self, block: QuietBlock) -> list[FrameLevels]:
        """Process a block in which no node transmitted."""
        return self.feed(block.samples())

    def flush(self) -> list[FrameLevels]:
        """End of the recording: decode a last frame if it is complete."""
        frames: list[FrameLevels] = []
        self._waiting, waited = False, self._waiting
        if waited and self._cursor > self._again[0]:
            self._try_again()
        cursor = -1
        while self._samples.end - self._cursor > self._search.shortest and cursor != self._cursor:
            cursor = self._cursor
            frames += self._decide(self._samples.end, final=True)
        self.reset()
        return frames

    def _begin_at(self, index: int) -> None:
        """Start looking at this sample; slots stay on their raster across a hole."""
        if not self._heard_one or index < self._next - self._search.period:
            self._next, self._heard_one = float(index), False
            self._raster.forget_place()
        self._seen = index
        self._skip_to(index)
        self._settle()

    def _skip_to(self, index: int) -> None:
        """Decide on samples from here on; nothing is known of slots that began before."""
        self._cursor = index
        late = math.ceil((index - self._next) / self._search.period)
        self._next += max(0, late) * self._search.period
        self._schedule()

    def _settle(self) -> None:
        """What lies before the cursor is decided for good."""
        self._again = self._cursor, self._next, self.rejections
        self._schedule()

    def _try_again(self) -> None:
        """Return to what was rejected since the last frame or slot."""
        self._cursor, self._next, self.rejections = self._again
        self._gap, self._failures = None, 0
        self._schedule()

    def _schedule(self) -> None:
        """Drop decided samples; set when the next decision is due."""
        if self._gap is None:  # a whole gap must be in view
            self.due = self._cursor + math.ceil(self._search.period) + self._reach
        else:
            self.due = max(math.ceil(self._next), self._cursor) + self._reach
            expected = self._expected = self._raster.expect(self._next)
            self._note(self._search.is_sure(expected))
            if expected and self._sure:
                early = math.ceil(expected.start + self._proof_chips * expected.chip)
                self.due = early if self._seen < early < self.due else self.due
        if self._cursor - self._again[0] > self._most_again:
            self._again = self._cursor, self._next, self.rejections
        self._samples.drop(self._again[0])

    def _note(self, sure: bool) -> None:
        """Whether the raster places the next frame."""
        if sure != self._sure:
            self._sure = sure
            _log.debug(
                "raster %s at sample %d", "places frames" if sure else "is lost", self._cursor
            )

    def _decide(self, end: int, final: bool = False) -> list[FrameLevels]:
        """Look at the samples from the cursor to `end`, and move on. final: none will follow."""
        raw = self._samples.take(self._cursor, end)
        self._seen = end
        heard = self._hum.heard
        volts = self._hum.removed(raw, self._cursor)
        look = None
        if self._gap is not None:
            expected = self._expected if self._sure else None
            look = self._search.look(volts, raw, self._gap, self._cursor, expected)
        if look is None and math.isnan(sums(raw)[0]):
            self.rejections += ABSURD
            self._skip_to(self._cursor + int(np.flatnonzero(np.isnan(raw))[-1]) + 1)
            return []
        candidates = [look.gap] if look else self._search.gaps(volts, self._gap)
        if candidates:
            # The window in which the gap was measured shows hum.
            begin, half = candidates[0].begin, self._search.half
            window = raw[begin : begin + self._search.window_halves * half]
            self._hum.learn(self._cursor + begin, window, candidates[0].variance * half)
            if self._comes_too_early(heard):
                return []
        if look and look.is_sound:
            return self._take_sound(look, candidates[0])
        found = self._searched(volts, candidates, raw, final, look)
        if isinstance(found, _Failure):
            for other in (without_impulses(volts), raw):  # hum may have ended
                if isinstance(found, _Failure) and other is not volts:
                    calmer = self._searched(other, self._search.gaps(other, self._gap), raw, final)
                    found = found if isinstance(calmer, _Failure) else calmer
        if not isinstance(found, _Failure):
            return found
        self.rejections += found.reason
        self._failures += 1
        _log.debug("no frame at sample %d: %s", self._cursor, found.reason)
        if self._failures == 3:  # perhaps it is the level that is wrong
            _log.debug("the gap's level is measured anew")
            self._gap, self._failures = None, 0
        # A wrong level's burst may reach far into the next frame.
        self._skip_to(self._cursor + max(self._search.bit, math.ceil(found.pause)))
        return []

    def _searched(
        self,
        volts: Floats,
        candidates: list[Gap],
        raw: Floats,
        final: bool,
        look: Look | None = None,
    ) -> list[FrameLevels] | _Failure:
        """What is in the samples from the cursor on: frames, or none yet; or why there is nothing.

        volts: hum removed, and perhaps impulses. raw: as they came. look: what is known of them.
        """
        end = self._cursor + volts.size
        seen: list[Burst] = []
        reason = INCOMPLETE
        for gap in candidates:
            line = Line(volts, gap.level)
            burst = look.burst if look else None
            if burst is None and not (look and look.is_silent):
                burst, look = self._first_burst(line.volts, gap), None
            if burst is None:
                continue
            seen.append(burst)
            if look and (found := look.found):
                taken = self._take(line, burst, gap, raw, found, look.beside)
                if not isinstance(taken, Rejections):
                    return taken
            expected = self._raster.expect(self._cursor + burst.first, self._cursor)
            complete = min(burst.first + self._reach, burst.last + self._search.bit)
            incomplete = volts.size < complete and volts.size <= self._most_held
            if not final and incomplete:
                self.due = max(end + 1, self._cursor + math.ceil(complete))
                found = self._proven(line, burst, expected, look)
                taken = [] if found is None else self._take(line, burst, gap, raw, found)
                return [] if isinstance(taken, Rejections) else taken
            if burst.first < self._search.chip:
                continue  # no gap before it: the rest of a frame that began before the cursor
            found = self._search.frame(line, burst, expected)
            taken = MISFIT if found is None else self._take(line, burst, gap, raw, found)
            if not isinstance(taken, Rejections):
                return taken
            reason = taken
        if all(self._may_be_noise(burst) for burst in seen):
            self._gap = candidates[0] if candidates and not final else self._gap
            return [] if final else self._pass_idle(end)
        return _Failure(reason, min(burst.pause for burst in seen))

    def _proven(
        self, line: Line, burst: Burst, expected: Expected | None, look: Look | None
    ) -> Judgement | None:
        """The frame that the raster places here, if the samples prove already that it is over."""
        search, fit = self._search, None
        if not look and burst.first >= search.chip:
            fit = search.carried(line, expected)
        proven = look.proven if look else 0.0 if fit is None else search.proven(burst, fit)
        if proven > line.received.size:
            self.due = min(self.due, self._cursor + math.ceil(proven))
        elif proven and (fit := fit or search.carried(line, expected)):
            return search.explained(line, burst, fit, expected)
        return None

    def _first_burst(self, volts: Floats, gap: Gap) -> Burst | None:
        """The earliest burst: the strongest one may have a weaker one before it."""
        found = None
        while burst := self._search.burst(volts, gap.variance):
            if found and self._may_be_noise(burst):
                break  # the frame after it is in view
            found = burst
            if burst.pause < burst.last:
                before = int(burst.pause) + self._search.bit
            else:
                before = int(burst.first - self._search.chip)
            if not self._search.shortest < before < volts.size:
                break
            volts = volts[:before]
        return found

    def _may_be_noise(self, burst: Burst) -> bool:
        return burst.snr < 2 * self._search.snr_floor

    def _comes_too_early(self, heard: bool) -> bool:
        """Whether to look at all this later or again, since hum disturbs it that is not known yet.

        heard: whether hum was known before this view.
        """
        hum, held = self._hum, self._cursor - self._again[0]
        if self._waiting and not hum.decided and held < self._most_again / 2:
            if hum.moving:
                self._skip_to(self._cursor + math.ceil(self._search.period))
            return hum.moving
        again = (hum.heard and not heard) or (self._waiting and held > 0)
        self._waiting = False
        if again:
            self._try_again()
        return again

    def _take(
        self,
        line: Line,
        burst: Burst,
        gap: Gap,
        raw: Floats,
        found: Judgement,
        beside: Beside | None = None,
    ) -> list[FrameLevels] | Rejections:
        """The frame that a burst is, after silent slots before it; or why it is no frame.

        line: gap level, hum and impulses removed. raw: samples as they came, V. beside: if known.
        """
        spec, fit = self._spec, found.fit
        end = fit.end(spec)
        if end > raw.size + 0.5 * fit.chip:
            return INCOMPLETE
        clipped = share_clipped(raw[max(0, round(fit.start)) : round(end)], self._rails_v)
        if clipped > LIMITS.clipped:
            return AT_RAIL
        beside = beside or self._search.beside(line.volts, fit, burst)
        noise = beside.variance * self._search.half / fit.chip
        words = even_words(line, fit, spec, found.words)
        if not words.believable(spec, noise):
            return MISFIT
        if not beside.quiet:
            return NOT_AT_REST
        self._learn(gap, words)
        expected = self._raster.expect(self._cursor + fit.start, self._cursor)
        sure = self._search.is_sure(expected)
        placed = expected is not None and sure and expected.is_near(fit)
        least = math.sqrt(self._search.least_power) / FAINT_SHARE
        doubts = [found.doubtful, strays(line, fit, words, beside, least, placed, spec)]
        of_others = sure and not placed and not words.explained_by(noise)  # theirs is on the raster
        if clipped > LIMITS.deafened or of_others:
            doubts = [np.ones(spec.nodes, bool)]
        known = [some for some in doubts if some is not None]
        doubtful = np.any(known, axis=0) if known else None
        unaided, levels = found.unaided if found.decided else None, node_levels(words.rows[0], spec)
        return self._emit(fit, unaided, levels, beside.level, clipped, doubtful, placed)

    def _take_sound(self, look: Look, gap: Gap) -> list[FrameLevels]:
        """The frame in which the kernel found nothing odd."""
        self._learn(gap, look.words)
        levels = look.levels(self._spec)
        return self._emit(Fit(*look.place), look.unaided, levels, look.around[0], look.clipped)

    def _learn(self, gap: Gap, words: WordFit) -> None:
        """Learn from a frame's words and the gap beside it."""
        self._gap = gap
        if self._spec.node_swing_v is None:
            self._search.least_power = least_power(float(words.amplitude.max()))

    def _emit(
        self,
        fit: Fit,
        unaided: bool | None,
        levels: NodeLevels,
        left_v: float,
        clipped: float,
        doubtful: Bools | None = None,
        placed: bool = True,
    ) -> list[FrameLevels]:
        """The frame, after the silent slots before it.

        fit: from the cursor on. unaided: see Judgement; None where its place is not decided.
        left_v: of the gap's level around it. placed: see FrameLevels.
        """
        assert self._gap is not None
        end = fit.end(self._spec)
        fit = Fit(self._cursor + fit.start, fit.chip)
        # Without an earlier frame, what lies before this one may be the rest of another.
        frames: list[FrameLevels] = []
        if self._heard_one:
            frames += self._idle_slots(fit.start - self._search.period / 2)
        if self._spec.first_row == 0:  # the only row that an offset shows in
            levels.values[:, 0] -= np.float32(left_v)
        noise_rms_v = levels.noise_v * math.sqrt(self._spec.order)
        level_v = self._gap.level + left_v
        heard = levels, noise_rms_v, level_v, clipped, doubtful, placed
        frames.append(FrameLevels(fit.start, fit.chip, *heard))
        self._heard_one, self._failures = True, 0
        if unaided is not None:
            self._raster.learn(fit, unaided)
        self._next = fit.start + self._search.period
        self._cursor += math.ceil(end + 0.5 * fit.chip)
        self._settle()
        return frames

    def _pass_idle(self, end: int) -> list[FrameLevels]:
        """Nothing up to `end`, but a frame may begin within the last frame's length before it."""
        frames = list(self._idle_slots(end - self._reach))
        if self._spec.node_swing_v is None:
            self._search.least_power *= FORGET ** len(frames)
        self._cursor = max(self._cursor, end - self._reach)
        self._settle()
        return frames

    def _silent_slot(self, level: float, noise: float) -> FrameLevels | Rejections:
        """The slot that is next, in which there is no frame; noise: of a chip's level, V RMS.

        Rejected where a rail or noise hides words. A faint word hardly has power. Where its place
        is known it is looked for on the nodes' rows, else everybody's silence is a guess.
        """
        spec, search, slot = self._spec, self._search, self._next
        before = (search.period - search.shortest) / 2
        begin = max(self._samples.begin, math.floor(slot - before))
        volts = self._samples.take(begin, begin + math.ceil(search.period))
        seen = volts if volts.size or self._gap is None else np.array([level])
        clipped = share_clipped(seen, self._rails_v)
        if hidden := silence_hidden(clipped, noise, spec):
            return hidden
        silent = FrameLevels(slot, search.chip, None, noise, level, clipped)
        volts = self._hum.removed(volts, begin) - level
        if self._gap is None or not volts.size:
            return silent
        sample_noise = self._gap.variance * search.half
        power = dot(volts, volts) / volts.size - sample_noise
        power *= volts.size / search.shortest
        if abs(power) + SURE_NOISE * sample_noise < SURE_SHARE**2 * search.least_power:
            return silent
        expected = self._raster.expect(slot, begin)
        if expected is None or not search.is_sure(expected):
            return replace(silent, doubtful=np.ones(spec.nodes, bool))
        start, chip = np.array([expected.start]), np.array([expected.chip])
        rows = read_words(integrate(Line(volts), start, chip, spec), spec).rows[0]
        levels = node_levels(rows, spec)
        squares = np.einsum("kn,kn->n", levels.values, levels.values)
        least = math.sqrt(search.least_power) / FAINT_SHARE
        if not rises(squares, np.float32(least), levels.noise_v, spec.line_bits).any():
            return silent
        place = begin + expected.start
        return replace(silent, start=place, chip_samples=expected.chip, levels=levels)

    def _idle_slots(self, until: float) -> Iterator[FrameLevels]:
        """Silent slots that begin up to an index; rejected where a rail or noise hides words."""
        if self._next > until:
            return
        level, noise, is_deaf = 0.0, math.nan, False
        if gap := self._gap:  # whose variance is that of half chips
            level, noise = gap.level, math.sqrt(gap.variance / 2)
            # A node that speaks alone might pass for noise, since power finds bursts.
            least_v2 = LIMITS.lone * 2 * self._search.snr_floor * gap.variance
            is_deaf = (self._spec.node_swing_v or math.inf) ** 2 < least_v2
        while self._next <= until:
            slot = NOISY if is_deaf else self._silent_slot(level, noise)
            if isinstance(slot, Rejections):
                self.rejections += slot
            else:
                yield slot
            self._next += self._search.period
