# SPDX-License-Identifier: Apache-2.0

"""Has the compiled kernel called, which does the arithmetic of every frame.

Its functions are called by their names in kernel/*.h, as `lib.words_noise(…)`: cffi checks how many
arguments there are, and their types. Arrays are handed over by `pointer`, which checks how many
values there are, structs by `struct`, and objects are held by a `Held`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .errors import KernelError

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

try:
    _module: Any = import_module("tactile_cdma._kernel")
except ImportError as error:
    raise KernelError(
        f"the compiled kernel does not load ({error}): build it, with a C compiler (apt: gcc "
        "python3-dev), by pip install . or, in a ROS workspace, colcon build; in a checkout by "
        "make setup"
    ) from error

lib, ffi = _module.lib, _module.ffi
"""The kernel's functions and numbers; what makes and reads values in C."""
_ARRAYS = {
    "f": "float[]", "d": "double[]", "i": "int32_t[]", "h": "int16_t[]", "b": "int8_t[]",
    "B": "uint8_t[]", "?": "uint8_t[]",
}  # fmt: skip
"""Types in C of numpy's arrays. Flags are bytes there."""


def pointer(values: NDArray[Any], *shape: int, written: bool = False) -> Any:
    """Return a pointer to the values of an array, for the kernel; it keeps the array.

    Raises ValueError unless the array is C-contiguous and of this shape, and writeable if it is
    written to. That it has the function's type, cffi checks in the call.
    """
    if values.shape != shape:
        raise ValueError(f"the kernel needs an array of shape {shape}, not {values.shape}")
    return ffi.from_buffer(_ARRAYS[values.dtype.char], values, written)


class Held:
    """Keeps an object of the kernel, and what that uses, as long as this lives.

    at: points to it.
    """

    def __init__(self, at: Any, free: Callable[[Any], None] | None, *used: object) -> None:
        """at: what the kernel's function has made, or, without free, a struct of this module.

        Raises ValueError where the function made nothing.
        """
        if not at:
            raise ValueError(
                f"the kernel makes no {ffi.typeof(at).item.cname}: sizes contradict each other, or "
                "exceed what the kernel is built for, or memory is short"
            )
        self.at, self._used = ffi.gc(at, free) if free else at, used


def struct(name: str, **members: Any) -> Held:
    """Make one of the kernel's structs, by the names of its members and of those of structs in it.

    It keeps the arrays that its members point to. Raises TypeError unless exactly its members are
    given.
    """
    given = dict(members)
    at = ffi.new(f"struct {name} *", _filled(ffi.typeof(f"struct {name}"), name, given))
    if given:
        raise TypeError(f"struct {name} of the kernel has no {', '.join(sorted(given))}")
    return Held(at, None, members)


def _filled(kind: Any, name: str, members: dict[str, Any]) -> dict[str, Any]:
    """Take what a struct of this type is filled with out of members."""
    values: dict[str, Any] = {}
    for member, field in kind.fields:
        if field.type.kind == "struct":
            values[member] = _filled(field.type, name, members)
        elif member in members:
            value = members.pop(member)
            is_array = field.type.kind == "pointer" and hasattr(value, "shape")
            values[member] = pointer(value, *value.shape) if is_array else value
        else:
            raise TypeError(f"struct {name} of the kernel: {member} is missing")
    return values
