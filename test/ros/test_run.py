# SPDX-License-Identifier: Apache-2.0

"""The driver and the viewer as a user starts them, in separate processes."""

import re
import runpy
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from test.support.programs import on_a_terminal, run_program, run_python, started
from test.support.waiting import PATIENCE_S

ROOT = Path(__file__).resolve().parents[2]
RUN = [sys.executable, str(ROOT / "tools" / "run.py")]
DRIVER = [sys.executable, "-m", "tactile_cdma.ros.driver.node", "--ros-args"]


def read_until(process: subprocess.Popen[str], text: str) -> None:
    """Read the process's errors up to a line with this text."""
    watchdog = threading.Timer(PATIENCE_S, process.kill)
    watchdog.start()
    try:
        assert process.stderr is not None
        assert any(text in line for line in process.stderr), f"never said {text!r}"
    finally:
        watchdog.cancel()


def test_make_run_counts_and_times_frames_and_loses_none() -> None:
    done = run_program(*RUN, "--seconds", "3")
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    *lines, last = done.stdout.splitlines()
    values = {key: float(value) for key, value in (pair.split("=") for pair in last.split())}
    assert set(values) == {"published", "received", "lost", "rate_hz", "p50_ms", "p99_ms"}
    assert values["lost"] == 0
    assert values["received"] == values["published"] > 180
    assert values["rate_hz"] == pytest.approx(78.1, rel=0.2)
    assert 0 < values["p50_ms"] <= values["p99_ms"]
    assert sum("frames" in line for line in lines) >= 2


def test_a_terminal_shows_a_coloured_heatmap_until_ctrl_c() -> None:
    many = r"(?s)kPa.*(frames/s.*){5}"
    numbers = b"nn"  # of taxels, then of nodes
    steps = (many, numbers), ("nodes   speaking", b"\x03")
    text = on_a_terminal(RUN, *steps, TERM="xterm-256color")
    assert re.search(r"\x1b\[\d+;48;2;\d+;\d+;\d+m +\d+\.\d", text)
    assert "\x1b[?1049l" in text  # the screen is given back
    assert "received=" in text


@pytest.mark.parametrize("seconds", ["abc", "-1", "nan", "inf"])
def test_a_wrong_time_is_refused_in_words_of_make(
    seconds: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [*RUN[1:], "--seconds", seconds])
    with pytest.raises(SystemExit) as exit_:
        runpy.run_path(RUN[1], run_name="__main__")
    said = capsys.readouterr().err
    assert exit_.value.code == 2
    assert f"SECONDS={seconds} is not a number of seconds" in said
    assert said.startswith("usage: make run")


ONTO_ANOTHER = ["-r", "/skin/tactile:=/skin/contacts"]
BAD_RULE = ["-r", "__node:=a b"]
PARAMS_FILE = "--ros-args", "--params-file"


@pytest.mark.parametrize(
    ("program", "arguments", "said"),
    [
        ("make run", ["--prot=/dev/ttyACM0"], r"unknown argument 'prot'; did you mean 'port'\?"),
        ("make run", ["--par", "a.yaml"], "unknown argument 'par'"),
        ("make run", ["--params", "none.yaml"], "no parameter file {folder}/none.yaml"),
        ("make run", ["touch.skin"], "unknown argument 'touch.skin'"),
        ("skin_view", ["left palm"], "Invalid topic name: .* '/left palm/skin/tactile'"),
        ("skin_body_view", ["--body", "/my body"], "Invalid topic name: .* '/my body/contacts'"),
        ("skin_view", ["--ros-args", *BAD_RULE], "Failed to parse ROS arguments: .*__node:=a b"),
        ("skin_driver", ["--ros-args", *ONTO_ANOTHER], "existing topic name rt/skin/contacts with"),
        ("skin_driver", [*PARAMS_FILE, "broken.yaml"], "broken.yaml, line 2: not a YAML file"),
        ("skin_driver", [*PARAMS_FILE, "other.yaml"], "other.yaml.* no 'ros__parameters' section"),
    ],
)
def test_words_and_files_that_cannot_be_are_one_clear_error(
    tmp_path: Path, program: str, arguments: list[str], said: str
) -> None:
    (tmp_path / "broken.yaml").write_text("/**: [")
    (tmp_path / "other.yaml").write_text("/**: {ros_parameters: {nodes: 9}}")
    is_make = program == "make run"
    command = RUN if is_make else [sys.executable, str(ROOT / "scripts" / program)]
    done = run_program(*command, *arguments, cwd=tmp_path)
    last = done.stderr.splitlines()[-1]
    assert done.returncode == 1 + is_make and "Traceback" not in done.stderr
    said = said.replace("{folder}", str(tmp_path))
    assert re.match(f"{program}: {'error: ' if is_make else '.*'}{said}", last), done.stderr


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--params-file", "/nowhere.yaml"], "no parameter file /nowhere.yaml"),
        (["-x"], "unknown arguments: ['-x']"),
    ],
)
def test_what_the_driver_cannot_start_with_is_one_line(arguments: list[str], said: str) -> None:
    done = run_program(*DRIVER, *arguments)
    assert (done.returncode, done.stderr) == (1, f"skin_driver: {said}\n")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals_end_the_driver_in_order(number: signal.Signals) -> None:
    command = [*DRIVER, "-p", "port:=sim://"]
    with started(command, stderr=subprocess.PIPE) as node:
        read_until(node, "receiving frames")
        time.sleep(0.3)
        node.send_signal(number)
        assert node.wait(PATIENCE_S) == 0
        assert node.stderr is not None
        assert node.stderr.read() == ""


