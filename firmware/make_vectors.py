# SPDX-License-Identifier: Apache-2.0

"""Test vectors shared by C and Python, made with the Python implementation.

They pin the wire format: a change shows in their diff. They do not prove it right; the tests derive
some of them by other means.
"""

from __future__ import annotations

import dataclasses
import json
import textwrap
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from tactile_cdma.code.codes import code_book, row_signs
from tactile_cdma.code.frame import UNIPOLAR, FrameSpec
from tactile_cdma.code.sparse import code_digits, code_numbers, code_places
from tactile_cdma.config.parameters import read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.hardware.node_memory import node_memory
from tactile_cdma.wire._protocol import PacketType, Result, Scene, SyncMode, SyncWire
from tactile_cdma.wire.messages import (
    Ack,
    Ask,
    Bootsel,
    Configure,
    FrameLayout,
    GetInfo,
    Groups,
    Info,
    Message,
    Pack,
    Packed,
    Packet,
    Quiet,
    Samples,
    Start,
    Status,
    Stop,
    Touch,
)
from tactile_cdma.wire.packets import PacketWriter, cobs_decode, cobs_encode

DEMO_PARAMS = Path(__file__).resolve().parents[1] / "config" / "demo_skin.yaml"
PAPER = FrameLayout.of(
    FrameSpec(order=16, first_row=0, sign_seed=None, polarity=-1), samples_per_chip=8
)
LARGE = FrameLayout.of(
    FrameSpec(nodes=1024, chip_s=780e-9, frame_period_s=10e-3, sign_seed=2**32 - 1, drive=UNIPOLAR),
    samples_per_chip=1,
)
EXAMPLE = Samples(1_000_000, 4096, np.array([0, 1, -1, 300], dtype=np.int16), sync=True)

MOST = 2**32 - 1
PACKETS: dict[str, tuple[int, Packet]] = {
    "info of the paper's skin": (
        0,
        Info(
            firmware_minor=1,
            digitizer_id=bytes(range(8)),
            sample_rate_uhz=160_000_000_000,
            volts_per_count=3.3 / 4096,
            zero_count=2048,
            min_count=0,
            max_count=4095,
            sync_mode=SyncMode.HEAR,
            frame=PAPER,
        ),
    ),
    "info of a large skin": (
        65_535,
        Info(
            firmware_major=255,
            firmware_minor=254,
            digitizer_id=b"\xff" * 8,
            sample_rate_uhz=round(1e6 / 780e-9),
            volts_per_count=1e-3,
            sync_mode=SyncMode.DRIVE,
            integrated=True,
            quiet_uv=2**32 - 1,
            frame=LARGE,
        ),
    ),
    "samples, the example of docs/protocol.md": (7, EXAMPLE),
    "samples, one, after an overrun": (
        256,
        Samples(2**64 - 1, 2**64 - 1, np.array([-32_768], dtype=np.int16), overrun=True),
    ),
    "samples, many, blocks longer than 254 bytes": (
        257,
        Samples(1, 2, np.arange(512, dtype=np.int16) * 97 + 1000, sync=True, overrun=True),
    ),
    "quiet frame": (
        261,
        Quiet.of(2**40, 2**33, np.array([-3, 0, 2, 2], dtype=np.int16), sync=True),
    ),
    "quiet, extremes": (262, Quiet(0, 0, MOST, -MOST << 15, MOST << 30, overrun=True)),
    "samples, all zero on the wire": (258, Samples(0, 0, np.full(40, 0x5555, dtype=np.int16))),
    "packed samples, an odd number": (
        263,
        Packed(5, 6, np.array([0, 4095, 2048], dtype=np.int16), sync=True),
    ),
    "packed samples, whole counts of eighths": (
        264,
        Packed(7, 8, np.arange(0, 4000, 8, dtype=np.int16) - 1000, base=-1000, step=8),
    ),
    "status": (259, Status(2**40 + 3, 1, 2, 3, 4, 5, streaming=True)),
    "ack": (260, Ack(PacketType.CONFIGURE, 513, Result.UNSUPPORTED)),
    "get info": (0, GetInfo()),
    "start": (1, Start()),
    "stop": (65_535, Stop()),
    "pack": (4, Pack()),
    "touch": (5, Touch(Scene.HOST, 16, 1023)),
    "bootsel": (6, Bootsel()),
    "groups": (7, Groups(3)),
    "ask": (8, Ask(4)),
    "quiet frame in which somebody was asked": (
        266,
        Quiet.of(11, 12, np.array([0, 1], dtype=np.int16), sync=True, asked=True, turn=3),
    ),
    "samples, of the last of eight groups": (
        265,
        Samples(9, 10, np.array([1, 2], dtype=np.int16), sync=True, turn=15),
    ),
    "configure": (2, Configure(PAPER, SyncMode.HEAR, integrated=True, quiet_uv=135_000)),
    "configure, sync on the data wire": (3, Configure(PAPER, sync_wire=SyncWire.DATA)),
    "info, sync on the data wire": (
        9,
        Info(frame=PAPER, sample_rate_uhz=1, volts_per_count=1.0, sync_wire=SyncWire.DATA),
    ),
}

