# SPDX-License-Identifier: Apache-2.0

"""Text for people: untrusted text made safe, lists, and what a misspelt name was meant to be."""

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from difflib import get_close_matches
from typing import TypeVar

Item = TypeVar("Item")
MOST_SHOWN = 4000
"""Characters; chosen to bound logs: a parameter's name may have a megabyte."""

_END_OF_LINE, _BLOCK = re.compile("\r\n?|\n"), 1 << 16
"""Where a text is cut into blocks of lines, and their least characters; chosen."""


def plain(text: str) -> str:
    """Escape what is not printable (line feeds, changes of direction, too); cut at MOST_SHOWN."""
    return escaped(text if len(text) <= MOST_SHOWN else text[: MOST_SHOWN - 1] + "…")[:MOST_SHOWN]


def escaped(text: str) -> str:
    """Escape what is not printable."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def lines_of(text: str) -> Iterator[str]:
    """Yield what splitlines() gives, of which a list takes ten times as much memory as the text."""
    begin = 0
    while begin < len(text):
        end_of_line = _END_OF_LINE.search(text, begin + _BLOCK)
        end = end_of_line.end() if end_of_line else len(text)
        yield from text[begin:end].splitlines()
        begin = end


def plain_lines(text: str) -> str:
    """Do the same to every line of a text that has several, such as the trace of an exception."""
    return "\n".join(map(plain, text.splitlines()))


def listed(
    items: Sequence[Item], noun: str = "", most: int = 20, show: Callable[[Item], str] = str
) -> str:
    """List items: "3, 4, 9"; with the noun "node", "node 3" or "nodes 3, 4 and 12 more".

    most: items to show. show: returns the text of one.
    """
    text = ", ".join(map(show, items[:most]))
    if len(items) > most:
        text += f" and {len(items) - most} more"
    return f"{noun}{'s' * (len(items) != 1)} {text}" if noun else text


def closest(name: str, known: Iterable[str], alike: float = 0.6) -> str | None:
    """Find the known name that resembles one most; None if none is as much alike, 0…1 (difflib)."""
    return next(iter(get_close_matches(name.lower(), list(known), n=1, cutoff=alike)), None)


def suggestion(name: str, known: Iterable[str], otherwise: str = "", alike: float = 0.6) -> str:
    """End a message about an unknown name: "; did you mean 'nodes'?", else "; otherwise"."""
    near = closest(name, known, alike)
    hint = f"did you mean {near!r}?" if near else otherwise
    return hint and f"; {hint}"
