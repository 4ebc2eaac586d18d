# SPDX-License-Identifier: Apache-2.0

"""Foreign devices on the port, and ports that do not open or take no bytes."""

from __future__ import annotations

import fcntl
import math
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.session import Session
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.wire._protocol import VERSION, PacketType
from tactile_cdma.wire.messages import WIRE
from tactile_cdma.wire.packets import wrap

from ..outcome import Plan
from .interruptions import GONE, Fault
from .plug import Tty
from .trial import Rng, Trial, Turns, rng_of, some_skin

PACE_S = 10e-3
"""Interval of a device's output, s."""
CHUNK = 500
"""Bytes of each output: 50 kB/s."""
SAMPLE = 10_000
"""Bytes generated for a device, which repeats them."""
TEXT = "text received"
NOISE = "no valid packet"
UNKNOWN = "no description"
NO_MORE = ("no packets any more", "fallen silent", "sends no frames", "version")
"""Problems where something else comes from a port that was steady."""

_LOG = (
    b"\x00\xf8\x9e\x1c\x00rst:0x1 (POWERON_RESET),boot:0x13 (SPI_FAST_FLASH_BOOT)\r\n"
    b"configsip: 0, SPIWP:0xee\r\nmode:DIO, clock div:2\r\nload:0x3fff0030,len:1344\r\n"
    b"entry 0x400805f0\r\nI (29) boot: compile time 10:21:04\r\nE (312) main: no sensor\r\n"
)
_NMEA = b"GPGGA,%02d3519.00,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,"


class Stranger:
    """Sends the same bytes again and again; echoes: sends received bytes back as well."""

    def __init__(self, content: bytes, echoes: bool = False) -> None:
        self._content, self._echoes = content, echoes
        self._at, self._due_s = 0, time.monotonic()
        self._output = b""

    def receive(self, data: bytes) -> None:
        """Take bytes of the host."""
        if self._echoes:
            self._output += data

    def advance(self, wanted: int) -> float:
        """Send what is due; drop what nobody reads."""
        now_s = time.monotonic()
        if not self._content:
            return math.inf
        if now_s >= self._due_s:
            self._due_s = now_s + PACE_S
            self._output = (self._output + self._content[self._at : self._at + CHUNK])[-4 * CHUNK :]
            self._at = (self._at + CHUNK) % len(self._content)
        return self._due_s - now_s

    def take(self, size: int) -> bytes:
        """Give away at most `size` bytes for the host."""
        data, self._output = self._output[:size], self._output[size:]
        return data


def misread(data: bytes, ratio: float) -> bytes:
    """What a UART receives of bytes sent back to back at another rate: 8 bits, no parity.

    ratio: its rate over the sender's. It starts at a falling edge and samples the middle of its own
    bits; a wrong stop bit is ignored, as on a Linux tty.
    """
    bits = np.unpackbits(np.frombuffer(data, np.uint8), bitorder="little").reshape(-1, 8)
    framed = np.pad(bits, ((0, 0), (1, 1)))
    framed[:, -1] = 1
    line = np.concatenate((framed.ravel(), np.ones(1 + math.ceil(10 / ratio), np.uint8)))
    edges = np.flatnonzero((line[1:] == 0) & (line[:-1] == 1)) + 1
    edges = np.concatenate(([0], edges)) if data else edges
    middles = (np.arange(1, 9) + 0.5) / ratio
    received, free = bytearray(), 0.0
    while (at := int(np.searchsorted(edges, free))) < len(edges):
        samples = line[(edges[at] + middles).astype(int)]
        received.append(int(np.packbits(samples, bitorder="little")[0]))
        free = edges[at] + 9.5 / ratio
    return bytes(received)


def digitizer_bytes(seed: int, size: int) -> bytes:
    """Output of a streaming digitizer."""
    digitizer = VirtualDigitizer(SimOptions(seed=seed, scene="all", speed=0))
    digitizer.receive(Session(SkinConfig.of({})).open())
    digitizer.advance(size)
    return digitizer.take(size)


def _nmea(rng: Rng) -> bytes:
    lines = []
    for second in range(60):
        body = _NMEA % second
        checksum = int(np.bitwise_xor.reduce(np.frombuffer(body, np.uint8)))
        lines.append(b"$%s*%02X\r\n" % (body, checksum))
    return b"".join(lines)


