# SPDX-License-Identifier: Apache-2.0

"""Pictures of one skin over real DDS: all show the same pressures, places and colours."""

import time
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from sensor_msgs.msg import Image, PointCloud2, PointField
from visualization_msgs.msg import Marker

from tactile_cdma.places.layout_file import read_layout
from tactile_cdma.places.layout_nodes import Wiring
from tactile_cdma.ros.common.qos import PICTURE
from tactile_cdma.ros.driver.markers import ARROWS, SURFACE
from tactile_cdma.ros.driver.pictures import LEAST_FADE_S, TOPICS
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.views.cloud import POINT
from tactile_cdma.views.heatmap import NO_READING_RGB, colours
from test.support.boards import plugged
from test.support.skin_client import Client, running
from test.support.waiting import wait_for

pytestmark = pytest.mark.xdist_group("pictures")
PATH = Path(__file__).resolve().parents[2] / "config" / "layouts" / "sphere.yaml"
BALL = read_layout(PATH, Wiring(nodes=25))
SKIN = {
    "port": f"sim://?scene=all&threshold=0&layout={PATH}",
    "nodes": 25,
    "frame_period_ms": 20.0,
    "layout_file": str(PATH),
    "frame_id": "ball",
    "heatmap_pixels": 1,
}
NUMPY_TYPES = {PointField.FLOAT32: "<f4", PointField.UINT32: "<u4"}


def subscribe(client: Client) -> dict[str, list[Any]]:
    """The lists that every picture's messages are going to fill, by topic."""
    return {name: client.heard(kind, f"/skin/{name}", PICTURE) for name, kind in TOPICS.items()}


def time_ns(message: Any) -> int:
    header = message.markers[0].header if hasattr(message, "markers") else message.header
    assert header.frame_id == "ball"
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def records(cloud: PointCloud2) -> np.ndarray:
    """The points, by nothing but what the message says of itself."""
    point = np.dtype(
        {
            "names": [field.name for field in cloud.fields],
            "formats": [NUMPY_TYPES[field.datatype] for field in cloud.fields],
            "offsets": [field.offset for field in cloud.fields],
            "itemsize": cloud.point_step,
        }
    )
    assert (cloud.height, cloud.row_step) == (1, cloud.width * cloud.point_step)
    assert not cloud.is_bigendian and cloud.is_dense
    return np.frombuffer(cloud.data, point, count=cloud.width)


def pixels(image: Image, kind: type, channels: int) -> np.ndarray:
    assert image.step == image.width * channels * np.dtype(kind).itemsize
    return np.frombuffer(image.data, kind).reshape(image.height, image.width, channels)


