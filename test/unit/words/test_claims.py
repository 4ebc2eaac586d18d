# SPDX-License-Identifier: Apache-2.0

"""Silence and words are claims: none is made of faint words, tones, offsets or broken-off words."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.doubt.lines import Condition
from benchmarks.doubt.mixtures import drawn
from benchmarks.doubt.tally import Tally
from benchmarks.doubt.words import TIMINGS, compare, decode
from tactile_cdma.code.encode import line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.words.health import JUDGE_FRAMES, NodeState
from test.support.chip_line import ChipLine, hear, read_chips
from test.support.independent_line import Line, Skin, Talk, render

FEW = Talk(speakers=(0, 2, 3, 5), share=0.6, stay=8)
OLD = Skin(order=16, first_row=0, sign_seed=None, polarity=-1, period_chips=208)
FALSE_ONCE = {
    0: (68, 74, 221, 416, 541, 624, 806, 1124),
    1: (497, 827),
    2: (34, 48, 91, 126),
    3: (16, 129),
}
"""Random mixtures, by their seeds and names in `make bench-doubt`. Three more are false still: see
docs/results.md."""
LONG = Skin(nodes=39, order=40, period_chips=520)


def tally(
    line: Line, talk: Talk, skin: Skin, timing: str, frames: int = 40, learnt: bool = False
) -> Tally:
    recording = render(skin, talk, line, TIMINGS[timing], frames, seed=7)
    counts, complaints = compare(recording, decode(recording, learnt), line)
    assert not counts.unflagged, complaints
    assert not counts.phantom
    return counts


@pytest.mark.parametrize("timing", TIMINGS)
@pytest.mark.parametrize(("share", "rho"), [(0.17, 20), (0.15, 70), (0.24, 40)])
def test_a_faint_word_is_no_silence(share: float, rho: float, timing: str) -> None:
    line = Line(gains=((2, share),), noise_v=0.3 * 20**0.5 / rho)
    counts = tally(line, FEW, Skin(), timing)
    assert counts.wrong_flagged > 10, "it had something to hide"
    assert counts.right + counts.flagged > 30


@pytest.mark.parametrize("timing", TIMINGS)
@pytest.mark.parametrize(
    "talk", [Talk(share=0.5), Talk(speakers=(2,), share=0.5)], ids=["all", "one"]
)
def test_a_skin_whose_supply_sags_is_not_silent(talk: Talk, timing: str) -> None:
    counts = tally(Line(gain=0.2), talk, Skin(), timing)
    assert counts.wrong_flagged + counts.lost == counts.words > 0


@pytest.mark.parametrize("timing", TIMINGS)
def test_a_word_that_breaks_off_is_no_silence(timing: str) -> None:
    counts = tally(Line(dropouts=((2, 1.0),)), FEW, Skin(), timing)
    assert counts.wrong_flagged > 3


@pytest.mark.parametrize(
    ("skin", "late"),
    [
        (Skin(nodes=22, order=28, period_chips=526), ((7, -2.48),)),
        (Skin(nodes=15, order=20, bits=13, period_chips=355), ((1, 2.1), (8, -1.77))),
        (Skin(nodes=95, order=96, bits=9, period_chips=1300, amplitude_v=0.1), ((3, 2.0),)),
    ],
    ids=["28", "20", "96"],
)
def test_a_node_in_no_row_is_no_noise(skin: Skin, late: tuple[tuple[int, float], ...]) -> None:
    """Late by chips it is what other rows hold alike: those who may be it are not silent."""
    counts = tally(Line(late=late, noise_v=0.03), Talk(together=3), skin, "means", 60)
    assert counts.right > 60


@pytest.mark.parametrize("disturbed", [{"steps_hz": 20, "step_v": 0.05}, {"hum_v": 0.15}])
def test_on_a_sparse_line_something_but_nobody_is_heard(disturbed: dict[str, float]) -> None:
    """Most frames have no speaker, and are not silent."""
    skin = Skin(nodes=256, order=64, period_chips=832, amplitude_v=0.15, sparse=True)
    counts = tally(Line(**disturbed), Talk((3,), 0.1), skin, "means", 60)
    assert counts.words > 3
    assert counts.silences > 14000


@pytest.mark.parametrize(
    ("number", "seed"), [(number, seed) for seed in FALSE_ONCE for number in FALSE_ONCE[seed]]
)
def test_what_was_claimed_falsely_once_is_flagged(number: int, seed: int) -> None:
    counts, complaints = drawn(number).run(250, seed)
    assert not counts.false, complaints
    assert counts.words > 20


@pytest.mark.parametrize("timing", ["marks", "means"])
@pytest.mark.parametrize(("shifts", "flagged"), [((), 0.05), ((1.0, -1.0, 2.0), 0.5)])
def test_equal_words_of_few_are_theirs_if_their_mark_is_where_it_should_be(
    shifts: tuple[float, ...], flagged: float, timing: str
) -> None:
    """Equal bits on rows 1 to 4 are those on rows 2 to 5 a chip earlier, ends included."""
    digitizer = replace(TIMINGS[timing], mark_shifts=shifts, mark_share=0.1)
    talk = Talk(speakers=tuple(range(7)), together=4, words="equal")
    condition = Condition("late marks", Line(noise_v=0.003), talk, Skin(), digitizer)
    counts, complaints = condition.run(600, 1)
    assert not counts.unflagged, complaints
    assert counts.right > 1500 and counts.flagged < flagged * counts.right


def test_what_leaks_onto_the_row_of_a_node_known_to_be_weak_is_no_word() -> None:
    """Behind this low-pass all words have 0.6 of their amplitude, so that nodes become weak."""
    line, talk = Line(low_pass_chips=0.6), Talk(share=0.3, stay=8, words="slow")
    name = "marks: low-pass 0.6 chip, joining and leaving"  # of which seeds are made
    counts, complaints = Condition(name, line, talk, Skin(), TIMINGS["marks"]).run(100, 0)
    assert not counts.unflagged, complaints
    assert counts.right > 0.3 * counts.words > 100


def test_parts_of_a_late_word_on_other_rows_are_somebodys() -> None:
    """Whose own row holds nothing."""
    skin = Skin(nodes=39, order=40, period_chips=749, amplitude_v=0.19)
    talk = Talk(share=0.3, stay=8, words="equal")
    line = Line(late=((12, 1.38),), noise_v=0.093)
    counts = tally(line, talk, skin, "means", 60)
    assert counts.right > 200


def test_silence_of_means_is_certain_once_a_word_has_shown_where_frames_begin() -> None:
    """Half a chip off, nothing would be left of a node whose row alternates."""
    digitizer = replace(TIMINGS["means"], mark_shifts=(2.0,), mark_share=0.04)
    talk = Talk(speakers=(2,), share=0.2)
    recording = render(Skin(), talk, Line(noise_v=0.03), digitizer, 150, seed=7)
    decoded, timed, silences, offs = decode(recording), False, [0, 0], (9.0, 9.0)
    assert len(decoded) == len(recording.frames)
    for frame, truth in zip(decoded, recording.frames, strict=True):
        words, offs = frame.words, (*offs[-2:], frame.start_chips - truth.start_chips)
        timed &= max(offs) - min(offs) < 0.5  # three marks tell whether they keep their distance
        if (truth.codes < 0).all():
            silences[timed] += 1
            assert timed == (words is None or not words.doubtful.any())
        else:
            timed |= words is not None and not words.doubtful.any()
    assert min(silences) > 10


def test_of_unknown_amplitude_words_that_may_be_noise_hide_a_node() -> None:
    """All speak but one that is early, and so on another's row."""
    line = Line(late=((5, -2.0),), noise_v=0.112)
    counts = tally(line, Talk(), Skin(), "means", learnt=True)
    assert counts.wrong_flagged > 20


