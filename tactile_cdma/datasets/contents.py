# SPDX-License-Identifier: Apache-2.0

"""What is in a file or folder, in names and texts for people: bags, tables, LeRobot's datasets."""

from __future__ import annotations

import json
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.errors import CaptureError, TactileError
from ..base.named_file import naming
from .arrow import pyarrow
from .episodes import samples_of
from .lerobot import ABOUT, INFO
from .lerobot.features import TIME
from .parquet_table import METADATA
from .progress import Progress
from .samples import NANO, SkinFrame, patches_of
from .sources.opening import Wanted, is_bag, open_source
from .survey import FrameSurvey
from .tables import about_path

Lines = Iterator[tuple[str, str]]
_READ_ROWS = 1024
"""Rows of a table that are held in memory; chosen."""
_PER_TAXEL = ("pressure_pa", "status")
_USED = ("sequence", "device_time_s", "wall_time_s", *_PER_TAXEL)
"""Columns that a survey needs."""
_EPISODE = "episode"
"""A column that it takes where it is there: earlier versions wrote none."""
_DAMAGE = (
    *(LookupError, ArithmeticError, ValueError, TypeError, AttributeError, EOFError, MemoryError),
    *(NotImplementedError, zipfile.BadZipFile, zlib.error, tokenize.TokenError),
)
"""Errors of json, numpy and zipfile, and of arithmetic, for a damaged or foreign file."""


def contents(path: Path, progress: Progress) -> Lines:
    """The contents of anything but a recording. Raises CaptureError for an unknown kind of file."""
    if (path / INFO).is_file():
        return _lerobot(path)
    if is_bag(path):
        return _bag(path, progress)
    if path.suffix == ".csv":
        raise CaptureError(
            f"{path}: CSV cannot be read back: {about_path(path).name} beside a table says where "
            "it comes from; export to NPZ or Parquet"
        )
    readers = {".npz": _npz, ".parquet": _parquet}
    if path.suffix not in readers:
        raise CaptureError(
            f"{path}: no recording, bag, NPZ, Parquet or LeRobot folder; decode reads bytes alone"
        )
    return readers[path.suffix](path)


def source_lines(about: Mapping[str, Any]) -> Lines:
    """Which skin it was, and whether anything was touched."""
    yield "skin", str(about.get("skin") or "not named")
    calibration = about.get("calibration_id")
    yield "calibration", "not known" if calibration is None else str(calibration) or "default curve"
    measured = about.get("measured_by", "unknown")
    simulated = ": nothing was touched" if measured in ("simulated", "demonstrator") else ""
    yield "measured by", f"{measured} {about.get('digitizer_id', '')}".strip() + simulated


def _bag(path: Path, progress: Progress) -> Lines:
    source = open_source(path, Wanted())
    from .sources.bag_source import BagSource  # slow to load, and needed here only

    assert isinstance(source, BagSource)
    length_s = (source.end_ns - source.begin_ns) / NANO
    messages = sum(number for _, number in source.counts.values())
    topics = _counted(len(source.counts), "topic")
    yield "bag", f"{length_s:.3f} s, {_counted(messages, 'message')} in {topics}"
    for topic, (kind, number) in sorted(source.counts.items()):
        rate = f", {(number - 1) / length_s:.2f} Hz" if length_s > 0 and number > 1 else ""
        yield topic, f"{kind}, {_counted(number, 'message')}{rate}"
    surveys = {stream.key: FrameSurvey() for stream in patches_of(source)}
    for sample in samples_of(source, (), progress):
        if isinstance(sample.value, SkinFrame):
            surveys[sample.stream].take(sample.value)
    for stream in patches_of(source):
        patch = stream.patch
        assert patch is not None
        yield f"patch {patch.name}", f"{patch.rows} × {patch.columns} taxels of {patch.topic}"
        yield from source_lines(patch.about)
        yield from surveys[stream.key].lines()
    for note in source.notes:
        yield "note", note


def _npz(path: Path) -> Lines:
    survey = FrameSurvey()
    with _undamaged(path, "a table of tactile-cdma"):
        with naming(path, CaptureError), np.load(path, allow_pickle=False) as table:
            about = json.loads(str(table["about"]))
            rows, columns = (int(number) for number in table["shape"])
        yield "table", f"NPZ, {rows} × {columns} taxels"
        yield from source_lines(about)
        with zipfile.ZipFile(path) as archive:
            names = [*_USED, *([_EPISODE] if f"{_EPISODE}.npy" in archive.namelist() else [])]
            for values in zip(*(_rows_of(archive, name) for name in names), strict=True):
                _survey_row(survey, dict(zip(names, values, strict=True)))
    yield from survey.lines()


def _rows_of(archive: zipfile.ZipFile, name: str) -> Iterator[Any]:
    """The rows of an array in an NPZ file, without holding all of it."""
    with archive.open(f"{name}.npy") as file:
        if np.lib.format.read_magic(file) != (1, 0):
            raise ValueError(f"{name} is not in version 1.0 of the format")
        shape, _, dtype = np.lib.format.read_array_header_1_0(file)
        if dtype.hasobject:
            raise ValueError(f"{name} holds objects")
        cells = int(np.prod(shape[1:], dtype=np.int64))
        for begin in range(0, shape[0], _READ_ROWS):
            rows = min(_READ_ROWS, shape[0] - begin)
            data = file.read(rows * cells * dtype.itemsize)
            yield from np.frombuffer(data, dtype).reshape(rows, *shape[1:])