@pytest.fixture(scope="module")
def seen() -> tuple[dict[str, Any], np.ndarray]:
    """All pictures of one frame by topic, and its pressures, Pa."""
    with running(**SKIN) as (_, client):
        lists = subscribe(client)
        wait_for(lambda: all(len(messages) > 30 for messages in lists.values()))
    by_time = [{time_ns(m): m for m in messages} for messages in lists.values()]
    frames = {time_ns(array): array for array in client.arrays}
    common = sorted(set(frames).intersection(*by_time))
    assert common, "array and pictures of a frame have one stamp"
    stamp_ns = common[len(common) // 2]
    frame = frames[stamp_ns]
    pictures = dict(zip(lists, (messages[stamp_ns] for messages in by_time), strict=True))
    pressure_pa = np.array(frame.pressure, dtype=np.float32)
    assert np.isnan(pressure_pa).tolist() == [node == 13 for node in BALL.nodes]
    assert np.nanmax(pressure_pa) > 10e3
    return pictures, pressure_pa


def test_the_pressure_image_has_a_pixel_for_every_cell(seen: Any) -> None:
    pictures, pressure_pa = seen
    image = pictures["pressure_image"]
    assert (image.encoding, image.height, image.width) == ("32FC1", 5, 5)
    found = pixels(image, np.float32, 1)[..., 0]
    assert np.array_equal(found, pressure_pa[BALL.raster], equal_nan=True)


def test_points_say_where_they_are_what_they_feel_and_which_taxel_they_are(seen: Any) -> None:
    pictures, pressure_pa = seen
    points = records(pictures["points"])
    assert np.array_equal(points, np.frombuffer(pictures["points"].data, POINT))
    taxels = points["taxel"]
    assert taxels.tolist() == [taxel for taxel in range(25) if taxel != 12]
    places = np.stack([points[name] for name in ("x", "y", "z")], axis=1)
    normals = np.stack([points[f"normal_{name}"] for name in "xyz"], axis=1)
    assert np.array_equal(places, BALL.positions_m[taxels])
    assert np.array_equal(normals, BALL.normals[taxels])
    assert np.array_equal(points["pressure"], pressure_pa[taxels])


def test_heatmap_points_and_markers_have_the_same_colours(seen: Any) -> None:
    pictures, pressure_pa = seen
    wanted = colours(pressure_pa, 140e3)
    assert pictures["heatmap"].encoding == "rgb8"
    assert np.array_equal(pixels(pictures["heatmap"], np.uint8, 3), wanted[BALL.raster])
    points = records(pictures["points"])
    of_points = points["rgb"][:, None] >> np.array([16, 8, 0]) & 255
    assert np.array_equal(of_points, wanted[points["taxel"]])
    [surface] = [m for m in pictures["markers"].markers if m.ns == SURFACE]
    of_corners = np.array([(c.r, c.g, c.b) for c in surface.colors]).reshape(25, 6, 3) * 255
    assert np.allclose(of_corners, wanted[:, None], atol=1e-3)


def test_each_picture_is_drawn_only_while_somebody_looks_at_it() -> None:
    with running(**SKIN) as (node, client):
        wait_for(lambda: len(client.arrays) > 20)
        pictures = node.pictures
        assert pictures._timer.is_canceled()
        pictures._message = drawn = Mock(wraps=pictures._message)
        markers = client.heard(TOPICS["markers"], "/skin/markers", PICTURE)
        wait_for(lambda: len(markers) > 3)
        assert pictures._timer.timer_period_ns == round(1e9 / 30)
        client.unsubscribe("/skin/markers")
        wait_for(pictures._timer.is_canceled)
        assert {call.args[0] for call in drawn.call_args_list} == {"markers"}
        drawn.reset_mock()
        before = len(client.arrays)
        wait_for(lambda: len(client.arrays) > before + 20)
        assert not drawn.called


def test_no_frame_is_drawn_twice() -> None:
    with running(port="sim://?scene=all&threshold=0", frame_period_ms=100) as (_, client):
        images = client.heard(Image, "/skin/heatmap", PICTURE)
        wait_for(lambda: len(images) > 8)
    stamps = [(image.header.stamp.sec, image.header.stamp.nanosec) for image in images]
    assert len(set(stamps)) == len(stamps)


@pytest.mark.parametrize("deactivates", [False, True], ids=["unplugged", "deactivated"])
def test_when_nothing_is_read_any_more_a_last_picture_shows_no_pressure(
    deactivates: bool, tmp_path: Path
) -> None:
    path = tmp_path / "tty"
    with running(**SKIN | {"port": str(path)}) as (_, client):
        lists = subscribe(client)
        with plugged(lambda: VirtualDigitizer(SimOptions.from_url(str(SKIN["port"]))), path):
            wait_for(lambda: lists["points"] and lists["points"][-1].width and lists["heatmap"])
            if deactivates:
                assert client.change("deactivate")
        wait_for(lambda: not lists["points"][-1].width)
        wait_for(lambda: np.isnan(pixels(lists["pressure_image"][-1], np.float32, 1)).all())
        wait_for(lambda: has_no_reading(lists["heatmap"][-1]))
        drawn = [len(messages) for messages in lists.values()]
        time.sleep(2 * LEAST_FADE_S)
        assert [len(messages) for messages in lists.values()] == drawn, "it is drawn once"


def has_no_reading(heatmap: Image) -> bool:
    return bool((pixels(heatmap, np.uint8, 3) == NO_READING_RGB).all())


def test_colour_scale_rate_and_thresholds_of_pictures_change_at_once() -> None:
    with running(**SKIN) as (_, client):
        lists = subscribe(client)
        clouds, markers = lists["points"], lists["markers"]
        wait_for(lambda: clouds and any(arrows(m) for m in markers))
        assert len(set(records(clouds[-1])["rgb"])) > 1
        for name in ("contact_kpa", "release_kpa", "colour_max_kpa"):
            assert client.set(**{name: 1e5}) == (True, "")
        assert client.set(colour_gamma=1.0) == (True, "")
        wait_for(lambda: len(set(records(clouds[-1])["rgb"])) == 1 and not arrows(markers[-1]))
        assert client.set(visual_rate_hz=4.0) == (True, "")
        start, before = time.monotonic(), len(clouds)
        wait_for(lambda: len(clouds) >= before + 6)
        assert time.monotonic() - start > 1.0


def arrows(markers: Any) -> list[Any]:
    return [m for m in markers.markers if (m.ns, m.action) == (ARROWS, Marker.ADD)]
