# SPDX-License-Identifier: Apache-2.0

"""Decoded frames as a bag of TactileArray and TactileSkinInfo, without ROS."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
from rosbags.typesys.store import Typestore

from ..base.errors import CaptureError
from ..config.skin_config import SkinConfig
from ..driver.pipeline import TactileFrame
from .message_types import PACKAGE, message_types

TOPIC, INFO_TOPIC = "/skin/tactile", "/skin/info"
INFO_ID = 1
_MOST_S = 2**31
"""Seconds since 1970 that a stamp can hold: an int32."""
_FOREVER = QosTime(9_223_372_036, 854_775_807)
_LATCHED = Qos(
    QosHistory.KEEP_LAST,
    1,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    _FOREVER,
    _FOREVER,
    QosLiveliness.AUTOMATIC,
    _FOREVER,
    False,
)
_SENSOR_DATA = _LATCHED._replace(
    depth=5, reliability=QosReliability.BEST_EFFORT, durability=QosDurability.VOLATILE
)


def write_bag(
    folder: Path, frames: Iterator[tuple[TactileFrame, float]], config: SkinConfig, frame_id: str
) -> int:
    """Every frame, and its Unix time in s, as messages of a driver called /skin; returns how many.

    Raises CaptureError where the folder exists already, and for times that no stamp holds; OSError
    where it cannot be written.
    """
    types, count = message_types(), 0
    try:
        with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            kinds = [f"{PACKAGE}/msg/{name}" for name in ("TactileSkinInfo", "TactileArray")]
            info, array = (
                writer.add_connection(topic, kind, typestore=types, offered_qos_profiles=[qos])
                for topic, kind, qos in zip(
                    (INFO_TOPIC, TOPIC), kinds, (_LATCHED, _SENSOR_DATA), strict=True
                )
            )
            for frame, wall_s in frames:
                if not 0 <= wall_s < _MOST_S:
                    raise CaptureError(f"{wall_s:g} s: the recording computer's clock was wrong")
                stamp_ns = round(wall_s * 1e9)
                header = _header(types, stamp_ns, frame_id)
                if not count:
                    message = _skin_info(types, config, header)
                    writer.write(info, stamp_ns, types.serialize_cdr(message, info.msgtype))
                message = _tactile_array(types, config, header, frame)
                writer.write(array, stamp_ns, types.serialize_cdr(message, array.msgtype))
                count += 1
    except WriterError as error:
        raise CaptureError(str(error)) from None
    return count


def _header(types: Typestore, stamp_ns: int, frame_id: str) -> Any:
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    stamp = types.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    return types.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame_id)


def _tactile_array(types: Typestore, config: SkinConfig, header: Any, frame: TactileFrame) -> Any:
    readings = frame.readings
    return types.types[f"{PACKAGE}/msg/TactileArray"](
        header=header,
        sequence=frame.sequence,
        device_time_us=max(0, round(frame.t_middle * 1e6)),
        info_id=INFO_ID,
        height=config.layout.rows,
        width=config.layout.columns,
        pressure=readings.pressure_pa,
        voltage=readings.voltage_v,
        status=readings.status,
        noise_rms=frame.words.noise_rms_v,
    )


def _skin_info(types: Typestore, config: SkinConfig, header: Any) -> Any:
    """As from a driver without tare or drift."""
    spec, layout = config.spec, config.layout
    code_rows = np.append(spec.rows, 0)  # 0 for a taxel without a node
    none = np.zeros(0, dtype=np.float32)
    return types.types[f"{PACKAGE}/msg/TactileSkinInfo"](
        header=header,
        info_id=INFO_ID,
        nodes=spec.nodes,
        height=layout.rows,
        width=layout.columns,
        positions=_points(types, layout.positions_m),
        normals=_points(types, layout.normals),
        area=layout.areas_m2.astype(np.float32),
        node=layout.nodes.astype(np.uint16),
        code_row=code_rows[layout.nodes - 1].astype(np.uint32),
        code_order=spec.order,
        bits=spec.bits,
        frame_period=spec.frame_period_s,
        pressure_min=0.0,
        pressure_max=float(config.calibration.curves.range_pa.max()),
        calibration_id=config.calibration.identity,
        tare=none,
        drift=none,
    )


def _points(types: Typestore, places: NDArray[np.floating]) -> list[Any]:
    point = types.types["geometry_msgs/msg/Point32"]
    return [point(x=x, y=y, z=z) for x, y, z in places.tolist()]
