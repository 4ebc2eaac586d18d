# SPDX-License-Identifier: Apache-2.0

"""The emulated skin of a parameter file: nodes with tolerances, pressed by a scene."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from emulated import Amplifier, DataWire, EmulatedNodes, Node
from tactile_cdma.base.errors import SpecError
from tactile_cdma.config.frame_rate import MCUS
from tactile_cdma.config.parameters import DATA
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.hardware.node_memory import REST, check_timing, hearing_data, node_memory
from tactile_cdma.sim.scene import Scene, SkinGeometry

IMAGES = Path(__file__).resolve().parents[1] / "build" / "node"
SUPPLY_V = 3.3
CLOCK_HZ = 8e6
NOISE_V = 2e-3
"""Standard deviation of one sample on the line, V. Chosen: 2.5 counts of the converter."""


@dataclass(frozen=True, slots=True)
class Spread:
    """Tolerances of the nodes, uniform within ± these relative errors.

    clock: of the oscillators. supply: of the supplies, and so of the levels on the line.
    skew_ns: longest delay of the sync line at a node; uniform from 0.
    """

    clock: float = 0.02
    supply: float = 0.03
    skew_ns: float = 0.0
    seed: int = 1


CRYSTALS = Spread(clock=50e-6, supply=0.01, skew_ns=200)
"""Parameters that fast nodes ask for (firmware/README.md)."""


DATA_DELAY_S, BANDGAP_V = (0.3e-6, 1.5e-6), (1.0, 1.2)
"""On the data wire: from its edge to a comparator's output, behind the node's resistor (SPICE, 0.3
to 0.8 µs; the data sheet's typical 0.1 to 0.75 µs), and the comparator's level (data sheet)."""
PULL = DataWire(pulled_v=3.24, recovery_s=2e-6, back_s=3.5e-6)
"""The pulled wire with an amplifier, within 1 mV of rest after 15 µs, at 4 nF (SPICE)."""
PASSIVE_PULL = DataWire(pulled_v=0.11, recovery_s=4.5e-6, back_s=3.5e-6)
"""A pulled wire without an amplifier, after 33 µs."""


def reference_nodes(
    config: SkinConfig,
    spread: Spread | None = None,
    *,
    mcu: str = "atmega328p",
    discipline: bool = True,
    threshold: int = 1,
    heartbeat: int | None = None,
    rest: int | None = None,
) -> list[Node]:
    """Make the nodes of a skin, each with the memory that `tactile-cdma node` would give it.

    With several sensors each they are fewer; what they hear on the data wire is in their memory.

    The slowest and the fastest clock of the spread are included. Raises SpecError if the parameters
    leave the amplitude open.
    """
    spec, spread = config.spec, spread or Spread()
    if spec.amplitude_v is None:
        raise SpecError(
            "amplitude_mv is 0 (learnt from every frame): an emulated skin needs a value"
        )
    check_timing(config.timing)
    rng = np.random.default_rng(spread.seed)
    sensors = MCUS[mcu].sensors
    size = spec.nodes // sensors
    clocks = rng.permutation(np.linspace(-spread.clock, spread.clock, size))
    supplies = rng.uniform(-spread.supply, spread.supply, size)
    delays_ns = rng.uniform(0, spread.skew_ns, size)

    def memory(taxel: int) -> bytes:
        made = node_memory(
            spec,
            taxel,
            threshold=threshold,
            heartbeat=heartbeat,
            discipline=discipline,
            rest=rest,
            mcu=mcu,
            speaks=REST if config.nodes_repeat else None,
        )
        return hearing_data(made, mcu) if config.sync_wire == DATA else made

    nodes = [
        Node(
            image=IMAGES / f"node-{mcu}.elf",
            mcu=mcu,
            memory=b"".join(memory(number * sensors + s + 1) for s in range(sensors)),
            clock_hz=CLOCK_HZ * (1 + clocks[number]),
            supply_v=SUPPLY_V * (1 + supplies[number]),
            gain=spec.amplitude_v / (SUPPLY_V / 2),
            delay_ns=round(delays_ns[number]),
        )
        for number in range(size)
    ]
    return _on_data_wire(nodes, spread.seed) if config.sync_wire == DATA else nodes


def _on_data_wire(nodes: list[Node], seed: int) -> list[Node]:
    """Return these nodes with comparators that hear sync pulses on the data wire."""
    rng = np.random.default_rng(seed)
    return [
        replace(
            node,
            delay_ns=round(rng.uniform(*DATA_DELAY_S) * 1e9),
            bandgap_v=rng.uniform(*BANDGAP_V),
        )
        for node in nodes
    ]


def reference_amplifier(config: SkinConfig) -> Amplifier:
    """Design the amplifier between these nodes and the digitizer."""
    pull = PULL if config.sync_wire == DATA else None
    return Amplifier(polarity=config.spec.polarity, noise_v=NOISE_V, pull=pull)


class Digitized(Protocol):
    """Is nodes with a digitizer, however that is emulated."""

    @property
    def now_ns(self) -> int:
        """Tell how far the emulation has come."""

    def run(self, t_ns: int) -> None:
        """Run everything to a time."""

    def write(self, data: bytes) -> None:
        """Pass bytes from the host to the digitizer."""

    def read(self) -> bytes:
        """Return the next frame in order, waited for."""


class PressedSkin:
    """Presses an emulated skin by a scene. Pressures are constant for a frame period at a time.

    There may be fewer nodes than the configuration has: the others are not on the line.
    phase_ns: time from a multiple of the frame period to the change of pressures.
    """

    def __init__(
        self, config: SkinConfig, scene: Scene, nodes: EmulatedNodes, digitizer: Digitized
    ) -> None:
        self.phase_ns = 0
        self._config, self._scene = config, scene
        self._nodes, self._digitizer = nodes, digitizer
        self._supplies_v = np.array([nodes.nodes[node].supply_v for node, _ in nodes.sensors])
        self._place = SkinGeometry.of(config.layout, config.spec.nodes)
        self._pressed_ns: list[int] = []
        self._codes: list[NDArray[np.int64]] = []
        self._next_ns = 0
        self._press()

    @property
    def now_ns(self) -> int:
        """Tell how far the emulation has come."""
        return self._digitizer.now_ns

    def run(self, t_ns: int) -> None:
        """Run to a time, changing the pressures on the way."""
        while self._next_ns <= t_ns:
            self._digitizer.run(self._next_ns)
            self._press()
        self._digitizer.run(t_ns)

    def write(self, data: bytes) -> None:
        """Pass bytes from the host to the digitizer."""
        self._digitizer.write(data)

    def read(self) -> bytes:
        """Return the next frame in order, waited for."""
        return self._digitizer.read()

    def codes(self, t_ns: int) -> NDArray[np.int64]:
        """Return codes of ideal converters for the sensors' voltages at a time: (n,)."""
        return self._codes[bisect_right(self._pressed_ns, t_ns) - 1]

    def _press(self) -> None:
        config = self._config
        volts = config.curve.voltage(self._scene(self.now_ns * 1e-9, self._place))
        self._pressed_ns.append(self.now_ns)
        self._codes.append(config.adc.code(volts))
        # Sensor and converter share a node's supply: the code is the ratio.
        placed = volts[: self._supplies_v.size]
        self._nodes.press(placed / config.adc.vref_v * self._supplies_v)
        period_ns = round(config.spec.frame_period_s * 1e9)
        periods = (self.now_ns - self.phase_ns) // period_ns + 1
        self._next_ns = self.phase_ns + periods * period_ns
