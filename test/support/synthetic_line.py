# SPDX-License-Identifier: Apache-2.0

"""A synthetic line for tests of timing: frames at known times, and checks of what is decoded."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

from tactile_cdma.code.encode import line_chips
from tactile_cdma.code.frame import DEFAULT_AMPLITUDE_V, UNIPOLAR, FrameSpec
from tactile_cdma.driver.stream import ABSURD_V
from tactile_cdma.framing.frame_reader import FrameReader, Rails
from tactile_cdma.framing.frames import LineFrame
from tactile_cdma.framing.gaps.gap_timing import SIDE_CHIPS, GapTiming

PAPER = FrameSpec(first_row=0, sign_seed=None, polarity=-1, order=16)
DEFAULT = FrameSpec()
SPECS = {
    "paper": PAPER,
    "paper, amplitude unknown": replace(PAPER, amplitude_v=None),
    "default": DEFAULT,
    "unipolar": replace(DEFAULT, drive=UNIPOLAR),
    "unipolar, amplitude unknown": replace(DEFAULT, drive=UNIPOLAR, amplitude_v=None),
}


@dataclass
class Sent:
    """One frame on the line: when, how fast, and what each active node said."""

    start: float
    chip: float
    words: dict[int, int]


class Wire:
    """A line, sampled at integer instants, on which frames are placed at fractional ones."""

    def __init__(self, spec: FrameSpec, samples_per_chip: float, seed: int = 0) -> None:
        self.spec = spec
        self.rng = np.random.default_rng(seed)
        self.chip = samples_per_chip
        self.rate_hz = samples_per_chip / spec.chip_s
        self.period = self.rate_hz * spec.frame_period_s
        self.sent: list[Sent] = []
        self.jitter = 0.0
        self.amplitude_v: float | None = None

    def send(self, start: float, words: dict[int, int], stretch: float | None = None) -> None:
        chip = self.chip * (1 + (self.rng.uniform(0, 0.10) if stretch is None else stretch))
        self.sent.append(Sent(start, chip, words))

    def send_random(self, count: int, nodes: int | None = None, wander: float = 2.0) -> None:
        """Frames with random subsets (of a given size) and words, roughly once per period."""
        for i in range(count):
            words = self.words(nodes)
            late = self.rng.uniform(-wander, wander) * self.chip
            self.send((i + 0.25) * self.period + late, words)

    def words(self, nodes: int | None = None) -> dict[int, int]:
        """Random words of so many random nodes; None: of any number."""
        n = self.spec.nodes
        talking = self.rng.choice(n, nodes or self.rng.integers(1, n + 1), replace=False)
        return {int(k): int(self.rng.integers(1 << self.spec.bits)) for k in talking}

    def volts(
        self, length: float | None = None, rho: float | None = None, offset_v: float = 0.0
    ) -> np.ndarray:
        """Samples; one percent of noise where no rho is given."""
        spec = self.spec
        line = np.zeros(math.ceil(length or self.sent[-1].start + 1.2 * self.period))
        for frame in self.sent:
            codes, active = np.zeros(spec.nodes, int), np.zeros(spec.nodes, bool)
            for node, word in frame.words.items():
                codes[node], active[node] = word, True
            levels = line_chips(spec, codes, active, self.amplitude_v).ravel()
            edges = frame.start + frame.chip * np.arange(levels.size + 1)
            edges += frame.chip * self.rng.uniform(-self.jitter, self.jitter, edges.size)
            at = np.arange(max(0, math.ceil(edges[0])), min(math.ceil(edges[-1]), line.size))
            line[at] += levels[np.searchsorted(edges, at, side="right") - 1]
        swing = (self.amplitude_v or spec.amplitude_v or DEFAULT_AMPLITUDE_V) / (
            1 + (spec.drive == UNIPOLAR)
        )
        sigma = 0.01 * swing
        if rho is not None:
            sigma = math.sqrt(spec.order * self.chip) * swing / rho
        return (line + offset_v + self.rng.normal(0, sigma, line.size)).astype(np.float32)


def gap_timing(spec: FrameSpec, rate_hz: float, rails_v: Rails = None) -> GapTiming:
    return GapTiming(FrameReader(spec, rate_hz, rails_v, side_chips=SIDE_CHIPS), rate_hz)


def words_of(frame: LineFrame) -> dict[int, int]:
    """What the nodes said, in doubt or not."""
    if frame.words is None:
        return {}
    return {int(i): int(frame.words.codes[i]) for i in np.flatnonzero(frame.words.active)}


def run(timing: GapTiming, volts: np.ndarray, cuts: list[int] | None = None) -> list[LineFrame]:
    volts = np.where(np.abs(volts) < ABSURD_V, volts, np.float32(np.nan))
    frames = []
    for begin, end in zip([0, *(cuts or [])], [*(cuts or []), volts.size], strict=True):
        frames += timing.feed(begin, volts[begin:end])
    frames += timing.flush()
    for frame in frames:  # readings are made of the memory
        assert frame.words is None or np.shares_memory(frame.words.doubtful, frame.memory)
    return frames


def check(wire: Wire, frames: list[LineFrame], start_chips: float = 0.1) -> None:
    """Every frame sent was recovered, and nothing else. Point samples blur edges by ±½ sample."""
    talking = [frame for frame in frames if frame.speakers]
    assert [words_of(f) for f in talking] == [s.words for s in wire.sent]
    for frame, sent in zip(talking, wire.sent, strict=True):
        assert frame.start == pytest.approx(sent.start, abs=start_chips * sent.chip)
        end_error = frame.start - sent.start + wire.spec.chips * (frame.chip_samples - sent.chip)
        assert abs(end_error) < start_chips * sent.chip


def same(some: list[LineFrame], others: list[LineFrame]) -> None:
    assert len(some) == len(others)
    for one, other in zip(some, others, strict=True):
        for name in ("start", "chip_samples", "level_v", "clipped", "certificate"):
            assert getattr(one, name) == getattr(other, name), name
        assert (one.words is None) == (other.words is None)
        if one.words is not None and other.words is not None:
            assert words_of(one) == words_of(other)
            assert np.array_equal(one.words.doubtful, other.words.doubtful)


def garbage(kind: str) -> np.ndarray:
    rng, size = np.random.default_rng(13), 40_000
    index = np.arange(size)
    with np.errstate(over="ignore"):
        return {
            "nan": np.full(size, np.nan),
            "some inf": np.where(rng.random(size) < 1e-3, np.inf, 0.0),
            "huge": rng.normal(0, 1e30, size),
            "square": np.sign(np.sin(index / 37)),
            "sine": np.sin(index / 300),
            "ramp": index % 2048 / 100,
            "bursts": rng.normal(0, 1, size) * (index % 2080 < 1330),
            "walk": rng.normal(0, 0.1, size).cumsum(),
            "telegraph": np.repeat(rng.choice([-1.0, 1.0], size // 8), 8),
        }[kind].astype(np.float32)
