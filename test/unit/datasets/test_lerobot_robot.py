# SPDX-License-Identifier: Apache-2.0

"""What lerobot-record keeps of skins means what `tactile-cdma export` writes; without LeRobot.

The trial with LeRobot itself is by hand: docs/learning.md.
"""

import time
from pathlib import Path
from types import ModuleType

import numpy as np
import pyarrow.parquet
import pytest

from tactile_cdma import LiveObservation, PortError, Skin
from tactile_cdma.commands.cli import main
from tactile_cdma.datasets.sources.recording_source import RecordingSource
from tactile_cdma.sim.options import SimOptions
from test.support import simulated
from test.support.scripts import loaded
from test.support.waiting import wait_for

pytestmark = pytest.mark.xdist_group("public_skin")

ROOT = Path(__file__).resolve().parents[3]
PACKAGE = "lerobot_robot_tactile_cdma"
PARAMETERS = "/**:\n  ros__parameters:\n    port: {port}\n    skin: {skin}\n    nodes: 16\n"


@pytest.fixture(scope="module")
def touch() -> ModuleType:
    """The module of the package that does without LeRobot."""
    return loaded(ROOT / "integrations" / PACKAGE / PACKAGE / "touch.py")


def test_the_numbers_are_the_rows_of_an_export_bit_for_bit(
    touch: ModuleType, tmp_path: Path
) -> None:
    recording, dataset = tmp_path / "touch.skin", tmp_path / "set"
    options = SimOptions.from_url("sim://?scene=all&seed=3&heartbeat=40&dead=5")
    simulated.recording(recording, options, 1.2)
    words = "--lerobot", str(dataset), "--fps", "20", "--samples", "last"
    assert main(["export", str(recording), *words]) == 0
    table = pyarrow.parquet.read_table(dataset / "data/chunk-000/file-000.parquet")
    source = RecordingSource(recording, {}, derived=False)
    stamps = {
        sample.value.sequence: (sample.stamp_ns, sample.value.stamp_uncertainty_s)
        for sample in source.samples(None, None)
    }
    parameters = LiveObservation.parameters(dataset)
    with Skin(f"replay://{recording}?speed=0", contacts=True, **parameters) as skin:
        observation = LiveObservation.of(skin)
        frames = iter(skin)
        ahead = next(frames)
        for row in table.to_pylist():
            while ahead is not None and stamps[ahead.sequence][0] <= row["unix_time_ns"]:
                observation.take(ahead, "skin", *stamps[ahead.sequence])
                ahead = next(frames, None)  # type: ignore[arg-type]
            numbers = touch.flat(observation, observation.at(row["unix_time_ns"]))
            # As lerobot-record: the robot's own numbers first, all in one vector of float32.
            values = {"elbow.pos": 0.5, **numbers}
            state = np.array(list(values.values()), np.float32)
            found = touch.touch_of(list(values), state)
            assert found.pop("observation.state").tolist() == [0.5]
            assert found.keys() == {name for name in row if name.startswith("observation.")}
            for name, array in found.items():
                assert array.tobytes() == np.array(row[name], np.float32).tobytes(), name
    assert len(table) > 15
    assert found["observation.contacts.skin"][0] == 1.0
    assert found["observation.tactile.skin.valid"].tolist() == [1.0] * 4 + [0.0] + [1.0] * 11


def test_a_skin_is_there_before_recording_and_is_told_when_it_stops(
    touch: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "palm.yaml"
    file.write_text(PARAMETERS.format(port='"sim://?scene=all&threshold=0"', skin="Left Palm"))
    skin = touch.Touch(str(file))
    assert len(skin.names) == 33
    assert skin.names[3] == "tactile.left_palm.taxel_3"
    assert skin.names[-1] == "tactile.left_palm.age_s.age_0"
    assert skin.names[16] == "tactile.left_palm.valid.taxel_0"
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
