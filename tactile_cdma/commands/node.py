# SPDX-License-Identifier: Apache-2.0

"""The subcommand `tactile-cdma node`: writes and reads what sensing nodes are programmed with."""

import argparse
import shlex
import sys
from pathlib import Path
from typing import Any

from ..base.errors import SpecError
from ..config.arguments import add_skin_options, given
from ..config.parameters import DEFAULTS, Values
from ..config.skin_config import SkinConfig
from ..framing.load import capacity, groups_for_all
from ..hardware import programmer
from ..hardware.node_memory import (
    CRYSTALS_MHZ,
    MCUS,
    check_timing,
    describe_memory,
    node_memory,
    usual_heartbeat,
)
from . import node_numbers

ALL, ANY = "all", "any"
"""Instead of a node's number: a file for each, and one file for all."""
ARDUINO = {8: "arduino -P /dev/ttyUSB0 -b 57600", 16: "arduino -P /dev/ttyUSB0 -b 115200"}
"""What avrdude is told, by the crystal, MHz: of a Pro Mini's boot loader; of an Uno's."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand."""
    file: dict[str, Any] = {"type": Path, "metavar": "FILE"}
    whose: dict[str, Any] = {"action": "store_const", "dest": "node"}
    add = parser.add_mutually_exclusive_group(required=True).add_argument
    add("--node", type=_node_number, metavar="NUMBER", help="1, 2, … or all")
    add("--all", **whose, const=ALL, help="as --node all")
    add("--any", **whose, const=ANY, help="an image for all nodes (--hex)")
    text = "give nodes of such an image their numbers: press one after the other"
    add("--enumerate", metavar="PORT", dest="port", help=text)
    add("--read", **file, help="print the contents of such a file")
    add = parser.add_argument
    text = "EEPROM: Intel HEX (.hex, .eep) or bytes (.bin); with all: a folder, made if missing"
    add("-o", "--output", **file, help=text)
    text = "flash, for boot loaders: program and memory in one Intel HEX; with all: a directory"
    add("--hex", **file, help=text)
    text = "of a node flashed by --hex: 16 for an Arduino Uno or Nano (8)"
    add("--crystal-mhz", type=int, choices=CRYSTALS_MHZ, help=text)
    add("--image", **file, help="program for --hex (that of `make firmware`)")
    add("--mcu", choices=MCUS, default="atmega328p")
    text = (
        "the node transmits while its code is more than this from rest or from what it sent last; "
        "0: always [LSB] (1)"
    )
    add("--threshold", type=int, default=1, help=text)
    text = "transmit at least every so many frames; 0: never (1 s)"
    add("--heartbeat", type=int, help=text)
    add("--rest", type=int, help="code at rest (measured after power-up)")
    text = "time chips by the node's own clock only, not corrected by the sync edges"
    add("--no-discipline", action="store_false", dest="discipline", help=text)
    text = "also write it to the node by avrdude: usbasp, 'arduino -P /dev/ttyUSB0 -b 57600', …"
    add("--programmer", metavar="NAME", help=text)
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
    if arguments.port is not None:
        return node_numbers.run(arguments.port, get["baud"], config, arguments.layout)
    heartbeat = arguments.heartbeat
    if heartbeat is None:
        heartbeat = usual_heartbeat(config.spec.frame_period_s)
    one = arguments.node not in (ALL, ANY)
    nodes = [arguments.node] if one else range(1, config.spec.nodes + 1)
    names = ("threshold", "rest", "discipline", "mcu")
    how = {"heartbeat": heartbeat} | {name: getattr(arguments, name) for name in names}
    _write(arguments, [node_memory(config.spec, node, **how) for node in nodes])
    if arguments.threshold:
        _warn_of_silence(heartbeat, config)
    if config.spec.sparse:
        groups = groups_for_all(config.spec)
        print(
            f"sparse codes: {capacity(config.spec)} of {config.spec.nodes} nodes may speak in one "
            f"frame, and all {f'by turns, in {groups} groups' if groups else 'never'}"
        )
    return 0


def _check(arguments: argparse.Namespace) -> None:
    """Raise SpecError for options that do not go together."""
    of_flash = bool(arguments.crystal_mhz or arguments.image)
    written = [one for one in (arguments.hex, arguments.output) if one is not None]
    if arguments.port is not None:
        if written or of_flash:
            raise SpecError("--enumerate writes no memory: leave out --hex, -o, --crystal-mhz")
        return
    for is_wrong, text in (
        (arguments.layout is not None, "--layout is the file that --enumerate PORT writes"),
        (len(written) > 1, "-o and --hex are given: EEPROM or flash, not both"),
        (not written, "-o is missing: the file to write, or with all the directory; or --hex"),
        (
            arguments.hex is None and (arguments.node == ANY or of_flash),
            "--any, --crystal-mhz and --image are about flash: give --hex instead of -o",
        ),
        (
            arguments.programmer and arguments.node == ALL,
            "--programmer writes one node, the one that is connected: --node is all",
        ),
    ):
        if is_wrong:
            raise SpecError(text)


def _write(arguments: argparse.Namespace, memories: list[bytes]) -> None:
    """Write memories to files, and to the node that is connected or say how."""
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
    usual = ARDUINO[crystal_mhz] if of_flash else "usbasp"
    if arguments.programmer:
        programmer.burn(output, mcu, arguments.programmer, kind)
    else:
        print("to the node:", shlex.join(programmer.avrdude(paths[0], mcu, usual, kind)))


def _node_number(text: str) -> int | str:
    if text != ALL and not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number nor {ALL!r}")
    return text if text == ALL else int(text)


def _warn_of_silence(heartbeat: int, config: SkinConfig) -> None:
    """Warn of nodes that are silent for so long that a driver takes them for stale."""
    silent_s = heartbeat * config.spec.frame_period_s
    if not 0 < silent_s < config.stale_after_s:
        often = f"only every {silent_s:g} s" if silent_s else "never"
        print(
            f"tactile-cdma: with heartbeat {heartbeat} a node at rest talks {often}, but "
            f"is stale to the driver after {config.stale_after_s:g} s (stale_after_s)",
            file=sys.stderr,
        )
