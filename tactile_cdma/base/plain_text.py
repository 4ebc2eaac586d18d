# SPDX-License-Identifier: Apache-2.0

"""Untrusted text made safe for terminals and logs."""

MOST_SHOWN = 4000
"""Characters; chosen to bound logs: a parameter's name may have a megabyte."""


def plain(text: str) -> str:
    """Escape what is not printable (line feeds, changes of direction, too); cut at MOST_SHOWN."""
    shown = text if len(text) <= MOST_SHOWN else text[: MOST_SHOWN - 1] + "…"
    if shown.isprintable():
        return shown
    escaped = (c if c.isprintable() else c.encode("unicode_escape").decode() for c in shown)
    return "".join(escaped)[:MOST_SHOWN]


def plain_lines(text: str) -> str:
    """The same of every line of a text that has several, such as the trace of an exception."""
    return "\n".join(map(plain, text.splitlines()))
