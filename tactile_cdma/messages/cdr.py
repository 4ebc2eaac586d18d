# SPDX-License-Identifier: Apache-2.0

"""Serialised messages, written and read without message objects.

rclpy makes and takes apart an object for every number in a message's messages: 40 µs for a contact,
20 µs for a square of markers. What is published often is therefore written as bytes, which
publishers take as well, and bags: plain CDR, little-endian (OMG DDS-XTypes 1.3, 7.4), the same as
rclpy's.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from struct import Struct
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.errors import MessageError
from ..driver.pipeline import TactileFrame
from ..places.layout import Layout

ENCAPSULATION = b"\0\1\0\0"
"""Begins a message: plain CDR, little-endian, no options. Places are counted from behind it."""
PADDING = [bytes(count) for count in range(8)]
"""Zeros to the next multiple of an alignment, by their number."""
MOST_PA, MOST_DEVICE_US = 1e12, 1 << 62
"""Pressures and device times beyond are lies, on which arithmetic would choke; chosen far above any
skin's."""
_COUNT, _STAMP = Struct("<I"), Struct("<iI")
_ARRAY, _FLOAT = Struct("<QQIfHHI"), Struct("<f")
_LAST_NS = 2**31 * 1_000_000_000 - 1  # of a message's time; others may send later ones


class Heading(NamedTuple):
    """The header of a message: its ROS time, ns, and tf frame."""

    stamp_ns: int
    frame_id: str

    @property
    def fields(self) -> bytes:
        """Return the header as fields of a message; they begin at a multiple of 4."""
        return self.stamp + string(self.frame_id)

    @property
    def stamp(self) -> bytes:
        """Return the time alone as fields of a message."""
        return _STAMP.pack(*self.time)

    @property
    def time(self) -> tuple[int, int]:
        """Return seconds and nanoseconds, at most the last time that a message can have."""
        return divmod(min(self.stamp_ns, _LAST_NS), 1_000_000_000)


@lru_cache
def string(text: str) -> bytes:
    """Return a string as a field, which begins at a multiple of 4."""
    data = text.encode(errors="replace")
    return b"%b%b\0" % (_COUNT.pack(len(data) + 1), data)


class CdrWriter:
    """Writes the fields of one message in their order."""

    def __init__(self) -> None:
        self._parts: list[bytes | memoryview] = [ENCAPSULATION]
        self._end = 0

    @property
    def message(self) -> bytes:
        return b"".join(self._parts)

    def add(self, data: bytes | memoryview, alignment: int = 1) -> None:
        """Write bytes at the next multiple of alignment."""
        if padding := -self._end % alignment:
            self._parts.append(PADDING[padding])
        self._parts.append(data)
        self._end += padding + len(data)

    def count(self, length: int) -> None:
        """Write the length of a sequence, whose elements follow."""
        self.add(_COUNT.pack(length), 4)

    def text(self, text: str) -> None:
        self.add(string(text), 4)

    def texts(self, texts: Sequence[str]) -> None:
        self.count(len(texts))
        for text in texts:
            self.text(text)

    def array(self, values: NDArray[np.generic]) -> None:
        """Write a sequence of numbers (m,), or of points and the like (m, …), little-endian."""
        self.count(len(values))
        if values.size:
            self.add(np.ascontiguousarray(values).view(np.uint8).reshape(-1).data, values.itemsize)

    def header(self, heading: Heading) -> None:
        self.add(heading.fields, 4)


