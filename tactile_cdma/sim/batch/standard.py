# SPDX-License-Identifier: Apache-2.0

"""The array API standard: one set of functions for numpy, torch, JAX and others."""

from typing import Any

from ...base.optional import needed_for

Array = Any
"""Of a library that follows the standard."""


def array_api() -> Any:
    """The module array_api_compat; raises MissingPackageError."""
    with needed_for("SkinBatch", "array_api_compat"):
        import array_api_compat
    return array_api_compat
