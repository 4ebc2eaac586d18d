# SPDX-License-Identifier: Apache-2.0

"""Judges a driver on a damaged line: words, times, pressures, counts, and whether it resumed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict

import numpy as np

from tactile_cdma.config.parameters import GAP
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.sim.options import SimOptions
from test.support.oracle import Held, Verdict

from ..judge import Judge
from ..outcome import Tally
from .ledger import Counts, Ledger, Unbroken
from .man_in_the_middle import Started

MAY_MISS = 2
"""Frames that arrived whole but may be missing after a fault, without marks: a frame is then found
by the gaps before and after it. With marks, none may be missing."""
NEAR_CHIPS = 0.5
"""Tolerance of the start of a frame in which a node spoke, chips."""
NEAR_PA = 0.5
"""Tolerance of a pressure, Pa; float32 resolves 0.01 Pa."""


class LineJudge(Judge):
    """Follows one driver on one line, whose man in the middle keeps a ledger."""

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

    def began(self, options: SimOptions, started: Started, first_index: int) -> None:
        """Note that a stream began with this index."""
        self._first_index[len(self.oracle.streams)] = first_index
        self.oracle.began(options, started.setup, started.device_s, started.turns)

    def look(self, frames: Sequence[TactileFrame], pipeline: Pipeline) -> Tally:
        """What is wrong with these frames and with the counts, once all that arrived is decoded."""
        found = self.look_at_frames(frames)
        self._lost += found.lost
        found.uncounted_losses += self._miscounted(pipeline)
        self._count_missing(found)
        return found

    def look_at_frames(self, frames: Sequence[TactileFrame]) -> Tally:
        """Judge the frames alone."""
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
        """Frames lost before this one; after a START only the host's clock tells how many."""
        before, self._newest_sequence = self._newest_sequence, frame.sequence
        return frame.sequence - before - 1 if verdict.lost is None else verdict.lost

    def _wrong(self, frame: TactileFrame, verdict: Verdict) -> int:
        """How many times and pressures of a frame are wrong."""
        if verdict.stream != self._stream:
            self._stream = verdict.stream
            # Earlier words are held, or forgotten if the device's clock may be another one.
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
        """Number of taxels whose reading does not follow from the words."""
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
        """How far the driver's counts have moved away from the ledger since the last look."""
        differences = Counter(counted(pipeline))
        differences.subtract(asdict(self._ledger.counts))
        differences["lost_frames"] = pipeline.counters.lost_frames - self._lost
        new = sum(abs(differences[name] - self._differences[name]) for name in differences)
        self._differences = differences
        return new

    def _count_missing(self, found: Tally) -> None:
        """Count whole frames that were not published: late, and hangs unless after a fault."""
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
        # Without marks a frame is known only when the next one is over.
        last = int((samples.end - origin) // size) - (2 if self._config.timing == GAP else 0)
        return ((number, number - first) for number in range(first, last))


def counted(pipeline: Pipeline) -> dict[str, int]:
    """The driver's counts by the names of Counts; all kinds of broken packets are summed."""
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