@pytest.mark.parametrize(("timing", "late"), [("marks", -1.0), ("means", 1.0)])
def test_a_doubled_row_hides_a_node_for_as_long_as_it_is_doubled(timing: str, late: float) -> None:
    """Also once it is known to be, and is left out of what tells of something unknown."""
    noise_v = 0.08 if timing == "marks" else 0.1
    line = Line(late=((5, late),), dropouts=((5, 0.3),), noise_v=noise_v)
    counts = tally(line, Talk(), Skin(), timing, 60)
    assert counts.right + counts.flagged > 600


def test_a_tone_that_gives_a_frame_its_timing_is_no_silence() -> None:
    line = Line(hum_v=0.41, hum_hz=1115, rise_chips=0.44, noise_v=0.03)
    skin = Skin(
        nodes=59, order=64, bits=12, first_row=0, sign_seed=None, chip_s=53e-6, period_chips=937,
        amplitude_v=0.156,
    )  # fmt: skip
    counts = tally(line, Talk(together=2, words="extreme"), skin, "marks", 30)
    assert counts.wrong_flagged + counts.lost > 20, "it hides words"


def test_hum_that_is_taken_for_more_noise_than_it_is_hides_a_word_by_gaps() -> None:
    counts, complaints = drawn(1354).run(40, 1)
    assert not counts.false, complaints
    assert counts.lost + counts.wrong_flagged > 5


@pytest.mark.parametrize("share", [0.005, 0.01])
def test_a_node_whose_clock_is_off_speaks_falsely_nowhere(share: float) -> None:
    counts = tally(Line(slow=((2, share),)), Talk(), Skin(), "marks", 60)
    assert counts.wrong_flagged > 30
    assert counts.lost < 0.25 * counts.words


