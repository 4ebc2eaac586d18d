# SPDX-License-Identifier: Apache-2.0

"""The subcommand `tactile-cdma node`: writes and reads what sensing nodes are programmed with."""

import argparse
import shlex
from pathlib import Path
from typing import Any

from ..base.errors import SpecError, check_limits
from ..base.program import tell
from ..config.arguments import add_skin_options, given
from ..config.frame_rate import MCUS, mcu_of
from ..config.parameters import DATA, DEFAULTS, Values
from ..config.skin_config import SkinConfig
from ..framing.load import capacity, groups_for_all
from ..hardware import flashing, programmer
from ..hardware.node_memory import (
    CHANGE,
    CRYSTALS_MHZ,
    REST,
    check_timing,
    describe_memory,
    hearing_data,
    node_memory,
    usual_heartbeat,
)
from . import node_numbers

ALL, ANY = "all", "any"
"""Instead of a node's number: a file for each, and one file for all."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand."""
    file: dict[str, Any] = {"type": Path, "metavar": "FILE"}
    whose: dict[str, Any] = {"action": "store_const", "dest": "node"}
    add = parser.add_mutually_exclusive_group(required=True).add_argument
    add("--node", type=int, metavar="NUMBER", help="one node: 1, 2, …")
    add("--all", **whose, const=ALL, help="every node: a folder of files")
    add("--any", **whose, const=ANY, help="one image for all nodes, with --hex")
    text = "give the nodes of such an image their numbers, by pressing one after the other"
    add("--enumerate", metavar="PORT", dest="port", help=text)
    add("--read", **file, help="print what a file of a node's memory says")
    add = parser.add_argument
    text = "EEPROM: Intel HEX (.hex, .eep) or bytes (.bin); with --all a folder, made if missing"
    add("-o", "--output", **file, help=text)
    text = "flash, for boot loaders: program and memory in one Intel HEX; with --all a folder"
    add("--hex", **file, help=text)
    text = "crystal of a node flashed by --hex: 16 for an Arduino Uno or Nano (8)"
    add("--crystal-mhz", type=int, choices=CRYSTALS_MHZ, help=text)
    add("--image", **file, help="program for --hex (that of `make firmware`)")
    add("--mcu", choices=MCUS, help="microcontroller (that of node_kind or rate_hz)")
    text = "transmit while the code is more than this off rest, or off what was sent; 0: always (1)"
    add("--threshold", type=int, default=1, help=text)
    text = (
        "rest: in every frame while it is off rest, which follows drift; change: when its code has "
        "changed since it sent it (change of sparse codes unless nodes_repeat, else rest)"
    )
    add("--speaks", choices=(REST, CHANGE), help=text)
    text = "transmit at least every so many frames; 0: never (1 s)"
    add("--heartbeat", type=int, help=text)
    add("--rest", type=int, help="code at rest (measured after power-up)")
    text = "time chips by the node's own clock only, not corrected by the sync edges"
    add("--no-discipline", action="store_false", dest="discipline", help=text)
    text = "write program and memory to nodes, one after the other, by avrdude; with --board"
    add("--flash", action="store_true", help=text)
    add("--board", choices=flashing.BOARDS, help="board to flash: tells fuses, clock, programmer")
    text = "for --flash, as avrdude takes it: usbasp, 'arduino -P /dev/ttyUSB0 -b 57600', …"
    add("--programmer", metavar="NAME", help=text)
    add("--log", **file, default=Path("flash.log"), help="where --flash logs (flash.log)")
    add("--dry-run", action="store_true", help="only print what --flash would do")
    add("--layout", **file, help="layout file that --enumerate writes")
    add_skin_options(parser, "the driver's")


def run(arguments: argparse.Namespace) -> int:
    """Write or print memories; returns the exit code."""
    if arguments.read:
        print(describe_memory(*programmer.read_memory(arguments.read)))
        return 0
    _check(arguments)
    get: Values = {**DEFAULTS, **given(arguments)}
    config = SkinConfig.of(get)
    check_timing(config.timing)
    if config.choice:
        print(config.choice)
    if arguments.flash:
        arguments.mcu = flashing.BOARDS[arguments.board].mcu
    arguments.mcu = arguments.mcu or mcu_of(config.node_kind, config.sync_wire)
    if arguments.port is not None:
        return node_numbers.run(arguments.port, get["baud"], config, arguments.layout)
    heartbeat = arguments.heartbeat
    if heartbeat is None:
        heartbeat = usual_heartbeat(config.spec.frame_period_s)
    one = arguments.node not in (ALL, ANY)
    of = _taxels(config, arguments)
    nodes = [arguments.node] if one else range(1, len(of) + 1)
    check_limits("node", nodes[0], 1, len(of), "so many nodes make these taxels")
    names = ("threshold", "rest", "discipline", "mcu")
    how = {"heartbeat": heartbeat, "speaks": _rule(arguments.speaks, config.nodes_repeat)}
    how |= {name: getattr(arguments, name) for name in names}
    made = [[node_memory(config.spec, taxel, **how) for taxel in of[node - 1]] for node in nodes]
    memories = [b"".join(_heard_on(config.sync_wire, each, arguments.mcu)) for each in made]
    if arguments.flash:
        return _flash(arguments, dict(zip(nodes, memories, strict=True)))
    _write(arguments, memories)
    if arguments.threshold:
        _warn_of_silence(heartbeat, config)
    if config.spec.sparse:
        groups = groups_for_all(config.spec)
        print(
            f"sparse codes: {capacity(config.spec)} of {config.spec.nodes} nodes may speak in one "
            f"frame, and all {f'by turns, in {groups} groups' if groups else 'never'}"
        )
    return 0


