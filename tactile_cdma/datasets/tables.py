# SPDX-License-Identifier: Apache-2.0

"""The frames of one patch as tables: NPZ, CSV, Parquet; see docs/recording.md."""

import csv
import io
import json
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..base.errors import CaptureError
from ..base.whole_file import replace_file, replacing
from .episodes import Episode, number_at, samples_of
from .parquet_table import parquet_table
from .progress import Progress
from .samples import (
    NANO,
    Completeness,
    Continuity,
    PatchInfo,
    SampleSource,
    SkinFrame,
    check_taxels,
    differences,
    patches_of,
)

Rows: TypeAlias = Iterator[tuple[int, SkinFrame]]
"""Frames, each with the number of its episode."""

PER_FRAME = {
    "sequence": "<u8",
    "device_time_s": "<f8",
    "wall_time_s": "<f8",
    "stamp_uncertainty_s": "<f4",
    "noise_v": "<f4",
    "episode": "<u4",
}
PER_TAXEL = {"pressure_pa": "<f4", "voltage_v": "<f4", "status": "|u1"}
COLUMNS = PER_FRAME | PER_TAXEL
"""Types of the columns' numbers."""


class PatchFrames:
    """Iterates over the frames of one patch in the episodes of all files: number of episode, frame.

    episodes: of a file. from_first_complete: in every file, begin where every taxel in service has
    had a valid reading. left_out: frames before that. missing: frame periods between two frames of
    an episode without one, by the sequence: lost, or not published. patch: that of the first frame,
    from then on. given: frames so far. notes: what was odd, complete when all is read. Raises
    CaptureError where files do not fit together, or a patch is never complete.
    """

    def __init__(
        self,
        sources: Sequence[SampleSource],
        name: str,
        episodes: Callable[[SampleSource], Sequence[Episode]],
        progress: Progress,
        from_first_complete: bool = False,
    ) -> None:
        self._sources, self._name, self._progress = sources, name, progress
        self._episodes, self._from_first_complete = episodes, from_first_complete
        self.left_out = self.missing = self.given = 0
        self.patch: PatchInfo | None = None
        self.notes: list[str] = []

    def __iter__(self) -> Rows:
        first = 0  # number of a file's first episode
        for source in self._sources:
            mine, its = (
                ", ".join(sorted(patch.name for patch in patches_of(one.streams).values()))
                for one in (self._sources[0], source)
            )
            if mine != its:
                raise CaptureError(
                    f"{source.path}: its patches are {its or 'none'}, in the first file {mine}: "
                    "choose by --topic, or export them one by one"
                )
            episodes, before = self._episodes(source), self.given
            for number, frame in self._of(source, self._own(source)[0], episodes):
                if self.given == before:  # the digitizer of a recording is known from here on
                    _, patch = self._own(source)
                    self.patch = self.patch or patch
                    check_taxels(self.patch, patch, source.path)
                    for difference in differences(patch.name, self.patch.about, patch.about):
                        raise CaptureError(f"{source.path}: {difference}; export them one by one")
                self.given += 1
                yield first + number, frame
            if self.given == before:
                self.notes.append(f"{source.path}: no frame of {self._name} in its episodes")
            first += len(episodes)

    def _own(self, source: SampleSource) -> tuple[str, PatchInfo]:
        """Return the patch in a file, as far as that was read, and the key of its frames."""
        return next(one for one in patches_of(source.streams).items() if one[1].name == self._name)

    def _of(self, source: SampleSource, key: str, episodes: Sequence[Episode]) -> Rows:
        seen, continuity = Completeness(), Continuity()
        last: int | None = None
        for sample in samples_of(source, episodes, self._progress):
            frame = sample.value
            if sample.stream != key or not isinstance(frame, SkinFrame):
                continue
            if self._from_first_complete and not seen.is_complete:
                seen.take(frame)
                if not seen.is_complete:
                    self.left_out += 1
                    continue
            if (number := number_at(episodes, sample.stamp_ns)) is not None:
                continuity.take(frame.sequence, sample.stamp_ns / NANO, last == number)
                last = number
                yield number, frame
        self.missing += continuity.missing
        if restarts := continuity.restarts.number:
            self.notes.append(
                f"{source.path}: {self._name}: {restarts} where the sequence begins anew (did the "
                f"driver restart?); what is missing in the {continuity.restarts.total_s:.3f} s "
                "between these frames is not known"
            )
        if self._from_first_complete:
            seen.check(source.path, self._name)


