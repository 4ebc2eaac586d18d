# SPDX-License-Identifier: Apache-2.0

"""The digitizer's C core as Python objects, with board, clock and line supplied by the test."""

from __future__ import annotations

import ctypes
import struct
import weakref
from collections.abc import Iterable
from ctypes import POINTER, byref, c_bool, c_size_t, c_uint8, c_uint16, c_uint32, c_uint64
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.wire._protocol import SYNC_LEAD, SYNC_UNIT_US
from tactile_cdma.wire.messages import Ack, Command, Configure, Packet, Start, Status
from tactile_cdma.wire.packets import PacketParser, PacketWriter


class Board(ctypes.Structure):
    """struct dg_board: of the tests' digitizer, a 12-bit converter clocked at 48 MHz."""

    _fields_ = [
        ("id", c_uint8 * 8),
        ("ticks_per_us", c_uint32),
        ("min_ticks", c_uint32),
        ("max_ticks", c_uint32),
        ("volts_per_count", ctypes.c_float),
        ("zero_count", ctypes.c_int16),
        ("min_count", ctypes.c_int16),
        ("max_count", ctypes.c_int16),
        ("command", ctypes.c_void_p),
        ("layout", ctypes.c_void_p),
        ("wireless", c_bool),
        ("hears", c_bool),
    ]

    @classmethod
    def of(cls, **changes: Any) -> Board:
        values: dict[str, Any] = {
            "id": (c_uint8 * 8)(*b"core\0\1\2\3"),
            "ticks_per_us": 48,
            "min_ticks": 96,
            "max_ticks": 65_536,
            "volts_per_count": 2**-10,  # the same in 32 bits as in 64
            "zero_count": 2048,
            "min_count": 0,
            "max_count": 4095,
        }
        return cls(**{**values, **changes})


class _Pulse(ctypes.Structure):
    _fields_ = [("tick", c_uint64), ("units", c_uint8)]


@dataclass(frozen=True)
class Pulse:
    """A pulse on the sync line: its rising edge in ticks of the stream, its length in units."""

    tick: int
    units: int

    @property
    def announces(self) -> int:
        """Tick of the frame or restart that it announces, at 48 ticks per µs."""
        return int(self.tick + 48 * SYNC_UNIT_US * SYNC_LEAD)


class CoreDigitizer:
    """The C core with its surroundings; the host's parser parses its output."""

    def __init__(
        self,
        core: ctypes.CDLL,
        board: Board | None = None,
        capacity: int = 8192,
        output: int | None = None,
        now_us: int = 0,
    ) -> None:
        """capacity: of its sample buffer. output: size of its ring, else generous."""
        declare(core)
        self._core, self.now_us = core, now_us
        self.board = board or Board.of()
        self.capacity = capacity
        self.output_size = core.shim_output_min(capacity) * 8 if output is None else output
        self._shim = core.shim_new(byref(self.board), self.output_size, capacity, now_us)
        weakref.finalize(self, core.shim_free, self._shim)
        self.parser, self.writer = PacketParser(), PacketWriter()
        self.events: list[tuple[str, bytes]] = []
        """All calls so far, as events of digitizer/replay."""
        self.given = b""
        """Their results: pulses and bytes sent, in the order of the calls."""

    @property
    def running(self) -> bool:
        return bool(self._core.shim_running(self._shim))

    @property
    def ticks_per_sample(self) -> int:
        return int(self._core.shim_ticks_per_sample(self._shim))

    def set_sequence(self, sequence: int) -> None:
        self._core.shim_set_sequence(self._shim, sequence)

    def receive(self, data: bytes) -> None:
        """Deliver bytes from the host; restart the stream if they ask for it."""
        self.events.append(("r", data))
        self._core.dg_receive(self._shim, data, len(data), self.now_us)
        if self._core.dg_restarted(self._shim) and self.running:
            self._core.dg_begin(self._shim, self.now_us)

    def send(self, *commands: Command) -> None:
        """Deliver commands from the host, back to back."""
        self.receive(b"".join(self.writer.encode(command) for command in commands))

    def samples(self, counts: NDArray[Any]) -> None:
        data = np.ascontiguousarray(counts, dtype=np.uint16)
        self.events.append(("s", data.tobytes()))
        self._core.dg_samples(self._shim, data.ctypes.data_as(POINTER(c_uint16)), data.size)

    def heard(self, us: int) -> None:
        """Tell of another digitizer's frame, which begins then."""
        self._core.dg_heard(self._shim, us & 0xFFFFFFFF)

    @property
    def strayed(self) -> bool:
        return bool(self._core.dg_strayed(self._shim))

    def lost(self, size: int) -> None:
        self.events.append(("l", struct.pack("<I", size)))
        self._core.dg_lost(self._shim, size)

    def end(self) -> None:
        self._core.dg_end(self._shim)

    def time(self, now_us: int) -> None:
        self.now_us = now_us
        self.events.append(("t", struct.pack("<Q", now_us)))
        self._core.dg_time(self._shim, now_us)

    def pulses(self, count: int) -> list[Pulse]:
        """The next pulses, at most as many as asked for."""
        self.events.append(("p", struct.pack("<I", count)))
        pulses: list[Pulse] = []
        pulse = _Pulse()
        while len(pulses) < count and self._core.dg_pulse(self._shim, byref(pulse)):
            pulses.append(Pulse(pulse.tick, pulse.units))
            self.given += struct.pack("<QB", pulse.tick, pulse.units)
        return pulses

    def take(self, most: int = 1 << 30) -> bytes:
        """Take bytes of the output, in as many pieces as the ring gives."""
        self.events.append(("o", struct.pack("<I", most)))
        taken = b""
        start = POINTER(c_uint8)()
        while most > 0 and (size := self._core.dg_output(self._shim, byref(start))):
            size = min(size, most)
            taken += ctypes.string_at(start, size)
            self._core.dg_sent(self._shim, size)
            most -= size
        self.given += taken
        return taken

    def packets(self, *kinds: type[Packet]) -> list[Any]:
        """Packets sent since the last call, which must be intact; those of some kinds, or all."""
        received = self.parser.feed(self.take())
        seen = self.parser.counters
        assert not seen.crc_errors + seen.framing_errors + seen.malformed + seen.unknown
        return of_kind(received, *kinds or (Packet,))

    def results(self, *commands: Command) -> list[int]:
        """Results of these commands, as acknowledged."""
        self.send(*commands)
        return [ack.result for ack in self.packets(Ack)]

    def status(self, now_us: int = 1_000_000) -> Status:
        """The report at this time; drops all packets before it."""
        self.time(now_us)
        status: Status = self.packets(Status)[-1]
        return status


