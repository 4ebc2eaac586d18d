# SPDX-License-Identifier: Apache-2.0

"""Code books, flipped chips and sparse codes by the document, and fast correlation with them."""

import re
import tracemalloc
import zlib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from benchmarks.doubt.words import TIMINGS, compare, decode
from tactile_cdma.base.errors import SpecError
from tactile_cdma.code.codes import (
    MAX_ORDER,
    SMALL_FACTOR,
    chip_flips,
    code_book,
    default_order,
    is_feasible,
    row_signs,
    scrambler_state,
    smallest_order,
)
from tactile_cdma.code.encode import line_chips, word_bits
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.code.sparse import TAPS
from tactile_cdma.code.transform import chips_of, correlate, rows_of, spread
from tactile_cdma.code.twins import ALIKE, SHIFTS, twins
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.framing.load import groups_for_all
from tactile_cdma.wire._protocol import Signs
from tactile_cdma.wire.messages import FrameLayout
from tactile_cdma.words.words import Words
from test.support.chip_line import hear, read_chips
from test.support.examples import examples
from test.support.independent_line import Line, Skin, Talk, render
from test.support.simulated import run, stream
from test.support.single_frames import SingleReader
from test.support.sparse_codes import code_number, node_chips, octets

MULTIPLES = range(4, 1001, 4)
FEASIBLE = [order for order in MULTIPLES if is_feasible(order)]


@pytest.mark.parametrize(
    "order", [1, 2, *[n for n in FEASIBLE if n <= 260], 336, 340, 344, 500, 676, 972]
)
def test_rows_are_orthogonal_and_row_zero_is_all_ones(order: int) -> None:
    matrix = code_book(order).matrix.astype(np.float32)
    assert np.array_equal(np.abs(matrix), np.ones((order, order)))
    assert np.array_equal(matrix @ matrix.T, order * np.eye(order))
    assert (matrix[0] == 1).all()


def test_constructions_cover_what_they_are_known_to_cover() -> None:
    assert len(FEASIBLE) == 195
    assert {28, 36, 52, 244, 344} <= set(FEASIBLE)  # Paley over 27, 17, 25, 243 and 343
    assert not {92, 116, 156, 188, 668} & set(FEASIBLE)
    assert max(smallest_order(n) - n for n in range(4, 1001)) == 11


@given(st.sampled_from([1, 2, 12, 20, 48, 144, 1024, 1040]), st.data())
def test_single_rows_equal_rows_of_the_matrix(order: int, data: st.DataObject) -> None:
    rows = data.draw(st.lists(st.integers(0, order - 1), max_size=5))
    assert np.array_equal(code_book(order).rows(rows), code_book(order).matrix[rows])


@pytest.mark.parametrize("order", [1020, 4160, 16_416, 65_536])
def test_rows_of_long_codes_are_orthogonal(order: int) -> None:
    """Paley I over 1019, and products; whole, up to 4 GB."""
    chosen = np.unique([0, 1, order - 1, *np.random.default_rng(order).integers(0, order, 20)])
    rows = code_book(order).rows(chosen).astype(np.float64)
    assert np.array_equal(rows @ rows.T, order * np.eye(len(chosen)))


ROWS = st.one_of(st.integers(1, 700), st.integers(1, MAX_ORDER))


@given(ROWS)
def test_the_default_order_is_short_and_cheap(rows: int) -> None:
    smallest, order = smallest_order(rows), default_order(rows)
    assert smallest <= order <= 1.02 * smallest
    assert is_feasible(order)
    if order != smallest:
        assert max(code_book(smallest).plan) > SMALL_FACTOR >= max(code_book(order).plan)


NEIGHBOURS = [(92, ("88", "96")), (3, ("2", "4")), (668, ("664", "672"))]


@pytest.mark.parametrize(("order", "named"), NEIGHBOURS)
def test_infeasible_orders_name_their_neighbours(order: int, named: tuple[str, str]) -> None:
    with pytest.raises(SpecError) as caught:
        code_book(order)
    assert all(f" {number}" in str(caught.value) for number in (order, *named))


@pytest.mark.parametrize("order", [0, -4, 65_540])
def test_orders_out_of_range_are_refused(order: int) -> None:
    with pytest.raises(SpecError, match="65536"):
        code_book(order)


