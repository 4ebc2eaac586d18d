# SPDX-License-Identifier: Apache-2.0

"""Finds frames in nothing but the waveform: between gaps, stretched at random.

Where the raster of the frames before places the next one, it is read as a marked one is. Else the
search proposes a place. Either way the kernel's certificate decides what is believed, and frames
whose place it finds to be decided by the waveform alone teach the raster.
"""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from itertools import product

import numpy as np

from ...base import kernel
from ...base.arrays import Floats32
from ...base.errors import SpecError
from ...words.limits import GAP_WEIGHT, LEAST_REST, LIMITS, MOST_RISE
from ..frame_reader import FrameReader, mean_and_variance
from ..frames import Certificate, LineFrame, Rejections, rejections_of, words_of
from ..raster import MEMORY, Raster
from .search import FAINT, SETTLING, Burst, Gap, GapSearch

_log = logging.getLogger(__name__)

SIDE_CHIPS = int(kernel.lib.CERTIFICATE_BESIDE) // 2
"""Chips beside a frame, on either side, of which rivals are looked at."""
FORGET = 1 - 1 / MEMORY
"""Factor on a learnt amplitude in each silent slot."""
GAPS = 2 / GAP_WEIGHT - 1
"""Gaps that the running estimate of noise is as good as the mean of."""
LOST_AGAIN = 3
"""Stretches in a row that hold no frame, after which the line's level is measured anew."""