def test_a_tone_on_a_nodes_row_is_no_word_of_a_weak_node() -> None:
    """It has 0.6 of an amplitude there, and even bits."""
    skin = Skin(nodes=39, order=40, period_chips=520, amplitude_v=0.2)
    talk = Talk(speakers=(0, 2, 3, 5), share=0.6, stay=8)
    condition = Condition(
        "means: hum of 1 A, 250 Hz", Line(hum_v=0.2, hum_hz=250), talk, skin, TIMINGS["means"]
    )
    counts, complaints = condition.run(250, 2)
    assert not counts.unflagged, complaints
    assert counts.words > 500


@pytest.mark.parametrize("hum_hz", [100.0, 200.0, 250.0, 300.0, 500.0])
@pytest.mark.parametrize("talk", [Talk(share=0), Talk(together=1)], ids=["nobody", "one"])
def test_hum_is_no_word(talk: Talk, hum_hz: float) -> None:
    """Of 0.2 to 1 period per bit: on row 20 it is alike in all bits, or turns with each."""
    for volts in (0.3, 0.6, 1.2):
        tally(Line(hum_v=volts, hum_hz=hum_hz), talk, LONG, "means", 20)


@pytest.mark.parametrize("periods", np.arange(0.1, 1.55, 0.1))
def test_a_tone_speaks_for_nobody(periods: float) -> None:
    spec = FrameSpec(nodes=39, order=40, frame_period_s=0.03)
    bits = np.arange(400).reshape(10, 40) / 40
    spoke = 0
    for phase in np.arange(0, 1, 0.1):
        for volts in (0.2, 0.3, 0.6, 1.2):
            tone = volts * np.sin(2 * np.pi * (periods * bits + phase))
            frame = hear(tone, spec)
            if frame is not None and frame.words is not None:
                assert not (frame.words.active & ~frame.words.doubtful).any()
            spoke += frame is None or (frame.words is not None and frame.words.doubtful.any())
    assert spoke > 10 or periods < 0.15, "it had something to say"


def test_words_in_a_tone_of_a_third_of_an_amplitude_are_heard() -> None:
    flagged = total = 0
    spec, rng = FrameSpec(nodes=39, order=40, frame_period_s=0.03), np.random.default_rng(3)
    time = np.arange(400).reshape(10, 40) / 40
    for _ in range(40):
        codes, active = rng.integers(0, 1024, 39), rng.random(39) < 0.5
        active[19] = True
        hum = 0.1 * np.sin(2 * np.pi * (rng.uniform(0.1, 1.5) * time + rng.uniform()))
        chips = line_chips(spec, codes, active) + hum + rng.normal(0, 0.02, (10, 40))
        words = read_chips(chips, spec, 0.02)
        assert np.array_equal(words.active, active)
        assert np.array_equal(words.codes[active], codes[active])
        flagged += int((words.doubtful & active).sum())
        total += int(active.sum())
    assert flagged < 0.05 * total


@pytest.mark.parametrize("offset", [-1.5, -0.6, 0.8, 1.5])
def test_an_offset_is_not_the_word_of_a_dead_node_on_row_0(offset: float) -> None:
    """One value per chip shows no gap, whose level would tell."""
    talk = Talk(speakers=tuple(range(1, 16)), share=0.4)
    counts = tally(Line(offset_v=0.3 * offset), talk, OLD, "means")
    assert counts.right > 200


def test_a_word_of_changing_bits_on_row_0_is_heard() -> None:
    counts = tally(Line(), Talk(speakers=(0, 4)), OLD, "means")
    assert counts.right > 0.95 * counts.words


def test_silence_in_noise_is_certain() -> None:
    spec, rng = FrameSpec(), np.random.default_rng(5)
    flagged = total = 0
    for rho in (15, 60):
        sigma = 0.3 * np.sqrt(20) / rho
        for _ in range(120):
            active = rng.random(16) < 0.3
            chips = line_chips(spec, rng.integers(0, 1024, 16), active)
            chips = chips + rng.normal(0, sigma, chips.shape)
            words = read_chips(chips, spec, sigma)
            flagged += int((words.doubtful & ~active).sum())
            total += int((~active).sum())
    assert flagged < 0.01 * total


@pytest.mark.parametrize(("every", "verdicts"), [(1, 3), (15, 10)])
def test_a_node_that_always_speaks_faintly_is_named_weak(every: int, verdicts: int) -> None:
    rng, spec = np.random.default_rng(1), FrameSpec()
    line = ChipLine(spec)
    sound, weak = np.arange(16) < 8, np.arange(16) == 11
    for frame in range(verdicts * JUDGE_FRAMES):
        codes = rng.integers(0, 1024, 16)
        chips = line_chips(spec, codes, sound)
        if frame % every == 0:
            chips = chips + line_chips(spec, codes, weak, 0.045)
        chips = chips + rng.normal(0, 0.067, chips.shape)  # ρ = 20, of the faint words 3
        words = line.frame(chips).words
    health = line.pipeline.health
    assert health.nodes(NodeState.WEAK) == [12]
    assert not words.active[11], "it is not heard for that"
    assert (health.state[12:] == NodeState.UNHEARD).all()
