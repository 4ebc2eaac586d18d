# SPDX-License-Identifier: Apache-2.0

"""Tests stand alone, and a worker of pytest that dies, or hangs, fails the test that it was at."""

import ast
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from test.support.domains import own_domain
from test.support.programs import run_python

ROOT = Path(__file__).resolve().parents[3]
TEST = ROOT / "test"
SUPPORT = TEST / "support"


def imported(path: Path) -> Iterator[str]:
    """Full names of the modules that a file imports from elsewhere than its own folder."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("folder", ["test", "torture", "benchmarks"])
def test_what_tests_share_is_in_test_support(folder: str) -> None:
    own = {path.stem for path in TEST.rglob("*.py")} - {path.stem for path in SUPPORT.glob("*.py")}
    for path in (ROOT / folder).rglob("*.py"):
        for name in imported(path):
            parts = name.split(".")
            assert parts[0] not in own, f"{path} imports {name}, a test's module"
            assert parts[0] != "test" or parts[:2] == ["test", "support"], f"{path}: {name}"


def test_the_package_needs_no_test() -> None:
    for path in (ROOT / "tactile_cdma").rglob("*.py"):
        outside = [name for name in imported(path) if name.split(".")[0] in ("test", "torture")]
        assert not outside, f"{path} imports {outside}"


def test_no_domain_is_given_twice() -> None:
    another = "from test.support.domains import own_domain; print(own_domain())"
    mine = {own_domain(str(key)) for key in range(5)}
    assert len(mine) == 5 and own_domain() == int(os.environ["ROS_DOMAIN_ID"]) not in mine
    for _ in range(3):
        found = run_python("-c", another, check=True).stdout
        assert int(found) not in mine | {own_domain()}


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
