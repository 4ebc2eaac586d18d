# SPDX-License-Identifier: Apache-2.0

"""What a policy gets at run time is what it was trained on: recorded, exported, replayed.

And what lerobot-record keeps of skins means the same; that trial with LeRobot itself is by hand:
docs/learning.md.
"""

import json
import re
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest

from tactile_cdma import (
    CaptureError,
    Frame,
    LiveObservation,
    ObservationError,
    ParameterError,
    PortError,
    Skin,
)
from tactile_cdma.commands.cli import main
from tactile_cdma.datasets.sources.recording_source import RecordingSource
from tactile_cdma.sim import Sphere
from tactile_cdma.sim.options import SimOptions
from test.support import simulated
from test.support.bags import BagMaker
from test.support.scripts import ROOT, loaded
from test.support.waiting import wait_for

pytestmark = pytest.mark.xdist_group("public_skin")
TOUCH = ROOT.joinpath("integrations", *2 * ["lerobot_robot_tactile_cdma"], "touch.py")
PARAMETERS = "/**:\n  ros__parameters:\n    port: {port}\n    skin: {skin}\n    nodes: 16\n"
TACTILE = "observation.tactile.skin"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("observation") / "touch.skin"
    return simulated.recording(path, SimOptions(scene="all", seed=3, heartbeat=40), 1.2)


def exported(source: Path, folder: Path, *options: str) -> Path:
    assert main(["export", str(source), "--lerobot", str(folder), "--fps", "20", *options]) == 0
    return folder


def observed(
    recording: Path, dataset: Path, skin: Skin, observation: LiveObservation
) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """The rows of a dataset, and what is observed at their times in a replay of its recording."""
    stamps = {
        sample.value.sequence: (sample.stamp_ns, sample.value.stamp_uncertainty_s)
        for sample in RecordingSource(recording, {}, derived=False).samples(None, None)
    }
    rows = pyarrow.parquet.read_table(dataset / "data/chunk-000/file-000.parquet").to_pylist()
    assert len(rows) > 15
    frames = iter(skin)
    ahead = next(frames, None)
    for row in rows:
        while ahead is not None and stamps[ahead.sequence][0] <= row["unix_time_ns"]:
            observation.take(ahead, "skin", *stamps[ahead.sequence])
            ahead = next(frames, None)
        yield row, observation.at(row["unix_time_ns"])


@pytest.mark.parametrize(
    "options", [("--samples", "window"), ("--samples", "last", "--nan", "zero")], ids=" ".join
)
def test_a_replay_gives_the_rows_of_the_dataset_bit_for_bit(
    recording: Path, tmp_path: Path, options: tuple[str, ...]
) -> None:
    dataset = exported(recording, tmp_path / "set", *options)
    parameters, touched = LiveObservation.parameters(dataset), 0
    with Skin(f"replay://{recording}?speed=0", contacts=True, **parameters) as skin:
        observation = LiveObservation(dataset, skin)
        for row, found in observed(recording, dataset, skin, observation):
            columns = {name for name in row if name.startswith(("observation.", "unix_"))}
            assert observation.features.keys() == columns and not observation.others
            for name, array in found.items():
                expected = np.array(row[name], dtype=array.dtype).reshape(array.shape)
                assert array.tobytes() == expected.tobytes(), name
            touched += found["observation.contacts.skin"][0] == 1.0
        assert observation.notes == []
    assert touched > 0


def test_a_live_skin_is_observed_without_waiting_and_its_silence_is_told(
    recording: Path, tmp_path: Path
) -> None:
    dataset = exported(recording, tmp_path / "set")
    with Skin("sim://?scene=all&seed=3", contacts=True) as skin:
        observation, without = LiveObservation(dataset, skin), LiveObservation.of(skin)
        untold = Skin("sim://?scene=external&speed=0", contacts=True)  # it sends when it is told to
        with untold, pytest.raises(ObservationError, match=r"tactile.skin had not begun"):
            LiveObservation(dataset, untold).read()

        def is_valid() -> bool:  # the first second's stamps are not certain; then a window fills
            with suppress(ObservationError):
                return bool(observation.read()[f"{TACTILE}.valid"].all())
            return False

        wait_for(is_valid)
        found = observation.read()
        assert found[TACTILE].shape == (4, 16) and found[f"{TACTILE}.valid"].any()
        ages_s = found[f"{TACTILE}.age_s"]
        assert (np.diff(ages_s) < 0).all() and 0 <= ages_s[-1] < 0.1
        assert "amplitude_mv of patch skin is 300.0, in the dataset 0.0" in observation.notes[-1]
        assert without.notes == [], "there is no dataset to differ from"
        assert not skin.tared and not any("tared" in note for note in observation.notes)
        skin.tare(force=True, wait_s=5.0)
        assert (
            skin.tared and "tared of patch skin is True, in the dataset False" in observation.notes
        )
        other = Skin("sim://?scene=external&speed=0&threshold=0", rows=2, columns=8)
        with other, pytest.raises(ParameterError, match="is not of patch skin's skin"):
            observation.take(other.step())


