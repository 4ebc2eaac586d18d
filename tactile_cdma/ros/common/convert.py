# SPDX-License-Identifier: Apache-2.0

"""Converts frames, configuration and arrays to ROS messages, and messages to arrays.

What is published often comes as bytes, see cdr.py.
"""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from functools import cache
from struct import Struct

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, Point32, Vector3
from numpy.typing import NDArray
from sensor_msgs.msg import PointField
from std_msgs.msg import Header

from tactile_cdma.msg import TactileSkinInfo

from ...config.skin_config import SkinConfig
from ...driver.digitizer import Source
from ...driver.pipeline import TactileFrame
from ...places.layout import Layout
from ...readings.baseline import Baseline
from ...recording.message_fields import array_fields, info_fields
from .cdr import CdrWriter


def ros_array(values: NDArray[np.generic]) -> array[float] | array[int]:
    """An ndarray as array.array, which message fields take without a look at every element."""
    return array(values.dtype.char, values.tobytes())


def by_taxel(layout: Layout, of_node: NDArray[np.float32]) -> array[float] | array[int]:
    """Values of the nodes, (n,), in the order of the taxels; 0 for a taxel without a node."""
    if layout.source is None:
        return ros_array(of_node)
    return ros_array(np.where(layout.source < 0, np.float32(0), of_node[layout.source]))


def tactile_array(
    frame: TactileFrame, layout: Layout, header: Header, info_id: int, with_voltage: bool
) -> bytes:
    """One frame as the message TactileArray, which a manipulation stack subscribes to."""
    fields = array_fields(frame, layout, info_id, np.asarray, with_voltage)
    writer = CdrWriter()
    writer.header(header)
    names = "sequence", "device_time_us", "info_id", "height", "width"
    writer.add(_ARRAY.pack(*(fields[name] for name in names)), 8)
    for name in ("pressure", "voltage", "status"):
        writer.array(fields[name])
    writer.add(_FLOAT.pack(fields["noise_rms"]), 4)
    return writer.message


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


def image(picture: NDArray[np.generic], encoding: str, header: Header) -> bytes:
    """A picture, (h, w) or (h, w, channels), as the message Image."""
    height, width = picture.shape[:2]
    writer = CdrWriter()
    writer.header(header)
    writer.add(_SIZE.pack(height, width), 4)
    writer.text(encoding)
    writer.add(b"\0")  # not big-endian
    writer.add(_STEP.pack(picture.nbytes // height), 4)
    writer.array(picture.reshape(-1).view(np.uint8))
    return writer.message


def point_cloud(
    kind: np.dtype[np.void], clouds: Sequence[NDArray[np.void]], header: Header
) -> bytes:
    """PointCloud2 of one cloud after the other, with a field for each of kind's.

    kind: of the records, of little-endian numbers. clouds: (m,) each.
    """
    count = sum(map(len, clouds))
    writer = CdrWriter()
    writer.header(header)
    writer.add(_SIZE.pack(1, count), 4)
    writer.add(_point_fields(kind), 4)
    writer.add(_STEPS.pack(False, kind.itemsize, count * kind.itemsize), 4)
    writer.count(count * kind.itemsize)
    for cloud in clouds:
        writer.add(cloud.view(np.uint8).data)
    writer.add(b"\1")  # dense: all coordinates are finite
    return writer.message


@cache
def _point_fields(kind: np.dtype[np.void]) -> bytes:
    """The sequence of PointFields of such records, from a multiple of 4 on."""
    assert kind.fields is not None
    writer = CdrWriter()
    writer.count(len(kind.fields))
    for name, (number, offset, *_) in kind.fields.items():
        writer.text(name)
        writer.add(_FIELD.pack(offset, _POINT_TYPES[number.str], 1), 4)
    return writer.fields


_POINT_TYPES = {"<f4": PointField.FLOAT32, "<u4": PointField.UINT32}
_ARRAY, _FLOAT = Struct("<QQIHH"), Struct("<f")
_SIZE = Struct("<II")
_STEP, _STEPS, _FIELD = Struct("<I"), Struct("<?3xII"), Struct("<IB3xI")


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
