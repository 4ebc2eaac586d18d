# SPDX-License-Identifier: Apache-2.0

"""The message of `make firmware-tools` if the RP2040's emulator cannot be installed."""

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
