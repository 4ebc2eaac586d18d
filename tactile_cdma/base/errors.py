# SPDX-License-Identifier: Apache-2.0

"""The exceptions that misuse raises. Line noise is never an exception: it is counted."""

from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum

from .text import plain


class TactileError(Exception):
    """Base of all errors of this package; its text is meant for the person at the bench.

    The text may quote untrusted files and devices: control characters are shown escaped.
    Example: `except TactileError as error: print(error)` around a whole program.
    """

    def __str__(self) -> str:
        return plain(super().__str__())


class SpecError(TactileError, ValueError):
    """A parameter, or a combination of parameters, that cannot work.

    Example: frame_period_ms=5 for 16 nodes of 50 µs chips, whose frames last 10 ms.
    """


class LayoutError(SpecError):
    """A layout file that is not one, or that contradicts itself or the skin's parameters.

    Example: two taxels of the file have node 7.
    """


class BodyError(SpecError):
    """A body file that is not one, or that contradicts itself.

    Example: two of its patches have the same port.
    """


class ParameterError(TactileError, ValueError):
    """An unknown parameter name, a value of the wrong type, or a value out of range.

    Example: Skin("sim://", nodez=16), or bits=99.
    """


class PortError(TactileError, OSError):
    """The port cannot be opened, was lost, or carries something other than packets.

    Example: /dev/ttyACM0 is held by another program, or its cable is pulled.
    """


class RecordingEndError(PortError):
    """The end of a recording that is replayed: opening the port again would not help.

    Example: read() after the last frame of replay://touch.skin.
    """


class ProtocolError(TactileError):
    """The digitizer speaks another protocol version, or refuses what was asked of it.

    Example: its firmware is of an older protocol than this package.
    """


class CaptureError(TactileError):
    """A capture or recording that is empty, truncated or of another format.

    Example: the time in an oscilloscope's CSV does not rise.
    """


class CalibrationError(TactileError, ValueError):
    """A calibration file, or recorded loads to calibrate from, that cannot be used.

    Example: calibration_file is that of another skin.
    """


class NodeMemoryError(TactileError, ValueError):
    """A node's memory that is blank, damaged or not for this firmware.

    Example: `tactile-cdma node --read` of a chip that was never programmed.
    """


class ObservationError(TactileError):
    """An observation that a policy was never trained on, because rows like it are left out.

    Example: the state of the robot is older than half a second.
    """


class MissingPackageError(TactileError, ImportError):
    """An optional package that a command needs is not installed.

    Example: `tactile-cdma export` to Parquet without pyarrow.
    """


class Refusal(IntEnum):
    """Why a tare was refused; the numbers are those of Tare.srv."""

    NONE = 0
    OTHER = 1
    INACTIVE = 2
    NO_FRAMES = 3
    EARLY = 4
    MOVING = 5
    LOADED = 6
    SENSOR = 7
    NO_READING = 8

    @property
    def may_pass(self) -> bool:
        """Whether trying again later may help, without anybody's doing."""
        return self in (Refusal.NO_FRAMES, Refusal.EARLY, Refusal.MOVING, Refusal.LOADED)


class RestError(TactileError):
    """A tare that cannot be taken now, or a file of tare and drift that cannot be used.

    Example: tare() while something touches the skin; reason is Refusal.LOADED then.
    """

    def __init__(self, text: str, reason: Refusal = Refusal.OTHER) -> None:
        super().__init__(text)
        self.reason = reason


class MessageError(TactileError, ValueError):
    """A message whose fields contradict each other, or that is none of its type.

    Example: 16 pressures, and the status of 15 taxels.
    """


class TransformError(TactileError, LookupError):
    """Coordinate frames that are not connected, or that form a cycle.

    Example: nobody publishes the transform from a patch to the frame of the body.
    """


def check_limits(name: str, value: float, low: float, high: float, cause: str = "") -> None:
    """Raises SpecError, naming value, limits and cause, for a value beyond the limits, or NaN."""
    if not low <= value <= high:
        limits = f"{low:.10g}…{high:.10g}" + (f": {cause}" if cause else "")
        raise SpecError(f"{name} is {value:.10g}; it must lie within {limits}")


@contextmanager
def needed_for(what: str, module: str, package: str = "") -> Iterator[None]:
    """For the imports of what needs a module of an optional package of PyPI.

    what: the command or option that needs it. package: called as the module unless it is given.
    Raises MissingPackageError where it is missing.
    """
    package = package or module
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != module:
            raise
        raise MissingPackageError(
            f"{what} needs the Python package {package}, which is not installed: pip install "
            f"{package} (with --break-system-packages where pip refuses the system's Python)"
        ) from None
