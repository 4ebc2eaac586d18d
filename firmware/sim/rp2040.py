# SPDX-License-Identifier: Apache-2.0

"""The digitizer's real image, run in an emulated RP2040 (rp2040js): the Python side of rp2040.mjs.

    with Rp2040(image, line) as board:
        board.plug_usb()
        board.write_uart(bytes)
        board.run(0.5)
        packets = parser.feed(board.read_uart())

Time is the chip's, in seconds since power-up unless stated otherwise. It advances only in `run`,
which calls `line` and `on_sync` in order of time, so a line may depend on every sync edge before
the instants that it is asked for.
"""

from __future__ import annotations

import json
import os
import shutil
import struct
import subprocess
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.wire._protocol import SIMULATED_ID

HERE = Path(__file__).resolve().parent
CPU_HZ = 96e6
"""clk_sys, as clocks.c sets it."""
PIN_SYNC, PIN_HEARD = 16, 17
PIN_LED = 25
MAX_COUNTS = 4096
"""Most counts of the line per request."""

Line = Callable[[NDArray[np.float64]], NDArray[np.uint16]]
"""The ADC's counts, (m,) uint16, at times (m,) float64, ns. No sync edge lies between the times."""
SyncEdge = Callable[[float, bool], None]
"""Called with an edge of the sync line: its time in ns, and whether it rises."""


class EmulatorError(RuntimeError):
    """The emulator is not installed, failed, or was used wrongly."""


@dataclass(frozen=True, slots=True)
class Network:
    """Is a line that the chip's own pins drive, biased to half the supply by two resistors.

    ohms: from GPIO0, 1, … to GPIO26; None: not there. noise_counts: of the converter, rms.
    told: `on_pin` is called with these pins' changes. pull_ohms: of a transistor that pulls the
    line low while the sync pin is high; None: there is none.
    """

    ohms: tuple[float | None, ...]
    bias_ohms: float = 2e3
    noise_counts: float = 1.0
    told: bool = False
    pull_ohms: float | None = None


@dataclass(frozen=True, slots=True)
class Bus:
    """Is a host that asks for packets without knowing of any; see rp2040_usb_host.mjs.

    retry_ns: after which it asks again where there was none. gap_ns: between packets. busy: share
    of every frame that other devices have.
    """

    retry_ns: float
    gap_ns: float
    busy: float


ROOT_PORT = Bus(retry_ns=0.0, gap_ns=2e3, busy=0.1)
"""Bus of a root port, which asks again at once. Chosen: a tenth is a mouse and a headset."""
HUB = Bus(retry_ns=125e3, gap_ns=10e3, busy=0.2)
"""Behind a hub of USB 2, whose host asks anew in the next microframe. The rest is chosen."""


@dataclass(frozen=True, slots=True)
class UsbDevice:
    """Holds the device's USB descriptors; `strings` by index, None if there is none."""

    device: bytes
    configuration: bytes
    strings: tuple[str | None, ...]


