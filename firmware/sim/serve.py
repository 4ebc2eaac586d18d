# SPDX-License-Identifier: Apache-2.0

"""The emulated skin behind a tty, live: `make run FIRMWARE=1`.

Node images run under simavr, their pins add up on the analog line, and the digitizer's core samples
it; bytes leave through a pseudo-terminal in real time.
"""

from __future__ import annotations

import argparse
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

from emulated import EmulatedSkin, EmulationError, Node
from skin import CRYSTALS, PressedSkin, reference_amplifier, reference_nodes
from tactile_cdma.base.errors import TactileError
from tactile_cdma.config.frame_rate import FAST, MCUS
from tactile_cdma.config.parameters import read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.sim.pty import serve
from tactile_cdma.sim.scene import SCENES

STEP_S = 2e-3
"""Step of the emulation, s. Chosen: small against a frame of 8 ms."""
MOST_LAG_S = 0.1
"""An emulation that falls farther behind the host's clock, s, does not catch up. Chosen."""
SLOW = (
    "serve.py: this machine is too slow to emulate this many nodes in real time: "
    "the frame rate is too low, and the age of frames is meaningless"
)


class LiveSkin:
    """Is an emulated skin in real time: a `tactile_cdma.sim.pty.Digitizer`."""

    def __init__(self, skin: PressedSkin, clock: Callable[[], float] = time.monotonic) -> None:
        self._skin, self._clock = skin, clock
        self._origin_s = clock()
        self._output = bytearray()
        self._is_late = False

    def receive(self, data: bytes) -> None:
        """Hand bytes of the host to the digitizer."""
        self._skin.write(data)

    def advance(self, wanted: int) -> float:
        """Let the emulation catch up with the host's clock, by a step at most."""
        lag_s = self._clock() - self._origin_s - self._skin.now_ns * 1e-9
        if lag_s > MOST_LAG_S:
            self._origin_s += lag_s - MOST_LAG_S
            if not self._is_late:
                self._is_late = True
                print(SLOW, file=sys.stderr, flush=True)
        if lag_s >= STEP_S:
            self._skin.run(self._skin.now_ns + round(STEP_S * 1e9))
            self._output += self._skin.read()
        return max(0.0, STEP_S - lag_s)

    def take(self, size: int) -> bytes:
        """Take at most `size` bytes for the host."""
        data = bytes(self._output[:size])
        del self._output[:size]
        return data


def nodes_for(config: SkinConfig) -> list[Node]:
    """Return the nodes that make chips of this length: fast ones, with crystals, or slow ones."""
    if round(config.spec.chip_s * 1e9) <= MCUS[FAST].longest_chip_ns:
        return reference_nodes(config, CRYSTALS, mcu=FAST)
    return reference_nodes(config)


def main() -> int:
    """Serve until SIGINT or SIGTERM; print the tty's path when ready."""
    parser = argparse.ArgumentParser(description="The emulated skin behind a tty.")
    parser.add_argument("--params", type=Path, required=True, help="ROS 2 parameter file")
    parser.add_argument("--scene", choices=SCENES, default="demo", help="what touches it")
    parser.add_argument("--wired", type=int, help="only the first so many nodes are on the line")
    parser.add_argument("--link", type=Path, help="symbolic link to make to the tty")
    arguments = parser.parse_args()
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    try:
        config = SkinConfig.of(read_file(arguments.params))
        nodes = nodes_for(config)[: arguments.wired]
        with EmulatedSkin(nodes, reference_amplifier(config)) as emulated:
            skin = PressedSkin(config, SCENES[arguments.scene], emulated, emulated)
            serve(lambda: LiveSkin(skin), arguments.link, stop, lambda p: print(p, flush=True))
    except (EmulationError, TactileError) as error:
        print(f"{Path(__file__).name}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
