# SPDX-License-Identifier: Apache-2.0

"""The decoder against an independent line, and the code books against a second implementation."""

import re
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.doubt.lines import conditions
from benchmarks.doubt.mixtures import drawn
from benchmarks.doubt.tally import Tally
from benchmarks.doubt.words import BLIND, LineCondition, compare, decode, rival
from tactile_cdma.base.errors import SpecError
from tactile_cdma.code import codes
from test.support.independent_line import (
    SILENT,
    Digitizer,
    Line,
    Recording,
    Skin,
    Talk,
    code_book,
    default_order,
    factors,
    flips,
    render,
    row_sign,
)

PAGE = Path(__file__).resolve().parents[3] / "firmware" / "codes.md"


# The page, its second implementation, and the package


def test_the_page_defines_the_books_of_the_package() -> None:
    built = 0
    for order in (1, 2, *range(4, 205, 4)):
        try:
            expected = codes.code_book(order).rows(np.arange(order))
        except SpecError:
            with pytest.raises(ValueError, match="no code book"):
                code_book(order)
            continue
        assert np.array_equal(code_book(order), expected), order
        built += 1
    assert built > 40


def test_books_are_hadamard_and_as_printed_on_the_page() -> None:
    table = PAGE.read_text(encoding="utf-8").split("<!--begin:books-->")[1].split("<!--")[0]
    vectors = re.findall(r"\| (\d+) \| ([\d·]+) \| `(\w+)` \| (0x\w+) \|", table)
    assert {order for order, *_ in vectors} >= {"12", "20", "28", "36", "40", "100"}
    for text, parts, last, crc in vectors:
        order = int(text)
        assert "·".join(map(str, factors(order) or ())) == parts
        ones = (code_book(order) > 0).astype(np.uint8)
        padded = np.append(ones[-1], np.zeros(-order % 8, np.uint8))
        assert np.packbits(padded).tobytes().hex()[: len(last)] == last
        assert zlib.crc32(ones.tobytes()) == int(crc, 16)
        book = code_book(order).astype(int)
        assert np.array_equal(book @ book.T, order * np.eye(order))


def test_default_orders_are_chosen_as_the_page_says() -> None:
    for rows in (*range(1, 420), 1000, 1025, 2049, 4097):
        assert codes.default_order(rows) == default_order(rows), rows


@pytest.mark.parametrize("seed", [0, 1, 2**32 - 1])
def test_row_signs_as_printed_on_the_page(seed: int) -> None:
    table = PAGE.read_text(encoding="utf-8").split("<!--begin:signs-->")[1].split("<!--")[0]
    header, _, *lines = table.strip().splitlines()
    rows = [int(text) for text in re.findall(r"r = (\d+)", header)]
    printed = next(
        line.split("|")[2:-1] for line in lines if line.split("|")[1].strip() == str(seed)
    )
    assert [{"+": 1, "−": -1}[text.strip()] for text in printed] == [
        row_sign(row, seed) for row in rows
    ]


def test_chips_are_flipped_as_the_page_says() -> None:
    for order in (4, 12, 20, 64, 100):
        for seed in (0, 1, 2**32 - 1):
            assert np.array_equal(flips(17, order, seed), codes.chip_flips(17, order, seed)), order


# The renderer


FINE = Digitizer(samples_per_chip=21, adc_bits=16)
"""A sample of every cell in which the line is computed."""
SINGLE = Skin(nodes=1, order=2, bits=8, period_chips=64, amplitude_v=1.0)


def line_volts(line: Line, digitizer: Digitizer = FINE, skin: Skin = SINGLE) -> Recording:
    return render(skin, Talk(), replace(line, noise_v=0.0), digitizer, frames=3, seed=4)


def frame_volts(recording: Recording, number: int = 0) -> np.ndarray:
    """From a frame's mark on, until the next one's."""
    run = recording.runs[number + 1]
    assert run.marked
    return run.counts * recording.digitizer.volts_per_count


