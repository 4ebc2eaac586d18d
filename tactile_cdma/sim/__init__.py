# SPDX-License-Identifier: Apache-2.0

"""A skin without hardware: scenes, sensing nodes, analog line and digitizer, byte for byte.

    scene ──▶ nodes ──▶ line (by channel) ──▶ packets ──▶ digitizer ──▶ sim:// (protocol_sim)
                                              schedule ──┘       └──▶ a tty (pty)

pyserial finds `sim://` once 'tactile_cdma.sim' is in serial.protocol_handler_packages. For programs
that press on sim://?scene=external there are the objects below; docs/simulation.md.
"""

from .depth import at_force
from .indenters import (
    Box,
    Capsule,
    Cylinder,
    Ellipsoid,
    Foundation,
    HeightMap,
    Indenter,
    Sphere,
)

__all__ = [
    "Box",
    "Capsule",
    "Cylinder",
    "Ellipsoid",
    "Foundation",
    "HeightMap",
    "Indenter",
    "Sphere",
    "at_force",
]
