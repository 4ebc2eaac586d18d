# SPDX-License-Identifier: Apache-2.0

"""Decoded frames as tables for learning pipelines: NPZ and CSV; see docs/recording.md."""

from __future__ import annotations

import csv
import io
import json
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.whole_file import replacing
from ..driver.pipeline import TactileFrame
from ..places.layout import Layout

Frames = Iterator[tuple[TactileFrame, float]]
"""Frames, and the Unix time of their middles in s (NaN where it is not known)."""

_PER_FRAME = {"sequence": "<u8", "device_time_s": "<f8", "wall_time_s": "<f8", "noise_v": "<f4"}
_PER_TAXEL = {"pressure_pa": "<f4", "voltage_v": "<f4", "status": "|u1"}


def write_npz(path: Path, frames: Frames, layout: Layout, about: Mapping[str, Any]) -> int:
    """All frames, at least one, as numpy arrays by columns; returns how many. Raises OSError.

    about: metadata, stored as JSON. Columns are kept in temporary files beside it, so that memory
    does not grow with the recording.
    """
    count, taxels = 0, len(layout.positions_m)
    shapes = dict.fromkeys(_PER_FRAME, ()) | dict.fromkeys(_PER_TAXEL, (taxels,))
    with ExitStack() as stack:
        file = stack.enter_context(replacing(path))  # first, since it may fail
        spools = {
            name: stack.enter_context(tempfile.TemporaryFile(dir=path.parent)) for name in shapes
        }
        for frame, wall_s in frames:
            count += 1
            for name, value in _columns(frame, wall_s).items():
                spools[name].write(np.asarray(value, dtype=_type(name)).tobytes())
        arrays: dict[str, Any] = {
            name: np.memmap(spool, _type(name), "r", shape=(count, *shapes[name]))
            for name, spool in spools.items()
        }
        arrays |= _places(layout) | {"about": np.array(json.dumps(about))}
        np.savez_compressed(file, **arrays)
    return count


def write_csv(path: Path, frames: Frames, layout: Layout, about: Mapping[str, Any]) -> int:
    """One row per frame; beside it NAME.taxels.csv, one row per taxel, and NAME.about.json.

    Returns how many frames. Raises OSError.
    """
    count, taxels = 0, len(layout.positions_m)
    with replacing(path) as raw:
        file = io.TextIOWrapper(raw, encoding="utf-8", newline="")
        table = csv.writer(file, lineterminator="\n")
        table.writerow([*_PER_FRAME, *(f"{n}_{i}" for n in _PER_TAXEL for i in range(taxels))])
        for frame, wall_s in frames:
            count += 1
            columns = _columns(frame, wall_s)
            row = [columns[name] for name in _PER_FRAME]
            for name in _PER_TAXEL:
                row.extend(columns[name])
            table.writerow("" if value != value else value for value in row)  # NaN: an empty cell
        file.flush()
        file.detach()
    with replacing(taxels_path(path)) as raw:
        raw.write(_taxels(layout).encode())
    with replacing(about_path(path)) as raw:
        raw.write(json.dumps(about, indent=1).encode() + b"\n")
    return count


def taxels_path(path: Path) -> Path:
    """The file of the taxels' places that goes with a CSV file."""
    return path.with_name(f"{path.stem}.taxels{path.suffix}")


def about_path(path: Path) -> Path:
    """The file of the metadata that goes with a CSV file."""
    return path.with_name(f"{path.stem}.about.json")


def _columns(frame: TactileFrame, wall_s: float) -> dict[str, Any]:
    readings = frame.readings
    return {
        "sequence": frame.sequence,
        "device_time_s": frame.t_middle,
        "wall_time_s": wall_s,
        "noise_v": frame.words.noise_rms_v,
        "pressure_pa": readings.pressure_pa,
        "voltage_v": readings.voltage_v,
        "status": readings.status,
    }


def _type(name: str) -> np.dtype[Any]:
    return np.dtype({**_PER_FRAME, **_PER_TAXEL}[name])


def _places(layout: Layout) -> dict[str, NDArray[Any]]:
    """Arrays that are the same in all frames."""
    return {
        "shape": np.array([layout.rows, layout.columns], dtype=np.uint16),
        "node": layout.nodes.astype(np.uint16),
        "position_m": layout.positions_m.astype(np.float32),
        "normal": layout.normals.astype(np.float32),
        "area_m2": layout.areas_m2.astype(np.float32),
    }


def _taxels(layout: Layout) -> str:
    places = _places(layout)
    lines = ["taxel,node,x_m,y_m,z_m,normal_x,normal_y,normal_z,area_m2"]
    for taxel, node in enumerate(places["node"]):
        numbers = [*places["position_m"][taxel], *places["normal"][taxel], places["area_m2"][taxel]]
        lines.append(",".join([str(taxel), str(node), *map(str, numbers)]))
    return "\n".join(lines) + "\n"
