# SPDX-License-Identifier: Apache-2.0

"""A bag as a LeRobotDataset v3: what pandas and pyarrow read is what was recorded, at its time."""

import io
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from tactile_cdma.commands.cli import main
from tactile_cdma.datasets.lerobot import writer
from tactile_cdma.sim.options import SimOptions
from test.support.bags import BEGIN_NS, PERIOD_S, TAXELS, BagMaker, pressure_pa
from test.support.command_line import Printed, Refused
from test.support.simulated import recording

pyarrow = pytest.importorskip("pyarrow", reason="the extra [learn] is not installed")
parquet = pytest.importorskip("pyarrow.parquet")

pytestmark = pytest.mark.xdist_group("datasets")  # its bag is made once
Capsys: TypeAlias = pytest.CaptureFixture[str]
Dataset: TypeAlias = tuple[Path, Any]
SECONDS = 3.0
FPS = 30
SKIN = "observation.tactile.skin"
PALM = "observation.tactile.left_palm"


def palm_invalid(t_s: float) -> Sequence[int]:
    """Taxel 5 speaks after half a second, taxel 3 is silent for a while, 9 and 10 for a moment."""
    if t_s < 0.5:
        return [5]
    return [3] if 1.0 < t_s < 1.2 else []


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    maker = BagMaker().skin("/skin", SECONDS)
    maker.skin("/left_palm/skin", SECONDS, palm_invalid)
    maker.camera("/front/image_raw", SECONDS, 30)
    maker.camera("/wrist/image_raw/compressed", SECONDS, 15, compressed=True)
    maker.joints("/joint_states", SECONDS)
    maker.contacts("/skin", SECONDS, end_s=2.0)
    for seen_s, text in ((0.7, "grip"), (1.5, ""), (2.0, "lift"), (2.6, "")):
        maker.add(seen_s, "/task", "std_msgs/msg/String", data=text)
    return maker.write(tmp_path_factory.mktemp("lerobot") / "session")


def exported(bag: Path, folder: Path, *options: str) -> Any:
    """The rows of the dataset, as pyarrow reads them."""
    fps = () if {"--clock", "--fps"} & {*options} else ("--fps", str(FPS))
    assert main(["export", str(bag), "--lerobot", str(folder), *fps, *options]) == 0
    return parquet.read_table(folder / "data/chunk-000/file-000.parquet")


