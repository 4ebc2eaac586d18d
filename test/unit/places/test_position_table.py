# SPDX-License-Identifier: Apache-2.0

"""Tables of taxels' places: read as the list that says the same, or refused by line."""

from pathlib import Path

import numpy as np
import pytest

from tactile_cdma.base.errors import LayoutError
from tactile_cdma.places.layout import Layout
from tactile_cdma.places.layout_file import read_layout
from tactile_cdma.places.layout_nodes import Wiring

PLACES_MM = [(0.0, 0.0, 0.0), (10.0, 5.0, 1.5), (20.0, 10.0, 0.0), (30.0, 0.0, -2.5)]
NORMALS = [(0, 0, 1), (0, 0.6, 0.8), (0, 0, 2), (1, 0, 1)]
NODES = (3, 1, 4, 2)


def listed(path: Path, normals: bool, nodes: bool) -> Layout:
    """The layout that a YAML file says."""
    rows = []
    for index, (place, normal) in enumerate(zip(PLACES_MM, NORMALS, strict=True)):
        node = NODES[index] if nodes else index + 1
        said = f", normal: {list(normal)}" if normals else ""
        rows.append(f"  - {{position_mm: {list(place)}, node: {node}{said}}}\n")
    path.write_text(
        "schema: tactile_cdma/layout\nversion: 1\nshape: list\ntaxels:\n" + "".join(rows)
    )
    return read_layout(path, Wiring())


def table(heading: str, separator: str, unit_mm: float, normals: bool, nodes: bool) -> str:
    lines = [heading]
    for index, (place, normal) in enumerate(zip(PLACES_MM, NORMALS, strict=True)):
        cells = [f"{one / unit_mm:.6g}" for one in place]
        cells += [f"{one}" for one in normal] * normals + [str(NODES[index])] * nodes
        lines.append(separator.join(cells))
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    ("name", "text", "normals", "nodes"),
    [
        ("a.csv", table("x_mm,y_mm,z_mm", ",", 1, False, False), False, False),
        ("a.CSV", table("x_mm,y_mm,z_mm,nx,ny,nz", ",", 1, True, False), True, False),
        ("a.tsv", table("X [m]\tY [m]\tZ [m]\tNode", "\t", 1e3, False, True), False, True),
        (
            "a.txt",
            table(
                "pos_x_cm pos_y_cm pos_z_cm normal_x normal_y normal_z node", " ", 10, True, True
            ),
            *(True, True),
        ),
        (
            "a.csv",
            "sep=;\n" + table("x;y;z;nx;ny;nz\nmm;mm;mm;;;", ";", 1, True, False).replace(".", ","),
            *(True, False),
        ),
    ],
)
def test_a_table_is_the_list_that_says_the_same(
    tmp_path: Path, name: str, text: str, normals: bool, nodes: bool
) -> None:
    (tmp_path / name).write_text(text)
    found, expected = (
        read_layout(tmp_path / name, Wiring()),
        listed(tmp_path / "list.yaml", normals, nodes),
    )
    assert found.irregular and found.name == "a"
    assert found.nodes.tolist() == expected.nodes.tolist()
    for field in ("positions_m", "normals", "areas_m2", "neighbours"):
        np.testing.assert_allclose(getattr(found, field), getattr(expected, field), rtol=1e-6)


def test_rows_may_be_numbered_as_taxels_are(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("taxel,x_mm,y_mm,z_mm\n0,0,0,0\n1,10,0,0\n")
    assert read_layout(path, Wiring()).nodes.tolist() == [1, 2]
    path.write_text("taxel,x_mm,y_mm,z_mm\n1,0,0,0\n2,10,0,0\n")
    with pytest.raises(LayoutError, match="line 2: 4 cells of taxel 1; expected 4 of taxel 0"):
        read_layout(path, Wiring())


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("", "the file is empty"),
        ("x_mm,y_mm,z_mm\n", "taxels has 0 entries"),
        ("0 0 0 0 0 1\n0.01 0 0 0 0 1\n", "line 1: '0' where the name of a column should be: x_mm"),
        ("x,y,z\n0,0,0\n", "line 1: 'x' where the name of a column should be: x_mm, y_mm, z_mm"),
        ("x_mm,y_mm\n0,0\n", "line 1: no column z; known are x_mm"),
        ("x_mm,y_mm,z_mm,nz\n0,0,0,1\n", "line 1: no column nx, ny; known are"),
        ("x_mm,x_m,y_mm,z_mm\n0,0,0,1\n", "line 1: 'x_m' where the name of a column"),
        ("x_mm,y_mm,z_mm\n0,0,0\n10,0,0,0\n", "line 3: 4 cells of taxel 1; expected 3"),
        ("x_mm,y_mm,z_mm\n0,0,0\n10,?,0\n", r"line 3: number 2 of the position of taxel 1 is '\?'"),
        ("x_m,y_m,z_m\n0,0,0\nten,0,0\n", "line 3: number 1 of the position of taxel 1 is 'ten'"),
        ("x_m,y_m,z_m\n0,0,0\n7,0,0\n", "taxels are 7e.03 mm apart; .*: are positions in mm"),
        ("x_mm,y_mm,z_mm\n0,0,0\n0,0,0\n", "line 3: taxel 1 is at the same place as taxel 0"),
        ("x_mm,y_mm,z_mm,node\n0,0,0,1\n7,0,0,1.5\n", "line 3: the node of taxel 1 is '1.5'"),
        ("x_mm,y_mm,z_mm\n" + "0,0,0\n" * 65_537, "taxels has 65536 entries"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, text: str, cause: str) -> None:
    path = tmp_path / "places.csv"
    path.write_text(text)
    with pytest.raises(LayoutError, match=cause) as caught:
        read_layout(path, Wiring())
    assert str(caught.value).startswith(f"{path}")
