# SPDX-License-Identifier: Apache-2.0

"""Converts frames, configuration and arrays to ROS messages, and messages to arrays."""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, Point32, Vector3
from numpy.typing import NDArray
from sensor_msgs.msg import Image, PointCloud2, PointField
from std_msgs.msg import Header

from tactile_cdma.msg import TactileArray, TactileSkinInfo

from ...config.skin_config import SkinConfig
from ...driver.digitizer import Source
from ...driver.pipeline import TactileFrame
from ...places.layout import Layout
from ...readings.baseline import Baseline
from ...recording.message_fields import array_fields, info_fields


def ros_array(values: NDArray[np.generic]) -> array[float] | array[int]:
    """An ndarray as array.array, which message fields take without a look at every element."""
    return array(values.dtype.char, values.tobytes())


def _bytes(values: NDArray[np.generic]) -> array[int]:
    """The bytes of an ndarray as array.array, which message fields take as it is."""
    result = array("B")
    result.frombytes(np.ascontiguousarray(values).view(np.uint8).data)
    return result


def by_taxel(layout: Layout, of_node: NDArray[np.float32]) -> array[float] | array[int]:
    """Values of the nodes, (n,), in the order of the taxels; 0 for a taxel without a node."""
    if layout.source is None:
        return ros_array(of_node)
    return ros_array(np.where(layout.source < 0, np.float32(0), of_node[layout.source]))


def tactile_array(
    frame: TactileFrame, layout: Layout, header: Header, info_id: int, with_voltage: bool
) -> TactileArray:
    """One frame as the message that a manipulation stack subscribes to."""
    fields = array_fields(frame, layout, info_id, ros_array, with_voltage)
    return TactileArray(header=header, **fields)


def skin_info(
    config: SkinConfig, source: Source, baseline: Baseline, header: Header, info_id: int
) -> TactileSkinInfo:
    """What frames are read with: their source, layout, nodes, calibration, tare and drift."""
    fields = info_fields(config, source, info_id, ros_array, Point32)
    message = TactileSkinInfo(header=header, **fields)
    if baseline.tared:
        message.tare = by_taxel(config.layout, baseline.tare_pa)
    if baseline.drift_v.any():
        message.drift = by_taxel(config.layout, baseline.drift_v)
    return message


def image(picture: NDArray[np.generic], encoding: str, header: Header) -> Image:
    """A picture, (h, w) or (h, w, channels), as a message."""
    message = Image(header=header, encoding=encoding, step=picture.nbytes // len(picture))
    message.height, message.width = picture.shape[:2]
    message.data = _bytes(picture)  # the constructor would copy it
    return message


def point_cloud(points: NDArray[np.void], header: Header) -> PointCloud2:
    """Records of little-endian numbers, (m,), as a message with a field for each of theirs."""
    message = PointCloud2(header=header, height=1, width=len(points), is_dense=True)
    assert points.dtype.fields is not None
    message.fields = [
        PointField(name=name, offset=offset, datatype=_POINT_TYPES[kind.str], count=1)
        for name, (kind, offset, *_) in points.dtype.fields.items()
    ]
    message.point_step, message.row_step = points.itemsize, points.nbytes
    message.data = _bytes(points)  # the constructor would copy it
    return message


_POINT_TYPES = {"<f4": PointField.FLOAT32, "<u4": PointField.UINT32}


def diagnostic(
    name: str, level: bytes, text: str, values: Mapping[str, object], hardware_id: str = ""
) -> DiagnosticStatus:
    """One entry of /diagnostics."""
    pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    return DiagnosticStatus(
        level=level, name=name, message=text, hardware_id=hardware_id, values=pairs
    )


def stamp(nanoseconds: int) -> Time:
    """A ROS time stamp."""
    return Time(sec=nanoseconds // 1_000_000_000, nanosec=nanoseconds % 1_000_000_000)


def nanoseconds(stamp: Time) -> int:
    """A ROS time stamp as one number."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def rows(points: Sequence[Point | Point32 | Vector3]) -> NDArray[np.float64]:
    """Points or vectors as an array, (m, 3)."""
    return np.array([(p.x, p.y, p.z) for p in points], dtype=np.float64).reshape(-1, 3)


def point(place: NDArray[np.floating]) -> Point:
    """A point from an array, (3,)."""
    x, y, z = place.tolist()
    return Point(x=x, y=y, z=z)


def vector(values: NDArray[np.floating]) -> Vector3:
    """A vector from an array, (3,)."""
    x, y, z = values.tolist()
    return Vector3(x=x, y=y, z=z)
