# SPDX-License-Identifier: Apache-2.0

"""Drivers where they run on robots: in containers, without a home, with another Python on PATH."""

import os
import shutil
import signal
import subprocess
import sys
import venv
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tactile_cdma.srv import Tare
from test.support.programs import run_program
from test.support.skin_client import Client
from test.support.spinning import spinning
from test.support.users import NAMELESS, ordinary
from test.support.waiting import PATIENCE_S, wait_for

ROOT = Path(__file__).resolve().parents[2]
DRIVER = ROOT / "scripts" / "skin_driver"
HOMELESS = {name: text for name, text in os.environ.items() if name not in ("HOME", "ROS_HOME")}
ASCII = {"LC_ALL": "POSIX", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


@contextmanager
def receiving(
    said: Path, prefix: list[str], environment: dict[str, str], node: str = "skin"
) -> Iterator["subprocess.Popen[bytes]"]:
    """A driver that receives frames, in other namespaces of Linux; said: the file of its log."""
    if os.geteuid() or not shutil.which("unshare"):
        pytest.skip("only root may make namespaces, with unshare (Debian: util-linux)")
    words = ("--ros-args", "-p", "port:=sim://?scene=idle", "-r", f"__node:={node}")
    command = ["unshare", *prefix, sys.executable, DRIVER, *words]
    with said.open("wb") as file, subprocess.Popen(command, env=environment, stderr=file) as driver:
        try:
            wait_for(lambda: "receiving frames" in said.read_text() or driver.poll() is not None)
            assert driver.poll() is None, said.read_text()
            yield driver
        finally:
            driver.kill()


def test_as_process_1_of_a_user_without_name_and_home_it_runs_and_ends_when_told(
    tmp_path: Path,
) -> None:
    said = tmp_path / "said"
    prefix = ["--pid", "--fork", "--kill-child", *ordinary(NAMELESS, NAMELESS)]
    with receiving(said, prefix, HOMELESS) as unshare:
        children = Path(f"/proc/{unshare.pid}/task/{unshare.pid}/children").read_text().split()
        os.kill(int(children[0]), signal.SIGTERM)  # as `docker stop`
        assert unshare.wait(PATIENCE_S) == 0, said.read_text()
    assert "no log file is written: HOME is not set" in said.read_text()
    assert "tare and drift are not kept: the user after ~ has no home" in said.read_text()


def test_on_a_read_only_disk_in_an_ascii_locale_a_tare_says_that_it_is_in_memory(
    tmp_path: Path,
) -> None:
    said, home = tmp_path / "said", tmp_path / "home"
    home.mkdir()
    prefix = ["--mount", "sh", "-c", 'mount -t tmpfs -o ro none "$0" && exec "$@"', str(home)]
    client, environment = Client("/read_only"), {**HOMELESS, **ASCII, "HOME": str(home)}
    with receiving(said, prefix, environment, "read_only") as driver, spinning([client]):
        answer: Tare.Response = client.call(Tare, "tare", Tare.Request(wait=PATIENCE_S))
        driver.send_signal(signal.SIGHUP)  # its terminal has gone
        assert driver.wait(PATIENCE_S) == 0, said.read_text()
    assert answer.success
    assert "are taken off; in memory only: " in answer.message
    assert answer.message.endswith("tare and drift are not kept: Read-only file system")
    assert f"no log file is written: {home}/.ros/log: Read-only file system" in said.read_text()


@pytest.mark.parametrize("other", ["", "/opt/ros/new/lib/python3.99/site-packages"])
def test_a_python_that_has_no_ros_is_named_in_one_line(tmp_path: Path, other: str) -> None:
    venv.create(tmp_path, with_pip=False)  # as conda's, first on PATH
    own = {"PATH": f"{tmp_path}/bin:{os.environ['PATH']}", "PYTHONPATH": f"{ROOT}:{other}"}
    done = run_program(DRIVER, env={**os.environ, **own})
    assert done.returncode == 1
    [line] = done.stderr.splitlines()
    python = f"{tmp_path}/bin/python3 (Python {sys.version_info.major}.{sys.version_info.minor})"
    assert line.startswith(f"skin_driver: cannot run by {python}: No module named ")
    assert ("has Python 3.99: take the other one off PATH" in line) == bool(other)