class GapTiming:
    """Frames from nothing but the waveform: they stand between gaps, stretched by 0…11 %.

    Samples from `_cursor` on are undecided. At stream index `due`, when they hold the frame that is
    expected next, it is decided: nothing, a frame, or something else. Decisions depend on sample
    positions only, so any cutting into blocks gives the same frames.
    """

    def __init__(self, reader: FrameReader, rate_hz: float) -> None:
        """Raise SpecError where frames leave no gap to find, or at too low a rate.

        reader: made with SIDE_CHIPS. rate_hz: samples per second.
        """
        spec = reader.spec
        self._reader, self._spec = reader, spec
        search = self._search = GapSearch(reader, rate_hz)
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
        # From a frame's first loud sample to the instants at which it, and its slot, must be over.
        self._over = math.ceil(search.longest + 3 * search.chip)
        self._reach = max(self._over, 1 + math.ceil((search.period + search.shortest) / 2))
        # A level that holds words on row 0 is known by all of a gap, that of hum by what is near.
        near = math.inf if spec.first_row == 0 else spec.order * search.chip
        self._rest_size = int(min(search.gap, near))
        self._counts = [0] * kernel.lib.FRAME_VERDICTS
        self._volts = np.empty(0, np.float32)  # from stream index _begin on
        self._begin = self._cursor = self._end = self.due = 0
        self._raster = Raster(search.period, spec.span_chips)
        self._next = 0.0  # start of the next slot
        self._has_begun = self._fresh = self._is_placed = False
        self._level: float | None = None  # of the line at rest, V
        self._noise = 0.0  # variance of a chip's level there, V²
        self._failures = 0
        self._loudest_v = 0.0  # word, where the amplitude is not specified
        self.reset()

    @property
    def rejections(self) -> Rejections:
        """Stretches of which nothing is claimed."""
        return rejections_of(self._counts)

    def reset(self) -> None:
        """Forget the frame in progress, since the stream has a hole."""
        self._fresh = True

    def feed(self, first_index: int, volts: Floats32) -> list[LineFrame]:
        """Take samples in; return the frames and silent slots that they complete.

        first_index: of the first sample in the stream. volts: (m,), NaN where absurd.
        """
        if self._fresh or first_index != self._end:
            self._begin_at(first_index)
        kept = self._volts[max(0, self._cursor - self._kept - self._begin) :]
        self._begin = self._end - kept.size
        self._volts = np.concatenate((kept, volts))
        self._end += volts.size
        frames: list[LineFrame] = []
        while self._end >= self.due:
            frames += self._decide(self.due, False)
        return frames

    def flush(self) -> list[LineFrame]:
        """End of the recording: decode a last frame if it is complete."""
        frames: list[LineFrame] = []
        cursor = -1
        while self._end - self._cursor > self._search.shortest and cursor != self._cursor:
            cursor = self._cursor
            frames += self._decide(self._end, True)
        self.reset()
        return frames

    @property
    def _kept(self) -> int:
        """Samples before the cursor that are looked at: gap before the next frame, or slot."""
        search = self._search
        before_frame = self._rest_size + (SIDE_CHIPS + 2 * SETTLING) * search.chip
        return 1 + math.ceil(max(before_frame, (search.period - search.shortest) / 2))

    def _begin_at(self, index: int) -> None:
        """Start looking at this sample; slots stay on their raster across a hole."""
        self._fresh = False
        self._volts = np.empty(0, np.float32)
        self._begin = self._end = index
        if not self._has_begun or index < self._next - self._search.period:
            self._next, self._has_begun = float(index), False
            self._raster.forget_place()
        self._skip_to(index)

    def _skip_to(self, index: int) -> None:
        """Decide on samples from here on; nothing is known of slots that began before."""
        self._cursor = index
        late = math.ceil((index - self._next) / self._search.period)
        self._next += max(0, late) * self._search.period
        self._schedule()

    def _schedule(self) -> None:
        """Set when the next decision is due."""
        self._expected = None
        expected = self._raster.expect(self._next)
        if self._level is None:  # a whole gap must be in view
            self.due = self._cursor + math.ceil(self._search.period) + self._reach
        else:
            self.due = max(math.ceil(self._next), self._cursor) + self._reach
            if expected is not None and expected.sure and expected.start >= self._cursor:
                self._expected = expected
                self.due = math.ceil(expected.start + self._reader.due_chips * expected.chip)
        if (self._expected is not None) != self._is_placed:
            self._is_placed = self._expected is not None
            told = "places frames" if self._is_placed else "is lost"
            _log.debug("raster %s at sample %d", told, self._cursor)

    def _take(self, begin: int, end: int) -> Floats32:
        """Return samples begin…end − 1, as far as they are kept."""
        return self._volts[max(0, begin - self._begin) : max(0, end - self._begin)]

    def _decide(self, end: int, final: bool) -> list[LineFrame]:
        """Look at the samples from the cursor to `end`, and move on. final: none will follow."""
        if self._expected is not None:
            frames = self._placed(end, final)
            if frames is not None:
                return frames
            self._expected = None
            self.due = max(math.ceil(self._next), self._cursor) + self._reach
            if not final and self.due > end:
                return []
        begun = self._begun(end)
        return self._searched(end, final) if begun is None else self._emit(begun)

    # Frames that the raster places

    def _placed(self, end: int, final: bool) -> list[LineFrame] | None:
        """Return the frame where the raster expects it; None where none is there."""
        expected, lib = self._expected, kernel.lib
        assert expected is not None
        first = max(self._begin, math.floor(expected.start - SIDE_CHIPS * expected.chip))
        self._learn_rest(expected.start)
        scatter = LIMITS.deviations * expected.scatter
        after = self._raster.expect(expected.start + 1.5 * self._search.period)
        measures = not (after and after.sure)  # else the raster would be lost
        self._reader.expect(expected.start - first, expected.chip, scatter, measures)
        verdict = self._reader.verdict(self._take(first, end), final, searches=True)
        if verdict == lib.FRAME_NEEDS_MORE:
            self.due = end + max(1, self._reader.more)
            return []
        if verdict in (lib.FRAME_READ, lib.FRAME_SILENT):
            return self._emit(self._reader.taken(first))
        return None

    def _begun(self, end: int) -> LineFrame | None:
        """Return the frame that begins where the raster expects it, whatever its chips' duration.

        None unless it is certain, though all other places are its rivals.
        """
        expected = self._raster.expect(self._next)
        start = -1.0 if expected is None else expected.start - self._cursor
        if expected is None or not expected.begins or start < 0 or self._level is None:
            return None
        volts = self._take(self._cursor, end)
        self._reader.learn_rest(self._level, self._noise)
        chip = self._reader.duration(volts, start)
        if not chip or self._read_at(volts, start, chip) != kernel.lib.FRAME_READ:
            return None
        frame = self._reader.taken(self._cursor + self._first)
        is_sure = frame.certificate is not None and frame.certificate.holds
        return frame if frame.speakers and is_sure else None

    def _learn_rest(self, start: float) -> None:
        """Learn level and noise of the line from the gap before a frame."""
        chip = self._search.chip
        stop = math.floor(start - SETTLING * chip)
        begin = max(stop - self._rest_size, math.ceil(self._cursor + SETTLING * chip))
        gap = self._take(max(begin, self._begin), stop)
        if gap.size < LEAST_REST:
            return
        self._level, variance = mean_and_variance(gap)
        newest = variance / chip * gap.size / (gap.size - 1)
        if newest > MOST_RISE * self._noise > 0:
            newest = MOST_RISE * self._noise
        self._noise += (GAP_WEIGHT if self._noise else 1.0) * (newest - self._noise)
        self._reader.learn_rest(self._level, self._noise)

    # Others

    def _searched(self, end: int, final: bool) -> list[LineFrame]:
        """Return what is in the samples from the cursor to `end`: frames, or none yet."""
        lib, search, begin = kernel.lib, self._search, self._cursor
        volts = self._take(begin, end)
        if math.isnan(float(volts.sum())):
            self._counts[lib.FRAME_ABSURD] += 1
            self._skip_to(begin + int(np.flatnonzero(np.isnan(volts))[-1]) + 1)
            return []
        volts = _without_impulses(volts)
        gaps = search.gaps(volts, self._level)
        why, seen = lib.FRAME_INCOMPLETE, None
        for gap, moves in product(gaps, search.views):
            burst = search.first_burst(volts, gap, moves, self._reader.swing_v or self._loudest_v)
            if burst is None:
                continue
            seen = seen or (gap, burst)
            complete = math.ceil(min(burst.first + self._reach, burst.last + search.bit))
            most = search.period + 2 * self._reach
            if not final and volts.size < min(complete, most):
                self.due = max(end + 1, begin + complete)
                return []
            if burst.first < search.chip:
                continue  # no gap before it: the rest of a frame that began before the cursor
            verdict = self._read(self._take(begin, end), volts, gap, burst)
            if verdict == lib.FRAME_READ:
                frame = self._reader.taken(begin + self._first)
                certificate = frame.certificate
                is_sure = certificate is not None and certificate.holds
                if frame.speakers and (is_sure or not burst.may_be_noise):
                    return self._emit(frame)
            # A burst in which nobody spoke is none of noise: something else was sent.
            why = verdict if verdict > lib.FRAME_READ else lib.FRAME_MISFIT
        if seen is not None and not seen[1].may_be_noise:
            return self._reject(why, begin + max(search.bit, search.quiet_after(volts, *seen)))
        if gaps and not final:
            self._level, self._noise = gaps[0].level, self._noise or self._noise_of(gaps[0])
        return self._idle_slots(end - self._over) if final else self._pass_idle(end)

    def _reject(self, why: int, until: int) -> list[LineFrame]:
        """Count samples up to an index that hold no frame, but something that was sent."""
        self._counts[why] += 1
        self._failures += 1
        _log.debug("no frame up to sample %d", until)
        if self._failures == LOST_AGAIN:
            self._level, self._noise, self._failures = None, 0.0, 0
        self._skip_to(until)
        return []

    def _noise_of(self, gap: Gap) -> float:
        """Return the variance of a chip's level there, V²."""
        return gap.variance * self._search.half / self._search.chip

    def _read(self, volts: Floats32, calm: Floats32, gap: Gap, burst: Burst) -> int:
        """Read the frame that a burst is; return the kernel's verdict.

        calm: the same samples without impulses.
        """
        if not self._noise:
            self._noise = self._noise_of(gap)
        self._reader.learn_rest(gap.level, self._noise)
        expected = self._raster.expect(self._next)
        chips = () if expected is None else (expected.chip,)
        fit = self._search.frame(calm, burst, chips)
        return int(kernel.lib.FRAME_MISFIT) if fit is None else self._read_at(volts, *fit)

    def _read_at(self, volts: Floats32, start: float, chip: float) -> int:
        """Read a frame that begins about there, or whole chips beside; return the verdict."""
        spec, reader = self._spec, self._reader
        first = self._first = max(0, math.floor(start - SIDE_CHIPS * chip))
        stop = max(0, math.floor(start - SETTLING * chip))
        near = volts[max(0, stop - self._rest_size) : stop]
        if near.size >= LEAST_REST:  # hum moves the level from gap to gap
            reader.learn_rest(mean_and_variance(near)[0], self._noise)
        last = math.ceil(start + (spec.span_chips * 1.01 + SIDE_CHIPS + 1) * chip)
        reader.expect(start - first, chip, math.inf)
        return reader.verdict(volts[first:last])

    # What is told

    def _emit(self, frame: LineFrame) -> list[LineFrame]:
        """Return a frame, after the silent slots before it."""
        search, chip = self._search, frame.chip_samples
        frame = self._with_learnt(frame)
        frames: list[LineFrame] = []
        # Without an earlier frame, what lies before this one may be the rest of another.
        if self._has_begun:
            frames += self._idle_slots(frame.start - search.period / 2)
        frames.append(frame)
        start = frame.start
        if frame.words is None:
            start = self._next if self._expected is None else self._expected.start
        else:
            self._level = frame.level_v
            self._has_begun, self._failures = True, 0
            told = math.nan if self._expected is None else self._expected.start
            is_measured = not abs(start - told) < 1e-6  # else it is the raster's own
            is_measured &= frame.speakers > 0
            if is_measured and frame.certificate and frame.certificate.rivals < 1:
                self._raster.learn(start, chip)
        self._next = start + search.period
        self._cursor = math.ceil(start + (self._spec.span_chips + 0.5) * chip)
        self._schedule()
        return frames

    def _with_learnt(self, frame: LineFrame) -> LineFrame:
        """Return a frame as the amplitude of those before has it, where none is specified.

        What is far fainter than their words, such as hum on row 0, may be silence.
        """
        if self._reader.swing_v is not None or frame.words is None or frame.certificate is None:
            return frame
        loudest_v = float(frame.words.amplitude_v.max()) if frame.speakers else 0.0
        if loudest_v < FAINT * self._loudest_v:
            self._loudest_v *= FORGET
            beyond = FAINT * self._loudest_v / loudest_v if loudest_v else math.inf
            return self._doubted(replace(frame, speakers=0), beyond)
        if frame.certificate.holds:
            self._loudest_v = max(loudest_v, self._loudest_v)
        return frame

    def _pass_idle(self, end: int) -> list[LineFrame]:
        """Nothing up to `end`, but a frame may begin within the last frame's length before it."""
        frames = self._idle_slots(end - self._reach)
        self._cursor = max(self._cursor, end - self._reach)
        self._schedule()
        return frames

    def _idle_slots(self, until: float) -> list[LineFrame]:
        """Return silent slots that begin up to an index; none where a rail or noise hides words."""
        frames = []
        while self._next <= until:
            self._loudest_v *= FORGET
            verdict, energy = self._silent_slot(self._next)
            if verdict == kernel.lib.FRAME_SILENT:
                frame = self._reader.taken(round(self._next))
                frames.append(self._doubted(frame, energy) if energy > 1 else frame)
            else:
                self._counts[verdict] += 1
            self._next += self._search.period
        return frames

    def _silent_slot(self, slot: float) -> tuple[int, float]:
        """Return the kernel's verdict on a slot in which no burst is seen, and its ENERGY.

        Beyond 1 a node may have spoken, so that the silence is in doubt. A word that is too faint
        for a burst shows in the power of the whole slot. Samples that are not kept in any case, or
        not decided on yet, are left out, lest blocks show.
        """
        lib, search, reader = kernel.lib, self._search, self._reader
        side = (search.period - search.shortest) / 2
        before, after = min(side, self._kept), min(search.period - side, self._reach)
        volts = self._take(math.floor(slot - before), math.floor(slot + after))
        if self._level is None or volts.size < search.shortest:
            return lib.FRAME_INCOMPLETE, math.inf
        if reader.is_deaf(volts):
            return lib.FRAME_AT_RAIL, math.inf
        mean, variance = mean_and_variance(volts)
        if search.misses_one(max(self._noise, variance / search.chip)):
            return lib.FRAME_NOISY, math.inf
        noise = self._noise * search.chip
        scatter = noise * math.sqrt(2 / volts.size + 2 / (GAPS * self._rest_size))
        more = abs(variance + (mean - self._level) ** 2 - noise) + LIMITS.deviations * scatter
        least = reader.silent_power * search.shortest
        energy = more * volts.size / least if least else math.inf
        return reader.sum_up(mean, variance), energy

    def _doubted(self, frame: LineFrame, energy: float) -> LineFrame:
        """Return a frame as silence in which any node may have spoken faintly; energy: above 1."""
        noise_v, memory = frame.noise_rms_v, np.zeros_like(frame.memory)
        words = words_of(memory, self._spec.nodes, noise_v)
        words.doubtful[:] = True
        row_noise_v = noise_v / math.sqrt(self._spec.order)
        swing_v = self._reader.swing_v or math.nan
        certificate = Certificate(noise_v**2, row_noise_v, swing_v, energy, 0.0, 0.0, 0.0, 0.0)
        return replace(frame, words=words, memory=memory, certificate=certificate)


def _without_impulses(volts: Floats32) -> Floats32:
    """Return the samples, (m,) V, each as the middle one of itself and its neighbours.

    Switching loads couple impulses of single samples into the line; chips of two or more stay.
    """
    if volts.size < 3:
        return volts
    left, middle, right = volts[:-2], volts[1:-1], volts[2:]
    calm = volts.copy()
    np.clip(middle, np.minimum(left, right), np.maximum(left, right), out=calm[1:-1])
    return calm
