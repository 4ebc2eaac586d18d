# SPDX-License-Identifier: Apache-2.0

"""The compiled kernel: chosen or not, the same bits on every processor, and no harm by misuse."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.base import kernel
from tactile_cdma.base.errors import ParameterError
from tactile_cdma.code.codes import code_book, is_feasible
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.code.separate import frame_fields, frame_settings
from tactile_cdma.code.transform import CompiledTransform, correlate, numpy_transform
from test.support.programs import run_python

needs_kernel = pytest.mark.skipif(kernel.compiled is None, reason=kernel.why_numpy)
WHICH = "from tactile_cdma.base import kernel; print(kernel.compiled and 'compiled')"


def started_with(choice: str, program: str = WHICH) -> subprocess.CompletedProcess[str]:
    return run_python("-c", program, env={**os.environ, kernel.VARIABLE: choice})


def test_numpy_can_be_chosen() -> None:
    assert started_with("numpy").stdout == "None\n"


@needs_kernel
@pytest.mark.parametrize("choice", ["", "compiled"])
def test_the_kernel_is_used_where_it_was_built(choice: str) -> None:
    assert started_with(choice).stdout == "compiled\n"


def test_any_other_choice_is_one_clear_error() -> None:
    answer = started_with("fast", "from tactile_cdma.__main__ import main; exit(main())")
    assert answer.returncode == 1
    assert answer.stderr == (
        "tactile-cdma: TACTILE_CDMA_KERNEL is 'fast'; it must be numpy, compiled or empty "
        "(compiled where the kernel was built)\n"
    )


def test_without_a_kernel_numpy_is_used_and_the_reason_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "tactile_cdma._kernel", None)
    module, _, reason = kernel._choose("")
    assert module is None
    assert "was not built for this Python" in reason
    with pytest.raises(ParameterError, match="is compiled, but the kernel was not built"):
        kernel._choose("compiled")


@needs_kernel
@pytest.mark.parametrize(
    "spreading, limit",
    [(False, 1e-6), (True, 1e-5)],  # rows that are added up are rounded at the size of their sum
)
def test_products_are_those_of_numpy_for_all_orders(spreading: bool, limit: float) -> None:
    rng = np.random.default_rng(1)
    feasible = [order for order in range(1, 513) if is_feasible(order)]
    for order in [*feasible, 1024, 1040, 4096, 4160, 16_384, 65_520, 65_536]:
        values = rng.normal(size=(3, order)).astype(np.float32)
        found, expected = np.empty((2, 3, order), np.float32)
        plan = code_book(order).plan
        CompiledTransform(plan, spreading).multiply(values, found)
        numpy_transform(plan, spreading).multiply(values, expected)
        rms = np.sqrt(np.mean(np.square(expected if spreading else values)))
        assert np.abs(found - expected).max() < limit * rms, order


@needs_kernel
@pytest.mark.parametrize("spreading", [False, True])
@pytest.mark.parametrize(
    "order", [8, 16, 20, 72, 128, 144, 160, 256, 388, 1040, 4096, 4160, 16_384]
)
def test_the_same_bits_by_registers_of_any_width(order: int, spreading: bool) -> None:
    values = np.random.default_rng(order).normal(size=(5, order)).astype(np.float32)
    results = []
    for lanes in (1, 4, 8):
        if lanes <= kernel.compiled.transform_lanes():
            out = np.empty_like(values)
            CompiledTransform(code_book(order).plan, spreading, lanes).multiply(values, out)
            results.append(out.tobytes())
    assert len(set(results)) == 1


@needs_kernel
@given(st.integers(1, 9), st.sampled_from([4, 20, 80, 256, 1040]))
def test_a_vector_gives_the_same_bits_alone_and_among_others(count: int, order: int) -> None:
    values = np.random.default_rng(count).normal(size=(count, order)).astype(np.float32)
    together = correlate(values, code_book(order))
    for i in range(count):
        assert np.array_equal(correlate(values[i], code_book(order)), together[i])


@needs_kernel
@pytest.mark.parametrize("order", [16, 20, 80, 1040])
def test_in_place_as_into_other_memory(order: int) -> None:
    values = np.random.default_rng(1).normal(size=(3, order)).astype(np.float32)
    apart, transform = np.empty_like(values), CompiledTransform(code_book(order).plan, False)
    transform.multiply(values, apart)
    transform.multiply(values, values)
    assert np.array_equal(values, apart)


@needs_kernel
def test_misuse_of_a_transform_is_refused() -> None:
    transform = CompiledTransform((2, 2, 2, 2), spreading=False)
    values = np.zeros((3, 16), np.float32)
    read_only = values.copy()
    read_only.flags.writeable = False
    for source, out in (
        (values, np.zeros((3, 16))),
        (values.astype(np.int32), values),
        (values, read_only),
        (values, np.zeros((3, 15), np.float32)),
        (values, np.zeros((2, 16), np.float32)),
        (values[:, :15].copy(), values[:, :15].copy()),
        (values[:, ::2], values[:, ::2]),
        (values[:2], values[1:]),
    ):
        with pytest.raises((TypeError, ValueError, BufferError)):
            transform.multiply(source, out)
    new, ones = kernel.compiled.transform_new, np.ones(1028**2, np.int8)
    for twos, orders, lanes in (
        (17, (), 0),
        (0, (7,), 0),
        (0, (1028,), 0),
        (0, (512, 256), 0),
        (1, (4,) * 9, 0),
        (4, (), 3),
        (2, (), 8),
    ):
        matrices = [kernel.pointer(ones, ones.size)] * len(orders)
        with pytest.raises(ValueError, match="struct transform of the kernel: what it is made of"):
            kernel.Held(new(twos, len(orders), orders, matrices, 1.0, lanes), None)


@needs_kernel
def test_misuse_is_refused_and_says_what_is_wrong() -> None:
    lib, pointer = kernel.compiled, kernel.pointer
    spec = FrameSpec(nodes=5, order=8)
    rows, frame = np.zeros((10, 8), np.float32), frame_settings(spec)
    assert lib.words_noise(frame, pointer(rows, 10, 8), 6, 2) == 0
    for wrong, error in (
        (rows[:, :9], r"shape \(10, 9\), not \(10, 8\)"),
        (rows[0], r"shape \(10, 9\), not \(8,\)"),
    ):
        with pytest.raises(ValueError, match=f"the kernel needs an array of {error}"):
            pointer(wrong, 10, 9)
    with pytest.raises(ValueError, match="not C-contiguous"):
        pointer(rows[:, ::2], 10, 4)
    with pytest.raises(TypeError, match=r"float \*.*double\[\]"):
        lib.words_noise(frame, pointer(rows.astype(np.float64), 10, 8), 6, 2)
    with pytest.raises(TypeError, match="words_noise expected 4 arguments, got 3"):
        lib.words_noise(frame, pointer(rows, 10, 8), 6)
    with pytest.raises(TypeError, match="struct words_frame"):
        lib.words_noise(kernel.ffi.new("struct fit *"), pointer(rows, 10, 8), 6, 2)


@needs_kernel
def test_structs_take_exactly_their_members_by_name() -> None:
    spec = FrameSpec(nodes=5, order=8)
    members = frame_fields(spec)
    made = kernel.struct("words_frame", **members).at
    assert {name: getattr(made, name) for name in members} == pytest.approx(members)
    whole = dict.fromkeys(("start", "scatter", "chip", "slips"), 1.0)
    with pytest.raises(TypeError, match="struct gap_expected of the kernel has no slipz"):
        kernel.struct("gap_expected", **whole, slipz=1.0)
    del whole["slips"]
    with pytest.raises(TypeError, match="struct gap_expected of the kernel: slips is missing"):
        kernel.struct("gap_expected", **whole)
    edges = np.array([0, 4, 8], np.int32)
    held = kernel.struct(
        "frame_edges", count=3, whole=edges, share=np.zeros(3), number=np.ones(2), places=edges
    )
    count = sys.getrefcount(edges)
    assert held.at.all.whole[2] == 8
    del held
    assert sys.getrefcount(edges) < count, "it kept the array, and no longer"


def test_the_kernel_knows_nothing_of_python() -> None:
    """Builds for one Python serve others, and format strings with # break those of 3.13."""
    folder = Path(__file__).parents[3] / "kernel"
    for path in [*folder.glob("*.[ch]"), folder / "build_kernel.py"]:
        text = path.read_text()
        assert not re.search(r"Python\.h|PyArg_|Py_BuildValue", text), path