def test_rows_out_of_range_are_refused() -> None:
    with pytest.raises(SpecError, match="0 to 15"):
        code_book(16).rows([16])


def test_signs_are_fixed_balanced_per_row_and_lower_the_crest() -> None:
    rows = np.arange(4096)
    signs = row_signs(rows, 1)
    assert set(np.unique(signs)) == {-1, 1}
    assert abs(int(signs.sum())) < 4 * 64  # 4 standard deviations of fair coins
    assert np.array_equal(row_signs(rows[100:200], 1), signs[100:200])
    assert abs(int(signs @ row_signs(rows, 2).astype(int))) < 4 * 64
    assert (row_signs(rows, None) == 1).all()
    book, rows = code_book(256), np.arange(256)
    natural = np.abs(book.matrix.sum(axis=0, dtype=int)).max()
    scrambled = np.abs(row_signs(rows, 1).astype(int) @ book.matrix).max()
    assert natural == 256
    assert scrambled < 6 * 16  # 6·√n


SCRAMBLED = {"scramble": True}
SPARSE = {"codes": "sparse", "nodes": 100, "order": 32, "frame_period_s": 1.0}


def test_defaults_and_the_papers_book() -> None:
    spec = FrameSpec()
    assert (spec.nodes, spec.order, spec.chips) == (16, 20, 200)
    assert 0 not in spec.rows
    assert spec.frame_s == pytest.approx(10e-3)
    assert set(spec.rows) | set(range(20)[spec.spare_rows]) | {0} == set(range(20))
    spec = FrameSpec(order=16, first_row=0, sign_seed=None)
    assert spec.frame_s == pytest.approx(8e-3)
    assert list(spec.rows) == list(range(16))
    assert (spec.signs == 1).all()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"order": 16}, "16 nodes from row 1 on need 17 code rows.*use order 20"),
        ({"nodes": 20, "order": 16, "first_row": 0}, "use order 20"),
        ({"order": 92}, "nearest feasible orders are 88 and 96"),
        ({"chip_s": 100e-6}, "lasts 20 ms, longer than its period of 12.8 ms: .* to 21 or more"),
        ({"drive": "unipolar", "first_row": 0, "order": 16}, "cannot use code row 0"),
        ({"drive": "tripolar"}, "'tripolar'.*'bipolar' or 'unipolar'"),
        ({"polarity": 0}, "polarity is 0"),
        ({"bits": 7}, "bits is 7; it must lie within 8…16"),
        ({"bits": 17}, "8…16"),
        ({"nodes": 0}, "nodes is 0"),
        ({"chip_s": float("nan")}, "chip_s is nan"),
        ({"amplitude_v": -0.3}, "amplitude_v is -0.3"),
        ({"sign_seed": 2**32}, "sign_seed"),
        ({"resync_chips": 32}, "resync_chips is 32 and guard_chips 0"),
        ({"guard_chips": 1}, "resync_chips is 0 and guard_chips 1"),
        (SCRAMBLED | {"nodes": 1, "order": 2, "first_row": 0}, "order is 2: rows of fewer than 4"),
        (SCRAMBLED | {"drive": "unipolar"}, "would show in all rows"),
        (SCRAMBLED | {"sign_seed": None}, "from sign_seed"),
        (SPARSE | {"drive": "unipolar"}, "unipolar drive cannot be: .* set drive to bipolar"),
        (SPARSE | {"first_row": 0}, "set first_row to 1"),
        (SPARSE | {"order": 7}, "8 to 4096 chips"),
        (SPARSE | {"order": 5000}, "8 to 4096 chips"),
        (SPARSE | {"sign_seed": None}, "sign_seed"),
        (SPARSE | {"nodes": 65_536}, "65535 at most"),
    ],
)
def test_impossible_combinations_are_refused_with_the_reason(fields: dict, message: str) -> None:
    with pytest.raises(SpecError, match=message):
        FrameSpec(**fields)


@given(st.integers(8, 16), st.data())
def test_bits_are_most_significant_first(bits: int, data: st.DataObject) -> None:
    codes = data.draw(st.lists(st.integers(0, 2**bits - 1), min_size=1, max_size=8))
    for code, row in zip(codes, word_bits(codes, bits), strict=True):
        assert "".join(map(str, row)) == format(code, f"0{bits}b")


