# SPDX-License-Identifier: Apache-2.0

"""The optional library pyarrow, and the Parquet files that we write with it."""

from collections.abc import Sequence
from types import ModuleType
from typing import Any

import numpy as np

from ..base.optional import needed_for


def pyarrow() -> ModuleType:
    """The library; raises MissingPackageError where it is missing."""
    with needed_for("Parquet", "pyarrow"):
        import pyarrow as library
        import pyarrow.parquet
    return library  # type: ignore[no-any-return]


PNG_OR_JPEG = "image"
"""In place of numpy's type of a column: its cells are the bytes of image files."""


def column_type(dtype: str, shape: tuple[int, ...]) -> Any:
    """The type of a column whose cells are arrays or images; () and (1,) are plain numbers.

    Vectors have a fixed size, matrices are lists of lists, as the library datasets stores them.
    """
    library = pyarrow()
    if dtype == PNG_OR_JPEG:
        return library.struct([("bytes", library.binary()), ("path", library.string())])
    kind = library.from_numpy_dtype(np.dtype(dtype))
    if shape in ((), (1,)):
        return kind
    if len(shape) == 1:
        return library.list_(kind, shape[0])
    for _ in shape:
        kind = library.list_(kind)
    return kind


def column(cells: Sequence[Any], dtype: str, shape: tuple[int, ...]) -> Any:
    """A column of column_type(dtype, shape)."""
    library = pyarrow()
    if dtype == PNG_OR_JPEG:
        files = [{"bytes": file, "path": None} for file in cells]
        return library.array(files, column_type(dtype, shape))
    rows = len(cells)
    column = library.array(np.array(cells, dtype).reshape(-1))
    if shape in ((), (1,)):
        return column
    if len(shape) == 1:
        return library.FixedSizeListArray.from_arrays(column, shape[0])
    for depth in range(len(shape) - 1, -1, -1):
        above = rows * int(np.prod(shape[:depth], dtype=np.int64))
        offsets = np.arange(above + 1, dtype=np.int32) * shape[depth]
        column = library.ListArray.from_arrays(offsets, column)
    return column
