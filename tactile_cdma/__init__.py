# SPDX-License-Identifier: Apache-2.0

"""Driver for large-area robot skin whose nodes share one wire by code division multiple access.

Skin: live frames of a skin. Decoder: bytes → frames. Both without ROS; see docs/python.md. The
ROS 2 nodes are in tactile_cdma.ros, their messages in tactile_cdma.msg.
"""

from importlib import import_module
from pkgutil import extend_path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .base.errors import TactileError
    from .readings.taxels import Status
    from .skin import Decoder, Frame, Skin, read_parameters, read_recording

__all__ = [
    "Decoder",
    "Frame",
    "Skin",
    "Status",
    "TactileError",
    "read_parameters",
    "read_recording",
]

_HOMES = {
    "Decoder": ".skin",
    "Frame": ".skin",
    "Skin": ".skin",
    "Status": ".readings.taxels",
    "TactileError": ".base.errors",
    "read_parameters": ".skin",
    "read_recording": ".skin",
}

# The messages that a build generates lie beside the installed package, not in a checkout.
__path__ = extend_path(__path__, __name__)

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    """Load a public name when it is first used: `tactile-cdma doctor` runs without numpy."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name], __name__), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
