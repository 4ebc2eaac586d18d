# SPDX-License-Identifier: Apache-2.0

"""sim:// for pyserial: a virtual digitizer that is opened like any other port."""

from __future__ import annotations

from ..wire.virtual_port import VirtualPort
from .digitizer import VirtualDigitizer
from .options import SimOptions


class Serial(VirtualPort[VirtualDigitizer]):
    """A virtual digitizer, powered up by open() and down by close().

    Speed is set by the URL's option. open() raises SpecError for a bad one.
    """

    READ_AHEAD = 4096  # to make more takes long

    def reset_input_buffer(self) -> None:
        """Discard what has arrived and was not read."""
        with self._changed:
            digitizer = self._opened()
            digitizer.advance(0)
            digitizer.take(digitizer.pending)

    def _made(self, url: str) -> VirtualDigitizer:
        return VirtualDigitizer(SimOptions.from_url(url))

    def _receive(self, device: VirtualDigitizer, data: bytes) -> None:
        device.receive(data)
