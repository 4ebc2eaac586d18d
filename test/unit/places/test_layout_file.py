# SPDX-License-Identifier: Apache-2.0

"""Layout files and tables of places: their layouts, nodes and taxels, and what is refused."""

import re
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


def test_code_rows_count_from_the_first_row(tmp_path: Path) -> None:
    text = GRID + "code_rows: [[0, 1, ~], [4, 3, 2]]\n"
    layout = read_layout(written(tmp_path, text), Wiring(nodes=5, first_row=0))
    assert layout.nodes.tolist() == [1, 2, 0, 5, 4, 3]
    rows = list_of(at(0, 9), at(9, 8)).replace("node", "code_row")
    layout = read_layout(written(tmp_path, rows), Wiring(first_row=8))
    assert layout.nodes.tolist() == [2, 1]


def test_an_area_is_for_all(tmp_path: Path) -> None:
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
def test_parameters_that_contradict_the_file_are_refused(
    name: str, value: float, tmp_path: Path
) -> None:
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
    path.write_text(
        "schema: tactile_cdma/layout\nversion: 1\nshape: list\ntaxels:\n" + "".join(rows)
    )
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
