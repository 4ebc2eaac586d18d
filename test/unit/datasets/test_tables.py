# SPDX-License-Identifier: Apache-2.0

"""Tables of bags: the skin's own frames as they were recorded, whatever stores and splits them."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from test.support.bags import BEGIN_NS, PERIOD_S, TAXELS, BagMaker, pressure_pa
from test.support.command_line import Printed, Refused

pytestmark = pytest.mark.xdist_group("datasets")
SECONDS = 1.6


def unknown_at_first(t_s: float) -> list[int]:
    return [2] if t_s < 0.3 else []


@pytest.fixture(scope="module", params=["mcap", "sqlite3"])
def bag(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    maker = BagMaker().skin("/skin", SECONDS, unknown_at_first).skin("/left_palm/skin", SECONDS)
    for seen_s, begins in ((0.4, True), (0.805, False), (1.0, True)):
        maker.add(seen_s, "/recording", "std_msgs/msg/Bool", data=begins)
    path = tmp_path_factory.mktemp(request.param) / "session"
    return maker.write(path, sqlite=request.param == "sqlite3")


def read(path: Path) -> dict[str, NDArray[Any]]:
    with np.load(path) as table:
        return dict(table)


def t_of(table: dict[str, NDArray[Any]]) -> NDArray[np.float64]:
    return np.asarray(table["wall_time_s"] - BEGIN_NS * 1e-9)


def test_every_patch_has_a_file_of_all_its_frames(
    bag: Path, tmp_path: Path, printed: Printed
) -> None:
    printed("export", bag, "-o", tmp_path / "out.npz")
    assert {path.name for path in tmp_path.iterdir()} == {"out.skin.npz", "out.left_palm.npz"}
    table = read(tmp_path / "out.skin.npz")
    frames = round(SECONDS / PERIOD_S)
    assert table["sequence"].tolist() == list(range(frames))
    assert table["pressure_pa"].dtype == np.float32
    expected = pressure_pa((np.arange(frames) + 0.5) * PERIOD_S)
    expected[t_of(table) < 0.3, 2] = np.nan
    assert table["pressure_pa"] == pytest.approx(expected, rel=1e-6, nan_ok=True)
    assert table["device_time_s"] == pytest.approx((np.arange(frames) + 0.5) * PERIOD_S)
    assert t_of(table) == pytest.approx(table["device_time_s"], abs=1e-6)
    assert np.isnan(table["voltage_v"]).all()  # was not published
    assert table["status"][0].tolist() == [0, 0, 8] + [0] * 13
    assert table["shape"].tolist() == [4, 4]
    assert table["position_m"][:, 0] == pytest.approx(0.007 * np.arange(TAXELS))
    about = json.loads(str(table["about"]))
    said = {"measured_by": "simulated", "skin": "palm-1", "calibration_id": "abcd1234"}
    assert about | said | {"topic": "/skin/tactile", "frame_id": "palm", "tared": False} == about


def test_bounds_marks_and_completeness(bag: Path, tmp_path: Path, printed: Printed) -> None:
    def chosen(name: str, *options: str) -> dict[str, NDArray[Any]]:
        printed("export", bag, "-o", tmp_path / name, "--topic", "/skin/tactile", *options)
        return read(tmp_path / name)

    part = chosen("part.npz", "--start", "0.5", "--end", "1.1")
    assert 0.5 <= t_of(part)[0] < 0.5 + PERIOD_S and 1.1 - PERIOD_S < t_of(part)[-1] <= 1.1
    complete = chosen("complete.npz", "--from-first-complete")
    assert 0.3 <= t_of(complete)[0] < 0.3 + PERIOD_S
    assert np.isfinite(complete["pressure_pa"]).all()
    marked = chosen("marked.npz", "--marks", "/recording")
    for episode, (begin_s, end_s) in enumerate(((0.4, 0.805), (1.0, SECONDS))):
        t_s = t_of(marked)[marked["episode"] == episode]
        assert begin_s <= t_s[0] < begin_s + PERIOD_S and end_s - PERIOD_S < t_s[-1] <= end_s
    given = chosen("given.npz", "--episode", "0.1:0.2", "--episode", "1:1.1")
    assert np.bincount(given["episode"]).tolist() == [8, 8]


def test_a_bag_s_file_alone_and_many_files(bag: Path, tmp_path: Path, printed: Printed) -> None:
    [file] = [path for path in bag.iterdir() if path.suffix in (".mcap", ".db3")]
    printed("export", file, bag, "-o", tmp_path / "two.npz", "--topic", "/skin/tactile")
    table = read(tmp_path / "two.npz")
    assert np.bincount(table["episode"]).tolist() == [round(SECONDS / PERIOD_S)] * 2
    assert json.loads(str(table["about"]))["files"] == [file.name, bag.name]


def test_csv_and_parquet_hold_the_same_as_npz(bag: Path, tmp_path: Path, printed: Printed) -> None:
    words = "export", bag, "--topic", "/skin/tactile", "-o"
    printed(*words, tmp_path / "out.npz")
    printed(*words, tmp_path / "out.csv")
    expected = read(tmp_path / "out.npz")
    with (tmp_path / "out.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    kinds = {name: array.dtype for name, array in expected.items()}
    taxels = ("pressure_pa", "voltage_v", "status")
    for name in taxels:
        cells = [[row[f"{name}_{i}"] or "nan" for i in range(TAXELS)] for row in rows]
        assert np.array(cells, dtype=kinds[name]).tobytes() == expected[name].tobytes()
    assert rows[0]["pressure_pa_2"] == "", "NaN"
    frame = ("sequence", "device_time_s", "wall_time_s", "noise_v", "episode")
    for name in frame:
        cells = [row[name] for row in rows]
        assert np.array(cells, dtype=kinds[name]).tobytes() == expected[name].tobytes()
    with (tmp_path / "out.taxels.csv").open(newline="") as file:
        x_m = [np.float32(row["x_m"]) for row in csv.DictReader(file)]
    assert x_m == expected["position_m"][:, 0].tolist()
    parquet = pytest.importorskip("pyarrow.parquet")
    printed(*words, tmp_path / "out.parquet")
    found = parquet.read_table(tmp_path / "out.parquet")
    for name in (*frame, *taxels):
        cells = np.array(found.column(name).to_pylist(), dtype=kinds[name])
        assert cells.tobytes() == expected[name].tobytes()


@pytest.mark.parametrize("is_there", [False, True], ids=["none", "of another type"])
def test_a_patch_without_info_has_unknown_places(
    tmp_path: Path, printed: Printed, is_there: bool
) -> None:
    maker = BagMaker().skin("/skin", 0.3).without("/skin/info")
    if is_there:
        maker.add(0.0, "/skin/info", "std_msgs/msg/String", data="left palm")
    said = printed("export", maker.write(tmp_path / "bag"), "-o", tmp_path / "out.npz").err
    assert "no info, so places and calibration are unknown" in said
    table = read(tmp_path / "out.npz")
    assert np.isnan(table["position_m"]).all() and not table["node"].any()
    assert table["pressure_pa"].shape == (round(0.3 / PERIOD_S), TAXELS)


@pytest.mark.parametrize(
    ("taxels", "field"), [(20, "pressure"), (9, "pressure"), (0, "pressure"), (3, "status")]
)
def test_frames_of_another_size_are_refused(
    tmp_path: Path, refused: Refused, taxels: int, field: str
) -> None:
    """A shorter or longer row would shift all that follow it."""
    maker = BagMaker().skin("/skin", 1.2)
    for message in maker.of("/skin/tactile")[80:]:
        message.status = np.zeros(taxels, dtype=np.uint8)
        if field == "pressure":
            message.pressure = np.arange(taxels, dtype=np.float32)
    bag = maker.write(tmp_path / "bag")
    for name in ("out.npz", "out.csv"):
        said = refused("export", bag, "-o", tmp_path / name)
        assert f"/skin/tactile: {taxels} values of {field} in frame 80 of a patch of 16" in said
    assert [path.name for path in tmp_path.iterdir()] == ["bag"]


def test_a_patch_without_taxels_is_refused(tmp_path: Path, refused: Refused) -> None:
    maker = BagMaker().skin("/skin", 0.3)
    for message in maker.of("/skin/tactile"):
        message.pressure, message.status = np.zeros(0, np.float32), np.zeros(0, np.uint8)
    said = refused("info", maker.write(tmp_path / "bag"))
    assert "/skin/tactile: its first frame has no taxels" in said


def other_skin(path: Path, skin: str = "/skin", /, **fields: Any) -> Path:
    """A bag whose skin differs by some fields of its info."""
    maker = BagMaker().skin(skin, 0.2)
    for name, value in fields.items():
        setattr(maker.messages[0][3], name, value)
    return maker.write(path)


@pytest.mark.parametrize(
    ("node", "fields", "message"),
    [
        ("/skin", {"node": np.arange(TAXELS, 0, -1, dtype=np.uint16)}, "nodes of the taxels"),
        ("/skin", {"area": np.full(TAXELS, 1e-6, dtype=np.float32)}, "areas of the taxels"),
        ("/skin", {"origin": 1}, "origin of patch skin is 'board', in the first file 'sim"),
        ("/skin", {"measured_by": 1}, "measured_by of patch skin is 'board'"),
        ("/skin", {"calibration_id": "other"}, "calibration_id of patch skin is 'other'"),
        ("/left_palm/skin", {}, "its patches are left_palm, in the first file skin"),
    ],
)
def test_files_of_different_skins_are_not_one_table(
    tmp_path: Path, refused: Refused, node: str, fields: dict[str, Any], message: str
) -> None:
    first, other = other_skin(tmp_path / "first"), other_skin(tmp_path / "other", node, **fields)
    said = refused("export", first, other, "-o", tmp_path / "out.npz")
    assert f"{other}: {message}" in said and "export them one by one" in said
    assert not (tmp_path / "out.npz").exists()


def test_rows_and_columns_of_files_must_agree(tmp_path: Path, refused: Refused) -> None:
    first, maker = other_skin(tmp_path / "first"), BagMaker().skin("/skin", 0.2)
    for message in maker.of("/skin/tactile"):
        message.height, message.width = 2, 8
    other = maker.write(tmp_path / "other")
    words, problem = ["export", first, other], "has 2 × 8 taxels, in the first file 4 × 4"
    assert problem in refused(*words, "-o", tmp_path / "out.npz")
    pytest.importorskip("pyarrow")
    assert problem in refused(*words, "--lerobot", tmp_path / "out", "--fps", "30")


@pytest.mark.parametrize(
    ("tares_pa", "tared"),
    [
        ([300.0, 300.0, 500.0, 500.0, 300.0], "changes"),
        ([None, None, 500.0, 500.0, None], "changes"),
        ([300.0, 300.0], True),
    ],
)
def test_a_tare_that_changes_within_a_bag_is_told(
    tmp_path: Path, printed: Printed, tares_pa: list[float | None], tared: object
) -> None:
    """One info after the other; None: of a skin that was not tared."""
    maker = BagMaker().skin("/skin", 1.0).without("/skin/info")
    for number, tare_pa in enumerate(tares_pa):
        [(time_ns, *rest, info)] = BagMaker().skin("/skin", 0.0).messages
        info.tare = np.full(TAXELS if tare_pa else 0, tare_pa or 0.0, dtype=np.float32)
        maker.messages.append((time_ns + number * 200_000_000, *rest, info))
    bag, note = maker.write(tmp_path / "bag"), "/skin/tactile: the tare changes within the bag"
    said = printed("export", bag, "-o", tmp_path / "out.npz").err
    assert (f"tactile-cdma: {bag}: {note}" in said) == bool(said) == (tared == "changes")
    assert printed("info", bag).out.count(note) == (tared == "changes")
    assert json.loads(str(read(tmp_path / "out.npz")["about"]))["tared"] == tared


def test_a_bag_whose_info_changes_says_so(tmp_path: Path, printed: Printed) -> None:
    maker, real = BagMaker(), BagMaker()
    maker.skin("/skin", 1.0)
    real.skin("/skin", 0.0, simulated=False)
    [(time_ns, *rest, info)] = real.messages
    info.calibration_id, info.node = "other", info.node[::-1].copy()
    maker.messages.append((time_ns + 500_000_000, *rest, info))
    bag = maker.write(tmp_path / "bag")
    said = printed("info", bag).out
    assert "measured by: simulated, then board" in said and "no sensor" not in said
    assert "calibration: abcd1234, then other" in said
    assert "note: /skin/tactile: its taxels change within the bag" in said
    said = printed("export", bag, "-o", tmp_path / "out.npz").err
    assert "measured_by changes within the bag" in said
    about = json.loads(str(read(tmp_path / "out.npz")["about"]))
    assert about["origin"] == "simulated, then board" and about["skin"] == "palm-1"
