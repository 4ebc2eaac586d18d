# SPDX-License-Identifier: Apache-2.0

"""Files that are small, and would make much: each is refused soon, with little memory."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tactile_cdma.base.errors import CaptureError, LayoutError, ParameterError, TactileError
from tactile_cdma.calibrating.load_points import read_table
from tactile_cdma.config.body_file import read_body
from tactile_cdma.config.parameters import read_file
from tactile_cdma.places.layout_file import read_layout
from tactile_cdma.places.layout_nodes import Wiring
from tactile_cdma.places.surface_file import read_link, read_triangles
from tactile_cdma.recording.scope_csv import MOST_SAMPLES, read_scope_csv
from test.support.bounds import bounded, room

MESH = """schema: tactile_cdma/layout
version: 1
shape: mesh
mesh: part.stl
pitch_mm: 1
at_mm: [0, 0, 0]
out: [0, 0, 1]
right: [1, 0, 0]
"""
SPHERE = '<collision><geometry><sphere radius="0.01"/></geometry></collision>'


def layout(path: Path) -> None:
    read_layout(path, Wiring())


def stl(triangles: np.ndarray) -> bytes:
    """Write triangles (n, 3, 3) as binary STL."""
    facets = np.zeros(len(triangles), dtype=[("of", "<f4", 12), ("no", "<u2")])
    facets["of"][:, 3:] = triangles.reshape(-1, 9)
    return bytes(80) + len(triangles).to_bytes(4, "little") + facets.tobytes()


def ball(taxels: int) -> str:
    """List taxels in a ball, a quarter of the pitch that the file says apart."""
    places = np.random.default_rng(1).normal(size=(taxels, 3)) / 4
    entries = "".join(
        f"- {{position_mm: [{x:.6f}, {y:.6f}, {z:.6f}], node: {i}}}\n"
        for i, (x, y, z) in enumerate(places, 1)
    )
    head = "schema: tactile_cdma/layout\nversion: 1\nshape: list\npitch_mm: 1\ntaxels:\n"
    return head + entries


def repeated(items: object, name: str = "a{}", **parameters: object) -> bytes:
    """Write a body (JSON is YAML) of one patch with these items."""
    patch = {"repeat": items, "parameters": parameters}
    return json.dumps({"frame_id": "body", "patches": {name: patch}}).encode()


CASES: dict[str, tuple[Callable[[Path], object], str, bytes | Callable[[], bytes], str]] = {
    "texts of repeat": (
        read_body,
        "body.yaml",
        lambda: repeated([f"{'x' * 120}{i}" for i in range(500)], port="{}" * 30_000),
        "repeat writes out more than",
    ),
    "one text of repeat": (
        read_body,
        "body.yaml",
        lambda: repeated(["x" * 60_000], port="{}" * 30_000),
        "repeat writes out more than",
    ),
    "a name of repeat": (
        read_body,
        "body.yaml",
        lambda: repeated(["x" * 60_000], name="a" + "{}" * 500),
        "repeat writes out more than",
    ),
    "lists of repeat": (
        read_body,
        "body.yaml",
        lambda: repeated([f"i{i}" for i in range(1000)], port=[1] * 20_000),
        "repeat writes out more than",
    ),
    "items of repeat": (
        read_body,
        "body.yaml",
        lambda: repeated({f"i{i}": {} for i in range(100_000)}),
        "repeat has 100000 items; the limit is 1000",
    ),
    "wildcards of a node": (
        lambda path: read_file(path, "/a/b/c/d"),
        "skin.yaml",
        ("? " + "/**" * 20_000 + "/x\n: {ros__parameters: {bits: 10}}").encode(),
        "this node is /a/b/c/d",
    ),
    "sections": (
        lambda path: read_file(path, "/skin"),
        "skin.yaml",
        lambda: "".join(
            f"/{'n' * 99}{i}: {{ros__parameters: {{}}}}\n" for i in range(9999)
        ).encode(),
        "and 9979 more, and this node is /skin",
    ),
    "spheres of a link": (
        lambda path: read_link(path, "ball"),
        "hand.urdf",
        f"<robot><link name='ball'>{SPHERE * 10_000}</link></robot>".encode(),
        "more than 524288 triangles",
    ),
    "elements of a robot": (
        lambda path: read_link(path, "ball"),
        "hand.urdf",
        b"<robot>" + b"<a/>" * 524_000 + b"</robot>",
        "has no link 'ball'",
    ),
    "links of a robot": (
        lambda path: read_link(path, "ball"),
        "hand.urdf",
        b"<robot>" + b"".join(b"<link name='%d'/>" % i for i in range(50_000)) + b"</robot>",
        "49980 more",
    ),
    "corners of a mesh": (
        read_triangles,
        "part.obj",
        b"v 1 1 1\n" * (2 << 20),
        "more than 524288 triangles",
    ),
    "faces of a mesh": (
        read_triangles,
        "part.obj",
        b"v 1 1 1\n" + b"f 1 1 1\n" * 540_000,
        "more than 524288 triangles",
    ),
    "a face of a mesh": (
        read_triangles,
        "part.obj",
        b"v 1 1 1\nf" + b" 1" * (1 << 20),
        "a line of 2097153 bytes; the limit is",
    ),
    "empty lines of a mesh": (read_triangles, "part.obj", b"\n" * (2 << 20), "has no triangles"),
    "triangles of a text": (
        read_triangles,
        "part.stl",
        b"vertex 1 1 1\n" * (2 << 20),
        "more than 524288 triangles",
    ),
    "dense taxels": (
        layout,
        "skin.yaml",
        lambda: ball(700).encode(),
        "taxels lie within 3 pitches",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_what_would_make_much_is_refused(tmp_path: Path, case: str) -> None:
    read, name, content, words = CASES[case]
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content())
    del content
    with bounded(room(path)), pytest.raises((TactileError, ValueError), match=words) as caught:
        read(path)
    assert name in str(caught.value) or "triangles" in words


def test_triangles_on_top_of_each_other_are_too_many_for_taxels(tmp_path: Path) -> None:
    flat = np.array([[-999, -999, 0], [999, -999, 0], [0, 999, 0.0]])
    (tmp_path / "part.stl").write_bytes(stl(np.tile(flat, (100_000, 1, 1))))
    path = tmp_path / "skin.yaml"
    path.write_text(MESH + "rows: 64\ncolumns: 64\n")
    with bounded(), pytest.raises(LayoutError, match="too many triangles for 4096 taxels"):
        layout(path)


def test_a_fine_mesh_takes_no_longer_for_triangles_that_are_elsewhere(tmp_path: Path) -> None:
    """All pairs of its taxels and triangles would take minutes."""
    side = np.arange(500) / 2.0 - 125
    x, y = (part.ravel() for part in np.meshgrid(side, side))
    near = np.stack([x, y, np.zeros_like(x)], axis=1)
    corners = near[:, None] + np.array([[0, 0, 0], [0.5, 0, 0], [0, 0.5, 0]])
    halves = near[:, None] + np.array([[0.5, 0, 0], [0.5, 0.5, 0], [0, 0.5, 0]])
    (tmp_path / "part.stl").write_bytes(stl(np.concatenate([corners, halves])))
    path = tmp_path / "skin.yaml"
    path.write_text(MESH + "rows: 32\ncolumns: 32\nscale: 0.001\n")
    with bounded():
        found = read_layout(path, Wiring())
    assert np.allclose(found.positions_m[:, 2], 0, atol=1e-6)
    assert np.allclose(found.normals, [0, 0, 1], atol=1e-6)


@pytest.mark.parametrize(
    ("read", "heading", "row", "count"),
    [
        (read_table, "pressure_kpa,voltage_v", "1,2", 600_000),
        (lambda path: read_scope_csv(path, rate_hz=1e6), "CH1;CH2", "1;2", 2_000_000),
        (lambda path: read_scope_csv(path, rate_hz=1e6), "", "0.5", 2_000_000),
    ],
)
def test_a_table_of_short_lines_takes_ten_times_its_size_at_most(
    tmp_path: Path, read: Callable[[Path], object], heading: str, row: str, count: int
) -> None:
    """A list of its lines alone would take more."""
    path = tmp_path / "long.csv"
    path.write_text(f"{heading}\n" + f"{row}\n" * count)
    with bounded(room(path)):
        assert read(path)


def test_more_samples_than_fit_into_memory_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "long.csv"
    path.write_bytes(b"1,2\n" * (MOST_SAMPLES + 1))
    with bounded(room(path)), pytest.raises(CaptureError, match="has more than 16777216 samples"):
        read_scope_csv(path)


@pytest.mark.parametrize(
    ("section", "fits"),
    [
        ("/**", True),
        ("/**/skin", True),
        ("/**/**/skin/**", True),
        ("/*/*/skin", True),
        ("/left/palm/skin", True),
        ("/left/**/palm/*", True),
        ("/**/left/palm/skin", True),
        ("/*/skin", False),
        ("/**/palm", False),
        ("/left/palm/skin/*", False),
        ("/right/**", False),
        ("/**/left", False),
        ("/left", False),
    ],
)
def test_wildcards_stand_for_names_between_slashes(
    tmp_path: Path, section: str, fits: bool
) -> None:
    path = tmp_path / "skin.yaml"
    path.write_text(f"'{section}': {{ros__parameters: {{bits: 10}}}}")
    if fits:
        assert read_file(path, "/left/palm/skin") == {"bits": 10}
    else:
        with pytest.raises(ParameterError, match="this node is /left/palm/skin"):
            read_file(path, "/left/palm/skin")
