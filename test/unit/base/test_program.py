# SPDX-License-Identifier: Apache-2.0

"""Programs: text of others that they print, to closed outputs too, signals, and YAML with lines."""

import contextlib
import re
import signal
import sys
from importlib import import_module
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.base.errors import LayoutError, PortError, TactileError
from tactile_cdma.base.interrupt import SIGNALS, stop_event, terminable
from tactile_cdma.base.marked_yaml import MOST_BYTES, MOST_TEXT, Marked, read_marked
from tactile_cdma.base.program import Drawn, program, say, tell
from tactile_cdma.base.text import MOST_SHOWN, closest, listed, plain, suggestion
from tactile_cdma.wire.discovery import SerialPort
from test.support import simulated
from test.support.bags import BagMaker
from test.support.programs import run_program, run_python

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


def test_nothing_reaches_a_terminal_raw_but_drawings(capsys: pytest.CaptureFixture[str]) -> None:
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
def test_output_that_is_closed_leaves_no_trace(
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


# Signals that come while another one's handler runs

NESTED = """
import signal, sys
from tactile_cdma.base.interrupt import stop_event

raised = []

def again(frame, event, _):
    "SIGTERM at every call and return that SIGINT's handler makes."
    if len(raised) < 20:
        raised.append(frame.f_code.co_name)
        signal.raise_signal(signal.SIGTERM)

with stop_event(None) as stop:
    assert not stop.is_set()
    sys.setprofile(again)
    signal.raise_signal(signal.SIGINT)
    sys.setprofile(None)
    assert stop.is_set() and "set" in raised, raised
"""


def test_a_signal_in_a_handler_and_a_given_time_stop_it() -> None:
    # In a process of its own: with a lock it would wait for ever, whatever signal it gets.
    run_python("-c", NESTED, check=True)
    with stop_event(1e-3) as stop:
        while not stop.is_set():
            pass


@pytest.mark.parametrize("number", SIGNALS[1:])
def test_a_closed_terminal_and_sigterm_end_as_ctrl_c_does(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt), terminable():
        signal.raise_signal(number)
    with stop_event(None) as stop:
        signal.raise_signal(number)
        assert stop.is_set()
    assert signal.getsignal(number) == before


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="Windows has no SIGHUP")
def test_nohup_is_obeyed() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stop_event(None) as stop, terminable():
            signal.raise_signal(signal.SIGHUP)
            assert not stop.is_set()
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


@given(st.text())
def test_what_is_shown_can_be_printed_and_is_bounded(text: str) -> None:
    assert plain(text).isprintable()
    assert len(plain(text * 1000)) <= MOST_SHOWN
    if text.isprintable():
        assert plain(text) == text


def test_errors_escape_what_they_quote() -> None:
    for error in (TactileError, PortError, LayoutError):
        assert str(error("a\x1b[2Jb\n\u202ec µ…")) == r"a\x1b[2Jb\n\u202ec µ…"
    assert "\x1b" not in str(SerialPort("/dev/ttyACM0", "a \x1b]0;board", "1\x07"))


@pytest.mark.parametrize(
    ("items", "noun", "text"),
    [
        ([], "", ""),
        ([3, 4, 9], "", "3, 4, 9"),
        ([3], "node", "node 3"),
        ([3, 4], "node", "nodes 3, 4"),
        (["a", "b", "c", "d", "e"], "", "a, b, c and 2 more"),
        ([1, 2, 3, 4], "line", "lines 1, 2, 3 and 1 more"),
    ],
)
def test_items_are_listed_up_to_a_limit(items: list[object], noun: str, text: str) -> None:
    assert listed(items, noun, most=3) == text


def test_items_are_shown_as_asked_and_only_those_shown() -> None:
    """Making the text of an item may take time."""

    def mark(item: int) -> str:
        made.append(item)
        return f"#{item}"

    made: list[int] = []
    assert listed([1, 2, 3], most=2, show=mark) == "#1, #2 and 1 more"
    assert made == [1, 2]


KNOWN = ("nodes", "node_clocks", "port")


@pytest.mark.parametrize(
    ("name", "meant"), [("nodez", "nodes"), ("PROT", "port"), ("node_clock", "node_clocks")]
)
def test_a_name_that_resembles_a_known_one_is_suggested(name: str, meant: str) -> None:
    assert closest(name, iter(KNOWN)) == meant
    assert suggestion(name, KNOWN, "known: all") == f"; did you mean {meant!r}?"