def test_what_is_old_comes_again_or_is_yet_to_come_is_not_of_now() -> None:
    """By the stamps of frames that say that all is well, however lately they came."""
    ball = Sphere(radius_m=0.02, position_m=(0.0, 0.0, 0.017))
    external = "sim://?scene=external&speed=0&threshold=0"
    with Skin(external, contacts=True) as pressed, Skin(external, contacts=True) as free:
        observation = LiveObservation.of(free)
        felt, none = pressed.step(ball), free.step()

        def valid_after(frame: Frame, age_s: float) -> float:
            observation.take(frame, stamp_ns=time.time_ns() - round(age_s * 1e9))
            found = observation.read(now=True)
            assert found["observation.wrench.skin.valid"].all() == found[f"{TACTILE}.valid"].all()
            touched.append(found["observation.contacts.skin"][0] > 0)
            return float(found[f"{TACTILE}.valid"].mean())

        touched: list[bool] = []
        assert felt.touched and none.untouched and valid_after(none, 3.0) == 0.0
        assert all(valid_after(none, age_s) == 1.0 for age_s in (0.07, 0.05, 0.03, 0.01))
        assert valid_after(felt, 0.3) == 1.0 and not any(touched), "an older one"
        assert valid_after(felt, -5.0) == 1.0 and not any(touched), "in five seconds"
        time.sleep(0.6)
        assert valid_after(felt, 3.0) == 0.0 and not any(touched), "again, of long ago"
        assert valid_after(felt, 0.0) == 1.0 and touched[-1]


def test_a_policy_is_never_shown_the_start_of_a_skin_whose_stamps_are_not_known_yet(
    recording: Path, tmp_path: Path
) -> None:
    """The dataset of the same recording has no row in which nothing is valid."""
    dataset, reasons = exported(recording, tmp_path / "set", "--samples", "last"), set[str]()
    with Skin("sim://?scene=all&seed=3&threshold=0", contacts=True) as skin:
        observation, rows = LiveObservation(dataset, skin), list[Any]()
        skin.read()
        while not rows:  # later ones may be old on a busy machine
            try:
                rows.append(observation.read())
            except ObservationError as error:
                reasons.add(str(error))
            time.sleep(0.01)
    for valid in (f"{TACTILE}.valid", "observation.wrench.skin.valid"):
        assert rows[0][valid].all()
    assert rows[0][TACTILE].min() > 1e3
    assert reasons and all("had not begun" in reason for reason in reasons)


def test_a_state_is_put_into_the_order_of_the_dataset(tmp_path: Path) -> None:
    maker = BagMaker().skin("/skin", 2.0).without("/skin/info")  # places unknown
    maker.joints("/joint_states", 2.0)
    maker.contacts("/skin", 2.0, end_s=2.0)
    dataset = exported(maker.write(tmp_path / "bag"), tmp_path / "set", "--state", "/joint_states")
    names = json.loads((dataset / "meta/info.json").read_text())["features"]["observation.state"]
    names = names["names"]
    with Skin("sim://?scene=all", contacts=True) as skin:
        observation = LiveObservation(dataset, skin)

        def refused() -> str:
            try:
                found.append(observation.read()["observation.state"])
            except ObservationError as error:
                return str(error)
            return ""

        def observed() -> bool:
            """An observation is as of the skin's newest frame, which was before the state."""
            observation.state(dict(reversed(values.items())))
            return not refused()

        found = list[Any]()
        values = dict(zip(names, np.arange(len(names), dtype=float), strict=True))
        wait_for(lambda: "observation.state had not begun" in refused())
        wait_for(observed)
        assert found[-1].tolist() == list(values.values())
        for wrong in ({"elbow": 1.0}, [0.0] * (len(names) + 1)):
            with pytest.raises(ParameterError, match=f"the dataset's are {names[0]}"):
                observation.state(wrong)
        for no_number in (np.nan, np.inf, 1e39, None, True, "1", 1j):
            with pytest.raises(ParameterError, match=r"observation\.state is .*finite numbers"):
                observation.state([no_number] * len(names))  # type: ignore[list-item]
        with pytest.raises(ParameterError, match=r"observation\.state is a masked array"):
            observation.state(np.ma.masked_array(np.zeros(len(names)), mask=True))
        wait_for(lambda: re.search(r"observation.state .* had stopped", refused()))
    with pytest.raises(CaptureError, match="no parameters of skin: was it made from a bag"):
        LiveObservation.parameters(dataset)


