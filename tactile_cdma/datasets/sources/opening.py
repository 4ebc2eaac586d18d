# SPDX-License-Identifier: Apache-2.0

"""Opens a recording, raw bytes or a bag as a source, whichever a path names."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path

from ...base.errors import CaptureError, ParameterError, needed_for
from ...config.parameters import Value
from ...recording.recording_file import is_recording
from ..samples import MOST_SHOWN, SampleSource
from .recording_source import RecordingSource

READERS = "tactile_cdma.readers"
"""Entry points of readers in other packages, called as the end of a file's name: they get its path,
and return a SampleSource."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Wanted:
    """What to read of a source.

    asked: parameters of the skin that override a recording's. topics: of a bag's arrays, all if
    empty. derived: contacts and wrench, too. cameras: image topics; None: all. state, action:
    vectors, TOPIC or TOPIC:NAME,…. info: a bag to take a patch's info from, where there is none.
    """

    asked: dict[str, Value] = field(default_factory=dict)
    topics: Sequence[str] = ()
    derived: bool = False
    cameras: Sequence[str] | None = ()
    state: Sequence[str] = ()
    action: Sequence[str] = ()
    info: Path | None = None


def open_source(path: Path, wanted: Wanted) -> SampleSource:
    """Open what a path names as a source. Raises CaptureError."""
    if is_bag(path):
        with needed_for("a bag", "rosbags"):
            from .bag_source import BagSource  # slow to load, and needed here only

        if wanted.asked:
            names = ", ".join(sorted(wanted.asked)[:MOST_SHOWN])
            more = ", …" if len(wanted.asked) > MOST_SHOWN else ""
            raise ParameterError(
                f"{path}: --params and the skin's options ({names}{more}) are for recordings, "
                "which are decoded with them; what this holds was decoded before"
            )
        bag = BagSource(path, wanted)
        _log.debug("%s is a bag with %s", path, ", ".join(bag.streams) or "nothing wanted")
        return bag
    for point in entry_points(group=READERS, name=path.suffix[1:]) if path.suffix else ():
        read: SampleSource = point.load()(path)
        return read
    source = RecordingSource(path, wanted.asked, wanted.derived)
    of_bags: dict[str, object] = {"--topic": wanted.topics, "--image": wanted.cameras}
    of_bags |= {"--state": wanted.state, "--action": wanted.action, "--info": wanted.info}
    for option, value in of_bags.items():
        if value:
            raise CaptureError(f"{path}: {option} is for bags: recordings have no topics")
    return source


def has_times(path: Path) -> bool:
    """Tell whether a source's frames have a wall time: raw bytes have none. Raises CaptureError."""
    return is_bag(path) or is_recording(path)


def is_bag(path: Path) -> bool:
    """Tell whether a path is a bag: a folder, or named as one of its files.

    Raises CaptureError for one of its files that is compressed as a whole.
    """
    if path.suffix == ".zstd" and path.is_file():
        raise CaptureError(f"{path}: a compressed file of a bag: give its folder, or decompress it")
    return path.is_dir() or path.suffix in (".mcap", ".db3")
