# SPDX-License-Identifier: Apache-2.0

"""YAML files whose values know their line, so that an error names the place in the file.

They are built from the events of PyYAML's parser, so that untrusted files can neither nest deeply
nor multiply their contents by aliases. ruamel.yaml, which keeps lines too, takes 1.7 s for a layout
of 4,096 taxels instead of 0.08, resolves aliases, ends in a RecursionError where lists nest deeply,
and has lost what was written: 010 is 10.
"""

import math
import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from .errors import TactileError
from .named_file import read_text
from .text import suggestion

MOST_BYTES = 1 << 24
"""Bytes of a file; chosen."""
MOST_DEPTH = 16
"""Levels of nesting; chosen well above the 4 or so that our files have."""
_TOO_DEEP = f"nested deeper than {MOST_DEPTH} levels"
MOST_EVENTS = 1 << 21
"""Values, keys, and beginnings and ends of lists: twice what 65,535 taxels need with all keys."""
MOST_TEXT = 1 << 16
"""Characters of one value; chosen."""
_WHOLE = re.compile("0|-?[1-9][0-9]{0,17}")
_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@dataclass(frozen=True, slots=True)
class MarkedFile:
    """The file that values come from, and the type of error to refuse it with."""

    path: Path
    error: type[TactileError]

    def refuse(self, text: str, line: int | None = None) -> TactileError:
        """Return the error to raise. line: counted from 1."""
        where = f"{self.path}, line {line}" if line else f"{self.path}"
        return self.error(f"{where}: {text}")


@dataclass(frozen=True, slots=True)
class Marked:
    """A value of the file: a scalar's text, a list or a mapping, and the line where it begins.

    Limits of numbers and of lengths are inclusive.
    """

    content: "str | list[Marked] | dict[str, Marked]"
    line: int
    quoted: bool
    file: MarkedFile

    def refuse(self, text: str) -> TactileError:
        return self.file.refuse(text, self.line)

    @contextmanager
    def refusing(self, *kinds: type[Exception]) -> Iterator[None]:
        """Turn such errors into the file's, about this value."""
        try:
            yield
        except kinds as error:
            raise self.refuse(str(error)) from None

    @property
    def is_null(self) -> bool:
        """Tell whether the value is left out: null or ~."""
        return self.content in ("", "~", "null") and not self.quoted

    def mapping(self, what: str) -> "Keys":
        if not isinstance(self.content, dict):
            raise self.refuse(f"{what} is {self._kind}; it must be keys with values")
        return Keys(what, self, self.content)

    def items(self, what: str, least: int = 0, most: int = MOST_EVENTS) -> "list[Marked]":
        if not isinstance(self.content, list):
            raise self.refuse(f"{what} is {self._kind}; it must be a list")
        if not least <= (count := len(self.content)) <= most:
            allowed = least if least == most else f"{least}…{most}"
            raise self.refuse(f"{what} has {count} entries; it must have {allowed}")
        return self.content

    def numbers(
        self, what: str, low: float, high: float, unit: str = "", least: int = 0, most: int = 64
    ) -> list[float]:
        """Return a list of least to most finite numbers, each within low…high."""
        entries = enumerate(self.items(what, least, most), 1)
        return [entry.number(f"number {i} of {what}", low, high, unit) for i, entry in entries]

    def text(self, what: str) -> str:
        if not isinstance(self.content, str) or self.is_null:
            raise self.refuse(f"{what} is {self._kind}; it must be text")
        return self.content

    def number(self, what: str, low: float, high: float, unit: str = "") -> float:
        try:
            value = float(self._plain.lower().replace(".nan", "nan").replace(".inf", "inf"))
        except ValueError:
            raise self.refuse(f"{what} is {self._kind}; it must be a number") from None
        if not math.isfinite(value):
            raise self.refuse(f"{what} is {self._plain[:40]}; it must be finite")
        return self._within(what, value, low, high, unit)

    def whole(self, what: str, low: int, high: int) -> int:
        # Leading zeros are refused: 010 is 8 in YAML 1.1, and 07 would be another key than 7.
        if not _WHOLE.fullmatch(self._plain):
            raise self.refuse(f"{what} is {self._kind}; it must be a whole number")
        return int(self._within(what, int(self._plain), low, high, ""))

    def _within(self, what: str, value: float, low: float, high: float, unit: str) -> float:
        if not low <= value <= high:
            raise self.refuse(
                f"{what} is {value:.10g}; it must lie within {low:.10g}…{high:.10g} {unit}".rstrip()
            )
        return value

    @property
    def _plain(self) -> str:
        """Return a scalar without quotes; empty for anything else."""
        return self.content if isinstance(self.content, str) and not self.quoted else ""

    @property
    def _kind(self) -> str:
        if isinstance(self.content, str):
            return "empty" if self.is_null else repr(self.content[:40])
        return "a list" if isinstance(self.content, list) else "keys with values"


