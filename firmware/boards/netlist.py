# SPDX-License-Identifier: Apache-2.0

"""Reads KiCad schematics: their parts, and which pins are connected.

Knows what these drawings consist of: wires, junctions, labels, supplies, sheets without pins of
their own. test/firmware/test_boards.py compares it with KiCad's own netlist.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kicad_file import Item, load

Terminal = tuple[str, str]
"""A part's reference, and the number of its pin."""
Place = tuple[int, int]
"""Place on a sheet, µm."""


@dataclass(frozen=True, slots=True)
class Component:
    """Is a part. pins: names by number."""

    reference: str
    symbol: str
    value: str
    fields: dict[str, str]
    pins: dict[str, str]


@dataclass(frozen=True, slots=True)
class Netlist:
    """Is a board. nets: sets of connected pins; names: the net's, where it has one."""

    components: dict[str, Component]
    nets: tuple[frozenset[Terminal], ...]
    names: dict[str, frozenset[Terminal]]

    def net(self, reference: str, pin: str) -> frozenset[Terminal]:
        """Return what a pin, by number or name, is connected to, itself included."""
        pins = self.components[reference].pins
        (number,) = [number for number, name in pins.items() if pin in (number, name)]
        (net,) = [net for net in self.nets if (reference, number) in net]
        return net


def read(path: Path) -> Netlist:
    """Read the board whose first sheet is this file. Raises KicadFileError."""
    reader = _Reader()
    root = load(path)
    reader.sheet(root, "/" + root.one("uuid").text())
    return reader.netlist()


def components(tree: Item, path: str = "") -> Iterator[tuple[Component, Item, Item]]:
    """Yield parts of a sheet, each with its item and its symbol, without supplies.

    path: of the sheet's use; without it, parts are named as in the first one.
    """
    for item, definition in _symbols(tree):
        if any(definition.all("power")):
            continue
        reference, value, fields = item.field("Reference"), item.field("Value"), item.fields
        pins = {number: name for number, name, _ in _pins(definition)}
        for use in item.one("instances").one("project").all("path"):
            if use.text() == path:
                reference = use.one("reference").text()
        symbol = definition.text().partition(":")[2]
        yield Component(reference, symbol, value, fields, pins), item, definition


class _Reader:
    def __init__(self) -> None:
        self.components: dict[str, Component] = {}
        self.above: dict[Any, Any] = {}
        self.terminals: list[Terminal] = []
        self.named: set[str] = set()

    def sheet(self, tree: Item, path: str, above: tuple[Path, ...] = ()) -> None:
        """Take in a sheet, and those in it. above: files that it is in."""
        self._take_wires(tree, path)
        for component, item, definition in components(tree, path):
            self.components[component.reference] = component
            for number, _, at in _pins(definition):
                terminal = (component.reference, number)
                self.terminals.append(terminal)
                self._join((path, _placed(at, item.one("at"))), terminal)
        for item, definition in _symbols(tree):
            if any(definition.all("power")):
                self._take_power(item, definition, path)
        for child in tree.all("sheet"):
            file = tree.file.parent / child.field("Sheetfile")
            if file in (above := (*above, tree.file)):
                raise child.error("it is within itself")
            self.sheet(load(file), f"{path}/{child.one('uuid').text()}", above)

    def _take_wires(self, tree: Item, path: str) -> None:
        """Join what wires, junctions and labels of a sheet join."""
        wires = [_ends(wire) for wire in tree.all("wire")]
        for begin, end in wires:
            self._join((path, begin), (path, end))
        touching = [_point(item.one("at")) for item in tree.all("junction")]
        for label in tree.all("label", "global_label"):
            touching.append(at := _point(label.one("at")))
            name = label.text() if label.kind == "global_label" else f"{path} {label.text()}"
            self._name(name, (path, at))
        for at in touching:
            for begin, end in wires:
                if _on(at, begin, end):
                    self._join((path, at), (path, begin))

    def _take_power(self, item: Item, definition: Item, path: str) -> None:
        """Name the net of a power symbol."""
        for _, name, at in _pins(definition):
            if name != "PWR_FLAG":
                self._name(item.field("Value"), (path, _placed(at, item.one("at"))))

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


def _symbols(tree: Item) -> Iterator[tuple[Item, Item]]:
    """Yield symbols of a sheet, each with its definition."""
    definitions = {item.text(): item for item in tree.one("lib_symbols").all("symbol")}
    for item in tree.all("symbol"):
        name = item.one("lib_id").text()
        if name not in definitions:
            raise item.error(f"{name} is not in (lib_symbols …)")
        yield item, definitions[name]


def _ends(wire: Item) -> tuple[Place, Place]:
    ends = [_point(xy) for xy in wire.one("pts").all("xy")]
    if len(ends) != 2:
        raise wire.error(f"it has {len(ends)} ends")
    return ends[0], ends[1]


def _point(item: Item) -> Place:
    return round(item.number() * 1e3), round(item.number(1) * 1e3)


def _pins(definition: Item) -> Iterator[tuple[str, str, Place]]:
    """Yield number, name and place of every pin of a symbol."""
    for unit in definition.all("symbol"):
        for pin in unit.all("pin"):
            yield pin.one("number").text(), pin.one("name").text(), _point(pin.one("at"))


def _placed(pin: Place, at: Item) -> Place:
    """Return a pin's place on the sheet: symbols are drawn y up, sheets y down."""
    turn = math.radians(at.number(2))
    cosine, sine = round(math.cos(turn)), round(math.sin(turn))
    x, y = _point(at)
    return x + pin[0] * cosine - pin[1] * sine, y - pin[0] * sine - pin[1] * cosine


def _on(at: Place, begin: Place, end: Place) -> bool:
    """Tell whether a point is on a level or upright wire."""
    return all(min(b, e) <= p <= max(b, e) for p, b, e in zip(at, begin, end, strict=True))
