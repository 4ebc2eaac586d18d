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

"""sim:// for pyserial: a virtual digitizer that is opened like any other port."""

from __future__ import annotations

import math
import threading
import time

from serial.serialutil import PortNotOpenError, SerialBase, SerialException, to_bytes

from .digitizer import VirtualDigitizer
from .options import SimOptions

_READ_AHEAD = 4096
"""Bytes that in_waiting has generated where the pace is as fast as they are read."""


class Serial(SerialBase):
    """A virtual digitizer, powered up by open() and down by close().

    Speed is set by the URL's option, not by the baud rate, which is accepted and ignored.
    """

    def __init__(self, *args: object, **kwargs: object) -> None:
        self.digitizer: VirtualDigitizer | None = None
        # Guards the digitizer; notified when bytes may have become due or a read is to end.
        self._changed = threading.Condition()
        self._cancelled = False
        self.is_open = False
        super().__init__(*args, **kwargs)

    def open(self) -> None:
        """Power up. Raises SpecError for a bad option, SerialException where already open."""
        if self._port is None:
            raise SerialException("Port must be configured before it can be used.")
        if self.is_open:
            raise SerialException("Port is already open.")
        self.digitizer = VirtualDigitizer(SimOptions.from_url(self._port))
        self.is_open = True

    def close(self) -> None:
        """Power down and end a read() in another thread."""
        with self._changed:
            self.is_open = False
            self.digitizer = None
            self._changed.notify_all()

    @property
    def in_waiting(self) -> int:
        """Bytes that can be read at once."""
        with self._changed:
            digitizer = self._powered()
            digitizer.advance(_READ_AHEAD)
            return digitizer.pending

    def read(self, size: int = 1) -> bytes:
        """Wait for `size` bytes, at most as long as the timeout; returns what there is."""
        deadline = math.inf if self._timeout is None else time.monotonic() + self._timeout
        data = b""
        with self._changed:
            while True:
                digitizer = self._powered()
                wait_s = digitizer.advance(size - len(data))
                data += digitizer.take(size - len(data))
                left_s = deadline - time.monotonic()
                if len(data) >= size or left_s <= 0 or self._cancelled:
                    self._cancelled = False
                    return data
                self._changed.wait(min(wait_s, left_s, threading.TIMEOUT_MAX))

    def write(self, data: bytes | bytearray | memoryview) -> int:
        """Send bytes to the digitizer; returns their number."""
        sent = to_bytes(data)
        with self._changed:
            self._powered().receive(sent)
            self._changed.notify_all()
        return len(sent)

    def cancel_read(self) -> None:
        """End a read() in another thread, or the next one if there is none."""
        with self._changed:
            self._cancelled = True
            self._changed.notify_all()

    def reset_input_buffer(self) -> None:
        """Discard what has arrived and was not read."""
        with self._changed:
            digitizer = self._powered()
            digitizer.advance(0)
            digitizer.take(digitizer.pending)

    def reset_output_buffer(self) -> None:
        """Nothing to discard: what is written is received at once."""
        self._powered()

    @property
    def out_waiting(self) -> int:
        """Bytes written and not yet received: none."""
        self._powered()
        return 0

    def flush(self) -> None:
        """Nothing to wait for: what is written is received at once."""
        self._powered()

    def _powered(self) -> VirtualDigitizer:
        if self.digitizer is None:
            raise PortNotOpenError()
        return self.digitizer

    # SerialBase calls these when a setting changes; a virtual port has no lines to set.

    def _reconfigure_port(self) -> None:
        pass

    def _update_rts_state(self) -> None:
        pass

    def _update_dtr_state(self) -> None:
        pass

    def _update_break_state(self) -> None:
        pass
