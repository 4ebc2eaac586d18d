# SPDX-License-Identifier: Apache-2.0

"""Decoded frames as a bag of TactileArray and TactileSkinInfo, without ROS."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import rosbags.interfaces as bags
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError

from ..base.errors import CaptureError
from ..config.skin_config import SkinConfig
from ..driver.digitizer import Source
from ..driver.pipeline import TactileFrame
from ..messages.cdr import Heading, tactile_array
from ..messages.fields import info_fields
from ..messages.types import PACKAGE, message_types

TOPIC, INFO_TOPIC = "/skin/tactile", "/skin/info"
INFO_ID = 1
_MOST_S = 2**31
"""Seconds since 1970 that a stamp can hold: an int32."""
_FOREVER = bags.QosTime(9_223_372_036, 854_775_807)
_LATCHED = bags.Qos(
    history=bags.QosHistory.KEEP_LAST,
    depth=1,
    reliability=bags.QosReliability.RELIABLE,
    durability=bags.QosDurability.TRANSIENT_LOCAL,
    deadline=_FOREVER,
    lifespan=_FOREVER,
    liveliness=bags.QosLiveliness.AUTOMATIC,
    liveliness_lease_duration=_FOREVER,
    avoid_ros_namespace_conventions=False,
)
_SENSOR_DATA = _LATCHED._replace(
    depth=5, reliability=bags.QosReliability.BEST_EFFORT, durability=bags.QosDurability.VOLATILE
)


def write_bag(
    folder: Path,
    frames: Iterator[tuple[TactileFrame, float]],
    config: SkinConfig,
    source: Source,
    frame_id: str,
) -> int:
    """Write every frame, with its Unix time, s, as messages of a driver /skin; return their number.

    Raises CaptureError where the folder exists, or for a time that no stamp holds; OSError.
    """
    types, count = message_types(), 0
    no_values = np.zeros(0, dtype=np.float32)
    point = types.types["geometry_msgs/msg/Point32"]
    masked = sorted({*config.layout.masked, *config.masked})
    about = info_fields(config, source, INFO_ID, np.asarray, point, masked)
    about |= {"tare": no_values, "drift": no_values, "retired": np.zeros(0, dtype=np.uint16)}
    try:
        with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            info, array = (
                writer.add_connection(
                    topic, f"{PACKAGE}/msg/{kind}", typestore=types, offered_qos_profiles=[qos]
                )
                for topic, kind, qos in (
                    (INFO_TOPIC, "TactileSkinInfo", _LATCHED),
                    (TOPIC, "TactileArray", _SENSOR_DATA),
                )
            )
            for frame, wall_s in frames:
                if not 0 <= wall_s < _MOST_S:
                    raise CaptureError(f"{wall_s:g} s: the recording computer's clock was wrong")
                stamp_ns = round(wall_s * 1e9)
                heading = Heading(stamp_ns, frame_id)
                if not count:
                    stamp = types.types["builtin_interfaces/msg/Time"](*heading.time)
                    header = types.types["std_msgs/msg/Header"](stamp, frame_id)
                    message = types.types[info.msgtype](header=header, **about)
                    writer.write(info, stamp_ns, types.serialize_cdr(message, info.msgtype))
                data = tactile_array(frame, config.layout, heading, INFO_ID, with_voltage=True)
                writer.write(array, stamp_ns, data)
                count += 1
    except WriterError as error:
        raise CaptureError(str(error)) from None
    return count
