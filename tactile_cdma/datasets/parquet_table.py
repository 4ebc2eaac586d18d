# SPDX-License-Identifier: Apache-2.0

"""A patch's frames as a Parquet file: the columns of an NPZ, its constants as metadata."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np

from ..base.whole_file import replacing
from .arrow import array_column, array_type, pyarrow
from .samples import PatchInfo
from .tables import PER_FRAME, PER_TAXEL, Frames, column_type, columns, known, places

GROUP_ROWS, GROUP_BYTES = 4096, 16 << 20
"""The most of a row group, which is held in memory; chosen."""
METADATA = b"tactile_cdma"
"""Key of the file's metadata: JSON with about and the arrays of the taxels."""


class ParquetTable:
    """A Parquet file that grows by rows of numbers and arrays of a fixed size.

    columns: name → numpy type and shape of a cell. Use as a context manager: the file appears when
    that ends; after an exception nothing has changed. Raises MissingPackageError without pyarrow.
    """

    def __init__(
        self,
        path: Path,
        columns: Mapping[str, tuple[str, tuple[int, ...]]],
        metadata: Mapping[str, Any],
    ) -> None:
        self._library, self._columns = pyarrow(), columns
        schema = [(name, array_type(*kind)) for name, kind in columns.items()]
        self._schema = self._library.schema(schema).with_metadata(
            {METADATA: json.dumps(metadata).encode()}
        )
        row_bytes = sum(
            np.dtype(dtype).itemsize * int(np.prod(shape)) for dtype, shape in columns.values()
        )
        self._most = max(1, min(GROUP_ROWS, GROUP_BYTES // row_bytes))
        self._rows: list[Mapping[str, Any]] = []
        self._path = path

    def add(self, row: Mapping[str, Any]) -> None:
        """Add a row. Arrays are copied when their group is written: hand over such that stay."""
        self._rows.append(row)
        if len(self._rows) >= self._most:
            self._flush()

    def __enter__(self) -> ParquetTable:
        with ExitStack() as stack:
            file = stack.enter_context(replacing(self._path))
            self._writer = self._library.parquet.ParquetWriter(file, self._schema)
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
                array_column(np.array([row[name] for row in self._rows], dtype=dtype))
                for name, (dtype, _) in self._columns.items()
            ]
            self._writer.write_table(self._library.Table.from_arrays(cells, schema=self._schema))
            self._rows = []


def write_parquet(path: Path, frames: Frames, patch: PatchInfo, about: Mapping[str, Any]) -> int:
    """All frames, one per row; returns how many. Raises MissingPackageError, OSError."""
    kinds: dict[str, tuple[str, tuple[int, ...]]] = {
        name: (column_type(name).str, ()) for name in PER_FRAME
    }
    kinds |= {name: (column_type(name).str, (len(patch),)) for name in PER_TAXEL}
    constants = {name: known(array) for name, array in places(patch).items()}
    count = 0
    with ParquetTable(path, kinds, {"about": about} | constants) as table:
        for episode, frame in frames:
            table.add(columns(episode, frame))
            count += 1
    return count
