# SPDX-License-Identifier: Apache-2.0

"""Taxels on a robot's parts: files of meshes, links of a URDF, rectangles seen on them."""

import struct
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import pytest

from tactile_cdma.base.errors import LayoutError
from tactile_cdma.places.layout import Layout
from tactile_cdma.places.layout_file import read_layout
from tactile_cdma.places.layout_nodes import Wiring
from tactile_cdma.places.surface_file import read_link, read_triangles

URDF = """<robot name="hand">
<link name="finger"><visual><geometry><box size="9 9 9"/></geometry></visual><collision>
  <origin xyz="0 0 0.02"/><geometry><cylinder radius="0.008" length="0.04"/></geometry>
</collision></link>
<link name="ball"><collision><geometry><sphere radius="0.015"/></geometry></collision></link>
<link name="palm"><collision><origin xyz="0 0 0.005" rpy="0 0 1.5707963267948966"/>
  <geometry><box size="0.03 0.04 0.01"/></geometry></collision></link>
<link name="cube"><collision><geometry>
  <mesh filename="package://hand/cube.stl" scale="0.01 0.01 0.01"/></geometry></collision></link>
<link name="bare"/></robot>"""
FINGER = {
    "urdf": "hand.urdf",
    "link": "finger",
    "rows": 6,
    "columns": 4,
    "pitch_mm": "[3.0, 4.0]",
    "at_mm": "[0, -8, 20]",
    "out": "[0, -1, 0]",
    "right": "[1, 0.2, 0]",
}
# Of a cube from −1 to 1: each face's corners, turning left seen from outside.
CORNERS = list(product((-1, 1), repeat=3))
FACES = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
CUBE = np.array(
    [[CORNERS[face[0]], CORNERS[a], CORNERS[b]] for face in FACES for a, b in pairwise(face[1:])],
    dtype=float,
)


def on(tmp_path: Path, **changes: object) -> Layout:
    (tmp_path / "hand.urdf").write_text(URDF)
    stl = b"solid".ljust(80) + struct.pack("<I", 12)
    stl += b"".join(struct.pack("<12fH", 0, 0, 0, *each.ravel(), 0) for each in CUBE)
    (tmp_path / "cube.stl").write_bytes(stl)
    values = {name: value for name, value in {**FINGER, **changes}.items() if value is not None}
    head = "schema: tactile_cdma/layout\nversion: 1\nshape: mesh\n"
    path = tmp_path / "skin.yaml"
    path.write_text(head + "".join(f"{name}: {value}\n" for name, value in values.items()))
    return read_layout(path, Wiring())


def test_a_cube_is_the_same_in_every_kind_of_file(tmp_path: Path) -> None:
    on(tmp_path)
    ascii_stl = "solid x\n" + "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join("vertex {} {} {}\n".format(*corner) for corner in each)
        + "endloop\nendfacet\n"
        for each in CUBE
    )
    (tmp_path / "text.stl").write_text(ascii_stl)
    obj = "".join("v {} {} {}\n".format(*corner) for corner in CORNERS)
    obj += "".join("f " + " ".join(f"{n + 1}//1" for n in face) + "\n" for face in FACES)
    (tmp_path / "cube.obj").write_text(obj)
    (tmp_path / "back.obj").write_text(obj.replace("f 1//1 2//1", "f -8 -7"))
    for name in ("cube.stl", "text.stl", "cube.obj", "back.obj"):
        assert np.array_equal(read_triangles(tmp_path / name), CUBE), name


def test_taxels_lie_on_a_link_with_its_normals_and_areas(tmp_path: Path) -> None:
    layout = on(tmp_path)
    x, y, z = layout.positions_m.astype(float).T
    assert np.allclose(np.hypot(x, y), 8e-3, rtol=1e-3)
    assert np.allclose(x.reshape(6, 4)[0], [-4.5e-3, -1.5e-3, 1.5e-3, 4.5e-3], atol=1e-7)
    assert np.allclose(z.reshape(6, 4)[:, 0], 0.02 + 4e-3 * (2.5 - np.arange(6)), atol=1e-7)
    assert np.allclose(layout.normals, np.stack([x, y, 0 * z], axis=1) / 8e-3, atol=0.04)
    assert np.allclose(layout.areas_m2, 12e-6 / -layout.normals[:, 1], rtol=1e-4)
    neighbours = (layout.neighbours != np.arange(24)[:, None]).sum(axis=1).reshape(6, 4)
    assert (neighbours[0] == [3, 5, 5, 3]).all()
    assert (neighbours[1] == [5, 8, 8, 5]).all()
    ball = on(tmp_path, link="ball", rows=4, pitch_mm=5, at_mm="[0, 0, 0]", out="[0, 0, 2]")
    assert np.allclose(np.linalg.norm(ball.positions_m, axis=1), 15e-3, rtol=2e-3)
    palm = on(tmp_path, link="palm", pitch_mm=5, at_mm="[2, 0, 9]", out="[0, 0, 1]")
    assert np.allclose(palm.positions_m[:, 2], 0.01)
    assert np.allclose(palm.areas_m2, 25e-6)
    assert np.ptp(palm.positions_m[:, 0]) < 0.02, "turned by its origin, and still on it"


