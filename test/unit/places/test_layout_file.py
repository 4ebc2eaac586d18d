# SPDX-License-Identifier: Apache-2.0

"""Layout files, tables of places, taxels on a robot's parts: their layouts, and what is refused."""

import re
import struct
from itertools import pairwise, product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.base.errors import LayoutError, SpecError
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.places.layout import Layout
from tactile_cdma.places.layout_file import read_layout
from tactile_cdma.places.layout_nodes import Wiring
from tactile_cdma.places.surface_file import read_link, read_triangles
from tactile_cdma.readings.status import Status
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.words.words import silent
from test.support.examples import examples
from test.support.simulated import run, stream

EXAMPLES = sorted((Path(__file__).resolve().parents[3] / "config" / "layouts").glob("*.yaml"))
HEAD = "schema: tactile_cdma/layout\nversion: 1\n"
GRID = HEAD + "shape: grid\nrows: 2\ncolumns: 3\npitch_mm: 7\n"
LIST = HEAD + "shape: list\n"


def written(folder: Path, text: str) -> Path:
    path = folder / "skin.yaml"
    path.write_text(text)
    return path


def list_of(*places: str, head: str = "") -> str:
    """A list of these taxels; head: its other keys."""
    return LIST + head + "taxels:\n" + "".join(f"  - {{{place}}}\n" for place in places)


def at(x_mm: float, node: int | str) -> str:
    """A taxel of a list, on the x axis."""
    return f"position_mm: [{x_mm}, 0, 0], node: {node}"


def test_a_grid_file_is_the_grid_of_the_parameters(tmp_path: Path) -> None:
    layout = read_layout(written(tmp_path, GRID), Wiring(nodes=6))
    grid = Layout.grid(6, 2, 3, 7e-3, 7e-3)
    for name in ("positions_m", "normals", "areas_m2", "flat_m", "nodes"):
        assert np.array_equal(getattr(layout, name), getattr(grid, name)), name
    assert (layout.name, layout.rows, layout.columns) == ("skin", 2, 3)
    assert layout.source is None


def test_a_list_stands_where_it_says(tmp_path: Path) -> None:
    text = list_of(
        "position_mm: [0, 0, 0], node: 4",
        "position_mm: [5, 0, 1], node: 1, normal: [0, 3, 4], area_mm2: 20",
        "position_mm: [0, 5, 0], node: 3",
        head="name: odd\nunplaced: [2]\nmasked: [3]\n",
    )
    layout = read_layout(written(tmp_path, text), Wiring(nodes=4))
    assert (layout.name, layout.rows, layout.columns, layout.irregular) == ("odd", 1, 3, True)
    assert np.allclose(layout.positions_m, [[0, 0, 0], [5e-3, 0, 1e-3], [0, 5e-3, 0]])
    assert np.allclose(layout.normals, [[0, 0, 1], [0, 0.6, 0.8], [0, 0, 1]])
    assert layout.nodes.tolist() == [4, 1, 3]
    assert (layout.masked, layout.unplaced, layout.wired) == ((3,), (2,), 4)
    assert layout.pitch_m == pytest.approx(5e-3)
    assert layout.areas_m2[1] == pytest.approx(20e-6)


def test_a_list_is_drawn_as_seen_from_outside(tmp_path: Path) -> None:
    """Seen against the normals x is to the right and y is up."""
    side = list_of(  # a wall in the plane x = 0 whose outside is at x > 0
        "position_mm: [0, 0, 0], normal: [1, 0, 0], node: 1",
        "position_mm: [0, 7, 0], normal: [1, 0, 0], node: 2",
        "position_mm: [0, 0, 7], normal: [1, 0, 0], node: 3",
    )
    flat = read_layout(written(tmp_path, side), Wiring()).flat_m
    assert np.allclose(flat, [[0, 0], [0, 7e-3], [-7e-3, 0]], atol=1e-9)


