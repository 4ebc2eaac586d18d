# SPDX-License-Identifier: Apache-2.0

"""Tools: the environment, what cannot be installed, who gets the demonstrator, the audit."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import serial

from test.support.programs import run_program, run_python
from test.support.scripts import ROOT, loaded

sys.path.append(str(Path(__file__).resolve().parents[3] / "tools"))
import audit
import firmware_tools
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
    command = ("setup_env.py", "--venv", tmp_path / "venv", "--distro", distro)
    inherited = {name: text for name, text in os.environ.items() if name != "ROS_DISTRO"}
    answer = run_python(*command, cwd=TOOLS, env={**inherited, **environment})
    assert answer.returncode == 1
    assert f"setup: error: {reason}" in answer.stderr
    assert "Traceback" not in answer.stderr
    assert list(tmp_path.iterdir()) == []


ON_ARM = "import platform; platform.machine = lambda: 'aarch64'; import setup_env as s; "


def on_arm(program: str) -> subprocess.CompletedProcess[str]:
    return run_python("-c", ON_ARM + program, cwd=TOOLS)


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


NO_NETWORK = """npm warn something else
npm error code ENOTFOUND
npm error network request to https://nowhere.example/a failed, reason: getaddrinfo ENOTFOUND
npm error A complete log of this run can be found in: /home/me/debug-0.log
"""


@pytest.mark.parametrize(
    ("version", "said", "problem"),
    [
        ("v18.0.0", NO_NETWORK, ".* failed, reason: getaddrinfo ENOTFOUND"),
        ("v20.1.0", "", ".* npm failed without a word"),
        ("v20.1.0", "Segmentation fault\n", ".* Segmentation fault"),
        ("v20.1.0", "npm ERR! code EACCES\nlast\n", ".* npm ERR! code EACCES"),
        *((old, "", "Node.js 18 or newer with npm.*") for old in ("v12.22.9", "v17.9.1", "''")),
    ],
)
def test_why_there_is_no_emulator_is_said_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: str, said: str, problem: str
) -> None:
    """With a Node.js of this version, and an npm that says this and fails."""
    (tmp_path / "said").write_text(said)
    scripts = {
        "node": f"echo {version}",
        "npm": f"while read -r line; do echo \"$line\"; done <'{tmp_path}/said' >&2; exit 1",
    }
    for name, script in scripts.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{script}\n")
        (tmp_path / name).chmod(0o755)
    (tmp_path / "package-lock.json").touch()
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(firmware_tools, "SIM", tmp_path)
    assert re.fullmatch(problem, firmware_tools.emulator_problem() or "")


@pytest.mark.parametrize(("argument", "code", "told"), [("--require", 1, False), ("", 0, True)])
def test_what_will_be_skipped_is_told_with_the_way_to_get_it(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    argument: str,
    code: int,
    told: bool,
) -> None:
    monkeypatch.setattr(firmware_tools, "PACKAGES", {"ngspice": "/no/such/file", "sh": "sh"})
    monkeypatch.setattr(firmware_tools, "OPTIONAL", {"json": "x", "sh": "x", "no_module": "get it"})
    monkeypatch.setattr(firmware_tools, "install", lambda packages: None)
    monkeypatch.setattr(firmware_tools, "emulator_problem", lambda: "Node.js 18")
    monkeypatch.setattr(sys, "argv", ["firmware_tools.py", *filter(None, [argument])])
    assert firmware_tools.main() == code
    said = capsys.readouterr()
    assert "needed on this machine: sudo apt install ngspice\n" in said.err
    skipped = "skips tests that need sudo apt install ngspice; Node.js 18; no_module (get it)\n"
    assert said.out == (f"make test: {skipped}" if told else "")


IMAGE = b"an image"


@pytest.fixture
def tool(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ModuleType:
    """tools/copy_demo.py on a machine without boards."""
    module = loaded(ROOT / "tools" / "copy_demo.py")
    (tmp_path / "demo.uf2").write_bytes(IMAGE)
    monkeypatch.setattr(sys, "argv", ["", str(tmp_path / "demo.uf2"), ""])
    monkeypatch.setattr(module, "comports", list)
    monkeypatch.setattr(module, "mounted", lambda: None)
    return module


@pytest.mark.parametrize(
    ("port", "products", "restarts"),
    [
        ("", ["Tactile skin demonstrator"], ["tty0"]),
        ("", ["Tactile skin digitizer", "Tactile skin demonstrator"], ["tty1"]),
        ("", ["Tactile skin digitizer", None], []),
        ("", 2 * ["Tactile skin demonstrator"], []),
        ("tty0", ["Tactile skin digitizer"], ["tty0"]),
    ],
)
def test_which_board_is_restarted(
    tool: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    port: str,
    products: list[str | None],
    restarts: list[str],
) -> None:
    opened: list[str] = []
    drive = tmp_path / "drive"
    drive.mkdir()

    def serial_port(name: str, baud: int) -> SimpleNamespace:
        assert baud == 1200
        opened.append(name)
        return SimpleNamespace(close=lambda: None)

    ports = [SimpleNamespace(device=f"tty{i}", product=p) for i, p in enumerate(products)]
    monkeypatch.setattr(tool, "comports", lambda: ports)
    monkeypatch.setattr(serial, "Serial", serial_port)
    monkeypatch.setattr(tool, "mounted", lambda: drive if opened else None)
    monkeypatch.setattr(tool.time, "sleep", lambda seconds: None)
    sys.argv[2] = port
    assert tool.main() == 0
    assert opened == restarts
    copied = {path.name: path.read_bytes() for path in drive.iterdir()}
    assert copied == ({"demo.uf2": IMAGE} if restarts else {})
    assert ("hold its BOOTSEL button" in capsys.readouterr().out) == (not restarts)


def test_every_requirement_has_an_upper_bound() -> None:
    assert list(audit.unbounded(audit.requirements())) == []


@pytest.mark.parametrize(
    "line", ["numpy", "numpy>=1.26", "numpy!=2.0", 'numpy>1;python_version<"4"']
)
def test_an_unbounded_requirement_is_named_with_its_file(line: str) -> None:
    [found] = audit.unbounded({"requirements.txt": ["pyserial>=3.5,<4", line]})
    assert found == f"requirements.txt: {line}: no upper bound"


def test_a_package_of_npm_without_its_hash_is_named() -> None:
    locked = {"": {"name": "own"}, "node_modules/a": {"integrity": "sha512-x"}}
    assert list(audit.unlocked({"packages": locked})) == []
    for package in ({}, {"integrity": "sha1-x"}):
        [found] = audit.unlocked({"packages": {**locked, "node_modules/b": package}})
        assert "node_modules/b" in found


def test_vulnerabilities_are_told_with_what_mends_them() -> None:
    """In the form in which pip-audit 2.10 writes them."""
    found = {"id": "PYSEC-2099-1", "fix_versions": ["3.6"], "aliases": [], "description": ""}
    dependencies = [
        {"name": "numpy", "version": "2.4.6", "vulns": []},
        {"name": "ours", "skip_reason": "not on PyPI"},
        {"name": "pyserial", "version": "3.5", "vulns": [found, {**found, "fix_versions": []}]},
    ]
    assert list(audit.told(dependencies)) == [
        "pyserial 3.5: PYSEC-2099-1, mended in 3.6",
        "pyserial 3.5: PYSEC-2099-1, mended in no version",
    ]


@pytest.mark.parametrize(
    ("complaint", "reason"),
    [
        ("trace\nrequests.exceptions.ConnectionError: HTTPSConnectionPool", "cannot be reached"),
        ("/usr/bin/python3: No module named pip_audit\n", "No module named pip_audit"),
        ("", "said nothing"),
    ],
)
def test_advisories_that_cannot_be_had_are_no_clean_bill(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], complaint: str, reason: str
) -> None:
    program = f"import sys; sys.exit({complaint!r})"
    monkeypatch.setattr(audit, "TOOL", [sys.executable, "-c", program])
    monkeypatch.setattr(audit, "misfits", list)
    assert audit.main() == 2
    out, err = capsys.readouterr()
    assert out == "problems=0 advisories=unknown\n"
    assert reason in err and len(err.splitlines()) == 1