def write_npz(path: Path, frames: Rows, patch: PatchInfo, about: Mapping[str, Any]) -> None:
    """Write all frames, at least one, as numpy arrays by columns. Raises OSError.

    about: as JSON. Columns are kept in temporary files meanwhile, so that memory does not grow with
    the recording.
    """
    with ExitStack() as stack:
        file = stack.enter_context(replacing(path))  # first, since it may fail
        spools = {
            name: stack.enter_context(tempfile.TemporaryFile(dir=path.parent)) for name in COLUMNS
        }
        for episode, frame in frames:
            for name, value in row(episode, frame).items():
                spools[name].write(np.asarray(value, dtype=COLUMNS[name]).tobytes())
        arrays: dict[str, Any] = {
            name: np.memmap(spool, COLUMNS[name], "r") for name, spool in spools.items()
        }
        arrays |= {name: arrays[name].reshape(-1, len(patch)) for name in PER_TAXEL}
        arrays |= places(patch) | {"shape": np.array([patch.rows, patch.columns], dtype=np.uint16)}
        np.savez_compressed(file, **arrays, about=np.array(json.dumps(about)))


def write_csv(path: Path, frames: Rows, patch: PatchInfo, about: Mapping[str, Any]) -> None:
    """Write a row per frame; beside it NAME.taxels.csv, a row per taxel, and NAME.about.json.

    Raises OSError.
    """
    with replacing(path) as raw:
        file = io.TextIOWrapper(raw, encoding="utf-8", newline="")
        table = csv.writer(file, lineterminator="\n")
        taxels = range(len(patch))
        table.writerow([*PER_FRAME, *(f"{name}_{i}" for name in PER_TAXEL for i in taxels)])
        for episode, frame in frames:
            found = row(episode, frame)
            cells = [found[name] for name in PER_FRAME]
            for name in PER_TAXEL:
                cells.extend(found[name])
            table.writerow("" if value != value else value for value in cells)  # NaN: empty
        file.flush()
        file.detach()
    rows = ["taxel,node,x_m,y_m,z_m,normal_x,normal_y,normal_z,area_m2"]
    known = zip(*places(patch).values(), strict=True)
    for taxel, (node, position_m, normal, area_m2) in enumerate(known):
        rows.append(",".join(map(str, (taxel, node, *position_m, *normal, area_m2))))
    taxels_path, about_path = files_beside(path)
    replace_file(taxels_path, "\n".join(rows) + "\n")
    replace_file(about_path, json.dumps(about, indent=1) + "\n")


def write_parquet(path: Path, frames: Rows, patch: PatchInfo, about: Mapping[str, Any]) -> None:
    """Write a row per frame, with the columns of an NPZ; its constants are metadata.

    Raises MissingPackageError, OSError.
    """
    kinds: dict[str, tuple[str, tuple[int, ...]]] = {
        name: (dtype, (len(patch),) if name in PER_TAXEL else ()) for name, dtype in COLUMNS.items()
    }
    metadata = {"about": about, "shape": [patch.rows, patch.columns], **constants(patch)}
    with parquet_table(path, kinds, metadata) as table:
        for episode, frame in frames:
            table.add(row(episode, frame))


def files_beside(path: Path) -> tuple[Path, Path]:
    """Return the files that go with a CSV file: of the taxels' places, and of the metadata."""
    taxels = path.with_name(f"{path.stem}.taxels{path.suffix}")
    return taxels, path.with_name(f"{path.stem}.about.json")


def row(episode: int, frame: SkinFrame) -> dict[str, Any]:
    """Return a frame as a table's row, by columns."""
    cells = {name: getattr(frame, name) for name in COLUMNS if name != "episode"}
    return {"episode": episode} | cells


def places(patch: PatchInfo) -> dict[str, NDArray[Any]]:
    """Return the arrays of taxels that are the same in all frames."""
    return {
        "node": patch.nodes.astype(np.uint16),
        "position_m": patch.positions_m,
        "normal": patch.normals,
        "area_m2": patch.areas_m2,
    }


def constants(patch: PatchInfo) -> dict[str, Any]:
    """Return places as lists for JSON, which has no NaN; None where they are not known."""
    return {
        name: values.tolist() if np.isfinite(values).all() else None
        for name, values in places(patch).items()
    }