def test_what_does_not_fit_the_dataset_is_refused(recording: Path, tmp_path: Path) -> None:
    dataset = exported(recording, tmp_path / "set")
    with pytest.raises(CaptureError, match="4 × 4 taxels, in the skin 4 × 6"):
        LiveObservation(dataset, Skin("sim://", nodes=24, frame_period_ms=16.0, contacts=True))
    with pytest.raises(CaptureError, match="positions of the taxels"):
        LiveObservation(dataset, Skin("sim://", pitch_mm=9.0, contacts=True))
    with pytest.raises(ParameterError, match="contacts=True"):
        LiveObservation(dataset, Skin("sim://"))
    with pytest.raises(ParameterError, match=r"skins are palm; .* has skin"):
        LiveObservation(dataset, {"palm": Skin("sim://", contacts=True)})
    for skins in ({}, {"left palm": Skin("sim://"), "left_palm": Skin("sim://")}):
        with pytest.raises(ParameterError, match=r"(none|palm): these would be \d patches"):
            LiveObservation.of(skins)
    with pytest.raises(CaptureError, match=r"meta/info\.json: not read: No such file"):
        LiveObservation(tmp_path, Skin("sim://", contacts=True))
    about = dataset / "meta/tactile.json"
    for text in ("{}", "[]", "nonsense", about.read_text().replace('"window"', '"some"')):
        about.write_text(text)
        with pytest.raises(CaptureError, match=r"tactile.json|not this version's dataset"):
            LiveObservation(dataset, Skin("sim://", contacts=True))


@pytest.fixture(scope="module")
def touch() -> ModuleType:
    """The module of the package that does without LeRobot."""
    return loaded(TOUCH)


def test_the_numbers_are_the_rows_of_an_export_bit_for_bit(
    touch: ModuleType, tmp_path: Path
) -> None:
    recording = tmp_path / "touch.skin"
    options = SimOptions.from_url("sim://?scene=all&seed=3&heartbeat=40&dead=5")
    simulated.recording(recording, options, 1.2)
    dataset = exported(recording, tmp_path / "set", "--samples", "last")
    parameters = LiveObservation.parameters(dataset)
    with Skin(f"replay://{recording}?speed=0", contacts=True, **parameters) as skin:
        observation = LiveObservation.of(skin)
        for row, arrays in observed(recording, dataset, skin, observation):
            # As lerobot-record: the robot's own numbers first, all in one vector of float32.
            values = {"elbow.pos": 0.5, **touch.flat(observation, arrays)}
            state = np.array(list(values.values()), np.float32)
            found = touch.touch_of(list(values), state)
            assert found.pop("observation.state").tolist() == [0.5]
            assert found.keys() == {name for name in row if name.startswith("observation.")}
            for name, array in found.items():
                assert array.tobytes() == np.array(row[name], np.float32).tobytes(), name
    assert found["observation.contacts.skin"][0] == 1.0
    assert found[f"{TACTILE}.valid"].tolist() == [1.0] * 4 + [0.0] + [1.0] * 11


def test_a_skin_is_there_before_recording_and_is_told_when_it_stops(
    touch: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "palm.yaml"
    file.write_text(PARAMETERS.format(port='"sim://?scene=all&threshold=0"', skin="Left Palm"))
    skin = touch.Touch(str(file))
    assert len(skin.names) == 33
    assert skin.names[3] == "tactile.left_palm.taxel_3.vel"
    assert skin.names[-1] == "tactile.left_palm.age_s.age_0.vel"
    assert skin.names[16] == "tactile.left_palm.valid.taxel_0.vel"
    skin.open()
    try:
        # The first second's stamps are not certain.
        wait_for(lambda: all(list(skin.read().values())[16:32]))
        values = list(skin.read().values())
        assert min(values[:16]) > 5e3 and skin.is_open
        time.sleep(0.02)  # a frame is 5 ms old when it arrives
        assert 0.004 < list(skin.read().values())[32] < 5.0
        skin._ends.close()  # as where the cable is pulled
        monkeypatch.setattr(Skin, "waiting", lambda self: [])
        monkeypatch.setattr(Skin, "problem", None)
        time.sleep(0.7)
        stopped = list(skin.read().values())
        assert stopped[16:32] == [0.0] * 16 and min(stopped[:16]) > 5e3 and stopped[32] > 0.5
    finally:
        skin.close()
    file.write_text(PARAMETERS.format(port="/dev/tactile-none", skin="x"))
    with pytest.raises(PortError, match="tactile-none"):
        touch.Touch(str(file)).open()
