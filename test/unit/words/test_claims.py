# SPDX-License-Identifier: Apache-2.0

"""Silence and words are claims: doubt about single words, and the health of a node from many."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from benchmarks.doubt.lines import Condition, plain_conditions
from benchmarks.doubt.mixtures import drawn, mixture_of
from benchmarks.doubt.tally import Tally
from benchmarks.doubt.words import TIMINGS, compare, decode
from tactile_cdma.base.arrays import Floats32
from tactile_cdma.code.encode import line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.code.transform import chips_of, rows_of
from tactile_cdma.driver.pipeline import TactileFrame
from tactile_cdma.readings.status import Status
from tactile_cdma.words.health import JUDGE_FRAMES, NodeState
from test.support.chip_line import ChipLine, hear, read_chips
from test.support.examples import examples
from test.support.independent_line import Line, Skin, Talk, render

FEW = Talk(speakers=(0, 2, 3, 5), share=0.6, stay=8)
OLD = Skin(order=16, first_row=0, sign_seed=None, polarity=-1, period_chips=208)
FALSE_ONCE = [(number, 0) for number in (68, 74, 221, 416, 541, 624, 806, 1124)]
FALSE_ONCE += [(497, 1), (827, 1), (34, 2), (48, 2), (91, 2), (126, 2), (16, 3), (129, 3)]
"""Random mixtures, by their names and seeds in `make bench-doubt`. Three more are false still: see
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


@pytest.mark.parametrize(("number", "seed"), FALSE_ONCE)
def test_what_was_claimed_falsely_once_is_flagged(number: int, seed: int) -> None:
    counts, complaints = drawn(number).run(250, seed)
    assert not counts.false, complaints
    assert counts.words > 20


@pytest.mark.parametrize("timing", ["marks", "means", "gap"])
@pytest.mark.parametrize("words", ["equal", "slow"])
def test_what_is_clipped_hides_no_weak_node(words: str, timing: str) -> None:
    """The converter's lower rail is 1.4 A below rest: clipped samples hold less of the node."""
    skin = Skin(nodes=7, order=8, period_chips=104)
    line = Line(offset_v=0.3 * 1.4 - 6, gains=((1, 0.21),), noise_v=0.03)
    counts = tally(line, Talk(share=0.4, words=words), skin, timing, 150)
    assert counts.right > 40
    assert counts.wrong_flagged > 40


def test_at_a_rail_nobody_is_silent_for_certain() -> None:
    """The same word of two nodes, of which the rail takes all that the weak one adds."""
    name = "gap: a rail at 1 A on one side, a weak node, equal words"
    [condition] = (one for one in plain_conditions() if one.name == name)
    counts, complaints = condition.run(60, 0)
    assert not counts.unflagged, complaints
    assert counts.right and counts.silent_flagged > 20
    # No word is left of it, and no more than noise; but noise reaches no rail.
    counts, complaints = mixture_of(395).run(250, 2)
    assert not counts.unflagged, complaints
    assert counts.wrong_flagged > 10


@pytest.mark.parametrize("scramble", [False, True])
@pytest.mark.parametrize("late", [0.0, 0.7, 1.0, 1.3, -1.0])
def test_a_node_that_is_late_after_restarts_moves_no_frame(late: float, scramble: bool) -> None:
    """Two speak; the one that is in time was published as the row beside it."""
    skin = replace(LONG, restart_chips=40, guard_chips=3, period_chips=640, scramble=scramble)
    line, talk = Line(late=((32, late),), noise_v=0.01), Talk((31, 32), 0.8)
    counts = tally(line, talk, skin, "marks", 60)
    assert counts.words > 80
    assert counts.right < 20 if late else counts.right == counts.words


@pytest.mark.parametrize("scramble", [False, True])
def test_a_level_that_moves_from_bit_to_bit_is_on_no_row(scramble: bool) -> None:
    """Codes as short as possible: the level would show most on their rows."""
    spec = FrameSpec(nodes=3, order=4, scramble=scramble)
    chips = line_chips(spec, [7, 0, 0], [True, False, False])
    moving = chips + np.linspace(-0.1, 0.1, spec.bits)[:, None]
    frame = ChipLine(spec, nodes=3).frame(moving)
    assert frame.certificate is not None and frame.certificate.rest > 0.5, "it does move"
    assert frame.certificate.atoms < 0.05
    assert frame.words.active.tolist() == [True, False, False]
    assert not (frame.words.faint | frame.words.doubtful).any()


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


def test_tones_and_hum_that_hide_words_are_no_silence() -> None:
    line = Line(hum_v=0.41, hum_hz=1115, rise_chips=0.44, noise_v=0.03)
    skin = Skin(
        nodes=59, order=64, bits=12, first_row=0, sign_seed=None, chip_s=53e-6, period_chips=937,
        amplitude_v=0.156,
    )  # fmt: skip
    counts = tally(line, Talk(together=2, words="extreme"), skin, "marks", 30)
    assert counts.wrong_flagged + counts.lost > 20, "it hides words"
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


SPEC = FrameSpec()
PARITY = FrameSpec(parity=True)
SWING = 0.3


