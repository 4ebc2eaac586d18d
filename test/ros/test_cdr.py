# SPDX-License-Identifier: Apache-2.0

"""Messages written as bytes are rclpy's own: of every size, length of strings, and alignment.

rclpy leaves the bytes between fields as they happen to be in memory, so messages are compared field
by field, and by their lengths.
"""

import random
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Vector3, Wrench, WrenchStamped
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Image, PointCloud2, PointField
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from tactile_cdma.base.errors import MessageError
from tactile_cdma.driver.pipeline import TactileFrame
from tactile_cdma.messages.cdr import Heading, tactile_array
from tactile_cdma.msg import TactileArray, TactileContact, TactileContacts
from tactile_cdma.places.layout import Layout
from tactile_cdma.readings.contact import ContactThresholds, ContactTracker
from tactile_cdma.readings.taxels import Readings
from tactile_cdma.ros.common import convert
from tactile_cdma.ros.common.convert import image, nanoseconds, point_cloud, wrench_stamped
from tactile_cdma.ros.common.touches import Touches
from tactile_cdma.ros.driver.frames import contacts_message
from tactile_cdma.ros.driver.markers import RESULTANT, SUM, SkinMarkers
from tactile_cdma.views.cloud import BODY_POINT, POINT
from tactile_cdma.words.words import silent

NAMES = ("", "a", "ab", "abc", "abcd", "/left_palm/skin", "Häutchen", "皮")
STAMP = Time(sec=2**31 - 1, nanosec=999_999_999)
FLOATS = (0.0, -0.0, 1 / 3, float("nan"), float("inf"), -1e300, 5e-324)


def assert_same(written: bytes, message: Any) -> None:
    """The bytes are this message's."""
    by_rclpy = serialize_message(message)
    assert written[:4] == by_rclpy[:4]
    assert len(written) == len(by_rclpy)
    assert repr(deserialize_message(written, type(message))) == repr(message)


def heading(frame_id: str) -> Heading:
    return Heading(nanoseconds(STAMP), frame_id)


def header(frame_id: str) -> Header:
    return Header(stamp=STAMP, frame_id=frame_id)


def test_headers() -> None:
    for frame_id in NAMES:
        assert convert.header(heading(frame_id)) == header(frame_id)
    before = Time(sec=-5, nanosec=999_999_999)
    assert convert.header(Heading(nanoseconds(before), "")).stamp == before
    later = Heading(nanoseconds(STAMP) + 1, "")
    assert convert.header(later).stamp == STAMP  # there is no later one


@pytest.mark.parametrize("taxels", [1, 2, 3, 15, 16, 4096])
@pytest.mark.parametrize("with_voltage", [False, True])
def test_arrays(taxels: int, with_voltage: bool) -> None:
    rng = np.random.default_rng(taxels)
    values = rng.normal(size=(2, taxels)).astype(np.float32)
    values[:, ::3] = np.nan
    status = rng.integers(0, 256, taxels).astype(np.uint8)
    noise_v = float(np.float32(0.1)) if taxels % 2 else float("nan")
    words = silent(taxels, noise_v)
    sigma_pa = np.abs(values[1][::-1]) if taxels % 2 else None
    readings = Readings(values[0], values[1], status, sigma_pa)
    frame = TactileFrame(2**40 + 1, 0.0, 1e7, 0.0, 0.25, 5e-5, 0.0, words, readings)
    layout = Layout.grid(taxels, 1, taxels, 7e-3, 5e-3)
    message = TactileArray(
        sequence=2**40 + 1,
        device_time_us=10**13,
        info_id=2**32 - 1,
        stamp_uncertainty=0.25,
        height=1,
        width=taxels,
        pressure=values[0].tolist(),
        voltage=values[1].tolist() if with_voltage else [],
        sigma=[] if sigma_pa is None else sigma_pa.tolist(),
        status=status.tolist(),
        noise_rms=noise_v,
    )
    for frame_id in NAMES:
        message.header = header(frame_id)
        written = tactile_array(frame, layout, heading(frame_id), 2**32 - 1, with_voltage)
        assert_same(written, message)


