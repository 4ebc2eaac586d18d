"""Frame and chip timing against a synthetic line: right words, right times, nothing false."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_cdma.encode import line_chips
from tactile_cdma.errors import SpecError
from tactile_cdma.frame import DEFAULT_AMPLITUDE_V, UNIPOLAR, FrameSpec
from tactile_cdma.gap_timing import GapTiming
from tactile_cdma.line_timing import LineTiming
from tactile_cdma.timing import FrameLevels, SampleBlock
from tactile_cdma.transform import correlate

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
        n = self.spec.nodes
        for i in range(count):
            talking = self.rng.choice(n, nodes or self.rng.integers(1, n + 1), replace=False)
            words = {int(k): int(self.rng.integers(1 << self.spec.bits)) for k in talking}
            late = self.rng.uniform(-wander, wander) * self.chip
            self.send((i + 0.25) * self.period + late, words)

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


def words_of(frame: FrameLevels, spec: FrameSpec) -> dict[int, int]:
    assert frame.levels is not None
    signed = frame.levels.values * spec.signs * spec.polarity
    mean = np.abs(signed).mean(axis=0)
    weights = 1 << np.arange(spec.bits - 1, -1, -1)
    codes = (signed > 0).T @ weights
    return {int(i): int(codes[i]) for i in np.flatnonzero(mean > 0.5 * mean.max())}


def run(timing: GapTiming | LineTiming, volts: np.ndarray, cuts: list[int] | None = None) -> list:
    frames = []
    for begin, end in zip([0, *(cuts or [])], [*(cuts or []), volts.size], strict=True):
        frames += timing.feed(SampleBlock(begin, volts[begin:end]))
    return frames + timing.flush()


def check(wire: Wire, frames: list[FrameLevels], start_chips: float = 0.1) -> None:
    """Every frame sent was recovered, and nothing else. Point samples blur edges by ±½ sample."""
    talking = [frame for frame in frames if frame.levels is not None]
    assert [words_of(f, wire.spec) for f in talking] == [s.words for s in wire.sent]
    for frame, sent in zip(talking, wire.sent, strict=True):
        assert frame.start == pytest.approx(sent.start, abs=start_chips * sent.chip)
        end_error = frame.start - sent.start + wire.spec.chips * (frame.chip_samples - sent.chip)
        assert abs(end_error) < start_chips * sent.chip
        assert frame.levels.values.shape == (wire.spec.line_bits, wire.spec.nodes)
        assert frame.levels.values.dtype == np.float32


@pytest.mark.parametrize("rate", [4.0, 8.13, 10.0, 20.0])
@pytest.mark.parametrize("inverted_level", [0.3, 0.15])
def test_the_papers_words(rate: float, inverted_level: float) -> None:
    wire = Wire(PAPER, rate)
    wire.amplitude_v = inverted_level
    wire.send(90 * rate, {10: 0b0101101110})
    wire.send(90 * rate + wire.period, {3: 0b1000110000, 12: 0b1010011001})
    timing = GapTiming(PAPER, wire.rate_hz)
    # A lone frame's edges are few at few samples per chip.
    check(wire, run(timing, wire.volts()), start_chips=0.05 + 0.5 / rate)
    assert timing.rejected == 0


@pytest.mark.parametrize("node", range(16))
@pytest.mark.parametrize("spec", [PAPER, DEFAULT], ids=["paper", "default"])
def test_every_single_node(spec: FrameSpec, node: int) -> None:
    wire = Wire(spec, 8.13, seed=node)
    words = (0b1111111111, 0, 0b1010101010, 0b0000000001, 0b1000000000, 0b0101101110, 0b1111100000)
    for i, word in enumerate(words):
        wire.send((i + 0.3) * wire.period, {node: word})
    check(wire, run(GapTiming(spec, wire.rate_hz), wire.volts(offset_v=0.7)))


@pytest.mark.parametrize("rate", [5.0, 8.13, 25.0])
@pytest.mark.parametrize("amplitude_v", [0.3, None])
@pytest.mark.parametrize("word", [0b1110000111, 0b1111100000, 0b0000111100, 0b1111111111])
def test_a_first_word_as_quiet_as_the_gap(
    word: int, amplitude_v: float | None, rate: float
) -> None:
    """A lone node on row 0 holds the line at −a and at +a as evenly as the gap at 0."""
    wire = Wire(replace(PAPER, amplitude_v=amplitude_v), rate, seed=word)
    wire.amplitude_v = 0.3
    for i in range(3):
        wire.send((i + 0.25) * wire.period, {0: word ^ i})
    timing = GapTiming(wire.spec, wire.rate_hz)
    volts = wire.volts(rho=60, offset_v=0.7)
    check(wire, run(timing, volts), start_chips=0.25)  # its edges are few
    assert timing.rejected == 0
    inside = int(wire.sent[0].start + wire.rng.uniform(0.1, 0.9) * PAPER.chips * wire.chip)
    frames = [
        f for f in run(GapTiming(wire.spec, wire.rate_hz), volts[inside:]) if f.levels is not None
    ]
    assert [words_of(f, PAPER) for f in frames] == [s.words for s in wire.sent[1:]]


@pytest.mark.parametrize("seed", range(8))
def test_noise_before_a_frame_does_not_hide_it(seed: int) -> None:
    spec = FrameSpec(nodes=4, order=4, first_row=0, frame_period_s=3.2e-3, amplitude_v=None)
    wire = Wire(spec, 8.13, seed)
    for slot in (0, 1, 3, 6, 8, 11):
        wire.send((slot + 0.5) * wire.period, {2: 400 + slot, 3: 77})
    check(wire, run(GapTiming(spec, wire.rate_hz), wire.volts(rho=30)), start_chips=0.2)


@pytest.mark.parametrize("rate", [3.3, 5.0, 8.13, 40.0])
@pytest.mark.parametrize("name", SPECS)
def test_random_words_and_subsets(name: str, rate: float) -> None:
    wire = Wire(SPECS[name], rate, seed=1)
    wire.send_random(10)
    timing = GapTiming(wire.spec, wire.rate_hz)
    check(wire, run(timing, wire.volts(offset_v=-1.3)), start_chips=0.05 + 0.35 / rate)
    assert timing.rejected == 0


@pytest.mark.parametrize("stretch", [0.0, 0.003, 0.05, 0.11])
@pytest.mark.parametrize("nodes", [1, 2, 16])
def test_stretch(stretch: float, nodes: int) -> None:
    wire = Wire(PAPER, 8.13, seed=nodes)
    wire.send_random(6, nodes)
    for sent in wire.sent:
        sent.chip = wire.chip * (1 + stretch)
    check(wire, run(GapTiming(PAPER, wire.rate_hz), wire.volts()))


def test_jitter_and_hum() -> None:
    wire = Wire(PAPER, 8.13, seed=2)
    wire.jitter = 0.1
    wire.send_random(12)
    volts = wire.volts()
    volts += (0.03 * np.sin(2 * np.pi * 50 / wire.rate_hz * np.arange(volts.size))).astype("f4")
    check(wire, run(GapTiming(PAPER, wire.rate_hz), volts), start_chips=0.25)


@pytest.mark.parametrize("name", SPECS)
def test_noise(name: str) -> None:
    wire = Wire(SPECS[name], 8.13, seed=3)
    wire.send_random(12, nodes=12)
    frames = run(GapTiming(wire.spec, wire.rate_hz), wire.volts(rho=10))
    check(wire, frames, start_chips=0.15)


@pytest.mark.parametrize("words", [(483,), (0,), (1023,), (483, 804, 405, 483)])
def test_equal_words_everywhere(words: tuple[int, ...]) -> None:
    """With natural signs few chips per bit are loud, and shifts look much alike."""
    wire = Wire(PAPER, 8.13)
    for i in range(5):
        scene = {node: words[node % len(words)] for node in range(16)}
        wire.send((i + 0.25) * wire.period, scene)
    check(wire, run(GapTiming(PAPER, wire.rate_hz), wire.volts()))


def test_a_larger_book() -> None:
    spec = FrameSpec(nodes=240, chip_s=4e-6)
    wire = Wire(spec, 4.2, seed=4)
    wire.send_random(3)
    wire.send(3.25 * wire.period, {7: 513})
    check(wire, run(GapTiming(spec, wire.rate_hz), wire.volts()), start_chips=0.15)


def test_offset_and_clipping_are_reported() -> None:
    wire = Wire(PAPER, 8.0)
    wire.send_random(3, nodes=16, wander=0)
    volts = wire.volts(offset_v=0.4)
    rails = (-1.5, 2.3)
    frames = run(GapTiming(PAPER, wire.rate_hz, rails), np.clip(volts, *rails))
    check(wire, frames)
    for frame, sent in zip(frames, wire.sent, strict=False):
        assert frame.offset_v == pytest.approx(0.4, abs=1e-3)
        inside = volts[round(sent.start) : round(sent.start + PAPER.chips * sent.chip)]
        assert frame.clipped == pytest.approx(np.mean((inside < -1.5) | (inside > 2.3)), abs=0.01)


@settings(max_examples=25, deadline=None)
@given(st.data())
def test_chunking_is_invisible(data: st.DataObject) -> None:
    wire = Wire(PAPER, 5.1, seed=5)
    wire.send_random(3)
    wire.send(5.25 * wire.period, {2: 77})
    volts = wire.volts(rho=12)
    cuts = sorted(data.draw(st.lists(st.integers(0, volts.size), max_size=30)))
    whole = run(GapTiming(PAPER, wire.rate_hz), volts)
    _same(run(GapTiming(PAPER, wire.rate_hz), volts, cuts), whole)
    assert sum(frame.levels is None for frame in whole) >= 2


def test_sample_by_sample() -> None:
    wire = Wire(DEFAULT, 3.1, seed=6)
    wire.send_random(2)
    volts = wire.volts()
    whole = run(GapTiming(DEFAULT, wire.rate_hz), volts)
    _same(run(GapTiming(DEFAULT, wire.rate_hz), volts, list(range(1, volts.size))), whole)


def _same(some: list[FrameLevels], others: list[FrameLevels]) -> None:
    assert len(some) == len(others)
    for one, other in zip(some, others, strict=True):
        assert (one.start, one.chip_samples, one.offset_v, one.clipped) == (
            other.start,
            other.chip_samples,
            other.offset_v,
            other.clipped,
        )
        assert np.array_equal(one.noise_rms_v, other.noise_rms_v, equal_nan=True)
        if one.levels is None or other.levels is None:
            assert one.levels is other.levels
        else:
            assert np.array_equal(one.levels.values, other.levels.values)
            assert one.levels.noise_v == other.levels.noise_v


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.99])
def test_a_recording_that_begins_within_a_frame(share: float) -> None:
    wire = Wire(PAPER, 8.13, seed=7)
    wire.send_random(4)
    cut = int(wire.sent[0].start + share * PAPER.chips * wire.sent[0].chip)
    volts = wire.volts()[cut:]
    frames = [f for f in run(GapTiming(PAPER, wire.rate_hz), volts) if f.levels is not None]
    assert [words_of(f, PAPER) for f in frames] == [s.words for s in wire.sent[1:]]


@pytest.mark.parametrize("tail", [0.0, 3.0, 500.0])
def test_a_single_frame_that_ends_the_recording(tail: float) -> None:
    wire = Wire(PAPER, 8.13, seed=8)
    wire.send(350.0, {1: 300, 5: 700, 9: 1})
    end = wire.sent[0].start + PAPER.chips * wire.sent[0].chip
    check(wire, run(GapTiming(PAPER, wire.rate_hz), wire.volts(length=end + tail)))


def test_a_frame_cut_short_is_no_frame() -> None:
    wire = Wire(PAPER, 8.13, seed=9)
    wire.send(350.0, {1: 300, 5: 700, 9: 1}, stretch=0.05)
    end = wire.sent[0].start + 0.95 * PAPER.chips * wire.sent[0].chip
    frames = run(GapTiming(PAPER, wire.rate_hz), wire.volts(length=end))
    assert all(frame.levels is None for frame in frames)


def test_a_hole_costs_one_frame() -> None:
    wire = Wire(PAPER, 8.13, seed=10)
    wire.send_random(6)
    volts = wire.volts()
    hole = int(wire.sent[2].start + 400), int(wire.sent[2].start + 700)
    timing = GapTiming(PAPER, wire.rate_hz)
    frames = timing.feed(SampleBlock(0, volts[: hole[0]]))
    frames += timing.feed(SampleBlock(hole[1], volts[hole[1] :])) + timing.flush()
    del wire.sent[2]
    check(wire, frames)


def test_silent_slots_keep_the_raster() -> None:
    wire = Wire(PAPER, 8.0, seed=11)
    wire.send(3.25 * wire.period, {4: 1000})
    wire.send(7.25 * wire.period, {4: 1001})
    frames = run(GapTiming(PAPER, wire.rate_hz), wire.volts(length=12 * wire.period))
    check(wire, frames)
    slots = [frame.start / wire.period for frame in frames]
    assert slots == pytest.approx([0, 1, 2, *np.arange(3.25, 12)], abs=0.05)
    assert [f.levels is None for f in frames] == [True] * 3 + [False] + [True] * 3 + [False] + [
        True
    ] * 4


@pytest.mark.parametrize("amplitude_v", [0.3, None])
@pytest.mark.parametrize("noise_v", [0.0, 0.001, 1.0])
def test_noise_alone_is_silence(noise_v: float, amplitude_v: float | None) -> None:
    spec = replace(PAPER, amplitude_v=amplitude_v)
    volts = np.random.default_rng(12).normal(0.5, noise_v, 60_000).astype(np.float32)
    timing = GapTiming(spec, 8.13 / spec.chip_s)
    frames = run(timing, volts)
    assert len(frames) == pytest.approx(60_000 / (256 * 8.13), abs=2)
    assert all(frame.levels is None for frame in frames)


def _garbage(kind: str) -> np.ndarray:
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


GARBAGE = ["nan", "some inf", "huge", "square", "sine", "ramp", "bursts", "telegraph"]
ROW_0_FREE = replace(DEFAULT, amplitude_v=None)


# A wandering line is a word on row 0 once in a while: it is no garbage where that row is assigned.
@pytest.mark.parametrize(
    ("kind", "spec"),
    [(kind, PAPER) for kind in GARBAGE] + [(kind, ROW_0_FREE) for kind in [*GARBAGE, "walk"]],
)
def test_garbage_gives_no_words(kind: str, spec: FrameSpec) -> None:
    frames = run(GapTiming(spec, 8.13 / spec.chip_s), _garbage(kind))
    assert all(frame.levels is None for frame in frames)


def test_frames_after_garbage() -> None:
    wire = Wire(PAPER, 8.13, seed=14)
    wire.send_random(10)
    volts = np.concatenate((_garbage("telegraph"), _garbage("nan"), wire.volts(offset_v=2.0)))
    frames = [f for f in run(GapTiming(PAPER, wire.rate_hz), volts) if f.levels is not None]
    found = [words_of(f, PAPER) for f in frames]
    assert len(found) >= 6
    assert found == [s.words for s in wire.sent][-len(found) :]


def test_what_cannot_work_is_refused() -> None:
    with pytest.raises(SpecError, match="samples per chip"):
        GapTiming(PAPER, 1.5 / PAPER.chip_s)
    with pytest.raises(SpecError, match="gap"):
        GapTiming(replace(PAPER, frame_period_s=8.1e-3), 8 / PAPER.chip_s)
    with pytest.raises(SpecError, match="line timing"):
        LineTiming(PAPER, 1.4 / PAPER.chip_s)


# Line timing


def feed_marked(
    timing: LineTiming, volts: np.ndarray, starts: list[int], cuts: list[int]
) -> list[FrameLevels]:
    frames = []
    bounds = sorted({0, *starts, *cuts, volts.size})
    for begin, end in pairwise(bounds):
        frames += timing.feed(SampleBlock(begin, volts[begin:end], begin in starts))
    return frames + timing.flush()


def marked(
    spec: FrameSpec,
    samples_per_chip: float,
    stretch: float,
    seed: int = 0,
    frames: int = 6,
    nodes: int | None = None,
) -> Wire:
    wire = Wire(spec, samples_per_chip, seed)
    wire.send_random(frames, nodes, wander=0)
    for sent in wire.sent:
        sent.start = math.ceil(sent.start) - (0.0 if stretch == 0 else wire.rng.uniform(0, 0.9))
        sent.chip = samples_per_chip * (1 + stretch)
    return wire


@pytest.mark.parametrize("rate", [4.0, 8.0, 8.13])
@pytest.mark.parametrize("stretch", [0.0, 0.004, 0.06, 0.11])
@pytest.mark.parametrize("name", SPECS)
def test_marked_frames(name: str, stretch: float, rate: float) -> None:
    wire = marked(SPECS[name], rate, stretch, seed=20)
    starts = [math.ceil(sent.start) for sent in wire.sent]
    timing = LineTiming(wire.spec, wire.rate_hz)
    frames = feed_marked(timing, wire.volts(), starts, [])
    assert [words_of(f, wire.spec) for f in frames] == [s.words for s in wire.sent]
    assert [f.start for f in frames] == pytest.approx(starts, abs=1.0)
    assert timing.rejected == 0


def test_a_marked_frame_comes_three_chips_after_its_end() -> None:
    wire = marked(PAPER, 8.0, 0.0)
    start, volts, timing = int(wire.sent[0].start), wire.volts(), LineTiming(PAPER, wire.rate_hz)
    end = start + 8 * PAPER.chips
    assert timing.feed(SampleBlock(start, volts[start:end], sync=True)) == []
    assert len(timing.feed(SampleBlock(end, volts[end : end + 3 * 8 + 2]))) == 1


@pytest.mark.parametrize("name", SPECS)
@pytest.mark.parametrize("rate", [4.0, 8.13])
def test_stretched_marked_frames_are_right_or_rejected(name: str, rate: float) -> None:
    """With one or two nodes few level changes tell the stretch: a wrong one must not pass."""
    spec = SPECS[name]
    for stretch, nodes in itertools.product((0.005, 0.03, 0.1), (1, 2)):
        wire = marked(spec, rate, stretch, seed=31, frames=40, nodes=nodes)
        starts = [math.ceil(sent.start) for sent in wire.sent]
        timing = LineTiming(spec, wire.rate_hz)
        frames = feed_marked(timing, wire.volts(), starts, [])
        sent = {start: one.words for start, one in zip(starts, wire.sent, strict=True)}
        wrong = 0
        for frame in frames:
            nearest = min(starts, key=lambda start, frame=frame: abs(start - frame.start))
            wrong += words_of(frame, spec) != sent[nearest]
        assert wrong <= 1  # waveforms can tie
        assert len(frames) + timing.rejected == len(starts)
        assert len(frames) >= 38


def test_words_of_more_bits_than_specified_are_rejected() -> None:
    wire = marked(DEFAULT, 8.0, 0.0, seed=32, frames=60, nodes=8)
    starts = [math.ceil(sent.start) for sent in wire.sent]
    timing = LineTiming(replace(DEFAULT, bits=9), wire.rate_hz)
    frames = feed_marked(timing, wire.volts(), starts, [])
    assert len(frames) <= 4  # the sum of the nodes may cancel for three chips
    assert timing.rejected >= 56


def test_integrated_chips_of_stretched_frames_are_rejected() -> None:
    """One value per chip cannot follow a stretch; what does not fit the book is not believed."""
    rng = np.random.default_rng(33)
    timing, index = LineTiming(DEFAULT, 1 / DEFAULT.chip_s), 0
    for _ in range(30):
        chips = line_chips(DEFAULT, rng.integers(0, 1024, 16)).ravel()
        late = np.interp(np.arange(chips.size) / 1.05, np.arange(chips.size), chips)
        timing.feed(SampleBlock(index, late.astype(np.float32), sync=True))
        index += chips.size
    assert timing.rejected >= 29


@pytest.mark.parametrize("spec", [PAPER, DEFAULT], ids=["paper", "default"])
def test_integrated_chips(spec: FrameSpec) -> None:
    rng = np.random.default_rng(21)
    codes = rng.integers(0, 1024, (3, 16))
    chips = [line_chips(spec, row) for row in codes]
    line = np.concatenate([np.append(c.ravel(), np.zeros(50, np.float32)) for c in chips]) + 0.25
    starts = [i * (spec.chips + 50) for i in range(3)]
    timing = LineTiming(spec, 1 / spec.chip_s)
    frames = feed_marked(timing, line.astype(np.float32), starts, [7, 100, 333])
    first = 0.0 if spec.first_row == 0 else 0.25  # row 0 in use: known from the first gap on
    assert [f.offset_v for f in frames] == pytest.approx([first, 0.25, 0.25], abs=1e-6)
    for frame, sent in zip(frames[1:], chips[1:], strict=True):
        expected = correlate(sent, spec.book)[:, spec.rows]
        np.testing.assert_allclose(frame.levels.values, expected, atol=1e-5)
    assert words_of(frames[2], spec) == dict(enumerate(codes[2].tolist()))


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(0, 7000), max_size=20), st.sampled_from([0.0, 0.07]))
def test_chunking_is_invisible_with_marks(cuts: list[int], stretch: float) -> None:
    wire = marked(PAPER, 4.0, stretch, seed=22)
    volts, starts = wire.volts(rho=15), [math.ceil(sent.start) for sent in wire.sent]
    whole = feed_marked(LineTiming(PAPER, wire.rate_hz), volts, starts, [])
    cuts = [cut for cut in cuts if cut < volts.size]
    _same(feed_marked(LineTiming(PAPER, wire.rate_hz), volts, starts, cuts), whole)


def test_a_mark_within_a_frame_rejects_it() -> None:
    wire = marked(PAPER, 8.0, 0.0, seed=23)
    starts = [int(sent.start) for sent in wire.sent]
    timing = LineTiming(PAPER, wire.rate_hz)
    frames = feed_marked(timing, wire.volts(), [starts[0] - 300, *starts], [])
    assert timing.rejected == 1
    assert [words_of(f, PAPER) for f in frames] == [s.words for s in wire.sent]


def test_marked_silence_and_garbage() -> None:
    rng = np.random.default_rng(24)
    starts = list(range(100, 18_000, 2048))
    quiet = rng.normal(0, 0.01, 20_000).astype(np.float32)
    frames = feed_marked(LineTiming(PAPER, 8 / PAPER.chip_s), quiet, starts, [])
    assert len(frames) == len(starts)
    assert all(frame.levels is None for frame in frames)
    for kind in ("nan", "huge", "walk"):
        timing = LineTiming(DEFAULT, 8 / PAPER.chip_s)  # a drifting line is a word on row 0
        frames = feed_marked(timing, _garbage(kind)[:20_000], starts, [])
        assert all(frame.levels is None for frame in frames)
        assert timing.rejected >= len(starts) - 1


def test_a_hole_forgets_the_marked_frame() -> None:
    timing = LineTiming(PAPER, 1 / PAPER.chip_s)
    timing.feed(SampleBlock(0, np.ones(50, np.float32), sync=True))
    assert timing.feed(SampleBlock(60, np.ones(200, np.float32))) == []
    assert timing.rejected == 1
