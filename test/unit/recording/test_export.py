# SPDX-License-Identifier: Apache-2.0

"""Exported recordings: other programs load the values that the decoder found."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from tactile_cdma.base.errors import CaptureError
from tactile_cdma.commands.cli import main
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.datasets.samples import SkinFrame
from tactile_cdma.datasets.sources.recording_source import RecordingSource
from tactile_cdma.datasets.tables import write_npz
from tactile_cdma.driver.digitizer import Source
from tactile_cdma.driver.pipeline import TactileFrame
from tactile_cdma.recording.bag_export import write_bag
from tactile_cdma.recording.offline import RawCapture
from tactile_cdma.recording.recording_file import Recorder, describe, read_bytes
from tactile_cdma.sim.options import SimOptions
from test.support.command_line import Printed, Refused
from test.support.simulated import recording

pytestmark = pytest.mark.xdist_group("export")  # its recording is made once
TAXELS = 16
Recorded: TypeAlias = tuple[Path, list[TactileFrame]]
"""A recording with a node that never speaks, and its frames."""
RECORDED = Source("touch.skin", recorded=True)


@pytest.fixture(scope="module")
def skin(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    path = tmp_path_factory.mktemp("export") / "touch.skin"
    asked = {"amplitude_mv": 300.0, "frame_id": "palm", "active_share": 0.45}
    recording(path, SimOptions(scene="moving", seed=2, dead="5"), 1.5, **asked)
    capture = RawCapture(path, {})
    frames = list(capture.frames())
    assert len(frames) > 80 and capture.config.active_share == 0.45
    return path, frames


def exported(path: Path, output: Path, *options: str) -> Path:
    assert main(["export", str(path), "-o", str(output), *options]) == 0
    return output


def test_numpy_arrays_are_the_decoder_s(skin: Recorded, tmp_path: Path) -> None:
    path, frames = skin
    table = np.load(exported(path, tmp_path / "out.npz"))
    assert table["sequence"].tolist() == [frame.sequence for frame in frames]
    assert table["device_time_s"].tolist() == [frame.t_middle for frame in frames]
    for name in ("pressure_pa", "voltage_v", "status"):
        expected = np.array([getattr(frame.readings, name) for frame in frames])
        assert table[name].dtype == expected.dtype
        assert table[name].tobytes() == expected.tobytes()
    assert np.isnan(table["pressure_pa"][:, 4]).all()
    begun_s = describe(path).wall_ns * 1e-9
    assert (np.diff(table["wall_time_s"]) > 0).all()
    assert begun_s - 0.1 < table["wall_time_s"][0] < table["wall_time_s"][-1] < begun_s + 1.6
    assert table["position_m"].shape == table["normal"].shape == (TAXELS, 3)
    assert table["node"].tolist() == list(range(1, TAXELS + 1))
    assert table["shape"].tolist() == [4, 4]
    assert np.allclose(np.linalg.norm(table["normal"], axis=1), 1)
    about = json.loads(str(table["about"]))
    assert about["parameters"]["nodes"] == TAXELS and about["parameters"]["frame_id"] == "palm"


def test_a_bag_holds_the_same_and_its_definitions(skin: Recorded, tmp_path: Path) -> None:
    path, frames = skin
    with AnyReader([exported(path, tmp_path / "bag", "--bag")]) as reader:
        messages = [
            (c.topic, t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages()
        ]
    [info] = [message for topic, _, message in messages if topic == "/skin/info"]
    arrays = [(t, message) for topic, t, message in messages if topic == "/skin/tactile"]
    assert len(arrays) == len(frames)
    for (stamp_ns, message), frame in zip(arrays, frames, strict=True):
        assert message.info_id == info.info_id
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp_ns
        assert message.header.frame_id == "palm"
        assert message.sequence == frame.sequence
        assert message.device_time_us == round(frame.t_middle * 1e6)
        assert message.pressure.tobytes() == frame.readings.pressure_pa.tobytes()
        assert message.status.tobytes() == frame.readings.status.tobytes()


def test_every_export_says_what_was_recorded(
    skin: Recorded, tmp_path: Path, printed: Printed
) -> None:
    path, _ = skin
    said = {"origin": "replayed", "measured_by": "simulated", "digitizer_id": "73696D0002000000"}
    exported(path, tmp_path / "out.csv")
    in_csv = json.loads((tmp_path / "out.about.json").read_text())
    in_npz = json.loads(str(np.load(exported(path, tmp_path / "out.npz"))["about"]))
    assert in_csv == in_npz
    assert in_csv | {"file": "touch.skin", "skin": ""} | said == in_csv
    with AnyReader([exported(path, tmp_path / "bag", "--bag")]) as reader:
        [connection] = [c for c in reader.connections if c.topic == "/skin/info"]
        [(_, _, raw)] = reader.messages([connection])
        info = reader.deserialize(raw, connection.msgtype)
    assert (info.origin, info.measured_by) == (info.ORIGIN_REPLAYED, info.ORIGIN_SIMULATED)
    assert info.digitizer_id == said["digitizer_id"]
    assert "digitizer: simulated, 73696D0002000000" in printed("info", path).out


def test_options_of_decoding_count(skin: Recorded, tmp_path: Path) -> None:
    params = tmp_path / "skin.yaml"
    params.write_text("skin:\n  ros__parameters:\n    pitch_mm: 6.0\n    rows: 2\n    columns: 8\n")
    table = np.load(exported(skin[0], tmp_path / "out.npz", "--params", str(params)))
    assert table["shape"].tolist() == [2, 8]
    assert table["position_m"][1, 0] - table["position_m"][0, 0] == pytest.approx(6e-3)


def test_bytes_alone_have_no_wall_time(skin: Recorded, tmp_path: Path, refused: Refused) -> None:
    raw = tmp_path / "touch.raw"
    raw.write_bytes(b"".join(data for data, _ in read_bytes(skin[0])))
    table = np.load(exported(raw, tmp_path / "out.npz"))
    assert np.isnan(table["wall_time_s"]).all()
    assert table["device_time_s"].tolist() == [frame.t_middle for frame in skin[1]]
    assert "no times" in refused("export", raw, "-o", tmp_path / "bag", "--bag")


def test_an_output_that_cannot_be_is_told_before_the_work(skin: Recorded, tmp_path: Path) -> None:
    def unwanted() -> Iterator[tuple[int, SkinFrame]]:
        raise AssertionError("frames were asked for")
        yield

    patch = RecordingSource(skin[0], {}, derived=False).patch
    with pytest.raises(FileNotFoundError):
        write_npz(tmp_path / "none" / "out.npz", unwanted(), patch, {})


def test_a_bag_refuses_times_that_ros_cannot_tell(skin: Recorded, tmp_path: Path) -> None:
    for wall_s in (-1.0, 2.0**31):
        frames = iter([(skin[1][0], wall_s)])
        with pytest.raises(CaptureError, match="clock"):
            write_bag(tmp_path / str(wall_s), frames, SkinConfig.of({}), RECORDED, "skin")


def test_what_cannot_be_exported_is_one_clear_error(
    skin: Recorded, tmp_path: Path, refused: Refused
) -> None:
    path, output = skin[0], tmp_path / "out.npz"
    output.write_bytes(b"mine")
    scope = tmp_path / "scope.csv"
    scope.write_text("0,1\n" * 100)
    for arguments, message in (
        ([path, "-o", output], "--force overwrites it"),
        ([path, "-o", tmp_path / "out.xls"], "name it *.npz, *.csv"),
        ([path, "-o", tmp_path / "none" / "out.npz"], "No such file"),
        ([path, "-o", tmp_path, "--bag"], "exists already"),
        ([tmp_path / "none.skin", "-o", tmp_path / "x.npz"], "No such file"),
        ([scope, "-o", tmp_path / "x.npz"], "decode --json"),
    ):
        assert message in refused("export", *arguments)
    assert output.read_bytes() == b"mine"


@pytest.mark.parametrize("options", [["out.npz"], ["out.csv"], ["out", "--bag"]])
def test_a_recording_without_frames_leaves_no_file(
    tmp_path: Path, refused: Refused, options: list[str]
) -> None:
    path = tmp_path / "silent.skin"
    with Recorder(path, "sim://", 9600, {}) as recorder:
        recorder.write(bytes(100), describe(path).monotonic_ns * 1e-9)
    assert refused("export", path, "-o", tmp_path / options[0], *options[1:])
    assert list(tmp_path.iterdir()) == [path]


def test_a_bag_without_rosbags_is_one_clear_error(
    skin: Recorded, tmp_path: Path, refused: Refused, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "tactile_cdma.recording.bag_export")
    monkeypatch.setitem(sys.modules, "rosbags.interfaces", None)
    said = refused("export", skin[0], "-o", tmp_path / "bag", "--bag")
    assert said.startswith("tactile-cdma: --bag needs the Python package rosbags, which is not")
    assert "pip install rosbags" in said and not (tmp_path / "bag").exists()
