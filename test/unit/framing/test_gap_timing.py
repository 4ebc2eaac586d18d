# SPDX-License-Identifier: Apache-2.0

"""Gap timing on a synthetic line: right words, right times, nothing invented."""

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from benchmarks.doubt.tally import Tally
from benchmarks.doubt.words import compare, decode
from tactile_cdma.base.errors import SpecError
from tactile_cdma.code.encode import word_bits
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.framing.frames import LineFrame
from tactile_cdma.framing.frames import words_of as words_in
from tactile_cdma.framing.gaps.search import GapSearch
from tactile_cdma.framing.raster import Raster
from test.support.examples import examples
from test.support.independent_line import Digitizer, Line, Skin, Talk, render
from test.support.synthetic_line import (
    DEFAULT,
    PAPER,
    SPECS,
    Wire,
    check,
    gap_timing,
    garbage,
    run,
    same,
    words_of,
)


def heard(spec: FrameSpec, rate_hz: float, volts: np.ndarray) -> list[dict[int, int]]:
    """The words of every frame in which somebody speaks."""
    frames = run(gap_timing(spec, rate_hz), volts)
    return [words_of(frame) for frame in frames if frame.speakers]


@pytest.mark.parametrize("rate", [4.0, 8.13, 10.0, 20.0])
@pytest.mark.parametrize("inverted_level", [0.3, 0.2])
def test_the_papers_words(rate: float, inverted_level: float) -> None:
    wire = Wire(PAPER, rate)
    wire.amplitude_v = inverted_level
    wire.send(90 * rate, {10: 0b0101101110})
    wire.send(90 * rate + wire.period, {3: 0b1000110000, 12: 0b1010011001})
    timing = gap_timing(PAPER, wire.rate_hz)
    # A lone frame's edges are few at few samples per chip.
    check(wire, run(timing, wire.volts()), start_chips=0.05 + 0.5 / rate)
    assert timing.rejections.total == 0


@pytest.mark.parametrize("node", range(16))
@pytest.mark.parametrize("spec", [PAPER, DEFAULT], ids=["paper", "default"])
def test_every_single_node(spec: FrameSpec, node: int) -> None:
    wire = Wire(spec, 8.13, seed=node)
    words = (0b1111111111, 0, 0b1010101010, 0b0000000001, 0b1000000000, 0b0101101110, 0b1111100000)
    for i, word in enumerate(words):
        wire.send((i + 0.3) * wire.period, {node: word})
    check(wire, run(gap_timing(spec, wire.rate_hz), wire.volts(offset_v=0.7)))


@pytest.mark.parametrize("rate", [5.0, 8.13, 25.0])
@pytest.mark.parametrize("amplitude_v", [0.3, None])
@pytest.mark.parametrize("word", [0b1110000111, 0b1111100000, 0b0000111100, 0b1111111111])
def test_a_first_word_as_quiet_as_a_gap(word: int, amplitude_v: float | None, rate: float) -> None:
    """A lone node on row 0 holds the line at −a and at +a as evenly as the gap at 0."""
    wire = Wire(replace(PAPER, amplitude_v=amplitude_v), rate, seed=word)
    wire.amplitude_v = 0.3
    for i in range(3):
        wire.send((i + 0.25) * wire.period, {0: word ^ i})
    timing = gap_timing(wire.spec, wire.rate_hz)
    volts = wire.volts(rho=60, offset_v=0.7)
    check(wire, run(timing, volts), start_chips=0.25)  # its edges are few
    assert timing.rejections.total == 0
    inside = int(wire.sent[0].start + wire.rng.uniform(0.1, 0.9) * PAPER.chips * wire.chip)
    found = run(gap_timing(wire.spec, wire.rate_hz), volts[inside:])
    certain = [words_of(frame) for frame in found if frame.speakers and not is_doubtful(frame)]
    assert certain == [s.words for s in wire.sent[1:]]  # the rest of the first one may be another


