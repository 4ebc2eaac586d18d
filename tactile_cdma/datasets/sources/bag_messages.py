# SPDX-License-Identifier: Apache-2.0

"""Messages of a bag as samples' values. Fields are read as rosbags gives them."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from ...base.arrays import Floats32
from ...base.errors import CaptureError
from ...driver.digitizer import Origin
from ..samples import NANO, PatchInfo, SkinFrame, feature_name, in_order

ARRAY, INFO = "tactile_cdma/msg/TactileArray", "tactile_cdma/msg/TactileSkinInfo"
CONTACTS_TYPE, WRENCH_TYPE = "tactile_cdma/msg/TactileContacts", "geometry_msgs/msg/WrenchStamped"
IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
JOINTS = "sensor_msgs/msg/JointState"
VECTORS = (JOINTS, "std_msgs/msg/Float32MultiArray", "std_msgs/msg/Float64MultiArray")
"""Types that --state and --action take."""
_THEN, _TARED, _CHANGES = ", then ", "tared", "changes"
PERIODS_S = (50e-6, 60.0)
"""Frame periods that are believed, s; chosen: 8 bits of 12 chips take 48 µs at 0.5 µs per chip."""


def stamp_ns(message: Any) -> int:
    """Tell when a message's content was measured; 0 if it does not say."""
    stamp = message.header.stamp if hasattr(message, "header") else None
    return stamp.sec * NANO + stamp.nanosec if stamp else 0


def patch_name(topic: str) -> str:
    """Make left_palm of /left_palm/skin/tactile, skin of /skin/tactile."""
    parts = topic.strip("/").split("/")[:-1] or ["skin"]
    return feature_name("_".join(parts[:-1] if parts[-1] == "skin" and parts[1:] else parts))


def skin_frame(message: Any, time_ns: int, patch: PatchInfo) -> SkinFrame:
    """Read a patch's TactileArray; time_ns: its stamp. Raises CaptureError for another skin's."""
    pressure, voltage, taxels = message.pressure, message.voltage, len(patch)
    for name, values in (("pressure", pressure), ("status", message.status), ("voltage", voltage)):
        if len(values) != taxels and (len(values) or name != "voltage"):
            raise CaptureError(
                f"{patch.topic}: {len(values)} values of {name} in frame {message.sequence} of a "
                f"patch of {taxels} taxels: did the layout change? Export what is before it (--end)"
            )
    return SkinFrame(
        sequence=int(message.sequence),
        device_time_s=message.device_time_us * 1e-6,
        wall_time_s=time_ns / NANO,
        stamp_uncertainty_s=float(getattr(message, "stamp_uncertainty", np.nan)),
        noise_v=float(message.noise_rms),
        pressure_pa=pressure,
        voltage_v=voltage if len(voltage) else np.full(taxels, np.nan, dtype=np.float32),
        status=message.status,
    )


def patch(topic: str, file: str, array: Any, info: Any | None) -> PatchInfo:
    """Describe a patch by its first frame and, if the bag holds it, its info."""
    taxels = len(array.pressure)
    if not taxels:
        raise CaptureError(f"{topic}: its first frame has no taxels")
    if array.height * array.width != taxels:
        size = f"{array.height} × {array.width}"
        raise CaptureError(
            f"{topic}: {taxels} values of pressure in a first frame of {size} taxels"
        )
    about: dict[str, Any] = {"file": file, "topic": topic}
    places = normals = np.full((taxels, 3), np.nan, dtype=np.float32)
    nodes, areas, period_s = np.zeros(taxels, np.uint16), places[:, 0].copy(), float("nan")
    if info is not None:
        for name in ("node", "positions", "normals", "area"):
            if (told := len(getattr(info, name))) != taxels:
                raise CaptureError(f"{topic}: {taxels} taxels, but its info has {told} of {name}")
        places, normals = (_points(points) for points in (info.positions, info.normals))
        nodes = np.asarray(info.node, np.uint16)
        areas = np.asarray(info.area, np.float32)
        if PERIODS_S[0] <= info.frame_period <= PERIODS_S[1]:
            period_s = float(info.frame_period)
        about |= _facts(info) | {"frame_id": info.header.frame_id, _TARED: bool(len(info.tare))}
    return PatchInfo(
        name=patch_name(topic),
        topic=topic,
        rows=int(array.height),
        columns=int(array.width),
        nodes=nodes,
        positions_m=places,
        normals=normals,
        areas_m2=areas,
        frame_period_s=period_s,
        about=about,
    )