class Rp2040:
    """Emulates the chip with its flash, a line at its ADC and hosts at UART and USB.

    image: the flash's content, a .bin file.
    line: gives the ADC's counts, or the network by which the chip's pins do.
    on_sync: called with every edge of the sync line.
    on_pin: called with time in ns, pin and level (2: released) of the other pins that are told.
    flash_id: the flash's unique number, 8 bytes; by default it tells that this is no board.
    bus: of the USB host; None: it takes every packet at once.
    grounded: pins that are tied to ground.
    """

    def __init__(
        self,
        image: Path,
        line: Line | Network,
        on_sync: SyncEdge | None = None,
        flash_id: bytes = SIMULATED_ID + b"rp20",
        on_pin: Callable[[float, int, int], None] | None = None,
        bus: Bus | None = None,
        grounded: tuple[int, ...] = (),
    ) -> None:
        node = shutil.which("node")
        if node is None:
            raise EmulatorError("no node on this machine: Node.js 18 or newer runs the emulator")
        if not (HERE / "node_modules" / "rp2040js").is_dir():
            raise EmulatorError(f"rp2040js is not installed: `npm ci` in {HERE} does that")
        if not image.is_file():
            raise EmulatorError(f"no image {image}: `make rp2040` in firmware/ builds it")
        network = json.dumps(asdict(line) if isinstance(line, Network) else None)
        usb = json.dumps(asdict(bus) if bus is not None else None)
        command = [node, str(HERE / "rp2040.mjs"), str(image), flash_id.hex(), network, usb]
        self._line = line
        self._on_sync, self._on_pin = on_sync, on_pin
        self._uart = bytearray()
        self._usb = bytearray()
        self._answers: list[bytes | None] = []
        self._pending = bytearray()
        self._now_ns = 0.0
        self._until_ns = 0.0
        self.cycles = 0.0
        """Cycles that the CPU was awake since power-up."""
        self._is_sync_high = self.led = False
        self.late_packets = 0.0
        """Packets offered to USB in the last fifth of a frame, which RP2040-E15 forbids."""
        self.usb_asks = self.usb_naks = 0.0
        """How often a host on a Bus asked for a packet, and how often there was none."""
        self.is_drive = False
        """It has restarted as the boot ROM's USB drive, and runs no more."""
        self.usb_device: UsbDevice | None = None
        """Set when a host has configured the device, after about 30 ms."""
        self._process = subprocess.Popen(
            [*command, json.dumps(grounded)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
        )

    def __enter__(self) -> Rp2040:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the emulator, which may be amid a run that an error here has left."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.close()
        self._process.stdout.close()
        self._process.kill()
        self._process.wait()

    @property
    def now(self) -> float:
        """Time since power-up, s."""
        return self._now_ns / 1e9

    @property
    def load(self) -> float:
        """Return the share of the time since power-up that the CPU was awake."""
        return self.cycles / (self.now * CPU_HZ)

    def run(self, until: float) -> None:
        """Advance to a time, s."""
        self._until_ns = until * 1e9
        self._send(b"R", struct.pack("<d", self._until_ns))
        while self._handle(*self._receive()) != "D":
            pass

    def write_uart(self, data: bytes) -> None:
        """Send bytes to UART0 at its speed."""
        self._send(b"U", data)

    def read_uart(self) -> bytes:
        """Return the bytes sent by UART0 since the last call."""
        data = bytes(self._uart)
        self._uart.clear()
        return data

    def plug_usb(self, reading: bool = True) -> None:
        """Plug in a USB host. If not `reading`, it takes no data from the device."""
        self._send(b"H", bytes([2 if reading else 1]))

    def set_usb_baud(self, baud: int) -> None:
        """Have the USB host set the port's speed."""
        self._send(b"L", struct.pack("<I", baud))

    def set_usb_dtr(self, raised: bool) -> None:
        """Have a program on the USB host open the port, or close it."""
        self._send(b"K", bytes([raised]))

    def suspend_usb(self, asleep: bool) -> None:
        """Put the USB host to sleep, or wake it."""
        self._send(b"Z", bytes([asleep]))

    def clear_usb_halt(self, out: bool = False) -> None:
        """Have the USB host clear the halt of the endpoint that it reads, or writes."""
        self._send(b"C", bytes([out]))

    def usb_request(
        self,
        kind: int,
        request: int,
        value: int = 0,
        index: int = 0,
        length: int = 0,
        given_up: bool = False,
    ) -> bytes | None:
        """Make a control request; returns the device's bytes, None if it stalls.

        given_up: the host sends the request and nothing more, as if it had been unplugged amid it.
        """
        setup = struct.pack("<2B3H", kind, request, value, index, length)
        self._send(b"Q", bytes([given_up]) + setup)
        for _ in range(20):
            self.run(self.now + 1e-3)
            if self._answers:
                return self._answers.pop()
        raise EmulatorError(f"request {setup.hex()} was not answered within 20 ms")

    def unplug_usb(self) -> None:
        """Unplug the USB host."""
        self._send(b"H", bytes([0]))

    def write_usb(self, data: bytes) -> None:
        """Send bytes to the USB device."""
        self._send(b"S", data)

    def read_usb(self) -> bytes:
        """Return the bytes that the USB host has read since the last call."""
        data = bytes(self._usb)
        self._usb.clear()
        return data

    def stall(self, seconds: float) -> None:
        """Stall the CPU for a time, while everything else continues."""
        self._send(b"T", struct.pack("<d", seconds * 1e9))

    def hold_samples(self, seconds: float) -> None:
        """Keep samples in the ADC's FIFO from reaching memory for a time."""
        self._send(b"M", struct.pack("<d", seconds * 1e9))

    def drive(self, pin: int, edges: Iterable[tuple[float, bool]]) -> None:
        """Have something outside drive a pin: (s, level) of every change to come, in order."""
        times = (struct.pack("<dB", when * 1e9, level) for when, level in edges)
        self._send(b"E", bytes([pin]) + b"".join(times))

    def _handle(self, kind: str, payload: bytes) -> str:
        """Process a message; return its type."""
        if kind == "A":
            self._answer(*struct.unpack("<3d", payload))
        elif kind == "U":
            self._uart += payload[8:]
        elif kind == "S":
            self._usb += payload[8:]
        elif kind == "P":
            self._note_pin(*struct.unpack("<dBB", payload))
        elif kind == "D":
            told = struct.unpack("<dd?ddd", payload)
            self._now_ns, self.cycles, self.is_drive, self.late_packets = told[:4]
            self.usb_asks, self.usb_naks = told[4:]
        elif kind == "Q":
            self._answers.append(None if payload[0] else payload[1:])
        elif kind == "I":
            self.usb_device = _device(json.loads(payload))
        elif kind == "X":
            raise EmulatorError(payload.decode())
        else:
            raise EmulatorError(f"message {kind!r} of the emulator is not known")
        return kind

    def _note_pin(self, now_ns: float, pin: int, level: int) -> None:
        """Take in a change of a pin: 0 low, 1 high, 2 released."""
        if pin == PIN_LED:
            self.led = level == 1
        elif pin == PIN_SYNC:
            was_high, self._is_sync_high = self._is_sync_high, level == 1
            if self._on_sync is not None and was_high != self._is_sync_high:
                self._on_sync(now_ns, self._is_sync_high)
        elif self._on_pin is not None:
            self._on_pin(now_ns, pin, level)

    def _answer(self, now_ns: float, period_ns: float, stays_ns: float) -> None:
        """Send the line's counts at a conversion and at those before the sync line may change."""
        ahead = (min(stays_ns, self._until_ns) - now_ns) // period_ns
        times = now_ns + period_ns * np.arange(min(max(ahead, 1), MAX_COUNTS))
        assert callable(self._line), "a network answers in the emulator"
        counts = np.asarray(self._line(times))
        if counts.shape != times.shape:
            raise EmulatorError(f"a line of shape {counts.shape} for times of shape {times.shape}")
        self._send(b"A", counts.astype("<u2").tobytes())

    def _send(self, kind: bytes, payload: bytes) -> None:
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(kind + struct.pack("<I", len(payload)) + payload)
        except BrokenPipeError:
            while True:  # until it gives the reason
                self._handle(*self._receive())

    def _receive(self) -> tuple[str, bytes]:
        """Return the next message."""
        assert self._process.stdout is not None
        while True:
            if len(self._pending) >= 5:
                kind, size = struct.unpack_from("<cI", self._pending)
                if len(self._pending) >= 5 + size:
                    payload = bytes(self._pending[5 : 5 + size])
                    del self._pending[: 5 + size]
                    return kind.decode(), payload
            data = os.read(self._process.stdout.fileno(), 1 << 16)
            if not data:
                raise EmulatorError(f"the emulator has ended ({self._process.wait()})")
            self._pending += data


def _device(told: dict[str, list[int] | list[list[int] | None]]) -> UsbDevice:
    """Return the device's descriptors from the emulator's JSON."""
    strings = tuple(
        None if string is None else bytes(string)[2:].decode("utf-16-le")
        for string in told["strings"]
    )
    return UsbDevice(bytes(told["device"]), bytes(told["configuration"]), strings)  # type: ignore[arg-type]
