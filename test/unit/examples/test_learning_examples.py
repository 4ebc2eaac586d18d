# SPDX-License-Identifier: Apache-2.0

"""The examples of recording and learning run, and what they print is true."""

import os
import re
import sys
import threading
from collections import deque
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from unittest import mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma import Decoder, Frame, PortError, Skin, read_recording
from tactile_cdma.commands.cli import main
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.sim.pty import serve
from test.support import simulated
from test.support.programs import run_python
from test.support.scripts import loaded
from test.support.waiting import PATIENCE_S

pytestmark = pytest.mark.xdist_group("learning examples")  # its recording is made once
EXAMPLES = Path(__file__).resolve().parents[3] / "examples"


needs_pyarrow = pytest.mark.skipif(
    not find_spec("pyarrow"), reason="the extra [learn] is not installed"
)
needs_torch = pytest.mark.skipif(not find_spec("torch"), reason="torch is not installed")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recorded") / "touch.skin"
    return simulated.recording(path, SimOptions(scene="moving", seed=1), 3.0)


def run(name: str, *words: str) -> dict[str, float]:
    """The figures that the last line of an example's output names."""
    environment = os.environ | {"MPLBACKEND": "Agg", "PYTHONPATH": str(EXAMPLES.parent)}
    done = run_python(EXAMPLES / name, *words, env=environment)
    assert done.returncode == 0, done.stderr
    last = done.stdout.splitlines()[-1]
    return {name: float(value) for name, value in re.findall(r"(\w+)=([\d.]+)", last)}


def started(monkeypatch: pytest.MonkeyPatch, *words: object) -> ModuleType:
    """The example that logs, in this process, with these words on its command line."""
    monkeypatch.setenv("MPLBACKEND", "Agg")
    monkeypatch.setattr(sys, "argv", ["live_parquet.py", *map(str, words)])
    return loaded(EXAMPLES / "live_parquet.py")


@needs_pyarrow
def test_every_frame_is_logged_while_the_picture_lives(tmp_path: Path) -> None:
    import pyarrow.parquet

    output, picture = tmp_path / "touch.parquet", tmp_path / "touch.png"
    port = "sim://?scene=press&seed=1"
    figures = run("live_parquet.py", port, str(output), "--seconds", "3", "--picture", str(picture))
    table = pyarrow.parquet.read_table(output).to_pydict()
    sequence, time_s = table["sequence"], table["unix_time_s"]
    assert len(sequence) == figures["frames"] > 50
    passed = sequence[-1] - sequence[0]
    assert sequence == sorted(set(sequence))  # all but what a busy machine leaves out
    assert (time_s[-1] - time_s[0]) / passed == pytest.approx(
        0.0128, rel=0.3
    )  # first stamps waited
    assert max(max(row) for row in table["pressure_pa"][50:]) > 1e3
    assert picture.read_bytes().startswith(b"\x89PNG")


@needs_pyarrow
def test_a_recording_is_logged_to_its_end(
    recording: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    import pyarrow.parquet

    output = tmp_path / "touch.parquet"
    example = started(monkeypatch, f"replay://{recording}?speed=0", output)
    example.main()
    [said] = re.findall(r"frames=(\d+) dropped=0", capsys.readouterr().out)
    sequence = pyarrow.parquet.read_table(output).column("sequence").to_pylist()
    frames = sum(
        len(decoder.feed(data, t_host))
        for decoder in [Decoder(nodes=16)]
        for data, t_host in read_recording(recording)
    )
    assert len(sequence) == int(said) == frames > 200
    before = output.read_bytes()
    with pytest.raises(SystemExit):
        example.main()
    assert "exists already; --force overwrites it" in capsys.readouterr().err
    assert output.read_bytes() == before


@needs_pyarrow
def test_what_was_logged_before_a_port_was_lost_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import pyarrow.parquet

    example = started(monkeypatch)
    output, link = tmp_path / "touch.parquet", tmp_path / "skin"
    plugged, unplug, newest = threading.Event(), threading.Event(), Newest(50)
    newest.reached = unplug.set
    board = threading.Thread(
        target=serve,
        args=(lambda: VirtualDigitizer(SimOptions()), link, unplug, lambda _: plugged.set()),
    )
    board.start()
    assert plugged.wait(PATIENCE_S)
    try:
        with Skin(str(link), nodes=16, timeout_s=1.0) as skin:
            frames = example.log(skin, output, newest, threading.Event())
            before = output.read_bytes()
            with pytest.raises(PortError):  # it never comes back: no file without a frame
                example.log(skin, output, newest, threading.Event())
    finally:
        unplug.set()
        board.join()
    assert pyarrow.parquet.read_table(output).num_rows == frames >= 50
    assert f"the log ends here: {link}: " in capsys.readouterr().err
    assert output.read_bytes() == before


class Newest(deque[Frame]):
    """What the example hands its newest frame to; tells when it has had so many."""

    def __init__(self, count: int) -> None:
        super().__init__(maxlen=1)
        self._left = count
        self.reached: Callable[[], None] = lambda: None

    def append(self, frame: Frame) -> None:
        super().append(frame)
        self._left -= 1
        if not self._left:
            self.reached()


@needs_torch
def test_a_network_answers_until_a_recording_ends(recording: Path) -> None:
    figures = run("live_torch.py", f"replay://{recording}", "--seconds", "60")
    assert figures["answers"] > 50 and figures["shared"] == 1


@needs_torch
def test_a_network_answers_every_frame_from_shared_memory() -> None:
    figures = run("live_torch.py", "sim://?scene=moving", "--seconds", "3")
    assert figures["shared"] == 1
    assert figures["answers"] > 50
    assert 0 < figures["network_ms"] < figures["latency_ms"]


@given(length=st.integers(1, 8), pushed=st.integers(0, 30))
def test_the_window_is_always_the_last_frames_in_order(length: int, pushed: int) -> None:
    torch = SimpleNamespace(nn=SimpleNamespace(Module=object))  # the ring needs none of it
    with mock.patch.dict(sys.modules, torch=torch):
        recent = loaded(EXAMPLES / "live_torch.py").RecentFrames(length, (2,))
    for i in range(pushed):
        recent.push(np.array([i + 1, -i], dtype=np.float32))
        window = recent.window
        assert window.flags.c_contiguous and window.base is not None
        assert np.shares_memory(window, recent._frames)
        expected = np.maximum(np.arange(i + 2 - length, i + 2), 0)
        assert window[:, 0].tolist() == expected.tolist()
    assert recent.count == pushed


@needs_torch
@needs_pyarrow
def test_a_network_learns_from_a_dataset(recording: Path, tmp_path: Path) -> None:
    dataset = str(tmp_path / "touch")
    episodes = ["--episode", "0:1.3", "--episode", "1.4:2.7"]
    assert main(["export", str(recording), "--lerobot", dataset, "--fps", "30", *episodes]) == 0
    figures = run("dataset_torch.py", dataset)
    assert figures["episodes"] == 2
    assert 50 < figures["pairs"] <= 2 * (39 - 1)
    assert figures["last"] < 0.5 * figures["first"]
