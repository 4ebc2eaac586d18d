# SPDX-License-Identifier: Apache-2.0

"""The emulated skin: sensing nodes that run their real images on one analog line (skin.h).

EmulatedNodes has the nodes, their sync line and the analog line; EmulatedSkin adds a digitizer: the
firmware's core on a virtual board (virtual_board.h). Times are in ns from power-up of the skin, the
same for all nodes whatever their clocks.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import (
    POINTER,
    byref,
    c_bool,
    c_char_p,
    c_double,
    c_int,
    c_int8,
    c_int64,
    c_size_t,
    c_uint32,
    c_uint64,
    c_void_p,
)
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_cdma.config.frame_rate import MCUS
from tactile_cdma.hardware.programmer import from_hex

LIBRARY = Path(__file__).resolve().parents[1] / "build" / "sim" / "libskin.so"
EDGE = np.dtype([("t_ns", "<i8"), ("level", "i1")], align=True)
"""A change of an output pin: level is +1 high, −1 low, 0 released."""
_MIN_RUN_NS = 10_000_000
"""Least time run before old edges are dropped, ns. Chosen: a frame or so."""
_AVR = 83
"""e_machine of an ELF image for the AVR."""


class EmulationError(Exception):
    """The emulation that was asked for is not possible."""


@dataclass(frozen=True, slots=True)
class Node:
    """Is a sensing node.

    image: its firmware, an ELF file, or Intel hex of its flash. mcu: "atmega328p", "attiny85" or
    another of avr_node.c. sensors: of "atmega328p-four" there are four, each with a line.
    memory: the beginning of its EEPROM. clock_hz: true frequency of its oscillator, which it may
    divide. supply_v: V. gain: of its input of the amplifier; its level on the line is
    gain · supply_v / 2. start_ns: power-up.
    delay_ns: of the sync line's edges on the way to its pin, or through resistor and comparator.
    bandgap_v: level of its comparator on the data wire; 0: it hears a sync line of its own.
    """

    image: Path
    mcu: str = "atmega328p"
    memory: bytes = b""
    clock_hz: float = 8e6
    supply_v: float = 3.3
    gain: float = 0.06
    start_ns: int = 0
    delay_ns: int = 0
    bandgap_v: float = 0.0

    @property
    def sensors(self) -> int:
        """Count its sensors."""
        return MCUS[self.mcu].sensors if self.mcu in MCUS else 1


@dataclass(frozen=True, slots=True)
class DataWire:
    """Describes how a digitizer's pull-down moves the data wire.

    pulled_v: what the digitizer samples while the wire is low, V. recovery_s: after that, time
    constant. back_s: from its release until it is above the nodes' comparators' level.
    """

    pulled_v: float
    recovery_s: float
    back_s: float


@dataclass(frozen=True, slots=True)
class Amplifier:
    """Sums the nodes: offset_v ± the sum of their levels + noise, clipped at the rails, in V.

    polarity: −1 if it inverts. noise_v: standard deviation, independent from sample to sample.
    load: without an amplifier, the conductance of the line itself; see skin.h. 0: with one.
    pull: sync pulses pull the data wire; None: they have a line of their own.
    """

    offset_v: float = 1.65
    polarity: int = 1
    low_v: float = 0.0
    high_v: float = 3.3
    noise_v: float = 0.0
    seed: int = 1
    load: float = 0.0
    pull: DataWire | None = None


class _Amplifier(ctypes.Structure):
    _fields_ = (
        ("offset_v", c_double),
        ("polarity", c_double),
        ("low_v", c_double),
        ("high_v", c_double),
        ("noise_v", c_double),
        ("load", c_double),
        ("on_data", c_bool),
        ("pulled_v", c_double),
        ("recovery_ns", c_double),
        ("back_ns", c_int64),
        ("seed", c_uint64),
    )


class _Plan(ctypes.Structure):
    _fields_ = (
        ("image", c_char_p),
        ("mcu", c_char_p),
        ("flash", c_char_p),
        ("flash_size", c_size_t),
        ("memory", c_char_p),
        ("memory_size", c_size_t),
        ("clock_hz", c_double),
        ("supply_v", c_double),
        ("gain", c_double),
        ("start_ns", c_int64),
        ("delay_ns", c_int64),
        ("bandgap_v", c_double),
    )


class NodeCounters(ctypes.Structure):
    """Counts what a node did since power-up; see struct node_counters."""

    cycles_awake: int
    cycles_asleep: int
    watchdog_resets: int
    deep_sleeps: int
    pull_ups: int
    faults: int
    _fields_ = (
        ("cycles_awake", c_uint64),
        ("cycles_asleep", c_uint64),
        ("watchdog_resets", c_uint32),
        ("deep_sleeps", c_uint32),
        ("pull_ups", c_uint32),
        ("faults", c_uint32),
    )


class EmulatedNodes:
    """Sensing nodes on one line, numbered from 0. A context manager; close() frees them.

    Sensors are numbered from 0, too, those of one node after those of the one before.
    """

    def __init__(
        self,
        nodes: Sequence[Node],
        amplifier: Amplifier | None = None,
        *,
        library: Path = LIBRARY,
    ) -> None:
        self._library = _load(library)
        line = amplifier or Amplifier()
        pull = line.pull or DataWire(0.0, 0.0, 0.0)
        self._skin: int | None = self._library.skin_create(
            byref(
                _Amplifier(
                    line.offset_v,
                    line.polarity,
                    line.low_v,
                    line.high_v,
                    line.noise_v,
                    line.load,
                    line.pull is not None,
                    pull.pulled_v,
                    pull.recovery_s * 1e9,
                    round(pull.back_s * 1e9),
                    line.seed,
                )
            ),
        )
        self.nodes = tuple(nodes)
        self.sensors = [(node, s) for node, n in enumerate(self.nodes) for s in range(n.sensors)]
        try:
            for node in self.nodes:
                self._add(node)
        except EmulationError:
            self.close()
            raise

    def _add(self, node: Node) -> None:
        flash = _flash(node.image)
        plan = _Plan(
            str(node.image).encode(),
            node.mcu.encode(),
            flash,
            len(flash),
            node.memory,
            len(node.memory),
            node.clock_hz,
            node.supply_v,
            node.gain,
            node.start_ns,
            node.delay_ns,
            node.bandgap_v,
        )
        error = ctypes.create_string_buffer(1024)
        if self._library.skin_add(self._skin, byref(plan), error, len(error)) < 0:
            raise EmulationError(error.value.decode())

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Free the nodes. May be called twice."""
        if self._skin is not None:
            self._library.skin_free(self._skin)
            self._skin = None

    def press(self, volts: ArrayLike) -> None:
        """Set the voltage at every sensor: (n,) or one for all, V."""
        every = np.broadcast_to(volts, len(self.sensors))
        for (node, sensor), value in zip(self.sensors, every, strict=True):
            self._library.node_sense(self._node(node), sensor, value)

    def sync(self, t_ns: int, level: bool) -> None:
        """Announce an edge of the sync line. Edges are in order, none is in the past."""
        if not self._library.skin_sync(self._skin, t_ns, level):
            raise EmulationError(
                f"an edge of the sync line at {t_ns} ns is before the last one or in the past"
            )

    def stick(self, t_ns: int) -> None:
        """Have the data wire stuck low from a time on, in which no pulse is."""
        self._library.skin_stick(self._skin, t_ns)

    @property
    def lowest_v(self) -> float:
        """Return the data wire's lowest voltage beside pulses; inf where an amplifier holds it."""
        return float(self._library.skin_lowest(self._skin))

    def run(self, t_ns: int) -> None:
        """Run all nodes to a time."""
        self._library.skin_run(self._skin, t_ns)

    def volts(self, t_ns: float, step_ns: float, size: int) -> NDArray[np.float64]:
        """Return the line at t_ns, t_ns + step_ns, …, before the time run to: (size,), V."""
        volts = np.empty(size)
        self._library.skin_volts(
            self._skin, t_ns, step_ns, volts.ctypes.data_as(POINTER(c_double)), size
        )
        return volts

    def edges(self, sensor: int) -> NDArray[np.void]:
        """Return changes of a sensor's output pin: (m,) of EDGE. It was released before."""
        edges, before = c_void_p(), c_int8()
        if not 0 <= sensor < len(self.sensors):
            raise IndexError(f"sensor {sensor}: there are {len(self.sensors)}, counted from 0")
        node, line = self.sensors[sensor]
        size = self._library.node_edges(self._node(node), line, byref(edges), byref(before))
        return np.frombuffer(ctypes.string_at(edges, size * EDGE.itemsize) if size else b"", EDGE)

    def forget(self, t_ns: int) -> None:
        """Forget edges before a time; `volts` cannot go back beyond it."""
        self._library.skin_forget(self._skin, t_ns)

    def led(self, node: int) -> bool:
        """Tell whether a node's status LED is lit."""
        return bool(self._library.node_led(self._node(node)))

    def memory(self, node: int) -> bytes:
        """Return the first KiB of a node's EEPROM, or all of it."""
        content = ctypes.create_string_buffer(1024)
        size = self._library.node_memory(self._node(node), content, len(content))
        return content.raw[:size]

    def counters(self, node: int) -> NodeCounters:
        """Tell what a node did since power-up."""
        counters = NodeCounters()
        self._library.node_count(self._node(node), byref(counters))
        return counters

    def _node(self, node: int) -> int:
        if not 0 <= node < len(self.nodes):
            raise IndexError(f"node {node}: there are {len(self.nodes)}, counted from 0")
        pointer: int = self._library.skin_node(self._skin, node)
        return pointer