@dataclass(frozen=True, slots=True)
class Keys:
    """Keys with values. what: its name in messages."""

    what: str
    value: Marked
    entries: dict[str, Marked]

    def check_keys(self, known: Collection[str]) -> None:
        for name, value in self.entries.items():
            if name not in known:
                hint = suggestion(name, known, f"known: {', '.join(known)}")
                raise value.refuse(f"unknown key {name!r} in {self.what}{hint}")

    def check_schema(self, schema: str, version: int) -> None:
        """Refuse a file of another kind or version, by its keys schema and version."""
        if (found := self.text("schema")) != schema:
            raise self["schema"].refuse(f"schema is {found[:40]!r}; it must be {schema!r}")
        if (number := self.whole("version", 0, 10**6)) != version:
            remedy = "update this program" if number > version else "write the file again"
            raise self["version"].refuse(
                f"version is {number}; this program reads version {version}: {remedy}"
            )

    def text(self, key: str, default: str | None = None) -> str:
        """Return the text under a key; where the key is missing the default, if there is one."""
        if default is not None and key not in self.entries:
            return default
        return self[key].text(key)

    def number(self, key: str, low: float, high: float, unit: str = "") -> float:
        return self[key].number(key, low, high, unit)

    def whole(self, key: str, low: int, high: int) -> int:
        return self[key].whole(key, low, high)

    def get(self, key: str) -> Marked | None:
        return self.entries.get(key)

    def __getitem__(self, key: str) -> Marked:
        """Return the value; raises the file's error where the key is missing."""
        if key not in self.entries:
            raise self.value.refuse(f"{self.what} has no {key!r}")
        return self.entries[key]


def read_marked(path: Path, error: type[TactileError]) -> Marked:
    """Return the only document of a YAML file.

    Raises error, naming file and line, for a file that cannot be read, is not YAML, or has aliases,
    duplicate keys or too many levels of nesting.
    """
    file = MarkedFile(path, error)
    try:
        text = read_text(path, MOST_BYTES)
    except OSError as problem:
        # The absolute path: the working folder may be the mistake.
        raise MarkedFile(path.absolute(), error).refuse(problem.strerror or str(problem)) from None
    try:
        events = yaml.parse(text, Loader=_LOADER)
        return _document(_bounded(events, file), file)
    except yaml.YAMLError as problem:
        mark = getattr(problem, "problem_mark", None)
        said = getattr(problem, "problem", None) or " ".join(str(problem).split())
        line = mark.line + 1 if mark else None
        if "nesting depth" in said:  # newer parsers look ahead, and refuse it before _value does
            raise file.refuse(_TOO_DEEP, line) from None
        raise file.refuse(f"not a YAML file: {said}", line) from None


def _bounded(events: Iterator[yaml.Event], file: MarkedFile) -> Iterator[yaml.Event]:
    """Refuse files that would fill the memory: a value takes some hundred bytes."""
    for number, event in enumerate(events):
        if number > MOST_EVENTS:
            raise file.refuse(f"holds more than {MOST_EVENTS} values", _line(event))
        if isinstance(event, yaml.ScalarEvent) and len(event.value) > MOST_TEXT:
            raise file.refuse(f"a text of more than {MOST_TEXT} characters", _line(event))
        yield event


def _document(events: Iterator[yaml.Event], file: MarkedFile) -> Marked:
    value = None
    for event in events:
        if isinstance(event, yaml.DocumentStartEvent):
            if value:
                raise file.refuse("a second document begins here", _line(event))
            value = _value(next(events), events, file, 0)
    if value is None:
        raise file.refuse("the file is empty")
    return value


def _value(event: yaml.Event, events: Iterator[yaml.Event], file: MarkedFile, depth: int) -> Marked:
    line = _line(event)
    if depth > MOST_DEPTH:
        raise file.refuse(_TOO_DEEP, line)
    if isinstance(event, yaml.ScalarEvent):
        # Without libyaml plain scalars have no style, with it an empty one.
        return Marked(event.value, line, bool(event.style), file)
    if isinstance(event, yaml.SequenceStartEvent):
        values = []
        while not isinstance(event := next(events), yaml.SequenceEndEvent):
            values.append(_value(event, events, file, depth + 1))
        return Marked(values, line, False, file)
    if isinstance(event, yaml.MappingStartEvent):
        return Marked(_mapping(events, file, depth + 1), line, False, file)
    raise file.refuse("anchors and aliases (& and *) are not supported here; write it out", line)


def _line(event: yaml.Event) -> int:
    assert event.start_mark is not None
    return int(event.start_mark.line) + 1


def _mapping(events: Iterator[yaml.Event], file: MarkedFile, depth: int) -> dict[str, Marked]:
    values: dict[str, Marked] = {}
    while not isinstance(event := next(events), yaml.MappingEndEvent):
        key = _value(event, events, file, depth)
        name = key.text("a key")
        if name in values:
            raise key.refuse(f"{name!r} again; it stands in line {values[name].line} already")
        values[name] = _value(next(events), events, file, depth)
    return values
