# SPDX-License-Identifier: Apache-2.0

"""The completion of tactile-cdma, asked by bash."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from tactile_cdma.commands.cli import SUBCOMMANDS, main

ASK = """
source "$1"; shift
COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMPREPLY=()
_tactile_cdma
printf '%s\\n' "${COMPREPLY[@]}"
complete -p tactile-cdma >&2
"""


@pytest.fixture
def script(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    if shutil.which("bash") is None:
        pytest.skip("bash is not installed")
    assert main(["completion"]) == 0
    path = tmp_path / "completion"
    path.write_text(capsys.readouterr().out)
    return path


@pytest.mark.parametrize(
    ("line", "completions"),
    [
        (("",), set(SUBCOMMANDS)),
        (("de",), {"decode"}),
        (("decode", "scope.csv", "--tim"), {"--timing"}),
        (("decode", "scope.csv", "--timing", ""), {"line", "gap"}),
        (("decode", "scope.csv", "--timing", "g"), {"gap"}),
        (("export", "touch.skin", "--b"), {"--bag", "--bits"}),
        (("export", ""), set()),
        (("unknown", "--b"), set()),
    ],
)
def test_bash_completes(script: Path, line: tuple[str, ...], completions: set[str]) -> None:
    command = ["bash", "-c", ASK, "bash", str(script), "tactile-cdma", *line]
    answer = subprocess.run(command, capture_output=True, text=True, check=True)
    assert set(answer.stdout.split()) == completions
    assert "-o default" in answer.stderr, "what is no command and no option is a file"
