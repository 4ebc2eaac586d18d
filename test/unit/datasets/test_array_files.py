# SPDX-License-Identifier: Apache-2.0

"""HDF5 and Zarr, read as robomimic and diffusion policies read them: what was recorded, or NaN."""

import io
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from test.support.bags import BEGIN_NS, PERIOD_S, TAXELS, BagMaker, pressure_pa
from test.support.command_line import Printed, Refused

h5py = pytest.importorskip("h5py", reason="the extra [learn] is not installed")
zarr = pytest.importorskip("zarr", reason="the extra [learn] is not installed")
parquet = pytest.importorskip("pyarrow.parquet", reason="the extra [learn] is not installed")

pytestmark = pytest.mark.xdist_group("datasets")
Arrays: TypeAlias = Mapping[str, NDArray[Any]]
SECONDS = 2.0
JOINTS = ("--state", "/joint_states", "--action", "/joint_states")
EPISODES = ("--episode", "0.2:0.8", "--episode", "1.0:1.9")


def unknown(t_s: float) -> list[int]:
    """Taxel 2 speaks late, and 3 is not read for a while, though all are pressed by 10 kPa."""
    return [2] if t_s < 0.5 else [3] if 1.2 < t_s < 1.5 else []


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    maker = BagMaker().skin("/skin", SECONDS, unknown).joints("/joint_states", SECONDS)
    maker.camera("/front/image_raw", SECONDS, 30).contacts("/skin", SECONDS, end_s=1.0)
    return maker.write(tmp_path_factory.mktemp("arrays") / "session")


def demos(path: Path) -> list[Arrays]:
    """Episodes in the order, and with the lengths, that robomimic's SequenceDataset finds."""
    with h5py.File(path, "r") as file:
        data = file["data"]
        assert {*json.loads(data.attrs["env_args"])} == {"env_name", "env_type", "env_kwargs"}
        names = sorted(data, key=lambda name: int(name[5:]))
        found = [
            {
                key: array[:]
                for part in (data[name], data[name]["obs"])
                for key, array in part.items()
                if isinstance(array, h5py.Dataset)
            }
            for name in names
        ]
        lengths = [data[name].attrs["num_samples"] for name in names]
        assert data.attrs["total"] == sum(lengths)
    for arrays, length in zip(found, lengths, strict=True):
        assert {len(array) for array in arrays.values()} == {length}
        assert arrays["dones"].tolist() == [0] * (length - 1) + [1]
        assert np.isnan(arrays["rewards"]).all()
    return found


def replay_buffer(path: Path) -> list[Arrays]:
    """Episodes as diffusion policies cut them: all in one array, and where each ends."""
    root = zarr.open(path, mode="r")
    ends = root["meta/episode_ends"][:]
    data = {name: array[:] for name, array in root["data"].arrays()}
    assert {len(array) for array in data.values()} == {ends[-1]}
    starts = [0, *ends[:-1]]
    return [
        {name: array[start:end] for name, array in data.items()}
        for start, end in zip(starts, ends, strict=True)
    ]


READ = {"hdf5": demos, "zarr": replay_buffer}


@pytest.mark.parametrize("kind", READ)
def test_a_table_has_the_frames_of_the_bag_and_nan_where_they_are_not_known(
    bag: Path, tmp_path: Path, printed: Printed, kind: str
) -> None:
    output = tmp_path / f"out.{kind}"
    printed("export", bag, "-o", output, *EPISODES)
    found = READ[kind](output)
    assert [round(len(one["sequence"]) * PERIOD_S, 1) for one in found] == [0.6, 0.9]
    for one in found:
        t_s = one["wall_time_s"] - BEGIN_NS * 1e-9
        expected, valid = pressure_pa(t_s), np.ones((len(t_s), TAXELS), dtype=bool)
        for row, at_s in enumerate(t_s):
            valid[row, unknown(at_s)] = False
        assert one["valid"].tolist() == valid.tolist()
        assert np.isnan(one["pressure_pa"]).tolist() == (~valid).tolist()
        assert one["pressure_pa"][valid] == pytest.approx(expected[valid], rel=1e-6)


