# SPDX-License-Identifier: Apache-2.0

"""Sparse codes: the book by the document, what it is for, and who is found in a frame."""

import re
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.base.errors import SpecError
from tactile_cdma.code.codes import code_book
from tactile_cdma.code.encode import line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.code.sparse import TAPS
from tactile_cdma.code.transform import chips_of, rows_of
from tactile_cdma.code.twins import ALIKE, SHIFTS, twins
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.framing.load import groups_for_all
from tactile_cdma.wire._protocol import Signs
from tactile_cdma.wire.messages import FrameLayout
from test.support.examples import examples
from test.support.single_frames import SingleReader
from test.support.sparse_codes import code_number, node_chips, octets

PAGE = Path(__file__).parents[3] / "firmware/codes.md"


def sparse(nodes: int, order: int, **changes: Any) -> FrameSpec:
    fields: dict[str, Any] = {"amplitude_v": 1.0, "chip_s": 1e-6, "frame_period_s": 1.0}
    return FrameSpec(nodes=nodes, order=order, codes="sparse", **{**fields, **changes})


@pytest.mark.parametrize("m", TAPS)
def test_states_repeat_after_all_others(m: int) -> None:
    state, seen = 1, 0
    while seen == 0 or state != 1:
        parity = (state & 1) ^ (sum(state >> a & 1 for a in TAPS[m]) & 1)
        state, seen = state >> 1 | parity << m - 1, seen + 1
    assert seen == 2**m - 1


