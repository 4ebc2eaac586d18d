# SPDX-License-Identifier: Apache-2.0

"""What `make firmware-tools` and `make test` say of what cannot be installed."""

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).resolve().parents[3] / "tools"))
import firmware_tools

NO_NETWORK = """npm warn something else
npm error code ENOTFOUND
npm error network request to https://nowhere.example/a failed, reason: getaddrinfo ENOTFOUND
npm error A complete log of this run can be found in: /home/me/debug-0.log
"""


def emulator_problem(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: str, stderr: str = "", code: int = 1
) -> str | None:
    """What is wrong, with a Node.js of this version and an npm that says this."""
    (tmp_path / "said").write_text(stderr)
    scripts = {
        "node": f"echo {version}",
        "npm": f"while read -r line; do echo \"$line\"; done <'{tmp_path}/said' >&2; exit {code}",
    }
    for name, script in scripts.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{script}\n")
        (tmp_path / name).chmod(0o755)
    (tmp_path / "package-lock.json").touch()
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(firmware_tools, "SIM", tmp_path)
    return firmware_tools.emulator_problem()


def test_npm_without_network_is_reported_with_its_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = emulator_problem(tmp_path, monkeypatch, "v18.0.0", NO_NETWORK)
    assert problem is not None and problem.endswith("failed, reason: getaddrinfo ENOTFOUND")


@pytest.mark.parametrize("said", ["", "Segmentation fault\n", "npm ERR! code EACCES\nlast\n"])
def test_whatever_npm_says_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: str
) -> None:
    problem = emulator_problem(tmp_path, monkeypatch, "v20.1.0", said)
    assert problem is not None and "\n" not in problem
    assert problem.endswith(said.split("\n")[0] or "npm failed without a word")


@pytest.mark.parametrize("version", ["v12.22.9", "v17.9.1", "''"])
def test_nodejs_too_old_is_told_before_npm_is_tried(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: str
) -> None:
    problem = emulator_problem(tmp_path, monkeypatch, version)
    assert problem is not None and problem.startswith("Node.js 18 or newer with npm")


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
