# SPDX-License-Identifier: Apache-2.0

"""`tactile-cdma examples`: what documents name, in a folder of the user's, as documents name it."""

from pathlib import Path

import pytest

from test.support.command_line import Printed, Refused

ROOT = Path(__file__).resolve().parents[3]


def test_it_copies_what_documents_name(
    printed: Printed, refused: Refused, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "new"
    printed("examples", folder)
    monkeypatch.chdir(folder)
    for name in ("config/layouts/cylinder.yaml", "examples/mujoco_skin.py", "urdf/skin.urdf.xacro"):
        assert Path(name).read_bytes() == (ROOT / name).read_bytes()
    printed("layout", "config/layouts/cylinder.yaml")
    printed("decode", "examples/scope.csv", "--params", "config/paper_skin.yaml")
    assert not list(folder.rglob("__pycache__"))
    Path("config/skin.yaml").write_text("own")
    assert "config: File exists" in refused("examples", folder)
    assert Path("config/skin.yaml").read_text() == "own"
