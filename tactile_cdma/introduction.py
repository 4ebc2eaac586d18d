# Copyright 2026 tactile_cdma maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Who is at the other end of a port; nothing is sent to what does not speak our protocol."""

from __future__ import annotations

import time

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
                raise ProtocolError(f"{port.url}: {packet}")
        if parser.counters.packets and not asked:
            asked = True
            port.write(PacketWriter().encode(GetInfo()))
    raise PortError(f"{port.url}: {diagnose(parser.counters)}")
