# SPDX-License-Identifier: Apache-2.0

"""Packages that only some commands need: where one is missing, one clear error says so."""

from collections.abc import Iterator
from contextlib import contextmanager

from .errors import MissingPackageError


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
