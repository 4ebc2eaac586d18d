# SPDX-License-Identifier: Apache-2.0

"""A patch's frames as tables: NPZ and CSV; see docs/recording.md."""

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
from .samples import PatchInfo, SkinFrame

Frames = Iterator[tuple[int, SkinFrame]]
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


def write_npz(path: Path, frames: Frames, patch: PatchInfo, about: Mapping[str, Any]) -> int:
    """All frames, at least one, as numpy arrays by columns; returns how many. Raises OSError.

    about: metadata, stored as JSON. Columns are kept in temporary files beside it, so that memory
    does not grow with the recording.
    """
    count = 0
    with ExitStack() as stack:
        file = stack.enter_context(replacing(path))  # first, since it may fail
        spools = {
            name: stack.enter_context(tempfile.TemporaryFile(dir=path.parent)) for name in COLUMNS
        }
        for episode, frame in frames:
            count += 1
            for name, value in columns(episode, frame).items():
                spools[name].write(np.asarray(value, dtype=COLUMNS[name]).tobytes())
        arrays: dict[str, Any] = {
            name: np.memmap(
                spool, COLUMNS[name], "r", shape=(count, len(patch)) if name in PER_TAXEL else count
            )
            for name, spool in spools.items()
        }
        arrays |= places(patch) | {"about": np.array(json.dumps(about))}
        np.savez_compressed(file, **arrays)
    return count


def write_csv(path: Path, frames: Frames, patch: PatchInfo, about: Mapping[str, Any]) -> int:
    """One row per frame; beside it NAME.taxels.csv, one row per taxel, and NAME.about.json.

    Returns how many frames. Raises OSError.
    """
    count, taxels = 0, len(patch)
    with replacing(path) as raw:
        file = io.TextIOWrapper(raw, encoding="utf-8", newline="")
        table = csv.writer(file, lineterminator="\n")
        table.writerow([*PER_FRAME, *(f"{n}_{i}" for n in PER_TAXEL for i in range(taxels))])
        for episode, frame in frames:
            count += 1
            found = columns(episode, frame)
            row = [found[name] for name in PER_FRAME]
            for name in PER_TAXEL:
                row.extend(found[name])
            table.writerow("" if value != value else value for value in row)  # NaN: an empty cell
        file.flush()
        file.detach()
    with replacing(taxels_path(path)) as raw:
        raw.write(_taxels(patch).encode())
    with replacing(about_path(path)) as raw:
        raw.write(json.dumps(about, indent=1).encode() + b"\n")
    return count


def taxels_path(path: Path) -> Path:
    """The file of the taxels' places that goes with a CSV file."""
    return path.with_name(f"{path.stem}.taxels{path.suffix}")


def about_path(path: Path) -> Path:
    """The file of the metadata that goes with a CSV file."""
    return path.with_name(f"{path.stem}.about.json")


def columns(episode: int, frame: SkinFrame) -> dict[str, Any]:
    """One row of a table."""
    cells = {name: getattr(frame, name) for name in COLUMNS if name != "episode"}
    return {"episode": episode} | cells


def places(patch: PatchInfo) -> dict[str, NDArray[Any]]:
    """Arrays that are the same in all frames."""
    return {
        "shape": np.array([patch.rows, patch.columns], dtype=np.uint16),
        "node": patch.nodes.astype(np.uint16),
        "position_m": patch.positions_m,
        "normal": patch.normals,
        "area_m2": patch.areas_m2,
    }


def known(values: NDArray[Any]) -> Any:
    """An array as lists for JSON, which has no NaN; None where it is not known."""
    return values.tolist() if np.isfinite(values).all() else None


def _taxels(patch: PatchInfo) -> str:
    found = places(patch)
    lines = ["taxel,node,x_m,y_m,z_m,normal_x,normal_y,normal_z,area_m2"]
    for taxel, node in enumerate(found["node"]):
        numbers = [*found["position_m"][taxel], *found["normal"][taxel], found["area_m2"][taxel]]
        lines.append(",".join([str(taxel), str(node), *map(str, numbers)]))
    return "\n".join(lines) + "\n"
