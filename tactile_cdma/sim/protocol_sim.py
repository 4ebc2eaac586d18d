# SPDX-License-Identifier: Apache-2.0

"""sim:// for pyserial: a virtual digitizer, opened like any other port, and pressed by programs."""

from collections.abc import Sequence

from ..base.errors import PortError, SpecError
from ..driver.driver import Driver
from ..places.layout import Layout
from ..wire.port import Port, lost
from ..wire.virtual_port import VirtualPort
from .digitizer import VirtualDigitizer
from .indenters import Indenter
from .options import SimOptions
from .scene import EXTERNAL


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

    def _receive(self, device: VirtualDigitizer, data: bytes) -> None:
        device.receive(data)


def is_pressable(port: Port) -> bool:
    """Tell whether this is a skin that press() acts on."""
    skin: SimOptions | None = getattr(port.device, "simulated", None)
    return skin is not None and skin.scene == EXTERNAL


def press(driver: Driver, objects: Sequence[Indenter], frames: int = 0) -> None:
    """Let these objects, and no others, touch the skin from its next frame on.

    frames: number of frames that may pass, of a skin that is stepped. Nothing touches a port that
    is opened anew. Raises PortError where the port is not open, or cannot be pressed like that.
    """
    port = driver.port
    if port is None:
        raise PortError(f"{driver.url}: not pressed, because it is not open")
    if not is_pressable(port):
        raise PortError(f"{port.url}: only sim://?scene=external can be pressed by a program")
    driver.expect_frames()
    try:
        port.device.press(objects, frames)
    except SpecError as error:
        raise PortError(f"{port.url}: {error}") from None
    except OSError as error:
        raise lost(port.url, "pressing", error) from None