@pytest.mark.parametrize("code", [-1, 1024])
def test_codes_that_do_not_fit_are_refused(code: int) -> None:
    with pytest.raises(SpecError, match=rf"code {code} does not fit 10 bits"):
        word_bits([0, code], 10)


@given(
    st.integers(1, 300),
    st.sampled_from(["bipolar", "unipolar"]),
    st.sampled_from([1, -1]),
    st.integers(0, 1000),
)
def test_chips_follow_the_definition(nodes: int, drive: str, polarity: int, seed: int) -> None:
    spec = FrameSpec(nodes=nodes, chip_s=1e-6, drive=drive, polarity=polarity, sign_seed=seed)
    rng = np.random.default_rng(seed)
    codes, active = rng.integers(0, 1024, nodes), rng.random(nodes) < 0.7
    own = spec.signs[:, None] * spec.book.rows(spec.rows).astype(float)  # (n, N), of ±1
    bits = 2 * word_bits(codes, 10).astype(int) - 1  # (n, k), of ±1
    total = bits[active].T @ own[active]  # (k, N): of all who speak
    expected = polarity * 0.3 * (total if drive == "bipolar" else (total + active.sum()) / 2)
    assert np.allclose(line_chips(spec, codes, active), expected, atol=1e-5 * nodes)


BLOCKS = [1, 2, 4, 12, 20, 64, 128, 148, 244, 388]  # one dense block
PRODUCTS = [144, 256, 400, 1024, 1040, 4096, 4144, 4160, 16_384, 65_520, 65_536]  # several
LARGE = [676, 1020, 1032, 2040]
"""With a large factor: Paley I over 1019, II over 337 and 257, and products."""
BOUND = 2.0**-17
"""Error of a correlation over the RMS of its chips in the worst frames, where all products of a sum
are equal and its roundings add up."""


def reference(chips: np.ndarray, order: int, rows: np.ndarray) -> np.ndarray:
    """Some correlations in float64, from the rows themselves."""
    return chips.astype(np.float64) @ code_book(order).rows(rows).T.astype(np.float64) / order


def error(chips: np.ndarray, order: int, rows: np.ndarray) -> float:
    """Largest error of some correlations, over the RMS of the chips of their bit."""
    chips = chips.astype(np.float32)
    rms = np.sqrt(np.square(chips.astype(np.float64)).mean(axis=-1, keepdims=True))
    found = correlate(chips, code_book(order))[..., rows]
    return float(np.max(np.abs(found - reference(chips, order, rows)) / rms))


def some_rows(order: int) -> np.ndarray:
    rng = np.random.default_rng(order)
    return np.unique([0, 1 % order, order - 1, *rng.integers(0, order, 12)])


@pytest.mark.parametrize("order", BLOCKS + PRODUCTS + LARGE)
def test_correlation_takes_apart_what_spreading_adds_up(order: int) -> None:
    symbols = np.random.default_rng(order).normal(size=(2, order)).astype(np.float32)
    chips = spread(symbols, code_book(order))
    assert np.abs(correlate(chips, code_book(order)) - symbols).max() < 1e-5


@examples(40)
@given(st.sampled_from([20, 312, 1024, 1040, 4160, 65_536]), st.integers(0, 2**32 - 1), st.data())
def test_harsh_frames_stay_within_the_bound(order: int, seed: int, data: st.DataObject) -> None:
    """A strong code beside others down to 60 dB weaker, an offset of up to 1000 amplitudes."""
    rng = np.random.default_rng(seed)
    symbols = rng.choice([-1.0, 1.0], order) * 10 ** -rng.uniform(0, 3, order)
    symbols[:: data.draw(st.integers(2, 20))] = 0.0
    symbols[0] = data.draw(st.floats(-1000, 1000))
    chips = spread(symbols.astype(np.float32), code_book(order)) * 10 ** rng.uniform(-30, 30)
    assert error(chips, order, some_rows(order)) < BOUND


