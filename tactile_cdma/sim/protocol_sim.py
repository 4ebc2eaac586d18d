# SPDX-License-Identifier: Apache-2.0

"""sim:// for pyserial: a virtual digitizer that is opened like any other port."""

from collections.abc import Sequence

from ..places.layout import Layout
from ..wire.virtual_port import VirtualPort
from .digitizer import VirtualDigitizer
from .indenters import Indenter
from .options import SimOptions


class Serial(VirtualPort[VirtualDigitizer]):
    """A virtual digitizer, powered up by open() and down by close().

    Speed is set by the URL's option. open() raises SpecError for a bad one.

    layout: of the skin, if who opens it knows; None: as the options say.
    """

    layout: Layout | None = None
    READ_AHEAD = 4096  # to make more takes long

    @property
    def stepped(self) -> bool:
        """Tell whether frames pass only as press() asks for them."""
        with self._changed:
            return self._opened().options.stepped

    @property
    def simulated(self) -> SimOptions:
        with self._changed:
            return self._opened().options

    def press(self, objects: Sequence[Indenter], frames: int) -> None:
        """Press as VirtualDigitizer.press does; any thread may call it."""
        with self._changed:
            self._opened().press(objects, frames)
            self._changed.notify_all()

    def reset_input_buffer(self) -> None:
        with self._changed:
            digitizer = self._opened()
            digitizer.advance(0)
            digitizer.take(digitizer.pending)

    def _made(self, url: str) -> VirtualDigitizer:
        return VirtualDigitizer(SimOptions.from_url(url, self.layout))