def test_silent_frames_that_the_raster_places_begin_there() -> None:
    wire = Wire(DEFAULT, 4.0, seed=25)
    for slot in range(60):
        if slot < 40 or slot % 2:
            words = dict(enumerate(wire.rng.integers(0, 1024, 16).tolist()))
            wire.send((slot + 0.25) * wire.period, words, stretch=0.0)
    frames = run(gap_timing(DEFAULT, wire.rate_hz), wire.volts())
    assert sum(frame.words is None for frame in frames) >= 9
    for frame in frames:
        slot = frame.start / wire.period - 0.25
        assert slot == pytest.approx(round(slot), abs=2 * wire.chip / wire.period)


@pytest.mark.parametrize("rho", [60, 8])
@pytest.mark.parametrize("jitter_chips", [0, 1])
def test_frames_where_the_raster_expects_them_are_those_that_a_search_finds(
    jitter_chips: int, rho: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    wire = Wire(DEFAULT, 4.0, seed=24)
    for slot in range(60):
        late = wire.chip * wire.rng.integers(0, jitter_chips + 1)
        wire.send((slot + 0.25) * wire.period + late, wire.words(), stretch=0.03)
    volts = wire.volts(rho=rho)
    found = run(gap_timing(DEFAULT, wire.rate_hz), volts)
    monkeypatch.setattr(Raster, "expect", lambda *_: None)
    searched = run(gap_timing(DEFAULT, wire.rate_hz), volts)
    assert sum(bool(frame.speakers) for frame in found) >= 55
    for one, other in zip(found, searched, strict=True):
        assert one.start == pytest.approx(other.start, abs=0.1 * wire.chip)
        assert words_of(one) == words_of(other)


@pytest.mark.parametrize("nodes", [16, 3])
def test_frames_on_a_known_raster_are_not_searched_for_whatever_their_stretch(nodes: int) -> None:
    wire = Wire(DEFAULT, 4.0, seed=26)
    for slot in range(80):
        words = wire.words(nodes)
        wire.send((slot + 0.25) * wire.period, words, stretch=wire.rng.uniform(0, 0.1))
    with patch.object(GapSearch, "frame", autospec=True, side_effect=GapSearch.frame) as search:
        check(wire, run(gap_timing(DEFAULT, wire.rate_hz), wire.volts(rho=60)), start_chips=0.15)
    assert 30 <= search.call_count <= 45  # the first ones, and those whose last chips cancel


@pytest.mark.parametrize("seed", range(8))
def test_noise_before_a_frame_does_not_hide_it(seed: int) -> None:
    spec = FrameSpec(nodes=4, order=4, first_row=0, frame_period_s=3.2e-3, amplitude_v=None)
    wire = Wire(spec, 8.13, seed)
    for slot in (0, 1, 3, 6, 8, 11):
        wire.send((slot + 0.5) * wire.period, {2: 400 + slot, 3: 77})
    check(wire, run(gap_timing(spec, wire.rate_hz), wire.volts(rho=30)), start_chips=0.2)


@pytest.mark.parametrize(
    ("slots", "seeds", "rho"),
    [((3, 5), range(8), 500), ((3, 5), range(8), 12), ((0, 1, 3, 5, 7, 9, 11), (4, 22, 51), 500)],
    ids=["before frames", "before frames in noise", "between frames"],
)
def test_silence_has_no_burst(slots: tuple[int, ...], seeds: Iterable[int], rho: float) -> None:
    """Of many windows the quietest shows half of the noise, of which the rest then stands out."""
    for seed in seeds:
        wire = Wire(replace(DEFAULT, amplitude_v=None), 4.0, seed)
        for slot in slots:
            wire.send((slot + 0.25) * wire.period, {seed % 16: 37 * slot + 77}, stretch=0.0)
        timing = gap_timing(wire.spec, wire.rate_hz)
        frames = run(timing, wire.volts(rho=rho, length=(slots[-1] + 4) * wire.period))
        assert [words_of(frame) for frame in frames if frame.speakers] == [
            sent.words for sent in wire.sent
        ]
        assert timing.rejections.total == 0


@pytest.mark.parametrize(
    ("rate", "nodes", "rho"), [(3.3, None, None), (5, None, None), (40, None, None), (8.13, 12, 10)]
)
@pytest.mark.parametrize("name", SPECS)
def test_random_words(name: str, rate: float, nodes: int | None, rho: float | None) -> None:
    wire = Wire(SPECS[name], rate, seed=1)
    wire.send_random(10, nodes)
    timing = gap_timing(wire.spec, wire.rate_hz)
    check(wire, run(timing, wire.volts(rho=rho, offset_v=-1.3)), 0.05 + (0.35 + bool(rho)) / rate)
    assert timing.rejections.total == 0


def test_jitter_and_hum() -> None:
    wire = Wire(PAPER, 8.13, seed=2)
    wire.jitter = 0.1
    wire.send_random(12)
    volts = wire.volts()
    volts += (0.03 * np.sin(2 * np.pi * 50 / wire.rate_hz * np.arange(volts.size))).astype("f4")
    check(wire, run(gap_timing(PAPER, wire.rate_hz), volts), start_chips=0.25)


@pytest.mark.parametrize("words", [(483,), (0,), (1023,), (483, 804, 405, 483)])
def test_equal_words_everywhere(words: tuple[int, ...]) -> None:
    """With natural signs few chips per bit are loud, and shifts look much alike."""
    wire = Wire(PAPER, 8.13)
    for i in range(5):
        scene = {node: words[node % len(words)] for node in range(16)}
        wire.send((i + 0.25) * wire.period, scene)
    check(wire, run(gap_timing(PAPER, wire.rate_hz), wire.volts()))


def test_offset_and_clipping_are_reported() -> None:
    wire = Wire(PAPER, 8.0)
    wire.send_random(3, nodes=16, wander=0)
    volts = wire.volts(offset_v=0.4)
    rails = (-1.5, 2.3)
    frames = run(gap_timing(PAPER, wire.rate_hz, rails), np.clip(volts, *rails))
    check(wire, frames)
    for frame, sent in zip(frames, wire.sent, strict=False):
        assert frame.level_v == pytest.approx(0.4, abs=1e-3)
        inside = volts[round(sent.start) : round(sent.start + PAPER.chips * sent.chip)]
        assert frame.clipped == pytest.approx(np.mean((inside < -1.5) | (inside > 2.3)), abs=0.01)


def test_a_silence_in_doubt_is_read_as_what_it_says() -> None:
    """Readings are made of a frame's memory: no word of another frame, or of none, is in it."""
    wire = Wire(PAPER, 5.1, seed=5)
    wire.send_random(3)
    wire.send(5.25 * wire.period, {2: 77})
    frames = run(gap_timing(PAPER, wire.rate_hz), wire.volts(rho=12))
    doubted = [frame for frame in frames if not frame.speakers]
    assert len(doubted) >= 2
    for frame in doubted:
        told = words_in(frame.memory, PAPER.nodes, frame.noise_rms_v)
        assert frame.words is not None and frame.words.doubtful.all() and told.doubtful.all()
        assert not told.active.any() and not told.codes.any() and not told.amplitude_v.any()


def on_a_raster(slots: range, silent: tuple[int, ...] = ()) -> Wire:
    """A stream that is timed by crystals, long enough for its raster to be known."""
    wire = Wire(DEFAULT, 4.0, seed=23)
    for slot in slots:
        words = wire.words(12)
        if slot not in silent:
            wire.send((slot + 0.25) * wire.period, words, stretch=0.0)
    return wire


def test_a_frame_is_out_once_silence_proves_its_end() -> None:
    wire = on_a_raster(range(45))
    timing, volts, late, before = gap_timing(DEFAULT, wire.rate_hz), wire.volts(rho=400), [], 0
    for begin in range(0, volts.size, 4):
        due = timing.due
        frames = timing.feed(begin, volts[begin : begin + 4])
        assert not frames or begin + 4 >= due > before
        before = begin + 4
        for frame in frames:
            end = frame.start + DEFAULT.span_chips * frame.chip_samples
            late += [] if not frame.speakers else [(begin + 4 - end) / frame.chip_samples]
    assert len(late) == 45
    assert max(late[:30]) > 15  # until the raster is known
    assert max(late[35:]) < 6


@cache
def line_of(kind: str) -> tuple[Wire, np.ndarray, list[LineFrame]]:
    """A line of this kind, its samples, and the frames that they are as a whole."""
    if kind == "raster":
        wire = on_a_raster(range(48), silent=(36, 40, 41))
        volts = wire.volts(rho=200)
    else:
        wire = Wire(PAPER, 5.1, seed=5)
        wire.send_random(3 if kind == "noise" else 12)
        wire.send(wire.sent[-1].start + 3 * wire.period, {2: 77})
        volts = wire.volts(rho=12 if kind == "noise" else 30)
    if kind == "hum and impulses":
        volts += (0.1 * np.sin(2 * np.pi * 50 / wire.rate_hz * np.arange(volts.size))).astype("f4")
        at = wire.rng.integers(0, volts.size, volts.size // 100)
        volts[at] += wire.rng.choice([-1.0, 1.0], at.size).astype("f4")
    whole = run(gap_timing(wire.spec, wire.rate_hz), volts)
    if kind == "raster":
        check(wire, whole, start_chips=0.15)
    assert sum(not frame.speakers for frame in whole) >= (0 if "hum" in kind else 2)
    assert sum(bool(frame.speakers) for frame in whole) >= (8 if "hum" in kind else 3)
    return wire, volts, whole


@examples(40)
@given(
    st.sampled_from(["noise", "raster", "hum and impulses"]),
    st.lists(st.integers(0, 50_000), max_size=60).map(sorted),
)
@example("noise", [*range(1, 2600)])
@example("noise", [5173])
@example("hum and impulses", [*range(50, 20_000, 97)])
def test_chunking_is_invisible(kind: str, cuts: list[int]) -> None:
    wire, volts, whole = line_of(kind)
    timing = gap_timing(wire.spec, wire.rate_hz)
    same(run(timing, volts, [min(cut, volts.size) for cut in cuts]), whole)


def test_the_log_tells_when_the_raster_places_frames(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("DEBUG", logger="tactile_cdma.framing.gaps.gap_timing")
    wire = on_a_raster(range(45))
    timing, volts = gap_timing(DEFAULT, wire.rate_hz), wire.volts(rho=400)
    timing.feed(0, volts)
    assert "raster places frames" in caplog.text and "raster is lost" not in caplog.text
    noise = wire.rng.normal(0, 3, round(9 * wire.period)).astype(np.float32)
    timing.feed(volts.size, noise)
    timing.feed(10**9, noise)
    assert "no frame up to sample" in caplog.text and "raster is lost" in caplog.text


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.99])
def test_a_recording_that_begins_within_a_frame(share: float) -> None:
    wire = Wire(PAPER, 8.13, seed=7)
    wire.send_random(4)
    cut = int(wire.sent[0].start + share * PAPER.chips * wire.sent[0].chip)
    found = heard(PAPER, wire.rate_hz, wire.volts()[cut:])
    assert found == [s.words for s in wire.sent[1:]]


@pytest.mark.parametrize("tail", [0.0, 3.0, 500.0])
def test_a_single_frame_that_ends_the_recording(tail: float) -> None:
    wire = Wire(PAPER, 8.13, seed=8)
    wire.send(350.0, {1: 300, 5: 700, 9: 1})
    end = wire.sent[0].start + PAPER.chips * wire.sent[0].chip
    check(wire, run(gap_timing(PAPER, wire.rate_hz), wire.volts(length=end + tail)))


def test_a_frame_cut_short_is_no_frame() -> None:
    wire = Wire(PAPER, 8.13, seed=9)
    wire.send(350.0, {1: 300, 5: 700, 9: 1}, stretch=0.05)
    end = wire.sent[0].start + 0.95 * PAPER.chips * wire.sent[0].chip
    frames = run(gap_timing(PAPER, wire.rate_hz), wire.volts(length=end))
    assert all(not frame.speakers for frame in frames)


def test_a_hole_costs_one_frame() -> None:
    wire = Wire(PAPER, 8.13, seed=10)
    wire.send_random(6)
    volts = wire.volts()
    hole = int(wire.sent[2].start + 400), int(wire.sent[2].start + 700)
    timing = gap_timing(PAPER, wire.rate_hz)
    frames = timing.feed(0, volts[: hole[0]])
    frames += timing.feed(hole[1], volts[hole[1] :]) + timing.flush()
    del wire.sent[2]
    check(wire, frames)


@pytest.mark.parametrize(("rho", "told"), [(1.0, False), (4.0, False), (10.0, True)])
def test_a_slot_in_noise_that_hides_words_is_not_called_silent(rho: float, told: bool) -> None:
    noise_v = 0.3 * math.sqrt(DEFAULT.order * 4) / rho
    volts = np.random.default_rng(6).normal(0, noise_v, 20 * 1024).astype(np.float32)
    timing = gap_timing(replace(DEFAULT, amplitude_v=0.3), 4 / DEFAULT.chip_s)
    frames = timing.feed(0, volts) + timing.flush()
    assert any(not frame.speakers for frame in frames) == told
    assert len(frames) + timing.rejections.total > 10


@pytest.mark.parametrize("rho", [2.8, 4.5])
def test_a_lone_node_that_noise_hides_is_not_called_silent(rho: float) -> None:
    """A burst is found by its power, which a lone node hardly adds to that of the noise."""
    wire = Wire(DEFAULT, 4.0, seed=21)
    for slot in range(60):
        wire.send((slot + 0.3) * wire.period, {3: 37 * slot % 1024}, stretch=0.0)
    timing = gap_timing(DEFAULT, wire.rate_hz)
    frames = run(timing, wire.volts(rho=rho))
    silent = [frame for frame in frames if frame.words is None]
    assert len(frames) + timing.rejections.total > 50
    assert len(silent) <= 1  # the slot that the recording begins or ends with


def test_a_slot_in_which_a_node_may_have_spoken_faintly_fails_its_certificate() -> None:
    """A node at a fifth of its 0.3 V makes no burst."""
    wire = Wire(DEFAULT, 4.0, seed=22)
    for slot in range(60):
        words = dict(enumerate(wire.rng.integers(0, 1024, 16).tolist()))
        wire.send((slot + 0.3) * wire.period, words, stretch=0.0)
    volts = wire.volts()
    wire.amplitude_v, wire.sent = 0.06, []
    for slot in range(60, 90):
        wire.send((slot + 0.3) * wire.period, {3: 37 * slot % 1024}, stretch=0.0)
    volts = np.concatenate((volts, wire.volts()[volts.size :]))
    faint = [f for f in run(gap_timing(DEFAULT, wire.rate_hz), volts) if not f.speakers]
    assert len(faint) > 20
    for frame in faint[1:]:
        assert frame.words is not None and frame.words.doubtful.all()
        assert frame.certificate is not None and not frame.certificate.holds


def test_silent_slots_keep_the_raster() -> None:
    wire = Wire(PAPER, 8.0, seed=11)
    wire.send(3.25 * wire.period, {4: 1000})
    wire.send(7.25 * wire.period, {4: 1001})
    frames = run(gap_timing(PAPER, wire.rate_hz), wire.volts(length=12 * wire.period))
    check(wire, frames)
    slots = [frame.start / wire.period for frame in frames]
    assert slots == pytest.approx([0, 1, 2, *np.arange(3.25, 12)], abs=0.05)
    assert [bool(f.speakers) for f in frames] == [slot in (3, 7) for slot in range(12)]


@pytest.mark.parametrize("amplitude_v", [0.3, None])
@pytest.mark.parametrize("noise_v", [0.0, 0.001, 0.3])
def test_noise_alone_is_silence(noise_v: float, amplitude_v: float | None) -> None:
    spec = replace(PAPER, amplitude_v=amplitude_v)
    volts = np.random.default_rng(12).normal(0.5, noise_v, 60_000).astype(np.float32)
    timing = gap_timing(spec, 8.13 / spec.chip_s)
    frames = run(timing, volts)
    assert len(frames) == pytest.approx(60_000 / (256 * 8.13), abs=2)
    assert all(not frame.speakers for frame in frames)


GARBAGE = ["nan", "some inf", "huge", "square", "sine", "ramp", "bursts", "telegraph"]
ROW_0_FREE = replace(DEFAULT, amplitude_v=None)


# A wandering line is a word on row 0 once in a while: it is no garbage where that row is assigned.
@pytest.mark.parametrize(
    ("kind", "spec"),
    [(kind, PAPER) for kind in GARBAGE] + [(kind, ROW_0_FREE) for kind in [*GARBAGE, "walk"]],
)
def test_garbage_gives_no_words(kind: str, spec: FrameSpec) -> None:
    frames = run(gap_timing(spec, 8.13 / spec.chip_s), garbage(kind))
    assert all(not frame.speakers for frame in frames)


def test_frames_after_garbage() -> None:
    wire = Wire(PAPER, 8.13, seed=14)
    wire.send_random(10)
    volts = np.concatenate((garbage("telegraph"), garbage("nan"), wire.volts(offset_v=2.0)))
    found = heard(PAPER, wire.rate_hz, volts)
    assert len(found) >= 6
    assert found == [s.words for s in wire.sent][-len(found) :]


def test_what_cannot_work_is_refused() -> None:
    with pytest.raises(SpecError, match="samples per chip"):
        gap_timing(PAPER, 1.5 / PAPER.chip_s)
    with pytest.raises(SpecError, match="gap"):
        gap_timing(replace(PAPER, frame_period_s=8.1e-3), 8 / PAPER.chip_s)


@pytest.mark.parametrize(
    ("spec", "frames"),
    [(PAPER, 150), (DEFAULT, 150), (FrameSpec(nodes=256, order=256, first_row=0, chip_s=4e-6), 6)],
    ids=["paper", "default", "256"],
)
def test_bit_errors_stay_within_half_a_decibel_of_the_bound(spec: FrameSpec, frames: int) -> None:
    """Q(ρ) is what a matched filter with perfect timing gets wrong (signal model)."""
    rho, wrong, bits = 2.8, 0, 0
    for seed in range(frames):
        wire = Wire(spec, 8.13, seed)
        gap = wire.period - 1.11 * spec.chips * wire.chip
        codes = wire.rng.integers(1 << spec.bits, size=spec.nodes)
        stretch = wire.rng.uniform(0, 0.11)
        wire.send(gap * wire.rng.uniform(1, 2), dict(enumerate(codes.tolist())), stretch)
        # The same ρ for every frame: longer chips take more noise.
        volts = wire.volts(rho=rho / math.sqrt(1 + stretch))
        (frame,) = run(gap_timing(spec, wire.rate_hz), volts)
        assert abs(frame.start - wire.sent[0].start) < 0.2 * wire.chip
        assert frame.words is not None
        said = word_bits(frame.words.codes, spec.bits)[frame.words.active]
        wrong += np.count_nonzero(said != word_bits(codes, spec.bits)[frame.words.active])
        bits += said.size
    half_a_decibel = 10 ** (-0.5 / 20)
    assert wrong / bits < 0.5 * math.erfc(rho * half_a_decibel / math.sqrt(2))


def is_doubtful(frame: LineFrame) -> bool:
    assert frame.words is not None
    return bool(frame.words.doubtful.any())


TIES = [{0: 500, 1: 500}, {0: 500, 1: 1023 ^ 500}, {4: 77, 6: 77}, {2: 9, 10: 1023 ^ 9}]


@pytest.mark.parametrize("words", TIES)
def test_a_first_frame_that_could_be_another_says_so(words: dict[int, int]) -> None:
    """Cᵢ + Cⱼ is silent at one end of every bit and looks like Cᵢ − Cⱼ some chips later."""
    wire = Wire(PAPER, 8.0)
    wire.send(0.25 * wire.period, words)
    wire.send(1.25 * wire.period, {3: 77, 5: 801, 6: 123})
    first, second = run(gap_timing(PAPER, wire.rate_hz), wire.volts())
    assert is_doubtful(first)
    assert not is_doubtful(second)
    assert words_of(second) == wire.sent[1].words


def test_a_frame_whose_energy_is_bunched_is_one_frame() -> None:
    """These words leave one and a half bits' time nearly silent, across the edge of two bits."""
    wire = Wire(PAPER, 8.0)
    nodes, codes = (3, 5, 7, 11, 13, 15), (343, 228, 58, 474, 591, 535)
    for slot in range(3):
        wire.send((slot + 0.25) * wire.period, dict(zip(nodes, codes, strict=True)))
    timing = gap_timing(PAPER, wire.rate_hz)
    check(wire, run(timing, wire.volts()))
    assert timing.rejections.total == 0


@pytest.mark.parametrize("spec", [PAPER, DEFAULT], ids=["paper", "default"])
def test_bursts_of_noise_are_no_frames(spec: FrameSpec) -> None:
    """As long and as strong as frames of all nodes at ρ = 3, in noise that would excuse them."""
    rng, period = np.random.default_rng(15), round(8 * spec.frame_period_s / spec.chip_s)
    volts = rng.normal(0, 3.7, 60 * period)
    volts += rng.normal(0, 4.0, volts.size) * (np.arange(volts.size) % period < 8.4 * spec.chips)
    timing = gap_timing(replace(spec, amplitude_v=None), 8 / spec.chip_s)
    frames = run(timing, volts.astype(np.float32))
    for frame in frames:
        assert frame.words is not None and not frame.speakers and frame.words.doubtful.all()
    assert timing.rejections.total > 10
    assert timing.rejections.total + len(frames) > 50


def test_hum_hides_no_frame_once_the_amplitude_is_learnt() -> None:
    spec = replace(PAPER, amplitude_v=None)
    wire = Wire(spec, 8.0, seed=16)
    wire.amplitude_v = 0.3
    wire.send_random(40)
    del wire.sent[10:15], wire.sent[25:30]  # silence, in which there is only hum
    volts = wire.volts(rho=100, offset_v=0.2)
    fade = np.minimum(np.arange(volts.size) / wire.period / 2, 1)  # the first frame is clean
    volts += (0.02 * fade * np.sin(2 * np.pi * 50 / wire.rate_hz * np.arange(volts.size))).astype(
        "f4"
    )
    check(wire, run(gap_timing(spec, wire.rate_hz), volts), start_chips=0.25)


@pytest.mark.parametrize("cycles_per_frame", [3.22, 20.29, 80.76, 161.14])
def test_an_oscillating_amplifier_hides_no_frame_but_the_next(cycles_per_frame: float) -> None:
    wire, first, last = Wire(DEFAULT, 4.0, seed=5), 6, 26
    for i in range(40):
        wire.send((i + 0.1) * wire.period, {node: 37 * node + i for node in range(16)})
    volts = wire.volts(rho=500)
    inside = slice(round(first * wire.period), round(last * wire.period))
    phase = 2 * np.pi * cycles_per_frame / wire.period * np.arange(volts.size)
    volts[inside] += (2.4 * np.sin(phase[inside])).astype("f4")
    heard = [f for f in run(gap_timing(DEFAULT, wire.rate_hz), volts) if f.speakers]
    after = [f for f in heard if f.start > (last + 1) * wire.period]
    assert [words_of(f) for f in after] == [s.words for s in wire.sent[last + 1 :]]


def test_a_learnt_amplitude_is_forgotten_in_silence() -> None:
    spec = replace(PAPER, amplitude_v=None)
    wire = Wire(spec, 4.0, seed=17)
    wire.amplitude_v = 0.3
    wire.send_random(1)
    loud = wire.volts(length=2 * wire.period)
    wire.sent, wire.amplitude_v = [], 0.05
    wire.send(0.3 * wire.period, {4: 500})
    faint = wire.volts(length=2 * wire.period)
    silence = wire.rng.normal(0, 1e-3, round(1200 * wire.period)).astype(np.float32)
    _, *after = heard(spec, wire.rate_hz, np.concatenate((loud, silence, faint)))
    assert after == [{4: 500}]
    assert len(heard(spec, wire.rate_hz, np.concatenate((loud, faint)))) == 1


@pytest.mark.parametrize("order", [256, 1024])
@pytest.mark.parametrize("nodes", [1, 2, None])
def test_large_books(order: int, nodes: int | None) -> None:
    spec = FrameSpec(nodes=order, order=order, first_row=0, chip_s=0.8e-3 / order)
    wire = Wire(spec, 4.2, seed=18)
    wire.send_random(2, nodes or order)
    check(wire, run(gap_timing(spec, wire.rate_hz), wire.volts()))


TWO = Talk(together=2)
CHURN = Talk(share=0.3, stay=8)
OLD = Skin(order=16, first_row=0, sign_seed=None, polarity=-1, period_chips=208)


def tally(line: Line, talk: Talk, skin: Skin, frames: int = 60) -> Tally:
    recording = render(skin, talk, line, Digitizer(marked=False), frames, seed=3)
    counts, complaints = compare(recording, decode(recording), line)
    assert not counts.unflagged, complaints
    assert not counts.phantom
    return counts


MOVES = {"jitter": {"start_jitter_chips": 3.0}, "slips": {"slip_share": 0.1}}


@pytest.mark.parametrize("order", [12, 20])
@pytest.mark.parametrize("moves", MOVES)
@pytest.mark.parametrize("words", ["random", "equal"])
def test_two_off_the_raster_are_right_or_flagged(words: str, moves: str, order: int) -> None:
    """Their frames are up to three chips beside it each, or now and then all later ones by one."""
    skin = Skin(nodes=order - 1, order=order, period_chips=256)
    counts = tally(Line(noise_v=0.02, **MOVES[moves]), Talk(together=2, words=words), skin, 120)
    assert counts.words == 240 and not counts.lost
    assert counts.tied > 20 if words == "equal" else counts.right == 240


@pytest.mark.parametrize(
    ("skin", "hum_hz"),
    [(Skin(), 50.0), (OLD, 59.9), (Skin(period_chips=400), 50.0)],
    ids=["78 per s", "row 0", "50 per s"],
)
@pytest.mark.parametrize("talk", [Talk(), TWO, CHURN], ids=["all", "two", "some"])
def test_hum_costs_few_frames(skin: Skin, hum_hz: float, talk: Talk) -> None:
    """Of a third of an amplitude; at 50 frames per second each one is at the same place in it.

    Where row 0 is a node's, hum is on it: its words are right, but most of the frames are doubtful.
    """
    counts = tally(Line(hum_v=0.1, hum_hz=hum_hz), talk, skin)
    assert counts.lost < 0.05 * counts.words
    known = counts.right + counts.tied + (counts.flagged if skin.first_row == 0 else 0)
    assert known > 0.95 * counts.words


@pytest.mark.parametrize("talk", [Talk(), TWO], ids=["all", "two"])
def test_a_thousand_impulses_per_second_cost_few_frames(talk: Talk) -> None:
    counts = tally(Line(impulses_hz=1000), talk, Skin())
    assert counts.lost < 0.3 * counts.words


def test_slots_in_which_a_node_spoke_are_not_silent_while_hum_is_being_learnt() -> None:
    """It begins in silence, and what was learnt of the line before is wrong then."""
    wire = Wire(DEFAULT, 4.0, seed=21)
    wire.amplitude_v = 0.3
    for slot in range(7, 40, 3):
        wire.send((slot + 0.3) * wire.period, {4: 37 * slot % 1024})
    volts, index = wire.volts(rho=60, length=42 * wire.period), np.arange(round(42 * wire.period))
    grows = np.clip(index / wire.period - 6, 0, 1)
    volts += (0.1 * grows * np.sin(2 * np.pi * 50 / wire.rate_hz * index)).astype("f4")
    timing, heard = gap_timing(replace(DEFAULT, amplitude_v=0.3), wire.rate_hz), 0
    for frame in run(timing, volts):
        near = [sent for sent in wire.sent if abs(sent.start - frame.start) < 0.3 * wire.period]
        assert words_of(frame) == (near[0].words if near else {})
        heard += bool(near)
    assert heard >= 7


def test_a_node_that_holds_the_line_is_no_hum() -> None:
    """On row 0, half a frame up and half a frame down, as slowly as 60 Hz."""
    wire = Wire(replace(PAPER, amplitude_v=0.3), 8.0, seed=22)
    for slot in range(25):
        wire.send((slot + 0.25) * wire.period, {0: 0b1111100000})
    timing = gap_timing(wire.spec, wire.rate_hz)
    check(wire, run(timing, wire.volts(rho=60)), start_chips=0.25)
    assert timing.rejections.total == 0