def _modbus(rng: Rng) -> bytes:
    """Answers of a Modbus slave: address, function 3, values, CRC-16."""
    frames = []
    for _ in range(500):
        body = bytes([1, 3, 8]) + rng.integers(0, 300, 4).astype(">u2").tobytes()
        frames.append(body + _crc16(body).to_bytes(2, "little"))
    return b"".join(frames)


def _crc16(body: bytes) -> int:
    crc = 0xFFFF
    for byte in body:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0xA001 if crc & 1 else 0)
    return crc


def _other_version(rng: Rng) -> bytes:
    """INFO of a later protocol version, twice as long, and unknown packets."""
    packets = []
    for sequence in range(0, 200, 2):
        header = WIRE["Header"].pack(PacketType.INFO, sequence)
        packets.append(wrap(header + bytes([VERSION + 1]) + rng.bytes(130)))
        packets.append(wrap(WIRE["Header"].pack(0x20, sequence + 1) + rng.bytes(300)))
    return b"".join(packets)


def _at_rate(ratio: float) -> Callable[[Rng], Stranger]:
    def make(rng: Rng) -> Stranger:
        sent = digitizer_bytes(int(rng.integers(100)), SAMPLE)
        return Stranger(misread(sent, ratio))

    return make


STRANGERS: dict[str, tuple[Callable[[Rng], Stranger], tuple[str, ...]]] = {
    "nothing": (lambda rng: Stranger(b""), ("no bytes",)),
    "text": (lambda rng: Stranger(b"hello, this is a 3D printer\r\nok T:21.3\r\n" * 50), (TEXT,)),
    "a GPS receiver (NMEA)": (lambda rng: Stranger(_nmea(rng)), (TEXT,)),
    "a Modbus slave": (lambda rng: Stranger(_modbus(rng)), (NOISE,)),
    "a microcontroller's boot log": (lambda rng: Stranger(_LOG), (TEXT,)),
    "endless 0x00": (lambda rng: Stranger(bytes(SAMPLE)), (NOISE,)),
    "endless 0xFF": (lambda rng: Stranger(b"\xff" * SAMPLE), (NOISE,)),
    "random bytes": (lambda rng: Stranger(rng.bytes(SAMPLE)), (NOISE,)),
    "an echo": (lambda rng: Stranger(b"", echoes=True), (UNKNOWN,)),
    "another protocol version": (lambda rng: Stranger(_other_version(rng)), ("version",)),
    "half the baud rate": (_at_rate(2.0), (NOISE,)),
    "twice the baud rate": (_at_rate(0.5), (NOISE,)),
    # Bytes with two equal top bits are read right: a short packet may come through.
    "a baud rate 7 % off": (_at_rate(1.07), (NOISE, UNKNOWN, "sends no frames")),
    "a twelfth of the baud rate": (_at_rate(12.0), (NOISE,)),
}
"""Devices, and texts one of which must be in the driver's problem."""


def strange(plan: Plan, folder: Path) -> list[Trial]:
    """Trials of every stranger, before the digitizer and after it."""
    return [
        Trial(
            "wrong baud rate" if "baud" in name else "another device on the port",
            plan,
            Tty(folder / f"stranger{number}"),
            visits(name, rng_of(plan, 4, number), 1 if plan.quick else 10),
        )
        for number, name in enumerate(STRANGERS)
    ]


def visits(name: str, rng: Rng, times: int) -> Callable[[Trial], Turns]:
    """A stranger is plugged in and must be named; then the digitizer takes its place."""
    make, texts = STRANGERS[name]

    def faults(trial: Trial) -> Turns:
        for _ in range(times):
            trial.plug.plug(make(rng))
            trial.tally.times += 1
            yield from trial.told(*texts)
            if rng.integers(2):
                trial.plug.unplug()
                trial.plug.plug(trial.digitizer(some_skin(rng)))
            else:
                trial.plug.swap(trial.digitizer(some_skin(rng)))
            yield from trial.resumes()
            trial.plug.unplug()
            yield from trial.told(*GONE)
        yield from usurps(trial, make(rng), rng)
        trial.said = "named, and none of it published; then the digitizer"

    return faults