class EmulatedSkin(EmulatedNodes):
    """Emulates nodes and the digitizer that drives their sync line and samples their line.

    clock_error: relative error of the digitizer's oscillator; 0.01 is 1 % fast. link_rate: bytes/s
    to the host; 0: unlimited. history_s: how far back edges and the line are kept.
    """

    def __init__(
        self,
        nodes: Sequence[Node],
        amplifier: Amplifier | None = None,
        *,
        clock_error: float = 0.0,
        link_rate: float = 0.0,
        history_s: float = 1.0,
        library: Path = LIBRARY,
    ) -> None:
        self._board: int | None = None
        super().__init__(nodes, amplifier, library=library)
        self._board = self._library.board_create(
            self._skin, (amplifier or Amplifier()).offset_v, clock_error, link_rate
        )
        self._history_ns = round(history_s * 1e9)
        self._buffer = ctypes.create_string_buffer(65_536)
        self.now_ns = 0

    def close(self) -> None:
        """Free the digitizer and the nodes. May be called twice."""
        if self._board is not None:
            self._library.board_free(self._board)
            self._board = None
        super().close()

    def run(self, t_ns: int) -> None:
        """Run digitizer and nodes to a time."""
        while self.now_ns < t_ns:
            self.now_ns = min(t_ns, self.now_ns + max(self._history_ns, _MIN_RUN_NS))
            self._library.board_run(self._board, self.now_ns)
            self.forget(self.now_ns - self._history_ns)

    def write(self, data: bytes) -> None:
        """Pass bytes from the host to the digitizer."""
        self._library.board_write(self._board, data, len(data))

    def read(self) -> bytes:
        """Tell what the host has received since the last call."""
        parts = []
        while size := self._library.board_read(self._board, self._buffer, len(self._buffer)):
            parts.append(self._buffer.raw[:size])
        return b"".join(parts)


