# SPDX-License-Identifier: Apache-2.0

"""Parquet files of any rows, by the optional library pyarrow."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, BinaryIO

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


@contextmanager
def parquet_table(
    path: Path,
    columns: Mapping[str, tuple[str, tuple[int, ...]]],
    metadata: Mapping[str, Any] | None = None,
) -> Iterator[ParquetTable]:
    """Open a Parquet file for rows of numbers, arrays of a fixed size, and images.

    columns: name → numpy type (or PNG_OR_JPEG) and shape of a cell. The file appears
    when the context ends; after an exception nothing has changed. Raises MissingPackageError.
    """
    library = pyarrow()
    schema = library.schema([(name, _type(library, *it)) for name, it in columns.items()])
    if metadata is not None:
        schema = schema.with_metadata({METADATA: json.dumps(metadata).encode()})
    with replacing(path) as file, library.parquet.ParquetWriter(file, schema) as writer:
        table = ParquetTable(file, writer, columns)
        yield table
        table.flush()


class ParquetTable:
    """Takes the rows of an open Parquet file."""

    def __init__(
        self, file: BinaryIO, writer: Any, columns: Mapping[str, tuple[str, tuple[int, ...]]]
    ) -> None:
        self._file, self._writer, self._columns = file, writer, columns
        self._rows: list[Mapping[str, Any]] = []
        self._held_bytes = 0

    @property
    def size(self) -> int:
        """Bytes written so far."""
        return self._file.tell()

    def add(self, row: Mapping[str, Any]) -> None:
        """Add a row. Arrays are copied when their group is written: hand over such that stay."""
        self._rows.append(row)
        self._held_bytes += sum(np.asarray(cell).nbytes for cell in row.values())
        if len(self._rows) >= GROUP_ROWS or self._held_bytes >= GROUP_BYTES:
            self.flush()

    def flush(self) -> None:
        if self._rows:
            library, schema = pyarrow(), self._writer.schema
            arrays = [
                library.array(_cells([row[name] for row in self._rows], *kind), field.type)
                for (name, kind), field in zip(self._columns.items(), schema, strict=True)
            ]
            self._writer.write_table(library.Table.from_arrays(arrays, schema=schema))
            self._rows, self._held_bytes = [], 0


def _type(library: ModuleType, dtype: str, shape: tuple[int, ...]) -> Any:
    """Return the type of a column of arrays or images; cells of () and (1,) are plain numbers.

    Vectors have a fixed size, matrices are lists of lists, as the library datasets stores them.
    """
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
