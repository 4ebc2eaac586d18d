# SPDX-License-Identifier: Apache-2.0

"""All that needs no tty of POSIX runs without the modules and names that Windows lacks.

`make portable-test` runs the unit tests of the way from bytes to datasets like this.
"""

from pathlib import Path

from test.support.programs import run_python

ROOT = Path(__file__).resolve().parents[3]
FILES = (path.relative_to(ROOT) for path in (ROOT / "tactile_cdma").rglob("*.py"))
OPTIONAL = "ros", "rerun_scene.py"
"""Folder and module that import what a driver does without."""
MODULES = sorted(
    ".".join(file.with_suffix("").parts) for file in FILES if not {*file.parts} & {*OPTIONAL}
)
BLOCKED = "import test.support.windows\n"
IMPORTS = f"""
{BLOCKED}
import importlib, sys
for name in sys.argv[1:]:
    importlib.import_module(name)
"""
USES = f"""
{BLOCKED}
import sys
from pathlib import Path
from tactile_cdma import Decoder, Skin, read_recording
from tactile_cdma.commands.cli import main

with Skin("sim://?scene=all&threshold=0", nodes=16) as skin:
    frames = [skin.read() for _ in range(5)]
assert all(frame.active.all() and not frame.doubtful.any() for frame in frames)
path = Path(sys.argv[1], "touch.skin")
assert main(["record", "sim://?scene=all", str(path), "--seconds", "1"]) == 0
decoder = Decoder(nodes=16)
decoded = [frame for data, t_s in read_recording(path) for frame in decoder.feed(data, t_s)]
assert len(decoded) > 10
for suffix in ("npz", "csv", "parquet"):
    target = path.with_suffix(f".{{suffix}}")
    assert main(["export", str(path), "-o", str(target)]) == 0 and target.stat().st_size
assert main(["export", str(path), "--lerobot", str(path.with_suffix("")), "--fps", "30"]) == 0
assert main(["info", str(path)]) == 0
assert main(["doctor", "sim://", "--seconds", "0.5"]) == 0
assert main(["simulate", "--pty", "--seconds", "1"]) == 1
"""
"""What a program and the command do with a simulated skin; only `simulate` needs a tty."""


def test_every_module_but_optional_ones_is_imported() -> None:
    run = run_python("-c", IMPORTS, *(name for name in MODULES if "__" not in name), cwd=ROOT)
    assert run.returncode == 0, run.stderr


def test_a_skin_is_read_recorded_and_exported(tmp_path: Path) -> None:
    run = run_python("-X", "warn_default_encoding", "-c", USES, tmp_path, cwd=ROOT)
    assert run.returncode == 0, run.stderr
    assert "this system has no pseudo-terminals: use the port sim://" in run.stderr
    ours = [line for line in run.stderr.splitlines() if "tactile_cdma" in line]
    assert not [line for line in ours if "EncodingWarning" in line], "of Windows, not UTF-8"


def test_what_is_blocked_is_missed(tmp_path: Path) -> None:
    """Else the tests above would show nothing."""
    for needs in ("import fcntl", "import pty", "import os; os.O_NOCTTY", "os.register_at_fork"):
        run = run_python("-c", f"{BLOCKED}import os\n{needs}", cwd=ROOT)
        assert run.returncode == 1 and "Error" in run.stderr, needs