def test_code_rows_count_from_the_first_row_and_an_area_is_for_all(tmp_path: Path) -> None:
    text = GRID + "code_rows: [[0, 1, ~], [4, 3, 2]]\n"
    layout = read_layout(written(tmp_path, text), Wiring(nodes=5, first_row=0))
    assert layout.nodes.tolist() == [1, 2, 0, 5, 4, 3]
    rows = list_of(at(0, 9), at(9, 8)).replace("node", "code_row")
    layout = read_layout(written(tmp_path, rows), Wiring(first_row=8))
    assert layout.nodes.tolist() == [2, 1]
    layout = read_layout(written(tmp_path, GRID + "area_mm2: 30\n"), Wiring())
    assert np.allclose(layout.areas_m2, 30e-6)


def test_a_wrap_around_layout_reads_the_same_forces_anywhere_in_the_order(tmp_path: Path) -> None:
    """Permuted nodes give permuted arrays, through the whole chain."""
    rng = np.random.default_rng(3)
    nodes = np.append(rng.permutation(16) + 1, [0, 0]).reshape(3, 6)
    text = GRID.replace("rows: 2", "rows: 3").replace("columns: 3", "columns: 6")
    path = written(tmp_path, text + f"nodes: {nodes.tolist()}\nmasked: [5]\n")
    plain = SkinConfig.of({})
    data = stream(plain, "sim://?scene=all&seed=3&threshold=0", 10)
    placed = run(SkinConfig.of({"layout_file": str(path)}), data)
    order, read = nodes.ravel() - 1, run(plain, data)
    assert len(placed) == len(read) >= 8
    for ours, theirs in zip(placed, read, strict=True):
        masked = (nodes.ravel() == 5) | (nodes.ravel() == 0)
        for name in ("pressure_pa", "voltage_v", "status"):
            values = getattr(ours.readings, name)
            assert values.shape == (18,)
            expected = getattr(theirs.readings, name)[order]
            assert np.array_equal(values[~masked], expected[~masked])
        assert np.isnan(ours.readings.pressure_pa[masked]).all()
        assert np.isnan(ours.readings.voltage_v[masked]).all()
        assert (ours.readings.status[masked] == Status.MASKED).all()
        assert not np.isnan(ours.readings.pressure_pa[~masked]).any()


def test_nodes_out_of_service_or_without_a_place_are_not_missed(tmp_path: Path) -> None:
    places = (at(7 * n, n) for n in (1, 2, 4))
    path = written(tmp_path, list_of(*places, head="masked: [2]\nunplaced: [3]\n"))
    pipeline = Pipeline(SkinConfig.of({"nodes": 4, "layout_file": str(path)}))
    read = pipeline.taxels.update(silent(4, 0.0), 10.0, pipeline.health)
    assert len(read.pressure_pa) == len(read.voltage_v) == len(read.status) == 3
    assert pipeline.taxels.missing == [1, 4]
    assert pipeline.taxels.in_service == 2


def test_the_simulator_presses_on_the_unrolled_skin(tmp_path: Path) -> None:
    text = GRID + "nodes: [[6, 5, 4], [1, 2, 0]]\nunplaced: [3, 7]\n"
    options = SimOptions.from_url(f"sim://?scene=press&layout={written(tmp_path, text)}")
    assert options.setup().spec.nodes == 7, "as many as the layout says"
    skin = options.skin(7)
    x, y = skin.positions_m.T * 1e3
    assert np.allclose(x[[5, 4, 3, 0, 1]], [-7, 0, 7, -7, 0])
    assert np.allclose(y[[5, 4, 3, 0, 1]], [3.5, 3.5, 3.5, -3.5, -3.5])
    for query in ("rows=2", "nodes=8"):
        with pytest.raises(SpecError):
            SimOptions.from_url(f"sim://?{query}&layout={tmp_path / 'skin.yaml'}")


def test_the_simulator_is_centred_on_the_skin(tmp_path: Path) -> None:
    places = list_of(*(at(100 + 7 * n, 4 - n) for n in range(4)))
    path = written(tmp_path, places.replace(", 0, 0]", ", 50, 0]"))
    skin = SimOptions.from_url(f"sim://?layout={path}").skin(4)
    assert np.allclose(skin.positions_m * 1e3, [[10.5, 0], [3.5, 0], [-3.5, 0], [-10.5, 0]])
    assert skin.pitch_m == pytest.approx(7e-3)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_the_examples_are_for_skins_that_exist(path: Path) -> None:
    layout = read_layout(path, Wiring())
    assert layout.name != path.stem
    assert layout.neighbours.shape[1] > 3
    assert set(layout.raster.ravel()) - {-1} == set(np.flatnonzero(layout.nodes))
    assert yaml.safe_load(path.read_text())["shape"] == path.stem


