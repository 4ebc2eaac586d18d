# SPDX-License-Identifier: Apache-2.0

"""Finds the writer of a table by the end of its name; other packages bring theirs.

    OUT.hdf5: data/demo_0/obs/NAME, data/demo_0/actions, …; about (robomimic's layout)
    OUT.zarr: data/NAME, all episodes one after the other; meta/episode_ends; about as an attribute

What is not known there is NaN: also rewards, which robomimic reads.
"""

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..base.errors import CaptureError, needed_for
from ..base.whole_file import replacing, whole_folder
from . import tables
from .lerobot.features import Feature
from .parquet_table import GROUP_BYTES, GROUP_ROWS, PNG_OR_JPEG
from .pictures import FIGURES, PICTURES_HZ, write_figure, write_video
from .samples import PatchInfo
from .sources.images import decoded

OBSERVATION, ACTION = "observation.", "action"
ENVIRONMENT = json.dumps({"env_name": "tactile_cdma", "env_type": 2, "env_kwargs": {}})
"""What robomimic wants to know of a simulator: here there was none; 2: one that Gym makes."""
CHUNK_BYTES = 1 << 20
"""Size of a Zarr array's file before it is compressed; chosen."""


class RowWriter(ABC):
    """Writes rows of episodes: begin(), add() rows, begin() the next episode, …, finish().

    frames: written so far; length: those of the last episode.
    """

    def __init__(self, features: Sequence[Feature]) -> None:
        self._features = features
        self._tasks: list[str] = []
        self._lengths: list[int] = []
        self.frames = self.length = 0

    @property
    def episodes(self) -> int:
        return len(self._tasks)

    @property
    def not_finite(self) -> Mapping[str, int]:
        """Tell how many elements of a feature were NaN or infinite, where that is no use."""
        return {}

    def begin(self, task: str) -> None:
        """Begin an episode; it has to get a row."""
        self._tasks.append(task)
        self._lengths.append(0)
        self.length = 0

    def add(self, cells: Mapping[str, Any]) -> None:
        """Add a row to the episode that was begun last: arrays, and images as files' bytes."""
        self.frames, self.length = self.frames + 1, self.length + 1
        self._lengths[-1] = self.length

    @abstractmethod
    def finish(self, about: Mapping[str, Any]) -> None: ...


OpenWriter: TypeAlias = Callable[[Path, Sequence[Feature], int], AbstractContextManager[RowWriter]]
"""Opens a file or folder for rows, so many per s; it appears when the context ends, unless by an
exception. Raises MissingPackageError, OSError."""


class _ArrayWriter(RowWriter):
    """Appends rows to arrays that the library keeps in its file, many at once."""

    def __init__(self, features: Sequence[Feature]) -> None:
        super().__init__(features)
        self._arrays: dict[str, Any] = {}
        self._held: list[dict[str, NDArray[Any]]] = []
        self._held_bytes = 0

    def begin(self, task: str) -> None:
        self._flush()
        super().begin(task)

    def add(self, cells: Mapping[str, Any]) -> None:
        super().add(cells)
        row = {one.name: _array(one, cells[one.name]) for one in self._features}
        self._held.append(row)
        self._held_bytes += sum(values.nbytes for values in row.values())
        if len(self._held) >= GROUP_ROWS or self._held_bytes >= GROUP_BYTES:
            self._flush()

    def _flush(self) -> None:
        for name, array in self._arrays.items() if self._held else ():
            values = np.stack([row[name] for row in self._held])
            array.resize((array.shape[0] + len(values), *array.shape[1:]))
            array[-len(values) :] = values
        self._held, self._held_bytes = [], 0

    def _described(self, about: Mapping[str, Any]) -> dict[str, Any]:
        content = {one.name: one.content() for one in self._features}
        return {**about, "features": content, "tasks": self._tasks}


class _Hdf5Writer(_ArrayWriter):
    def __init__(self, file: Any, features: Sequence[Feature]) -> None:
        super().__init__(features)
        self._file, self._data = file, file.create_group("data")

    def begin(self, task: str) -> None:
        super().begin(task)
        demo = self._data.create_group(f"demo_{self.episodes - 1}")
        demo.attrs["task"] = task
        for one in self._features:
            name = one.name.replace(OBSERVATION, "obs/") if one.name != ACTION else "actions"
            shape = {"shape": (0, *one.shape), "maxshape": (None, *one.shape)}
            self._arrays[one.name] = demo.create_dataset(
                name, dtype=_dtype(one), compression="gzip", **shape
            )

    def finish(self, about: Mapping[str, Any]) -> None:
        self._flush()
        for number, length in enumerate(self._lengths):
            demo = self._data[f"demo_{number}"]
            demo.attrs["num_samples"] = length
            demo["rewards"] = np.full(length, np.nan, np.float32)
            demo["dones"] = np.arange(1, length + 1) // length
        self._data.attrs.update(total=self.frames, env_args=ENVIRONMENT)
        self._file["about"] = json.dumps(self._described(about))


