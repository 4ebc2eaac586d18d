# SPDX-License-Identifier: Apache-2.0

"""What is logged: files, ports and whatever changes how frames are made, but no single frame."""

import logging
import time
from pathlib import Path

import pytest

from tactile_cdma import Decoder, Skin, read_recording
from tactile_cdma.base.whole_file import replace_file
from tactile_cdma.commands.cli import main
from tactile_cdma.config.parameters import read_file
from tactile_cdma.recording.recording_file import Recorder
from tactile_cdma.sim.options import SimOptions
from test.support.programs import run_python
from test.support.simulated import record
from test.support.waiting import PATIENCE_S


@pytest.fixture
def log(caplog: pytest.LogCaptureFixture) -> pytest.LogCaptureFixture:
    caplog.set_level(logging.DEBUG, "tactile_cdma")
    return caplog


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Two seconds of the skin's time, however busy the machine is."""
    raw, path = tmp_path / "raw", tmp_path / "touch.skin"
    record(raw, SimOptions(scene="moving"), 2.0)
    data, begun_s = raw.read_bytes(), time.monotonic()
    with Recorder(path, "sim://", 9600, {}) as recorder:
        for begin in range(0, len(data), 1000):
            recorder.write(data[begin : begin + 1000], begun_s + begin * 1e-6)
    return path


def test_files_that_are_read_or_written_are_logged(
    tmp_path: Path, log: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "skin.yaml"
    replace_file(path, "/left/skin:\n  ros__parameters: {nodes: 20}\n")
    read_file(path)
    assert log.messages == [
        f"wrote {path}",
        f"reading {path}",
        f"{path} has parameters for /left/skin",
    ]
    assert {record.name.rpartition(".")[0] for record in log.records} == {
        "tactile_cdma.base",
        "tactile_cdma.config",
    }


def test_frames_are_not_logged(recording: Path, log: pytest.LogCaptureFixture) -> None:
    decoder, frames, logged = Decoder(nodes=16), [0], [0]
    for data, t_host in read_recording(recording):
        frames.append(frames[-1] + len(decoder.feed(data, t_host)))
        logged.append(len(log.records))
    assert frames[-1] > 100
    begun = next(i for i, count in enumerate(frames) if count >= 10)
    assert logged[-1] == logged[begun], log.messages[logged[begun] :]


def test_losses_of_a_recording_are_logged(recording: Path, log: pytest.LogCaptureFixture) -> None:
    recording.write_bytes(recording.read_bytes()[:-100])
    assert sum(len(data) for data, _ in read_recording(recording))
    assert any(message.startswith(f"{recording}: ") for message in log.messages)


def test_a_digitizer_is_logged_and_a_replay_that_begins_again(
    recording: Path, log: pytest.LogCaptureFixture
) -> None:
    assert main(["ports", "sim://"]) == 0
    assert log.messages[0].startswith("sim:// is open")
    assert any(
        message.startswith("sim://: 73696D0000000000, simulated") for message in log.messages
    )
    with Skin(f"replay://{recording}?speed=0&loop=true", timeout_s=None) as skin:
        while f"{recording} begins again" not in log.messages:
            skin.read()


@pytest.mark.parametrize("verbose", [True, False])
def test_the_command_logs_on_stderr_if_asked_to(recording: Path, verbose: bool) -> None:
    words = ["-v"] * verbose + ["info", str(recording)]
    done = run_python("-m", "tactile_cdma", *words, check=True)
    assert (f"tactile_cdma.base.named_file: reading {recording}\n" in done.stderr) == verbose
    assert "checksum: right" in done.stdout


def test_nodes_that_a_tare_leaves_out_are_logged(log: pytest.LogCaptureFixture) -> None:
    port = "sim://?scene=idle&heartbeat=2&dead=3&speed=4"
    with Skin(port, nodes=16, stale_after_s=1.0) as skin:
        skin.tare(wait_s=PATIENCE_S)
    assert f"{port}: tared without node 3: no valid, certain reading" in log.messages
