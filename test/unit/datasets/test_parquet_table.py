# SPDX-License-Identifier: Apache-2.0

"""A Parquet table that ends early: nothing is left, and only the reason is told."""

import gc
import sys
from pathlib import Path

import pytest

from tactile_cdma.datasets.parquet_table import GROUP_ROWS, ParquetTable

parquet = pytest.importorskip("pyarrow.parquet", reason="the extra [datasets] is not installed")
COLUMNS = {"number": ("f8", ())}


@pytest.mark.parametrize("rows", [0, 10, GROUP_ROWS + 10])
@pytest.mark.parametrize("reason", [KeyboardInterrupt, OSError(28, "No space left on device")])
def test_what_ends_early_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reason: BaseException, rows: int
) -> None:
    told: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", told.append)  # of writers that are cleared away
    with (
        pytest.raises((KeyboardInterrupt, OSError)),
        ParquetTable(tmp_path / "out.parquet", COLUMNS, {}) as table,
    ):
        for number in range(rows):
            table.add({"number": number})
        raise reason
    del table
    gc.collect()
    assert not told and not list(tmp_path.iterdir())


def test_a_row_that_does_not_fit_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", told.append)
    with (
        pytest.raises(ValueError, match="could not convert"),
        ParquetTable(tmp_path / "out.parquet", COLUMNS, {}) as table,
    ):
        table.add({"number": "none"})
    del table
    gc.collect()
    assert not told and not list(tmp_path.iterdir())


def test_what_ends_well_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "out.parquet"
    with ParquetTable(path, COLUMNS, {}) as table:
        for number in range(GROUP_ROWS + 10):
            table.add({"number": number})
    found = parquet.read_table(path).column("number").to_pylist()
    assert found == list(range(GROUP_ROWS + 10))