COBS = (  # examples of the literature, then blocks around 254 bytes
    b"",
    b"\0",
    b"\0\0",
    b"\0\x11\0",
    b"\x11\x22\0\x33",
    b"\x11\x22\x33\x44",
    b"\x11\0\0\0",
    bytes(range(1, 254)),
    bytes(range(1, 255)),
    bytes(range(0, 255)),
    bytes(range(1, 256)),
    bytes(range(2, 256)) + b"\0",
    bytes(range(3, 256)) + b"\0\1",
    b"\x55" * 508,
    b"\x55" * 508 + b"\0",
)

CODE_ORDERS = (1, 2, 4, 12, 16, 20, 28, 36, 64, 144)
LONG_ORDERS = {1024: (1, 512, 1023), 1040: (1, 519, 1039)}
"""Orders too large to be written in full, and the rows that are written."""
DEMO_REST = 1015
"""Code at rest of a demonstrator's nodes: 0.8 kPa on the default curve. Chosen: a tare has work."""
SIGN_SEEDS = (0, 1, 2, 0xDEADBEEF, 0xFFFFFFFF)
SIGN_ROWS = (*range(32), 1023, 4095, 65_534, 65_535)


def protocol_vectors() -> str:
    """Make firmware/vectors/protocol.json."""
    packets = []
    for name, (sequence, packet) in PACKETS.items():
        wire = PacketWriter(sequence).encode(packet)
        packets.append(
            {
                "name": name,
                "packet": type(packet).__name__,
                "type": packet.TYPE,
                "sequence": sequence,
                "fields": as_json(packet),
                "body": cobs_decode(wire[:-1])[:-4].hex(),
                "wire": wire.hex(),
            }
        )
    return dump(
        {
            "crc32": [
                {"data": data.hex(), "crc": zlib.crc32(data)} for data in (b"", b"123456789", b"\0")
            ],
            "cobs": [{"data": data.hex(), "encoded": cobs_encode(data).hex()} for data in COBS],
            "packets": packets,
        }
    )


def code_vectors() -> str:
    """Make firmware/vectors/codes.json: chips and signs as strings of + and -."""
    orders = {order: tuple(range(order)) for order in CODE_ORDERS} | LONG_ORDERS
    return dump(
        {
            "rows": [
                {"order": order, "row": row, "chips": plus_minus(code_book(order).rows([row])[0])}
                for order, rows in orders.items()
                for row in rows
            ],
            "sign_rows": list(SIGN_ROWS),
            "signs": [
                {"seed": seed, "signs": plus_minus(row_signs(np.array(SIGN_ROWS), seed))}
                for seed in SIGN_SEEDS
            ],
        }
    )


def demo_memories() -> str:
    """Write in C the memories of a demonstrator's nodes, which are those of its parameter file."""
    spec = SkinConfig.of(read_file(DEMO_PARAMS)).spec
    memories = [node_memory(spec, node + 1, rest=DEMO_REST) for node in range(spec.nodes)]
    rows = [
        textwrap.fill(
            "    " + " ".join(f"0x{byte:02x}," for byte in memory), 100, subsequent_indent="    "
        )
        for memory in memories
    ]
    begin = [
        f"#define DEMO_MEMORY_SIZE {len(memories[0])}u /* bytes of a node */",
        "",
        f"static const uint8_t demo_memories[{len(memories)} * DEMO_MEMORY_SIZE] = {{",
    ]
    return "\n".join([*begin, *rows, "};", ""])