def test_there_is_an_example_of_every_shape() -> None:
    assert {path.stem for path in EXAMPLES} == {"grid", "cylinder", "sphere", "mesh", "list"}


ONE = at(0, 1)
HEAP = list_of(*(at(round(n * 1e-5, 5), n) for n in range(1, 3000)), head="pitch_mm: 7\n")
BENT = "shape: cylinder\nrows: 2\ncolumns: 9\npitch_mm: 7\n"
NODES, ROWS = GRID + "nodes: ", GRID + "code_rows: "
REFUSED = {
    # what it is
    "another schema": ("schema: 1\nversion: 1\n", ["line 1", "schema is '1'", "layout"]),
    "no schema": ("shape: grid\n", ["has no 'schema'"]),
    "newer": (GRID.replace("version: 1", "version: 2"), ["line 2", "version is 2", "update"]),
    "another skin": (GRID + "skin: left\n", ["line 7", "'left'", "'right'"]),
    "shape": (HEAD + "shape: cube\n", ["line 3", "'cube'", "grid, cylinder, sphere, mesh, list"]),
    "no shape": (HEAD, ["has no 'shape'"]),
    "misspelt": (GRID + "node: []\n", ["line 7", "'node'", "did you mean 'nodes'"]),
    "key of another shape": (GRID + "radius_mm: 3\n", ["line 7", "unknown key 'radius_mm'"]),
    # numbers
    "no rows": (GRID.replace("rows: 2\n", ""), ["has no 'rows'"]),
    "fraction": (GRID.replace("rows: 2", "rows: 2.5"), ["line 4", "'2.5'", "whole number"]),
    "none at all": (GRID.replace("rows: 2", "rows: 0"), ["line 4", "rows is 0", "1…65535"]),
    "infinite": (GRID.replace("pitch_mm: 7", "pitch_mm: .inf"), ["line 6", "must be finite"]),
    "pitch in metres": (GRID.replace("pitch_mm: 7", "pitch_mm: 0.007"), ["0.01…1000 mm"]),
    "too large": (GRID.replace("rows: 2", "rows: 65000"), ["195000 taxels", "65535"]),
    "area": (GRID + "area_mm2: 50\n", ["line 7", "area_mm2 is 50", "49.05 mm²"]),
    # nodes of grids
    "rows of nodes": (NODES + "[[1, 2, 3]]", ["line 7", "nodes has 1 rows; rows is 2"]),
    "columns of nodes": (NODES + "[[1, 2, 3],\n [4, 5]]", ["line 8", "2 entries; it must have 3"]),
    "doubled": (
        GRID + "nodes:\n - [1, 2, 3]\n - [4, 2, 5]\n",
        ["line 9", "taxel 4 (row 1, column 1)", "node 2", "taxel 1 (row 0, column 1)", "line 8"],
    ),
    "negative": (NODES + "[[1, 2, 3], [4, -5, 6]]", ["taxel 4", "-5", "1…65535"]),
    "gap": (NODES + "[[1, 2, 3], [4, 0, 6]]", ["no place for node 5 of the skin's 6", "unplaced"]),
    "beyond": (NODES + "[[1, 2, 3], [4, 5, 7]]", ["taxel 5", "node 7", "6 nodes"]),
    "empty": (NODES + "[[0, 0, 0], [0, 0, 0]]", ["no taxel has a node"]),
    "both": (NODES + "[]\ncode_rows: []", ["line 8", "leave one out"]),
    "row 0": (
        ROWS + "[[0, 1, 2], [3, 4, 5]]",
        ["line 7", "taxel 0", "code row 0", "node 1 has row 1"],
    ),
    "row beyond": (ROWS + "[[1, 2, 3], [4, 5, 60]]", ["taxel 5", "node 60", "code rows 1…6"]),
    "no row": (ROWS + "[[1, 2, 3], [4, 5, x]]", ["taxel 5", "'x'", "whole number"]),
    "masked twice": (GRID + "masked: [2, 2]\n", ["line 7", "masked lists node 2 twice"]),
    "masked nobody": (GRID + "masked: [7]\n", ["line 7", "node 7", "behind no taxel"]),
    "unplaced but placed": (GRID + "unplaced: [3]\n", ["line 7", "node 3", "behind taxel 2"]),
    "unplaced beyond": (GRID + "unplaced: [7]\n", ["line 7", "node 7", "6 nodes"]),
    # bent ones
    "no radius": (HEAD + BENT, ["has no 'radius_mm'"]),
    "round twice": (HEAD + BENT + "radius_mm: 5\n", ["line 7", "go round more than once"]),
    "beyond the ball": (
        HEAD + BENT.replace("cylinder", "sphere") + "radius_mm: 10\n",
        ["line 7", "hemisphere"],
    ),
    # lists
    "no taxels": (LIST, ["has no 'taxels'"]),
    "empty list": (LIST + "taxels: []\n", ["line 4", "0 entries"]),
    "no list": (LIST + "taxels: 3\n", ["line 4", "taxels is '3'; it must be a list"]),
    "no entry": (LIST + "taxels: [3]\n", ["line 4", "taxel 0 is '3'"]),
    "one": (list_of(ONE), ["give pitch_mm"]),
    "flat position": (
        list_of("position_mm: [0, 0], node: 1"),
        ["line 5", "position of taxel 0 has 2 entries; it must have 3"],
    ),
    "no position": (list_of("node: 1"), ["line 5", "taxel 0 has no 'position_mm'"]),
    "far away": (list_of("position_mm: [0, 1e6, 0], node: 1"), ["-100000…100000 mm"]),
    "no normal": (
        list_of(ONE, at(7, 2) + ", normal: [0, 0, 0]"),
        ["line 6", "normal of taxel 1", "length is 0"],
    ),
    "no area": (list_of(ONE + ", area_mm2: 0"), ["line 5", "area of taxel 0 is 0"]),
    "no node": (list_of("position_mm: [0, 0, 0]"), ["line 5", "taxel 0 needs a node or"]),
    "node and row": (list_of(ONE + ", code_row: 1"), ["line 5", "not both"]),
    "node 0": (list_of(at(0, 0)), ["line 5", "node of taxel 0 is 0"]),
    "node twice": (
        list_of(ONE, at(7, 1)),
        ["line 6", "taxel 1 has node 1", "taxel 0 already (line 5)"],
    ),
    "same place": (list_of(ONE, at(0, 2)), ["line 6", "taxel 1 is at the same place as taxel 0"]),
    "too near": (
        list_of(*(at(x_mm, n) for n, x_mm in enumerate([0, 7, 14, 15, 22, 29], 1))),
        ["line 8", "taxel 3 is 1 mm from taxel 2", "quarter of the pitch of 7 mm"],
    ),
    "piled up": (HEAP, ["on top of each other"]),
    "in metres": (list_of(ONE, at(0.007, 2)), ["0.007 mm apart", "are positions in mm"]),
    "misspelt in a list": (
        list_of("positon_mm: [0, 0, 0], node: 1"),
        ["line 5", "taxel 0", "did you mean 'position_mm'"],
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_bad_files_are_refused_with_line_taxel_and_cause(name: str, tmp_path: Path) -> None:
    text, words = REFUSED[name]
    path = written(tmp_path, text)
    nodes = 6 if "columns: 3" in text else None
    with pytest.raises(LayoutError) as caught:
        read_layout(path, Wiring(nodes=nodes, skin="right"))
    for word in [str(path), *words]:
        assert word in str(caught.value)


TEXTS = [path.read_text() for path in EXAMPLES]
VALUES = ["", "~", "0", "-1", "1e9", "0.001", "nan", "[]", "[[0]]", "{}", "'1'", "x", "99999"]


@examples(300)
@given(st.sampled_from(TEXTS), st.data())
def test_any_file_is_read_or_refused(text: str, data: st.DataObject) -> None:
    """Random edits of values, lines and characters give a LayoutError or a valid layout."""
    numbers = list(re.finditer(r"-?[\d.]+|\w+$", text, re.MULTILINE))
    for _ in range(data.draw(st.integers(1, 2))):
        place = data.draw(st.sampled_from(numbers))
        text = text[: place.start()] + data.draw(st.sampled_from(VALUES)) + text[place.end() :]
    lines = text.splitlines(keepends=True)
    if data.draw(st.booleans()):
        lines.insert(data.draw(st.integers(0, len(lines))), data.draw(st.sampled_from(lines)))
    if data.draw(st.booleans()):
        lines.pop(data.draw(st.integers(0, len(lines) - 1)))
    with TemporaryDirectory() as folder:
        path = written(Path(folder), "".join(lines))
        try:
            layout = read_layout(path, Wiring())
        except LayoutError as error:
            assert str(error).startswith(str(path))
            return
    real = layout.nodes[layout.nodes > 0].tolist()
    assert sorted([*real, *layout.unplaced]) == list(range(1, layout.wired + 1))
    assert set(layout.masked) <= set(real)
    assert np.isfinite(layout.positions_m).all()
    assert np.allclose(np.linalg.norm(layout.normals, axis=1), 1, atol=1e-5)
    assert (layout.areas_m2 > 0).all()
    assert len(layout.neighbours) == len(layout) == layout.rows * layout.columns


def test_a_layout_of_another_number_of_nodes_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, GRID)
    with pytest.raises(LayoutError, match=r"nodes 7, 8, 9.*, 16 of the skin's 16; place"):
        SkinConfig.of({"layout_file": str(path)})
    assert len(SkinConfig.of({"nodes": 6, "layout_file": str(path)}).layout) == 6


@pytest.mark.parametrize(("name", "value"), [("rows", 3), ("columns", 2), ("pitch_mm", 5.0)])
def test_parameters_against_the_file_are_refused(name: str, value: float, tmp_path: Path) -> None:
    values = {"nodes": 6, "layout_file": str(written(tmp_path, GRID))}
    with pytest.raises(SpecError, match=f"{name} is {value:g}, but . in layout_file"):
        SkinConfig.of({**values, name: value})
    SkinConfig.of({**values, "rows": 2, "columns": 3, "pitch_mm": 7.0})


PLACES_MM = [(0.0, 0.0, 0.0), (10.0, 5.0, 1.5), (20.0, 10.0, 0.0), (30.0, 0.0, -2.5)]
NORMALS = [(0, 0, 1), (0, 0.6, 0.8), (0, 0, 2), (1, 0, 1)]
ORDER = (3, 1, 4, 2)


def listed(path: Path, normals: bool, nodes: bool) -> Layout:
    """The layout that a YAML file says."""
    rows = []
    for index, (place, normal) in enumerate(zip(PLACES_MM, NORMALS, strict=True)):
        node = ORDER[index] if nodes else index + 1
        said = f", normal: {list(normal)}" if normals else ""
        rows.append(f"  - {{position_mm: {list(place)}, node: {node}{said}}}\n")
    path.write_text(LIST + "taxels:\n" + "".join(rows))
    return read_layout(path, Wiring())


def table(heading: str, separator: str, unit_mm: float, normals: bool, nodes: bool) -> str:
    lines = [heading]
    for index, (place, normal) in enumerate(zip(PLACES_MM, NORMALS, strict=True)):
        cells = [f"{one / unit_mm:.6g}" for one in place]
        cells += [f"{one}" for one in normal] * normals + [str(ORDER[index])] * nodes
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
    found = read_layout(tmp_path / name, Wiring())
    expected = listed(tmp_path / "list.yaml", normals, nodes)
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


def test_robots_may_be_those_of_packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    share, own = tmp_path / "install" / "share" / "hand", tmp_path / "own"
    share.mkdir(parents=True)
    own.mkdir()
    flat = {"rows": 2, "columns": 3, "pitch_mm": 3, "at_mm": "[0, 0, 9]", "out": "[0, 0, 1]"}
    on(share)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "install"))
    file = {"urdf": None, "link": None, "scale": 0.01, **flat}
    for origin in (
        {"mesh": "package://hand/cube.stl", **file},
        {"mesh": f"file://{share}/cube.stl", **file},
        {"urdf": "package://hand/hand.urdf", "link": "cube", **flat},
    ):
        assert np.allclose(on(own, **origin).positions_m[:, 2], 0.01), origin
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
def test_contradictory_meshes(name: str, content: str, words: str, tmp_path: Path) -> None:
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
