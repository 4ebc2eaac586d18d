"""YAML files whose every value knows its line, so that what is wrong can be pointed at."""

from __future__ import annotations

import difflib
import math
from collections.abc import Collection
from pathlib import Path
from typing import Any

import yaml

from .errors import TactileError

_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the one in C is ten times as fast


class LinedYaml:
    """One YAML file: its root, and its nodes' values in the type that is asked for.

    Every complaint is of the type `error` and names file and line. Aliases are refused: nothing
    that is read this way needs them, and a few lines of them make gigabytes.
    """

    def __init__(self, path: Path, error: type[TactileError], most_bytes: int) -> None:
        self.path, self.error = path, error
        try:
            size = path.stat().st_size
            if size > most_bytes:
                raise error(
                    f"{path}: {size / 1e6:.1f} MB are more than such a file can have "
                    f"({most_bytes / 1e6:g} MB)"
                )
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as problem:
            reason = getattr(problem, "strerror", None) or "not a text file"
            raise error(f"{path.absolute()}: {reason}") from None
        try:
            for event in yaml.parse(text, _LOADER):
                if isinstance(event, yaml.AliasEvent):
                    assert event.start_mark is not None
                    raise error(f"{path}: line {event.start_mark.line + 1}: aliases are not taken")
            root = yaml.compose(text, _LOADER)
        except (yaml.YAMLError, RecursionError) as problem:
            raise error(f"{path}: not a YAML file: {' '.join(str(problem).split())}") from None
        if root is None:
            raise error(f"{path}: the file is empty")
        self.root: yaml.Node = root

    def refusal(self, node: yaml.Node, cause: str) -> TactileError:
        """The error to raise for what is at a node."""
        return self.error(f"{self.path}: line {node.start_mark.line + 1}: {cause}")

    def mapping(
        self, node: yaml.Node, what: str, known: Collection[str] | None = None
    ) -> dict[str, yaml.Node]:
        """Entries by name; with `known`, only these may be there."""
        if not isinstance(node, yaml.MappingNode):
            raise self.refusal(node, f"{what} must be entries of the form 'name: value'")
        entries: dict[str, yaml.Node] = {}
        for key, value in node.value:
            name = self.text(key, f"a name in {what}")
            if name in entries:
                first = entries[name].start_mark.line + 1
                raise self.refusal(key, f"{what}: {name} is there twice, first in line {first}")
            if known is not None and name not in known:
                close = difflib.get_close_matches(name, known, n=1)
                hint = f"did you mean {close[0]}?" if close else f"known are {', '.join(known)}"
                raise self.refusal(key, f"{what}: unknown entry {name!r}; {hint}")
            entries[name] = value
        return entries

    def items(self, node: yaml.Node, what: str) -> list[yaml.Node]:
        """The items of a list."""
        if not isinstance(node, yaml.SequenceNode):
            raise self.refusal(node, f"{what} must be a list: [first, second, …]")
        return list(node.value)

    def text(self, node: yaml.Node, what: str) -> str:
        """A scalar as it is written."""
        if not isinstance(node, yaml.ScalarNode):
            raise self.refusal(node, f"{what} must be a single value")
        return str(node.value)

    def number(self, node: yaml.Node, what: str) -> float:
        """A finite number."""
        text = self.text(node, what)
        try:
            value = float(text)
        except ValueError:
            raise self.refusal(node, f"{what} must be a number, not {text[:40]!r}") from None
        if not math.isfinite(value):
            raise self.refusal(node, f"{what} is {text}; it must be finite")
        return value

    def whole(self, node: yaml.Node, what: str, low: int, high: int) -> int:
        """An integer within limits."""
        text = self.text(node, what)
        # Not every way to write one: 07 and 7 are one node, and it must not be there twice.
        value = int(text) if text.isdecimal() and len(text) < 10 else low - 1
        if text != str(value) or not low <= value <= high:
            raise self.refusal(
                node, f"{what} must be an integer within {low}…{high}, not {text[:40]!r}"
            )
        return value
