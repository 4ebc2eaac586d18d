# SPDX-License-Identifier: Apache-2.0

"""tools/setup_env.py: what it is based on, what it refuses, and where it goes on."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from test.support.programs import run_program, run_python

sys.path.append(str(Path(__file__).resolve().parents[3] / "tools"))
import setup_env

TOOLS = Path(setup_env.__file__).parent
CHOOSE = "import setup_env; print(setup_env.choose_interpreter(any_version=True))"


def test_inside_a_venv_the_interpreter_is_the_same(tmp_path: Path) -> None:
    """Else `make` with .venv activated would make .venv anew, and once more without."""
    base = tmp_path / "python3"
    base.symlink_to(Path(sys._base_executable).resolve())  # type: ignore[attr-defined]
    subprocess.run([base, "-m", "venv", "--without-pip", tmp_path / "venv"], check=True)

    def chosen(python: Path) -> str:
        return run_program(python, "-c", CHOOSE, cwd=TOOLS, check=True).stdout

    assert chosen(base) == chosen(tmp_path / "venv" / "bin" / "python")


def setup(tmp_path: Path, distro: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = ("setup_env.py", "--venv", tmp_path / "venv", "--distro", distro)
    inherited = {name: text for name, text in os.environ.items() if name != "ROS_DISTRO"}
    return run_python(*command, cwd=TOOLS, env={**inherited, **environment})


@pytest.mark.parametrize(
    "distro, environment, reason",
    [
        ("humbel", {}, "DISTRO=humbel: PyPI has ROS 2 only as jazzy and kilted"),
        ("kilted", {"ROS_DISTRO": "jazzy"}, "DISTRO=kilted was asked for, but ROS 2 jazzy is"),
    ],
)
def test_a_distribution_that_cannot_be_had_is_refused_before_anything_is_made(
    tmp_path: Path, distro: str, environment: dict[str, str], reason: str
) -> None:
    answer = setup(tmp_path, distro, **environment)
    assert answer.returncode == 1
    assert f"setup: error: {reason}" in answer.stderr
    assert "Traceback" not in answer.stderr
    assert list(tmp_path.iterdir()) == []


ON_ARM = "import platform; platform.machine = lambda: 'aarch64'; import setup_env as s; "


def on_arm(program: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", ON_ARM + program]
    return subprocess.run(command, cwd=TOOLS, capture_output=True, text=True)


def test_where_pypi_has_no_ros_all_else_is_set_up() -> None:
    """But an installation's ROS is used, and a distribution that is asked for refused."""
    chosen = on_arm("print(s.choose_distro('', '') == s.NO_ROS, s.choose_distro('', 'jazzy'))")
    assert chosen.stdout.split() == ["True", "jazzy"]
    refused = on_arm("s.choose_distro('kilted', '')").stderr
    assert "DISTRO=kilted: PyPI has no ROS 2 for aarch64, only for x86_64" in refused


def test_distributions_from_pypi_bring_the_same_packages() -> None:
    """But for build tools, which were renamed between them."""
    packages = {
        path.name: {
            match[1]
            for line in path.read_text().splitlines()
            if (match := re.match(r"ros-[a-z]+-((?!ament|python)[a-z-]+)", line))
        }
        for path in TOOLS.parent.glob("requirements-*.txt")
    }
    assert packages["requirements-jazzy.txt"] == packages["requirements-kilted.txt"]


BUILD = ["colcon", "import rclpy, tactile_cdma.msg"]


@pytest.mark.parametrize(
    "stopped, again",
    [
        ("venv", ["venv", "pip", *BUILD]),
        ("pip", ["venv", "pip", *BUILD]),  # with what pip has in its cache
        *((step, BUILD) for step in BUILD),
    ],
)
def test_a_set_up_that_was_stopped_goes_on_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stopped: str, again: list[str]
) -> None:
    """As after kill -9: nothing that ends in order tells the next run."""
    done: list[str] = []
    stops = [stopped]

    def run(command: list[str], log: Path, *_: object, **__: object) -> None:
        step = command[2] if command[1] in ("-m", "-c") else command[0]
        done.append(step)
        if step in stops:
            raise KeyboardInterrupt(stops.pop())
        if step == "venv":
            (tmp_path / "venv" / "bin").mkdir(parents=True, exist_ok=True)
            (tmp_path / "venv" / "bin" / "python").touch()

    monkeypatch.delenv("ROS_DISTRO", raising=False)
    for name, stand_in in {
        "run": run,
        "has_wheels": lambda: True,
        "require_tools": lambda *_: None,
        "output": lambda _: f"{tmp_path}\n{tmp_path}",
    }.items():
        monkeypatch.setattr(setup_env, name, stand_in)
    with pytest.raises(KeyboardInterrupt):
        setup_env.set_up(tmp_path / "venv", "")
    assert done.pop() == stopped
    done.clear()
    setup_env.set_up(tmp_path / "venv", "")
    assert done == again
    setup_env.set_up(tmp_path / "venv", "")
    assert done == again, "a third one has nothing to do"
