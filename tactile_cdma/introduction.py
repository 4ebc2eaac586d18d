"""Who is at the other end of a port; nothing is sent to what does not speak our protocol."""

from __future__ import annotations

import time

from ._protocol import VERSION
from .errors import PortError, ProtocolError
from .messages import GetInfo, Info, OtherVersion
from .protocol import PacketParser, PacketWriter, diagnose
from .source import Port

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
                raise ProtocolError(other_version(port.url, packet))
        if parser.counters.packets and not asked:
            asked = True
            port.write(PacketWriter().encode(GetInfo()))
    raise PortError(f"{port.url}: {diagnose(parser.counters)}")


def other_version(url: str, packet: OtherVersion) -> str:
    """What to say of a digitizer that speaks another version of the protocol."""
    return (
        f"{url}: the digitizer speaks protocol version {packet.version}, this package speaks "
        f"{VERSION}: update whichever is older"
    )