def rows(codes: NDArray[np.int64], spec: FrameSpec = SPEC) -> Floats32:
    """What every row holds where these words are sent, (k, N), V."""
    return rows_of(line_chips(spec, codes).astype(np.float32), spec)


def sigma(rho: float, spec: FrameSpec = SPEC) -> float:
    return SWING * float(np.sqrt(spec.order)) / rho


def noisy(levels: Floats32, spec: FrameSpec, rho: float, rng: np.random.Generator) -> Floats32:
    chips = chips_of(levels, spec)
    return (chips + rng.normal(0, sigma(rho, spec), chips.shape)).astype(np.float32)


@examples(50)
@given(st.integers(8, 16), st.sampled_from([1, -1]), st.integers(0, 2**32 - 1))
def test_parity_changes_no_word(bits: int, polarity: int, seed: int) -> None:
    spec = FrameSpec(bits=bits, parity=True, polarity=polarity, frame_period_s=0.1)
    codes = np.random.default_rng(seed).integers(0, 1 << bits, spec.nodes)
    words = read_chips(line_chips(spec, codes), spec)
    assert words.active.all() and not words.doubtful.any()
    assert np.array_equal(words.codes, codes)


@given(st.integers(0, 10), st.integers(0, 15), st.integers(0, 2**32 - 1))
def test_parity_mends_the_weakest_bit_and_says_so(bit: int, node: int, seed: int) -> None:
    codes = np.random.default_rng(seed).integers(0, 1024, 16)
    levels = rows(codes, PARITY)
    levels[bit, PARITY.first_row + node] *= -0.1  # the noise has just turned it
    words = read_chips(chips_of(levels, PARITY), PARITY)
    assert np.array_equal(words.codes, codes)
    assert words.doubtful[node]
    assert np.flatnonzero(words.odd).tolist() == [node]


def test_parity_takes_nearly_all_wrong_words_at_low_snr() -> None:
    rng, rho = np.random.default_rng(7), 3.3
    wrong = {}
    for spec in (SPEC, PARITY):
        count = 0
        for _ in range(600):
            codes = rng.integers(0, 1024, 16)
            words = read_chips(noisy(rows(codes, spec), spec, rho, rng), spec, sigma(rho, spec))
            count += int((words.codes != codes)[words.active].sum())
        wrong[spec.parity] = count / (600 * 16)
    # k·Q(ρ) = 4.8e-3 without; with, at least two bits must be wrong: C(11, 2)·Q(√2·ρ)·… < 1e-4.
    assert wrong[False] > 3e-3
    assert wrong[True] < 3e-4


def test_confidence_is_the_share_of_right_bits() -> None:
    """Among words of equal confidence p, the weakest bit is right in a share p of cases."""
    rng, rho = np.random.default_rng(8), 2.7
    spec = FrameSpec(nodes=64, chip_s=1e-5)
    expected = right = total = 0.0
    for _ in range(300):
        codes = rng.integers(0, 1024, spec.nodes)
        words = read_chips(noisy(rows(codes, spec), spec, rho, rng), spec, sigma(rho, spec))
        unsure = words.active & (words.confidence < 0.99)
        expected += float(words.confidence[unsure].sum())
        right += int((words.codes == codes)[unsure].sum())
        total += int(unsure.sum())
    assert total > 2000
    # The word is wrong somewhere else in a few cases, and amplitude and noise are estimates.
    assert right / total == pytest.approx(expected / total, abs=0.04)


def show(line: ChipLine, change: str, frames: int = 4 * JUDGE_FRAMES) -> TactileFrame:
    """Send frames in which node 5 is not as it should be; returns the last one."""
    rng, spec = np.random.default_rng(9), line.spec
    own = spec.first_row + 4
    for _ in range(frames):
        levels = rows(rng.integers(0, 1024, 16), spec)
        if change == "weak":
            levels[:, own] *= 0.35
        elif change in ("doubled", "tripled"):
            for _ in range(2 if change == "tripled" else 1):
                levels[:, own] += rows(rng.integers(0, 1024, 16), spec)[:, own]
        elif change == "doubled, same word":
            levels[:, own] *= 2
        elif change == "broken":
            levels[::3, own] *= 0.1
        elif change == "missing":
            levels[:, own] *= 0.0
        elif change == "inverted":
            levels[:, own] *= -1
        elif change == "other last bit":
            levels[-1, own] *= rng.choice([-1, 1])
        frame = line.frame(noisy(levels, spec, 60.0, rng))
    return frame


@pytest.mark.parametrize("change", ["inverted", "other last bit"])
def test_parity_tells_of_a_node_whose_even_words_are_wrong(change: str) -> None:
    line = ChipLine(PARITY)
    show(line, change)
    assert line.pipeline.health.nodes(NodeState.FAULTY) == [5]
    assert np.flatnonzero(line.pipeline.health.invalid).tolist() == [4]


def test_noise_that_parity_mends_makes_no_node_faulty() -> None:
    rng, line = np.random.default_rng(13), ChipLine(PARITY)
    for _ in range(8 * JUDGE_FRAMES):
        line.frame(noisy(rows(rng.integers(0, 1024, 16), PARITY), PARITY, 3.5, rng))
        assert not line.pipeline.health.invalid.any()