ENDS_NEVER = """
import ctypes

from rclpy.node import Node

from tactile_cdma.ros.common import process


class Endless(Node):
    def destroy_node(self):
        ctypes.PyDLL(None).pause()  # holds Python's lock, as rclpy does where DDS hangs


process.END_S = 0.5
with process.running(lambda: Endless("endless")):
    print("begun", flush=True)
print("ended", flush=True)
"""


def test_a_middleware_that_never_ends_does_not_keep_the_program() -> None:
    """What stands in its way is on the error stream; what ends in time is not cut off."""
    done = run_python("-c", ENDS_NEVER)
    assert (done.returncode, done.stdout) == (1, "begun\n")
    assert "in destroy_node" in done.stderr
    slow = ENDS_NEVER.replace("pause()", "usleep(1000)").replace("END_S = 0.5", "END_S = 60")
    done = run_python("-c", slow)
    assert (done.returncode, done.stdout, done.stderr) == (0, "begun\nended\n", "")


@pytest.mark.parametrize(
    "program",
    [*sorted(ROOT.glob("scripts/*[!y_]")), ROOT / "tools" / "run.py"],
    ids=lambda path: path.name,
)
def test_ctrl_c_while_a_program_starts_ends_it_without_a_traceback(program: Path) -> None:
    command = [sys.executable, "-X", "importtime", str(program)]
    with started(command, stderr=subprocess.PIPE) as node:
        read_until(node, " numpy.version")
        node.send_signal(signal.SIGINT)
        assert node.wait(PATIENCE_S) == -signal.SIGINT
        assert node.stderr is not None
        assert "Traceback" not in node.stderr.read()


def test_the_viewer_tells_why_nothing_comes(tmp_path: Path) -> None:
    done = run_program(*RUN, "--seconds", "1", "--port", tmp_path / "nothing")
    assert done.returncode == 1
    assert f"no frame on /skin/tactile: {tmp_path / 'nothing'}: no such port" in done.stderr


def test_the_viewer_passes_on_what_the_driver_complains_of() -> None:
    done = run_program(*RUN, "--seconds", "5", "--port", "sim://?scene=idle&heartbeat=0")
    assert done.returncode == 0
    assert "0/16 taxels valid" in done.stdout
    complaint = "driver: frames arrive, but no node was heard: is the skin powered, "
    complaint += "is active_share too high?"
    assert done.stderr.splitlines().count(complaint) == 1


def test_the_viewer_counts_over_restarts_of_the_driver() -> None:
    from tactile_cdma.ros.viewers.watched import Tally

    tally = Tally()
    for info_id, sequences in ((1, [0, 1, 2, 5]), (2, [0, 1, 3]), (2, [0, 1])):
        for sequence in sequences:
            tally.add(info_id, sequence, 0.01, 100.0 + tally.received)
    assert (tally.received, tally.published, tally.lost) == (9, 12, 3)
    assert tally.rate_hz(108.5) == pytest.approx(2 / 2.5)
    assert tally.rate_hz(200.0) == 0
    tally.end(110.0)
    assert tally.mean_rate_hz == pytest.approx(8 / 10)


def test_a_first_message_that_is_late_makes_no_higher_rate() -> None:
    from tactile_cdma.ros.viewers.watched import Tally

    tally = Tally()
    for number in range(11):
        late_s = 0.05 if number else 0.75
        tally.add(1, number, late_s, 100.0 + number + late_s)
    tally.end(110.05)
    assert tally.mean_rate_hz == pytest.approx(1.0)
