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
    """A combination of parameters that cannot work: frame_period_ms=5 for frames of 10 ms, say."""


class LayoutError(SpecError):
    """A layout file that is none, or contradicts itself or the skin: two taxels of node 7, say."""


class BodyError(SpecError):
    """A body file that is none, or contradicts itself: two of its patches have one port, say."""


class ParameterError(TactileError, ValueError):
    """An unknown parameter, or a value of the wrong type or out of range: nodez=16, or bits=99."""


class KernelError(TactileError, ImportError):
    """The compiled kernel was not built, or not for this Python and processor."""


class PortError(TactileError, OSError):
    """The port does not open, was lost (its cable is pulled, say), or carries no packets."""


class RecordingEndError(PortError):
    """The end of a recording that is replayed: opening the port again would not help."""


class ProtocolError(TactileError):
    """The digitizer speaks another protocol version, or refuses what was asked of it."""


class CaptureError(TactileError):
    """A capture or recording that is empty, truncated or of another format."""


class CalibrationError(TactileError, ValueError):
    """A calibration file (of another skin, say), or loads to calibrate from, of no use."""


class NodeMemoryError(TactileError, ValueError):
    """A node's memory that is blank, damaged or not for this firmware."""


class ObservationError(TactileError):
    """An observation that a policy was never trained on, because rows like it are left out.

    Example: the state of the robot is older than half a second.
    """


class MissingPackageError(TactileError, ImportError):
    """An optional package that a command needs is not installed: pyarrow for Parquet, say."""


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
        """Tell whether trying again later may help, without anybody's doing."""
        return self in (Refusal.NO_FRAMES, Refusal.EARLY, Refusal.MOVING, Refusal.LOADED)


class RestError(TactileError):
    """A tare that cannot be taken now, or a file of tare and drift that cannot be used.

    reason: Refusal.LOADED where something touches the skin, say.
    """

    def __init__(self, text: str, reason: Refusal = Refusal.OTHER) -> None:
        super().__init__(text)
        self.reason = reason


class MessageError(TactileError, ValueError):
    """A message that is none of its type, or contradicts itself: 16 pressures, but 15 statuses."""


class TransformError(TactileError, LookupError):
    """Coordinate frames that are not connected (nobody publishes a transform), or form a cycle."""


def check_limits(name: str, value: float, low: float, high: float, cause: str = "") -> None:
    """Raises SpecError, naming value, limits and cause, for a value beyond the limits, or NaN."""
    if not low <= value <= high:
        limits = f"{low:.10g}…{high:.10g}" + (f": {cause}" if cause else "")
        raise SpecError(f"{name} is {value:.10g}; it must lie within {limits}")


@contextmanager
def needed_for(what: str, module: str, package: str = "") -> Iterator[None]:
    """Tell which optional package of PyPI is missing where an import in the context fails.

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