def test_chips_are_sums_of_waveforms_and_samples_begin_where_they_do() -> None:
    skin = Skin(nodes=2, order=4, bits=8, period_chips=64, amplitude_v=1.0)
    recording = line_volts(Line(), Digitizer(), skin)
    for number, truth in enumerate(recording.frames):
        volts = frame_volts(recording, number)
        chips = skin.waveforms(truth.codes).sum(axis=0)
        assert volts[: 4 * skin.chips] == pytest.approx(np.repeat(chips, 4), abs=1e-3)
        assert not volts[4 * skin.chips :].any()
    recording = line_volts(Line(start_jitter_chips=2, slip_share=0.5), Digitizer())
    for run, truth in zip(recording.runs[1:], recording.frames, strict=True):
        assert run.t_chips == pytest.approx(truth.start_chips + 1 / 8)
    means = line_volts(Line(), Digitizer(integrated=True, samples_per_chip=8))
    for run, truth in zip(means.runs, means.frames, strict=True):
        assert run.counts.size == SINGLE.chips
        volts = run.counts * means.digitizer.volts_per_count
        assert volts == pytest.approx(SINGLE.waveforms(truth.codes)[0], abs=1e-3)


def test_filters_ringing_ramps_and_amplitudes_are_as_told() -> None:
    """Row 1 of order 2 changes at every chip but the bits': the first chip is a step from 0."""
    t_chips = (np.arange(21) + 0.5) / 21
    clean, low, high = (
        frame_volts(line_volts(line))[:21]
        for line in (Line(), Line(low_pass_chips=0.4), Line(high_pass_hz=1000))
    )
    assert low == pytest.approx(clean * (1 - np.exp(-t_chips / 0.4)), abs=0.06)
    assert high == pytest.approx(clean * np.exp(-2 * np.pi * 1000 * 50e-6 * t_chips), abs=0.02)
    slow = Skin(nodes=1, order=1, bits=8, first_row=0, period_chips=64, amplitude_v=1.0)
    volts = frame_volts(line_volts(Line(ringing=0.4, ringing_chips=0.5), skin=slow))
    first = np.abs(volts[:21])
    assert first.max() == pytest.approx(1.4, abs=0.02)
    assert np.argmax(first) / 21 == pytest.approx(0.25, abs=0.06)
    volts = frame_volts(line_volts(Line(rise_chips=0.5, fall_chips=1.0)))
    first, up = volts[:21], volts[10] > 0
    half_at = np.interp(0.5, np.abs(first), (np.arange(21) + 0.5) / 21)
    assert half_at == pytest.approx(0.25 if up else 0.5, abs=0.03)
    sagging = np.abs(frame_volts(line_volts(Line(droop=0.5))))
    assert sagging[[10, 21 * 8 + 10]] == pytest.approx([1.0, 0.75], abs=1e-3)
    loud = np.abs(frame_volts(line_volts(Line(gains=((0, 1.5),)))))
    assert loud[10] == pytest.approx(1.5, abs=1e-3)
    rippled = line_volts(Line(ripple=0.2, ripple_hz=1000))
    levels = np.abs(frame_volts(rippled))[10 : 21 * SINGLE.chips : 21]
    t_s = (rippled.frames[0].start_chips + np.arange(SINGLE.chips)) * 50e-6
    assert levels == pytest.approx(1 + 0.2 * np.sin(2 * np.pi * 1000 * t_s), abs=1e-3)