def test_meshes_are_found_scaled_and_left_out_where_no_node_is(tmp_path: Path) -> None:
    flat = {"rows": 2, "columns": 3, "pitch_mm": 8, "at_mm": "[0, 0, 0]", "out": "[0, 0, 1]"}
    nodes = "[[1, 2, 0], [3, 4, 0]]"
    link = on(tmp_path, link="cube", **flat, nodes=nodes)
    file = on(tmp_path, urdf=None, link=None, mesh="cube.stl", scale=0.01, **flat, nodes=nodes)
    assert np.array_equal(link.positions_m, file.positions_m)
    assert np.allclose(link.positions_m[:2, 2], 0.01)
    assert link.nodes.tolist() == [1, 2, 0, 3, 4, 0]


def test_robots_and_meshes_may_be_those_of_installed_packages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    share, own = tmp_path / "install" / "share" / "hand", tmp_path / "own"
    share.mkdir(parents=True)
    own.mkdir()
    flat = {"rows": 2, "columns": 3, "pitch_mm": 3, "at_mm": "[0, 0, 9]", "out": "[0, 0, 1]"}
    on(share)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "install"))
    file = {"urdf": None, "link": None, "scale": 0.01, **flat}
    for given in (
        {"mesh": "package://hand/cube.stl", **file},
        {"mesh": f"file://{share}/cube.stl", **file},
        {"urdf": "package://hand/hand.urdf", "link": "cube", **flat},
    ):
        assert np.allclose(on(own, **given).positions_m[:, 2], 0.01), given
    (own / "cube.stl").unlink()
    (own / "skin.yaml").write_text((own / "skin.yaml").read_text().replace("package://hand/", ""))
    assert np.allclose(read_layout(own / "skin.yaml", Wiring()).positions_m[:, 2], 0.01)
    monkeypatch.setenv("AMENT_PREFIX_PATH", "")
    with pytest.raises(LayoutError, match=r"cube.stl' is not found beside it, .*, or in a package"):
        read_layout(own / "skin.yaml", Wiring())
    with pytest.raises(LayoutError, match="no package 'hand' in AMENT_PREFIX_PATH"):
        on(own, mesh="package://hand/cube.stl", **file)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"link": "thumb"}, "has no link 'thumb'; it has ball, bare, cube, finger, palm"),
        ({"link": "bare"}, "link 'bare' has no geometry"),
        ({"urdf": None, "link": None}, "needs a mesh, or a urdf and a link"),
        ({"mesh": "cube.stl"}, "and not both"),
        ({"urdf": None, "link": None, "mesh": "none.stl"}, "No such file"),
        ({"urdf": None, "link": None, "mesh": "hand.urdf"}, "not an .stl or .obj file"),
        ({"urdf": "cube.stl"}, "not a URDF"),
        ({"right": "[0, 3, 0]"}, "right, the direction of columns"),
        ({"out": "[0, 0, 0]"}, "out has no direction"),
        ({"pitch_mm": 8}, r"taxel 0 \(row 0, column 0\) is beside the mesh"),
        ({"pitch_mm": 5.3}, r"taxel 0 .* too steep, 8.° from the rectangle"),
    ],
)
def test_what_cannot_be_is_refused(changes: dict[str, object], words: str, tmp_path: Path) -> None:
    with pytest.raises(LayoutError, match=words):
        on(tmp_path, **changes)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("part.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf -5 -4 -3\n", "that it does not have"),
        ("part.obj", f"v 0 0 0\nf {'9' * 20} 1 1\n", "that it does not have"),
        ("part.obj", f"v 0 0 0\nf {'9' * 5000} 1 1\n", "part.obj: not a mesh"),
        ("part.obj", "v 0 0 0\nf 1 2 1\n", "that it does not have"),
        ("part.obj", "v 0 0 0\nf 1 0 1\n", "that it does not have"),
        ("part.obj", "v 0 0\nf 1 1 1\n", "of less than three numbers"),
        ("part.obj", "v 0 a 0\nf 1 1 1\n", "part.obj: not a mesh: could not convert"),
        ("part.stl", "vertex 0 0 a\n" * 3, "part.stl: not a mesh"),
    ],
)
def test_meshes_that_contradict_themselves(
    name: str, content: str, words: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(ValueError, match=words):
        read_triangles(tmp_path / name)


@pytest.mark.parametrize(
    ("geometry", "words"),
    [
        ('<sphere radius="a"/>', "'a' where 1 numbers should be"),
        ("<sphere/>", "where 1 numbers should be"),
        ('<box size="1 2"/>', "'1 2' where 3 numbers should be"),
        (f'<mesh filename="{"x" * 5000}.stl"/>', "is not found"),
        ('<mesh filename="hand.urdf"/>', "not an .stl or .obj file"),
    ],
)
def test_links_that_say_no_numbers(geometry: str, words: str, tmp_path: Path) -> None:
    body = f"<collision><geometry>{geometry}</geometry></collision>"
    for encoding in ("utf-8", "nonsense"):
        head = f'<?xml version="1.0" encoding="{encoding}"?>'
        path = tmp_path / "hand.urdf"
        path.write_text(f'{head}<robot><link name="a">{body}</link></robot>')
        with pytest.raises(ValueError, match=words if encoding == "utf-8" else "not a URDF"):
            read_link(path, "a")