def test_for_any_other_the_message_ends_otherwise() -> None:
    assert closest("zebra", KNOWN) is None
    assert suggestion("zebra", KNOWN) == ""
    assert closest("code", ["node"]) == "node"
    assert closest("code", ["node"], alike=0.8) is None
    assert suggestion("zebra", KNOWN, "known: all") == "; known: all"


def read(tmp_path: Path, text: str | bytes) -> Marked:
    path = tmp_path / "file.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_marked(path, LayoutError)


def test_values_know_their_lines(tmp_path: Path) -> None:
    content = read(tmp_path, "# a comment\na: 1.5\nb:\n  - 2\n  - '3'\nc:\n").mapping("it")
    assert content["a"].number("a", 0, 2) == 1.5
    assert [value.line for value in content["b"].items("b")] == [4, 5]
    assert content["b"].items("b")[0].whole("b", 0, 2) == 2
    assert content["c"].is_null
    assert content.get("d") is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "empty"),
        ("# nothing\n", "empty"),
        ("a: [1\n", "line 2: not a YAML file"),
        ("a: b: c\n", "line 1: not a YAML file"),
        ("a: 1\nb: 2\na: 3\n", "line 3: 'a' again; it stands in line 1"),
        ("? [a]\n: 1\n", "line 1: a key is a list"),
        ("a: 1\n---\nb: 2\n", "line 2: a second document"),
        ("a: &x [1]\nb: *x\n", "line 2: anchors and aliases"),
        ("[" * 100_000, "line 1: nested deeper than 16 levels"),
        (b"a: \xff\xfe", "UTF-8"),
        ("a: \x01", "not a YAML file"),
        pytest.param(
            b"#" * (MOST_BYTES + 1),
            "has 16777217 bytes; files of this kind have 16777216 at most",
            id="too large",
        ),
    ],
)
def test_what_is_no_plain_yaml_is_refused(tmp_path: Path, text: str | bytes, words: str) -> None:
    with pytest.raises(LayoutError) as caught:
        read(tmp_path, text)
    assert str(caught.value).startswith(str(tmp_path / "file.yaml"))
    assert words in str(caught.value)


@pytest.mark.parametrize("text", ["x", "'1'", "nan", "inf", "[1]", "~", "true", "1e99", "-1"])
def test_what_is_no_number_in_range_is_refused(tmp_path: Path, text: str) -> None:
    value = read(tmp_path, f"a: {text}").mapping("it")["a"]
    with pytest.raises(LayoutError, match=r"line 1: a is .*; it must"):
        value.number("a", 0, 1e9)
    with pytest.raises(LayoutError, match=r"line 1: a is .*; it must"):
        value.whole("a", 0, 1)


@pytest.mark.parametrize("text", [".nan", "-.inf", ".INF", "NaN", "1e999"])
def test_a_number_is_finite(tmp_path: Path, text: str) -> None:
    value = read(tmp_path, f"a: {text}").mapping("it")["a"]
    with pytest.raises(LayoutError, match=f"line 1: a is {re.escape(text)}; it must be finite"):
        value.number("a", 0, 1)


@pytest.mark.parametrize("text", ["07", "+7", "1_0", "0x1", "1.0", "-0", "9" * 400, "٣"])
def test_a_whole_number_is_written_in_one_way(tmp_path: Path, text: str) -> None:
    value = read(tmp_path, f"a: {text}").mapping("it")["a"]
    with pytest.raises(LayoutError, match=r"line 1: a is '.*'; it must be a whole number"):
        value.whole("a", 0, 100)


def test_too_much_and_no_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(LayoutError, match="line 1: a text of more than"):
        read(tmp_path, "a: " + "x" * (MOST_TEXT + 1))
    monkeypatch.setattr("tactile_cdma.base.marked_yaml.MOST_EVENTS", 100)
    with pytest.raises(LayoutError, match="holds more than 100 values"):
        read(tmp_path, "a: [" + "1,\n" * 100 + "1]")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(LayoutError, match=re.escape(f"{tmp_path / 'none.yaml'}: No such file")):
        read_marked(Path("none.yaml"), LayoutError)
    with pytest.raises(LayoutError, match="is a folder, not a file"):
        read_marked(tmp_path, LayoutError)
