# SPDX-License-Identifier: Apache-2.0

"""The compiled kernel: the same bits on every processor, and no harm by misuse or absence."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tactile_cdma.base import kernel
from tactile_cdma.code.codes import code_book, is_feasible
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.code.transform import Transform
from test.support.programs import run_program, run_python

KERNEL = Path(__file__).parents[3] / "kernel"


def test_threads_share_nothing_that_the_kernel_writes(tmp_path: Path) -> None:
    """No file of it has variables of its own: each skin is decoded in a thread, without a lock."""
    compiler, names = shutil.which("cc"), shutil.which("nm")
    if compiler is None or names is None:
        pytest.skip("no C compiler on this machine")
    sources = sorted(KERNEL.glob("*.c"))
    assert len(sources) > 10
    for source in sources:
        made = tmp_path / f"{source.stem}.o"
        subprocess.run([compiler, "-std=gnu99", "-fno-pic", "-c", source, "-o", made], check=True)
        said = subprocess.run([names, made], check=True, capture_output=True, text=True).stdout
        found = [line for line in said.splitlines() if line.split()[-2] in "bBdDC"]
        assert not found, f"{source.name}: {found}"


def test_without_the_kernel_one_sentence_says_how_to_build_it() -> None:
    """Of every command, and of those who import what needs it."""
    program = "import sys; sys.modules['tactile_cdma._kernel'] = None\n"
    command = (
        program + "from tactile_cdma.__main__ import main; sys.argv[1:] = ['read']; exit(main())"
    )
    told = run_python("-c", command)
    assert told.returncode == 1
    assert told.stderr.startswith("tactile-cdma: the compiled kernel does not load (")
    assert told.stderr.count("\n") == 1 and "pip install ." in told.stderr
    caught = program + "from tactile_cdma.base.errors import KernelError\n"
    caught += (
        "try:\n    from tactile_cdma import Skin\nexcept KernelError as error:\n    print(error)"
    )
    assert "make setup" in run_python("-c", caught).stdout


@pytest.mark.parametrize(
    "spreading, limit",
    [(False, 1e-6), (True, 1e-5)],  # rows that are added up are rounded at the size of their sum
)
def test_products_are_those_with_the_matrix_for_all_orders(spreading: bool, limit: float) -> None:
    rng = np.random.default_rng(1)
    for order in [order for order in range(1, 513) if is_feasible(order)] + [1024, 1040]:
        values, book = rng.normal(size=(3, order)).astype(np.float32), code_book(order)
        found = np.empty_like(values)
        Transform(book.plan, spreading).multiply(values, found)
        matrix = book.rows(np.arange(order)).astype(np.float64)
        expected = values @ (matrix if spreading else matrix.T / order)
        rms = np.sqrt(np.mean(np.square(expected if spreading else values)))
        assert np.abs(found - expected).max() < limit * rms, order


@pytest.mark.parametrize("spreading", [False, True])
@pytest.mark.parametrize(
    "order", [8, 16, 20, 72, 80, 128, 144, 160, 256, 388, 1040, 4096, 4160, 16_384]
)
def test_the_same_bits_by_registers_of_any_width_and_in_place(order: int, spreading: bool) -> None:
    values = np.random.default_rng(order).normal(size=(5, order)).astype(np.float32)
    results = []
    for lanes in (1, 4, 8):
        if lanes <= kernel.lib.transform_lanes():
            out = np.empty_like(values)
            Transform(code_book(order).plan, spreading, lanes).multiply(values, out)
            results.append(out.tobytes())
    Transform(code_book(order).plan, spreading).multiply(values, values)
    assert {*results, values.tobytes()} == {results[0]}


def test_misuse_of_a_transform_is_refused() -> None:
    transform = Transform((2, 2, 2, 2), spreading=False)
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
    new, ones = kernel.lib.transform_new, np.ones(1028**2, np.int8)
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
        with pytest.raises(ValueError, match="the kernel makes no struct transform: sizes"):
            kernel.Held(new(twos, len(orders), orders, matrices, 1.0, lanes), None)


def test_misuse_is_refused_and_says_what_is_wrong() -> None:
    lib, pointer = kernel.lib, kernel.pointer
    rows, at = np.zeros((10, 8), np.float32), kernel.ffi.new("struct samples_sums *")
    for wrong, shape in ((rows, (10, 9)), (rows[0], (10, 8))):
        told = re.escape(f"the kernel needs an array of shape {shape}, not {wrong.shape}")
        with pytest.raises(ValueError, match=told):
            pointer(wrong, *shape)
    with pytest.raises(ValueError, match="not C-contiguous"):
        pointer(rows[:, ::2], 10, 4)
    assert lib.samples_add(pointer(rows, 10, 8), 80).sum == 0
    with pytest.raises(TypeError, match=r"float \*.*double\[\]"):
        lib.samples_add(pointer(rows.astype(np.float64), 10, 8), 80)
    with pytest.raises(TypeError, match="samples_add expected 2 arguments, got 1"):
        lib.samples_add(pointer(rows, 10, 8))
    with pytest.raises(TypeError, match="struct samples_sums"):
        lib.samples_add(at, 80)


def test_structs_take_exactly_their_members_by_name() -> None:
    spec = FrameSpec(nodes=5, order=8)
    members = {"size": 8, "level": 0.25, "volts": spec.book.rows([1]).astype(np.float32).ravel()}
    sums = np.zeros(9)
    made = kernel.struct("fit_line", **members, sums=sums).at
    assert (made.size, made.level, made.volts[1]) == (8, 0.25, members["volts"][1])
    with pytest.raises(TypeError, match="struct fit of the kernel has no chips"):
        kernel.struct("fit", start=0.0, chip=4.0, chips=1.0)
    with pytest.raises(TypeError, match="struct fit of the kernel: chip is missing"):
        kernel.struct("fit", start=0.0)
    held = kernel.struct("fit_line", **members, sums=sums)
    count = sys.getrefcount(sums)
    del held
    assert sys.getrefcount(sums) < count, "it kept the array, and no longer"


def test_the_kernel_knows_nothing_of_python() -> None:
    """Builds for one Python serve others, and format strings with # break those of 3.13."""
    for path in [*KERNEL.glob("*.[ch]"), KERNEL / "build_kernel.py"]:
        text = path.read_text()
        assert not re.search(r"Python\.h|PyArg_|Py_BuildValue", text), path


