# SPDX-License-Identifier: Apache-2.0

"""Who is at the other end of a port; nothing is sent to what does not speak our protocol."""

from __future__ import annotations

import time

from ..base.errors import PortError, ProtocolError
from .identity import shown_id
from .messages import GetInfo, Info, OtherVersion
from .packets import PacketParser, PacketWriter, diagnose
from .port import Port

LISTEN_S = 1.5
"""A digitizer reports once a second without being asked, by docs/protocol.md."""


def introduction(port: Port, patience_s: float = LISTEN_S) -> Info:
    """The digitizer's description of itself, waited for, and asked for once packets have come.

    Raises PortError, with the likely cause, where none comes, and ProtocolError for a digitizer of
    another protocol version.
    """
    parser, asked = PacketParser(), False
    end_s = time.monotonic() + patience_s
    while time.monotonic() < end_s:
        data, _ = port.read()
        for packet in parser.feed(data):
            if isinstance(packet, Info):
                return packet
            if isinstance(packet, OtherVersion):
                raise ProtocolError(f"{port.url}: {packet}")
        if parser.counters.packets and not asked:
            asked = True
            port.write(PacketWriter().encode(GetInfo()))
    raise PortError(f"{port.url}: {diagnose(parser.counters)}")


def described_info(info: Info) -> str:
    """A digitizer and its set-up in one line."""
    frame = info.frame
    return (
        f"{shown_id(info.digitizer_id)}, firmware {info.firmware_major}."
        f"{info.firmware_minor}, set to {frame.nodes} nodes × {frame.bits} bits, order "
        f"{frame.order}, {frame.chip_ns / 1e3:g} µs chips, a frame every "
        f"{frame.frame_period_us / 1e3:g} ms"
    )
