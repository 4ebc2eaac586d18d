# SPDX-License-Identifier: Apache-2.0

"""Episodes recorded without LeRobot are what a policy gets live, and can be learnt from."""

import re
import sys
import time
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from tactile_cdma import LiveObservation, Skin
from tactile_cdma.sim import Sphere
from test.support.programs import on_a_terminal, run_python
from test.support.scripts import loaded

parquet = pytest.importorskip("pyarrow.parquet", reason="the extra [learn] is not installed")
pytestmark = pytest.mark.xdist_group("public_skin")
EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "record_episodes.py"
STEPPED = "sim://?scene=external&speed=0&threshold=0"
TOUCH = "observation.tactile.skin"


@pytest.fixture(scope="module")
def example() -> ModuleType:
    return loaded(EXAMPLE)


def rows_of(dataset: Path) -> list[dict[str, Any]]:
    return list(parquet.read_table(dataset / "data").to_pylist())


def ball(depth_mm: float) -> Sphere:
    return Sphere(radius_m=0.02, position_m=(0.0, 0.0, 0.02 - depth_mm * 1e-3))


def test_a_policy_learns_from_episodes_and_gets_the_same_live(
    example: ModuleType, tmp_path: Path
) -> None:
    """Bit for bit, at the same moments, what another observation of the same frames gives."""
    folder, joints = tmp_path / "grasps", {"elbow": 0.25, "wrist": -1.0}
    with Skin(STEPPED, contacts=True) as skin:
        observation = LiveObservation.of(skin)
        kept, row = [], {}

        def press(depth_mm: float, sees: LiveObservation) -> None:
            sees.take(skin.step(ball(depth_mm)), stamp_ns=time.time_ns())

        with example.EpisodeRecorder(folder, observation) as recorder:
            for episode, fate in enumerate(["kept", "discarded", "kept", "begun"]):
                for i in range(15):
                    press(0.1 * (i + 1 + episode), observation)
                    mean_pa = float(observation.read(now=True)[TOUCH].mean())
                    row = recorder.add(joints, {"squeeze": 2e-4 * mean_pa})
                    kept += [row] if fate == "kept" else []
                if fate == "kept":
                    recorder.keep(f"task {episode}")
                elif fate == "discarded":
                    recorder.discard()
            assert not folder.exists() and recorder.episodes == 2
        rows = rows_of(folder)
        assert len(rows) == len(kept) == 30 and [one["episode_index"] for one in rows[14:16]] == [
            0,
            1,
        ]
        for recorded, added in zip(rows, kept, strict=True):
            for name, array in added.items():
                assert np.array(recorded[name], array.dtype).tobytes() == array.tobytes(), name

        # A policy: the squeeze, linear in what was felt.
        felt = np.array([one[TOUCH] for one in rows])
        gain = np.linalg.lstsq(felt, np.array([one["action"] for one in rows]), rcond=None)[0]
        live = LiveObservation(folder, skin)
        assert live.features.keys() == {name for name in row if name != "action"}
        frames = [skin.step(ball(1.2)) for _ in range(3)]
        now_ns = time.time_ns()
        for seen in (live, observation):
            for age_ms, frame in zip((3, 2, 1), frames, strict=True):
                seen.take(frame, stamp_ns=now_ns - age_ms * 1_000_000)
        live.state(joints, stamp_ns=now_ns)
        found, same = live.at(now_ns), observation.at(now_ns)
        assert found["observation.state"].tolist() == list(joints.values())
        assert all(found[name].tobytes() == array.tobytes() for name, array in same.items())
        assert found[TOUCH].max() > 1e3 and found[f"{TOUCH}.valid"].all()
        squeeze = float(found[TOUCH] @ gain)
        assert squeeze == pytest.approx(2e-4 * float(found[TOUCH].mean()), rel=0.05)
        other = example.EpisodeRecorder(tmp_path / "other", observation)
        other.add(joints, {})
        with pytest.raises(ValueError, match=r"observation\.state has knee; before elbow, wrist"):
            other.add({"knee": 1.0}, {})


def test_keys_keep_discard_and_end(tmp_path: Path) -> None:
    folder = tmp_path / "grasps"
    words = [sys.executable, EXAMPLE, folder, "--port", "sim://?scene=all", "--task", "press"]
    command = ["sh", "-c", 'exec "$@" 2>&1', "sh", *words]  # the progress line is on stderr
    said = on_a_terminal(
        command,
        (r"episode 1: [1-9]\.", b"n"),
        (r"episode 2: [1-9]\.", b"d"),
        (r"episode 2: [1-9]\..*episode 2: 0\.[1-9].*episode 2: [1-9]\.", b"q"),
    )
    assert re.search(r"episodes=2 late=\d+ folder=", said), said[-500:]
    rows = rows_of(folder)
    assert [row["frame_index"] for row in rows].count(0) == 2
    assert parquet.read_table(folder / "meta/tasks.parquet").to_pylist()[0]["task"] == "press"
    times_s = np.array([row["unix_time_ns"] for row in rows if row["episode_index"] == 0]) * 1e-9
    assert np.median(np.diff(times_s)) == pytest.approx(1 / 30, rel=0.2)
    again = run_python(EXAMPLE, folder, "--port", "sim://")
    assert again.returncode == 1 and "exists already" in again.stderr
    assert LiveObservation.parameters(folder) == {}
