# SPDX-License-Identifier: Apache-2.0

"""rviz files made to measure: those in config/, with a skin's or a body's names and sizes."""

import math
from collections import defaultdict
from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ..base.arrays import Floats
from ..config.body_file import NODE_NAME, Body, Patch
from ..config.parameters import DEFAULTS
from ..config.skin_config import SkinConfig
from ..places.layout import MOST_SQUARES, Layout
from ..places.poses import Pose

SKIN_SIZES = 1.65
"""Distance of the camera from a skin, in its diagonals. Chosen: with rviz's 45° it fills the
picture, and leaves room for arrows and labels."""
SLOPES = 1.15 * math.tan(math.radians(45 / 2)), math.tan(math.radians(45 / 2))
"""Half the width and half the height that rviz's camera sees at a distance, in that distance: 45°
upwards, and the window of the views, without its panel, is 1.15 times as wide as high."""
BODY_MARGIN = 1.1
"""Distance of the camera from a body in the least at which all taxels are seen. Chosen: names and
arrows are seen, too."""
LEAST_DISTANCE_M = 0.02
"""Least distance of the camera, m; a single taxel has no size."""
BEAD_PITCHES, BALL_PITCHES = 0.2, 0.9
"""Diameter of a point in pitches. Chosen: a bead on each square, and balls that nearly touch where
a skin has no squares."""


def skin_view(template: Path, layout: Layout, frame_id: str, node: str) -> str:
    """Make an rviz file of one skin. template: of the skin /skin. node: fully qualified name."""
    file = yaml.safe_load(template.read_text())
    has_squares = np.count_nonzero(layout.nodes) <= MOST_SQUARES
    size_m = (BEAD_PITCHES if has_squares else BALL_PITCHES) * layout.pitch_m
    points = {"Size (m)": _rounded(size_m)} | ({} if has_squares else {"Color Transformer": "RGB8"})
    for display in file["Visualization Manager"]["Displays"]:
        display.update({key: value for key, value in points.items() if key in display})
        if topic := display.get("Topic"):
            topic["Value"] = topic["Value"].replace(f"/{NODE_NAME}/", f"{node}/", 1)
    places_m = layout.positions_m.astype(np.float64)
    low_m, high_m = places_m.min(axis=0), places_m.max(axis=0)
    distance_m = SKIN_SIZES * float(np.linalg.norm(high_m - low_m))
    _look_at(file, (low_m + high_m) / 2, distance_m, frame_id)
    return yaml.safe_dump(file, sort_keys=False)


def body_view(template: Path, body: Body) -> str:
    """Make an rviz file of a body. template: a file of some body, with the markers of a patch."""
    file = yaml.safe_load(template.read_text())
    displays = defaultdict[bool, list[Any]](list)  # by whether they show a patch's markers
    for display in file["Visualization Manager"]["Displays"]:
        displays[display.get("Topic", {}).get("Value", "").endswith("/markers")].append(display)
    for display in displays[False]:
        if topic := display.get("Topic"):
            topic["Value"] = f"{body.within}{topic['Value']}"
    shown = [_of_patch(displays[True][0], patch) for patch in body.patches]
    file["Visualization Manager"]["Displays"] = displays[False] + shown
    _see_all(file, np.concatenate([_places_m(patch) for patch in body.patches]), body.frame_id)
    return yaml.safe_dump(file, sort_keys=False)


def _of_patch(display: Mapping[str, Any], patch: Patch) -> dict[str, Any]:
    own = deepcopy(dict(display))
    own["Name"] = patch.name.replace("_", " ").capitalize()
    own["Topic"]["Value"] = f"{patch.node}/markers"
    return own


def _places_m(patch: Patch) -> Floats:
    """Place a patch's taxels in the body, (t, 3), m, where the parameters mount it."""
    values = {**DEFAULTS, **patch.values}
    pose = Pose.of_rpy(values["mount_xyz_m"], values["mount_rpy_rad"])
    return pose.apply(SkinConfig.of(values).layout.positions_m.astype(np.float64))


def _see_all(file: Mapping[str, Any], places_m: Floats, frame_id: str) -> None:
    """Look at places (t, 3), m, of the frame, from as near as the view's direction allows."""
    view = file["Visualization Manager"]["Views"]["Current"]
    (sp, sy), (cp, cy) = np.sin((view["Pitch"], view["Yaw"])), np.cos((view["Pitch"], view["Yaw"]))
    # Of the picture: to its right, up, and towards the camera.
    axes = np.array([[-sy, cy, 0.0], [-sp * cy, -sp * sy, cp], [cp * cy, cp * sy, sp]])
    seen_m = places_m @ axes.T
    middle_m = (seen_m.min(axis=0) + seen_m.max(axis=0)) / 2
    aside_m, nearer_m = np.hsplit(seen_m - middle_m, [2])
    least_m = float((np.abs(aside_m) / SLOPES + nearer_m).max())
    _look_at(file, middle_m @ axes, BODY_MARGIN * least_m, frame_id)


def _look_at(file: Mapping[str, Any], focus_m: Floats, distance_m: float, frame_id: str) -> None:
    """Look at a place (3,), m, of the frame from a distance."""
    manager = file["Visualization Manager"]
    manager["Global Options"]["Fixed Frame"] = frame_id
    view = manager["Views"]["Current"]
    view["Distance"] = _rounded(max(distance_m, LEAST_DISTANCE_M))
    view["Focal Point"] = {
        axis: _rounded(m) for axis, m in zip("XYZ", focus_m.tolist(), strict=True)
    }


def _rounded(length_m: float) -> float:
    """To 0.1 mm: rviz files are read by people, too."""
    return round(length_m, 4) + 0.0  # no −0
