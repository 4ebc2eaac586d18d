# SPDX-License-Identifier: Apache-2.0

"""Reads what the Rerun viewer would show."""

from pathlib import Path

from pyarrow.types import is_temporal
from rerun.chunk import RrdReader


def columns_of(file: Path) -> dict[tuple[str, str], list[object]]:
    """Values by entity and column; where it is empty there was nothing."""
    values: dict[tuple[str, str], list[object]] = {}
    for chunk in RrdReader(file).stream():
        batch = chunk.to_record_batch()
        for name, column in zip(batch.schema.names, batch.columns, strict=True):
            of_column = values.setdefault((chunk.entity_path, name), [])
            if is_temporal(column.type):
                column = column.cast("int64")  # ns are too fine for datetime
            of_column += [value for value in column.to_pylist() if value is not None]
    return values
