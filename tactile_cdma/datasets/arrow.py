# SPDX-License-Identifier: Apache-2.0

"""The optional library pyarrow, and the Parquet files that we write with it."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.optional import needed_for


def pyarrow() -> ModuleType:
    """The library; raises MissingPackageError where it is missing."""
    with needed_for("Parquet", "pyarrow"):
        import pyarrow as library
        import pyarrow.parquet
    return library  # type: ignore[no-any-return]


def array_type(dtype: str, shape: tuple[int, ...]) -> Any:
    """The type of a column whose cells are arrays; () and (1,) are plain numbers.

    Vectors have a fixed size, matrices are lists of lists, as the library datasets stores them.
    """
    library = pyarrow()
    kind = library.from_numpy_dtype(np.dtype(dtype))
    if shape in ((), (1,)):
        return kind
    if len(shape) == 1:
        return library.list_(kind, shape[0])
    for _ in shape:
        kind = library.list_(kind)
    return kind


def array_column(cells: NDArray[Any]) -> Any:
    """(rows, *shape) as a column of array_type(cells.dtype, shape)."""
    library = pyarrow()
    rows, shape = len(cells), cells.shape[1:]
    column = library.array(np.ascontiguousarray(cells).reshape(-1))
    if shape in ((), (1,)):
        return column
    if len(shape) == 1:
        return library.FixedSizeListArray.from_arrays(column, shape[0])
    for depth in range(len(shape) - 1, -1, -1):
        above = rows * int(np.prod(shape[:depth], dtype=np.int64))
        offsets = np.arange(above + 1, dtype=np.int32) * shape[depth]
        column = library.ListArray.from_arrays(offsets, column)
    return column