@pytest.fixture(scope="module")
def dataset(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Everything that is in the bag, and the rows of it."""
    folder = tmp_path_factory.mktemp("dataset") / "out"
    joints = ("--state", "/joint_states", "--action", "/joint_states")
    return folder, exported(bag, folder, *joints, "--nan", "zero")


def array(table: Any, name: str) -> NDArray[Any]:
    values = np.array(table.column(name).to_pylist())
    if not name.endswith(".valid"):
        return values
    assert set(np.unique(values)) <= {0, 1}
    return values.astype(bool)


def seconds(table: Any) -> NDArray[np.float64]:
    """The rows' times, s after BEGIN_NS."""
    return (array(table, "unix_time_ns") - BEGIN_NS) * 1e-9


def meta(folder: Path, name: str) -> Any:
    return json.loads((folder / "meta" / name).read_text())


def episodes(folder: Path) -> Any:
    return parquet.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()


def reds(table: Any, camera: str) -> list[int]:
    """The number that each image shows; all of it is of that colour."""
    files = table.column(f"observation.images.{camera}").to_pylist()
    pixels = np.array([np.asarray(Image.open(io.BytesIO(file["bytes"]))) for file in files])
    assert pixels.shape == (len(table), 6, 8, 3) and (pixels == pixels[:, :1, :1]).all()
    assert (pixels[..., 1:] == [200, 0]).all()
    return pixels[:, 0, 0, 0].tolist()  # type: ignore[no-any-return]


def worst_error_s(found: NDArray[Any], t_s: NDArray[np.float64], valid: NDArray[Any]) -> float:
    """Largest error of time that explains found pressures, (…, 16), of which the time is t_s (…).

    The pressure rises by 1 Pa in 18 µs where it is steepest.
    """
    steepest_pa_s = 10e3 * 2 * np.pi * 0.9
    return float(np.abs(found - pressure_pa(t_s))[valid].max() / steepest_pa_s)


def test_every_sample_is_at_its_time_to_less_than_a_millisecond(dataset: Dataset) -> None:
    _, table = dataset
    ticks_s = seconds(table)
    assert np.diff(ticks_s) == pytest.approx(1 / FPS, abs=1e-6)
    for name in (SKIN, PALM):
        window, valid = array(table, name), array(table, f"{name}.valid")
        ages_s = array(table, f"{name}.age_s")
        assert window.shape == valid.shape == (len(table), 3, TAXELS)  # 33.3 ms, 12.8 ms a frame
        assert worst_error_s(window, ticks_s[:, None] - ages_s, valid) < 1e-3
        # The newest frame is less than a period old, and no frame of an interval is missing.
        assert (ages_s[:, -1] >= 0).all() and (ages_s[:, -1] < PERIOD_S + 1e-6).all()
        assert np.diff(ages_s[2:], axis=1) == pytest.approx(-PERIOD_S, abs=1e-5)
        assert (ages_s[2:, 0] > 1 / FPS - PERIOD_S - 1e-6).all()
        indices = np.unique(np.round((ticks_s[:, None] - ages_s) / PERIOD_S - 0.5))
        assert indices.tolist() == list(range(len(indices)))
    assert array(table, f"{SKIN}.valid")[2:].all()


def test_a_taxel_without_a_reading_is_held_zero_or_its_row_left_out(
    bag: Path, tmp_path: Path, capsys: Capsys
) -> None:
    only = ("--topic", "/left_palm/skin/tactile", "--samples", "last")
    held = exported(bag, tmp_path / "hold", *only)
    zero = exported(bag, tmp_path / "zero", *only, "--nan", "zero")
    measured_s = seconds(held) - array(held, f"{PALM}.age_s")
    silent = (measured_s > 1.0) & (measured_s < 1.2)
    assert 5 <= silent.sum() <= 7
    for table in (held, zero):
        valid = array(table, f"{PALM}.valid")
        assert (valid[:, 3] == ~silent).all()
        assert (valid[:, 5] == (measured_s >= 0.5)).all()
        assert np.delete(valid, [3, 5], axis=1).all()
    before_s = (np.floor(1.0 / PERIOD_S - 0.5) + 0.5) * PERIOD_S
    assert array(held, PALM)[silent, 3] == pytest.approx(pressure_pa(before_s)[3], rel=1e-6)
    assert (array(held, PALM)[measured_s < 0.5, 5] == 0).all()
    assert (array(zero, PALM)[silent, 3] == 0).all()
    whole = array(zero, PALM)[~silent & (measured_s > 0.5)]
    assert (whole == array(held, PALM)[~silent & (measured_s > 0.5)]).all()
    capsys.readouterr()

    dropped = exported(bag, tmp_path / "drop", *only, "--nan", "drop")
    said = capsys.readouterr()
    left = int(silent.sum() + (measured_s < 0.5).sum())
    assert f"left_out={left}" in said.out
    assert f"{left} rows are left out: a taxel of {PALM} had no valid reading" in said.err
    assert len(dropped) == len(held) - left
    assert array(dropped, f"{PALM}.valid").all()
    # Rows of an episode follow one another: where some were left out, another one begins.
    lengths = [episode["length"] for episode in episodes(tmp_path / "drop")]
    assert lengths == np.bincount(array(dropped, "episode_index")).tolist() and len(lengths) == 2
    for t_s in np.split(seconds(dropped), lengths[:1]):
        assert np.diff(t_s) == pytest.approx(1 / FPS, abs=1e-6)


def test_from_first_complete_begins_when_every_taxel_has_spoken(bag: Path, tmp_path: Path) -> None:
    table = exported(bag, tmp_path / "out", "--from-first-complete")
    assert 0.5 <= seconds(table)[0] < 0.5 + PERIOD_S + 1 / FPS
    assert not array(table, f"{PALM}.valid")[:, :, 3].all()  # what is silent later stays in


def test_a_taxel_that_never_speaks_is_named(
    tmp_path: Path, capsys: Capsys, refused: Refused
) -> None:
    bag = BagMaker().skin("/skin", 0.5, lambda t_s: [7]).write(tmp_path / "bag")
    exported(bag, tmp_path / "out")
    assert "skin: no valid reading of taxel 7" in capsys.readouterr().err
    options = ["--fps", "30", "--from-first-complete"]
    for output in (["--lerobot", tmp_path / "none"], ["-o", tmp_path / "none.npz"]):
        words = ["export", bag, *output, *(options if output[0] == "--lerobot" else options[2:])]
        assert "never complete: no valid reading of taxel 7; mask" in refused(*words)
        assert not Path(output[1]).exists()


def test_images_joints_and_actions_ride_along(dataset: Dataset) -> None:
    folder, table = dataset
    t_s = seconds(table)
    for name, rate_hz in (("front", 30), ("wrist", 15)):
        newest = np.minimum(np.floor(t_s * rate_hz - 0.25 + 1e-6), SECONDS * rate_hz - 1)
        assert reds(table, name) == newest.tolist()
    joints = array(table, "observation.state")
    assert (array(table, "action") == joints).all()
    newest_s = np.minimum(np.floor(t_s * 100 + 1e-6) / 100, SECONDS - 0.01)
    assert joints == pytest.approx(np.stack([newest_s, -newest_s], axis=1), abs=1e-6)
    features = meta(folder, "info.json")["features"]
    assert features["observation.state"]["names"] == ["finger", "wrist"]
    image = {"dtype": "image", "shape": [6, 8, 3], "names": ["height", "width", "channels"]}
    assert features["observation.images.front"] == image
    colours = meta(folder, "stats.json")["observation.images.front"]
    assert np.shape(colours["mean"]) == (3, 1, 1)
    assert np.ravel(colours["mean"])[1:] == pytest.approx([200 / 255, 0])


def test_contacts_and_wrench_are_zero_and_masked_where_they_are_unknown(dataset: Dataset) -> None:
    _, table = dataset
    t_s = seconds(table)
    measured_s = (np.floor(t_s / PERIOD_S - 0.5 + 1e-6) + 0.5) * PERIOD_S
    measured_s = np.minimum(measured_s, (round(2.0 / PERIOD_S) - 0.5) * PERIOD_S)
    known = (measured_s >= 1.0) & (t_s - measured_s <= 0.5)  # what is older is not the present
    assert (~known).any() and known.any() and not known[-1]
    force = np.where(known, -measured_s, 0)
    wrench, valid = (array(table, f"observation.wrench.skin{end}") for end in ("", ".valid"))
    assert wrench[:, 2] == pytest.approx(force, rel=1e-6)
    assert (valid[:, 2] == known).all()
    contacts, valid = (array(table, f"observation.contacts.skin{end}") for end in ("", ".valid"))
    assert (contacts[:, 0] == known).all()
    assert contacts[:, 4] == pytest.approx(np.where(known, 0.01, 0))
    assert (valid[:, 4] == known).all()


def test_a_camera_is_the_clock(bag: Path, tmp_path: Path) -> None:
    table = exported(bag, tmp_path / "out", "--clock", "/wrist/image_raw/compressed")
    assert meta(tmp_path / "out", "info.json")["fps"] == 15
    t_s = seconds(table)
    assert t_s == pytest.approx((np.arange(len(t_s)) + 0.25) / 15, abs=1e-6)
    assert array(table, SKIN).shape[1] == 6  # 66.7 ms, 12.8 ms a frame
    pressures, ages_s, valid = (array(table, f"{SKIN}{end}") for end in ("", ".age_s", ".valid"))
    assert worst_error_s(pressures, t_s[:, None] - ages_s, valid) < 1e-3
    assert reds(table, "wrist") == list(range(len(table)))


def test_vectors_are_the_clock(bag: Path, tmp_path: Path) -> None:
    folder, joints = tmp_path / "out", "/joint_states"
    options = "--clock", joints, "--state", joints, "--action", joints
    table = exported(bag, folder, *options, "--image", "/front/image_raw")
    assert meta(folder, "info.json")["fps"] == 100
    assert meta(folder, "tactile.json")["clock"] == joints
    t_s = seconds(table)
    assert len(t_s) > 250 and t_s == pytest.approx(t_s[0] + np.arange(len(t_s)) / 100, abs=1e-6)
    assert array(table, "observation.state")[:, 0] == pytest.approx(t_s, abs=1e-6)


@pytest.mark.parametrize("rate_hz", [29.97, 30.0])
def test_a_clock_of_no_whole_rate_is_told(tmp_path: Path, printed: Printed, rate_hz: float) -> None:
    """LeRobot's fps are whole, so that its timestamps are not those of the clock."""
    maker = BagMaker().skin("/skin", 6.0).camera("/front/image", 6.0, rate_hz)
    maker.without("/front/image", 20, 21, 50)
    bag, out = maker.write(tmp_path / "bag"), tmp_path / "out"
    said = printed("export", bag, "--lerobot", out, "--clock", "/front/image").err
    assert meta(out, "info.json")["fps"] == 30
    told = "/front/image has 29.97 messages per s"
    told += ", and LeRobot wants a whole number: timestamp counts 30, and is 0.10% slow"
    assert (told in said) == (rate_hz != 30) and ("messages per s" in said) == (rate_hz != 30)


def stopping(*stops: tuple[str, float, float]) -> BagMaker:
    """Six seconds in which topics are silent between two times, s."""
    maker = BagMaker().skin("/skin", 6.0).camera("/front/image", 6.0, 30).joints("/joints", 6.0)
    for topic, begin_s, end_s in stops:
        seen_s = [(ns - BEGIN_NS) * 1e-9 for ns, its, *_ in maker.messages if its == topic]
        maker.without(topic, *(i for i, t_s in enumerate(seen_s) if begin_s < t_s < end_s))
    return maker


@pytest.mark.parametrize("of", ["--state", "--image"])
@pytest.mark.parametrize("end_s", [7.0, 4.0])
def test_rows_without_a_present_image_or_vector_are_left_out(
    tmp_path: Path, capsys: Capsys, of: str, end_s: float
) -> None:
    topic, name = {
        "--state": ("/joints", "observation.state"),
        "--image": ("/front/image", "observation.images.front"),
    }[of]
    bag = stopping((topic, 2.5, end_s)).write(tmp_path / "bag")
    table = exported(bag, tmp_path / "out", of, topic, "--task", "press")
    said, t_s = capsys.readouterr(), seconds(table)
    episode = array(table, "episode_index")
    last_s = max(t for t in t_s if t < 3.5)
    assert 2.5 + 0.5 - 0.1 < last_s < 2.5 + 0.5 + 1e-6
    if end_s == 7.0:
        assert last_s == t_s[-1] and not episode.any()
        left = round((5.9 - last_s) * FPS)
    else:
        after_s = t_s[t_s > last_s]
        assert end_s - 0.05 < after_s[0] < end_s + 2 / FPS and after_s[-1] > 5.9
        assert (episode == (t_s > last_s)).all()
        left = round((after_s[0] - last_s) * FPS) - 1
    [line] = [one for one in said.err.splitlines() if "had stopped" in one]
    found = re.fullmatch(
        rf".* (\d+) rows are left out: {name} \({topic}\) had stopped, first at (\S+) s of {bag}",
        line,
    )
    assert found and int(found[1]) == pytest.approx(left, abs=3)
    assert f"left_out={found[1]} " in said.out or of == "--image"
    assert 2.4 < float(found[2]) < 2.5


def test_an_old_command_is_still_in_force(tmp_path: Path, capsys: Capsys) -> None:
    bag = stopping(("/joints", 2.5, 4.0)).write(tmp_path / "bag")
    table = exported(bag, tmp_path / "out", "--action", "/joints", "--task", "press")
    t_s, action = seconds(table), array(table, "action")[:, 0]
    assert not array(table, "episode_index").any()
    newest_s = np.where((t_s > 2.5) & (t_s < 4.0), 2.5, t_s)
    assert np.abs(action - newest_s).max() < 0.03
    old = np.count_nonzero(t_s - action > 0.5)
    assert f"the last command of /joints is repeated in {old} rows" in capsys.readouterr().err


def test_touch_of_a_patch_that_stopped_is_marked_and_told(tmp_path: Path, capsys: Capsys) -> None:
    bag = stopping(("/skin/tactile", 2.5, 7.0)).write(tmp_path / "bag")
    table = exported(bag, tmp_path / "out")
    t_s, valid = seconds(table), array(table, f"{SKIN}.valid")
    assert t_s[-1] > 5.9 and (valid[2:].all(axis=(1, 2)) == (t_s[2:] < 2.5 + 0.5 - 0.005)).all()
    assert not valid[t_s > 3].any()
    rows = np.count_nonzero(t_s > 2.5 + 0.5 - 0.005)
    told = re.search(rf"{SKIN}: /skin/tactile had stopped in (\d+) rows", capsys.readouterr().err)
    assert told and int(told[1]) == pytest.approx(rows, abs=1)


def test_a_clock_that_paused_ends_an_episode(tmp_path: Path) -> None:
    """Rows of an episode follow one another by fps; one lost image is none too long a step."""
    bag = stopping(("/front/image", 1.51, 1.56), ("/front/image", 2.5, 4.0)).write(tmp_path / "bag")
    table = exported(bag, tmp_path / "out", "--clock", "/front/image")
    t_s, episode = seconds(table), array(table, "episode_index")
    steps_s = np.diff(t_s)
    assert np.count_nonzero(steps_s > 1.5 / 30) == 2
    [pause] = np.flatnonzero(steps_s > 1)
    assert np.flatnonzero(np.diff(episode)).tolist() == [pause]
    assert array(table, f"{SKIN}.age_s")[1:].max() < 0.06


def test_rows_come_every_second_at_least_and_hold_a_bounded_number_of_frames(
    tmp_path: Path, refused: Refused
) -> None:
    maker = BagMaker().skin("/skin", 1.0).camera("/slow/image", 8.0, 0.4)
    maker.of("/skin/info")[0].frame_period = 1e-4
    words = "export", maker.write(tmp_path / "bag"), "--lerobot", tmp_path / "out"
    said = refused(*words, "--clock", "/slow/image")
    assert "2.500 s from message to message of /slow/image; a dataset has 1 row per s" in said
    said = refused(*words, "--fps", 1)
    assert "10000 frames of skin per row, 0.0001 s apart; at most 1000" in said


def test_metadata_is_as_lerobot_reads_it(bag: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    table = exported(bag, folder, "--marks", "/task")
    info = meta(folder, "info.json")
    assert info["codebase_version"] == "v3.0" and info["fps"] == FPS
    assert info["total_frames"] == len(table) and info["total_episodes"] == 2
    assert set(info["features"]) == set(table.column_names)
    for name, feature in info["features"].items():
        if feature["dtype"] == "image" or feature["shape"] == [1]:
            continue
        assert array(table, name).shape[1:] == tuple(feature["shape"])
    assert (array(table, "index") == np.arange(len(table))).all()
    index = episodes(folder)
    assert [episode["tasks"] for episode in index] == [["grip"], ["lift"]]
    for number, (begin_s, end_s) in enumerate([(0.7, 1.5), (2.0, 2.6)]):
        episode = index[number]
        rows = slice(episode["dataset_from_index"], episode["dataset_to_index"])
        assert (array(table, "episode_index")[rows] == number).all()
        frame = array(table, "frame_index")[rows]
        assert (frame == np.arange(episode["length"])).all()
        assert array(table, "timestamp")[rows] == pytest.approx(frame / FPS)
        t_s = seconds(table)[rows]
        assert begin_s < t_s[0] < begin_s + 2 / FPS and end_s - 2 / FPS < t_s[-1] <= end_s
    about = meta(folder, "tactile.json")
    assert about["units"] == {SKIN: "Pa", PALM: "Pa", "unix_time_ns": "ns"} | {
        f"{name}.age_s": "s" for name in (SKIN, PALM)
    }
    assert [patch["calibration_id"] for patch in about["patches"]] == ["abcd1234"] * 2
    assert np.shape(about["taxels"]["skin"]["position_m"]) == (TAXELS, 3)


def test_pandas_reads_it(bag: Path, tmp_path: Path) -> None:
    """Runs where pandas is installed."""
    pandas = pytest.importorskip("pandas")
    table = exported(bag, tmp_path / "out", "--marks", "/task")
    tasks = pandas.read_parquet(tmp_path / "out/meta/tasks.parquet")
    assert tasks.iloc[1].name == "lift" and tasks["task_index"].tolist() == [0, 1]
    rows = pandas.read_parquet(tmp_path / "out/data")
    assert len(rows) == len(table) and np.stack(rows[f"{SKIN}.age_s"]).shape == (len(rows), 3)


def test_lerobot_itself_loads_it(bag: Path, tmp_path: Path) -> None:
    """Runs where lerobot is installed, which is by hand: with 0.4.4."""
    loading = pytest.importorskip("lerobot.datasets.lerobot_dataset")
    torch = pytest.importorskip("torch")
    table = exported(bag, tmp_path / "out", "--action", "/joint_states", "--marks", "/task")
    steps = {SKIN: [-1 / FPS, 0.0], "action": [0.0, 1 / FPS, 2 / FPS]}
    dataset = loading.LeRobotDataset("me/touch", root=tmp_path / "out", delta_timestamps=steps)
    assert dataset.num_episodes == 2 and len(dataset) == len(table)
    item = dataset[10]
    window = torch.as_tensor(array(table, SKIN)[9:11].astype(np.float32))
    assert torch.equal(item[SKIN], window)
    assert item["unix_time_ns"] == array(table, "unix_time_ns")[10]
    assert item["task"] == "grip" and item["observation.images.front"].shape == (3, 6, 8)
    [batch] = list(torch.utils.data.DataLoader(dataset, batch_size=len(dataset)))
    assert batch[SKIN].shape == (len(table), 2, 3, TAXELS)
    assert batch[f"{SKIN}.valid"].dtype == torch.float32
    assert batch["action"].shape == (len(table), 3, 2)


def test_statistics_are_of_valid_readings_and_one_for_all_taxels(dataset: Dataset) -> None:
    folder, table = dataset
    found = meta(folder, "stats.json")
    pressures = array(table, PALM)[array(table, f"{PALM}.valid")].astype(float)
    for name in ("min", "max", "mean", "std"):
        expected = np.full((3, TAXELS), getattr(pressures, name)())
        assert np.array(found[PALM][name]) == pytest.approx(expected, rel=1e-5)
    assert found[PALM]["min"][0][0] > 5e3  # no filled zero
    assert np.unique(found[f"{PALM}.valid"]["std"]) == 1  # normalising must not blow up a mask
    assert not np.any(found[f"{PALM}.valid"]["mean"])
    ages = array(table, f"{PALM}.age_s")
    assert found[f"{PALM}.age_s"]["mean"] == pytest.approx(ages.mean(axis=0), rel=1e-5)
    times_ns = array(table, "unix_time_ns")
    expected_ns = (times_ns - times_ns[0]).std()
    assert found["unix_time_ns"]["std"][0] == pytest.approx(expected_ns, rel=1e-6)
    assert found["unix_time_ns"]["mean"][0] - BEGIN_NS == pytest.approx(
        (times_ns - BEGIN_NS).mean(), abs=1e3
    )


def test_episodes_by_intervals_and_by_files(bag: Path, tmp_path: Path) -> None:
    table = exported(bag, tmp_path / "out", "--episode", "1:1.5", "--episode", "0.2:0.6")
    lengths = np.bincount(array(table, "episode_index")).tolist()
    assert lengths == [12, 15]
    other = BagMaker().skin("/skin", 0.5).write(tmp_path / "other", sqlite=True)
    both = [str(path) for path in (bag, other)]
    only = ["--topic", "/skin/tactile", "--image", "/front/image_raw"]
    assert main(["export", *both, "--lerobot", str(tmp_path / "x"), "--fps", "30", *only]) == 1
    assert not (tmp_path / "x").exists()
    again = exported(other, tmp_path / "again")
    two = ["export", str(other), str(other), "--lerobot", str(tmp_path / "two"), "--fps", "30"]
    assert main(two) == 0
    table = parquet.read_table(tmp_path / "two/data/chunk-000/file-000.parquet")
    assert np.bincount(array(table, "episode_index")).tolist() == [len(again)] * 2


def test_episodes_begin_new_files_where_one_is_large(
    bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer, "FILE_MB", 0)
    monkeypatch.setattr(writer, "CHUNK_FILES", 2)
    exported(bag, tmp_path / "out", "--episode=0.2:0.6", "--episode=1:1.5", "--episode=2:2.3")
    places = [(0, 0), (0, 1), (1, 0)]
    for number, (episode, place) in enumerate(zip(episodes(tmp_path / "out"), places, strict=True)):
        assert (episode["data/chunk_index"], episode["data/file_index"]) == place
        rows = parquet.read_table(
            tmp_path / "out" / "data/chunk-{:03d}/file-{:03d}.parquet".format(*place)
        )
        assert (array(rows, "episode_index") == number).all()
        assert len(rows) == episode["length"] == [12, 15, 9][number]


def test_a_recording_has_contacts_and_wrench(tmp_path: Path) -> None:
    path = recording(tmp_path / "touch.skin", SimOptions(scene="press", seed=1), 1.5)
    table = exported(path, tmp_path / "out", "--samples", "last")
    force = array(table, "observation.wrench.skin")
    contacts = array(table, "observation.contacts.skin")
    touched = contacts[:, 0] == 1
    assert touched.any()
    assert (force[touched, 2] < 0).all()  # into the surface, whose normal is z
    pressed = array(table, SKIN)[touched].max(axis=1)
    assert (pressed > 0).all() and not np.isnan(contacts).any()
    features = meta(tmp_path / "out", "info.json")["features"]
    assert "force_z_n" in features["observation.wrench.skin"]["names"]


@pytest.mark.parametrize(
    "interrupt", [KeyboardInterrupt, OSError(28, "No space left on device")], ids=["ctrl-c", "full"]
)
def test_work_that_ends_early_leaves_nothing(
    bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, interrupt: BaseException
) -> None:
    add: Callable[..., None] = writer.DatasetWriter.add

    def ends(self: writer.DatasetWriter, cells: Any) -> None:
        if self.frames == 20:
            raise interrupt
        add(self, cells)

    exported(bag, tmp_path / "old", "--episode=1:1.2")
    before = (tmp_path / "old/meta/info.json").read_bytes()
    monkeypatch.setattr(writer.DatasetWriter, "add", ends)
    words = ["export", str(bag), "--fps", "30", "--lerobot"]
    assert main([*words, str(tmp_path / "new")]) != 0
    assert main([*words, str(tmp_path / "old"), "--force"]) != 0
    assert [path.name for path in tmp_path.iterdir()] == ["old"]
    assert (tmp_path / "old/meta/info.json").read_bytes() == before


def test_what_cannot_be_is_one_clear_error(bag: Path, tmp_path: Path, refused: Refused) -> None:
    without_skin = BagMaker().joints("/joint_states", 0.1).write(tmp_path / "joints")
    (tmp_path / "nothing").mkdir()
    (tmp_path / "torn.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(40))
    out = ["--lerobot", tmp_path / "out"]
    fps = ["--fps", "30"]
    of_bag: list[tuple[list[object], str]] = [
        ([*out], "--fps N, or --clock"),
        ([*out, "--fps", "0"], "--fps is 0; it must be a whole number of 1…1000"),
        (
            [*out, "--fps", "29.97"],
            "--fps is 29.97; it must be a whole number of 1…1000, as LeRobot",
        ),
        (["--lerobot", tmp_path, *fps], "exists already"),
        ([*out, "--clock", "/none"], "/none is not exported (but /left_palm/skin/tactile, "),
        ([*out, *fps, "--topic", "/none"], "no skin's frames in /none"),
        ([*out, *fps, "--image", "/none"], "no topic /none"),
        ([*out, *fps, "--image", "/joint_states"], "not an image"),
        ([*out, *fps, "--state", "/front/image_raw"], "state takes sensor_msgs/msg/JointState"),
        ([*out, *fps, "--marks", "/joint_states"], "marks are std_msgs/msg/Bool"),
        ([*out, *fps, "--episode", "2"], "START:END"),
        ([*out, *fps, "--episode", "1:2", "--marks", "/task"], "both say where episodes are"),
        ([*out, *fps, "--start", "5", "--end", "2"], "--start 5 is after --end 2"),
        ([*out, *fps, "--task", "grip \udcff"], "--task is not UTF-8"),
        ([*out, *fps, "--episode", "50:60"], "no row is whole: no sample"),
        (["-o", tmp_path / "x.npz", *fps], "--fps goes with --lerobot"),
        (["-o", tmp_path / "x", "--bag"], "is a bag already"),
    ]
    for words, message in (
        *(([bag, *words], message) for words, message in of_bag),
        ([without_skin, *out, *fps], "no frames of a skin"),
        ([tmp_path / "nothing", *out, *fps], "neither a bag (metadata.yaml) nor a dataset"),
        ([tmp_path / "torn.mcap", *out, *fps], "torn.mcap"),
    ):
        assert message in refused("export", *words)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("topic", "camera_off_s", "expected"),
    [
        ("/skin/tactile", 0, 1),
        ("/front/image", -1_699_999_900, 30),
        ("/front/image", 600, 30),
        ("/front/image", -5, 0),
    ],
)
def test_stamps_far_from_their_recording_are_not_believed(
    tmp_path: Path, capsys: Capsys, topic: str, camera_off_s: int, expected: int
) -> None:
    """One stamp in 2036; a camera whose clock counts from its start; one ahead, one 5 s behind."""
    seconds_s = 6.0 if camera_off_s == -5 else 1.0
    maker = BagMaker().skin("/skin", seconds_s).camera("/front/image", seconds_s, 30)
    if topic == "/skin/tactile":
        maker.of(topic)[40].header.stamp.sec = 2_100_000_000
    for message in maker.of("/front/image"):
        message.header.stamp.sec += camera_off_s
    bag = maker.write(tmp_path / "bag")
    table = exported(bag, tmp_path / "out", "--samples", "last", "--image", "/front/image")
    said = capsys.readouterr().err
    number = {"/skin/tactile": 78, "/front/image": 30}[topic]
    note = f"{topic}: {expected} of {number} stamps are more than 10 s from when"
    assert (note in said) == (expected > 0)
    t_s = seconds(table)
    held_s = 0.5 if camera_off_s == -5 else 0.0  # then it has stopped: no stamp is later
    assert 27 <= np.count_nonzero(t_s > 0) - 30 * held_s <= 31 and (t_s <= 1.04 + held_s).all()
    found, ages_s = array(table, SKIN), array(table, f"{SKIN}.age_s")
    # A stamp that is not believed is late by what its message waited.
    limit_s = 0.012 if topic == "/skin/tactile" else 1e-3
    assert worst_error_s(found, t_s - ages_s, np.isfinite(found)) < limit_s


@pytest.mark.parametrize("period_s", [0.0, -1.0, 1e-9, float("inf"), float("nan")])
def test_a_frame_period_that_cannot_be_is_unknown(tmp_path: Path, period_s: float) -> None:
    maker = BagMaker().skin("/skin", 0.5)
    maker.messages[0][3].frame_period = period_s
    table = exported(maker.write(tmp_path / "bag"), tmp_path / "out")
    assert array(table, f"{SKIN}.age_s").shape == (len(table),)  # one frame per row


def test_joints_are_taken_by_their_names(tmp_path: Path, refused: Refused) -> None:
    maker = BagMaker().skin("/skin", 1.0).joints("/joints", 1.0)
    joints = maker.of("/joints")
    for message in joints[1::2]:
        message.name, message.position = message.name[::-1], message.position[::-1].copy()
    joints[50].position = joints[50].position * np.nan
    table = exported(maker.write(tmp_path / "bag"), tmp_path / "out", "--state", "/joints")
    found = array(table, "observation.state")
    finger, wrist = found[np.isfinite(found).all(axis=1)].T
    assert (finger >= 0).all() and (wrist == -finger).all() and finger.max() > 0.9
    joints[80].name = ["finger", "thumb"]
    words = "--lerobot", tmp_path / "none", "--fps", FPS, "--state"
    said = refused("export", maker.write(tmp_path / "other"), *words, "/joints")
    assert "/joints: some messages have finger, wrist, others finger, thumb" in said
    said = refused("export", tmp_path / "bag", *words, "/joints:thumb")
    assert "/joints: no thumb (there are finger, wrist)" in said


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_values_that_are_not_finite_stay_out_of_the_statistics(
    tmp_path: Path, capsys: Capsys, bad: float
) -> None:
    maker = BagMaker().skin("/skin", 1.0).joints("/joints", 1.0)
    for message in maker.of("/joints")[:50]:
        message.position[0] = bad
    table = exported(maker.write(tmp_path / "bag"), tmp_path / "out", "--state", "/joints")
    finger, wrist = array(table, "observation.state").T
    finite = np.isfinite(finger)
    assert 0 < finite.sum() < len(finite)
    found = meta(tmp_path / "out", "stats.json")["observation.state"]
    for name, of in (("min", np.min), ("max", np.max), ("mean", np.mean), ("std", np.std)):
        expected = [of(finger[finite]), of(wrist)]
        assert found[name] == pytest.approx(expected, rel=1e-5, abs=1e-7)
    note = f"observation.state: {(~finite).sum()} values are not finite"
    assert note in capsys.readouterr().err


def test_no_row_is_later_than_the_recording(tmp_path: Path) -> None:
    """A stamp 9 s ahead is believed, since clocks may differ, but makes no rows of its own."""
    maker = BagMaker().skin("/skin", 1.0)
    maker.of("/skin/tactile")[40].header.stamp.sec += 9
    t_s = seconds(exported(maker.write(tmp_path / "bag"), tmp_path / "out"))
    assert len(t_s) == 29 and t_s[-1] <= 78 * PERIOD_S + 0.01
