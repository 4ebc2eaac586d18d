# SPDX-License-Identifier: Apache-2.0

"""Code blocks of README and docs run as documented, or a reason why not is known.

Each page has a folder of its own, with config/ and examples/ beside it and the files that a reader
has made by then. Commands run in the order of the page.
"""

from __future__ import annotations

import contextlib
import doctest
import io
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from tactile_cdma.base.errors import TactileError
from tactile_cdma.commands.cli import main
from tactile_cdma.config.body_file import read_body
from tactile_cdma.config.parameters import DEFAULTS, read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.readings.calibration_file import read_any, seal_calibration
from tactile_cdma.sim.options import SimOptions
from test.support import simulated
from test.support.page_blocks import (
    NOT_RUN,
    PAGES,
    ROOT,
    SAYS_NOTHING_TO_RUN,
    Block,
    blocks,
    reason,
)
from test.support.programs import run_program, run_python, started

Record = Callable[[str, object], None]
ENDLESS = re.compile(r"^ *for frame in skin:(?!.*break)", re.MULTILINE | re.DOTALL)
NEEDS_A_POLICY = re.compile(r"policy\(")
LOADS_KPA = (0, 5, 10, 20, 30, 40, 50, 60, 80, 100, 120, 140)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder as a reader has it."""
    for name in ("config", "examples"):
        shutil.copytree(ROOT / name, tmp_path / name)
    shutil.copytree(ROOT / "config" / "layouts", tmp_path / "layouts")
    for name, nodes in (("skin", 16), ("my_skin", 72)):
        (tmp_path / f"{name}.yaml").write_text(f"/**:\n  ros__parameters: {{nodes: {nodes}}}\n")
    shutil.copy(ROOT / "examples" / "scope.csv", tmp_path)
    shutil.copy(ROOT / "config" / "layouts" / "cylinder.yaml", tmp_path / "my_layout.yaml")
    loads = [f"{n},{kpa},{volts(kpa):.4f}" for n in range(1, 17) for kpa in LOADS_KPA]
    (tmp_path / "loads.csv").write_text("\n".join(["node,pressure_kpa,voltage_v", *loads]) + "\n")
    for name in ("touch", "one", "plain"):
        simulated.recording(tmp_path / f"{name}.skin", SimOptions(threshold=0), 1.0)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def volts(kpa: float) -> float:
    """The paper's curve, V."""
    return 3.2 - 0.033 * min(kpa, 50) - 0.0059 * max(kpa - 50, 0)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_code_blocks_run_as_documented(page: Path, folder: Path, record_property: Record) -> None:
    run, wrong = 0, list[str]()
    python = [block for block in blocks(page) if block.is_python and ">>>" in block.text]
    run += session(page, python)
    for block in blocks(page):
        if block in python or block.why_not:
            continue
        done, problem = one(block, folder)
        run += done
        wrong += [f"{block.place}: {problem}"] if problem else []
    record_property("blocks_run", run)
    assert wrong == []


def one(block: Block, folder: Path) -> tuple[bool, str]:
    """Run a block; whether something of it ran, and what is wrong."""
    if block.commands:
        chosen = [command for command in block.commands if not reason(command)]
        problems = [f"{command}: {said}" for command in chosen if (said := command_fails(command))]
        return bool(chosen), "; ".join(problems)
    if block.is_python:
        return program(block, folder)
    if block.is_yaml:
        return True, file(block, folder)
    if block.language == "xml":
        return True, xacro(block, folder)
    return False, f"neither a command, a file nor a program, and no reason known:\n{block.text}"


def command_fails(command: str) -> str:
    """Run a command; what it says if it fails."""
    command = re.sub(r"^python ", f"{sys.executable} ", command)
    if not command.startswith("tactile-cdma "):
        path = os.pathsep.join((str(ROOT), os.environ.get("PYTHONPATH", "")))
        where = ROOT if command.startswith("make ") else None
        done = run_program("sh", "-c", command, cwd=where, env={**os.environ, "PYTHONPATH": path})
        return done.stderr if done.returncode else ""
    for file_ in re.findall(r"(?:-o|--png|--table|--video) (\S+)", command):
        taken = Path(file_)
        shutil.rmtree(taken) if taken.is_dir() else taken.unlink(missing_ok=True)
    said = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(said):
        try:
            code = main(shlex.split(command)[1:])
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
    return said.getvalue()[-500:] if code else ""


