# SPDX-License-Identifier: Apache-2.0

"""Parquet files, by the optional library pyarrow: of any rows, and of a patch's frames."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from ..base.errors import needed_for
from ..base.whole_file import replacing
from .samples import PatchInfo
from .tables import COLUMNS, PER_TAXEL, Frames, columns, known, places

GROUP_ROWS, GROUP_BYTES = 4096, 16 << 20
"""The most of a row group, which is held in memory; chosen."""
METADATA = b"tactile_cdma"
"""Key of the file's metadata: JSON with about and the arrays of the taxels."""
PNG_OR_JPEG = "image"
"""In place of numpy's type of a column: its cells are the bytes of image files."""


def pyarrow() -> ModuleType:
    """The library; raises MissingPackageError where it is missing."""
    with needed_for("Parquet", "pyarrow"):
        import pyarrow as library
        import pyarrow.parquet
    return library  # type: ignore[no-any-return]


class ParquetTable:
    """A Parquet file that grows by rows of numbers, arrays of a fixed size, and images.

    columns: name → numpy type (or PNG_OR_JPEG) and shape of a cell. size: bytes written so far.
    Use as a context manager: the file appears when that ends; after an exception nothing has
    changed. Raises MissingPackageError without pyarrow.
    """

    def __init__(
        self,
        path: Path,
        columns: Mapping[str, tuple[str, tuple[int, ...]]],
        metadata: Mapping[str, Any] | None = None,
    ) -> None:
        self._library, self._columns = pyarrow(), columns
        schema = self._library.schema([(name, column_type(*it)) for name, it in columns.items()])
        if metadata is not None:
            schema = schema.with_metadata({METADATA: json.dumps(metadata).encode()})
        self._schema = schema
        self._array_bytes = sum(
            np.dtype(dtype).itemsize * int(np.prod(shape))
            for dtype, shape in columns.values()
            if dtype != PNG_OR_JPEG
        )
        self._rows: list[Mapping[str, Any]] = []
        self._held_bytes = 0
        self._path = path

    def add(self, row: Mapping[str, Any]) -> None:
        """Add a row. Arrays are copied when their group is written: hand over such that stay."""
        self._rows.append(row)
        images = sum(len(cell) for cell in row.values() if isinstance(cell, bytes))
        self._held_bytes += self._array_bytes + images
        if len(self._rows) >= GROUP_ROWS or self._held_bytes >= GROUP_BYTES:
            self._flush()

    @property
    def size(self) -> int:
        return self._file.tell()

    def __enter__(self) -> ParquetTable:
        with ExitStack() as stack:
            self._file = stack.enter_context(replacing(self._path))
            self._writer = self._library.parquet.ParquetWriter(self._file, self._schema)
            stack.push(self._abandon)  # before the file: what is left open writes to it later
            stack.push(self._finish)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *problem: Any) -> None:
        self._stack.__exit__(*problem)

    def _finish(self, kind: Any, *_: Any) -> None:
        if kind is None:
            self._flush()
            self._writer.close()

    def _abandon(self, kind: Any, *_: Any) -> None:
        if kind is not None:
            with suppress(Exception):  # the exception that is on its way is the one to tell
                self._writer.close()

    def _flush(self) -> None:
        if self._rows:
            cells = [
                column([row[name] for row in self._rows], *kind)
                for name, kind in self._columns.items()
            ]
            self._writer.write_table(self._library.Table.from_arrays(cells, schema=self._schema))
            self._rows, self._held_bytes = [], 0


def write_parquet(path: Path, frames: Frames, patch: PatchInfo, about: Mapping[str, Any]) -> int:
    """All frames, one per row, with the columns of an NPZ; its constants are metadata.

    Returns how many. Raises MissingPackageError, OSError.
    """
    kinds: dict[str, tuple[str, tuple[int, ...]]] = {
        name: (dtype, (len(patch),) if name in PER_TAXEL else ()) for name, dtype in COLUMNS.items()
    }
    constants = {name: known(array) for name, array in places(patch).items()}
    count = 0
    with ParquetTable(path, kinds, {"about": about} | constants) as table:
        for episode, frame in frames:
            table.add(columns(episode, frame))
            count += 1
    return count


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
