# SPDX-License-Identifier: Apache-2.0

"""The rviz files name displays and properties that exist, and topics as they are offered.

rviz itself passes silently over what it does not know. Names are those of rviz_default_plugins and
rviz_common in ROS 2 Jazzy: plugins_description.xml, and the properties of each display's source.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from rclpy.qos import (
    HistoryPolicy,
    QoSCompatibility,
    QoSDurabilityPolicy,
    QoSLivelinessPolicy,
    QoSProfile,
    QoSReliabilityPolicy,
    qos_check_compatible,
)

from tactile_cdma.config.body_file import read_body
from tactile_cdma.config.parameters import BY_NAME, DEFAULTS
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.places.layout import MOST_SQUARES, Layout
from tactile_cdma.places.poses import Pose
from tactile_cdma.ros.body.node import BodyNode
from tactile_cdma.ros.rviz_file import body_view, skin_view
from test.support.skin_client import Client, running
from test.support.waiting import wait_for

pytestmark = pytest.mark.xdist_group("rviz")  # its driver is started once
CONFIG = Path(__file__).resolve().parents[2] / "config"
FILES = {path.name: yaml.safe_load(path.read_text()) for path in sorted(CONFIG.glob("*.rviz"))}
TRIPLE = {"X", "Y", "Z"}
OF_ANY = {"Class", "Name", "Enabled"}
OF_TOPICS = {"Topic"}
PROPERTIES = {
    "Grid": {"Cell Size", "Plane Cell Count", "Reference Frame", "Offset"},
    "Axes": {"Length", "Radius", "Reference Frame"},
    "Image": {"Normalize Range"} | OF_TOPICS,
    "PointCloud2": {
        "Style",
        "Size (m)",
        "Position Transformer",
        "Color Transformer",
        "Color",
        "Autocompute Intensity Bounds",
    }
    | OF_TOPICS,
    "MarkerArray": OF_TOPICS,
    "Wrench": {"Force Arrow Scale", "Torque Arrow Scale", "Arrow Width", "Accept NaN Values"}
    | OF_TOPICS,
}
CHOICES = {
    "Style": {"Points", "Squares", "Flat Squares", "Spheres", "Boxes", "Tiles"},
    "Position Transformer": {"XYZ"},
    "Color Transformer": {"RGB8", "FlatColor"},
}
TYPES = {
    "Image": "sensor_msgs/msg/Image",
    "PointCloud2": "sensor_msgs/msg/PointCloud2",
    "MarkerArray": "visualization_msgs/msg/MarkerArray",
    "Wrench": "geometry_msgs/msg/WrenchStamped",
}
OF_TOPIC = {"Value", "Depth", "History Policy", "Reliability Policy", "Durability Policy"}
TOOLS = {"MoveCamera", "Select", "Measure"}
PANELS = {"rviz_common/Displays", "rviz_common/Views"}
OF_ORBIT = {"Class", "Name", "Distance", "Pitch", "Yaw", "Focal Point", "Near Clip Distance"}
OF_ORBIT |= {"Target Frame"}
files = pytest.mark.parametrize("name", FILES)


def manager(name: str) -> Any:
    return FILES[name]["Visualization Manager"]


def plugin(item: dict[str, Any]) -> str:
    package, _, name = item["Class"].partition("/")
    assert package == "rviz_default_plugins"
    return str(name)


def displays(name: str) -> list[tuple[str, dict[str, Any]]]:
    return [(plugin(display), display) for display in manager(name)["Displays"]]


@files
def test_rviz_knows_every_name(name: str) -> None:
    assert set(FILES[name]) == {"Panels", "Visualization Manager", "Window Geometry"}
    assert {panel["Class"] for panel in FILES[name]["Panels"]} <= PANELS
    assert {plugin(tool) for tool in manager(name)["Tools"]} <= TOOLS
    view = manager(name)["Views"]["Current"]
    assert (plugin(view), set(view)) == ("Orbit", OF_ORBIT)
    for kind, display in displays(name):
        assert set(display) <= OF_ANY | PROPERTIES[kind]
        for key, choices in CHOICES.items():
            assert display.get(key) in choices | {None}
        if kind in TYPES:
            assert set(display["Topic"]) == OF_TOPIC
    names = [display["Name"] for _, display in displays(name)]
    assert len(set(names)) == len(names)


@files
def test_values_are_of_the_kind_that_rviz_reads(name: str) -> None:
    for kind, display in displays(name):
        for key, value in display.items():
            if key in {*("Enabled", "Normalize Range", "Accept NaN Values")}:
                assert type(value) is bool
            elif key.endswith(("Size", "Scale", "Width", "(m)", "Count", "Length", "Radius")):
                assert value > 0
            elif key == "Offset":
                assert set(value) == TRIPLE
            elif key != "Topic":
                assert type(value) in {str, bool}, (kind, key)
    options = manager(name)["Global Options"]
    assert set(options) == {"Fixed Frame", "Background Color", "Frame Rate"}
    channels = [int(channel) for channel in options["Background Color"].split(";")]
    assert len(channels) == 3 and max(channels) < 256


@files
def test_colours_are_the_drivers_own(name: str) -> None:
    for kind, display in displays(name):
        if kind == "Image":
            assert display["Normalize Range"] is False
        if kind == "PointCloud2":  # beads on squares that have them, or the driver's own
            assert (display["Color Transformer"] == "FlatColor") == ("Color" in display)
            assert display["Autocompute Intensity Bounds"] is False


@pytest.fixture(scope="module")
def client() -> Iterator[Client]:
    """Of a running driver."""
    with running() as (_, client):
        wait_for(lambda: client.arrays)
        yield client


def wanted_qos(topic: dict[str, Any]) -> QoSProfile:
    def policy(name: str) -> str:
        return str(topic[f"{name} Policy"]).upper().replace(" ", "_")

    return QoSProfile(
        depth=topic["Depth"],
        history=HistoryPolicy[policy("History")],
        reliability=QoSReliabilityPolicy[policy("Reliability")],
        durability=QoSDurabilityPolicy[policy("Durability")],
        liveliness=QoSLivelinessPolicy.AUTOMATIC,  # rviz does not ask
    )


def check_topics(name: str, node: str, client: Client) -> set[str]:
    """That the node offers what displays subscribe to at nodes of its name; returns topics."""
    checked = set()
    for kind, display in displays(name):
        if kind not in TYPES:
            continue
        *_, owner, topic = display["Topic"]["Value"].split("/")
        if owner != node:
            continue
        publishers = partial(client.get_publishers_info_by_topic, f"/{node}/{topic}")
        wait_for(lambda publishers=publishers: len(publishers()) == 1)
        [offered] = publishers()
        assert offered.topic_type == TYPES[kind]
        fits, reason = qos_check_compatible(offered.qos_profile, wanted_qos(display["Topic"]))
        assert fits == QoSCompatibility.OK, reason
        checked.add(topic)
    return checked


@files
def test_topics_are_offered_with_that_type_and_quality(name: str, client: Client) -> None:
    assert "markers" in check_topics(name, "skin", client)


def test_so_are_the_bodys() -> None:
    with running(BodyNode, patches=["/nobody/skin"]) as (_, other):
        assert check_topics("body.rviz", "body", other) == {"names", "points"}


def test_the_files_are_what_is_made_for_the_skins_that_they_show() -> None:
    bent = {"nodes": 72, "frame_period_ms": 40.0}
    bent |= {"layout_file": str(CONFIG / "layouts" / "cylinder.yaml")}
    for name, values in (("skin.rviz", {}), ("curved_skin.rviz", bent)):
        layout = SkinConfig.of(values).layout
        made = skin_view(CONFIG / name, layout, str(BY_NAME["frame_id"].default), "/skin")
        assert yaml.safe_load(made) == FILES[name]
    body = read_body(CONFIG / "body.yaml")
    assert yaml.safe_load(body_view(CONFIG / "body.rviz", body)) == FILES["body.rviz"]


def test_a_skin_of_many_taxels_without_squares_has_larger_points() -> None:
    def points(nodes: int) -> tuple[float, str]:
        layout = Layout.grid(nodes, 0, 0, 7e-3, 7e-3)
        made = yaml.safe_load(skin_view(CONFIG / "skin.rviz", layout, "skin", "/skin"))
        shown = made["Visualization Manager"]["Displays"]
        [item] = [item for item in shown if "Size (m)" in item]
        return item["Size (m)"], item["Color Transformer"]

    (bead_m, bead), (ball_m, ball) = points(MOST_SQUARES), points(2 * MOST_SQUARES)
    assert bead_m < 7e-3 / 2 < ball_m < 7e-3
    assert (bead, ball) == ("FlatColor", "RGB8"), "where there are no squares, points have colours"


def test_the_camera_sees_the_whole_skin() -> None:
    """With rviz's angle of 45°, whatever the skin's size and place."""
    for rows, offset_m in ((4, 0.0), (1, 0.2), (40, -3.0)):
        flat = Layout.grid(rows * 8, rows, 8, 5e-3, 5e-3)
        layout = replace(flat, positions_m=flat.positions_m + np.float32(offset_m))
        made = yaml.safe_load(skin_view(CONFIG / "skin.rviz", layout, "skin", "/skin"))
        view = made["Visualization Manager"]["Views"]["Current"]
        focus = [view["Focal Point"][axis] for axis in "XYZ"]
        reach_m = np.linalg.norm(layout.positions_m - focus, axis=1).max()
        assert reach_m < view["Distance"] * np.tan(np.radians(45 / 2)) < 2 * reach_m


@pytest.mark.parametrize("patches", [slice(None), slice(1), slice(3, None)])
def test_the_camera_sees_a_whole_body_from_near(patches: slice) -> None:
    """Taxels are within rviz's picture, 45° high, and reach close to its edge."""
    whole = read_body(CONFIG / "body.yaml")
    body = replace(whole, patches=whole.patches[patches])
    made = yaml.safe_load(body_view(CONFIG / "body.rviz", body))
    view = made["Visualization Manager"]["Views"]["Current"]
    places_m = []
    for patch in body.patches:
        values = {**DEFAULTS, **patch.values}
        pose = Pose.of_rpy(values["mount_xyz_m"], values["mount_rpy_rad"])
        places_m.append(pose.apply(SkinConfig.of(values).layout.positions_m.astype(float)))
    # rviz's orbit: the camera is at this place of a ball round the focal point.
    pitch, yaw = view["Pitch"], view["Yaw"]
    outward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    focus_m = np.array([view["Focal Point"][axis] for axis in "XYZ"])
    seen_m = np.concatenate(places_m) - focus_m - view["Distance"] * outward
    right = np.cross(-outward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, -outward)
    slopes = np.abs(seen_m @ np.array([right, up]).T) / -(seen_m @ outward)[:, None]
    shares = slopes.max(axis=0) / np.tan(np.radians(45 / 2)) / [820 / 708, 1.0]  # by the pixels
    assert 0.8 < shares.max() < 0.95


def test_of_a_single_taxel_the_camera_keeps_a_distance() -> None:
    layout = Layout.grid(1, 1, 1, 7e-3, 7e-3)
    made = yaml.safe_load(skin_view(CONFIG / "skin.rviz", layout, "skin", "/skin"))
    assert made["Visualization Manager"]["Views"]["Current"]["Distance"] > 7e-3
