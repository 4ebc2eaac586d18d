# SPDX-License-Identifier: Apache-2.0

"""Formats and a viewer of one's own: lines of JSON, compressed recordings, the peak as text.

Any package brings them by entry points; in its pyproject.toml:

    [project.entry-points."tactile_cdma.writers"]
    jsonl = "own_formats:write_jsonl"

    [project.entry-points."tactile_cdma.readers"]
    xz = "own_formats:read_xz"

    [project.entry-points."tactile_cdma.viewers"]
    peak = "own_formats:show_peak"

Then these work:

    python examples/own_formats.py    # tries the viewer without being installed
    tactile-cdma export touch.skin.xz -o touch.jsonl
    tactile-cdma view sim:// --viewer peak
"""

import json
import lzma
from collections.abc import Mapping
from itertools import islice
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np

from tactile_cdma import Skin
from tactile_cdma.datasets.samples import PatchInfo, SampleSource
from tactile_cdma.datasets.sources.opening import Wanted, open_source
from tactile_cdma.datasets.tables import Rows


def write_jsonl(path: Path, frames: Rows, patch: PatchInfo, about: Mapping[str, Any]) -> None:
    with path.open("w", encoding="utf-8") as file:
        for episode, frame in frames:  # NaN: a taxel was not read
            values = [round(float(pa), 1) if pa == pa else None for pa in frame.pressure_pa]
            line = {"episode": episode, "t": frame.wall_time_s, "pa": values}
            file.write(json.dumps(line) + "\n")


def read_xz(path: Path) -> SampleSource:
    plain = Path(mkdtemp()) / path.stem
    plain.write_bytes(lzma.decompress(path.read_bytes()))
    return open_source(plain, Wanted())


def show_peak(skin: Skin) -> None:
    for frame in islice(skin, 0, 200, 20):
        known = frame.pressure_pa[np.isfinite(frame.pressure_pa)]
        print(f"{max(known, default=np.nan) / 1e3:.1f} kPa of {len(known)} taxels")


if __name__ == "__main__":
    with Skin("sim://", nodes=16) as skin:
        show_peak(skin)
