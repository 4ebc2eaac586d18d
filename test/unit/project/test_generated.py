# SPDX-License-Identifier: Apache-2.0

"""The files that firmware/generate.py writes are up to date, and its --check detects stale ones."""

import shutil
import subprocess
from pathlib import Path

import pytest

from test.support.programs import run_python

pytest.importorskip("yaml", reason="pyyaml, which the generator needs, is not installed")
ROOT = Path(__file__).parents[3]


def generate(root: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return run_python(root / "firmware" / "generate.py", *arguments)


def test_generated_files_are_fresh() -> None:
    result = generate(ROOT, "--check")
    assert result.returncode == 0, result.stdout + result.stderr


def test_check_tells_what_is_stale_and_writes_nothing(tmp_path: Path) -> None:
    for folder in ("firmware", "docs", "config", "tactile_cdma"):
        shutil.copytree(ROOT / folder, tmp_path / folder)
    definition = tmp_path / "firmware" / "protocol.yaml"
    text = definition.read_text(encoding="utf-8")
    changed = text.replace("range: [8, 16]", "range: [8, 15]")
    assert changed != text
    definition.write_text(changed, encoding="utf-8")
    stale = {
        path: (tmp_path / path).read_bytes()
        for path in (
            "docs/protocol.md",
            "firmware/core/tactile_protocol.h",
            "tactile_cdma/wire/_protocol.py",
        )
    }

    checked = generate(tmp_path, "--check")
    assert checked.returncode == 1, checked.stdout + checked.stderr
    assert {line.partition(":")[0] for line in checked.stdout.splitlines()} == set(stale)
    assert all((tmp_path / path).read_bytes() == content for path, content in stale.items())

    assert generate(tmp_path).returncode == 0
    assert all((tmp_path / path).read_bytes() != content for path, content in stale.items())
    assert generate(tmp_path, "--check").returncode == 0