def _parquet(path: Path) -> Lines:
    library = pyarrow()
    survey = FrameSurvey()
    foreign = _undamaged(path, "a table of tactile-cdma", library.ArrowException)
    with foreign, naming(path, CaptureError), library.parquet.ParquetFile(path) as file:
        metadata = json.loads((file.schema_arrow.metadata or {}).get(METADATA, "{}"))
        if not {"about", "shape"} <= metadata.keys():
            raise CaptureError(f"{path}: Parquet, but not made by tactile-cdma export")
        rows, columns = metadata["shape"]
        yield "table", f"Parquet, {rows} × {columns} taxels"
        yield from source_lines(metadata["about"])
        names = [*_USED, *([_EPISODE] if _EPISODE in file.schema_arrow.names else [])]
        for batch in file.iter_batches(_READ_ROWS, columns=names):
            found = {name: _flat(batch.column(name)) for name in names}
            for name in _PER_TAXEL:
                found[name] = found[name].reshape(batch.num_rows, -1)
            for i in range(batch.num_rows):
                _survey_row(survey, {name: values[i] for name, values in found.items()})
    yield from survey.lines()


@contextmanager
def _undamaged(path: Path, kind: str, *more: type[Exception]) -> Iterator[None]:
    """Turns what a damaged or foreign file raises, _DAMAGE and some more, into CaptureError."""
    try:
        yield
    except TactileError:
        raise
    except (*_DAMAGE, *more) as error:  # type: ignore[misc]
        raise CaptureError(f"{path}: not {kind}, or damaged: {error!r}") from None


def _survey_row(survey: FrameSurvey, row: Mapping[str, Any]) -> None:
    frame = SkinFrame(
        sequence=int(row["sequence"]),
        device_time_s=float(row["device_time_s"]),
        wall_time_s=float(row["wall_time_s"]),
        stamp_uncertainty_s=float("nan"),
        noise_v=float("nan"),
        pressure_pa=row["pressure_pa"],
        voltage_v=row["pressure_pa"],
        status=row["status"],
    )
    survey.take(frame, int(row.get(_EPISODE, 0)))


def _lerobot(path: Path) -> Lines:
    library = pyarrow()
    with _undamaged(path, "a dataset of LeRobot v3", library.ArrowException, OSError):
        info = json.loads((path / INFO).read_text("utf-8"))
        ours = path / ABOUT
        about = json.loads(ours.read_text("utf-8")) if ours.is_file() else {}
        features, frames, fps = info["features"], info["total_frames"], info["fps"]
        episodes = _counted(info["total_episodes"], "episode")
        yield "dataset", f"LeRobot {info['codebase_version']}, {episodes}"
        yield "frames", f"{frames} in {frames / fps:.3f} s, {fps} Hz"
        for name, feature in features.items():
            unit = about.get("units", {}).get(name, "")
            shape = " × ".join(map(str, feature["shape"]))
            yield name, f"{feature['dtype']}, {shape} {unit}".strip()
        if about:
            yield "readings", f"{about['samples']} per frame; NaN: {about['nan']}"
        for patch in about.get("patches", ()):
            yield "patch", f"{patch['patch']} of {patch['file']}"
            yield from source_lines(patch)
        yield from _lerobot_data(path, features, fps, frames)


def _lerobot_data(path: Path, features: Mapping[str, Any], fps: float, frames: int) -> Lines:
    """Shares of invalid readings, and gaps: ticks that are missing between rows.

    frames: how many rows there should be.
    """
    library = pyarrow()
    masks = {name: np.zeros(2, dtype=np.int64) for name in features if name.endswith(".valid")}
    clock = ("episode_index", TIME) if TIME in features else ()
    rows, gaps, last = 0, 0, (-1, 0)
    for file in sorted(path.glob("data/*/*.parquet")):
        with library.parquet.ParquetFile(file) as data:
            rows += data.metadata.num_rows
            for batch in data.iter_batches(_READ_ROWS, columns=[*masks, *clock]):
                for name, counts in masks.items():
                    values = _flat(batch.column(name))
                    counts += np.array([np.count_nonzero(values == 0), len(values)])
                times = [batch.column(name).to_pylist() for name in clock]
                for moment in zip(*times, strict=True):
                    gaps += last[0] == moment[0] and moment[1] - last[1] > 1.5 * NANO / fps
                    last = moment
    if rows != frames:
        yield "problem", f"data/ holds {rows} rows of the {frames} that {INFO} counts"
    if not rows:
        return  # nothing can be said of gaps and readings
    if clock:
        yield "gaps", f"{gaps} between rows of an episode" if gaps else "none within episodes"
    for name, (invalid, number) in masks.items():
        yield name.removesuffix(".valid"), f"{invalid / max(int(number), 1):.2%} invalid"


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _flat(column: Any) -> NDArray[Any]:
    """The numbers of a column, whatever lists they are in."""
    while hasattr(column.type, "value_type"):
        column = column.flatten()
    return np.asarray(column.to_numpy(zero_copy_only=False))
