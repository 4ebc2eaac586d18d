# SPDX-License-Identifier: Apache-2.0

"""Synthetic bags: skins whose pressure is a known function of time, cameras, joints, marks.

They share no code with the reader: messages are written by rosbags from their definitions.
"""

import io
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from tactile_cdma.messages.types import message_types

BEGIN_NS = 1_700_000_000_123_456_789
TAXELS = 16
PERIOD_S = 0.0128
ARRAY, INFO = "tactile_cdma/msg/TactileArray", "tactile_cdma/msg/TactileSkinInfo"


def pressure_pa(t_s: Any) -> NDArray[np.float64]:
    """(…, 16) at times t_s after BEGIN_NS: steep enough that 1 ms shows."""
    t = np.asarray(t_s, dtype=np.float64)[..., None]
    return 20e3 + 10e3 * np.sin(2 * np.pi * 0.9 * t + 0.3 * np.arange(TAXELS))


@dataclass
class BagMaker:
    """Collects messages with their time of recording, and writes them in that order."""

    messages: list[tuple[int, str, str, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.types = message_types()

    def make(self, kind: str, /, **fields: Any) -> Any:
        return self.types.types[kind](**fields)

    def header(self, t_s: float) -> Any:
        seconds, nanoseconds = divmod(BEGIN_NS + round(t_s * 1e9), 10**9)
        stamp = self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id="palm")

    def add(self, seen_s: float, topic: str, kind: str, /, **fields: Any) -> None:
        """A message, recorded seen_s after BEGIN_NS."""
        time_ns = BEGIN_NS + round(seen_s * 1e9)
        self.messages.append((time_ns, topic, kind, self.make(kind, **fields)))

    def of(self, topic: str) -> list[Any]:
        """The messages of a topic, in the order in which they were added."""
        return [message for _, its, _, message in self.messages if its == topic]

    def without(self, topic: str, *indices: int) -> Self:
        """Lose messages of a topic, by their index in of(); all where none is given."""
        lost = self._places(topic, indices)
        self.messages = [one for place, one in enumerate(self.messages) if place not in lost]
        return self

    def spoilt(self, topic: str, *indices: int) -> Self:
        """Damage messages likewise: they do not fit their definition."""
        for place in self._places(topic, indices):
            self.messages[place] = (*self.messages[place][:3], b"\x00\x01\x00\x00odd")
        return self

    def _places(self, topic: str, indices: tuple[int, ...]) -> set[int]:
        places = [place for place, one in enumerate(self.messages) if one[1] == topic]
        return {places[i] for i in indices or range(len(places))}

    def skin(
        self,
        node: str,
        seconds: float,
        invalid: Any = None,
        simulated: bool = True,
        uncertain: Any = None,
    ) -> Self:
        """Frames and info of a patch.

        invalid: (t_s) → indices of taxels without a reading. uncertain: (t_s) → what the stamp may
        be off by, s.
        """
        point = lambda x: self.make("geometry_msgs/msg/Point32", x=x, y=0.0, z=0.0)  # noqa: E731
        nothing = np.zeros(0, dtype=np.float32)
        self.add(
            0.0,
            f"{node}/info",
            INFO,
            header=self.header(0.0),
            info_id=1,
            origin=2 if simulated else 1,
            measured_by=2 if simulated else 1,
            digitizer_id="73696D0002000000",
            skin="palm-1",
            nodes=TAXELS,
            height=4,
            width=4,
            positions=[point(0.007 * i) for i in range(TAXELS)],
            normals=[point(1.0) for _ in range(TAXELS)],
            area=np.full(TAXELS, 2.5e-5, dtype=np.float32),
            node=np.arange(1, TAXELS + 1, dtype=np.uint16),
            code_row=np.arange(1, TAXELS + 1, dtype=np.uint32),
            masked=np.zeros(0, dtype=np.uint16),
            retired=np.zeros(0, dtype=np.uint16),
            code_order=20,
            bits=10,
            frame_period=PERIOD_S,
            pressure_min=0.0,
            pressure_max=140e3,
            calibration_id="abcd1234",
            tare=nothing,
            drift=nothing,
        )
        for i in range(round(seconds / PERIOD_S)):
            t_s = (i + 0.5) * PERIOD_S
            pressure = pressure_pa(t_s).astype(np.float32)
            status = np.zeros(TAXELS, dtype=np.uint8)
            for taxel in invalid(t_s) if invalid else ():
                pressure[taxel], status[taxel] = np.nan, 8
            self.add(
                t_s + 0.005 + 0.003 * (i % 3),  # messages wait, by varying times
                f"{node}/tactile",
                ARRAY,
                header=self.header(t_s),
                sequence=i,
                device_time_us=round(t_s * 1e6),
                info_id=1,
                stamp_uncertainty=uncertain(t_s) if uncertain else 0.001,
                height=4,
                width=4,
                pressure=pressure,
                voltage=nothing,
                sigma=nothing,
                status=status,
                noise_rms=0.001,
            )
        return self

    def camera(self, topic: str, seconds: float, rate_hz: float, compressed: bool = False) -> Self:
        """Images of 8 × 6 pixels, whose red is the number of the image (modulo 256)."""
        for i in range(round(seconds * rate_hz)):
            t_s = (i + 0.25) / rate_hz
            pixels = np.zeros((6, 8, 3), dtype=np.uint8)
            pixels[:, :, 0], pixels[:, :, 1] = i % 256, 200
            header = self.header(t_s)
            if compressed:
                file = io.BytesIO()
                Image.fromarray(pixels).save(file, "PNG")
                kind, data = "sensor_msgs/msg/CompressedImage", file.getvalue()
                fields: dict[str, Any] = {"format": "rgb8; png compressed rgb8"}
            else:
                kind, data = "sensor_msgs/msg/Image", pixels[:, :, ::-1].tobytes()
                fields = {"height": 6, "width": 8, "step": 24}
                fields |= {"encoding": "bgr8", "is_bigendian": 0}
            fields |= {"header": header, "data": np.frombuffer(data, dtype=np.uint8)}
            self.add(t_s + 0.04, topic, kind, **fields)
        return self

    def joints(
        self, topic: str, seconds: float, rate_hz: float = 100, **places: Callable[[float], float]
    ) -> Self:
        """Joints by name, each where it says by time (s); default: finger = t, wrist = −t."""
        places = places or {"finger": lambda t_s: t_s, "wrist": lambda t_s: -t_s}
        nothing = np.zeros(0)
        for i in range(round(seconds * rate_hz)):
            t_s = i / rate_hz
            self.add(
                t_s + 0.001,
                topic,
                "sensor_msgs/msg/JointState",
                header=self.header(t_s),
                name=list(places),
                position=np.array([place(t_s) for place in places.values()]),
                velocity=nothing,
                effort=nothing,
            )
        return self

    def contacts(self, node: str, seconds: float, end_s: float) -> Self:
        """Contacts and wrench until end_s: unknown before 1 s, from then on a force of −t N."""
        vector = lambda *xyz: self.make(  # noqa: E731
            "geometry_msgs/msg/Vector3", **dict(zip("xyz", xyz, strict=True))
        )
        for i in range(round(min(seconds, end_s) / PERIOD_S)):
            t_s = (i + 0.5) * PERIOD_S
            known = t_s >= 1.0
            value = -t_s if known else np.nan
            force, torque = vector(0.0, 0.0, value), vector(value, 0.0, 0.0)
            wrench = self.make("geometry_msgs/msg/Wrench", force=force, torque=torque)
            place = dict.fromkeys("xyz", 0.01 if known else np.nan)
            header, stamped = self.header(t_s), "geometry_msgs/msg/WrenchStamped"
            self.add(t_s + 0.004, f"{node}/wrench", stamped, header=header, wrench=wrench)
            self.add(
                t_s + 0.004,
                f"{node}/contacts",
                "tactile_cdma/msg/TactileContacts",
                header=header,
                sequence=i,
                info_id=1,
                stamp_uncertainty=0.001,
                absent=[],
                taxels_in_service=TAXELS,
                taxels_valid=TAXELS,
                touched=known,
                untouched=False,
                area=2.5e-5 if known else np.nan,
                position=self.make("geometry_msgs/msg/Point", **place),
                wrench=wrench,
                contacts=[],
            )
        return self

    def write(self, path: Path, sqlite: bool = False, compressed: str = "none") -> Path:
        plugin = StoragePlugin.SQLITE3 if sqlite else StoragePlugin.MCAP
        writer = Writer(path, version=9, storage_plugin=plugin)
        writer.set_compression(CompressionMode[compressed.upper()], CompressionFormat.ZSTD)
        with writer:
            connections: dict[str, Any] = {}
            for time_ns, topic, kind, message in sorted(self.messages, key=lambda m: m[0]):
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self.types)
                whole = not isinstance(message, bytes)  # else as it is, damaged perhaps
                data = self.types.serialize_cdr(message, kind) if whole else message
                writer.write(connections[topic], time_ns, data)
        return path