WINDOWS_COMPILER = "x86_64-w64-mingw32-gcc"


def test_the_kernel_compiles_for_windows_and_needs_nothing_else_there(tmp_path: Path) -> None:
    """Without a warning; a DLL that wants more than Windows has would load nowhere."""
    compiler = shutil.which(WINDOWS_COMPILER)
    if compiler is None:
        pytest.skip(f"{WINDOWS_COMPILER} (apt: gcc-mingw-w64-x86-64) compiles for Windows")
    options = [*(KERNEL / "options.txt").read_text().split(), "-Werror", "-shared"]
    library = tmp_path / "kernel.dll"
    made = run_program(compiler, *options, *sorted(KERNEL.glob("*.c")), "-o", library)
    assert made.returncode == 0, made.stderr
    told = run_program("x86_64-w64-mingw32-objdump", "-p", library).stdout
    assert {*re.findall(r"DLL Name: (\S+)", told)} <= {"KERNEL32.dll", "msvcrt.dll"}


@pytest.mark.parametrize("path", sorted(KERNEL.glob("*.c")), ids=lambda path: path.name)
def test_only_reading_a_port_uses_posix(path: Path) -> None:
    headers = {*re.findall(r"#include <(\S+)>", path.read_text(encoding="utf-8"))}
    c99 = {"errno.h", "math.h", "stdbool.h", "stddef.h", "stdint.h", "stdlib.h", "string.h"}
    assert (headers <= c99 | {"immintrin.h"}) == (path.name != "reader.c")
