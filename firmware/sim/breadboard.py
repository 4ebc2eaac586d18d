# SPDX-License-Identifier: Apache-2.0

"""Nodes on a breadboard: no amplifier; records in flash, as an Arduino's boot loader writes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from emulated import Amplifier, Node
from skin import NOISE_V, PASSIVE_PULL, SUPPLY_V, reference_nodes
from tactile_cdma.config.parameters import DATA
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.hardware.passive import PassiveLine
from tactile_cdma.hardware.programmer import node_image

UNO_OHM, UNO_V = 1.5, 5.0
"""Rin of an Arduino of 5 V over that of those of 3.3 V, so that it is as loud; its supply, V."""


@contextmanager
def breadboard_nodes(config: SkinConfig, *, unos: int = 0, silent: int = 0) -> Iterator[list[Node]]:
    """Make the nodes of a skin, whose EEPROM is blank; the last ones of 16 MHz and 5 V.

    silent: first ones, which speak when they are touched only; the others do in every frame.
    """
    quiet = reference_nodes(config, heartbeat=0)[:silent]
    nodes = quiet + reference_nodes(config, threshold=0)[silent:]
    first_uno = len(nodes) - unos
    with TemporaryDirectory() as folder:
        made = []
        for number, node in enumerate(nodes):
            of_uno = number >= first_uno
            image = Path(folder) / f"node{number + 1}.hex"
            image.write_text(node_image(node.mcu, [node.memory], 16 if of_uno else 8, None))
            plain = replace(node, image=image, memory=b"", supply_v=SUPPLY_V, gain=1.0)
            uno = replace(plain, clock_hz=2 * node.clock_hz, supply_v=UNO_V, gain=1 / UNO_OHM)
            made.append(uno if of_uno else plain)
        yield made


def breadboard_line(line: PassiveLine, config: SkinConfig) -> Amplifier:
    """Design the line in place of an amplifier."""
    pull = PASSIVE_PULL if config.sync_wire == DATA else None
    return Amplifier(offset_v=line.supply_v / 2, noise_v=NOISE_V, load=line.load, pull=pull)
