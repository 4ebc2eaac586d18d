# SPDX-License-Identifier: Apache-2.0

"""rviz files made to measure: those in config/, with a skin's or a body's names and sizes."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ..base.arrays import Floats
from ..places.layout import Layout
from ..places.mesh import MOST_SQUARES
from ..places.poses import Pose
from .body_file import NODE_NAME, Body, Patch
from .parameters import DEFAULTS, Values, read_file
from .skin_config import SkinConfig

SKIN_SIZES, BODY_SIZES = 1.65, 1.1
"""Distance of the camera from a skin and a body, in the diagonals of these. Chosen: with rviz's 45°
they fill the picture, and leave room for arrows and labels."""
LEAST_SIZE_M = 0.01
"""Size from which on the camera comes no closer, m; a single taxel's is 0."""
BEAD_PITCHES, BALL_PITCHES = 0.2, 0.9
"""Diameter of a point in pitches. Chosen: a bead on each square, and balls that nearly touch where
a skin has no squares."""
FRAME_SHARE = 0.3
"""Marker Scale of tf frames in the distance of the camera from a body; letters are a tenth of it.
Chosen: names are legible."""


def skin_view(template: Path, layout: Layout, frame_id: str, node: str) -> str:
    """An rviz file of one skin. template: a file of the skin /skin. node: fully qualified name."""
    file = _loaded(template)
    for topic in _topics(file):
        topic["Value"] = topic["Value"].replace(f"/{NODE_NAME}/", f"{node}/", 1)
    _look_at(file, layout.positions_m.astype(np.float64), SKIN_SIZES, frame_id)
    if np.count_nonzero(layout.nodes) <= MOST_SQUARES:
        _set(file, "Size (m)", _rounded(BEAD_PITCHES * layout.pitch_m))
    else:
        _set(file, "Size (m)", _rounded(BALL_PITCHES * layout.pitch_m))
        _set(file, "Color Transformer", "RGB8")
    return yaml.safe_dump(file, sort_keys=False)


def body_view(template: Path, body: Body) -> str:
    """An rviz file of a body. template: a file of some body, with a MarkerArray for a patch."""
    file = _loaded(template)
    manager = file["Visualization Manager"]
    markers = [item for item in manager["Displays"] if item["Class"].endswith("/MarkerArray")]
    others = [item for item in manager["Displays"] if item not in markers]
    manager["Displays"] = others + [_of_patch(markers[0], patch) for patch in body.patches]
    places_m = [_places_m(patch) for patch in body.patches]
    _look_at(file, np.concatenate(places_m), BODY_SIZES, body.frame_id)
    _set(file, "Marker Scale", _rounded(FRAME_SHARE * manager["Views"]["Current"]["Distance"]))
    return yaml.safe_dump(file, sort_keys=False)


def patch_values(patch: Patch) -> Values:
    """The parameters that the driver of a patch has."""
    given = read_file(patch.params_file, patch.node) if patch.params_file else {}
    return {**DEFAULTS, **given, **patch.parameters}


def _loaded(path: Path) -> Any:
    return yaml.safe_load(path.read_text())


def _topics(file: Mapping[str, Any]) -> list[dict[str, Any]]:
    displays = file["Visualization Manager"]["Displays"]
    return [display["Topic"] for display in displays if "Topic" in display]


def _set(file: Mapping[str, Any], key: str, value: float | str) -> None:
    """Set a property in all displays that have it."""
    for display in file["Visualization Manager"]["Displays"]:
        if key in display:
            display[key] = value


def _of_patch(display: Mapping[str, Any], patch: Patch) -> dict[str, Any]:
    """The display of markers, for another patch."""
    own = deepcopy(dict(display))
    own["Name"] = patch.name.replace("_", " ").capitalize()
    own["Topic"]["Value"] = f"{patch.node}/markers"
    return own


def _places_m(patch: Patch) -> Floats:
    """(t, 3) places of a patch's taxels in the body's frame, m, where the parameters mount it."""
    values = patch_values(patch)
    pose = Pose.of_rpy(values["mount_xyz_m"], values["mount_rpy_rad"])
    return pose.apply(SkinConfig.of(values).layout.positions_m.astype(np.float64))


def _look_at(file: Mapping[str, Any], places_m: Floats, sizes: float, frame_id: str) -> None:
    """Look from a distance of so many sizes at places (t, 3), m, of the frame."""
    manager = file["Visualization Manager"]
    manager["Global Options"]["Fixed Frame"] = frame_id
    low_m, high_m = places_m.min(axis=0), places_m.max(axis=0)
    view = manager["Views"]["Current"]
    size_m = max(float(np.linalg.norm(high_m - low_m)), LEAST_SIZE_M)
    view["Distance"] = _rounded(sizes * size_m)
    middle_m = ((low_m + high_m) / 2).tolist()
    view["Focal Point"] = {axis: _rounded(m) for axis, m in zip("XYZ", middle_m, strict=True)}


def _rounded(length_m: float) -> float:
    """To 0.1 mm: rviz files are read by people, too."""
    return round(length_m, 4) + 0.0  # no −0