def with_later(first: PatchInfo, info: Any, later: Any) -> tuple[PatchInfo, list[str]]:
    """Return a patch of which a bag holds another info: about names both, and so do notes.

    Its taxels stay those of the first info.
    """
    about, notes = dict(first.about), []
    for name, said in _facts(later).items():
        if said not in str(about[name]).split(_THEN):
            about[name] = f"{about[name]}{_THEN}{said}"
            notes.append(f"{first.topic}: {name} changes within the bag: {about[name]}")
    if about[_TARED] != _CHANGES and not np.array_equal(info.tare, later.tare, equal_nan=True):
        about[_TARED] = _CHANGES
        notes.append(
            f"{first.topic}: the tare changes within the bag: pressures before and after that have "
            "different zeros"
        )
    places = np.array_equal(_points(info.positions), _points(later.positions), equal_nan=True)
    if not places or not np.array_equal(info.node, later.node):
        notes.append(f"{first.topic}: its taxels change within the bag; the first ones are written")
    return replace(first, about=about), notes


def contacts(message: Any) -> Floats32:
    """Read a TactileContacts, (7,) by CONTACT_NAMES; NaN: unknown."""
    centre = message.position
    counts = message.touched, message.untouched, len(message.contacts)
    values = [*map(float, counts), message.area, centre.x, centre.y, centre.z]
    return np.array(values, dtype=np.float32)


def wrench(message: Any) -> Floats32:
    """Read a WrenchStamped, (6,) N and N m; NaN: unknown."""
    force, torque = message.wrench.force, message.wrench.torque
    values = [force.x, force.y, force.z, torque.x, torque.y, torque.z]
    return np.array(values, dtype=np.float32)


def publishers(
    topic: str, said: Iterable[tuple[str, ...]], chosen: tuple[str, ...]
) -> list[tuple[str, ...]]:
    """Group the names of a vector's elements by the programs that publish them on one topic.

    said: names in each message. chosen: those that are wanted; none: all. Raises CaptureError for
    a name that nobody publishes, or several programs do.
    """
    found: dict[frozenset[str], tuple[str, ...]] = {}  # in the order of the first message
    for names in filter(None, said):
        found.setdefault(frozenset(names), names)
    owners = Counter(name for names in found.values() for name in names)
    wanted = chosen or tuple(owners)
    for name in wanted:
        if name not in owners:
            raise CaptureError(f"{topic}: no {name} (there are {', '.join(owners) or 'none'})")
        if owners[name] > 1:
            some, others = [", ".join(names) for names in found.values() if name in names][:2]
            raise CaptureError(
                f"{topic}: some messages have {some}, others {others}: if two programs publish "
                f"{name}, choose other elements, {topic}:NAME,…, or record two topics"
            )
    each = [tuple(name for name in wanted if name in names) for names in found.values()]
    return [names for names in each if names]


def vector(message: Any, names: tuple[str, ...]) -> Floats32 | None:
    """Return the positions of a JointState, or the data of an array, in the order of the names.

    None for a message without them: another program's.
    """
    return in_order(_values(message), vector_names(message), names)


def vector_names(message: Any) -> tuple[str, ...]:
    """Return the names of a vector's elements."""
    names = tuple(getattr(message, "name", ()))
    size = len(_values(message))
    return names if len(names) == size else tuple(f"value_{i}" for i in range(size))


def _values(message: Any) -> Floats32:
    values = message.position if hasattr(message, "position") else message.data
    return np.asarray(values, dtype=np.float32)


def _points(points: Any) -> Floats32:
    return np.array([(p.x, p.y, p.z) for p in points], dtype=np.float32).reshape(-1, 3)


def _facts(info: Any) -> dict[str, str]:
    """Return what a TactileSkinInfo says of where readings come from."""
    return {
        "origin": _origin(info.origin),
        "measured_by": _origin(info.measured_by),
        "skin": info.skin,
        "digitizer_id": info.digitizer_id,
        "calibration_id": info.calibration_id,
    }


def _origin(value: int) -> str:
    return Origin(value).name.lower() if value in list(Origin) else f"unknown ({value})"
