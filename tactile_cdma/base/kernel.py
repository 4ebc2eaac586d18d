# SPDX-License-Identifier: Apache-2.0

"""Chooses what does the arithmetic of every frame: the compiled kernel, or numpy.

numpy is the reference, and what is left where the kernel was not built. Modules that have both
forms of a stage ask `compiled` once, when they are loaded or a stage is set up. What a function of
the kernel takes stands before its body in kernel/module*.c; another array or number raises.
"""

from __future__ import annotations

import os
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeVar

from .errors import ParameterError

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

Function = TypeVar("Function", bound="Callable[..., Any]")

VARIABLE = "TACTILE_CDMA_KERNEL"
"""Environment variable: numpy or compiled; unset or empty for compiled where there is one."""
VERSION = 34
"""Version of the functions that this package expects in the kernel."""


def _choose(wanted: str) -> tuple[ModuleType | None, str]:
    """Return the kernel, None for numpy; and why numpy. Raises ParameterError."""
    if wanted not in ("", "numpy", "compiled"):
        raise ParameterError(
            f"{VARIABLE} is {wanted!r}; it must be numpy, compiled or empty (compiled where the "
            "kernel was built)"
        )
    if wanted == "numpy":
        return None, f"{VARIABLE} is numpy"
    try:
        module = import_module("tactile_cdma._kernel")
        reason = ""
        if module.VERSION != VERSION:
            reason = (
                f"the kernel is of version {module.VERSION}, and this package needs {VERSION}: one "
                "of them is older"
            )
    except ImportError as error:
        reason = f"the kernel was not built for this Python, or does not load ({error})"
    if reason and wanted == "compiled":
        raise ParameterError(f"{VARIABLE} is compiled, but {reason}")
    return (None, reason) if reason else (module, "")


compiled, why_numpy = _choose(os.environ.get(VARIABLE, ""))
"""The kernel's module, None where numpy is used; and why, "" where it is not."""


def either(name: str, reference: Function) -> Function:
    """Return the kernel's function of this name; where there is no kernel, the same in numpy."""
    chosen: Function = reference if compiled is None else getattr(compiled, name)
    return chosen


def settings(struct: str, **fields: float) -> NDArray[np.void]:
    """Fill one of the kernel's C structs by the names of its members; () of its dtype.

    For functions of the kernel that take SETTINGS(struct). Raises TypeError unless exactly its
    members are given.
    """
    import numpy as np  # here: the doctor asks for the kernel where numpy is missing

    assert compiled is not None
    size, members = compiled.STRUCTS[struct]
    names, offsets, formats = zip(*members, strict=True)
    if fields.keys() != set(names):
        wrong = ", ".join(sorted(fields.keys() ^ set(names)))
        raise TypeError(f"struct {struct} of the kernel: missing or unknown: {wrong}")
    dtype = np.dtype(
        {"names": names, "formats": formats, "offsets": offsets, "itemsize": size}, align=False
    )
    return np.array(tuple(fields[name] for name in names), dtype)
