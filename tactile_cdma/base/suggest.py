# SPDX-License-Identifier: Apache-2.0

"""What a misspelt name was meant to be."""

from collections.abc import Iterable
from difflib import get_close_matches


def closest(name: str, known: Iterable[str], alike: float = 0.6) -> str | None:
    """The known name that resembles one most; None where none is as much alike, 0…1 (difflib)."""
    return next(iter(get_close_matches(name.lower(), list(known), n=1, cutoff=alike)), None)


def suggestion(name: str, known: Iterable[str], otherwise: str = "", alike: float = 0.6) -> str:
    """The end of a message about an unknown name: "; did you mean 'nodes'?", else "; otherwise"."""
    near = closest(name, known, alike)
    hint = f"did you mean {near!r}?" if near else otherwise
    return hint and f"; {hint}"
