# SPDX-License-Identifier: Apache-2.0

"""Writes the files of a LeRobotDataset v3: data in Parquet, images embedded, and its metadata.

    meta/info.json  meta/stats.json  meta/tasks.parquet  meta/episodes/chunk-000/file-000.parquet
    data/chunk-000/file-000.parquet …

The layout is that of lerobot 0.4: an episode lies in one file, and files hold many episodes.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...base.arrays import Bools
from ...base.whole_file import whole_folder
from ..formats import RowWriter
from ..parquet_table import PNG_OR_JPEG, ParquetTable, parquet_table, pyarrow
from ..sources.images import decoded
from . import ABOUT, INFO
from .features import Feature

VERSION = "v3.0"
FILE_MB, CHUNK_FILES = 100, 1000
"""A new data file begins after so many MB, a new folder after so many files: lerobot's own."""
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
_INDICES = ("frame_index", "episode_index", "index", "task_index")
COUNTERS = (
    Feature("timestamp", "float32", (1,), ()),
    *(Feature(name, "int64", (1,), ()) for name in _INDICES),
)
"""Columns that every dataset has; the order of the rows is their index."""


@contextmanager
def lerobot_writer(path: Path, features: Sequence[Feature], fps: int) -> Iterator[DatasetWriter]:
    """Open a folder for the rows of a dataset; see formats.OpenWriter."""
    with whole_folder(path) as folder, ExitStack() as tables:
        yield DatasetWriter(folder, features, fps, tables)


