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
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, Point32, Vector3
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import PointField
from std_msgs.msg import Header

from tactile_cdma.msg import TactileArray, TactileSkinInfo

from ...base.arrays import Floats, Floats32
from ...base.errors import MessageError
from ...config.parameters import Values
from ...config.skin_config import SkinConfig
from ...driver.digitizer import Source
from ...messages.cdr import ENCAPSULATION, CdrWriter, Heading, check_array
from ...messages.fields import info_fields
from ...places.layout import Layout
from ...readings.taxels import Taxels


def ros_array(values: NDArray[np.generic]) -> array[float] | array[int]:
    """Make an array.array, which message fields take without a look at every element."""
    return array(values.dtype.char, values.tobytes())


def header(heading: Heading) -> Header:
    """Return a heading as rclpy's message."""
    seconds, nanoseconds = heading.time
    return Header(stamp=Time(sec=seconds, nanosec=nanoseconds), frame_id=heading.frame_id)


def wrench_stamped(heading: Heading, force_n: Floats, torque_nm: Floats) -> bytes:
    """Return the message WrenchStamped; force_n, torque_nm: (3,), N and N m."""
    writer = CdrWriter()
    writer.header(heading)
    writer.add(_WRENCH.pack(*force_n.tolist(), *torque_nm.tolist()), 8)
    return writer.message


UNKNOWN_WRENCH = "publish_unknown_wrench"
"""The parameter without which wrenches that are unknown, NaN, are not published."""


def publish_wrench(
    publisher: Publisher, values: Values, heading: Heading, force_n: Floats, torque_nm: Floats
) -> None:
    """Publish a WrenchStamped; where one is unknown, only if the parameters' values say so."""
    if values[UNKNOWN_WRENCH] or np.isfinite([force_n, torque_nm]).all():
        publisher.publish(wrench_stamped(heading, force_n, torque_nm))


def skin_info(
    config: SkinConfig, source: Source, taxels: Taxels, heading: Heading, info_id: int
) -> TactileSkinInfo:
    """Describe what frames are read with: source, layout, nodes, calibration, tare and drift."""
    fields = info_fields(config, source, info_id, ros_array, Point32, taxels.masked)
    message = TactileSkinInfo(header=header(heading), retired=taxels.retired, **fields)
    baseline = taxels.baseline
    if baseline.tared:
        message.tare = ros_array(config.layout.of_nodes(baseline.tare_pa))
    if baseline.drift_v.any():
        message.drift = ros_array(config.layout.of_nodes(baseline.drift_v))
    return message


def image(picture: NDArray[np.generic], encoding: str, heading: Heading) -> bytes:
    """Return a picture, (h, w) or (h, w, channels), as the message Image."""
    height, width = picture.shape[:2]
    writer = CdrWriter()
    writer.header(heading)
    writer.add(_SIZE.pack(height, width), 4)
    writer.text(encoding)
    writer.add(b"\0")  # not big-endian
    writer.add(_STEP.pack(picture.nbytes // height), 4)
    writer.array(picture.reshape(-1).view(np.uint8))
    return writer.message


def point_cloud(
    kind: np.dtype[np.void], clouds: Sequence[NDArray[np.void]], heading: Heading
) -> bytes:
    """Make a PointCloud2 of one cloud after the other, with a field for each of kind's.

    kind: of the records, of little-endian numbers. clouds: (m,) each.
    """
    count = sum(map(len, clouds))
    writer = CdrWriter()
    writer.header(heading)
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
    """Return the sequence of PointFields of such records, from a multiple of 4 on."""
    assert kind.fields is not None
    writer = CdrWriter()
    writer.count(len(kind.fields))
    for name, (number, offset, *_) in kind.fields.items():
        writer.text(name)
        writer.add(_FIELD.pack(offset, _POINT_TYPES[number.str], 1), 4)
    return writer.message[len(ENCAPSULATION) :]


_POINT_TYPES = {"<f4": PointField.FLOAT32, "<u4": PointField.UINT32}
_WRENCH = Struct("<6d")
_SIZE = Struct("<II")
_STEP, _STEPS, _FIELD = Struct("<I"), Struct("<?3xII"), Struct("<IB3xI")


def diagnostic(
    name: str, level: bytes, text: str, values: Mapping[str, object], hardware_id: str = ""
) -> DiagnosticStatus:
    """Make one entry of /diagnostics."""
    pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    return DiagnosticStatus(
        level=level, name=name, message=text, hardware_id=hardware_id, values=pairs
    )


def report(node: Node, entries: list[DiagnosticStatus]) -> DiagnosticArray:
    """Return the message for /diagnostics."""
    return DiagnosticArray(header=Header(stamp=node.get_clock().now().to_msg()), status=entries)


def nanoseconds(stamp: Time) -> int:
    """Return a ROS time stamp as one number."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


MOST_M = 1e4
"""Coordinates, m, and areas, m², beyond are lies; chosen far above any skin's."""


def readings_of(message: TactileArray) -> tuple[Floats32, NDArray[np.uint8]]:
    """Read a frame's pressures, Pa, NaN without a reading, and status, (t,) each.

    What read_array does for bytes, for a message object, in 18 µs instead of 7. Raises MessageError
    where its fields contradict each other.
    """
    pressure_pa = np.array(message.pressure, dtype=np.float32)
    status = np.array(message.status, dtype=np.uint8)
    size = message.height, message.width
    sigma_pa = np.array(message.sigma, dtype=np.float32)
    check_array(message.sequence, message.device_time_us, size, pressure_pa, status, sigma_pa)
    return pressure_pa, status


def places_of(info: TactileSkinInfo) -> tuple[Floats, Floats, Floats32]:
    """Read positions, m, and normals of a skin's taxels, (t, 3), and areas, m², (t,).

    Raises MessageError where its fields contradict each other.
    """
    places = rows(info.positions), rows(info.normals), np.array(info.area, dtype=np.float32)
    counts = [*(len(place) for place in places), len(info.node)]
    if counts != [info.height * info.width] * 4 or not counts[0]:
        raise MessageError(
            f"the info of {info.height} × {info.width} taxels has {counts} positions, normals, "
            "areas and nodes"
        )
    if not (np.abs(np.column_stack(places)) < MOST_M).all() or not (places[2] > 0).all():
        raise MessageError("the info has positions, normals or areas that no skin has")
    return places


def layout_of(info: TactileSkinInfo) -> Layout:
    """Return the layout that a driver has published; raises MessageError as places_of."""
    return Layout.seen(
        info.header.frame_id,
        (info.height, info.width),
        np.array(info.node, dtype=np.int32),
        *(place.astype(np.float32) for place in places_of(info)),
    )


def rows(points: Sequence[Point | Point32 | Vector3]) -> NDArray[np.float64]:
    """Return points or vectors as an array, (m, 3)."""
    return np.array([(p.x, p.y, p.z) for p in points], dtype=np.float64).reshape(-1, 3)
