# SPDX-License-Identifier: Apache-2.0

"""replay:// for pyserial: a recording that is opened like any other port."""

from ..base.errors import RecordingEndError
from ..wire.virtual_port import VirtualPort
from .player import Player, ReplayOptions


class Serial(VirtualPort[Player]):
    """A recording, replayed from its beginning by the first read() after open().

    What is written is ignored. open() raises SpecError for a bad option, CaptureError for a bad
    file. At the end read() raises RecordingEndError.
    """

    def _made(self, url: str) -> Player:
        return Player(ReplayOptions.from_url(url))

    def _has_ended(self, device: Player, data: bytes) -> bool:
        if device.ended and not data:
            raise RecordingEndError(f"{self._port}: {device.farewell}")
        return device.ended