class _ZarrWriter(_ArrayWriter):
    def __init__(self, root: Any, features: Sequence[Feature]) -> None:
        super().__init__(features)
        self._root, data = root, root.create_group("data")
        for one in features:
            row_bytes = np.dtype(_dtype(one)).itemsize * int(np.prod(one.shape))
            rows = min(max(1, CHUNK_BYTES // row_bytes), GROUP_ROWS)
            shape = {"shape": (0, *one.shape), "chunks": (rows, *one.shape)}
            name = one.name.removeprefix(OBSERVATION)
            self._arrays[one.name] = data.create_array(name, dtype=_dtype(one), **shape)

    def finish(self, about: Mapping[str, Any]) -> None:
        self._flush()
        self._root.create_group("meta").create_array("episode_ends", data=np.cumsum(self._lengths))
        self._root.attrs["about"] = self._described(about)


@contextmanager
def hdf5_writer(path: Path, features: Sequence[Feature], fps: int) -> Iterator[RowWriter]:
    """Open an HDF5 file for rows; see OpenWriter."""
    with needed_for("HDF5", "h5py"):
        import h5py
    with replacing(path) as raw, h5py.File(raw, "w") as file:
        yield _Hdf5Writer(file, features)


@contextmanager
def zarr_writer(path: Path, features: Sequence[Feature], fps: int) -> Iterator[RowWriter]:
    """Open a Zarr folder for rows; see OpenWriter. Raises CaptureError for another folder."""
    with needed_for("Zarr", "zarr"):
        import zarr
    if path.exists() and not (path / ".zgroup").is_file():
        raise CaptureError(f"{path}: exists, and is no Zarr group to replace")
    with whole_folder(path) as folder:
        # Every version of the library reads format 2.
        yield _ZarrWriter(zarr.open_group(store=folder, mode="w", zarr_format=2), features)


def _dtype(feature: Feature) -> str:
    return "uint8" if feature.dtype == PNG_OR_JPEG else feature.dtype


def _array(feature: Feature, cell: Any) -> NDArray[Any]:
    pixels = decoded(cell, feature.name) if feature.dtype == PNG_OR_JPEG else cell
    return np.array(pixels, _dtype(feature)).reshape(feature.shape)


GROUP = "tactile_cdma.writers"
"""Entry points of writers in other packages, called as the end of a file's name: mat, say."""
TableWriter: TypeAlias = Callable[[Path, tables.Rows, PatchInfo, Mapping[str, Any]], None]
"""Writes the frames of one patch, at least one, to a file that does not exist or is to be replaced;
the mapping is metadata. Raises MissingPackageError, OSError."""


def write_episodes(
    open_writer: OpenWriter,
    path: Path,
    frames: tables.Rows,
    patch: PatchInfo,
    about: Mapping[str, Any],
) -> None:
    """Write a row per frame, and in which taxels it is valid, by episodes; see TableWriter."""
    taxels = (len(patch),)
    features = [
        Feature(name, np.dtype(kind).name, (), ()) for name, kind in tables.PER_FRAME.items()
    ]
    for name, kind in (tables.PER_TAXEL | {"valid": "bool"}).items():
        features.append(Feature(OBSERVATION + name, np.dtype(kind).name, taxels, ("taxel",)))
    with open_writer(path, features, 0) as writer:
        last: int | None = None
        for episode, frame in frames:
            if episode != last:
                writer.begin(str(episode))
                last = episode
            cells = tables.row(episode, frame) | {"valid": frame.valid}
            named = {one.name: cells[one.name.removeprefix(OBSERVATION)] for one in features}
            writer.add(named)
        constants = {"shape": [patch.rows, patch.columns], **tables.constants(patch)}
        writer.finish({**about, "taxels": constants})


ON_CLOCK: dict[str, OpenWriter] = {".hdf5": hdf5_writer, ".zarr": zarr_writer}
"""Formats of datasets on one clock, too."""
PICTURES: dict[str, Callable[..., None]] = {
    **dict.fromkeys(PICTURES_HZ, write_video),
    **dict.fromkeys(FIGURES, write_figure),
}
"""Suffixes of pictures: their writers take max_pa, the pressure at the top of the colours, too."""
BUILT_IN: dict[str, TableWriter] = {
    ".npz": tables.write_npz,
    ".csv": tables.write_csv,
    ".parquet": tables.write_parquet,
    **{suffix: partial(write_episodes, writer) for suffix, writer in ON_CLOCK.items()},
    **PICTURES,
}


def writer_of(path: Path) -> TableWriter:
    """Return what writes a file of this name; raises CaptureError where nothing does."""
    if (writer := BUILT_IN.get(path.suffix)) is not None:
        return writer
    others = {f".{point.name}": point for point in entry_points(group=GROUP)}
    if path.suffix in others:
        found: TableWriter = others[path.suffix].load()
        return found
    suffixes = ", ".join(f"*{suffix}" for suffix in (*BUILT_IN, *others))
    raise CaptureError(f"{path}: name it {suffixes}, or ask for --bag or --lerobot")
