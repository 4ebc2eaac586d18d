# SPDX-License-Identifier: Apache-2.0

"""The subcommand `tactile-cdma node`: what sensing nodes are programmed with, and their numbers."""

import argparse
import math
import queue
import shlex
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ..base.errors import LayoutError, PortError, SpecError, check_limits
from ..base.interrupt import terminable
from ..base.named_file import naming
from ..base.program import tell
from ..base.whole_file import replace_file
from ..config.arguments import add_skin_options, given
from ..config.frame_rate import MCUS, mcu_of
from ..config.parameters import DATA, DEFAULTS, Values
from ..config.skin_config import SkinConfig
from ..driver.pipeline import Pipeline
from ..driver.session import Session
from ..framing.load import capacity, groups_for_all
from ..hardware import flashing, node_memory, programmer
from ..hardware.numbering import Numbering
from ..places.layout import Layout
from ..places.layout_file import SCHEMA, VERSION
from ..wire._protocol import PacketType
from ..wire.discovery import leave_alone_if_open
from ..wire.messages import Number
from ..wire.port import Port

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
    add("--crystal-mhz", type=int, choices=node_memory.CRYSTALS_MHZ, help=text)
    add("--image", **file, help="program for --hex (that of `make firmware`)")
    add("--mcu", choices=MCUS, help="microcontroller (that of node_kind or rate_hz)")
    text = "transmit while the code is more than this off rest, or off what was sent; 0: always (1)"
    add("--threshold", type=int, default=1, help=text)
    text = (
        "rest: in every frame while it is off rest, which follows drift; change: when its code has "
        "changed since it sent it (change of sparse codes unless nodes_repeat, else rest)"
    )
    add("--speaks", choices=(node_memory.REST, node_memory.CHANGE), help=text)
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
        print(node_memory.describe_memories(*programmer.read_memory(arguments.read)))
        return 0
    _check(arguments)
    get: Values = {**DEFAULTS, **given(arguments)}
    config = SkinConfig.of(get)
    node_memory.check_timing(config.timing)
    if config.choice:
        print(config.choice)
    if arguments.flash:
        arguments.mcu = flashing.BOARDS[arguments.board].mcu
    arguments.mcu = arguments.mcu or mcu_of(config.node_kind, config.sync_wire)
    if arguments.port is not None:
        return _enumerate(arguments.port, get["baud"], config, arguments.layout)
    heartbeat = arguments.heartbeat
    if heartbeat is None:
        heartbeat = node_memory.usual_heartbeat(config.spec.frame_period_s)
    one = arguments.node not in (ALL, ANY)
    of = _taxels(config, arguments)
    nodes = [arguments.node] if one else range(1, len(of) + 1)
    check_limits("node", nodes[0], 1, len(of), "so many nodes make these taxels")
    if config.nodes_repeat and arguments.speaks == node_memory.CHANGE:
        raise SpecError(
            "nodes_repeat is true, but nodes that speak by change do not repeat what they said: "
            "the driver would believe values that changed unheard; set nodes_repeat to false"
        )
    speaks = node_memory.REST if config.nodes_repeat else arguments.speaks
    names = ("threshold", "rest", "discipline", "mcu")
    how = {"heartbeat": heartbeat, "speaks": speaks}
    how |= {name: getattr(arguments, name) for name in names}
    made = [
        [node_memory.node_memory(config.spec, taxel, **how) for taxel in of[node - 1]]
        for node in nodes
    ]
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
        return [node_memory.hearing_data(memory, mcu) for memory in memories]
    if not MCUS[mcu].hears_own:
        raise SpecError(f"mcu is {mcu}, whose image is for sync_wire {DATA!r}, not {wire!r}")
    return memories


def _check(arguments: argparse.Namespace) -> None:
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
    none = not written
    wrong = {
        "--layout is the file that --enumerate PORT writes": arguments.layout is not None,
        "-o and --hex are given: EEPROM or flash, not both": len(written) > 1,
        "-o is missing: the file to write, or with --all the folder; or --hex, or --flash": none,
        "--board, --programmer and --dry-run are of --flash, which is missing": (
            arguments.board is not None or arguments.programmer or arguments.dry_run
        ),
        "--any, --crystal-mhz and --image are about flash: give --hex instead of -o": (
            arguments.hex is None and (arguments.node == ANY or of_flash)
        ),
    }
    for text in filter(wrong.get, wrong):
        raise SpecError(text)