def example() -> str:
    """Write the worked example of docs/protocol.md."""
    sequence = next(sequence for sequence, packet in PACKETS.values() if packet is EXAMPLE)
    wire = PacketWriter(sequence).encode(EXAMPLE)
    raw = cobs_decode(wire[:-1])
    parts = [
        ("02", "type: SAMPLES"),
        (raw[1:3].hex(), f"sequence: {sequence}"),
        (raw[3:11].hex(), f"device_time_us: {EXAMPLE.device_time_us}"),
        (raw[11:19].hex(), f"first_index: {EXAMPLE.first_index}"),
        (raw[19:20].hex(), "flags: SYNC"),
        (raw[20:-4].hex(), f"words: {', '.join(map(str, EXAMPLE.counts))}, each XOR 0x5555"),
        (raw[-4:].hex(), f"CRC-32 of the above: 0x{zlib.crc32(raw[:-4]):08x}"),
    ]
    lines = [f"{bytes_hex:16s} {meaning}" for bytes_hex, meaning in parts]
    on_wire = textwrap.wrap(wire.hex(" ", -4), 9 * 5)
    return "\n".join(["```", *lines, "", "on the wire:", *on_wire, "```", ""])


def book_table() -> str:
    """Write the code books of firmware/codes.md: factors, last row, CRC-32 of all rows."""
    table = ["| order | factors | row N − 1 | CRC-32 |", "|--:|---|---|---|"]
    for order in (12, 20, 28, 36, 40, 100, 144):
        book = code_book(order)
        ones = (book.matrix > 0).astype(np.uint8)
        factors = "·".join(map(str, book.plan))
        last = np.packbits(ones[-1]).tobytes().hex()[: order // 4]
        table.append(f"| {order} | {factors} | `{last}` | 0x{zlib.crc32(ones.tobytes()):08x} |")
    return "\n".join([*table, ""])


def sign_table() -> str:
    """Write the row signs of firmware/codes.md."""
    rows = (0, 1, 1000, 65_535)
    table = [f"| sign_seed | {' | '.join(f'r = {row}' for row in rows)} |", "|--:" * 5 + "|"]
    for seed in (0, 1, 0xFFFFFFFF):
        signs = plus_minus(row_signs(np.array(rows), seed)).replace("-", "−")
        table.append(f"| {seed} | {' | '.join(signs)} |")
    return "\n".join([*table, ""])


def sparse_table() -> str:
    """Write the sparse codes of firmware/codes.md: first octets, CRC-32 of a frame's."""
    table = [
        "| nodes | order | bits | node | code number | octets | CRC-32 |",
        "|--:" * 5 + "|---|---|",
    ]
    for nodes, order, bits in ((64, 32, 8), (256, 48, 10), (4000, 912, 10), (65_535, 4096, 16)):
        digits, size = code_digits(nodes, order), -(-order // 8) * 8
        for node in (1, nodes):
            code = int(code_numbers(digits)[node])
            ones = np.bitwise_count(code_places(nodes, bits, size) & code).astype(np.uint8) & 1
            octets = np.packbits(ones, bitorder="little").tobytes()
            table.append(
                f"| {nodes} | {order} | {bits} | {node} | {code} | `{octets[:12].hex()}` "
                f"| 0x{zlib.crc32(octets):08x} |"
            )
    return "\n".join([*table, ""])


def as_json(message: Message) -> dict[str, Any]:
    """Return the fields of a packet as plain JSON; bytes in hex."""

    def plain(value: Any) -> Any:
        match value:
            case Message():
                return as_json(value)
            case bytes():
                return value.hex()
            case np.ndarray():
                return value.tolist()
        return value

    names = [field.name for field in dataclasses.fields(message)]
    return {name: plain(getattr(message, name)) for name in names if name != "sequence"}


def plus_minus(chips: np.ndarray) -> str:
    """Turn [1, -1] into "+-"."""
    return "".join("+" if chip > 0 else "-" for chip in chips)


def dump(vectors: dict[str, Any]) -> str:
    """Write JSON with one vector per line, for readable diffs."""
    sections = []
    for name, items in vectors.items():
        lines = ",\n".join("  " + json.dumps(item) for item in items)
        sections.append(f'"{name}": [\n{lines}\n]')
    return "{\n" + ",\n".join(sections) + "\n}\n"
