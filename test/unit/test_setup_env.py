"""The environment's own tool: what it stamps must not depend on where it is called from."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

TOOLS = Path(__file__).resolve().parents[2] / "tools"
CHOOSE = "import setup_env; print(setup_env.choose_interpreter(any_version=True))"


def test_inside_a_venv_the_interpreter_is_the_same(tmp_path: Path) -> None:
    """Else `make` with .venv activated would make .venv anew, and once more without."""
    base = tmp_path / "python3"
    base.symlink_to(Path(sys._base_executable).resolve())  # type: ignore[attr-defined]
    subprocess.run([base, "-m", "venv", "--without-pip", tmp_path / "venv"], check=True)

    def chosen(python: Path) -> str:
        command = [python, "-c", CHOOSE]
        return subprocess.run(command, cwd=TOOLS, capture_output=True, text=True, check=True).stdout

    assert chosen(base) == chosen(tmp_path / "venv" / "bin" / "python")
