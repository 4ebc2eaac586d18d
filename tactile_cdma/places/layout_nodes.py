# SPDX-License-Identifier: Apache-2.0

"""Assigns nodes to the taxels of a layout file.

Every node has one place, or is listed as unplaced.
"""

from dataclasses import dataclass

import numpy as np

from ..base.arrays import Int32s
from ..base.marked_yaml import Keys, Marked
from ..base.text import listed

MOST_TAXELS = 65_535
"""Largest count that TactileSkinInfo can hold: 16 bits."""


@dataclass(frozen=True, slots=True)
class Wiring:
    """The parameters of the skin that a layout is for.

    nodes: number on the wire; None: the highest in the layout. first_row: code row of node 1.
    skin: its name; empty: not checked.
    """

    nodes: int | None = None
    first_row: int = 1
    skin: str = ""


@dataclass(frozen=True, slots=True)
class TaxelNode:
    """A taxel and its node in the file.

    taxel: its name in messages. node: 1-based; 0: none. value: where the file states the node.
    """

    taxel: str
    node: int
    value: Marked


def node_of_entry(entry: Keys, first_row: int) -> TaxelNode:
    """Read the node of a taxel in a list, from its key node or code_row."""
    node, code_row = entry.get("node"), entry.get("code_row")
    value = node or code_row
    if not value or (node and code_row):
        raise entry.value.refuse(f"{entry.what} needs a node or a code_row, and not both")
    return _taxel_node(entry.what, value, None if node else first_row)


def nodes_of_grid(content: Keys, rows: int, columns: int, first_row: int) -> list[TaxelNode]:
    """Read a grid's nodes, row-major, from nodes or code_rows; without either 1, 2, 3 and so on."""
    nodes, code_rows = content.get("nodes"), content.get("code_rows")
    if nodes and code_rows:
        raise code_rows.refuse("nodes and code_rows say the same: leave one out")
    taxels = [
        f"taxel {row * columns + column} (row {row}, column {column})"
        for row in range(rows)
        for column in range(columns)
    ]
    if nodes:
        cells = zip(taxels, _matrix(nodes, "nodes", rows, columns), strict=True)
        return [TaxelNode(t, 0, v) if v.content == "0" else _taxel_node(t, v) for t, v in cells]
    if code_rows:
        cells = zip(taxels, _matrix(code_rows, "code_rows", rows, columns), strict=True)
        return [TaxelNode(t, 0, v) if v.is_null else _taxel_node(t, v, first_row) for t, v in cells]
    return [TaxelNode(taxel, node, content["shape"]) for node, taxel in enumerate(taxels, start=1)]


def check_nodes(
    content: Keys, places: list[TaxelNode], wiring: Wiring
) -> tuple[Int32s, tuple[int, ...], tuple[int, ...]]:
    """Return the nodes of the taxels, (t,) int32, and the masked and the unplaced nodes.

    Raises LayoutError for a node with two places or none, or beyond the skin's number, and for
    masked or unplaced nodes that contradict the places.
    """
    placed = _placed(content, places)
    masked, unplaced = _numbers(content, "masked"), _numbers(content, "unplaced")
    nodes = wiring.nodes or max(placed.keys() | unplaced.keys())
    for node, place in placed.items():
        if node > nodes:
            raise place.value.refuse(
                f"{place.taxel} has node {node}, but the skin has {nodes} nodes, on code rows "
                f"{wiring.first_row}…{wiring.first_row + nodes - 1}"
            )
    for node in unplaced:
        why = f"which is behind {placed[node].taxel}" if node in placed else ""
        why = why or (f"but the skin has {nodes} nodes" if node > nodes else "")
        if why:
            raise unplaced[node].refuse(f"unplaced lists node {node}, {why}")
    for node in (node for node in masked if node not in placed):
        raise masked[node].refuse(f"masked lists node {node}, which is behind no taxel")
    missing = [n for n in range(1, nodes + 1) if n not in placed and n not in unplaced]
    if missing:
        raise content.value.refuse(
            f"no place for {listed(missing, 'node')} of the skin's {nodes}; place them, or list "
            "under 'unplaced' what is on the wire but not on the skin"
        )
    nodes_of_taxels = np.array([place.node for place in places], dtype=np.int32)
    return nodes_of_taxels, tuple(sorted(masked)), tuple(sorted(unplaced))


def _placed(content: Keys, places: list[TaxelNode]) -> dict[int, TaxelNode]:
    placed = dict[int, TaxelNode]()
    for place in places:
        if other := placed.get(place.node):
            raise place.value.refuse(
                f"{place.taxel} has node {place.node}, which is behind {other.taxel} already (line "
                f"{other.value.line})"
            )
        if place.node:
            placed[place.node] = place
    if not placed:
        raise content.value.refuse("no taxel has a node")
    return placed


def _matrix(value: Marked, what: str, rows: int, columns: int) -> list[Marked]:
    lines = value.items(what)
    if len(lines) != rows:
        raise value.refuse(f"{what} has {len(lines)} rows; rows is {rows}")
    return [cell for line in lines for cell in line.items(f"a row of {what}", columns, columns)]


def _taxel_node(taxel: str, value: Marked, first_row: int | None = None) -> TaxelNode:
    """Read a taxel's node, which is given by number or, with first_row, by its code row."""
    if first_row is None:
        return TaxelNode(taxel, value.whole(f"the node of {taxel}", 1, MOST_TAXELS), value)
    code_row = value.whole(f"the code row of {taxel}", 0, first_row + MOST_TAXELS - 1)
    if code_row < first_row:
        raise value.refuse(f"{taxel} has code row {code_row}, but node 1 has row {first_row}")
    return TaxelNode(taxel, code_row - first_row + 1, value)


def _numbers(content: Keys, key: str) -> dict[int, Marked]:
    listing, numbers = content.get(key), dict[int, Marked]()
    for value in listing.items(key) if listing else ():
        number = value.whole(f"a node in {key}", 1, MOST_TAXELS)
        if number in numbers:
            raise value.refuse(f"{key} lists node {number} twice")
        numbers[number] = value
    return numbers