def test_hum_impulses_jumps_and_offset_add_to_the_line() -> None:
    nobody = Skin(nodes=1, order=2, bits=8, period_chips=4000)
    recording = render(
        nobody, Talk(share=0), Line(noise_v=0, hum_v=1, offset_v=2), FINE, frames=3, seed=1
    )
    volts = np.concatenate([run.counts for run in recording.runs]) * FINE.volts_per_count
    assert volts.min() == pytest.approx(1, abs=1e-3)
    assert volts.max() == pytest.approx(3, abs=1e-3)
    for line in (Line(noise_v=0, impulses_hz=200), Line(noise_v=0, steps_hz=200, step_v=1)):
        recording = render(nobody, Talk(share=0), line, FINE, frames=3, seed=1)
        changes = np.diff(np.concatenate([run.counts for run in recording.runs]))
        ups = changes[changes > 0].sum() * FINE.volts_per_count
        # Two edges per impulse; jumps go up every other time. 6 periods of 0.2 s.
        expected = 200 * 0.2 * len(recording.runs) * (1 if line.impulses_hz else 0.5)
        assert ups == pytest.approx(expected, rel=0.4)


def test_noise_of_a_chip_is_what_was_asked_for() -> None:
    silent = Talk(share=0)
    for digitizer in (Digitizer(), Digitizer(integrated=True, samples_per_chip=8)):
        recording = render(Skin(), silent, Line(noise_v=0.1), digitizer, frames=20, seed=1)
        volts = np.concatenate([run.counts for run in recording.runs]) * digitizer.volts_per_count
        per_chip = 1 if digitizer.integrated else digitizer.samples_per_chip
        chips = volts[: volts.size // per_chip * per_chip].reshape(-1, per_chip).mean(axis=1)
        assert chips.std() == pytest.approx(0.1, rel=0.1)


def test_frames_stretch_slip_and_jitter_where_the_truth_says() -> None:
    line = Line(stretch=0.1, start_jitter_chips=3, slip_share=0.5, clock_error=0.01)
    recording = render(Skin(), Talk(speakers=1), line, Digitizer(), frames=50, seed=1)
    starts = np.array([truth.start_chips for truth in recording.frames])
    chips = np.array([truth.chip for truth in recording.frames])
    assert 1.01 <= chips.min() < 1.02
    assert 1.1 < chips.max() <= 1.01 * 1.1
    off = np.diff(starts) - 1.01 * Skin().period_chips
    assert np.abs(off).max() <= 4.3  # the jitter, a slip, and rounding to samples
    assert np.unique(np.round(off)).size > 5
    for number, truth in enumerate(recording.frames):
        loud = np.flatnonzero(np.abs(frame_volts(recording, number)) > 0.1)
        assert loud[-1] / 4 == pytest.approx(truth.chip * Skin().chips, abs=0.5)


def test_rails_clip_and_lost_samples_leave_holes() -> None:
    for ratio, low, high in ((0.5, 0.0, 0.05), (1.0, 0.4, 0.8), (1.5, 0.95, 1.0)):
        recording = line_volts(Line(offset_v=6 * ratio), Digitizer(), Skin())
        assert all(low <= truth.clipped <= high for truth in recording.frames), ratio
    lossy = Digitizer(losses_hz=50)
    recording = render(Skin(), Talk(), Line(), lossy, frames=50, seed=1)
    ends = [run.first_index + run.counts.size for run in recording.runs]
    gaps = [b.first_index - end for b, end in zip(recording.runs[1:], ends, strict=False)]
    assert min(gaps) == 0
    assert 10 < sum(gap > 0 for gap in gaps) < 50
    first = recording.runs[0]
    for run in recording.runs:
        assert run.t_chips - first.t_chips == pytest.approx(run.first_index / 4)


def test_nodes_join_and_leave() -> None:
    rng = np.random.default_rng(1)
    speaks = Talk(share=0.3, stay=10).codes(Skin(nodes=50), 2000, rng) != SILENT
    assert speaks.mean() == pytest.approx(0.3, abs=0.02)
    changes = np.mean(speaks[1:] != speaks[:-1])
    assert changes == pytest.approx(2 * 0.3 * 0.7 / 10, rel=0.1)
    together = Talk(together=2, words="equal").codes(Skin(), 100, rng)
    assert (np.sum(together != SILENT, axis=1) == 2).all()
    assert all(len(np.unique(row[row != SILENT])) == 1 for row in together)
    few = Talk(speakers=3).codes(Skin(), 10, rng) != SILENT
    assert few.all(axis=0).sum() == few.any(axis=0).sum() == 3


def test_a_rival_gives_exactly_the_same_waveform() -> None:
    """Shifted by so many chips, with silence at its ends."""
    found = 0
    for order in (12, 16, 20):
        skin = Skin(nodes=order - 1, order=order)
        for sent in Talk(together=2, words="equal").codes(skin, 300, np.random.default_rng(2)):
            other = rival(skin, sent)
            if other is None:
                continue
            shift, words = other
            assert not np.array_equal(words, sent)
            mine, theirs = (
                np.pad(skin.waveforms(some).sum(axis=0), (10 + late, 10 - late))
                for some, late in ((sent, 0), (words, shift))
            )
            assert mine == pytest.approx(theirs)
            found += 1
    assert found > 30


def test_the_same_seed_gives_the_same_recording() -> None:
    line = Line(stretch=0.1, hum_v=0.1, impulses_hz=100, steps_hz=10, step_v=0.1, spread=0.1)
    first, second, other = (
        render(Skin(), Talk(), line, Digitizer(), frames=3, seed=seed) for seed in (1, 1, 2)
    )
    for run, same in zip(first.runs, second.runs, strict=True):
        assert np.array_equal(run.counts, same.counts)
    assert not np.array_equal(first.runs[1].counts, other.runs[1].counts)


# The decoder, where it must be right


@pytest.mark.parametrize(
    "digitizer",
    [Digitizer(), Digitizer(integrated=True, samples_per_chip=8), Digitizer(marked=False)],
    ids=["marks", "means", "gap"],
)
@pytest.mark.parametrize(
    "skin",
    [
        Skin(nodes=15, order=16, period_chips=208, polarity=-1),
        Skin(first_row=0, order=16, sign_seed=None, period_chips=208),
        Skin(drive="unipolar", sign_seed=77),
        Skin(nodes=19, parity=True, bits=12, period_chips=340),
        Skin(nodes=40, order=52, period_chips=680, amplitude_v=0.1),
    ],
    ids=["order 16", "paper", "unipolar", "parity", "order 52"],
)
def test_a_sound_line_is_heard_without_a_flag(skin: Skin, digitizer: Digitizer) -> None:
    recording = render(skin, Talk(), Line(), digitizer, frames=40, seed=1)
    tally, complaints = compare(recording, decode(recording), Line())
    assert not complaints
    assert tally == Tally(words=40 * skin.nodes, right=40 * skin.nodes)


def test_words_of_a_frame_that_was_not_decoded_are_lost() -> None:
    recording = render(Skin(), Talk(), Line(), Digitizer(), frames=4, seed=0)
    tally, _ = compare(recording, decode(recording)[:3], Line())
    assert (tally.right, tally.lost, tally.unflagged) == (48, 16, 0)


def test_other_words_are_counted_as_what_they_are() -> None:
    """The judge itself: words altered after decoding appear in their columns."""
    talk = Talk(speakers=(0, 1, 2))
    recording = render(Skin(), talk, Line(), Digitizer(), frames=3, seed=0)
    decoded = decode(recording)
    decoded[0].words.codes[0] ^= 1
    decoded[1].words.active[1] = False
    decoded[2].words.active[7] = True
    tally, complaints = compare(recording, decoded, Line())
    assert tally == Tally(words=9, right=7, missed=1, wrong=1, invented=1, phantom=1, silences=38)
    assert len(complaints) == 3
    assert all((truth.codes[3:] == SILENT).all() for truth in recording.frames)


# The decoder, where it must not claim what it did not hear


@pytest.mark.parametrize(
    ("name", "seed"),
    [
        ("marks: hum of 2 A", 3),
        ("marks: skew 0.4 chip", 3),
        ("marks: high-pass 500 Hz, two nodes", 3),
        ("marks: offset 1.05 x rail", 3),
        ("marks: 5 losses/s", 3),
        ("marks: 1000 impulses/s of 1 V, two nodes", 3),
        ("means: stretch 0.5 %", 3),
        ("means: offset 1.05 x rail", 3),
        ("means: 1000 impulses/s of 1 V, two nodes", 3),
        ("means: a node 0.6 chip late", 3),
        ("gap: offset 1.3 x rail", 3),
        ("gap: hum of A/3", 3),
        ("gap: 5 losses/s", 3),
        ("gap: jitter 3 chips", 3),
        ("gap: high-pass 500 Hz, two nodes", 2),
        ("gap: order 16, two nodes, equal words, jitter 3 chips, low-pass", 29),
        ("gap: a node 2 chips late", 3),
        ("gap: 1000 impulses/s of 1 V, two nodes", 5),
        ("gap: a node 0.6 chip late", 4),
    ],
)
def test_nothing_is_claimed_that_was_not_heard(name: str, seed: int) -> None:
    """Every node that speaks on a bad line is heard, flagged, or lost with its frame."""
    claim_what_was_heard(name, 50, seed)


def test_jitter_of_a_chip_and_hum_alone_claim_nothing() -> None:
    """Half a chip off, two nodes with equal words look like two others."""
    for seed in range(2):
        name = "gap: order 16, two nodes, equal words, jitter 1 chip"
        claim_what_was_heard(name, 250, [zlib.crc32(name.encode()), seed])
    # Loud hum looks like a frame half a period before one in which nodes speak.
    name = "gap: hum of 2 A, 625 Hz"
    claim_what_was_heard(name, 60, [zlib.crc32(name.encode()), 19])


def test_samples_taken_while_levels_change_put_no_weak_node_in_doubt() -> None:
    name = "gap: a node at 0.6 A"
    condition = next(some for some in conditions() if some.name == name)
    tally, _ = condition.run(60, 0)
    assert tally.right > 140 and not tally.unflagged
    assert tally.flagged_share < 0.01 and tally.silent_flagged_share < 0.01


@pytest.mark.parametrize("late", [2.2, 1.0, -1.0])
def test_nodes_out_of_time_by_chips_are_not_taken_for_others_between_gaps(late: float) -> None:
    """Words of equal bits are another row's, or inverted, and but the gap shows whose they are."""
    false = right = 0
    for node in (1, 5, 9):
        line = Line(late=((node, late),), noise_v=0.015)
        talk, skin = Talk(share=0.3, stay=8, words="extreme"), Skin(nodes=15, order=20)
        tally, _ = LineCondition(f"node {node} {late} late", line, talk, skin, BLIND).run(40, 0)
        false, right = false + tally.unflagged, right + tally.right
    assert right > 100 and not false


@pytest.mark.parametrize(
    ("number", "frames", "seed", "least"),
    [(161, 250, 2, 800), (91, 100, 2, 2000)],
    ids=["frame off its raster", "chips that alternate, half a chip late"],
)
def test_nodes_out_of_time_are_in_doubt(number: int, frames: int, seed: int, least: int) -> None:
    """Where levels jump, frames begin chips late; ends alone tell a row from another's shift.

    The words are those that were sent, but with a node that is always late all are in doubt.
    """
    tally, _ = drawn(number).run(frames, seed)
    assert tally.right + tally.flagged > least and not tally.unflagged


def claim_what_was_heard(name: str, frames: int, seed: int | list[int]) -> None:
    condition = next(some for some in conditions() if some.name == name)
    talk, line, digitizer = condition.talk, condition.line, condition.digitizer
    recording = render(condition.skin, talk, line, digitizer, frames=frames, seed=seed)
    tally, complaints = compare(recording, decode(recording), line)
    assert tally.words >= 60
    assert not complaints
    assert (tally.rail_silent, tally.phantom) == (0, 0)
    assert (
        tally.right + tally.flagged + tally.tied + tally.wrong_flagged + tally.lost >= tally.words
    )
