# SPDX-License-Identifier: Apache-2.0

"""Draws schematics as KiCad files.

Places are in steps of 2.54 mm, y down, as on the sheet; a symbol's own are y up, as KiCad has it.
All identifiers follow from names, so that the same drawing is the same file.
"""

from __future__ import annotations

import json
import math
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

MM = 2.54
VERSION = 20231120
"""Of the file format: KiCad 8's, which later ones read."""
LIBRARY = "boards"
SPACE = uuid.UUID("0d5c1f86-5f0a-4a1c-9f57-3a1c2b7e9d10")
"""Of all identifiers; chosen by chance."""
HIDDEN = "(effects (font (size 1.27 1.27)) (hide yes))"
DIRECTIONS = {0: (1, 0), 90: (0, -1), 180: (-1, 0), 270: (0, 1)}
"""Steps, on the sheet, by angle."""

Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Pin:
    """A pin's end, the angle at which it leads to the body, KiCad's electrical type."""

    number: str
    name: str
    kind: str
    at: Point
    angle: int
    length: float = 1.0


@dataclass(frozen=True, slots=True)
class Symbol:
    """A part as drawn. shape: KiCad's graphic items. height: of its body, steps."""

    name: str
    prefix: str
    pins: tuple[Pin, ...]
    shape: tuple[str, ...]
    height: float = 2.0
    names: bool = False
    power: bool = False


@dataclass(frozen=True, slots=True)
class Placed:
    """A symbol on a sheet."""

    symbol: Symbol
    at: Point
    turn: int

    def pin(self, which: str) -> Point:
        """The place of a pin, by its number or its name."""
        (pin,) = [p for p in self.symbol.pins if which in (p.number, p.name)]
        cosine, sine = (round(f(math.radians(self.turn))) for f in (math.cos, math.sin))
        x, y = pin.at
        return (self.at[0] + x * cosine - y * sine, self.at[1] - x * sine - y * cosine)