def test_the_pages_vectors_are_those_of_an_implementation_by_the_page() -> None:
    table = PAGE.read_text().partition("<!--begin:sparse-->")[2].partition("<!--end-->")[0]
    rows = re.findall(r"\| (\d+) \| (\d+) \| (\d+) \| (\d+) \| (\d+) \| `(\w+)` \| 0x(\w+)", table)
    assert len(rows) == 8
    for *numbers, first, crc in rows:
        nodes, order, bits, node, code = map(int, numbers)
        m = max(nodes, order).bit_length()
        made = bytes(octets(code_number(node, m), m, bits * -(-order // 8)))
        assert code_number(node, m) == code
        assert (made[:12].hex(), zlib.crc32(made)) == (first, int(crc, 16))


@pytest.mark.parametrize(("nodes", "order", "bits"), [(20, 8, 8), (100, 37, 10), (900, 250, 16)])
def test_chips_are_those_of_the_page(nodes: int, order: int, bits: int) -> None:
    spec = sparse(nodes, order, bits=bits, sign_seed=7)
    for node in (1, 2, nodes // 2, nodes):
        active = np.arange(1, nodes + 1) == node
        word = np.full(nodes, (1 << bits) - 1)
        sent = line_chips(spec, word, active)
        assert np.array_equal(sent, node_chips(node, nodes, order, bits, seed=7))


def test_rows_are_correlations_with_all_codes() -> None:
    spec = sparse(100, 40, bits=8)
    chips = np.random.default_rng(0).normal(size=(8, 40)).astype(np.float32)
    book = np.stack([node_chips(node, 100, 40, 8) for node in range(1, 101)])
    expected = np.einsum("nkc,kc->kn", book, chips) / 40
    assert np.allclose(rows_of(chips, spec)[:, spec.rows] * spec.signs, expected, atol=1e-6)
    rows = np.zeros((8, spec.row_count), np.float32)
    rows[:, 1:101] = np.random.default_rng(1).normal(size=(8, 100))
    sent = np.einsum("nkc,kn->kc", book, rows[:, 1:101] * spec.signs)
    assert np.allclose(chips_of(rows, spec), sent, atol=1e-5)


@pytest.mark.parametrize(("nodes", "order"), [(60, 32), (1000, 128)])
@pytest.mark.parametrize("seed", [0, 1, 99])
def test_a_late_node_looks_like_no_other(nodes: int, order: int, seed: int) -> None:
    """It would be another one, in full, if chips were not flipped."""
    spec = sparse(nodes, order, sign_seed=seed)
    for node in (1, nodes):
        for flipped in (True, False):
            sent = np.zeros(spec.chips + 16, np.float32)
            sent[8:-8] = node_chips(node, nodes, order, 10, seed, flipped).ravel()
            for late in (*range(-8, 0), *range(1, 9)):
                read = sent[8 - late : 8 - late + spec.chips].reshape(10, order)
                if not flipped:
                    assert spec.flips is not None
                    read = read * spec.flips
                alike = np.abs(rows_of(read, spec)[:, 1:]).mean(axis=0).max()
                assert alike < 0.5 if flipped else alike > 0.5


def test_every_bit_has_codes_of_its_own() -> None:
    """Nodes whose chips are alike in one bit are told apart by the others."""
    spec = sparse(200, 8)
    assert spec.flips is not None
    alike = np.abs(rows_of(spec.flips, spec)[:, 1:])
    assert alike.max() == 1
    assert alike.mean(axis=0).max() < 0.5


@given(st.data())
@examples(60)
def test_all_who_speak_are_found(data: st.DataObject) -> None:
    """Up to a quarter as many as chips, with amplitudes of their own, an offset and noise."""
    order = data.draw(st.sampled_from([32, 40, 64, 96]))
    nodes = data.draw(st.integers(order, 8 * order))
    spec = sparse(nodes, order, bits=data.draw(st.integers(8, 16)))
    speakers = data.draw(st.sets(st.integers(1, nodes), max_size=order // 4))
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    chips = rng.normal(0.3, np.sqrt(order) / 50, (spec.bits, order))
    words = np.zeros(nodes, np.int32)
    for node in speakers:
        word = rng.choice([-1.0, 1.0], spec.bits)
        chips += rng.uniform(0.6, 1.05) * node_chips(node, nodes, order, spec.bits) * word[:, None]
        words[node - 1] = (word > 0) @ (1 << np.arange(spec.bits)[::-1])
    frame = SingleReader(spec, 1 / spec.chip_s).read(chips.ravel().astype(np.float32))
    assert frame is not None and frame.words is not None and frame.speakers == len(speakers)
    assert set(np.flatnonzero(frame.words.active) + 1) == speakers
    assert np.array_equal(frame.words.codes, words)
    # It is the chips' mean, and so holds the words', too.
    by_chance = 5 * np.sqrt((1 + len(speakers)) / spec.chips)
    assert frame.level_v == pytest.approx(0.3, abs=by_chance)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"timing": "gap", "samples_per_chip": 4}, "it must be 'line'"),
        ({"samples_per_chip": 4}, "it must be 1"),
        ({"amplitude_mv": 0.0}, "set amplitude_mv"),
    ],
)
def test_how_sparse_codes_cannot_be_read_is_refused(changes: dict[str, Any], reason: str) -> None:
    values = {"codes": "sparse", "nodes": 40, "order": 16, "samples_per_chip": 1}
    SkinConfig.of(values)
    with pytest.raises(SpecError, match=reason):
        SkinConfig.of({**values, **changes})


@pytest.mark.parametrize(
    ("nodes", "order", "groups"),
    [(16, 64, 1), (4000, 912, 8), (80, 64, 8), (20, 8, 0), (16_000, 912, 0)],
)
def test_that_all_cannot_speak_by_turns_is_told(
    nodes: int, order: int, groups: int, caplog: pytest.LogCaptureFixture
) -> None:
    values = {"codes": "sparse", "nodes": nodes, "order": order, "samples_per_chip": 1}
    assert groups_for_all(SkinConfig.of({**values, "frame_period_ms": 0.0}).spec) == groups
    assert ("set order to more than" in caplog.text) == (groups == 0)


def test_an_order_that_cannot_be_is_not_advised(caplog: pytest.LogCaptureFixture) -> None:
    values = {"codes": "sparse", "nodes": 65_535, "order": 4096, "samples_per_chip": 1}
    SkinConfig.of({**values, "frame_period_ms": 0.0})
    assert "no order is enough for more than 41264 nodes" in caplog.text


def test_the_wire_says_it() -> None:
    spec = sparse(4000, 912, frame_period_s=0.02, amplitude_v=None)
    layout = FrameLayout.of(spec, 1)
    assert layout.signs == Signs.SPARSE
    assert layout.spec() == spec


@pytest.mark.parametrize("order", [1, 2, 4, 8, 16, 20, 24, 40, 48, 72, 104, 128, 144, 312])
def test_twins_are_the_pairs_whose_chips_are_alike(order: int) -> None:
    first, nodes = min(1, order - 1), max(1, order - 3)
    rows = code_book(order).matrix[first : first + nodes].astype(float)
    apart = np.concatenate((rows, np.zeros_like(rows)), axis=1)
    for shift in SHIFTS:
        moved = np.roll(apart, -shift, axis=1)  # the chips that wrap are those of the bit beside
        share = moved[:, :order] @ rows.T / order
        beside = np.roll(np.tile(rows, 2), -shift, axis=1)[:, :order] @ rows.T / order - share
        expected = {
            (i, j): (share[i, j], beside[i, j])
            for i, j in np.argwhere(np.abs(share) > ALIKE).tolist()
            if i != j or share[i, j] < 0
        }
        found = twins(order, first, nodes)
        found = found[found["shift"] == shift]
        assert set(zip(found["sent"].tolist(), found["alike"].tolist(), strict=True)) == set(
            expected
        )
        for pair in found:
            told = pair["share"], pair["wrap"]
            assert told == pytest.approx(expected[int(pair["sent"]), int(pair["alike"])], abs=1e-6)


def test_twins_of_the_largest_book_are_found_at_once() -> None:
    """Which took minutes when all rows were correlated with all others."""
    assert twins(65_536, 1, 65_535).size > 65_536