@pytest.mark.parametrize(
    ("change", "state"),
    [
        ("none", NodeState.OK),
        ("weak", NodeState.WEAK),
        ("doubled", NodeState.DOUBLED),
        ("tripled", NodeState.DOUBLED),
        ("doubled, same word", NodeState.DOUBLED),
        ("broken", NodeState.FAULTY),
        ("missing", NodeState.UNHEARD),
    ],
)
@pytest.mark.parametrize("known", [True, False])
def test_nodes_not_as_they_should_be_are_named(change: str, state: NodeState, known: bool) -> None:
    line = ChipLine(SPEC if known else replace(SPEC, amplitude_v=None))
    show(line, change)
    health = line.pipeline.health
    assert health.state[4] == state
    assert np.delete(health.state, 4).tolist() == [NodeState.OK] * 15
    assert health.nodes(state) == ([5] if state != NodeState.OK else list(range(1, 17)))


def test_a_node_that_only_tells_that_it_lives_is_sound_until_it_dies() -> None:
    """Every node speaks once in 78 frames, as at rest."""
    rng, line = np.random.default_rng(11), ChipLine(SPEC)
    for frame in range(78 * 12):
        active = np.arange(16) == frame % 78
        line.frame(line_chips(SPEC, rng.integers(0, 1024, 16), active))
    assert line.pipeline.health.nodes(NodeState.OK) == list(range(1, 17))
    line = ChipLine(SPEC, stale_after_s=0.5)
    show(line, "none", 64)
    assert line.pipeline.taxels.missing == []
    show(line, "missing", 64)
    assert line.pipeline.taxels.missing == [5]


@pytest.mark.parametrize("change", ["weak", "doubled", "broken"])
def test_a_node_that_recovers_is_sound_again(change: str) -> None:
    line = ChipLine(SPEC)
    show(line, change)
    show(line, "none", 6 * JUDGE_FRAMES)
    assert line.pipeline.health.state[4] == NodeState.OK


def test_a_weak_node_is_heard_and_a_broken_one_costs_only_itself_once_known() -> None:
    line = ChipLine(SPEC)
    assert not show(line, "weak", 1).words.active[4]
    words = show(line, "weak").words
    assert words.active[4] and not words.doubtful[4]
    # So does one whose row another one shares.
    for change in ("broken", "doubled"):
        line = ChipLine(SPEC)
        assert show(line, change, 1).words.doubtful.any()
        words = show(line, change).words
        assert line.pipeline.health.invalid[4]
        assert words.active.all() and not np.delete(words.doubtful, 4).any()


def test_noise_makes_no_weak_nodes() -> None:
    rng, line = np.random.default_rng(10), ChipLine(SPEC)
    for _ in range(500):
        line.frame(rng.normal(0, 0.15, (10, 20)))
    state = line.pipeline.health.state
    assert not np.isin(state, [NodeState.WEAK, NodeState.DOUBLED, NodeState.FAULTY]).any()


@pytest.mark.parametrize(
    ("change", "flag", "valid"),
    [
        ("weak", Status.WEAK, True),
        ("doubled", Status.FAULTY, False),
        ("broken", Status.FAULTY, False),
    ],
)
def test_status_tells_and_they_are_no_pressure(change: str, flag: Status, valid: bool) -> None:
    readings = show(ChipLine(SPEC), change).readings
    assert readings.status[4] & flag
    assert np.isfinite(readings.pressure_pa[4]) == valid
    assert np.isfinite(np.delete(readings.pressure_pa, 4)).all()
    assert not (np.delete(readings.status, 4) & flag).any()


@given(st.integers(0, 9), st.integers(0, 19), st.floats(-20.0, 20.0), st.integers(0, 2**32 - 1))
@examples(100)
def test_hits_of_one_chip_make_no_false_word(bit: int, place: int, size: float, seed: int) -> None:
    """Every row takes as much of it, with either sign. size: times what turns a bit of one."""
    rng = np.random.default_rng(seed)
    codes = rng.integers(0, 1024, 16)
    chips = noisy(rows(codes), SPEC, 100.0, rng)
    chips[bit, place] += SPEC.order * SWING * size
    frame = hear(chips, SPEC, sigma(100.0))
    if frame is not None and frame.words is not None:
        words = frame.words
        assert (words.doubtful | (words.active & (words.codes == codes))).all()


def test_what_hits_a_row_or_is_too_loud_is_doubtful() -> None:
    rng = np.random.default_rng(13)
    codes = rng.integers(0, 1024, 16)
    for size in (1.0, 1.5, 2.5, 4.0):
        levels = rows(codes)
        own = SPEC.first_row + 7
        levels[2, own] -= np.sign(levels[2, own]) * SWING * size
        assert read_chips(noisy(levels, SPEC, 100.0, rng), SPEC, sigma(100.0)).doubtful[7]
    levels = rows(np.arange(16))
    levels[:, SPEC.first_row + 4] *= 2.0
    assert np.flatnonzero(read_chips(chips_of(levels, SPEC), SPEC).doubtful).tolist() == [4]
