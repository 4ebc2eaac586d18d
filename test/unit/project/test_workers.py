# SPDX-License-Identifier: Apache-2.0

"""A worker of pytest that dies, or hangs, fails the test that it was at; nothing waits for it."""

import os
import subprocess
from pathlib import Path

import pytest

from test.support.programs import run_python

ROOT = Path(__file__).resolve().parents[3]
LETHAL = """
import os, signal, time
import pytest

@pytest.fixture(scope="module")
def dying():
    yield
    os.kill(os.getpid(), signal.SIGSEGV)

@pytest.mark.parametrize("i", range(8))
def test_sound(i):
    pass

def test_lethal():
    os.kill(os.getpid(), signal.SIGSEGV)

@pytest.mark.xdist_group("group")
@pytest.mark.parametrize("i", range(4))
def test_grouped(i):
    if i == 1:
        os.kill(os.getpid(), signal.SIGSEGV)

def test_hung():
    signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
    time.sleep(3600)
"""
LAST = LETHAL.split("@pytest.mark")[0] + "def test_last(dying):\n    pass\n"
PLUGINS = ("-p", "xdist.plugin", "-p", "test.support.workers", "-p", "no:cacheprovider")


def run(folder: Path, text: str, *options: str) -> subprocess.CompletedProcess[str]:
    (folder / "test_these.py").write_text(text)
    command = ("-m", "pytest", *PLUGINS, "--dist", "loadgroup", "-q", *options)
    environment = {**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    return run_python(*command, "-c", "/dev/null", folder, cwd=ROOT, env=environment)


@pytest.mark.slow
def test_what_kills_a_worker_has_failed_and_the_others_are_run(tmp_path: Path) -> None:
    limits = ("-o", "faulthandler_timeout=3", "-o", "faulthandler_exit_on_timeout=true")
    ended = run(tmp_path, LETHAL, "-n", "2", *limits)
    assert ended.returncode == pytest.ExitCode.TESTS_FAILED, ended.stdout
    assert "3 failed, 11 passed" in ended.stdout
    for name in ("test_lethal", "test_grouped[1]", "test_hung"):
        assert f"crashed while running 'test_these.py::{name}" in ended.stdout


@pytest.mark.slow
def test_a_worker_that_dies_after_its_last_test_is_told(tmp_path: Path) -> None:
    ended = run(tmp_path, LAST, "-n", "1")
    assert "1 passed" in ended.stdout
    assert ended.returncode == pytest.ExitCode.TESTS_FAILED


WAITING = """
import time
import pytest

@pytest.mark.parametrize("i", range(6))
def test_waits(i):
    time.sleep(0.2)
"""


@pytest.mark.slow
def test_what_waits_and_what_computes_are_run_side_by_side(tmp_path: Path) -> None:
    (tmp_path / "ros").mkdir()
    (tmp_path / "ros" / "test_waits.py").write_text(WAITING)
    ended = run(tmp_path, WAITING.replace("waits", "computes"), "-n", "2", "-vv")
    order = [line.partition("PASSED")[2] for line in ended.stdout.splitlines()]
    kinds = ["ros/" in test for test in order if "test_" in test]
    assert len(kinds) == 12 and 2 <= sum(kinds[:6]) <= 4, ended.stdout