def tactile_array(
    frame: TactileFrame, layout: Layout, heading: Heading, info_id: int, with_voltage: bool
) -> bytes:
    """Return a frame as the message TactileArray, which a manipulation stack subscribes to."""
    readings, header = frame.readings, heading.fields
    device_time_us = max(0, round(frame.t_middle * 1e6))
    size, count = (layout.rows, layout.columns), len(readings.status)
    sigma = b"" if readings.sigma_pa is None else readings.sigma_pa.tobytes()
    about = frame.sequence, device_time_us, info_id, frame.stamp_uncertainty_s
    # In one piece: it is what a subscriber waits for, and a CdrWriter takes 20 µs after a pause.
    return b"".join(
        (
            ENCAPSULATION,
            header,
            PADDING[-len(header) % 8],
            _ARRAY.pack(*about, *size, count),
            readings.pressure_pa.tobytes(),
            _COUNT.pack(count if with_voltage else 0),
            readings.voltage_v.tobytes() if with_voltage else b"",
            _COUNT.pack(len(sigma) // 4),
            sigma,
            _COUNT.pack(count),
            readings.status.tobytes(),
            PADDING[-count % 4],
            _FLOAT.pack(frame.words.noise_rms_v),
        )
    )


class CdrReader:
    """Reads the fields of one message in their order; raises MessageError where it cannot."""

    def __init__(self, message: bytes) -> None:
        if message[:2] != ENCAPSULATION[:2]:
            raise MessageError(
                f"the message begins with {message[:4].hex(' ') or 'nothing'}, which is not plain "
                "little-endian CDR: does its sender use another middleware?"
            )
        self._data, self._size, self._end = message[4:], len(message) - 4, 0

    def take(self, size: int, alignment: int = 1) -> bytes:
        """Take bytes at the next multiple of alignment."""
        begin = self._end + -self._end % alignment
        self._end = end = begin + size
        if end > self._size:
            raise MessageError(
                f"the message ends after {self._size} bytes, amid a field: does its sender "
                "have another version of this package?"
            )
        return self._data[begin:end]

    def numbers(self, kinds: Struct, alignment: int) -> tuple[Any, ...]:
        """Take numbers at the next multiple of alignment."""
        return kinds.unpack(self.take(kinds.size, alignment))

    def count(self) -> int:
        """Take the length of a sequence, whose elements follow."""
        return int.from_bytes(self.take(4, 4), "little")

    def text(self) -> str:
        return self.take(self.count())[:-1].decode(errors="replace")

    def header(self) -> Heading:
        seconds, nanoseconds = _STAMP.unpack(self.take(_STAMP.size, 4))
        return Heading(seconds * 1_000_000_000 + nanoseconds, self.text())


class TaxelArray(NamedTuple):
    """Holds what a TactileArray says of its t taxels.

    pressure_pa: (t,) float32, Pa, NaN without a reading. status: (t,) uint8. sigma_pa: (t,)
    float32, 1 σ, Pa, or (0,).
    """

    heading: Heading
    sequence: int
    info_id: int
    stamp_uncertainty_s: float
    pressure_pa: NDArray[np.float32]
    status: NDArray[np.uint8]
    sigma_pa: NDArray[np.float32]


def read_array(message: bytes) -> TaxelArray:
    """Take a TactileArray apart; raises MessageError if it is none, or contradicts itself."""
    reader = CdrReader(message)
    heading = reader.header()
    sequence, device_us, info_id, uncertainty_s, *size, count = reader.numbers(_ARRAY, 8)
    pressure_pa = np.frombuffer(reader.take(4 * count), dtype="<f4")
    reader.take(4 * reader.count())
    sigma_pa = np.frombuffer(reader.take(4 * reader.count()), dtype="<f4")
    status = np.frombuffer(reader.take(reader.count()), dtype=np.uint8)
    check_array(sequence, device_us, size, pressure_pa, status, sigma_pa)
    return TaxelArray(heading, sequence, info_id, uncertainty_s, pressure_pa, status, sigma_pa)


def check_array(
    sequence: int,
    device_time_us: int,
    size: Sequence[int],
    pressure_pa: NDArray[np.float32],
    status: NDArray[np.uint8],
    sigma_pa: NDArray[np.float32],
) -> None:
    """Raises MessageError where fields of a TactileArray contradict each other.

    size: height and width, taxels.
    """
    if len(sigma_pa) not in (0, len(pressure_pa)) or (sigma_pa < 0).any():
        raise MessageError(
            f"frame {sequence} has {len(sigma_pa)} sigmas for {len(pressure_pa)} pressures, or "
            "negative ones"
        )
    if not 0 < len(pressure_pa) == len(status) == math.prod(size):
        raise MessageError(
            f"frame {sequence} has {len(pressure_pa)} pressures and {len(status)} states for "
            f"{' × '.join(map(str, size))} taxels"
        )
    if (np.abs(pressure_pa) > MOST_PA).any() or device_time_us > MOST_DEVICE_US:
        raise MessageError(f"frame {sequence} has pressures or a time that no skin can have")
