# SPDX-License-Identifier: Apache-2.0

"""Checks what programs hand to the public classes, by the rules for parameters.

numpy's scalars and arrays are taken for Python's numbers and lists, paths for texts; a truth value
is no number, and a text no truth value. All raise ParameterError.
"""

import math
import reprlib
from collections.abc import Mapping
from os import PathLike, fspath
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..base.errors import ParameterError
from ..readings.baseline import ALL
from .parameters import Parameter, Value, check_values

T = TypeVar("T")
WHOLE_NS = (-(2**63), 2**63 - 1)
"""Limits of times of int64, ns."""
_NOT_NEGATIVE = (0.0, math.inf)


def parameters_of(given: Mapping[str, object]) -> dict[str, Value]:
    """Check parameters by name, and return them in their own types."""
    return check_values({name: _plain(value) for name, value in given.items()})


def argument(
    name: str, value: object, like: Value, limits: tuple[float, float] | None = None, unit: str = ""
) -> Any:
    """Check a value for the type of `like`, a tuple also for its length; limits are inclusive."""
    return Parameter(name, like, "", unit, limits).check(_plain(value))


def seconds(name: str, value: object) -> float:
    """Check a time span, s: 0 or more, also infinite."""
    return float(argument(name, value, 0.0, _NOT_NEGATIVE, "s"))


def forced(force: object) -> bool | str:
    """Check what a tare overrides: nothing, a load, or with "all" doubt, too."""
    is_all = isinstance(force, str) and force == ALL
    return ALL if is_all else bool(argument("force", force, False))


def timeout(name: str, value: object) -> float | None:
    """Check a time span, s, above 0; None for none."""
    span_s = None if value is None else seconds(name, value)
    if span_s == 0:
        raise ParameterError(f"{name} is 0 s; it must be above 0 s, or None")
    return span_s


def path_of(name: str, value: object) -> Path:
    """Make a path of one, or of a text."""
    return Path(argument(name, value, ""))


def instance(name: str, value: T, kind: type[Any]) -> T:
    """Return the value, if it is one of a class."""
    if not isinstance(value, kind):
        raise ParameterError(
            f"{name} is {reprlib.repr(value)} ({type(value).__name__}); it must be of "
            f"{kind.__module__.partition('.')[0]}'s {kind.__name__}"
        )
    return value


def unmasked(name: str, value: T) -> T:
    """Refuse numpy's masked arrays, whose mask nothing here looks at; returns the value."""
    if isinstance(value, np.ma.MaskedArray):
        raise ParameterError(f"{name} is a masked array; fill what is masked, or leave it out")
    return value


def array_of(name: str, value: object, shape: tuple[int | str, ...]) -> NDArray[Any]:
    """Check an array of float32 or float64; a text in its shape stands for any length."""
    array: NDArray[Any] = np.asarray(unmasked(name, instance(name, value, np.ndarray)))
    fits = len(array.shape) == len(shape) and all(
        isinstance(wanted, str) or length == wanted
        for length, wanted in zip(array.shape, shape, strict=True)
    )
    if not fits or array.dtype.char not in "fd":
        sizes = " × ".join(map(str, shape))
        raise ParameterError(
            f"{name} is {array.shape} of {array.dtype}; it must be {sizes} of float32 or float64"
        )
    return array


def _plain(value: object) -> object:
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return fspath(value) if isinstance(value, PathLike) else value