@dataclass
class Sheet:
    """A schematic in the making. users: project and paths of the sheets that show it, if any.

    size: width and height, steps.
    """

    name: str
    title: str
    size: tuple[float, float]
    users: tuple[str, Sequence[str]] | None = None
    symbols: dict[str, Symbol] = field(default_factory=dict)
    items: list[str] = field(default_factory=list)
    wires: list[tuple[Point, Point]] = field(default_factory=list)
    pins: list[Point] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)

    def place(
        self,
        symbol: Symbol,
        at: Point,
        value: str,
        *,
        turn: int = 0,
        fields: Mapping[str, str] | None = None,
    ) -> Placed:
        """Place a part; fields are its further properties, `Note` among them is shown."""
        number = self.counts[symbol.prefix] = self.counts.get(symbol.prefix, 0) + 1
        placed = Placed(symbol, at, turn)
        self.symbols[symbol.name] = symbol
        self.pins += [placed.pin(pin.number) for pin in symbol.pins]
        texts = {"Reference": f"{symbol.prefix}{number}", "Value": value, **(fields or {})}
        lines = [
            f'(symbol (lib_id "{LIBRARY}:{symbol.name}") {_at(at, turn)} (unit 1) '
            f"(exclude_from_sim no) (in_bom yes) (on_board yes) (dnp no) "
            f"{self._id(f'symbol {symbol.prefix}{number}')}"
        ]
        lines += [self._property(placed, key, text) for key, text in texts.items()]
        lines += [
            f'(pin "{pin.number}" {self._id(f"{symbol.prefix}{number}.{pin.number}")})'
            for pin in symbol.pins
        ]
        uses = "".join(
            f'(path "{path}" (reference "{symbol.prefix}{base + number}") (unit 1))'
            for base, path in self._uses()
        )
        project = self.users[0] if self.users else self.name
        self.items.append("\n  ".join([*lines, f'(instances (project "{project}" {uses})))']))
        return placed

    def power(self, symbol: Symbol, at: Point) -> None:
        """A supply's symbol, whose name is that of the net."""
        self.place(symbol, at, symbol.name)

    def wire(self, *points: Point) -> None:
        """Wires from point to point."""
        for begin, end in pairwise(points):
            if begin[0] != end[0] and begin[1] != end[1]:
                raise ValueError(
                    f"{self.name}: a wire from {begin} to {end} is neither level nor upright"
                )
            self.wires.append((begin, end))
            number = len(self.wires)
            self.items.append(
                f"(wire (pts (xy {_mm(begin)}) (xy {_mm(end)})) (stroke (width 0) (type default)) "
                f"{self._id(f'wire {number}')})"
            )

    def label(self, name: str, at: Point, angle: int = 0, *, everywhere: bool = False) -> None:
        """A net's name, of this sheet or of all sheets."""
        kind = "global_label" if everywhere else "label"
        shape = "(shape passive) " if everywhere else ""
        side = "right" if angle in (180, 270) else "left"
        number = self._count("label")
        self.items.append(
            f'({kind} "{name}" {shape}{_at(at, angle)} (effects (font (size 1.27 1.27)) '
            f"(justify {side}{'' if everywhere else ' bottom'})) {self._id(f'label {number}')})"
        )

    def stub(
        self, name: str, at: Point, angle: int = 0, length: float = 1.0, *, everywhere: bool = False
    ) -> None:
        """A short wire from a pin to a net's name."""
        dx, dy = DIRECTIONS[angle]
        end = (at[0] + dx * length, at[1] + dy * length)
        self.wire(at, end)
        self.label(name, end, angle, everywhere=everywhere)

    def unconnected(self, *places: Point) -> None:
        """Marks of pins that nothing is connected to."""
        for at in places:
            self.items.append(f"(no_connect {_at(at)} {self._id(f'nc {at}')})")

    def note(self, text: str, at: Point, size: float = 1.27) -> None:
        """Text for the reader."""
        number = self._count("note")
        self.items.append(
            f"(text {json.dumps(text, ensure_ascii=False)} (exclude_from_sim no) {_at(at, 0)} "
            f"(effects (font (size {size} {size})) (justify left top)) "
            f"{self._id(f'note {number}')})"
        )

    def child(self, name: str, file: str, at: Point, size: Point) -> None:
        """Another sheet in this one; nets that are named everywhere connect them."""
        number = self._count("sheet")
        font = "(effects (font (size 1.27 1.27)) (justify left top))"
        self.items.append(
            f"(sheet {_at(at)} (size {_mm(size)}) (stroke (width 0.15) (type solid)) "
            f"(fill (color 0 0 0 0)) {self._id(f'sheet {number}')}\n"
            f'  (property "Sheetname" "{name}" {_at((at[0] + 0.5, at[1] + 0.7), 0)} {font})\n'
            f'  (property "Sheetfile" "{file}" {_at((at[0], at[1] + size[1]), 0)} {HIDDEN})\n'
            f'  (instances (project "{self.name}" (path "/{self.root}" (page "{number + 1}")))))'
        )

    def child_path(self, number: int) -> str:
        """KiCad's path of the sheet in this one that was added as this one, from 1."""
        return f"/{self.root}/{_uuid(f'{self.name} sheet {number}')}"

    @property
    def root(self) -> uuid.UUID:
        """This sheet's own identifier."""
        return _uuid(self.name)

    def text(self) -> str:
        """The file."""
        library = "\n".join(symbol_text(symbol, f"{LIBRARY}:") for symbol in self.symbols.values())
        size = f"{self.size[0] * MM:g} {self.size[1] * MM:g}"
        junctions = [
            f"(junction {_at(at)} (diameter 0) (color 0 0 0 0) {self._id(f'junction {at}')})"
            for at in self._junctions()
        ]
        return "\n".join(
            [
                f'(kicad_sch (version {VERSION}) (generator "tactile_cdma") '
                f'(uuid "{self.root}") (paper "User" {size})',
                f'(title_block (title "{self.title}") (company "tactile_cdma") '
                f'(comment 1 "generated by firmware/boards/generate_boards.py"))',
                f"(lib_symbols\n{library}\n)",
                *junctions,
                *self.items,
                '(sheet_instances (path "/" (page "1")))',
                ")",
                "",
            ]
        )

    def _uses(self) -> Iterator[tuple[int, str]]:
        """What is added to the numbers of parts, and the path, of every use of this sheet."""
        if self.users is None:
            yield 0, f"/{self.root}"
        else:
            for number, path in enumerate(self.users[1], start=1):
                yield 100 * number, path

    def _junctions(self) -> list[Point]:
        """Points where three or more wires and pins meet."""
        ends = [end for wire in self.wires for end in wire]
        return [
            at
            for at in dict.fromkeys(ends)
            if ends.count(at)
            + self.pins.count(at)
            + 2 * sum(inside(at, begin, end) for begin, end in self.wires)
            > 2
        ]

    def _property(self, placed: Placed, key: str, text: str) -> str:
        """A property, where it is out of the way of the part's pins."""
        symbol, (x, y), turn = placed.symbol, placed.at, placed.turn
        shown = key in ("Reference", "Value", "Note")
        if symbol.power:
            shown = key == "Value"
            up = symbol.pins[0].angle == 90
            place, side = (x, y - 1.35 if up else y + 1.5), ""
        elif symbol.names:  # a box: above and below it
            row = {"Reference": -1.7, "Value": -0.7}.get(key, 0.0)
            place, side = (x - _half_width(symbol), y - symbol.height / 2 + row), "left"
        elif turn in (90, 270):
            row = {"Reference": -0.85, "Value": 0.9, "Note": 1.6}.get(key, 0.0)
            place, side = (x, y + row), ""
        else:
            row = {"Reference": -0.45, "Value": 0.35, "Note": 1.05}.get(key, 0.0)
            place, side = (x + _half_width(symbol) + 0.3, y + row), "left"
            if symbol.height > 3:  # an op-amp: above its right half
                place = (x + 0.4, y + {"Reference": -2.6, "Value": -1.8}.get(key, 0.0))
        justify = f" (justify {side})" if side else ""
        effects = f"(effects (font (size 1.27 1.27)){justify})" if shown else HIDDEN
        angle = 90 if turn in (90, 270) else 0
        quoted = json.dumps(text, ensure_ascii=False)
        return f'(property "{key}" {quoted} {_at(place, angle)} {effects})'

    def _id(self, name: str) -> str:
        return f'(uuid "{_uuid(f"{self.name} {name}")}")'

    def _count(self, kind: str) -> int:
        self.counts[kind] = self.counts.get(kind, 0) + 1
        return self.counts[kind]


