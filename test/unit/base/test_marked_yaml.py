# SPDX-License-Identifier: Apache-2.0

"""YAML with line numbers: what is read, and what is refused."""

import re
from pathlib import Path

import pytest

from tactile_cdma.base.errors import LayoutError
from tactile_cdma.base.marked_yaml import MOST_BYTES, MOST_TEXT, Marked, read_marked


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


def test_long_texts_and_too_many_values_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(LayoutError, match="line 1: a text of more than"):
        read(tmp_path, "a: " + "x" * (MOST_TEXT + 1))
    monkeypatch.setattr("tactile_cdma.base.marked_yaml.MOST_EVENTS", 100)
    with pytest.raises(LayoutError, match="holds more than 100 values"):
        read(tmp_path, "a: [" + "1,\n" * 100 + "1]")


def test_folders_and_missing_files_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(LayoutError, match=re.escape(f"{tmp_path / 'none.yaml'}: No such file")):
        read_marked(Path("none.yaml"), LayoutError)
    with pytest.raises(LayoutError, match="is a folder, not a file"):
        read_marked(tmp_path, LayoutError)
