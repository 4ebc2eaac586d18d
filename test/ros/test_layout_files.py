# SPDX-License-Identifier: Apache-2.0

"""The layouts for PlotJuggler and Foxglove name topics and fields that a driver publishes."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from geometry_msgs.msg import WrenchStamped
from rosidl_parser.definition import AbstractSequence

from tactile_cdma.msg import TactileArray, TactileContacts
from tactile_cdma.ros.driver.pictures import TOPICS

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