def _write(arguments: argparse.Namespace, memories: list[bytes]) -> None:
    """Write memories to files, and say how they get into a node."""
    mcu, of_flash = arguments.mcu, arguments.hex is not None
    output = arguments.hex if of_flash else arguments.output
    paths = [output] if arguments.node != ALL else programmer.node_files(output, len(memories))
    contents = [memories] if arguments.node == ANY else [[memory] for memory in memories]
    crystal_mhz = arguments.crystal_mhz or node_memory.CRYSTALS_MHZ[0]
    for path, content in zip(paths, contents, strict=True):
        if of_flash:
            image = programmer.node_image(mcu, content, crystal_mhz, arguments.image)
            programmer.write_image(path, image)
        else:
            programmer.write_memory(path, *content)
    print(f"written: {paths[0]}" + (f" … {paths[-1]}" if len(paths) > 1 else ""))
    kind = programmer.FLASH if of_flash else programmer.EEPROM
    board = flashing.BOARDS["pro-mini" if crystal_mhz == node_memory.CRYSTALS_MHZ[0] else "uno"]
    usual = board.programmer if of_flash else "usbasp"
    print("to the node:", shlex.join(programmer.avrdude(paths[0], mcu, usual, kind)))


def _flash(arguments: argparse.Namespace, memories: dict[int | str, bytes]) -> int:
    named = {f"node {node}": [memory] for node, memory in memories.items()}
    if arguments.node == ANY:
        named = {flashing.ANY_NODE: [*memories.values()]}
    board = flashing.BOARDS[arguments.board]
    contents = flashing.contents(board, named, arguments.image)
    return flashing.run(
        arguments.board, contents, arguments.programmer, arguments.log, arguments.dry_run
    )


def _warn_of_silence(heartbeat: int, config: SkinConfig) -> None:
    silent_s = heartbeat * config.spec.frame_period_s
    if not 0 < silent_s < config.stale_after_s:
        often = f"only every {silent_s:g} s" if silent_s else "never"
        tell(
            f"with heartbeat {heartbeat} a node at rest talks {often}, but "
            f"is stale to the driver after {config.stale_after_s:g} s (stale_after_s)"
        )


AGAIN_S = 0.5
"""s after which a request is repeated: a digitizer that was restarted announces nothing. Chosen."""
UNREAD_S, SILENT_S = 0.7, 5.0
"""s without a frame after which many nodes may speak on one row; and after which it ends. Chosen,
the latter as skin.TIMEOUT_S."""
KEYS = "b: the last one was wrong   s: leave this one out   q: end   (then Enter)"


def _enumerate(url: str, baud: int, config: SkinConfig, layout_file: Path | None) -> int:
    """Number the nodes at a port with a person at the terminal; returns the exit code."""
    leave_alone_if_open(url)
    if layout_file is not None:
        check_grid(layout_file, config.layout)  # before anybody presses anything
    typed: queue.Queue[str] = queue.Queue()
    threading.Thread(target=_type, args=(typed,), daemon=True).start()
    with terminable(), Port(url, baud) as port:
        numbering = enumerate_nodes(port, config, typed, lambda text: print(text, flush=True))
    if numbering.asked is not None:
        kept = f"; {layout_file} is not written" if layout_file else ""
        print(f"ended before node {numbering.asked} had its number{kept}", file=sys.stderr)
        return 1
    if layout_file is not None:
        write_numbered(layout_file, config.layout, numbering.skipped)
        print(f"written: {layout_file}")
    return 0


def _type(typed: "queue.Queue[str]") -> None:
    for line in sys.stdin:
        typed.put(line)


