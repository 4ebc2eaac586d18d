# SPDX-License-Identifier: Apache-2.0

"""The subcommand `tactile-cdma export`: writes a recording's frames for other programs."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

from .. import __version__
from ..base.errors import CaptureError
from ..base.named_file import naming
from ..base.optional import needed_for
from ..config.arguments import add_skin_options, given
from ..config.parameters import BY_NAME
from ..driver.pipeline import TactileFrame
from ..recording.capture import is_text
from ..recording.frame_table import about_path, taxels_path, write_csv, write_npz
from ..recording.offline import RawCapture
from ..recording.recording_file import is_recording


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand."""
    parser.add_argument("file", type=Path, help="recording, or raw bytes of a port")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="OUT",
        help="OUT.npz: numpy arrays; OUT.csv: a row per frame, and OUT.taxels.csv, OUT.about.json",
    )
    parser.add_argument(
        "--bag", action="store_true", help="OUT is a new folder: a bag (MCAP) of tactile and info"
    )
    parser.add_argument("--force", action="store_true", help="overwrite existing files")
    add_skin_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Decode and write; returns the exit code."""
    path, output = arguments.file, arguments.output
    _check(path, output, arguments.bag, arguments.force)
    capture = RawCapture(path, given(arguments))
    frames = capture.timed_frames()
    first = next(frames, None)
    if first is None:
        raise CaptureError(f"{path}: {capture.pipeline.problem or 'no frame found'}")
    with naming(output, CaptureError):
        count = _write(capture, chain([first], frames), output, arguments.bag)
    for note in capture.notes:
        print(f"tactile-cdma: {path}: {note}", file=sys.stderr)
    lost, taxels = capture.pipeline.counters.lost_frames, len(capture.config.layout.nodes)
    print(f"frames={count} lost_frames={lost} taxels={taxels}")
    return 0


def _write(
    capture: RawCapture, frames: Iterator[tuple[TactileFrame, float]], output: Path, bag: bool
) -> int:
    config, source, values = capture.config, capture.source, capture.values
    if bag:
        with needed_for("--bag", "rosbags"):
            from ..recording.bag_export import write_bag

        frame_id = str(values.get("frame_id", BY_NAME["frame_id"].default))
        return write_bag(output, frames, config, source, frame_id)
    about = {
        "file": capture.path.name,
        "origin": source.origin.name.lower(),
        "measured_by": source.measured_by.name.lower(),
        "skin": config.skin,
        "digitizer_id": (source.digitizer_id or b"").hex().upper(),
        "parameters": values,
        "package_version": __version__,
    }
    if output.suffix == ".npz":
        return write_npz(output, frames, config.layout, about)
    return write_csv(output, frames, config.layout, about)


def _check(path: Path, output: Path, bag: bool, force: bool) -> None:
    """Raises CaptureError for a file that cannot be exported, or not to this output."""
    if is_text(path):
        raise CaptureError(f"{path}: text; of an oscilloscope's capture decode --json makes frames")
    if bag and not is_recording(path):
        raise CaptureError(f"{path}: bytes alone have no times, which a bag needs")
    if bag:
        return
    if output.suffix not in (".npz", ".csv"):
        raise CaptureError(f"{output}: name it *.npz or *.csv, or ask for a folder with --bag")
    beside = [] if output.suffix == ".npz" else [taxels_path(output), about_path(output)]
    for file in [output, *beside]:
        if file.exists() and not force:
            raise CaptureError(f"{file}: exists already; --force overwrites it")
