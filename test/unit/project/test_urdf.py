# SPDX-License-Identifier: Apache-2.0

"""The macro that mounts a patch on a robot, expanded by xacro as docs/driver.md shows it."""

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

xacro = pytest.importorskip("xacro", reason="xacro comes with ROS 2")

ROOT = Path(__file__).resolve().parents[3]
INSTALLED = "$(find tactile_cdma)"


def expanded(tmp_path: Path, text: str) -> ElementTree.Element:
    """The robot that a description makes. text: may find the package, which is this checkout."""
    path = tmp_path / "robot.urdf.xacro"
    path.write_text(text.replace(INSTALLED, str(ROOT)))
    return ElementTree.fromstring(xacro.process_file(str(path)).toxml())


def robot(*skins: str) -> str:
    lines = "".join(f"<xacro:tactile_skin {skin}/>" for skin in skins)
    return (
        '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">'
        f'<xacro:include filename="{INSTALLED}/urdf/skin.urdf.xacro"/>'
        f'<link name="palm"/>{lines}</robot>'
    )


def roots(tree: ElementTree.Element) -> set[str | None]:
    """Links that are no joint's child."""
    children = {child.get("link") for child in tree.iterfind("joint/child")}
    return {link.get("name") for link in tree.iterfind("link")} - children


def numbers(element: ElementTree.Element | None, key: str) -> list[float]:
    assert element is not None
    return [float(number) for number in element.get(key, "").split()]


def test_the_example_of_the_docs_is_one_tree_with_the_patch_where_it_says(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "driver.md").read_text()
    [example] = re.findall(r"```xml\n(.*?)```", page, re.DOTALL)
    assert INSTALLED in example
    tree = expanded(tmp_path, example)
    assert roots(tree) == {"palm"}
    [joint] = tree.findall("joint")
    assert (joint.get("name"), joint.get("type")) == ("left_palm_mount", "fixed")
    assert joint.find("parent").get("link") == "palm"
    assert joint.find("child").get("link") == "left_palm"
    assert numbers(joint.find("origin"), "xyz") == [0.05, 0, 0.012]
    assert numbers(joint.find("origin"), "rpy") == [0, 0, 1.5708]
    visual = tree.find("link[@name='left_palm']/visual")
    size, origin = numbers(visual.find("geometry/box"), "size"), visual.find("origin")
    assert size == [0.028, 0.028, 0.002]
    assert numbers(origin, "xyz")[2] + size[2] / 2 == pytest.approx(0), "the skin is on its plate"
    assert not tree.findall(".//inertial") and not tree.findall(".//collision")


def test_several_patches_hang_on_one_another_and_without_a_size_there_is_no_plate(
    tmp_path: Path,
) -> None:
    tree = expanded(tmp_path, robot('name="a" parent="palm"', 'name="b" parent="a" xyz="0 0 1"'))
    assert roots(tree) == {"palm"}
    mounts = [
        (j.find("parent").get("link"), j.find("child").get("link")) for j in tree.findall("joint")
    ]
    assert mounts == [("palm", "a"), ("a", "b")]
    assert [numbers(j.find("origin"), "xyz") for j in tree.findall("joint")] == [
        [0, 0, 0],
        [0, 0, 1],
    ]
    assert all(len(link) == 0 for link in tree.findall("link"))


def test_a_patch_without_a_parent_is_refused(tmp_path: Path) -> None:
    with pytest.raises(xacro.XacroException, match="parent"):
        expanded(tmp_path, robot('name="a"'))
