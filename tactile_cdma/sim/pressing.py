# SPDX-License-Identifier: Apache-2.0

"""Presses on the simulated skin at a driver's port, sim://?scene=external."""

from collections.abc import Sequence

from ..base.errors import PortError, SpecError
from ..driver.driver import Driver
from ..wire.port import Port
from .indenters import Indenter
from .options import SimOptions
from .scene import EXTERNAL


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
        raise port.lost(error, "pressing") from None