@pytest.mark.parametrize("order", [16, 20, 148, 1024, 1040, 4096, 65_536])
def test_integer_sums_below_2_to_24_are_exact(order: int) -> None:
    rng = np.random.default_rng(order)
    symbols = rng.integers(-1, 2, order) * (2**24 // order - 1)
    chosen = some_rows(order)
    book = code_book(order)
    mirrored = book.rows(chosen).astype(np.int64).T  # columns of the transposed book
    chips = spread(symbols.astype(np.float32), book)
    only = np.zeros(order, dtype=np.int64)
    only[chosen] = symbols[chosen]
    assert np.array_equal(chips, np.rint(chips))
    assert np.array_equal(spread(only.astype(np.float32), book), mirrored @ only[chosen])
    if order & (order - 1) == 0:  # 1/N is exact too
        sums = correlate(symbols.astype(np.float32), book)[chosen].astype(np.float64) * order
        assert np.array_equal(sums, mirrored.T @ symbols)


@pytest.mark.parametrize("order", [20, 1024, 4160, 65_536])
def test_denormal_chips_do_no_harm(order: int) -> None:
    chips = np.full((2, order), 1e-42, dtype=np.float32)
    found = correlate(chips, code_book(order))
    exact = np.where(np.arange(order) == 0, chips[0, 0], np.float32(0))
    assert np.isfinite(found).all()
    assert np.abs(found - exact).max() < order * 2.0**-149


@pytest.mark.parametrize("order", [20, 160, 388, 1040, 676, 16_384])
@pytest.mark.parametrize("shape", [(), (1,), (0,), (7,), (3, 10), (2, 3, 11)])
def test_batches_of_any_shape_are_as_single_vectors(order: int, shape: tuple[int, ...]) -> None:
    chips = np.random.default_rng(1).normal(size=(*shape, order)).astype(np.float32)
    found = correlate(chips, code_book(order))
    assert found.shape == chips.shape
    for index in np.ndindex(shape):
        alone = correlate(chips[index], code_book(order))
        assert np.array_equal(found[index], alone)


@pytest.mark.parametrize("order", [20, 1040, 676])
def test_any_layout_and_type_of_chips_will_do(order: int) -> None:
    counts = np.random.default_rng(1).integers(-2048, 2048, (order, 12), dtype=np.int16)
    plain = np.ascontiguousarray(counts.T[::2]).astype(np.float32)
    found = correlate(counts.T[::2], code_book(order))  # type: ignore[arg-type]
    assert np.array_equal(found, correlate(plain, code_book(order)))


@pytest.mark.parametrize("order", [20, 388, 1040, 4096])
def test_with_out_nothing_is_allocated(order: int) -> None:
    chips = np.random.default_rng(1).normal(size=(16, order)).astype(np.float32)
    out = np.empty_like(chips)
    expected = correlate(chips, code_book(order))
    tracemalloc.start()
    assert correlate(chips, code_book(order), out=out) is out
    assert tracemalloc.get_traced_memory()[1] < 8192  # views and frames, no data
    tracemalloc.stop()
    assert np.array_equal(out, expected)


def test_threads_do_not_disturb_each_other() -> None:
    books = [code_book(order) for order in (4096, 4160, 4096, 2080)]
    chips = [
        np.random.default_rng(i).normal(size=(10, book.order)).astype(np.float32)
        for i, book in enumerate(books)
    ]
    expected = [correlate(c, book) for c, book in zip(chips, books, strict=True)]

    def is_right(i: int) -> bool:
        return all(np.array_equal(correlate(chips[i], books[i]), expected[i]) for _ in range(50))

    with ThreadPoolExecutor(len(books)) as pool:
        assert all(pool.map(is_right, range(len(books))))


def test_misuse_is_refused_with_a_reason() -> None:
    book, chips = code_book(20), np.zeros((10, 20), dtype=np.float32)
    with pytest.raises(SpecError, match=r"16 chips per bit .* order 20"):
        correlate(chips[:, :16], book)
    for out in (np.zeros((10, 20)), np.zeros((9, 20), "f4"), np.zeros((20, 10), "f4").T):
        with pytest.raises(SpecError, match="out must be contiguous float32"):
            correlate(chips, book, out=out)


MASK = 0xFFFFFFFF
MOST_LATE = 40
"""Chips."""


def test_no_seed_stops_it() -> None:
    """The state 0 would stay 0, and flip nothing; this seed's hash is 0."""
    seed = -65_536 * 0x9E3779B9 & MASK
    assert scrambler_state(seed) == 1
    assert (chip_flips(10, 20, seed) < 0).any()


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("order", [912, 20])
def test_it_is_balanced_and_unlike_itself_shifted(order: int, seed: int) -> None:
    flips = chip_flips(10, order, seed).ravel().astype(float)
    assert abs(flips.mean()) < 4 / np.sqrt(flips.size)
    for shift in range(1, min(200, flips.size // 2)):
        both = flips[shift:] * flips[:-shift]
        assert abs(both.mean()) < 5 / np.sqrt(both.size)


def test_rows_and_chips_are_inverse_and_the_wire_says_that_they_are_flipped() -> None:
    spec = FrameSpec(nodes=19, order=20, first_row=0, scramble=True)
    rows = np.random.default_rng(1).normal(size=(spec.line_bits, 20)).astype(np.float32)
    np.testing.assert_allclose(rows_of(chips_of(rows, spec), spec), rows, atol=1e-6)
    layout = FrameLayout.of(FrameSpec(scramble=True), 4)
    assert layout.signs == Signs.SCRAMBLED
    assert FrameLayout.unpack(layout.pack()).spec(0.3) == FrameSpec(scramble=True)
    assert not FrameLayout.of(FrameSpec(), 4).spec().scramble


@pytest.mark.parametrize(("nodes", "order"), [(16, 20), (60, 64), (900, 912)])
def test_who_does_not_know_of_it_hears_hardly_a_word(nodes: int, order: int) -> None:
    spec = FrameSpec(nodes=nodes, order=order, scramble=True, frame_period_s=10.0, amplitude_v=0.3)
    rng, right = np.random.default_rng(nodes), {True: 0, False: 0}
    for _ in range(20):
        codes = rng.integers(0, 1024, nodes)
        chips = line_chips(spec, codes).astype(np.float32)
        for scramble in right:
            heard = replace(spec, scramble=scramble)
            frame = hear(chips, heard)
            if frame is not None and frame.words is not None:
                words = frame.words
                right[scramble] += np.count_nonzero(
                    ~words.doubtful & words.active & (words.codes == codes)
                )
    assert right[True] == 20 * nodes
    assert right[False] <= 20 * nodes / 200


def line_of(
    spec: FrameSpec, codes: NDArray[np.int64], active: NDArray[np.bool_], late: int, by: int
) -> NDArray[np.float32]:
    """Chips of these nodes, of which one is late by whole chips; negative: early."""
    own = np.arange(spec.nodes) == late
    chips = line_chips(spec, codes, active & ~own).ravel()
    other = np.pad(line_chips(spec, codes, active & own).ravel(), MOST_LATE)
    return chips + other[MOST_LATE - by : MOST_LATE - by + chips.size]


@pytest.mark.parametrize(("nodes", "order"), [(16, 20), (60, 64), (900, 912)])
@pytest.mark.parametrize("by", [-2, -1, 1, 2])
def test_nodes_late_by_chips_are_named_and_disturb_nobody(nodes: int, order: int, by: int) -> None:
    """They show in no row, and so look silent: that must be in doubt, and only that."""
    spec = FrameSpec(nodes=nodes, order=order, scramble=True, frame_period_s=10.0, amplitude_v=0.3)
    rng, doubted = np.random.default_rng(by + 5), 0
    for _ in range(20):
        codes, active = rng.integers(0, 1024, nodes), rng.random(nodes) < 0.5
        late = int(rng.integers(nodes))
        active[late] = True

        def words(by: int) -> Words:
            chips = line_of(spec, codes, active, late, by)  # noqa: B023
            chips = chips + rng.normal(0, 0.1, chips.size)
            return read_chips(chips.astype(np.float32).reshape(-1, order), spec, 0.1)

        found = words(by)
        assert found.doubtful[late]
        others = (np.arange(nodes) != late) & active
        sure = others & ~found.doubtful
        assert found.active[sure].all()
        np.testing.assert_array_equal(found.codes[sure], codes[sure])
        sound = words(0)
        doubted += np.count_nonzero(sound.doubtful)
        np.testing.assert_array_equal(sound.active, active)
    assert doubted <= 0.01 * 20 * nodes


@pytest.mark.parametrize(("nodes", "order"), [(16, 20), (60, 64), (900, 912)])
@pytest.mark.parametrize("by", [-5, 3, 8, 40, None])
def test_nobody_is_silent_beside_one_not_understood(nodes: int, order: int, by: int | None) -> None:
    """One that is later than is looked for, or (None) does not flip its chips."""
    spec = FrameSpec(nodes=nodes, order=order, scramble=True, frame_period_s=10.0, amplitude_v=0.3)
    rng = np.random.default_rng(nodes)
    for _ in range(20):
        codes, active = rng.integers(0, 1024, nodes), rng.random(nodes) < 0.5
        active[:2], own = True, np.arange(nodes) == 0
        if by is None:
            chips = line_chips(spec, codes, active & ~own)
            chips = chips + line_chips(replace(spec, scramble=False), codes, own)
        else:
            chips = line_of(spec, codes, active, 0, by).reshape(-1, order)
        noisy = (chips + rng.normal(0, 0.03, chips.shape)).astype(np.float32)
        frame = hear(noisy, spec, 0.03)
        if frame is None:
            continue
        words = frame.words
        silent = ~words.active
        assert silent[0] or words.doubtful[0]
        assert words.doubtful[silent].all()


@pytest.mark.parametrize("scene", ["idle", "press"])
def test_silent_frames_of_unknown_amplitude_are_frames(scene: str) -> None:
    url = f"sim://?seed=2&scene={scene}"
    config = SkinConfig.of({"scramble": True, "amplitude_mv": 0.0})
    frames = run(config, stream(SkinConfig.of({"scramble": True}), url, 200))
    assert len(frames) >= 198


@pytest.mark.parametrize("scramble", [False, True])
def test_frames_of_two_nodes_with_one_word_are_no_longer_ties(scramble: bool) -> None:
    """Gap timing, starts anywhere: shifted by a chip such a frame looks like another one."""
    skin = Skin(scramble=scramble)
    talk, line = Talk(together=2, words="equal"), Line(start_jitter_chips=30.0, noise_v=0.03)
    recording = render(skin, talk, line, TIMINGS["gap"], 150, seed=3)
    counts, complaints = compare(recording, decode(recording), line)
    assert not counts.false, complaints
    flagged = counts.flagged + counts.tied
    assert flagged < 0.03 * counts.words if scramble else flagged > 0.1 * counts.words


@pytest.mark.parametrize("samples_per_chip", [1, 4])
def test_a_lone_late_node_is_not_called_silence(samples_per_chip: int) -> None:
    """Its chips are noise that the gap has not: such frames are rejected, or in doubt."""
    spec = FrameSpec(scramble=True, amplitude_v=0.3)
    reader = SingleReader(spec, samples_per_chip / spec.chip_s)
    rng, all_nodes = np.random.default_rng(1), np.ones(16, bool)
    for number in range(60):
        codes = rng.integers(0, 1024, 16)
        chips = {
            0: lambda c: line_chips(spec, c, all_nodes).ravel(),
            1: lambda c: line_of(spec, c, np.arange(16) == 5, 5, 1),
            2: lambda c: np.zeros(spec.chips),
        }[number % 3](codes)
        volts = np.append(np.repeat(chips, samples_per_chip), np.zeros(4 * samples_per_chip))
        if samples_per_chip == 1:
            volts = volts[: spec.chips]
        else:
            reader.learn_rest(0.0, 0.02**2 / samples_per_chip)
        volts += rng.normal(0, 0.02, volts.size)
        frame = reader.read(volts.astype(np.float32))
        if number < 30:  # of means the noise is learnt from frames
            continue
        if number % 3 == 1:
            assert frame is None or (frame.words is not None and frame.words.doubtful.all())
        else:
            assert frame is not None
            spoke = frame.words is not None and frame.words.active.all()
            assert spoke == (number % 3 == 0)


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
        assert set(zip(found["sent"], found["alike"], strict=True)) == set(expected)
        for pair in found:
            told = pair["share"], pair["wrap"]
            assert told == pytest.approx(expected[int(pair["sent"]), int(pair["alike"])], abs=1e-6)


def test_twins_of_the_largest_book_are_found_at_once() -> None:
    """Which took minutes when all rows were correlated with all others."""
    assert twins(65_536, 1, 65_535).size > 65_536