class DatasetWriter(RowWriter):
    """Writes into an empty folder. tables: closes the file that is open."""

    def __init__(
        self, folder: Path, features: Sequence[Feature], fps: int, tables: ExitStack
    ) -> None:
        super().__init__((*features, *COUNTERS))
        self._folder, self._fps = folder, fps
        self._arrow = pyarrow()
        self._statistics = {
            feature.name: _statistics(feature) for feature in self._features if not feature.mask
        }
        self._numbers: dict[str, int] = {}  # of tasks
        self._places: list[tuple[int, int]] = []  # chunk and file of each episode
        self._open = tables
        self._table: ParquetTable | None = None
        self._file_index = -1

    @property
    def not_finite(self) -> Mapping[str, int]:
        return {name: one.not_finite for name, one in self._statistics.items() if one.not_finite}

    def begin(self, task: str) -> None:
        if self._table is None or self._table.size > FILE_MB << 20:
            self._open.close()
            self._file_index += 1
            chunk, file = divmod(self._file_index, CHUNK_FILES)
            path = self._folder / DATA.format(chunk_index=chunk, file_index=file)
            path.parent.mkdir(parents=True, exist_ok=True)
            columns = {one.name: (one.dtype, one.shape) for one in self._features}
            self._table = self._open.enter_context(parquet_table(path, columns))
        self._numbers.setdefault(task, len(self._numbers))
        self._places.append(divmod(self._file_index, CHUNK_FILES))
        super().begin(task)

    def add(self, cells: Mapping[str, Any]) -> None:
        counters = {
            "timestamp": self.length / self._fps,
            "frame_index": self.length,
            "episode_index": self.episodes - 1,
            "index": self.frames,
            "task_index": self._numbers[self._tasks[-1]],
        }
        row = {**cells, **{name: np.array([value]) for name, value in counters.items()}}
        assert self._table is not None
        self._table.add(row)
        for name, statistics in self._statistics.items():
            if not isinstance(row[name], bytes):
                statistics.add(row[name], row.get(f"{name}.valid"))
            elif not self.frames % self._fps:  # an image per second is enough, and a 16th of it
                statistics.add(decoded(row[name], name)[::4, ::4].T / 255.0)
        super().add(cells)

    def finish(self, about: Mapping[str, Any]) -> None:
        self._open.close()
        (self._folder / "meta").mkdir()
        info = {
            "codebase_version": VERSION,
            "robot_type": None,
            "total_episodes": self.episodes,
            "total_frames": self.frames,
            "total_tasks": len(self._numbers),
            "chunks_size": CHUNK_FILES,
            "data_files_size_in_mb": FILE_MB,
            "video_files_size_in_mb": 200,
            "fps": self._fps,
            "splits": {"train": f"0:{self.episodes}"},
            "data_path": DATA,
            "video_path": None,
            "features": {feature.name: feature.content() for feature in self._features},
        }
        self._write_json(ABOUT, about)
        self._write_json(INFO, info)
        self._write_json(
            "meta/stats.json", {feature.name: self._content(feature) for feature in self._features}
        )
        # As pandas writes a table whose index is the task.
        numbers = {"task_index": list(self._numbers.values()), "task": list(self._numbers)}
        types = ("task_index", "int64", "int64"), ("task", "unicode", "object")
        keys = "name", "field_name", "metadata", "pandas_type", "numpy_type"
        columns = [dict(zip(keys, (name, name, None, *its), strict=True)) for name, *its in types]
        described = {"index_columns": ["task"], "column_indexes": [], "columns": columns}
        metadata = {"pandas": json.dumps(described)}
        tasks = self._arrow.table(numbers).replace_schema_metadata(metadata)
        self._arrow.parquet.write_table(tasks, self._folder / "meta/tasks.parquet")
        ends, path = np.cumsum(self._lengths).tolist(), self._folder / EPISODES
        episodes = [
            {
                "episode_index": number,
                "tasks": [task],
                "length": length,
                "data/chunk_index": chunk,
                "data/file_index": file,
                "dataset_from_index": end - length,
                "dataset_to_index": end,
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
            for number, (task, length, (chunk, file), end) in enumerate(
                zip(self._tasks, self._lengths, self._places, ends, strict=True)
            )
        ]
        path.parent.mkdir(parents=True)
        self._arrow.parquet.write_table(self._arrow.Table.from_pylist(episodes), path)

    def _write_json(self, name: str, content: Mapping[str, Any]) -> None:
        path = self._folder / name
        path.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", "utf-8")

    def _content(self, feature: Feature) -> dict[str, Any]:
        if feature.mask:
            # Normalising leaves it as it is. The true ones of a mask that is 1 throughout would
            # make the first 0 that a robot sees −10⁸.
            off, on = np.zeros(feature.shape).tolist(), np.ones(feature.shape).tolist()
            return {"min": off, "max": on, "mean": off, "std": on, "count": [self.frames]}
        content = self._statistics[feature.name].content()
        if feature.dtype == PNG_OR_JPEG:
            content["count"] = [-(-self.frames // self._fps)]  # images, not pixels
        return content


def _statistics(feature: Feature) -> Statistics:
    if feature.dtype == PNG_OR_JPEG:  # per colour, scaled to 0…1
        return Statistics((3, 1, 1), pooled=(1, 2))
    return Statistics(feature.shape, tuple(range(len(feature.shape))) if feature.pooled else ())


class Statistics:
    """Minimum, maximum, mean and standard deviation of one feature, per element.

    shape: of the feature; of an axis that is pooled, a value may have more elements. pooled: axes
    along which elements share one statistic, so that a taxel that nothing ever touched is not
    scaled up to noise. not_finite: elements that were NaN or infinite.

    Summed are differences to the first value, pooled to the mean of the first ones: the square of a
    Unix time in ns has 37 digits, of which float64 keeps 16.
    """

    def __init__(self, shape: tuple[int, ...], pooled: tuple[int, ...] = ()) -> None:
        self._shape, self._pooled = shape, pooled
        kept = tuple(1 if axis in pooled else size for axis, size in enumerate(shape))
        self._count, self._origin = np.zeros(kept), np.full(kept, np.nan)
        self._sum, self._squares = np.zeros(kept), np.zeros(kept)
        self._low, self._high = np.full(kept, np.inf), np.full(kept, -np.inf)
        self.not_finite = 0

    def add(self, values: NDArray[Any], valid: Bools | None = None) -> None:
        """Take in one value of the feature; elements that are not valid are left out.

        So are those that are not finite, which are counted.
        """
        values = np.asarray(values, dtype=np.float64)
        kept = np.isfinite(values)
        self.not_finite += int(np.count_nonzero(~kept))
        if valid is not None:
            kept &= valid
        along: dict[str, Any] = {"axis": self._pooled, "keepdims": True}
        count = kept.sum(**along)
        first = np.where(kept, values, 0.0).sum(**along) / np.maximum(count, 1)
        self._origin = np.where(np.isnan(self._origin) & (count > 0), first, self._origin)
        differences = np.where(kept, values - self._origin, 0.0)
        self._count += count
        self._sum += differences.sum(**along)
        self._squares += np.square(differences).sum(**along)
        low, high = (np.where(kept, values, limit) for limit in (np.inf, -np.inf))
        self._low = np.minimum(self._low, low.min(**along))
        self._high = np.maximum(self._high, high.max(**along))

    def content(self) -> dict[str, Any]:
        """Return what meta/stats.json holds; zeros where there was no value."""
        count = np.maximum(self._count, 1)
        mean = self._sum / count  # of the differences
        variance = np.maximum(self._squares / count - np.square(mean), 0.0)
        some = self._count > 0
        values = {
            "min": np.where(some, self._low, 0.0),
            "max": np.where(some, self._high, 0.0),
            "mean": np.where(some, self._origin + mean, 0.0),
            "std": np.sqrt(variance),
        }
        full = {name: np.broadcast_to(value, self._shape) for name, value in values.items()}
        content = {name: value.tolist() for name, value in full.items()}
        return content | {"count": [int(self._count.max())]}
