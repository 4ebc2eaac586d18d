# SPDX-License-Identifier: Apache-2.0

"""The compiled kernel: chosen or not, the same bits on every processor, and no harm by misuse."""

import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.base import kernel
from tactile_cdma.base.errors import ParameterError
from tactile_cdma.code.codes import code_book, is_feasible
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.code.separate import frame_fields, frame_settings
from tactile_cdma.code.transform import compiled_transform, correlate, numpy_transform
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
    module, reason = kernel._choose("")
    assert module is None
    assert "was not built for this Python" in reason
    with pytest.raises(ParameterError, match="is compiled, but the kernel was not built"):
        kernel._choose("compiled")


@needs_kernel
def test_a_kernel_of_another_version_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel, "VERSION", 10_000)
    assert kernel._choose("")[0] is None
    assert "this package needs 10000" in kernel._choose("")[1]


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
        compiled_transform(plan, spreading).multiply(values, found)
        numpy_transform(plan, spreading).multiply(values, expected)
        rms = np.sqrt(np.mean(np.square(expected if spreading else values)))
        assert np.abs(found - expected).max() < limit * rms, order


@needs_kernel
@pytest.mark.parametrize("spreading", [False, True])
@pytest.mark.parametrize(
    "order", [8, 16, 20, 72, 128, 144, 160, 256, 388, 1040, 4096, 4160, 16_384]
)
def test_the_same_bits_by_registers_of_any_width(order: int, spreading: bool) -> None:
    assert kernel.compiled is not None
    values = np.random.default_rng(order).normal(size=(5, order)).astype(np.float32)
    results = []
    for lanes in (1, 4, 8):
        if lanes <= kernel.compiled.LANES:
            out = np.empty_like(values)
            compiled_transform(code_book(order).plan, spreading, lanes).multiply(values, out)
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
    apart, transform = np.empty_like(values), compiled_transform(code_book(order).plan, False)
    transform.multiply(values, apart)
    transform.multiply(values, values)
    assert np.array_equal(values, apart)


@needs_kernel
def test_misuse_of_a_transform_is_refused() -> None:
    assert kernel.compiled is not None

    def new(twos: int, orders: tuple[int, ...], signs: int, lanes: int = 0) -> Any:
        """A transform from this many signs."""
        assert kernel.compiled is not None
        matrices = np.ones(signs, np.int8)
        return kernel.compiled.Transform(twos, np.array(orders, np.uintc), matrices, 1.0, lanes)

    transform = new(4, (), 0)
    values = np.zeros((3, 16), np.float32)
    read_only = values.copy()
    read_only.flags.writeable = False
    for source, out in (
        (values, np.zeros((3, 16))),
        (values.astype(np.int32), values),
        (b"text", values),
        (None, values),
        (values, read_only),
        (values, np.zeros((3, 15), np.float32)),
        (values, np.zeros((2, 16), np.float32)),
        (values[:, ::2], values[:, ::2]),
        (values[:2], values[1:]),
    ):
        with pytest.raises((TypeError, ValueError, BufferError)):
            transform.multiply(source, out)
    for arguments in (
        (17, (), 0),
        (2**32, (), 0),
        (0, (4,), 15),
        (0, (7,), 49),
        (0, (1028,), 1028**2),
        (0, (2**31,), 16),
        (0, (512, 256), 512**2 + 256**2),
        (1, (4,) * 9, 16 * 9),
        (4, (), 0, 3),
        (2, (), 0, 8),
    ):
        with pytest.raises(ValueError, match="Transform: "):
            new(*arguments)


@needs_kernel
def test_misuse_is_refused_and_says_of_which_argument() -> None:
    assert kernel.compiled is not None
    spec = FrameSpec(nodes=5, order=8)
    out = [np.empty(shape, np.float32) for shape in ((2, 5), (2, 5), 2, 2, 2, 2)]
    sound = [frame_settings(spec), np.zeros((2, 10, 8), np.float32), *out]
    kernel.compiled.fit_words(*sound)
    read_only = out[2].copy()
    read_only.flags.writeable = False
    for place, wrong, error in (
        (0, np.zeros(6), "words_frame: 56 bytes of settings expected, not 48"),
        (1, sound[1][:, :9], r"rows: ndarray is not C-contiguous"),
        (1, sound[1][:, :9].copy(), r"rows: \(10, 8\) with 5 nodes from row 1 on expected"),
        (1, sound[1][0], r"rows: 3 axes \(ckN\) expected, not 2"),
        (2, out[0][:, :4].copy(), r"uneven: n of \(cn\) is 4, not 5"),
        (4, out[2].astype(np.float64), "pedestal: values of type 'f' expected, not 'd'"),
        (4, np.empty(3, np.float32), "pedestal: 2 values expected, not 3"),
        (4, None, "pedestal: a bytes-like object"),
        (4, read_only, "pedestal: buffer source array is read-only"),
    ):
        with pytest.raises((TypeError, ValueError, BufferError), match=f"fit_words: {error}"):
            kernel.compiled.fit_words(*sound[:place], wrong, *sound[place + 1 :])
    with pytest.raises(TypeError, match="fit_words: 8 arguments expected, not 7"):
        kernel.compiled.fit_words(*sound[:-1])
    stream = kernel.compiled.Stream(kernel.compiled.Scanner(0))
    with pytest.raises(TypeError, match="give: t_host: must be real number, not str"):
        stream.give(b"", "0", False)


@needs_kernel
def test_settings_have_the_members_of_their_struct() -> None:
    assert kernel.compiled is not None
    for name, (size, members) in kernel.compiled.STRUCTS.items():
        end = 0
        for _, offset, kind in members:
            width = np.dtype(kind).itemsize
            assert end <= offset < end + width + 8 and offset % width == 0, "no member is left out"
            end = offset + width
        assert end <= size < end + 8
        for wrong in ({}, {**dict.fromkeys((m[0] for m in members), 1), "unknown": 1}):
            with pytest.raises(TypeError, match=name):
                kernel.settings(name, **wrong)
    made = frame_settings(FrameSpec(nodes=5, order=8))
    expected = frame_fields(FrameSpec(nodes=5, order=8))
    assert dict(zip(made.dtype.names, made.tolist(), strict=True)) == pytest.approx(expected)
