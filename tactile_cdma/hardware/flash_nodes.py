# SPDX-License-Identifier: Apache-2.0

"""`tactile-cdma node --flash`: asks for one node after the other, and writes each whole."""

import shlex
import time
from collections.abc import Mapping
from pathlib import Path

from ..base.errors import NodeMemoryError
from ..base.named_file import naming
from .flashing import BOARDS, NO_NUMBER, Board, Content, command, flash
from .programmer import node_image, program_text

ANY_NODE = "any node"
"""Name of one without a number, of which there may be any number."""
OK = "ok, read back"
KEYS = "(Enter; s: leave it out; q: end) "


def contents(
    board: Board, memories: Mapping[str, list[bytes]], program: Path | None
) -> dict[str, Content]:
    """Return what each node is to hold, by its name; several memories: it has no number yet.

    A boot loader writes flash only, where a number goes before an older one in the EEPROM.
    """
    made = {}
    for name, theirs in memories.items():
        if board.fuses and len(theirs) == 1:
            made[name] = Content(program_text(board.mcu, program), theirs[0])
        else:
            image = node_image(board.mcu, theirs, board.crystal_mhz, program)
            made[name] = Content(image, NO_NUMBER if board.fuses else None)
    return made


def run(
    name: str,
    nodes: Mapping[str, Content],
    programmer: str | None,
    log: Path,
    dry: bool,
) -> int:
    """Write nodes with a person at the terminal; returns the exit code, 1 where some are left.

    One without a number is written until the person ends. log: gets a line for every attempt. dry:
    only the commands are told.
    """
    board, written = BOARDS[name], []
    programmer = programmer or board.programmer
    if dry:
        for node, content in nodes.items():
            print(f"{node}:", shlex.join(command(board, content, programmer, Path(node))))
        return 0
    todo = [*nodes]
    while todo:
        node = todo[0]
        if (key := _answer(f"{node}: connect the {name} {KEYS}")) == "q":
            break
        if key != "s":
            result = _write(board, nodes[node], programmer)
            print(f"{node}: {result}", flush=True)
            with naming(log, NodeMemoryError), log.open("a", encoding="utf-8") as file:
                file.write(f"{time.strftime('%Y-%m-%dT%H:%M:%S%z')} {name} {node}: {result}\n")
            if result == OK:
                written.append(node)
            if result != OK or node == ANY_NODE:
                continue
        del todo[0]
    left = [node for node in nodes if node not in written]
    print(f"flashed={len(written)} left={len(left)} log={log}")
    return int(bool(left))


def _answer(question: str) -> str:
    try:
        return input(question).strip().lower()
    except EOFError:
        return "q"


def _write(board: Board, content: Content, programmer: str) -> str:
    """Write one; returns OK, or what went wrong."""
    try:
        flash(board, content, programmer)
    except NodeMemoryError as error:
        return str(error)
    return OK
