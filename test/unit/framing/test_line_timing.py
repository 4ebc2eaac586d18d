# SPDX-License-Identifier: Apache-2.0

"""Line timing on simulated lines: its shortcuts change no word, and disturbances cost little."""

from collections.abc import Callable
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.code.encode import line_chips
from tactile_cdma.code.frame import DEFAULT_AMPLITUDE_V, FrameSpec
from tactile_cdma.framing.fit import Fit, Line, refine
from tactile_cdma.framing.limits import LIMITS
from tactile_cdma.framing.line_timing import (
    CARRIED_FRAMES,
    LARGEST_SEARCH,
    SEARCH_PER_S,
    LineRecogniser,
    LineTiming,
)
from tactile_cdma.framing.marked_timing import MarkedFrame, Verdict
from tactile_cdma.framing.timing import MISFIT, FrameLevels, SampleBlock
from tactile_cdma.sim.line import truth
from tactile_cdma.sim.options import Setup, SimOptions
from tactile_cdma.sim.packets import stream
from tactile_cdma.wire._protocol import SyncMode
from tactile_cdma.words.decode import decode
from tactile_cdma.words.health import NodeHealth, NodeState
from test.support.examples import examples

SPEC = FrameSpec()


def blocks(options: SimOptions, setup: Setup, frames: int) -> list[SampleBlock]:
    """The digitized line of some frames, in V."""
    result: list[SampleBlock] = []
    for block in stream(options, setup):
        if (
            block.sync
            and len(result)
            and block.begin_s > (frames - 0.5) * setup.spec.frame_period_s
        ):
            return result
        volts = options.channel.volts(block.counts, setup.spec)
        result.append(SampleBlock(block.first_index, volts, block.sync))
    raise AssertionError("the stream has no end")


def run(timing: LineTiming, given: list[SampleBlock]) -> list[FrameLevels]:
    return [frame for block in given for frame in timing.feed(block)] + timing.flush()


