# SPDX-License-Identifier: Apache-2.0

"""Parquet files of any rows, by the optional library pyarrow."""

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

GROUP_ROWS, GROUP_BYTES = 4096, 16 << 20
"""The most of a row group, which is held in memory; chosen."""
METADATA = b"tactile_cdma"
"""Key of the file's metadata: JSON with about and the arrays of the taxels."""
PNG_OR_JPEG = "image"
"""Stands in place of a column's numpy type if its cells are the bytes of image files."""


def pyarrow() -> ModuleType:
    """Import pyarrow; raises MissingPackageError where it is missing."""
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
        self._library, self._columns, self._path = pyarrow(), columns, path
        schema = self._library.schema([(name, self._type(*it)) for name, it in columns.items()])
        if metadata is not None:
            schema = schema.with_metadata({METADATA: json.dumps(metadata).encode()})
        self._schema = schema
        self._rows: list[Mapping[str, Any]] = []
        self._held_bytes = 0

    def add(self, row: Mapping[str, Any]) -> None:
        """Add a row. Arrays are copied when their group is written: hand over such that stay."""
        self._rows.append(row)
        self._held_bytes += sum(np.asarray(cell).nbytes for cell in row.values())
        if len(self._rows) >= GROUP_ROWS or self._held_bytes >= GROUP_BYTES:
            self._flush()

    @property
    def size(self) -> int:
        return self._file.tell()

    def __enter__(self) -> ParquetTable:
        with ExitStack() as stack:
            self._file = stack.enter_context(replacing(self._path))
            self._writer = self._library.parquet.ParquetWriter(self._file, self._schema)
            stack.push(self._finish)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *problem: Any) -> None:
        self._stack.__exit__(*problem)

    def _finish(self, kind: Any, *_: Any) -> None:
        try:
            if kind is None:
                self._flush()
                self._writer.close()
        finally:
            with suppress(Exception):  # the exception that is on its way is the one to tell
                self._writer.close()  # before the file: what is left open writes to it later

    def _flush(self) -> None:
        if self._rows:
            arrays = [
                self._library.array(_cells([row[name] for row in self._rows], *kind), field.type)
                for (name, kind), field in zip(self._columns.items(), self._schema, strict=True)
            ]
            self._writer.write_table(self._library.Table.from_arrays(arrays, schema=self._schema))
            self._rows, self._held_bytes = [], 0

    def _type(self, dtype: str, shape: tuple[int, ...]) -> Any:
        """Return the type of a column of arrays or images; cells of () and (1,) are plain numbers.

        Vectors have a fixed size, matrices are lists of lists, as the library datasets stores them.
        """
        library = self._library
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


def _cells(cells: Sequence[Any], dtype: str, shape: tuple[int, ...]) -> Any:
    """Return a column's cells as pyarrow takes them: numbers, vectors, lists of vectors, images."""
    if dtype == PNG_OR_JPEG:
        return [{"bytes": file} for file in cells]
    values = np.array(cells, dtype)
    if shape in ((), (1,)):
        return values.reshape(-1)
    return [list(value) if len(shape) > 1 else value for value in values]