def _taxels(config: SkinConfig, arguments: argparse.Namespace) -> list[range]:
    """Number the taxels of each node: four in a row, where it has as many sensors.

    Raises SpecError where they do not come out even, or are to be numbered by pressing.
    """
    count, taxels = MCUS[arguments.mcu].sensors, config.spec.nodes
    if taxels % count:
        raise SpecError(
            f"nodes is {taxels}, but a node with {arguments.mcu} has {count} sensors, each with a "
            f"row of its own: set nodes to a multiple of {count}"
        )
    if count > 1 and arguments.node == ANY:
        raise SpecError(
            f"--any: a node with {count} sensors takes no number by pressing; use --all"
        )
    return [range(first, first + count) for first in range(1, taxels + 1, count)]


def _heard_on(wire: str, memories: list[bytes], mcu: str) -> list[bytes]:
    """Have nodes hear sync pulses on this wire. Raises SpecError for those that cannot."""
    if wire == DATA:
        return [hearing_data(memory, mcu) for memory in memories]
    if not MCUS[mcu].hears_own:
        raise SpecError(f"mcu is {mcu}, whose image is for sync_wire {DATA!r}, not {wire!r}")
    return memories


def _check(arguments: argparse.Namespace) -> None:
    """Raise SpecError for options that do not go together."""
    of_flash = bool(arguments.crystal_mhz or arguments.image)
    written = [one for one in (arguments.hex, arguments.output) if one is not None]
    if arguments.port is not None:
        if written or of_flash:
            raise SpecError("--enumerate writes no memory: leave out --hex, -o, --crystal-mhz")
        return
    if arguments.flash:
        if written or arguments.crystal_mhz or arguments.mcu or arguments.board is None:
            raise SpecError(
                "--flash needs --board, which says the rest: no -o, --hex, --crystal-mhz, --mcu"
            )
        return
    for is_wrong, text in (
        (arguments.layout is not None, "--layout is the file that --enumerate PORT writes"),
        (len(written) > 1, "-o and --hex are given: EEPROM or flash, not both"),
        (
            not written,
            "-o is missing: the file to write, or with --all the folder; or --hex, or --flash",
        ),
        (
            arguments.board is not None or arguments.programmer or arguments.dry_run,
            "--board, --programmer and --dry-run are of --flash, which is missing",
        ),
        (
            arguments.hex is None and (arguments.node == ANY or of_flash),
            "--any, --crystal-mhz and --image are about flash: give --hex instead of -o",
        ),
    ):
        if is_wrong:
            raise SpecError(text)


def _write(arguments: argparse.Namespace, memories: list[bytes]) -> None:
    """Write memories to files, and say how they get into a node."""
    mcu, of_flash = arguments.mcu, arguments.hex is not None
    output = arguments.hex if of_flash else arguments.output
    paths = [output] if arguments.node != ALL else programmer.node_files(output, len(memories))
    contents = [memories] if arguments.node == ANY else [[memory] for memory in memories]
    crystal_mhz = arguments.crystal_mhz or CRYSTALS_MHZ[0]
    for path, content in zip(paths, contents, strict=True):
        if of_flash:
            image = programmer.node_image(mcu, content, crystal_mhz, arguments.image)
            programmer.write_image(path, image)
        else:
            programmer.write_memory(path, *content)
    print(f"written: {paths[0]}" + (f" … {paths[-1]}" if len(paths) > 1 else ""))
    kind = programmer.FLASH if of_flash else programmer.EEPROM
    board = flashing.BOARDS["pro-mini" if crystal_mhz == CRYSTALS_MHZ[0] else "uno"]
    usual = board.programmer if of_flash else "usbasp"
    print("to the node:", shlex.join(programmer.avrdude(paths[0], mcu, usual, kind)))


def _flash(arguments: argparse.Namespace, memories: dict[int | str, bytes]) -> int:
    """Write nodes at a programmer; returns the exit code."""
    named = {f"node {node}": [memory] for node, memory in memories.items()}
    if arguments.node == ANY:
        named = {flashing.ANY_NODE: [*memories.values()]}
    board = flashing.BOARDS[arguments.board]
    contents = flashing.contents(board, named, arguments.image)
    return flashing.run(
        arguments.board, contents, arguments.programmer, arguments.log, arguments.dry_run
    )


def _rule(speaks: str | None, nodes_repeat: bool) -> str | None:
    """Choose the rule that the driver counts on; raise SpecError where another one is asked for."""
    if nodes_repeat and speaks == CHANGE:
        raise SpecError(
            "nodes_repeat is true, but nodes that speak by change do not repeat what they said: "
            "the driver would believe values that changed unheard; set nodes_repeat to false"
        )
    return REST if nodes_repeat else speaks


def _warn_of_silence(heartbeat: int, config: SkinConfig) -> None:
    """Warn of nodes that are silent for so long that a driver takes them for stale."""
    silent_s = heartbeat * config.spec.frame_period_s
    if not 0 < silent_s < config.stale_after_s:
        often = f"only every {silent_s:g} s" if silent_s else "never"
        tell(
            f"with heartbeat {heartbeat} a node at rest talks {often}, but "
            f"is stale to the driver after {config.stale_after_s:g} s (stale_after_s)"
        )
