# SPDX-License-Identifier: Apache-2.0

"""Tells viewers about a patch: the names of its topics, and its layout from ~/info."""

import numpy as np

from tactile_cdma.msg import TactileSkinInfo

from ...config.body_file import NODE_NAME as NODE_NAME  # viewers take it from here
from ...places.layout import Layout
from ..common.convert import places_of

ARRAY_TOPIC = "tactile"


def full_name(patch: str) -> str:
    """Complete the name of a driver: left_palm and /left_palm/skin are the same patch."""
    name = patch.strip("/")
    return f"/{name}" if name == NODE_NAME or "/" in patch else f"/{name}/{NODE_NAME}"


def layout_of(info: TactileSkinInfo) -> Layout:
    """Return the layout that a driver has published.

    Raises MessageError where its fields contradict each other.
    """
    return Layout.seen(
        info.header.frame_id,
        (info.height, info.width),
        np.array(info.node, dtype=np.int32),
        *(place.astype(np.float32) for place in places_of(info)),
    )
