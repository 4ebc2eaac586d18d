# SPDX-License-Identifier: Apache-2.0

"""The array API standard: one set of functions for numpy, torch, JAX and others."""

import reprlib
from typing import Any

from ...base.errors import ParameterError, needed_for
from ...config.python_arguments import unmasked

Array = Any
"""An array of a library that follows the standard."""


def array_api() -> Any:
    """Return the module array_api_compat; raises MissingPackageError."""
    with needed_for("SkinBatch", "array_api_compat"):
        import array_api_compat
    return array_api_compat


def is_array(array: Array, shape: tuple[int, ...]) -> bool:
    """Tell whether it is an array of a library that follows the standard, and of this shape."""
    return bool(array_api().is_array_api_obj(array)) and tuple(array.shape) == shape


def floating(name: str, array: Array) -> Any:
    """Return the namespace of an array of float32 or float64; ParameterError: it is none.

    Libraries have shorter ones, too, which end at 65 kPa or have steps of 0.4 kPa there.
    """
    api = array_api()
    if api.is_array_api_obj(unmasked(name, array)):
        xp = api.array_namespace(array)
        if xp.isdtype(array.dtype, (xp.float32, xp.float64)):
            return xp
    raise ParameterError(f"{name} is {described(array)}; it must be an array of float32 or float64")


def described(array: object) -> str:
    """Shape and type of what was given as an array."""
    if not array_api().is_array_api_obj(array):
        return f"{reprlib.repr(array)} ({type(array).__name__})"
    return f"{tuple(array.shape)} of {array.dtype}"  # type: ignore[attr-defined]


def axes_of(quaternion: Array, xp: Any) -> tuple[Array, Array, Array]:
    """Turn orientations (e, 4), x, y, z, w of any length, to the objects' axes, (e, 3) each."""
    q = quaternion / xp.sqrt(xp.sum(quaternion * quaternion, axis=-1, keepdims=True))
    x, y, z, w = (q[:, i] for i in range(4))
    return (
        xp.stack((1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)), axis=-1),
        xp.stack((2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)), axis=-1),
        xp.stack((2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)), axis=-1),
    )