@pytest.mark.parametrize("kind", READ)
def test_rows_on_a_clock_are_those_for_lerobot_but_for_nan(
    bag: Path, tmp_path: Path, printed: Printed, kind: str
) -> None:
    options = (*EPISODES, *JOINTS, "--fps", "30")
    output = tmp_path / f"out.{kind}"
    printed("export", bag, "-o", output, *options)
    printed("export", bag, "--lerobot", tmp_path / "lerobot", *options)
    table = parquet.read_table(tmp_path / "lerobot/data/chunk-000/file-000.parquet")
    episodes = np.array(table.column("episode_index"))
    seen = 0
    for number, one in enumerate(READ[kind](output)):
        rows = np.flatnonzero(episodes == number)
        for name in table.column_names[: table.column_names.index("timestamp")]:
            its = table.column(name).take(rows).to_pylist()
            short = name.removeprefix("observation.")
            array = one.get({"action": "actions"}.get(name, short), one.get(short))
            assert array is not None, name
            if name.startswith("observation.images"):
                pixels = [np.asarray(Image.open(io.BytesIO(file["bytes"]))) for file in its]
                assert array.dtype == np.uint8 and array.tobytes() == np.array(pixels).tobytes()
                continue
            expected = np.array(its).reshape(array.shape)
            if f"{name}.valid" in table.column_names:
                valid = one[f"{short}.valid"] == 1
                seen += np.count_nonzero(~valid)
                assert np.isnan(array).tolist() == (~valid).tolist()
                array, expected = array[valid], expected[valid]
            assert array.tolist() == expected.tolist(), name
    assert seen > 100, "there was something unknown"


def test_what_an_option_asks_for_stands_in_place_of_nan(
    bag: Path, tmp_path: Path, printed: Printed, refused: Refused
) -> None:
    output = tmp_path / "out.zarr"
    printed("export", bag, "-o", output, "--fps", "30", "--nan", "hold", "--samples", "last")
    [one] = replay_buffer(output)
    assert one["tactile.skin"].shape[1:] == (TAXELS,)
    assert not np.isnan(one["tactile.skin"]).any() and (one["tactile.skin.valid"] == 0).any()
    assert "exists already" in refused("export", bag, "-o", output, "--fps", "30")
    printed("export", bag, "-o", output, "--fps", "30", "--force")
    assert np.isnan(replay_buffer(output)[0]["tactile.skin"]).any()
    said = refused("export", bag, "--lerobot", tmp_path / "no", "--fps", "30", "--nan", "keep")
    assert "--nan keep is not for --lerobot" in said
    said = refused("export", bag, "-o", tmp_path / "out.hdf5", *JOINTS)
    assert "--state needs --fps or --clock beside it" in said


def test_places_and_what_is_known_of_the_skin_are_beside_the_data(
    bag: Path, tmp_path: Path, printed: Printed
) -> None:
    for kind in READ:
        printed("export", bag, "-o", tmp_path / f"out.{kind}")
    with h5py.File(tmp_path / "out.hdf5") as file:
        about = json.loads(file["about"][()])
    assert about == zarr.open(tmp_path / "out.zarr", mode="r").attrs["about"]
    assert about["measured_by"] == "simulated" and about["taxels"]["shape"] == [4, 4]
    assert np.array(about["taxels"]["position_m"])[:, 0] == pytest.approx(0.007 * np.arange(TAXELS))


@pytest.mark.parametrize(("kind", "library"), [("hdf5", "h5py"), ("zarr", "zarr")])
def test_a_missing_library_is_named_and_a_failure_leaves_nothing(
    bag: Path,
    tmp_path: Path,
    refused: Refused,
    monkeypatch: pytest.MonkeyPatch,
    kind: str,
    library: str,
) -> None:
    output = tmp_path / f"out.{kind}"
    said = refused("export", bag, "-o", output, "--start", "5", "--end", "6")
    assert "no frame" in said and not output.exists()
    output.mkdir() if kind == "zarr" else output.touch()
    said = refused("export", bag, "-o", output, *(["--force"] if kind == "zarr" else []))
    assert "exists" in said
    monkeypatch.setitem(sys.modules, library, None)
    said = refused("export", bag, "-o", tmp_path / f"other.{kind}")
    assert f"needs the Python package {library}, which is not installed" in said
    assert {path.name for path in tmp_path.iterdir()} == {output.name}
