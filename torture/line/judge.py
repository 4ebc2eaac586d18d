# SPDX-License-Identifier: Apache-2.0

"""What is to be said of a line after a while: frames, times, pressures and counts, one by one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict

import numpy as np

from tactile_cdma.config.parameters import GAP
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.sim.options import Setup, SimOptions

from ..oracle import Held, Judge, Verdict
from ..outcome import Tally
from .ledger import Counts, Ledger, Unbroken

MAY_MISS = 2
"""Frames that may be missing after a fault although they arrived whole, where they have no marks:
they are found by a gap before and after them. Where they have, none may."""
NEAR_CHIPS = 0.5
"""By how much a frame in which somebody spoke may be off its true start."""
NEAR_PA = 0.5
"""By how much a pressure may be off what its word says: float32 holds 0.01 Pa."""


class LineJudge(Judge):
    """Follows one driver on one line."""

    def __init__(self, config: SkinConfig, ledger: Ledger, frame_samples: float) -> None:
        """frame_samples: samples from one frame's start to the next one's."""
        super().__init__()
        self._config, self._ledger, self._frame_samples = config, ledger, frame_samples
        self._held = Held(config)
        self._heard_s = np.full(config.spec.nodes, -np.inf)
        self._may_be_forgotten = np.zeros(config.spec.nodes, bool)
        self._differences: Counter[str] = Counter()
        self._newest: TactileFrame | None = None
        self._newest_sequence = -1
        self._stream = 0
        self._published: set[tuple[int, int]] = set()
        self._looked_at: tuple[int, int] = (0, -1)  # stream and number of frames judged as missing
        self._lost = 0
        self._first_index: dict[int, int] = {}

    def began(self, options: SimOptions, setup: Setup, started_s: float, first_index: int) -> None:
        """A stream began at this time of the digitizer's clock, with this index."""
        self._first_index[len(self.oracle.streams)] = first_index
        self.oracle.began(options, setup, started_s)

    def look(self, frames: Sequence[TactileFrame], pipeline: Pipeline) -> Tally:
        """What is wrong with these frames and with the counts, once all that arrived is decoded."""
        found = self.look_at_frames(frames)
        self._lost += found.lost
        found.uncounted_losses += self._miscounted(pipeline)
        self._count_missing(found)
        return found

    def look_at_frames(self, frames: Sequence[TactileFrame]) -> Tally:
        """As `look`, of the frames alone."""
        self.tally = Tally()
        for frame in frames:
            verdict = self.check(frame)
            self.tally.wrong_values += self._wrong(frame, verdict)
            self.tally.uncounted_losses += verdict.uncounted
            self.tally.lost += self._passed_over(frame, verdict)
            if verdict.number is not None:
                self._published.add((verdict.stream, verdict.number))
        return self.tally

    def _passed_over(self, frame: TactileFrame, verdict: Verdict) -> int:
        """Frames lost before this one: after a START only the host's clock can tell how many."""
        before, self._newest_sequence = self._newest_sequence, frame.sequence
        return frame.sequence - before - 1 if verdict.lost is None else verdict.lost

    def _wrong(self, frame: TactileFrame, verdict: Verdict) -> int:
        """How many times and pressures of a frame are wrong."""
        if verdict.stream != self._stream:
            self._stream = verdict.stream
            # What was heard before is held, or forgotten if the clock may be another.
            self._may_be_forgotten[:] = True
        wrong = self._misread(frame)
        newest, self._newest = self._newest, frame
        if newest is not None:
            wrong += frame.t_host <= newest.t_host or frame.sequence <= newest.sequence
        stream = self.oracle.streams[verdict.stream]
        if verdict.number is None or not frame.words.active.any():
            return wrong
        true_s = stream.started_s + verdict.number * self._config.spec.frame_period_s
        return wrong + (abs(frame.t_start - true_s) > NEAR_CHIPS * self._config.spec.chip_s)

    def _misread(self, frame: TactileFrame) -> int:
        """How many taxels read something else than the words say."""
        words = frame.words
        self._held.hear(words.active, words.codes)
        self._heard_s[words.active] = frame.t_middle
        self._may_be_forgotten &= ~words.active
        stale = frame.t_middle - self._heard_s > self._config.stale_after_s
        expected_pa = np.where(stale, np.nan, self._held.pressure_pa)
        pressure_pa = frame.readings.pressure_pa
        near = np.abs(pressure_pa - expected_pa) < NEAR_PA
        unknown = (np.isnan(expected_pa) | self._may_be_forgotten) & np.isnan(pressure_pa)
        return int(np.count_nonzero(~(near | unknown)))

    def _miscounted(self, pipeline: Pipeline) -> int:
        """By how much more than before the driver's counts differ from what arrived."""
        differences = Counter(counted(pipeline))
        differences.subtract(asdict(self._ledger.counts))
        differences["lost_frames"] = pipeline.counters.lost_frames - self._lost
        new = sum(abs(differences[name] - self._differences[name]) for name in differences)
        self._differences = differences
        return new

    def _count_missing(self, found: Tally) -> None:
        """Whole frames that were not published: late, and a hang if long after the last fault."""
        may_miss = MAY_MISS if self._config.timing == GAP else 0
        for samples in self._ledger.unbroken:
            for number, since in self._frames_within(samples):
                if (samples.start, number) <= self._looked_at:
                    continue
                self._looked_at = (samples.start, number)
                if (samples.start, number) not in self._published:
                    found.late += 1
                    found.hangs += since >= may_miss
        del self._ledger.unbroken[:-1]
        self._published = {frame for frame in self._published if frame > self._looked_at}

    def _frames_within(self, samples: Unbroken) -> Iterable[tuple[int, int]]:
        """Numbers of the whole frames among these samples, and how many there were before each."""
        origin = self._first_index[samples.start]
        size = self._frame_samples
        first = int(np.ceil((samples.begin - origin) / size))
        # Without marks a frame is known when the next one would be over.
        last = int((samples.end - origin) // size) - (2 if self._config.timing == GAP else 0)
        return ((number, number - first) for number in range(first, last))


def counted(pipeline: Pipeline) -> dict[str, int]:
    """What a driver has counted, by the names of Counts; what must not come is added to broken."""
    packets, counters = pipeline.packet_counts, pipeline.counters
    unintelligible = packets.crc_errors + packets.framing_errors + packets.resyncs
    counts = Counts(
        bytes=packets.bytes,
        packets=packets.packets,
        broken=unintelligible + packets.jumps + packets.malformed + packets.unknown,
        lost_packets=packets.lost_packets,
        repeated=packets.repeated_packets,
        samples=counters.samples,
        lost_samples=counters.lost_samples,
        unannounced=counters.unannounced_samples,
        impossible=counters.implausible_packets,
        restarts=counters.restarts,
    )
    return asdict(counts)
