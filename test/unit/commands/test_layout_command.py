# SPDX-License-Identifier: Apache-2.0

"""`tactile-cdma layout`: text and picture."""

from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from tactile_cdma.commands.layout import draw_layout
from tactile_cdma.places.layout import Layout
from tactile_cdma.places.layout_file import read_layout
from tactile_cdma.places.layout_nodes import Wiring
from test.support.command_line import Printed, Refused

LAYOUTS = Path(__file__).resolve().parents[3] / "config" / "layouts"


def test_a_layout_is_told_in_numbers(printed: Printed) -> None:
    said = printed("layout", LAYOUTS / "list.yaml").out
    for words in ("pad: irregular, 19 taxels, 20 nodes", "neighbours of a taxel: 3…6", "node 20"):
        assert words in said


def test_a_skin_in_pieces_is_told(tmp_path: Path, printed: Printed) -> None:
    head = "schema: tactile_cdma/layout\nversion: 1\nshape: list\n"
    places = [(x, y) for x in (0, 8, 16) for y in (0, 2, 4, 6)]
    taxels = "".join(
        f"  - {{position_mm: [{x}, {y}, 0], node: {n}}}\n" for n, (x, y) in enumerate(places, 1)
    )
    path = tmp_path / "tip.yaml"
    path.write_text(f"{head}taxels:\n{taxels}")
    assert "in 3 pieces of 4, 4, 4 taxels" in printed("layout", path).out
    path.write_text(f"{head}pitch_mm: [8, 2]\ntaxels:\n{taxels}")
    said = printed("layout", path, "--png", tmp_path / "tip.png").out
    assert "pieces of" not in said
    assert "pitch 8 × 2 mm" in said
    assert "area 1.92 cm², 16…16 mm² each" in said


def test_a_layout_fits_its_parameters(tmp_path: Path, printed: Printed, refused: Refused) -> None:
    params = tmp_path / "skin.yaml"
    params.write_text("/**:\n  ros__parameters:\n    nodes: 24\n")
    said = refused("layout", LAYOUTS / "sphere.yaml", "--params", params)
    assert "node 25, but the skin has 24 nodes" in said
    params.write_text("/**:\n  ros__parameters:\n    nodes: 25\n")
    printed("layout", LAYOUTS / "sphere.yaml", "--params", params)


def taxel_colours(path: Path) -> set[tuple[int, ...]]:
    pixels = (matplotlib.image.imread(path)[..., :3] * 255).round().astype(int)
    colours, counts = np.unique(pixels.reshape(-1, 3), axis=0, return_counts=True)
    return {tuple(colour) for colour in colours[counts > 1000].tolist()}


@pytest.mark.parametrize("name", ["grid", "cylinder", "sphere", "list"])
def test_pictures_are_to_scale_and_the_same(name: str, tmp_path: Path, printed: Printed) -> None:
    for out in ("a.png", "b.png"):
        printed("layout", LAYOUTS / f"{name}.yaml", "--png", tmp_path / out)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    height, width = matplotlib.image.imread(tmp_path / "a.png").shape[:2]
    across = {"grid": 4, "cylinder": 12, "sphere": 5, "list": 5}[name]
    bent = name in ("cylinder", "sphere")
    # 0.6 inches of 100 dots per pitch, margins, and the shape in space beside it.
    assert width == pytest.approx(max(60 * across, 300) + 120 + 450 * bent, abs=2)
    assert height >= 450 * bent + 140


def test_taxels_have_the_colour_of_their_normals_and_many_no_numbers(tmp_path: Path) -> None:
    flat, path = Layout.grid(4, 2, 2, 7e-3, 7e-3), tmp_path / "flat.png"
    draw_layout(flat, path, first_row=1)
    assert taxel_colours(path) == {(255, 255, 255), (128, 128, 255)}
    path = tmp_path / "large.png"
    draw_layout(Layout.grid(150 * 150, 150, 150, 2e-3, 2e-3), path, first_row=1)
    assert max(matplotlib.image.imread(path).shape) < 4300


@pytest.mark.parametrize("name", ["grid", "cylinder", "sphere", "list", "mesh"])
def test_a_table_of_places_is_the_same_layout(name: str, tmp_path: Path, printed: Printed) -> None:
    table = tmp_path / "places.csv"
    printed("layout", LAYOUTS / f"{name}.yaml", "--table", table)
    before, after = (read_layout(path, Wiring()) for path in (LAYOUTS / f"{name}.yaml", table))
    real = before.nodes > 0
    assert after.nodes.tolist() == before.nodes[real].tolist()
    np.testing.assert_allclose(after.positions_m, before.positions_m[real], atol=1e-8)
    np.testing.assert_allclose(after.normals, before.normals[real], atol=1e-6)


def test_an_unwritable_picture_is_an_error(tmp_path: Path, printed: Printed) -> None:
    out = tmp_path / "none" / "out.png"
    said = printed("layout", LAYOUTS / "grid.yaml", "--png", out, code=1).err
    assert f"{out}: No such file or directory" in said


def test_a_picture_does_not_replace_its_layout(tmp_path: Path, refused: Refused) -> None:
    layout = tmp_path / "grid.yaml"
    text = (LAYOUTS / "grid.yaml").read_text()
    layout.write_text(text)
    said = refused("layout", layout, "--png", tmp_path / "." / "grid.yaml")
    assert "would overwrite the layout" in said
    assert layout.read_text() == text