@pytest.mark.parametrize("encoding", ["rgb8", "32FC1"])
@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (64, 64)])
def test_images(encoding: str, shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(1)
    picture = rng.random(shape, dtype=np.float32)
    if encoding == "rgb8":
        picture = rng.integers(0, 256, (*shape, 3)).astype(np.uint8)
    message = Image(height=shape[0], width=shape[1], encoding=encoding)
    message.step, message.data = picture.nbytes // shape[0], picture.tobytes()
    for frame_id in NAMES:
        message.header = header(frame_id)
        assert_same(image(picture, encoding, heading(frame_id)), message)


@pytest.mark.parametrize("kind", [POINT, BODY_POINT], ids=["skin", "body"])
@pytest.mark.parametrize("count", [0, 1, 4096])
def test_clouds(kind: np.dtype[np.void], count: int) -> None:
    size = count * kind.itemsize
    points = np.frombuffer(random.Random(count).randbytes(size), dtype=kind)
    types = {"<f4": PointField.FLOAT32, "<u4": PointField.UINT32}
    fields = [
        PointField(name=name, offset=4 * i, datatype=types[kind[name].str], count=1)
        for i, name in enumerate(kind.names or ())
    ]
    message = PointCloud2(height=1, width=count, fields=fields)
    message.point_step, message.row_step, message.is_dense = kind.itemsize, size, True
    message.data = points.tobytes()
    ways = [[points], [points[:1], points[1:1], points[1:]], *([[]] if not count else [])]
    for frame_id in NAMES:
        message.header = header(frame_id)
        for parts in ways:
            assert_same(point_cloud(kind, parts, heading(frame_id)), message)


def contact(rng: random.Random, patch: str) -> TactileContact:
    def vector(kind: type) -> Any:
        return kind(**{axis: rng.choice(FLOATS) for axis in "xyz"})

    return TactileContact(
        patch=patch,
        id=rng.randrange(2**32),
        age=0.5,
        position=vector(Point),
        normal=vector(Vector3),
        force=vector(Vector3),
        area=float("nan"),
        pressure_max=1.5,
        saturated=rng.random() < 0.5,
        lower_bound=rng.random() < 0.5,
        velocity=vector(Vector3),
        force_rate=-2.25,
        taxels=[rng.randrange(2**16) for _ in range(rng.randrange(5))],
    )


@pytest.mark.parametrize("frame_id", NAMES)
@pytest.mark.parametrize("patch", NAMES)
@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_contacts_are_read_and_written(frame_id: str, patch: str, count: int) -> None:
    rng = random.Random(f"{frame_id} {patch} {count}")
    message = TactileContacts(
        header=header(frame_id),
        sequence=2**64 - 1,
        info_id=3,
        stamp_uncertainty=0.5,
        absent=rng.sample(NAMES, count % 4),
        taxels_in_service=2**32 - 1,
        taxels_valid=5 if count else 2**32 - 1,
        touched=count > 0,
        untouched=count == 0,
        area=0.125,
        position=Point(x=1.0, y=float("nan"), z=-1e-9),
        wrench=Wrench(force=Vector3(x=1.0), torque=Vector3(z=2.0)),
        contacts=[contact(rng, patch) for _ in range(count)],
    )
    raw = serialize_message(message)
    touches = Touches.read(raw)
    assert_same(touches.message, message)
    wrench = WrenchStamped(header=header(frame_id), wrench=message.wrench)
    assert_same(wrench_stamped(touches.heading, touches.force_n, touches.torque_nm), wrench)
    for size in range(len(raw)):  # but for bytes at the end that mean nothing
        with pytest.raises(MessageError, match=r"amid a field|not plain"):
            Touches.read(raw[:size])


def test_bytes_of_others_are_refused() -> None:
    raw = serialize_message(TactileContacts())
    with pytest.raises(MessageError, match="begins with 00 07 00 00, which is not plain"):
        Touches.read(b"\0\7" + raw[2:])
    rng = random.Random(1)
    for _ in range(2000):
        try:
            Touches.read(b"\0\1\0\0" + rng.randbytes(rng.randrange(400)))
        except MessageError:
            continue


LAYOUT = Layout.grid(16, 0, 0, 7e-3, 5e-3)


def pressed() -> ContactTracker:
    return ContactTracker(LAYOUT, ContactThresholds(1e3, 5e2))


@pytest.mark.parametrize("frame_id", NAMES)
def test_contacts_of_a_frame(frame_id: str) -> None:
    pressure_pa = np.zeros(16, dtype=np.float32)
    pressure_pa[[0, 1, 7, 15]] = 2e3, 3e3, np.nan, 5e3
    readings = Readings(pressure_pa, pressure_pa, np.zeros(16, dtype=np.uint8))
    found = pressed().update(readings, 1.0)
    frame = TactileFrame(9, 0.0, 1.0, 0.0, 0.25, 5e-5, 0.0, silent(16, 0.0), readings)
    written = contacts_message(found, frame, "/skin", heading(frame_id), 4)
    message = deserialize_message(written, TactileContacts)
    assert_same(written, message)
    assert message.header == header(frame_id)
    assert (message.sequence, message.info_id, message.touched) == (9, 4, True)
    assert message.stamp_uncertainty == 0.25
    assert (message.taxels_in_service, message.taxels_valid, message.absent) == (16, 15, [])
    assert [c.patch for c in message.contacts] == ["/skin"] * len(found) == ["/skin"] * 2
    for i, one in enumerate(message.contacts):
        assert one.id == found.ids[i]
        assert one.taxels.tolist() == found.taxels[i].tolist()
        for got, wanted in (
            (one.position, found.position_m),
            (one.normal, found.normals),
            (one.force, found.force_n),
            (one.velocity, found.velocity_m_s),
        ):
            assert [got.x, got.y, got.z] == wanted[i].tolist()
        assert one.lower_bound == found.lower_bound[i]
        assert one.pressure_max == found.pressure_max_pa[i]
        assert one.area == np.float32(found.area_m2[i])


@pytest.mark.parametrize("frame_id", NAMES)
@pytest.mark.parametrize("most_squares", [0, 16])
def test_markers(frame_id: str, most_squares: int) -> None:
    """Of contacts that begin, end, and beside a taxel that is not read."""
    skin, tracker = SkinMarkers(LAYOUT, most_squares), pressed()
    drawn = 0
    for number, touched in enumerate(([], [0, 15], [15], [5])):
        pressure_pa = np.zeros(16, dtype=np.float32)
        pressure_pa[touched] = 4e3
        pressure_pa[9] = np.nan if number == 2 else 0.0
        status = np.zeros(16, dtype=np.uint8)
        contacts = tracker.update(Readings(pressure_pa, pressure_pa, status), float(number))
        written = skin.markers(pressure_pa, 1e5, contacts, heading(frame_id), 1.25)
        message = deserialize_message(written, MarkerArray)
        assert_same(written, message)
        drawn += len(message.markers)
        for marker in message.markers:
            assert marker.header == header(frame_id)
            if marker.action == Marker.DELETE:
                bare = Marker(header=marker.header, ns=marker.ns, id=marker.id)
                bare.action = Marker.DELETE
                assert marker == bare
            else:
                assert (marker.lifetime.sec, marker.lifetime.nanosec) == (1, 250_000_000)
                red, green = (1.0, 1.0) if marker.ns in (RESULTANT, SUM) else (0.3, 0.85)
                assert marker.color == ColorRGBA(**_float32(r=red, g=green, b=1.0, a=1.0))
                assert marker.pose.orientation.w == 1.0
    assert drawn == 4 * (most_squares > 0) + 14 + 4  # with the resultant, and its end


def _float32(**values: float) -> dict[str, float]:
    return {name: float(np.float32(value)) for name, value in values.items()}
