# SPDX-License-Identifier: Apache-2.0

"""KiCad's files as nested items that know their place, so that whatever is amiss can be found."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from pathlib import Path

VERSIONS = {"kicad_sch": ("20231120", "20250114"), "kicad_pcb": ("20241229",)}
"""Formats that are read, by kind of file: as KiCad 8 and 9 write them."""
DEEPEST = 100
"""Levels of a file; chosen: KiCad's have a dozen."""
_TOKENS = re.compile(r'[()]|"(?:\\.|[^"\\])*"|[^\s()"]+|"')


class KicadFileError(ValueError):
    """Tells file and line of what is missing, damaged, or not as KiCad writes it."""


class Item:
    """(kind value …) of a file. values: texts and items. line: where it begins."""

    __slots__ = ("file", "kind", "line", "values")

    def __init__(self, file: Path, line: int) -> None:
        self.file, self.line = file, line
        self.kind = ""
        self.values: list[str | Item] = []

    def all(self, *kinds: str) -> Iterator[Item]:
        """Return items of these kinds in this one."""
        return (v for v in self.values if isinstance(v, Item) and v.kind in kinds)

    def one(self, kind: str) -> Item:
        """Return the first item of a kind."""
        for item in self.all(kind):
            return item
        raise self.error(f"there is no ({kind} …) in it")

    @property
    def texts(self) -> list[str]:
        """Return the values that are no items."""
        return [value for value in self.values if isinstance(value, str)]

    def text(self, index: int = 0) -> str:
        """Return one of the values that are no items."""
        try:
            return self.texts[index]
        except IndexError:
            raise self.error("it lacks a value") from None

    def number(self, index: int = 0) -> float:
        """Return one of the values that are no items, as a number."""
        try:
            number = float(self.text(index))
            if not math.isfinite(number):
                raise ValueError
        except KicadFileError:
            raise
        except ValueError:
            raise self.error(f"{self.text(index)[:20]!r} is no number") from None
        return number

    def field(self, name: str) -> str:
        """Return the text of a property."""
        try:
            return self.fields[name]
        except KeyError:
            raise self.error(f"it has no field {name}") from None

    @property
    def fields(self) -> dict[str, str]:
        """Names and texts of all properties."""
        return {field.text(): field.text(1) for field in self.all("property")}

    def error(self, what: str) -> KicadFileError:
        """Make the error to raise about this item."""
        return KicadFileError(f"{self.file}: line {self.line}: ({self.kind} …): {what}")


def load(path: Path) -> Item:
    """Read a schematic or a layout. Raises KicadFileError."""
    kind = path.suffix[1:]
    try:
        text = path.read_bytes().decode()
    except OSError as error:
        raise KicadFileError(f"{path}: {error.strerror}") from None
    except UnicodeDecodeError:
        text = ""
    if not text.lstrip().startswith(f"({kind}"):
        raise KicadFileError(f"{path}: does not begin with ({kind}: was it written by KiCad?")
    tree = _parse(path, text)
    version = tree.one("version")
    if version.text() not in VERSIONS[kind]:
        formats = " or ".join(VERSIONS[kind])
        raise version.error(f"format {version.text()}, not {formats}: save it with KiCad 9")
    return tree


def _parse(path: Path, text: str) -> Item:
    file = Item(path, 1)
    stack, line, at = [file], 1, 0
    for match in _TOKENS.finditer(text):
        line += text.count("\n", at, match.start())
        at, part, inside = match.start(), match[0], stack[-1]
        if part == "(":
            stack.append(Item(path, line))
            inside.values.append(stack[-1])
        elif part == ")":
            stack.pop()
        elif inside.kind or inside.values:
            inside.values.append(_unquoted(part, inside))
        else:
            inside.kind = part
        if not 0 < len(stack) <= DEEPEST:
            raise KicadFileError(f"{path}: line {line}: brackets do not match")
    if len(stack) > 1:
        raise stack[-1].error("the file ends in it: is it truncated?")
    if len(file.values) != 1:
        raise KicadFileError(f"{path}: line {line}: more than one drawing")
    return file.one(path.suffix[1:])


def _unquoted(part: str, inside: Item) -> str:
    if part[0] != '"':
        return part
    try:
        return str(json.loads(part, strict=False))
    except ValueError:
        raise inside.error("a text in it does not end, or is not as KiCad writes it") from None
