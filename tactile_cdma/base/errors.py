# SPDX-License-Identifier: Apache-2.0

"""The exceptions that misuse raises. Line noise is never an exception: it is counted.

TactileError
├── SpecError         a parameter, or a combination of parameters, that cannot work
│   ├── LayoutError   a layout file that is not one, or that cannot be this skin's
│   └── BodyError     a body file that is not one, or that contradicts itself
├── ParameterError    an unknown parameter name, a wrong type or a value out of range
├── PortError         the port cannot be opened, was lost, or carries no packets
│   └── RecordingEndError  the end of a recording that is replayed; there is nothing to retry
├── ProtocolError     the digitizer speaks another protocol version or refuses a command
├── CaptureError      a capture or recording that is empty, truncated or of another format
├── CalibrationError  a calibration file, or loads to calibrate from, that cannot be used
├── NodeMemoryError   a node's memory that is blank, damaged or not for this firmware
├── MissingPackageError  an optional package that a command needs is not installed
├── RestError         a tare that cannot be taken now; an unusable file of tare and drift
└── TransformError    tf frames that are not connected, or that form a cycle
"""

from .plain_text import plain


class TactileError(Exception):
    """Base of all errors of this package; its text is meant for the person at the bench.

    The text may quote untrusted files and devices: control characters are shown escaped.
    """

    def __str__(self) -> str:
        return plain(super().__str__())


class SpecError(TactileError, ValueError):
    """A parameter, or a combination of parameters, that cannot work."""


class LayoutError(SpecError):
    """A layout file that is not one, or that contradicts itself or the skin's parameters."""


class BodyError(SpecError):
    """A body file that is not one, or that contradicts itself."""


class ParameterError(TactileError, ValueError):
    """An unknown parameter name, a value of the wrong type, or a value out of range."""


class PortError(TactileError, OSError):
    """The port cannot be opened, was lost, or carries something other than packets."""


class RecordingEndError(PortError):
    """The end of a recording that is replayed: opening the port again would not help."""


class ProtocolError(TactileError):
    """The digitizer speaks another protocol version, or refuses what was asked of it."""


class CaptureError(TactileError):
    """A capture or recording that is empty, truncated or of another format."""


class CalibrationError(TactileError, ValueError):
    """A calibration file, or recorded loads to calibrate from, that cannot be used."""


class NodeMemoryError(TactileError, ValueError):
    """A node's memory that is blank, damaged or not for this firmware."""


class MissingPackageError(TactileError, ImportError):
    """An optional package that a command needs is not installed."""


class RestError(TactileError):
    """A tare that cannot be taken now, or a file of tare and drift that cannot be used."""


class TransformError(TactileError, LookupError):
    """Coordinate frames that are not connected, or that form a cycle."""


def check_limits(name: str, value: float, low: float, high: float, cause: str = "") -> None:
    """Raises SpecError, naming value, limits and cause, for a value beyond the limits, or NaN."""
    if not low <= value <= high:
        limits = f"{low:.10g}…{high:.10g}" + (f": {cause}" if cause else "")
        raise SpecError(f"{name} is {value:.10g}; it must lie within {limits}")
