# SPDX-License-Identifier: Apache-2.0

"""A skin without hardware: scenes, sensing nodes, analog line and digitizer, byte for byte.

    scene ──▶ nodes ──▶ line (by channel) ──▶ packets ──▶ digitizer ──▶ sim:// (protocol_sim)
                                                                 └──▶ a tty (pty)

pyserial finds `sim://` once 'tactile_cdma.sim' is in serial.protocol_handler_packages. For programs
that press on sim://?scene=external there are the objects below; batch/ simulates thousands of skins
at once, without the line; docs/simulation.md.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .indenters import (
    Box,
    Capsule,
    Cylinder,
    Ellipsoid,
    Foundation,
    HeightMap,
    Indenter,
    Sphere,
    at_force,
    pressed_pa,
)

__all__ = [
    "BatchCover",
    "Box",
    "Capsule",
    "Cylinder",
    "Ellipsoid",
    "Foundation",
    "HeightMap",
    "Indenter",
    "SkinBatch",
    "Sphere",
    "at_force",
    "pressed_pa",
]

if TYPE_CHECKING:
    from .batch import BatchCover, SkinBatch
else:

    def __getattr__(name: str) -> Any:
        """Import the batched skin, which needs an optional package, when it is used."""
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(".batch", __name__), name)
