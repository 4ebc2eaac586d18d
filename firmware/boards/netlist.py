# SPDX-License-Identifier: Apache-2.0

"""Reads KiCad schematics: their parts, and which pins are connected.

Knows what these drawings consist of: wires, junctions, labels, supplies, sheets without pins of
their own. test/firmware/test_boards.py compares it with KiCad's own netlist.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

Terminal = tuple[str, str]
"""A part's reference, and the number of its pin."""
_PARTS = re.compile(r'[()]|"(?:\\.|[^"\\])*"|[^\s()"]+')


@dataclass(frozen=True, slots=True)
class Component:
    """A part. pins: names by number."""

    reference: str
    symbol: str
    value: str
    fields: dict[str, str]
    pins: dict[str, str]


@dataclass(frozen=True, slots=True)
class Netlist:
    """A board. nets: sets of connected pins; names: of those that have one."""

    components: dict[str, Component]
    nets: tuple[frozenset[Terminal], ...]
    names: dict[str, frozenset[Terminal]]

    def net(self, reference: str, pin: str) -> frozenset[Terminal]:
        """What a pin, by number or name, is connected to, itself included."""
        pins = self.components[reference].pins
        (number,) = [number for number, name in pins.items() if pin in (number, name)]
        (net,) = [net for net in self.nets if (reference, number) in net]
        return net


def parse(text: str) -> list[Any]:
    """The file as nested lists."""
    stack: list[list[Any]] = [[]]
    for part in _PARTS.findall(text):
        if part == "(":
            stack.append([])
        elif part == ")":
            done = stack.pop()
            stack[-1].append(done)
        else:
            stack[-1].append(json.loads(part) if part[0] == '"' else part)
    (tree,) = stack[0]
    return list(tree)


def read(path: Path) -> Netlist:
    """The board whose first sheet is this file."""
    reader = _Reader()
    root = parse(path.read_text(encoding="utf-8"))
    reader.sheet(root, "/" + _one(root, "uuid")[1], path.parent)
    return reader.netlist()


def components(tree: list[Any], path: str = "") -> Iterator[tuple[Component, list[Any]]]:
    """Parts of a sheet with their items, without supplies.

    path: of the sheet's use; without it, parts are named as in the first one.
    """
    definitions = {item[1]: item for item in _one(tree, "lib_symbols")[1:]}
    for item in _all(tree, "symbol"):
        definition = definitions[_one(item, "lib_id")[1]]
        if _all(definition, "power"):
            continue
        fields = {field[1]: field[2] for field in _all(item, "property")}
        pins = {number: name for number, name, _ in _pins(definition)}
        reference, value = fields.pop("Reference"), fields.pop("Value")
        for use in _all(_one(_one(item, "instances"), "project"), "path"):
            if use[1] == path:
                reference = _one(use, "reference")[1]
        symbol = _one(item, "lib_id")[1].partition(":")[2]
        yield Component(reference, symbol, value, fields, pins), item


class _Reader:
    def __init__(self) -> None:
        self.components: dict[str, Component] = {}
        self.above: dict[Any, Any] = {}
        self.terminals: list[Terminal] = []
        self.named: set[str] = set()

    def sheet(self, tree: list[Any], path: str, folder: Path) -> None:
        """Take in a sheet, and those in it."""
        definitions = {item[1]: item for item in _one(tree, "lib_symbols")[1:]}
        wires = [tuple(_point(xy) for xy in _one(wire, "pts")[1:]) for wire in _all(tree, "wire")]
        for begin, end in wires:
            self._join((path, begin), (path, end))
        touching = [_point(_one(item, "at")) for item in _all(tree, "junction")]
        for kind in ("label", "global_label"):
            for label in _all(tree, kind):
                at = _point(_one(label, "at"))
                touching.append(at)
                name = label[1] if kind == "global_label" else f"{path} {label[1]}"
                self._name(name, (path, at))
        for at in touching:
            for begin, end in wires:
                if _on(at, begin, end):
                    self._join((path, at), (path, begin))
        for component, item in components(tree, path):
            self.components[component.reference] = component
            for number, _, at in _pins(definitions[_one(item, "lib_id")[1]]):
                terminal = (component.reference, number)
                self.terminals.append(terminal)
                self._join((path, _placed(at, _one(item, "at"))), terminal)
        for item in _all(tree, "symbol"):
            definition = definitions[_one(item, "lib_id")[1]]
            if _all(definition, "power"):
                fields = {field[1]: field[2] for field in _all(item, "property")}
                ((_, name, at),) = _pins(definition)
                if name != "PWR_FLAG":
                    self._name(fields["Value"], (path, _placed(at, _one(item, "at"))))
        for child in _all(tree, "sheet"):
            fields = {field[1]: field[2] for field in _all(child, "property")}
            text = (folder / fields["Sheetfile"]).read_text(encoding="utf-8")
            self.sheet(parse(text), f"{path}/{_one(child, 'uuid')[1]}", folder)

    def netlist(self) -> Netlist:
        nets: dict[Any, set[Terminal]] = {}
        for terminal in self.terminals:
            nets.setdefault(self._root(terminal), set()).add(terminal)
        names = {
            name.rpartition(" ")[2]: frozenset(nets.get(self._root(("name", name)), ()))
            for name in self.named
        }
        return Netlist(self.components, tuple(map(frozenset, nets.values())), names)

    def _name(self, name: str, place: Any) -> None:
        self.named.add(name)
        self._join(("name", name), place)

    def _root(self, item: Any) -> Any:
        while (above := self.above.setdefault(item, item)) != item:
            item = above
        return item

    def _join(self, one: Any, other: Any) -> None:
        self.above[self._root(one)] = self._root(other)


def _all(tree: list[Any], kind: str) -> list[list[Any]]:
    return [item for item in tree if isinstance(item, list) and item and item[0] == kind]


def _one(tree: list[Any], kind: str) -> list[Any]:
    return _all(tree, kind)[0]


def _point(item: list[Any]) -> tuple[int, int]:
    """A place in µm."""
    return round(float(item[1]) * 1e3), round(float(item[2]) * 1e3)


def _pins(definition: list[Any]) -> Iterator[tuple[str, str, tuple[int, int]]]:
    """Number, name and place of every pin of a symbol."""
    for unit in _all(definition, "symbol"):
        for pin in _all(unit, "pin"):
            yield _one(pin, "number")[1], _one(pin, "name")[1], _point(_one(pin, "at"))


def _placed(pin: tuple[int, int], at: list[Any]) -> tuple[int, int]:
    """A pin's place on the sheet: symbols are drawn y up, sheets y down."""
    turn = math.radians(float(at[3]))
    cosine, sine = round(math.cos(turn)), round(math.sin(turn))
    x, y = _point(at)
    return x + pin[0] * cosine - pin[1] * sine, y - pin[0] * sine - pin[1] * cosine


def _on(at: tuple[int, int], begin: tuple[int, int], end: tuple[int, int]) -> bool:
    """Whether a point is on a level or upright wire."""
    return all(min(b, e) <= p <= max(b, e) for p, b, e in zip(at, begin, end, strict=True))
