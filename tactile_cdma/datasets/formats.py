# SPDX-License-Identifier: Apache-2.0

"""Finds the writer of a table by the end of its name; other packages bring theirs."""

from collections.abc import Callable, Mapping
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from ..base.errors import CaptureError
from . import tables
from .array_files import OBSERVATION, OpenWriter, hdf5_writer, zarr_writer
from .lerobot.meta import Feature
from .pictures import FIGURES, PICTURES_HZ, write_figure, write_video
from .samples import PatchInfo

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
