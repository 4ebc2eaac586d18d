# SPDX-License-Identifier: Apache-2.0

"""Text of strangers as terminals and logs may show it."""

from __future__ import annotations

MOST_SHOWN = 4000
"""Characters; somebody may name a parameter with a megabyte."""


def plain(text: str) -> str:
    """What cannot be printed is escaped, line feeds and turns of direction too; the rest is cut."""
    shown = text if len(text) <= MOST_SHOWN else text[: MOST_SHOWN - 1] + "…"
    if shown.isprintable():
        return shown
    escaped = (c if c.isprintable() else c.encode("unicode_escape").decode() for c in shown)
    return "".join(escaped)[:MOST_SHOWN]