def enumerate_nodes(
    port: Port, config: SkinConfig, typed: "queue.Queue[str]", tell: Callable[[str], None]
) -> Numbering:
    """Number the nodes at a port, until all were asked for, or q was typed.

    Raises PortError where the digitizer sends no frames or does not announce numbers.
    """
    numbering, session, pipeline = Numbering(config.spec.nodes), Session(config), Pipeline(config)
    on_key = {"b": numbering.back, "s": numbering.skip}
    announced, said_s, heard_s, prompted = Number(0), -np.inf, np.inf, 0
    tell(KEYS)
    port.write(session.open())
    try:
        while numbering.asked is not None or numbering.request.forget:
            data, now_s = port.read()
            heard_s = min(heard_s, now_s)
            for frame in pipeline.feed(data, now_s):
                heard_s = now_s
                if text := numbering.take(frame.words):
                    tell(text)
            _check_heard(pipeline, session, silent_s=now_s - heard_s)
            if now_s - heard_s > UNREAD_S and numbering.waits:
                tell(numbering.unclear())
            if not typed.empty():
                if (key := typed.get().strip().lower()) == "q":
                    break
                tell(on_key[key]() if key in on_key else KEYS)
                prompted = 0
            waited_for = numbering.asked if numbering.waits else None
            if waited_for and waited_for != prompted:
                tell(prompt(config.layout, waited_for))
            prompted = waited_for or 0
            if request := session.watch(pipeline, now_s):
                port.write(request)
            if pipeline.counters.frames and (
                numbering.request != announced or now_s - said_s > AGAIN_S
            ):
                announced, said_s = numbering.request, now_s
                port.write(session.encoded(announced))
    finally:
        port.write(session.encoded(Number(0)) + session.close())
    return numbering


def _check_heard(pipeline: Pipeline, session: Session, silent_s: float) -> None:
    """Raise PortError where there was no frame for too long, or numbers are not announced."""
    if silent_s > SILENT_S:
        why = pipeline.problem or session.problem or "the digitizer sends no frames"
        raise PortError(f"no frame for {SILENT_S:g} s: {why}")
    if (refusal := pipeline.digitizer.refusal) and refusal.command == PacketType.NUMBER:
        raise PortError(
            f"the digitizer announces no numbers ({refusal.result.name.lower()}): its firmware is "
            "older, it is a demonstrator or simulated, or the pause between frames is below 2.2 ms"
        )


def prompt(layout: Layout, number: int) -> str:
    """Tell which taxel to press."""
    [taxel, *_] = [*np.flatnonzero(layout.nodes == number), -1]
    if taxel < 0:
        return f"node {number} has no place in the layout: press it, or leave it out"
    x_mm, y_mm, z_mm = layout.positions_m[taxel] * 1e3
    where = f"x {x_mm:.1f}, y {y_mm:.1f}, z {z_mm:.1f} mm"
    if not layout.irregular:
        where = f"row {taxel // layout.columns + 1}, column {taxel % layout.columns + 1} ({where})"
    return f"press the taxel of node {number}: {where}"


def check_grid(path: Path, layout: Layout) -> None:
    """Raises LayoutError for a skin, or a place, of which no layout file can be written."""
    if layout.irregular or np.ptp(layout.positions_m[:, 2]) > 0:
        raise LayoutError(
            f"{path}: the skin is not a flat grid; leave --layout out, and edit its file"
        )
    if path.is_dir() or not path.parent.is_dir():
        raise LayoutError(f"{path}: is a folder, or lies in a folder that does not exist")


def write_numbered(path: Path, layout: Layout, skipped: list[int]) -> None:
    """Write the layout file of a flat grid, without the nodes that nobody has.

    Raises LayoutError where nobody has a number.
    """
    nodes = np.where(np.isin(layout.nodes, skipped), 0, layout.nodes)
    if not nodes.any():
        raise LayoutError(f"{path}: not written: all nodes were left out")
    pitches_mm = [round(pitch_m * 1e3, 6) for pitch_m in layout.pitches_m]
    content = {
        "schema": SCHEMA,
        "version": VERSION,
        "name": layout.name,
        "shape": "grid",
        "rows": layout.rows,
        "columns": layout.columns,
        "pitch_mm": pitches_mm if pitches_mm[0] != pitches_mm[1] else pitches_mm[0],
        "masked": sorted({*layout.masked} - {*skipped}),
        "unplaced": sorted({*layout.unplaced, *skipped}),
        "nodes": nodes.reshape(layout.rows, layout.columns).tolist(),
    }
    style: dict[str, Any] = {"default_flow_style": None, "width": math.inf}  # a line for each row
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True, **style)
    with naming(path, LayoutError):
        replace_file(path, text)
