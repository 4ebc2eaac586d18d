# SPDX-License-Identifier: Apache-2.0

"""The types of our messages for programs that read or write bags without ROS."""

from __future__ import annotations

import os
from pathlib import Path

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from ..base.errors import CaptureError

PACKAGE = "tactile_cdma"


def message_types() -> Typestore:
    """The messages of ROS 2 and ours, by names like tactile_cdma/msg/TactileArray.

    Raises CaptureError where our definitions are not installed.
    """
    store = get_typestore(Stores.ROS2_JAZZY)
    ours = {}
    for path in sorted(_folder().glob("*.msg")):
        text = path.read_text(encoding="utf-8")
        ours.update(get_types_from_msg(text, f"{PACKAGE}/msg/{path.stem}"))
    store.register(ours)
    return store


def _folder() -> Path:
    """Where the .msg files are: in a checkout beside the package, else in ROS 2's share folders."""
    prefixes = filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep))
    shares = [Path(prefix) / "share" / PACKAGE / "msg" for prefix in prefixes]
    for folder in (Path(__file__).parents[2] / "msg", *shares):
        if (folder / "TactileArray.msg").is_file():
            return folder
    raise CaptureError(
        "the definitions of tactile_cdma's messages are not installed: build the ROS 2 package, "
        "or run this from its checkout"
    )
