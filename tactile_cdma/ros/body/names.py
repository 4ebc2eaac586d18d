# SPDX-License-Identifier: Apache-2.0

"""The names of a body's patches, as texts above them."""

from collections.abc import Mapping

import numpy as np
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import Point, Pose, Quaternion, Vector3
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from ...base.arrays import Floats
from ...config.body_file import NODE_NAME

LETTER_SHARE = 0.035
"""Height of letters in the diagonal of the box round all patches. Chosen: legible where the body
fills the picture."""
ABOVE_LETTERS = 2.2
"""Height of a text's middle above the top of its patch, in letters; chosen."""
LIFETIME = Duration(sec=1)
"""Names vanish that are not renewed for this long; chosen as for the skins below them."""
_RGBA = ColorRGBA(r=1.0, g=1.0, b=1.0, a=1.0)


def body_names(places_m: Mapping[str, Floats], frame_id: str) -> MarkerArray:
    """Return a marker per patch, in a namespace of the patch's name; up is the z of the frame.

    places_m: (t, 3) taxels of each patch in the frame, m, by the fully qualified name of its
    driver; t > 0. The stamp is 0, which to rviz is now: names do not wait for transforms.
    """
    corners_m = {node: (at.min(axis=0), at.max(axis=0)) for node, at in places_m.items()}
    lows_m, highs_m = zip(*corners_m.values(), strict=True)
    letter_m = LETTER_SHARE * float(np.linalg.norm(np.max(highs_m, 0) - np.min(lows_m, 0)))
    markers = []
    for node, (low_m, high_m) in corners_m.items():
        x, y, _ = ((low_m + high_m) / 2).tolist()
        name = node.strip("/").removesuffix(f"/{NODE_NAME}")
        markers.append(
            Marker(
                header=Header(frame_id=frame_id),
                ns=name,
                type=Marker.TEXT_VIEW_FACING,
                pose=Pose(
                    position=Point(x=x, y=y, z=float(high_m[2]) + ABOVE_LETTERS * letter_m),
                    orientation=Quaternion(w=1.0),
                ),
                scale=Vector3(z=letter_m),
                color=_RGBA,
                lifetime=LIFETIME,
                text=name,
            )
        )
    return MarkerArray(markers=markers)
