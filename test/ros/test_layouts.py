# SPDX-License-Identifier: Apache-2.0

"""A layout reaches subscribers; the layouts for PlotJuggler and Foxglove name what exists."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from geometry_msgs.msg import WrenchStamped
from rosidl_parser.definition import AbstractSequence
from sensor_msgs.msg import Image

from tactile_cdma.msg import TactileArray, TactileContacts
from tactile_cdma.places.layout_file import read_layout
from tactile_cdma.places.layout_nodes import Wiring
from tactile_cdma.readings.status import Status
from tactile_cdma.ros.common.convert import layout_of
from tactile_cdma.ros.common.qos import PICTURE
from tactile_cdma.ros.driver.pictures import TOPICS
from tactile_cdma.ros.viewers.view import in_use
from test.support.skin_client import running
from test.support.waiting import wait_for

LAYOUTS = Path(__file__).resolve().parents[2] / "config" / "layouts"


def test_places_and_arrays_are_those_of_the_file() -> None:
    path = LAYOUTS / "grid.yaml"
    layout = read_layout(path, Wiring(nodes=12))
    port = f"sim://?scene=all&threshold=0&layout={path}"
    with running(port=port, nodes=12, layout_file=str(path)) as (_, client):
        wait_for(lambda: client.infos and len(client.arrays) > 10)
    info, message = client.infos[-1], client.arrays[-1]
    assert (info.height, info.width, info.nodes) == (4, 4, 12)
    assert (message.height, message.width, len(message.pressure)) == (4, 4, 16)
    assert list(info.node) == layout.nodes.tolist()
    assert [row for node, row in zip(info.node, info.code_row, strict=True) if node] == [
        node for node in info.node if node
    ]
    assert np.allclose([(p.x, p.y, p.z) for p in info.positions], layout.positions_m)
    assert np.allclose([(n.x, n.y, n.z) for n in info.normals], layout.normals)
    assert np.allclose(info.area, layout.areas_m2)
    empty = layout.nodes == 0
    assert (np.isnan(message.pressure) == empty).all()
    assert (np.array(message.status)[empty] == Status.MASKED).all()
    assert len(in_use(message)) == 12 and np.isfinite(in_use(message)).all()
    # The scene's wave runs along x: on the skin, whatever the order of the nodes, columns agree.
    pressure = np.array(message.pressure).reshape(4, 4)
    assert np.nanmax(np.ptp(pressure[1:3], axis=0)) < 1.0
    assert np.ptp(pressure[1]) > 5e3


def test_an_irregular_skin_is_one_row_and_still_a_picture() -> None:
    path = LAYOUTS / "list.yaml"
    port = f"sim://?scene=all&threshold=0&layout={path}"
    with running(port=port, nodes=20, layout_file=str(path), heatmap_pixels=8) as (_, client):
        images = client.heard(Image, "/skin/heatmap", PICTURE)
        wait_for(lambda: client.infos and images and len(client.arrays) > 10)
    info, message, image = client.infos[-1], client.arrays[-1], images[-1]
    assert (info.height, info.width, message.height, message.width) == (1, 19, 1, 19)
    assert len(message.pressure) == len(message.status) == 19
    assert not np.isnan(message.pressure).any()
    raster = read_layout(path, Wiring(nodes=20)).raster
    assert (image.height, image.width) == (raster.shape[0] * 4, raster.shape[1] * 4)
    np.testing.assert_array_equal(layout_of(info).raster, raster)


CONFIG = Path(__file__).resolve().parents[2] / "config"
TYPES = {"tactile": TactileArray, "contacts": TactileContacts, "wrench": WrenchStamped, **TOPICS}
FOXGLOVE = json.loads((CONFIG / "foxglove.json").read_text())
PLOTJUGGLER = ElementTree.fromstring((CONFIG / "plotjuggler.xml").read_text())


def resolve(path: str) -> Any:
    """The value in a fresh message that a path of either program leads to."""
    match = re.fullmatch(r"/skin/(\w+)[./](.*)", path)
    assert match, path
    value: Any = TYPES[match[1]]()
    for name in re.split(r"[./]", match[2]):
        field, _, index = name.partition("[")
        if index:
            of = type(value)
            kind = of.SLOT_TYPES[of.__slots__.index(f"_{field}")]
            assert isinstance(kind, AbstractSequence), f"{name} of {path} has no elements"
            return kind
        value = getattr(value, field)
    return value


def shown_by_foxglove(node: Any) -> Iterator[str]:
    """The panels in the tree of the layout."""
    if isinstance(node, str):
        yield node
    else:
        yield from shown_by_foxglove(node["first"])
        yield from shown_by_foxglove(node["second"])


def test_plotjugglers_curves_are_numbers_of_our_messages() -> None:
    curves = [str(curve.get("name")) for curve in PLOTJUGGLER.iter("curve")]
    assert len(curves) == len(set(curves)) > 5
    for curve in curves:
        assert isinstance(resolve(curve), float | int | AbstractSequence), curve
    for split in PLOTJUGGLER.iter("DockSplitter"):
        assert (
            len(list(split)) == int(split.get("count", 0)) == len(split.get("sizes", "").split(";"))
        )


def test_foxgloves_panels_show_our_topics() -> None:
    panels = FOXGLOVE["configById"]
    assert set(shown_by_foxglove(FOXGLOVE["layout"])) == set(panels)
    for panel in panels.values():
        for path in panel.get("paths", ()):
            assert isinstance(resolve(path["value"]), float | int | AbstractSequence)
    topics = [*panels["3D!skin"]["topics"], panels["Image!heatmap"]["imageMode"]["imageTopic"]]
    assert {topic.removeprefix("/skin/") for topic in topics} <= set(TOPICS)


def test_a_field_that_does_not_exist_is_noticed() -> None:
    for wrong in ("/skin/tactile/presure[0]", "/skin/tactile/sequence[0]", "/skin/nowhere/x"):
        with pytest.raises((AttributeError, AssertionError, KeyError, ValueError)):
            resolve(wrong)