def streaming(
    core: ctypes.CDLL, asked: Configure, *commands: Command, output: int = 1 << 22, **given: Any
) -> CoreDigitizer:
    """A digitizer that was asked for this, and streams; by default nothing is dropped.

    commands: what it is told between the two. given: options of CoreDigitizer.
    """
    digitizer = CoreDigitizer(core, output=output, **given)
    assert not any(digitizer.results(asked, *commands, Start()))
    return digitizer


def of_kind(packets: Iterable[object], *kinds: type[Packet]) -> list[Any]:
    """Those of some kinds."""
    return [packet for packet in packets if isinstance(packet, kinds)]


def declare(core: ctypes.CDLL) -> None:
    """Types of the functions that the tests call."""
    pointer, size, u64 = ctypes.c_void_p, c_size_t, c_uint64
    signatures: dict[str, tuple[Any, ...]] = {
        "shim_crc32": (c_uint32, c_uint32, ctypes.c_char_p, size),
        "shim_cobs": (size, ctypes.c_char_p, size, size, pointer, size, size),
        "shim_cobs_decode": (ctypes.c_long, ctypes.c_char_p, size, pointer),
        "shim_reader_new": (pointer,),
        "shim_reader_free": (None, pointer),
        "shim_read": (size, pointer, ctypes.c_char_p, size, POINTER(c_bool)),
        "shim_packet": (size, pointer, POINTER(c_uint8), POINTER(c_uint16), pointer),
        "shim_reader_errors": (c_uint32, pointer),
        "shim_write": (size, c_uint8, c_uint16, ctypes.c_char_p, size, size, size, pointer, size),
        "shim_new": (pointer, POINTER(Board), size, size, u64),
        "shim_free": (None, pointer),
        "shim_output_min": (size, size),
        "shim_running": (c_bool, pointer),
        "shim_ticks_per_sample": (c_uint32, pointer),
        "shim_set_sequence": (None, pointer, c_uint16),
        "dg_receive": (None, pointer, ctypes.c_char_p, size, u64),
        "dg_restarted": (c_bool, pointer),
        "dg_begin": (None, pointer, u64),
        "dg_end": (None, pointer),
        "dg_samples": (None, pointer, POINTER(c_uint16), size),
        "dg_lost": (None, pointer, c_uint32),
        "dg_pulse": (c_bool, pointer, POINTER(_Pulse)),
        "dg_heard": (None, pointer, c_uint32),
        "dg_strayed": (c_bool, pointer),
        "dg_time": (None, pointer, u64),
        "dg_output": (size, pointer, POINTER(POINTER(c_uint8))),
        "dg_sent": (None, pointer, size),
    }
    for name, (result, *arguments) in signatures.items():
        function = getattr(core, name)
        function.restype, function.argtypes = result, arguments