def session(page: Path, python: list[Block]) -> int:
    """Run the interactive examples of a page, one after the other, as one session."""
    text = "\n".join(block.text for block in python)
    test = doctest.DocTestParser().get_doctest(text, {}, page.name, str(page), 0)
    said = list[str]()
    results = doctest.DocTestRunner().run(test, out=said.append)
    assert results.failed == 0, "".join(said)
    return len(python)


def program(block: Block, folder: Path) -> tuple[bool, str]:
    """Run a program; of an endless one, until it has printed three lines."""
    if NEEDS_A_POLICY.search(block.text):
        compile(block.text, block.place, "exec")
        return False, ""
    if "@pytest.mark" in block.text:
        (folder / "test_page.py").write_text(block.text)
        plugin = "tactile_cdma.testing.plugin"
        done = run_python("-m", "pytest", "-q", "-p", plugin, "test_page.py", cwd=folder)
        return True, "" if done.returncode == 0 else done.stdout[-1000:]
    name = re.match(r"# (\w+\.py)\n", block.text)
    path = folder / (name[1] if name else "program.py")
    path.write_text(block.text)
    if not ENDLESS.search(block.text):
        done = run_python(path)
        return True, done.stderr
    with started([sys.executable, "-u", path], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        lines = [process.stdout.readline() for _ in range(3)]
        process.send_signal(signal.SIGINT)
    return True, "" if all(lines) else f"it printed {lines}"


def file(block: Block, folder: Path) -> str:
    """Have a file read by what it is for; what is wrong with it."""
    path = folder / f"{block.page.stem}_{block.line}.yaml"
    path.write_text(block.text, encoding="utf-8")
    content = yaml.safe_load(block.text)
    if "patches" in content:
        for patch in read_body(path).patches:  # as each driver does, its layout included
            SkinConfig.of({**DEFAULTS, **patch.values})
    elif content.get("schema") == "tactile_cdma/calibration":
        before = read_any(path)
        assert before.curves and seal_calibration(path)
    elif "ros__parameters" in block.text:
        read_file(path)
    else:
        read_file(_as_parameters(path, content))
    return ""


def _as_parameters(path: Path, content: object) -> Path:
    path.write_text(yaml.safe_dump({"/**": {"ros__parameters": content}}), encoding="utf-8")
    return path


def xacro(block: Block, folder: Path) -> str:
    """Expand a robot description; what is wrong with it."""
    pytest.importorskip("xacro")
    text = block.text.replace("$(find tactile_cdma)", str(ROOT))
    (folder / "hand.urdf.xacro").write_text(text, encoding="utf-8")
    done = run_python("-c", "import xacro; xacro.main()", "hand.urdf.xacro")
    return "" if "left_palm" in done.stdout else done.stderr


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("    tactile-cdma info no.skin\n", "no.skin: No such file"),
        ("    tactile-cdma look sim://\n", "invalid choice: 'look'"),
        ("    port: 5\n", "port must be a text"),
        ("    anything else\n", "no reason known"),
        ("```python\nraise SystemExit(f)\n```\n", "name 'f' is not defined"),
        ("```python\n>>> 1 + 1\n3\n\n```\n", "Expected"),
    ],
)
def test_a_block_that_fails_is_seen(folder: Path, text: str, said: str) -> None:
    page = folder / "page.md"
    page.write_text(f"# A page\n\n{text}")
    [block] = blocks(page)
    with pytest.raises((AssertionError, TactileError), match=said):
        if ">>>" in text:
            session(page, [block])
        raise AssertionError(one(block, folder)[1])


def test_every_reason_is_one_that_a_block_has() -> None:
    found = [block for page in PAGES for block in blocks(page)]
    assert set(NOT_RUN) < {reason(command) for block in found for command in block.commands}
    assert set(SAYS_NOTHING_TO_RUN) < {block.why_not for block in found}
