# SPDX-License-Identifier: Apache-2.0

"""A Parquet table that ends early: nothing is left, and only the reason is told."""

import gc
import sys
from pathlib import Path
from typing import Any

import pytest

from tactile_cdma.datasets.parquet_table import GROUP_ROWS, parquet_table

parquet = pytest.importorskip("pyarrow.parquet", reason="the extra [learn] is not installed")
COLUMNS = {"number": ("f8", ())}


@pytest.mark.parametrize("rows", [0, 10, GROUP_ROWS + 10])
@pytest.mark.parametrize("reason", [KeyboardInterrupt, OSError(28, "full"), ValueError])
def test_what_ends_early_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reason: Any, rows: int
) -> None:
    told: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", told.append)  # of writers that are cleared away
    with (
        pytest.raises((KeyboardInterrupt, OSError, ValueError)),
        parquet_table(tmp_path / "out.parquet", COLUMNS, {}) as table,
    ):
        for number in range(rows):
            table.add({"number": number})
        if reason is not ValueError:
            raise reason
        table.add({"number": "none"})  # a row that does not fit is seen when it is written
    del table
    gc.collect()
    assert not told and not list(tmp_path.iterdir())


def test_what_ends_well_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "out.parquet"
    with parquet_table(path, COLUMNS, {}) as table:
        for number in range(GROUP_ROWS + 10):
            table.add({"number": number})
    found = parquet.read_table(path).column("number").to_pylist()
    assert found == list(range(GROUP_ROWS + 10))