def _flash(image: Path) -> bytes:
    """Read a node's flash from Intel hex; nothing of an ELF file, which the library reads."""
    try:
        head = image.read_bytes()
    except OSError as error:
        raise EmulationError(
            f"{image}: {error.strerror}; `make -C firmware node` builds the nodes' images"
        ) from error
    if head[:1] == b":":
        return from_hex(head.decode("ascii"))
    if head[:4] != b"\x7fELF" or int.from_bytes(head[18:20], "little") != _AVR:
        raise EmulationError(f"{image}: this is no ELF image for an AVR")
    return b""


def _load(path: Path) -> ctypes.CDLL:
    try:
        library = ctypes.CDLL(str(path))
    except OSError as error:
        raise EmulationError(
            f"{error}; `make -C firmware sim` builds it, from libsimavr-dev and libelf-dev"
        ) from error
    for name, result, arguments in _FUNCTIONS:
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library


_FUNCTIONS: tuple[tuple[str, type | None, tuple[type, ...]], ...] = (
    ("skin_create", c_void_p, (POINTER(_Amplifier),)),
    ("skin_free", None, (c_void_p,)),
    ("skin_add", c_int, (c_void_p, POINTER(_Plan), c_char_p, c_size_t)),
    ("skin_sync", c_bool, (c_void_p, c_int64, c_bool)),
    ("skin_stick", None, (c_void_p, c_int64)),
    ("skin_lowest", c_double, (c_void_p,)),
    ("skin_run", None, (c_void_p, c_int64)),
    ("skin_forget", None, (c_void_p, c_int64)),
    ("skin_volts", None, (c_void_p, c_double, c_double, POINTER(c_double), c_size_t)),
    ("skin_node", c_void_p, (c_void_p, c_int)),
    ("node_sense", None, (c_void_p, c_int, c_double)),
    ("node_edges", c_size_t, (c_void_p, c_int, POINTER(c_void_p), POINTER(c_int8))),
    ("board_create", c_void_p, (c_void_p, c_double, c_double, c_double)),
    ("board_free", None, (c_void_p,)),
    ("board_run", None, (c_void_p, c_int64)),
    ("board_write", None, (c_void_p, c_char_p, c_size_t)),
    ("board_read", c_size_t, (c_void_p, c_char_p, c_size_t)),
    ("node_led", c_bool, (c_void_p,)),
    ("node_memory", c_size_t, (c_void_p, c_char_p, c_size_t)),
    ("node_count", None, (c_void_p, POINTER(NodeCounters))),
)
