# SPDX-License-Identifier: Apache-2.0

"""Compares the digitizer's core in C with the simulated one in Python, on the same input."""

from __future__ import annotations

import struct
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.wire._protocol import PacketType, Result
from tactile_cdma.wire.messages import Ack, Configure, FrameLayout, Packet, Samples, Start, Status
from tactile_cdma.wire.packets import PacketParser, PacketWriter, wrap

from ..outcome import Outcome, Plan

T = TypeVar("T", bound=Packet)
BEGIN = struct.pack("<QII", 0, 1 << 22, 8192) + struct.pack(
    "<8sIIIfhhh", b"torture", 48, 96, 65_536, 2**-10, 2048, 0, 4095
)
"""struct start of firmware/digitizer/replay: a board like an RP2040's, with a generous output."""
SECOND = ("t", struct.pack("<Q", 1_000_000))
SEND = ("o", struct.pack("<I", 2**32 - 1))
REPLAY_S = 60
TYPES = [0, 2, 0x7F, *range(0x80, PacketType.TOUCH), 0x8F, 0xFF]
"""Types of commands and others; which of TOUCH and BOOTSEL a board knows is its own affair."""
CONFIGURED = Configure(FrameLayout.of(FrameSpec(), 4))
PACKETS, SAMPLES = 200, 20_000
"""Input of one digitizer."""
PERHAPS = {Result.OK, Result.UNSUPPORTED}
"""Both are right answers to a valid request: what a digitizer supports is its own affair."""


def same_answers(replay: Path, plan: Plan) -> Outcome:
    """Packets of any type, length and content, and broken ones: answers and counts must agree."""
    rng = np.random.default_rng(plan.seed)
    batches, wrong, uncounted = (10 if plan.quick else 500), 0, 0
    for _ in range(batches):
        # STOP comes with the rest, so that the simulator makes no frames of a strange skin
        data = b"".join(hostile_packet(rng) for _ in range(PACKETS)) + b"\0" + wrap(b"\x83\0\0")
        differ = compare(replayed(replay, [("r", data), SECOND, SEND]), simulated(data))
        wrong += differ[0]
        uncounted += differ[1]
    return Outcome(
        "packets, to the digitizers in C and Python", batches * PACKETS, wrong, uncounted
    )


def hostile_packet(rng: np.random.Generator) -> bytes:
    """A packet that is mostly intact, and mostly wrong."""
    kind, sequence = int(rng.choice(TYPES)), int(rng.integers(2**16))
    payload = b"" if rng.random() < 0.5 else rng.bytes(int(rng.integers(60)))
    if kind == PacketType.CONFIGURE and rng.random() < 0.9:
        content = bytearray(CONFIGURED.pack())
        for place in rng.integers(len(content), size=rng.integers(4)):
            content[place] = rng.integers(256)
        payload = bytes(content)
    wire = bytearray(wrap(struct.pack("<BH", kind, sequence) + payload))
    if rng.random() < 0.2:
        wire[int(rng.integers(len(wire)))] ^= 1 << int(rng.integers(8))
    return bytes(wire)


def compare(in_c: Sequence[Packet], in_python: Sequence[Packet]) -> tuple[int, int]:
    """Number of answers in which two digitizers differ, and whether their error counts do."""
    answers = [of_kind(said, Ack) for said in (in_c, in_python)]
    differ = abs(len(answers[0]) - len(answers[1]))
    differ += sum(not same(one, other) for one, other in zip(*answers, strict=False))
    errors = [of_kind(said, Status)[-1].command_errors for said in (in_c, in_python)]
    return differ, int(errors[0] != errors[1])


def same(one: Ack, other: Ack) -> bool:
    """Whether two digitizers may give these answers to the same command."""
    if {one.result, other.result} <= PERHAPS:
        other = replace(other, result=one.result)
    return replace(one, sequence=0) == replace(other, sequence=0)


def simulated(data: bytes) -> list[Packet]:
    """Output of the Python digitizer for these bytes and one second more."""
    now_s = 0.0
    digitizer = VirtualDigitizer(clock=lambda: now_s)
    digitizer.receive(data)
    now_s = 1.0
    digitizer.advance(0)
    return parse(digitizer.take(digitizer.pending))


def same_samples(replay: Path, plan: Plan) -> Outcome:
    """Samples in pieces of any size, some lost: Python must read what C was given."""
    rng = np.random.default_rng(plan.seed)
    batches, wrong, uncounted, packets = (5 if plan.quick else 200), 0, 0, 0
    for _ in range(batches):
        line = rng.integers(0, 4096, SAMPLES).astype("<u2")
        lost = np.zeros(SAMPLES, bool)
        events = [("r", PacketWriter().encode(CONFIGURED) + PacketWriter(1).encode(Start()))]
        for piece in np.split(np.arange(SAMPLES), np.sort(rng.integers(0, SAMPLES, 60))):
            lost[piece] = rng.random() < 0.1
            if lost[piece].any():
                events.append(("l", struct.pack("<I", piece.size)))
            else:
                events.append(("s", line[piece].tobytes()))
        said = replayed(replay, [*events, SECOND, SEND])
        wrong += sum(not right(packet, line, lost) for packet in of_kind(said, Samples))
        uncounted += not counted(said, lost)
        packets += len(of_kind(said, Samples))
    return Outcome("samples, packed in C and read in Python", packets, wrong, uncounted)


def right(packet: Samples, line: NDArray[np.uint16], lost: NDArray[np.bool_]) -> bool:
    """Whether a packet has the samples of the line."""
    place = slice(packet.first_index, packet.first_index + packet.counts.size)
    return np.array_equal(packet.counts, line[place]) and not lost[place].any()


def counted(said: Sequence[Packet], lost: NDArray[np.bool_]) -> bool:
    """Whether exactly the lost samples are missing, and STATUS counts them."""
    told = np.zeros(lost.size, bool)
    for packet in of_kind(said, Samples):
        told[packet.first_index : packet.first_index + packet.counts.size] = True
    begun = np.flatnonzero(told)[-1] + 1  # later ones may wait for a full packet
    status = of_kind(said, Status)[-1]
    return bool((told != lost)[:begun].all()) and status.samples_lost == lost.sum()


def replayed(replay: Path, events: Sequence[tuple[str, bytes]]) -> list[Packet]:
    """Output of the C core for events of firmware/digitizer/replay."""
    script = b"".join(kind.encode() + struct.pack("<I", len(data)) + data for kind, data in events)
    with TemporaryDirectory() as folder:
        files = [Path(folder, "events"), Path(folder, "output")]
        files[0].write_bytes(BEGIN + script)
        command = [str(part) for part in (replay, *files)]
        subprocess.run(command, check=True, capture_output=True, timeout=REPLAY_S)
        return parse(files[1].read_bytes())


def parse(data: bytes) -> list[Packet]:
    """All packets of a digitizer. Raises RuntimeError if there are other bytes."""
    parser = PacketParser()
    packets = [packet for packet in parser.feed(data) if isinstance(packet, Packet)]
    seen = parser.counters
    if seen.crc_errors + seen.framing_errors + seen.malformed + seen.unknown + seen.lost_packets:
        raise RuntimeError(f"a digitizer's bytes are no packets: {seen}")
    return packets


def of_kind(packets: Sequence[Packet], kind: type[T]) -> list[T]:
    """Select the packets of a type."""
    return [packet for packet in packets if isinstance(packet, kind)]
