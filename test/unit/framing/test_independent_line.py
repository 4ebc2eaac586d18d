# SPDX-License-Identifier: Apache-2.0

"""The decoder against an independent line, and the code books against a second implementation."""

from __future__ import annotations

import re
import zlib
from pathlib import Path

import numpy as np
import pytest

from benchmarks.doubt import Tally, compare, decode
from benchmarks.independent_line import (
    SILENT,
    Digitizer,
    Line,
    Skin,
    Talk,
    code_book,
    render,
    row_sign,
)
from tactile_cdma.base.errors import SpecError
from tactile_cdma.code import codes

PAGE = Path(__file__).resolve().parents[3] / "docs" / "protocol.md"


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
    table = PAGE.read_text(encoding="utf-8").split("<!-- begin books -->")[1].split("<!--")[0]
    vectors = re.findall(r"\| (\d+) \| [\d·]+ \| `(\w+)` \| (0x\w+) \|", table)
    assert {order for order, *_ in vectors} >= {"12", "20", "28", "36", "40", "100"}
    for text, last, crc in vectors:
        order = int(text)
        ones = (code_book(order) > 0).astype(np.uint8)
        padded = np.append(ones[-1], np.zeros(-order % 8, np.uint8))
        assert np.packbits(padded).tobytes().hex()[: len(last)] == last
        assert zlib.crc32(ones.tobytes()) == int(crc, 16)
        book = code_book(order).astype(int)
        assert np.array_equal(book @ book.T, order * np.eye(order))


@pytest.mark.parametrize("seed", [0, 1, 2**32 - 1])
def test_row_signs_as_printed_on_the_page(seed: int) -> None:
    table = PAGE.read_text(encoding="utf-8").split("<!-- begin signs -->")[1].split("<!--")[0]
    header, _, *lines = table.strip().splitlines()
    rows = [int(text) for text in re.findall(r"r = (\d+)", header)]
    printed = next(
        line.split("|")[2:-1] for line in lines if line.split("|")[1].strip() == str(seed)
    )
    assert [{"+": 1, "−": -1}[text.strip()] for text in printed] == [
        row_sign(row, seed) for row in rows
    ]


# The renderer


def test_cells_are_exact_means_of_the_steps() -> None:
    """With 2 codes at ±A and nothing else, samples away from edges are sums of ±A."""
    skin = Skin(nodes=2, order=4, bits=8, period_chips=64, amplitude_v=1.0)
    quiet = Line(noise_v=0.0)
    recording = render(skin, Talk(), quiet, Digitizer(), frames=5, seed=1)
    volts = np.concatenate([run.counts for run in recording.runs]) * (6.0 / 2**13)
    assert set(np.round(volts, 1)) == {-2.0, 0.0, 2.0}
    for run, truth in zip(recording.runs[1:], recording.frames, strict=True):
        assert run.marked
        assert 0 <= run.t_chips - truth.start_chips < 0.25
        chips = run.counts[: 4 * skin.chips].reshape(-1, 4).mean(axis=1) * (6.0 / 2**13)
        assert chips == pytest.approx(skin.waveforms(truth.codes).sum(axis=0), abs=1e-2)


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
    assert tally == Tally(words=9, right=7, missed=1, wrong=1, invented=1, phantom=1)
    assert len(complaints) == 3
    assert all((truth.codes[3:] == SILENT).all() for truth in recording.frames)
