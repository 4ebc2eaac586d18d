# SPDX-License-Identifier: Apache-2.0

"""The fields of TactileSkinInfo, for the two libraries that make it: rclpy and rosbags."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..config.skin_config import SkinConfig
from ..driver.digitizer import Source

AsField = Callable[[NDArray[np.generic]], Any]
"""Converts an array to what the library's messages hold."""


def info_fields(
    config: SkinConfig,
    source: Source,
    info_id: int,
    as_field: AsField,
    point: Callable[..., Any],
    masked: Sequence[int],
) -> dict[str, Any]:
    """Return TactileSkinInfo's fields, but for header, tare, drift and retired.

    point: makes a Point32. masked: numbers of the nodes that are.
    """
    spec, layout = config.spec, config.layout
    code_rows = np.append(spec.rows, 0)  # 0 for a taxel without a node
    return {
        "info_id": info_id,
        "origin": int(source.origin),
        "measured_by": int(source.measured_by),
        "digitizer_id": (source.digitizer_id or b"").hex().upper(),
        "skin": config.skin,
        "nodes": spec.nodes,
        "height": layout.rows,
        "width": layout.columns,
        "positions": [point(x=x, y=y, z=z) for x, y, z in layout.positions_m.tolist()],
        "normals": [point(x=x, y=y, z=z) for x, y, z in layout.normals.tolist()],
        "area": as_field(layout.areas_m2.astype(np.float32)),
        "node": as_field(layout.nodes.astype(np.uint16)),
        "code_row": as_field(code_rows[layout.nodes - 1].astype(np.uint32)),
        "code_order": spec.order,
        "bits": spec.bits,
        "frame_period": spec.frame_period_s,
        "masked": as_field(np.array(masked, np.uint16)),
        "pressure_min": 0.0,
        "pressure_max": float(config.calibration.curves.range_pa.max()),
        "calibration_id": config.calibration.identity,
    }
