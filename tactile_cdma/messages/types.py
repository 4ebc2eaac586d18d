# SPDX-License-Identifier: Apache-2.0

"""The types of our messages for programs that read or write bags without ROS."""

from functools import cache

from rosbags.interfaces.typing import Typesdict
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from ..base.errors import CaptureError
from ..base.named_file import shipped

PACKAGE = "tactile_cdma"


@cache
def message_types() -> Typestore:
    """Return ROS 2's and our messages by names like tactile_cdma/msg/TactileArray; read only.

    Raises CaptureError where our definitions are not installed.
    """
    example = shipped("msg/TactileArray.msg")
    if example is None:
        raise CaptureError(
            "the definitions of tactile_cdma's messages are not installed: build the ROS 2 "
            "package, or run this from its checkout"
        )
    ours: Typesdict = {}
    for path in sorted(example.parent.glob("*.msg")):
        ours |= get_types_from_msg(path.read_text("utf-8"), f"{PACKAGE}/msg/{path.stem}")
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(ours)
    return store