def inside(at: Point, begin: Point, end: Point) -> bool:
    """Whether a point is on a level or upright wire, and not one of its ends."""
    if at in (begin, end):
        return False
    (x, y), xs, ys = at, sorted((begin[0], end[0])), sorted((begin[1], end[1]))
    return xs[0] <= x <= xs[1] and ys[0] <= y <= ys[1]


def symbol_text(symbol: Symbol, library: str = "") -> str:
    """A symbol's definition, of a sheet or of a library."""
    name = library + symbol.name
    kind = "(power) " if symbol.power else ""
    names = "(pin_names (offset 0.762)) "
    if not symbol.names:
        names = "(pin_numbers hide) (pin_names (offset 0) hide) "
    pins = "\n    ".join(
        f"(pin {pin.kind} line {_at(pin.at, pin.angle)} (length {pin.length * MM:g}) "
        f'(name "{pin.name}" (effects (font (size 1.27 1.27)))) '
        f'(number "{pin.number}" (effects (font (size 1.27 1.27)))))'
        for pin in symbol.pins
    )
    shape = "\n    ".join(symbol.shape)
    prefix = "#PWR" if symbol.power else symbol.prefix
    return (
        f'  (symbol "{name}" {kind}{names}(exclude_from_sim no) (in_bom yes) (on_board yes)\n'
        f'   (property "Reference" "{prefix}" (at 0 0 0) {HIDDEN})\n'
        f'   (property "Value" "{symbol.name}" (at 0 0 0) {HIDDEN})\n'
        f'   (symbol "{symbol.name}_0_1"\n    {shape})\n'
        f'   (symbol "{symbol.name}_1_1"\n    {pins}))'
    )


def library_text(symbols: Sequence[Symbol]) -> str:
    """A library of symbols."""
    body = "\n".join(symbol_text(symbol) for symbol in symbols)
    return f'(kicad_symbol_lib (version {VERSION}) (generator "tactile_cdma")\n{body}\n)\n'


def _half_width(symbol: Symbol) -> float:
    reach = max(
        abs(pin.at[0]) - (pin.length if pin.angle in (0, 180) else 0) for pin in symbol.pins
    )
    return max(reach, 0.3)


def _mm(at: Point) -> str:
    return f"{round(at[0] * MM, 4):g} {round(at[1] * MM, 4):g}"


def _at(at: Point, angle: int | None = None) -> str:
    return f"(at {_mm(at)}{'' if angle is None else f' {angle}'})"


def _uuid(name: str) -> uuid.UUID:
    return uuid.uuid5(SPACE, name)
