# SPDX-License-Identifier: Apache-2.0

"""What programs print: text of others, and output that is closed, full, or read no further."""

import contextlib
import re
import sys
from importlib import import_module
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.base.errors import PortError
from tactile_cdma.base.program import Drawn, program, say, tell
from test.support import simulated
from test.support.bags import BagMaker
from test.support.programs import run_program

ROOT = Path(__file__).resolve().parents[3]
PYTHON = f"{sys.executable} -m tactile_cdma"
EVIL = "\x1b]0;owned\x07\x1b[2J\u202e\x9b31m"
ANYTHING = st.text(st.characters(codec=None), max_size=60)
"""With lone surrogates, as names of files that are no UTF-8 have them."""


def shown(capsys: pytest.CaptureFixture[str], *texts: str) -> list[str]:
    """Lines of what a program that prints these, and raises, writes to stdout and stderr."""

    @program("some")
    def main() -> int:
        for text in texts:
            print(text)
            say(text)
            tell(text)
            sys.stdout.write(Drawn("\x1b[H"))
        raise PortError(texts[0])

    capsys.readouterr()
    assert main() == 1
    return [*"".join(capsys.readouterr()).replace("\x1b[H", "").split("\n")]


def test_nothing_reaches_the_terminal_raw_but_what_is_drawn(
    capsys: pytest.CaptureFixture[str],
) -> None:
    @given(ANYTHING)
    def check(text: str) -> None:
        lines = shown(capsys, text)
        assert all(map(str.isprintable, lines))
        told = text.encode("unicode_escape").decode().replace("\\\\", "\\")
        if text.isascii() and "\n" not in text:
            assert lines.count(told) >= 2 and f"some: {told}" in lines, "none of it is lost"

    check()


def test_headings_topics_and_arguments_cannot_command_a_terminal(tmp_path: Path) -> None:
    scope = (ROOT / "examples/scope.csv").read_text().splitlines()[2:400]
    (tmp_path / "scope.csv").write_text("\n".join([f"x-axis,{EVIL}", "second,Volt", *scope]))
    bag = BagMaker().skin(f"/{EVIL}", 1.0).write(tmp_path / "bag")
    for words in ("decode", tmp_path / "scope.csv"), ("info", bag), (EVIL,), ("layout", EVIL):
        done = run_program(*PYTHON.split(), *words, cwd=ROOT)
        said = done.stdout + done.stderr
        assert r"\x1b]0;owned\x07\x1b[2J\u202e\x9b31m" in said
        assert all(map(str.isprintable, said.split("\n")))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "skin.skin"
    return simulated.recording(path, simulated.SimOptions(scene="all", seed=3), 2.0)


FULL = r"tactile-cdma: \[Errno 28\] No space left on device\n"
END = r"frames=\d+ lost_frames=0 .*\n"


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        ("decode {} >&-", 0, END),
        ("decode {} >&- 2>&- <&-", 0, ""),
        ("decode {} 2>/dev/full >&-", 0, ""),
        ("decode {} >/dev/full", 1, FULL),
        ("decode {} | head -1", 0, rf"[-\d].*dB.*\n({END})?"),
        ("decode --json {} | head -c 1", 0, "{"),
        ("--help | true", 0, ""),
        ("layout config/layouts/grid.yaml >&-", 0, ""),
        ("info {} >/dev/full", 1, FULL),
        ("info {} | true", 0, ""),
        ("decode /nowhere | true", 1, "tactile-cdma: /nowhere: No such file or directory\n"),
        ("export {0} -o {0}.npz >&-", 0, ""),
        ("export {0} -o {0}.csv >/dev/full", 1, FULL),
    ],
)
def test_output_that_is_closed_full_or_cut_ends_without_a_trace(
    recording: Path, words: str, code: int, said: str
) -> None:
    """What is not printed has been done nevertheless: the table is there."""
    command = f"set -o pipefail; {PYTHON} {words.format(recording)}"
    done = run_program("bash", "-c", command, cwd=ROOT)
    assert done.returncode == code
    assert re.fullmatch(said, done.stdout + done.stderr)
    if "export" in words:
        assert Path(words.format(recording).split()[3]).stat().st_size > 1000


def test_no_file_gets_the_number_of_a_stream_that_is_closed(tmp_path: Path) -> None:
    """Else what ROS, or another library, logs to stderr would be in it."""
    text = (
        "import os; from tactile_cdma.base.program import program\n"
        f"main = lambda: os.write(2, b'log') + open({str(tmp_path / 'file')!r}, 'w').fileno()\n"
        "raise SystemExit(program('x')(main)())"
    )
    done = run_program("bash", "-c", f'{sys.executable} -c "$0" >&- 2>&- <&-', text, cwd=ROOT)
    assert done.returncode > 5 and (tmp_path / "file").read_bytes() == b""


def test_every_program_prints_by_this_way() -> None:
    """Those of scripts/, and the command; what needs ROS or Rerun, where these are."""
    calls = (re.search(r'main_of\("(.+)"\)', path.read_text()) for path in ROOT.glob("scripts/s*"))
    modules = [call[1] for call in calls if call]
    assert len(modules) == 6
    for module in ("tactile_cdma.commands.cli", *modules):
        with contextlib.suppress(ImportError, SystemExit):
            assert hasattr(import_module(module).main, "__wrapped__"), module
