# SPDX-License-Identifier: Apache-2.0

"""The exceptions that misuse raises. Line noise is never an exception: it is counted.

TactileError
├── SpecError         a parameter, or a combination of parameters, that cannot work
│   ├── LayoutError   a layout file that is not one, or that cannot be this skin's
│   └── BodyError     a body file that is not one, or that contradicts itself
├── ParameterError    an unknown parameter name, a wrong type or a value out of range
├── PortError         the port cannot be opened, was lost, or carries something else
│   └── RecordingEndError  all of a recording was replayed; there is nothing to retry
├── ProtocolError     the digitizer speaks another protocol version or refuses a command
├── CaptureError      a capture file that is empty, truncated or not what it should be
├── CalibrationError  a calibration file, or loads to calibrate from, that cannot be used
├── NodeMemoryError   a node's memory that is blank, damaged or not for this firmware
├── RestError         a tare that cannot be taken now; a file of tare and drift that is of no use
└── TransformError    tf frames that nothing connects, or that go round in a circle
"""

from .plain_text import plain


class TactileError(Exception):
    """Base of all errors of this package; its text is meant for the person at the bench.

    It may quote files and devices of strangers: what a terminal would obey is shown escaped.
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
    """All of a recording was replayed: this port has nothing more to say."""


class ProtocolError(TactileError):
    """The digitizer speaks another protocol version, or refuses what was asked of it."""


class CaptureError(TactileError):
    """A capture file that is empty, truncated or not what it should be."""


class CalibrationError(TactileError, ValueError):
    """A calibration file, or recorded loads to calibrate from, that cannot be used."""


class NodeMemoryError(TactileError, ValueError):
    """A node's memory that is blank, damaged or not for this firmware."""


class RestError(TactileError):
    """A tare that cannot be taken now, or a file of tare and drift that is of no use."""


class TransformError(TactileError, LookupError):
    """Coordinate frames that nothing connects, or that go round in a circle."""
