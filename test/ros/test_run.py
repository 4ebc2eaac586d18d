"""What a user starts: the driver and the viewer as processes of their own."""

from __future__ import annotations

import os
import pty
import re
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS 2 (rclpy) is not installed")

pytestmark = pytest.mark.ros
ROOT = Path(__file__).resolve().parents[2]
RUN = [sys.executable, str(ROOT / "tools" / "run.py")]


def test_make_run_counts_and_times_frames_and_loses_none() -> None:
    done = subprocess.run(
        [*RUN, "--seconds", "4"],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    *lines, last = done.stdout.splitlines()
    values = {key: float(value) for key, value in (pair.split("=") for pair in last.split())}
    assert set(values) == {"published", "received", "lost", "rate_hz", "p50_ms", "p99_ms"}
    assert values["lost"] == 0
    assert values["received"] == values["published"] > 250
    assert values["rate_hz"] == pytest.approx(78.1, abs=2)
    assert 0 < values["p50_ms"] < 100
    assert sum("frames" in line for line in lines) >= 3


def test_a_terminal_shows_a_coloured_heatmap_until_ctrl_c() -> None:
    pid, terminal = pty.fork()
    if pid == 0:
        os.execvpe(RUN[0], RUN, {**os.environ, "TERM": "xterm-256color"})
    shown, deadline = b"", time.monotonic() + 30
    while b"kPa" not in shown or shown.count(b"frames/s") < 5:
        assert time.monotonic() < deadline, shown[-2000:]
        if select.select([terminal], [], [], 0.1)[0]:
            shown += os.read(terminal, 65_536)
    os.kill(pid, signal.SIGINT)
    while True:
        try:
            shown += os.read(terminal, 65_536)
        except OSError:
            break
    _, status = os.waitpid(pid, 0)
    assert os.waitstatus_to_exitcode(status) in (0, 130)
    text = shown.decode(errors="replace")
    assert re.search(r"\x1b\[\d+;48;2;\d+;\d+;\d+m +\d+\.\d", text)
    assert "\x1b[?1049l" in text  # the screen is given back
    assert "received=" in text


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_the_driver_in_order(number: signal.Signals) -> None:
    command = [sys.executable, "-m", "tactile_cdma.ros.node", "--ros-args", "-p", "port:=sim://"]
    node = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert node.stderr is not None
    for line in node.stderr:
        if "receiving frames" in line:
            break
    time.sleep(0.3)
    node.send_signal(number)
    assert node.wait(10) == 0
    assert node.stderr.read() == ""
    node.stderr.close()


def test_the_viewer_tells_why_nothing_comes(tmp_path: Path) -> None:
    done = subprocess.run(
        [*RUN, "--seconds", "1", "--port", str(tmp_path / "nothing")],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 1
    assert f"no frame on /skin/tactile: {tmp_path / 'nothing'}: no such port" in done.stderr


def test_a_parameter_file_with_a_wrong_key_is_reported_and_the_node_lives(tmp_path: Path) -> None:
    path = tmp_path / "wrong.yaml"
    path.write_text("/**:\n  ros__parameters:\n    chip_uss: 40.0\n")
    command = [sys.executable, "-m", "tactile_cdma.ros.node", "--ros-args"]
    command += ["--params-file", str(path)]
    node = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        assert node.stderr is not None
        for line in node.stderr:
            if "did you mean 'chip_us'" in line:
                break
        time.sleep(1.0)
        assert node.poll() is None
    finally:
        node.send_signal(signal.SIGINT)
        assert node.wait(10) in (0, 130)
