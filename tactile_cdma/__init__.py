# SPDX-License-Identifier: Apache-2.0

"""Driver for large-area robot skin whose nodes share one wire by code division multiple access.

Skin: live frames of a skin. Decoder: bytes → frames. Both without ROS; see docs/programs.md. The
ROS 2 nodes are in tactile_cdma.ros, their messages in tactile_cdma.msg.
"""

from importlib import import_module
from pkgutil import extend_path
from typing import TYPE_CHECKING, Any

from .base.errors import (
    BodyError,
    CalibrationError,
    CaptureError,
    ObservationError,
    ParameterError,
    PortError,
    RecordingEndError,
    Refusal,
    RestError,
    SpecError,
    TactileError,
)

__all__ = [
    "Body",
    "BodyError",
    "BodyFrame",
    "CalibrationError",
    "CaptureError",
    "Contact",
    "Contacts",
    "Decoder",
    "Frame",
    "LiveObservation",
    "ObservationError",
    "Origin",
    "ParameterError",
    "PortError",
    "RecordingEndError",
    "Refusal",
    "RestError",
    "Skin",
    "SpecError",
    "Status",
    "TactileError",
    "read_parameters",
    "read_recording",
]

# The messages that a build generates lie beside the installed package, not in a checkout.
__path__ = extend_path(__path__, __name__)

__version__ = "0.2.0"

if TYPE_CHECKING:
    from .body import Body, BodyFrame
    from .driver.digitizer import Origin
    from .live_observation import LiveObservation
    from .readings.contact import Contact, Contacts
    from .readings.status import Status
    from .skin import Decoder, Frame, Skin, read_parameters, read_recording
else:

    def __getattr__(name: str) -> Any:
        """Load what needs numpy when it is first used: `tactile-cdma doctor` runs without."""
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        homes = {
            "Body": ".body",
            "BodyFrame": ".body",
            "Contact": ".readings.contact",
            "Contacts": ".readings.contact",
            "LiveObservation": ".live_observation",
            "Origin": ".driver.digitizer",
            "Status": ".readings.status",
        }
        return getattr(import_module(homes.get(name, ".skin"), __name__), name)


def __dir__() -> list[str]:
    return [*__all__, *(name for name in globals() if name.startswith("__"))]
