# SPDX-License-Identifier: Apache-2.0

"""The command `tactile-cdma export`: a recording's frames for other programs."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

from .. import __version__
from ..base.errors import CaptureError
from ..config.arguments import add_skin_options, given
from ..config.parameters import BY_NAME, Value
from ..config.skin_config import SkinConfig
from ..driver.pipeline import Pipeline, TactileFrame
from ..recording.capture import capture_notes, is_text
from ..recording.frame_table import taxels_path, write_csv, write_npz
from ..recording.offline import offline_values, raw_frames
from ..recording.recording_file import describe, is_recording


def add_to(commands: Any) -> None:
    """Add the command to those of the program (what argparse's add_subparsers returns)."""
    export = commands.add_parser(
        "export", help="frames of a recording as NPZ, CSV or a rosbag2 folder"
    )
    export.add_argument("file", type=Path, help="recording, or raw bytes of a port")
    export.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="OUT",
        help="OUT.npz: numpy arrays; OUT.csv: a row per frame, and OUT.taxels.csv",
    )
    export.add_argument(
        "--bag", action="store_true", help="OUT is a new folder: a bag of tactile and info, MCAP"
    )
    export.add_argument("--force", action="store_true", help="overwrite a file")
    add_skin_options(export)
    export.set_defaults(run=_export)


def _export(arguments: argparse.Namespace) -> int:
    path, output = arguments.file, arguments.output
    _check(path, output, arguments.bag, arguments.force)
    values = offline_values(path, given(arguments))
    config = SkinConfig.of(values)
    pipeline = Pipeline(config, background=False)
    frames = _timed(path, pipeline)
    first = next(frames, None)
    if first is None:
        raise CaptureError(f"{path}: {pipeline.problem or 'no frame found'}")
    try:
        count = _write(arguments, chain([first], frames), config, values)
    except OSError as error:
        raise CaptureError(f"{output}: {error.strerror}") from None
    for note in capture_notes(path):
        print(f"tactile-cdma: {path}: {note}", file=sys.stderr)
    counters = pipeline.counters
    print(f"frames={count} lost_frames={counters.lost_frames} taxels={len(config.layout.nodes)}")
    return 0


def _write(
    arguments: argparse.Namespace,
    frames: Iterator[tuple[TactileFrame, float]],
    config: SkinConfig,
    values: dict[str, Value],
) -> int:
    output: Path = arguments.output
    if arguments.bag:
        from ..recording.bag_export import write_bag  # slow to load, and needed here only

        frame_id = str(values.get("frame_id", BY_NAME["frame_id"].default))
        return write_bag(output, frames, config, frame_id)
    if output.suffix == ".npz":
        about = {"file": arguments.file.name, "parameters": values, "package_version": __version__}
        return write_npz(output, frames, config.layout, about)
    return write_csv(output, frames, config.layout)


def _check(path: Path, output: Path, bag: bool, force: bool) -> None:
    """Raises CaptureError for what cannot be exported, or not there."""
    if is_text(path):
        raise CaptureError(f"{path}: text; of an oscilloscope's capture decode --json makes frames")
    if bag and not is_recording(path):
        raise CaptureError(f"{path}: bytes alone have no times, which a bag needs")
    if bag:
        return
    if output.suffix not in (".npz", ".csv"):
        raise CaptureError(f"{output}: name it *.npz or *.csv, or ask for a folder with --bag")
    written = [output] if output.suffix == ".npz" else [output, taxels_path(output)]
    for file in written:
        if file.exists() and not force:
            raise CaptureError(f"{file}: exists already; --force overwrites it")


def _timed(path: Path, pipeline: Pipeline) -> Iterator[tuple[TactileFrame, float]]:
    """Frames, and the Unix time of their middles, s; NaN for bytes alone."""
    description = describe(path) if is_recording(path) else None
    for frame in raw_frames(path, pipeline):
        yield frame, description.wall_s(frame.t_host) if description else math.nan