def changed(
    given: list[SampleBlock], change: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> list[SampleBlock]:
    """The same blocks of another line: of its volts and the numbers of its samples."""
    line = np.concatenate([block.volts for block in given])
    line = change(line, np.arange(line.size)).astype(np.float32)
    return [
        replace(block, volts=line[block.first_index : block.first_index + block.volts.size])
        for block in given
    ]


def codes_of(options: SimOptions, setup: Setup, frames: int) -> list[np.ndarray]:
    return [node.codes for node in islice(truth(options, setup), frames)]


def assert_read(frames: list[FrameLevels], codes: list[np.ndarray], spec: FrameSpec) -> None:
    """Every frame is heard, and all its words are right and certain."""
    assert len(frames) == len(codes)
    for frame, sent in zip(frames, codes, strict=True):
        assert frame.levels is not None
        words = decode(frame.levels, spec)
        assert words.active.all() and not words.doubtful.any()
        assert np.array_equal(words.codes, sent)


@pytest.fixture
def refinements(monkeypatch: pytest.MonkeyPatch) -> list[Line]:
    """The lines whose timing was refined."""
    calls = []

    def counted(line: Line, *args: object, **options: object) -> object:
        calls.append(line)
        return refine(line, *args, **options)  # type: ignore[arg-type]

    monkeypatch.setattr("tactile_cdma.framing.line_timing.refine", counted)
    return calls


def ungated(rate_hz: float) -> LineTiming:
    """Line timing without the energy gate."""
    timing = LineTiming(SPEC, rate_hz)
    gate = timing.line.gate

    def opened(frame: MarkedFrame) -> Verdict | None:
        verdict = gate(frame)
        return verdict if verdict and verdict.rejected else None

    timing.line.gate = opened
    return timing


@pytest.mark.parametrize(("gap_v", "told"), [(0.01, True), (2.0, False)])
def test_a_word_fainter_than_the_noise_of_the_gap_is_not_called_silent(
    gap_v: float, told: bool
) -> None:
    """The gap is loud and the frame is not, so a word passes for noise."""
    rng, alone = np.random.default_rng(7), np.arange(16) == 4
    timing, frames = LineTiming(SPEC, 4 / SPEC.chip_s), []
    for number in range(4):
        volts = sampled(line_chips(SPEC, np.full(16, 618), alone & (number == 3)))
        volts[4 * SPEC.chips :] += rng.normal(0, gap_v, 1024 - 4 * SPEC.chips)
        frames += timing.feed(SampleBlock(1024 * number, volts, sync=True))
    last = [frame for frame in frames if frame.start > 3000]
    assert [frame.levels is not None for frame in last] == [True] * told


@examples(25)
@given(
    st.sampled_from(["idle", "press", "moving", "all"]),
    st.sampled_from([1, 4]),
    st.sampled_from([0.0, 0.02, 0.1]),
    st.integers(0, 1000),
)
def test_the_energy_gate_changes_nothing(scene: str, rate: int, noise: float, seed: int) -> None:
    options = SimOptions(scene=scene, noise=noise, seed=seed, heartbeat=0)
    setup = Setup(SPEC, rate, SyncMode.DRIVE, integrated=rate == 1)
    given = blocks(options, setup, 8)
    gated = run(LineTiming(SPEC, setup.rate_hz), given)
    full = run(ungated(setup.rate_hz), given)
    assert len(gated) == len(full) == 8
    for one, other in zip(gated, full, strict=True):
        assert (one.start, one.chip_samples, one.offset_v) == (
            other.start,
            other.chip_samples,
            other.offset_v,
        )
        assert (one.levels is None) == (other.levels is None)
        if one.levels is not None and other.levels is not None:
            assert np.array_equal(one.levels.values, other.levels.values)


@pytest.mark.parametrize("noise", [0.005, 0.1, 0.4])
def test_timing_carried_over_is_as_good_as_timing_refined(
    noise: float, refinements: list[Line], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Words are as accurate, and nearly every refinement is saved."""
    options = SimOptions(scene="all", threshold=0, noise=noise, seed=3)
    setup = Setup(SPEC, 4, SyncMode.DRIVE, False)
    sent = blocks(options, setup, 60)
    carried = run(LineTiming(SPEC, setup.rate_hz), sent)
    assert len(refinements) <= 2 * (1 + 60 // CARRIED_FRAMES)
    monkeypatch.setattr(LineRecogniser, "_by_carried", lambda *_: None)
    refined = run(LineTiming(SPEC, setup.rate_hz), sent)
    errors = []
    for frames in (carried, refined):
        assert len(frames) == 60
        worst = 0.0
        for frame, node in zip(frames, islice(truth(options, setup), 60), strict=False):
            assert frame.levels is not None
            bits = np.where((node.codes[:, None] >> np.arange(9, -1, -1)) & 1, 1.0, -1.0).T
            error = frame.levels.values * SPEC.signs - 0.3 * bits
            worst += float(np.square(error).mean())
        errors.append(worst)
    assert errors[0] < 1.05 * errors[1]


@pytest.mark.parametrize("disturbed", [{}, {"noise": 0.3}, {"jitter": 0.1}, {"stretch": 0.004}])
@pytest.mark.parametrize("scene", ["press", "moving", "all"])
def test_no_stretch_that_is_left_out_would_have_won(
    disturbed: dict[str, float], scene: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = SimOptions(scene=scene, threshold=0, seed=5, **disturbed)
    setup = Setup(SPEC, 4, SyncMode.DRIVE, False)
    sent = blocks(options, setup, 30)
    short = run(LineTiming(SPEC, setup.rate_hz), sent)
    chosen = LineRecogniser._chosen
    numbers = []

    def all_considered(
        self: LineRecogniser, frame: MarkedFrame, line: Line, fits: list[Fit]
    ) -> Verdict:
        numbers.append(len(fits))
        return chosen(self, frame, line, fits) if len(fits) == 3 else Verdict(rejected=MISFIT)

    monkeypatch.setattr(LineRecogniser, "_by_carried", lambda *_: None)
    monkeypatch.setattr(LineRecogniser, "_chosen", all_considered)
    whole = run(LineTiming(SPEC, setup.rate_hz), sent)
    assert numbers.count(3) == len(whole) == len(short) == 30
    for one, other in zip(short, whole, strict=True):
        assert one.levels is not None and other.levels is not None
        mine, theirs = decode(one.levels, SPEC), decode(other.levels, SPEC)
        assert np.array_equal(mine.codes, theirs.codes)
        assert np.array_equal(mine.active, theirs.active) and mine.active.any()
        assert other.doubtful is None or not other.doubtful.any()


def test_frames_that_are_all_stretched_alike_reuse_timing(refinements: list[Line]) -> None:
    timing, rng, stretched = LineTiming(SPEC, 4 / SPEC.chip_s), np.random.default_rng(3), 4.2
    chip = ((np.arange(1024) + 0.5) / stretched).astype(int)
    for number in range(140):
        codes = rng.integers(0, 1024, 16)
        volts = np.append(line_chips(SPEC, codes).ravel(), 0.0)[np.minimum(chip, SPEC.chips)]
        volts = (volts + rng.normal(0, 0.01, 1024)).astype(np.float32)
        frames = timing.feed(SampleBlock(1024 * number, volts, sync=True))
        assert len(frames) == 1 and frames[0].levels is not None
        assert frames[0].chip_samples == pytest.approx(stretched, rel=1e-3)
        assert np.array_equal(decode(frames[0].levels, SPEC).codes, codes)
    assert len(refinements) <= 3 * (1 + 140 // CARRIED_FRAMES)


def test_timing_that_changes_is_noticed_at_once() -> None:
    """A stretch of half a percent after thirty steady frames."""
    setup = Setup(SPEC, 8, SyncMode.DRIVE, False)
    steady = SimOptions(scene="all", threshold=0, seed=4)
    given = blocks(steady, setup, 30)
    at = given[-1].first_index + given[-1].volts.size
    for block in blocks(replace(steady, stretch=0.01, seed=5), setup, 10):
        given.append(SampleBlock(block.first_index + at, block.volts, block.sync))
    codes = codes_of(steady, setup, 30) + codes_of(steady, setup, 10)
    assert_read(run(LineTiming(SPEC, setup.rate_hz), given), codes, SPEC)


@pytest.mark.parametrize("rate", [1, 4])
@pytest.mark.parametrize("parity", [False, True])
def test_frames_with_restarts_in_them(rate: int, parity: bool) -> None:
    spec = FrameSpec(resync_chips=32, guard_chips=1, parity=parity)
    assert spec.span_chips == spec.chips + (spec.chips - 1) // 32
    assert np.array_equal(np.diff(spec.places) == 2, np.arange(1, spec.chips) % 32 == 0)
    options = SimOptions(scene="moving", threshold=0, noise=0.05)
    setup = Setup(spec, rate, SyncMode.DRIVE, integrated=rate == 1)
    frames = run(LineTiming(spec, setup.rate_hz), blocks(options, setup, 20))
    assert_read(frames, codes_of(options, setup, 20), spec)


def test_an_absurd_sample_loses_its_frame_only() -> None:
    setup = Setup(SPEC, 4, SyncMode.DRIVE, False)
    given = blocks(SimOptions(scene="all", threshold=0), setup, 6)
    for bad in (np.nan, np.inf, -1e30):
        sent = [replace(block, volts=block.volts.copy()) for block in given]
        third = [block.first_index for block in sent if block.sync][2]
        next(block for block in sent if block.first_index == third).volts[7] = bad
        timing = LineTiming(SPEC, setup.rate_hz)
        frames = run(timing, sent)
        assert len(frames) == 5 and timing.rejections.total == 1
        for frame in frames:
            assert frame.levels is not None and np.isfinite(frame.levels.values).all()


@pytest.mark.parametrize("delay", [0.3, 0.9])
def test_nodes_that_all_restart_late(delay: float) -> None:
    spec = FrameSpec(resync_chips=32, guard_chips=1)
    setup = Setup(spec, 8, SyncMode.DRIVE, False)
    options, shift = SimOptions(scene="all", threshold=0), round(delay * 8)
    given = changed(
        blocks(options, setup, 12), lambda volts, _: np.append(np.zeros(shift), volts[:-shift])
    )
    assert_read(run(LineTiming(spec, setup.rate_hz), given), codes_of(options, setup, 12), spec)


@pytest.mark.parametrize("gap_chips", [1, 2, 3])
@pytest.mark.parametrize("rate", [2, 4])
def test_short_gaps_are_enough(gap_chips: int, rate: int) -> None:
    spec = FrameSpec(frame_period_s=(200 + gap_chips) * 50e-6)
    sigma = 0.3 * np.sqrt(20 * rate) / 8  # ρ = 8
    options = SimOptions(scene="all", threshold=0, noise=float(sigma), seed=6, rail=10.0)
    setup = Setup(spec, rate, SyncMode.DRIVE, False)
    timing = LineTiming(spec, setup.rate_hz)
    frames = run(timing, blocks(options, setup, 150))
    assert timing.rejections.total <= 3
    sent = list(islice(truth(options, setup), 150))
    for frame in frames:
        assert frame.levels is not None
        words = decode(frame.levels, spec)
        codes = sent[round(frame.start / setup.rate_hz / spec.frame_period_s)].codes
        assert np.array_equal(words.codes, codes)


ALWAYS = SimOptions(threshold=0)
RAW = Setup(SPEC, 4)


def test_a_burst_in_the_gap_costs_no_frame_after_it() -> None:
    until = 6 * round(RAW.rate_hz * SPEC.frame_period_s) - 10

    def burst(volts: np.ndarray, at: np.ndarray) -> np.ndarray:
        return volts + np.where(at % 2, 10.0, -10.0) * ((until - 150 <= at) & (at < until))

    given = changed(blocks(ALWAYS, RAW, 20), burst)
    assert_read(run(LineTiming(SPEC, RAW.rate_hz), given), codes_of(ALWAYS, RAW, 20), SPEC)


ROW = np.arange(16) == 4


def sampled(chips: np.ndarray) -> np.ndarray:
    """A period at 4 samples per chip, that begins with a frame."""
    return np.pad(np.repeat(chips.ravel(), 4), (0, 1024 - 4 * chips.size)).astype(np.float32)


def shared_row_blocks(
    talkers: int,
    number: int,
    words: str,
    frames: int = 40,
    share: float = 1.0,
    spec: FrameSpec = SPEC,
) -> tuple[list[SampleBlock], list[np.ndarray]]:
    """Frames in which so many nodes more speak on node 5's row, and the codes of the others."""
    rng, result, sent = np.random.default_rng(9), [], []
    active = ROW | (np.arange(16) < talkers - 1)
    for frame in range(frames):
        codes = rng.integers(0, 1024, 16)
        chips = line_chips(spec, codes, active)
        for _ in range(number):
            other = {"equal": codes, "alike": codes ^ rng.integers(0, 4, 16)}.get(
                words, rng.integers(0, 1024, 16)
            )
            chips += line_chips(spec, other, ROW, share * DEFAULT_AMPLITUDE_V)
        volts = sampled(chips) + rng.normal(0, 0.01, 1024).astype(np.float32)
        result.append(SampleBlock(1024 * frame, volts, sync=True))
        sent.append(np.where(active & ~ROW, codes, -1))
    return result, sent


@pytest.mark.parametrize("talkers", [3, 4, 16])
@pytest.mark.parametrize(
    ("number", "words", "share"),
    [
        (1, "equal", 1),
        (1, "alike", 1),
        (1, "any", 1),
        (1, "any", 0.3),
        (1, "equal", -1),
        (2, "equal", 1),
        (2, "any", 1),
    ],
)
def test_nodes_on_one_row_cost_no_frame(
    talkers: int, number: int, words: str, share: float
) -> None:
    given, sent = shared_row_blocks(talkers, number, words, share=share)
    timing, health = LineTiming(SPEC, 4 / SPEC.chip_s), NodeHealth(SPEC)
    frames = run(timing, given)
    assert timing.rejections.total <= 4
    for frame in frames:
        assert frame.levels is not None
        heard, codes = decode(frame.levels, SPEC), sent[round(frame.start / 1024)]
        assert np.array_equal(np.where(heard.active & ~ROW, heard.codes, -1), codes)
        health.update(heard)
    assert not health.invalid[~ROW].any()
    if number == 1 and share == 1:
        assert health.nodes(NodeState.DOUBLED) == [5]


def test_two_unipolar_nodes_on_one_row_cost_the_others_nothing() -> None:
    spec = FrameSpec(drive="unipolar")
    timing = LineTiming(spec, 4 / spec.chip_s)
    run(timing, shared_row_blocks(16, 1, "any", 60, spec=spec)[0])
    assert timing.rejections.total <= 2


@pytest.mark.parametrize("number", [0, 1])
@pytest.mark.parametrize("what", ["another code", "noise", "too long", "cut"])
def test_what_is_no_frame_is_rejected(what: str, number: int) -> None:
    """Also where two nodes share a row, which makes these words uneven anyway."""
    given, _ = shared_row_blocks(16, number, "any", frames=12)
    timing, rng = LineTiming(SPEC, 4 / SPEC.chip_s), np.random.default_rng(1)
    for block in given:
        volts = block.volts.copy()
        if what == "another code":
            chips = volts[: 4 * SPEC.chips].reshape(-1, 4)
            volts[: 4 * SPEC.chips] = rng.permutation(chips).ravel()
        elif what == "noise":
            volts[: 4 * SPEC.chips] = rng.normal(0, 1, 4 * SPEC.chips)
        elif what == "too long":
            volts[:960] = volts[np.arange(960) * 5 // 6]
        else:
            volts[400:] = 0
        assert not timing.feed(replace(block, volts=volts))
    timing.flush()
    assert timing.rejections.total == len(given)


def right(frames: list[FrameLevels], options: SimOptions, setup: Setup) -> list[int]:
    """Numbers of the frames; their certain words are what was said."""
    numbers = [round(frame.start / (setup.spec.frame_period_s * setup.rate_hz)) for frame in frames]
    true = dict(enumerate(islice(truth(options, setup), numbers[-1] + 1)))
    for number, frame in zip(numbers, frames, strict=True):
        assert frame.levels is not None
        words = decode(frame.levels, setup.spec)
        wrong = words.codes != true[number].codes
        assert words.active.all()
        assert not (wrong & ~words.doubtful).any() and np.count_nonzero(wrong) <= 1
    return numbers


def test_hum_costs_no_frame() -> None:
    """Of three nodes' amplitude: it is under the words and under the silence after them."""
    hum = changed(
        blocks(ALWAYS, RAW, 20),
        lambda volts, at: volts + 0.9 * np.sin(2 * np.pi * 50 / RAW.rate_hz * at),
    )
    assert right(run(LineTiming(SPEC, RAW.rate_hz), hum), ALWAYS, RAW) == list(range(20))


@pytest.mark.parametrize(("before", "lost"), [(LIMITS.proven_ends, 0), (5, 6)])
def test_a_late_node_costs_the_others_nothing_once_frames_are_known(before: int, lost: int) -> None:
    """Before that, it may as well be that frames are longer than specified."""
    size = round(SPEC.frame_period_s * RAW.rate_hz)
    late = np.zeros(size, np.float32)
    word = 0.3 * np.outer([1, -1, -1, 1, 1, -1, 1, -1, 1, 1], SPEC.book.rows([18])[0]).ravel()
    late[40 : 40 + 4 * SPEC.chips] = np.repeat(word, 4)
    given = changed(
        blocks(ALWAYS, RAW, before + 10),
        lambda volts, at: volts + late[at % size] * (at >= before * size),
    )
    frames = run(LineTiming(SPEC, RAW.rate_hz), given)
    assert len(right(frames, ALWAYS, RAW)) == before + 10 - lost


@pytest.mark.parametrize("rate", [1, 4])
def test_a_line_at_its_rail_is_no_silence(rate: int) -> None:
    setup = Setup(SPEC, rate, SyncMode.DRIVE, integrated=rate == 1)
    given = changed(blocks(ALWAYS, setup, 5), lambda volts, _: np.full_like(volts, 5.0))
    timing = LineTiming(SPEC, setup.rate_hz, (-5.0, 5.0))
    assert not run(timing, given)
    assert timing.rejections.total == 5
    assert len(run(LineTiming(SPEC, setup.rate_hz, (-6.0, 6.0)), given)) == 5


def test_a_frame_at_the_rails_does_not_tell_who_was_silent() -> None:
    given = changed(blocks(ALWAYS, RAW, 5), lambda volts, _: np.clip(100 * volts, -5, 5))
    timing = LineTiming(SPEC, RAW.rate_hz, (-5.0, 5.0))
    assert not run(timing, given)
    assert timing.rejections.total == 5


def test_words_after_a_frame_at_the_rails_are_no_noise() -> None:
    """Where chips are integrated no gap is sent, nor is one seen in the frames that follow."""
    setup = Setup(SPEC, 1, integrated=True)
    loud = 30 * np.outer([1, -1, -1, 1, 1, -1, 1, -1, 1, 1], SPEC.book.rows([8])[0]).ravel()
    given = blocks(ALWAYS, setup, 10)
    for number, block in enumerate(given[:2]):
        volts = np.clip(block.volts + loud, -5, 5).astype(np.float32)
        given[number] = replace(block, volts=volts)
    frames = run(timing := LineTiming(SPEC, setup.rate_hz, (-5.0, 5.0)), given)
    assert timing.rejections.total == 2
    assert [frame.levels is not None for frame in frames] == [True] * 8


def test_a_disturbed_line_costs_a_bounded_search(monkeypatch: pytest.MonkeyPatch) -> None:
    looked_at, gains = [], LineRecogniser._gains
    spec = FrameSpec(nodes=256, chip_s=4e-6, frame_period_s=16e-3)

    def counted(self: LineRecogniser, line: Line, chip: np.ndarray, bits: int) -> np.ndarray:
        looked_at.append(chip.size * bits * spec.order)
        return gains(self, line, chip, bits)

    monkeypatch.setattr(LineRecogniser, "_gains", counted)
    setup = Setup(spec, 2)
    rng, size = np.random.default_rng(3), round(spec.frame_period_s * setup.rate_hz)
    timing = LineTiming(spec, setup.rate_hz)
    for number in range(40):
        volts = rng.normal(0, 3, size).astype(np.float32)
        timing.feed(SampleBlock(number * size, volts, sync=True))
    nominal = 40 * 8 * spec.chips  # ends where the line falls silent
    assert max(looked_at) > 100 * spec.chips, "none of all stretches was looked for"
    assert sum(looked_at) < nominal + LARGEST_SEARCH + 40 * SEARCH_PER_S * spec.frame_period_s


@pytest.mark.parametrize(
    ("nodes", "stretch", "speaking", "noisy"),
    [(256, 0.03, 1, 0), (256, 0.11, 32, 3), (512, 0.11, 64, 0)],
)
def test_a_first_frame_is_read_whatever_its_stretch(
    nodes: int, stretch: float, speaking: int, noisy: int
) -> None:
    """After a silent slot, and after some of noise, which all are searched for words: ρ = 15."""
    spec = FrameSpec(nodes=nodes, chip_s=1e-5, frame_period_s=0.128, amplitude_v=1.0)
    rng, size, noise = np.random.default_rng(5), 25_600, np.sqrt(2 * spec.order) / 15
    bits = rng.choice([-1.0, 1.0], (spec.bits, nodes)) * (np.arange(nodes) < speaking)
    chip = (np.arange(size) + 0.5) / 2 / (1 + stretch)
    sent = np.append(bits @ spec.node_rows, 0.0)[np.minimum(chip, spec.chips).astype(int)]
    lines = np.stack([0 * sent] + [3 * rng.normal(size=size)] * noisy + [sent, 0 * sent])
    timing, frames = LineTiming(spec, 2 / spec.chip_s), []
    for number, line in enumerate(lines + noise * rng.normal(size=lines.shape)):
        frames += timing.feed(SampleBlock(number * size, line.astype(np.float32), sync=True))
    [frame] = [frame for frame in frames if round(frame.start / size) == noisy + 1]
    assert frame.levels is not None and frame.doubtful is None
    assert np.array_equal(np.sign(frame.levels.values)[:, :speaking], bits[:, :speaking])
