# SPDX-License-Identifier: Apache-2.0

"""Asks which digitizer is on a port. Sends nothing to devices that do not speak our protocol."""

import logging
import time

from ..base.errors import PortError, ProtocolError
from .identity import kind_of, shown_id
from .messages import GetInfo, Info, OtherVersion
from .packets import PacketParser, PacketWriter, diagnose
from .port import Port

_log = logging.getLogger(__name__)

LISTEN_S = 1.5
"""s: one and a half times the second in which a digitizer sends INFO unasked (docs/protocol.md)."""


def introduction(port: Port, patience_s: float = LISTEN_S) -> Info:
    """Wait for the digitizer's INFO, and ask for it as soon as an intact packet has come.

    Raises PortError, with the likely cause, if none comes, and ProtocolError if the digitizer
    speaks another protocol version.
    """
    parser, asked = PacketParser(), False
    end_s = time.monotonic() + patience_s
    while time.monotonic() < end_s:
        data, _ = port.read()
        for packet in parser.feed(data):
            if isinstance(packet, Info):
                _log.debug("%s: %s", port.url, described_info(packet))
                return packet
            if isinstance(packet, OtherVersion):
                raise ProtocolError(f"{port.url}: {packet}")
        if parser.counters.packets and not asked:
            asked = True
            port.write(PacketWriter().encode(GetInfo()))
    raise PortError(f"{port.url}: {diagnose(parser.counters)}")


def described_info(info: Info, settings: str = "set to") -> str:
    """Describe a digitizer and its settings in a line. settings: the words that introduce these."""
    frame = info.frame
    known = ", ".join(filter(None, (shown_id(info.digitizer_id), kind_of(info.digitizer_id))))
    return (
        f"{known}, firmware {info.firmware_major}."
        f"{info.firmware_minor}, {settings} {frame.nodes} nodes × {frame.bits} bits, order "
        f"{frame.order}, {frame.chip_ns / 1e3:g} µs chips, a frame every "
        f"{frame.frame_period_us / 1e3:g} ms"
        + (", sync pulses on the data wire" if info.sync_wire else "")
    )
