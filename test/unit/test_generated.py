# Copyright 2026 tactile_cdma maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""What firmware/generate.py writes is up to date, and its --check would tell if it weren't."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("yaml", reason="pyyaml, which the generator needs, is not installed")
ROOT = Path(__file__).parents[2]
PACKAGE = (
    "__init__",
    "_protocol",
    "cobs",
    "codes",
    "errors",
    "frame",
    "messages",
    "paley",
    "protocol",
)
"""What the generator needs of the package."""


def generate(root: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(root / "firmware" / "generate.py"), *arguments],
        capture_output=True,
        text=True,
        timeout=60,
    )


def test_generated_files_are_fresh() -> None:
    result = generate(ROOT, "--check")
    assert result.returncode == 0, result.stdout + result.stderr


def test_check_tells_what_is_stale_and_writes_nothing(tmp_path: Path) -> None:
    for folder in ("firmware", "docs"):
        shutil.copytree(ROOT / folder, tmp_path / folder)
    (tmp_path / "tactile_cdma").mkdir()
    for module in PACKAGE:
        shutil.copy(ROOT / "tactile_cdma" / f"{module}.py", tmp_path / "tactile_cdma")
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
            "tactile_cdma/_protocol.py",
        )
    }

    checked = generate(tmp_path, "--check")
    assert checked.returncode == 1, checked.stdout + checked.stderr
    assert {line.partition(":")[0] for line in checked.stdout.splitlines()} == set(stale)
    assert all((tmp_path / path).read_bytes() == content for path, content in stale.items())

    assert generate(tmp_path).returncode == 0
    assert all((tmp_path / path).read_bytes() != content for path, content in stale.items())
    assert generate(tmp_path, "--check").returncode == 0