def usurps(trial: Trial, stranger: Stranger, rng: Rng) -> Turns:
    """A stranger speaks on a port that is open and steady; it must be told of, and can be left."""
    trial.plug.plug(trial.digitizer(some_skin(rng)))
    yield from trial.resumes()
    trial.plug.swap(stranger)
    trial.tally.times += 1
    yield from trial.told(*NO_MORE)


def unusable(plan: Plan, folder: Path) -> list[Trial]:
    """Trials of ports and digitizers that cannot be used for a while."""
    times = 1 if plan.quick else 10
    kinds: tuple[tuple[str, Fault, dict[str, object]], ...] = (
        ("port busy", busy, {}),
        ("port takes no bytes", unwritable, {}),
        ("another skin's digitizer", others, {"digitizer_id": _OURS.hex()}),
        ("digitizer set otherwise", otherwise, {}),
    )
    return [
        Trial(
            name,
            plan,
            Tty(folder / f"port{number}"),
            _several(fault, rng_of(plan, 5, number), times),
            parameters,
        )
        for number, (name, fault, parameters) in enumerate(kinds)
    ]


def forbidden(plan: Plan, folder: Path) -> list[Trial]:
    """Trials of ports without permission; to be run as an ordinary user."""
    faults = _several(without_permission, rng_of(plan, 6), 2 if plan.quick else 20)
    return [Trial("permission taken away", plan, Tty(folder / "port"), faults)]


def _several(fault: Fault, rng: Rng, times: int) -> Callable[[Trial], Turns]:
    def faults(trial: Trial) -> Turns:
        for _ in range(times):
            trial.tally.times += 1
            yield from fault(trial, rng)
            yield from trial.resumes()
            trial.plug.unplug()
            yield from trial.told(*GONE)
        trial.said = trial.took

    return faults


def busy(trial: Trial, rng: Rng) -> Turns:
    """Another program has the port."""
    assert isinstance(trial.plug, Tty)
    trial.plug.make()
    trial.plug.lock(fcntl.LOCK_EX)
    trial.plug.show(trial.digitizer(some_skin(rng)))
    yield from trial.told("busy: another program")
    yield from trial.after(rng.uniform(0, 0.5))
    trial.plug.lock(fcntl.LOCK_UN)


def without_permission(trial: Trial, rng: Rng) -> Turns:
    """The port may not be opened yet, as before udev has set its permissions."""
    assert isinstance(trial.plug, Tty)
    trial.plug.make()
    trial.plug.permit(0)
    trial.plug.show(trial.digitizer(some_skin(rng)))
    yield from trial.told("no permission")
    trial.plug.permit(0o600)


def unwritable(trial: Trial, rng: Rng) -> Turns:
    """The port opens, but nothing can be written."""
    assert isinstance(trial.plug, Tty)
    trial.plug.make()
    trial.plug.fill()
    trial.plug.stalled = True
    trial.plug.show(trial.digitizer(some_skin(rng)))
    yield from trial.told("takes no bytes")
    trial.plug.stalled = False


def others(trial: Trial, rng: Rng) -> Turns:
    """Another skin's digitizer, then the right one."""
    trial.plug.plug(trial.digitizer(SimOptions(scene="moving", seed=7)))
    yield from trial.resumes()
    other = trial.digitizer(SimOptions(scene="moving", seed=8 + int(rng.integers(100))))
    if rng.integers(2):
        trial.plug.unplug()
        trial.plug.plug(other)
    else:
        trial.plug.swap(other)
    yield from trial.told("wrong digitizer")
    trial.plug.swap(trial.digitizer(SimOptions(scene="moving", seed=7)))


_OURS = VirtualDigitizer(SimOptions(seed=7)).info().digitizer_id


def otherwise(trial: Trial, rng: Rng) -> Turns:
    """A digitizer that cannot be configured to the parameters, then one that can."""
    trial.plug.plug(trial.digitizer(SimOptions(scene="moving", seed=1, order=24)))
    yield from trial.told("order 24 (parameters: 20)")
    trial.plug.swap(trial.digitizer(some_skin(rng)))
