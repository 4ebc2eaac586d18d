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

"""replay:// for pyserial: a recording that is opened like any other port."""

from __future__ import annotations

import math
import threading
import time

from serial.serialutil import PortNotOpenError, SerialBase, SerialException, to_bytes

from ..errors import RecordingEndError
from .options import ReplayOptions
from .player import Player

_READ_AHEAD = 65_536
"""Bytes that in_waiting takes over at most."""


class Serial(SerialBase):
    """A recording, replayed from its beginning by the first read() after open().

    What is written is accepted and ignored, and so is the baud rate. At the end read() raises
    RecordingEndError.
    """

    def __init__(self, *args: object, **kwargs: object) -> None:
        self._player: Player | None = None
        self._changed = threading.Condition()  # guards the player; notified when a read is to end
        self._cancelled = False
        self.is_open = False
        super().__init__(*args, **kwargs)

    def open(self) -> None:
        """Find the recording.

        Raises SpecError for a bad option, CaptureError for a bad file, SerialException where
        already open.
        """
        if self._port is None:
            raise SerialException("Port must be configured before it can be used.")
        if self.is_open:
            raise SerialException("Port is already open.")
        self._player = Player(ReplayOptions.from_url(self._port))
        self.is_open = True

    def close(self) -> None:
        """End, and end a read() in another thread."""
        with self._changed:
            self.is_open = False
            self._player = None
            self._changed.notify_all()

    @property
    def in_waiting(self) -> int:
        """Bytes that can be read at once."""
        with self._changed:
            player = self._opened()
            player.advance(_READ_AHEAD)
            return player.pending

    def read(self, size: int = 1) -> bytes:
        """Wait for `size` bytes, at most as long as the timeout; returns what there is.

        Raises RecordingEndError where there will be none.
        """
        deadline = math.inf if self._timeout is None else time.monotonic() + self._timeout
        data = b""
        with self._changed:
            while True:
                player = self._opened()
                wait_s = player.advance(size - len(data))
                data += player.take(size - len(data))
                if player.ended and not data:
                    raise RecordingEndError(f"{self._port}: {player.farewell}")
                left_s = deadline - time.monotonic()
                if len(data) >= size or left_s <= 0 or self._cancelled or player.ended:
                    self._cancelled = False
                    return data
                self._changed.wait(min(wait_s, left_s, threading.TIMEOUT_MAX))

    def write(self, data: bytes | bytearray | memoryview) -> int:
        """Ignore bytes: what was recorded has been answered already. Returns their number."""
        self._opened()
        return len(to_bytes(data))

    def cancel_read(self) -> None:
        """End a read() in another thread, or the next one if there is none."""
        with self._changed:
            self._cancelled = True
            self._changed.notify_all()

    def reset_input_buffer(self) -> None:
        """Nothing to discard: what was not read stays to be read."""
        self._opened()

    def reset_output_buffer(self) -> None:
        """Nothing to discard: what is written is ignored at once."""
        self._opened()

    @property
    def out_waiting(self) -> int:
        """Bytes written and not yet ignored: none."""
        self._opened()
        return 0

    def flush(self) -> None:
        """Nothing to wait for: what is written is ignored at once."""
        self._opened()

    def _opened(self) -> Player:
        if self._player is None:
            raise PortNotOpenError()
        return self._player

    # SerialBase calls these when a setting changes; a recording has no lines to set.

    def _reconfigure_port(self) -> None:
        pass

    def _update_rts_state(self) -> None:
        pass

    def _update_dtr_state(self) -> None:
        pass

    def _update_break_state(self) -> None:
        pass
