# SPDX-License-Identifier: Apache-2.0

"""What /diagnostics says of drivers, for those who show it."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from ...base.plain_text import plain

LEVELS = {
    DiagnosticStatus.OK: "OK",
    DiagnosticStatus.STALE: "STALE",
    DiagnosticStatus.WARN: "WARN",
    DiagnosticStatus.ERROR: "ERROR",
}
"""From good to bad."""
_BADNESS = list(LEVELS)
MOST_ENTRIES = 32
"""Of one node, which has a handful: anybody may publish under its name."""


class Complaints:
    """The newest of every entry of one node. node: its name without the leading slash."""

    def __init__(self, node: str) -> None:
        self._prefix = f"{node}:"
        self._entries: dict[str, DiagnosticStatus] = {}

    def take(self, message: DiagnosticArray) -> list[DiagnosticStatus]:
        """Take the node's entries out of a message; returns those whose level or text changed.

        Such as no driver of ours makes, of other levels or too many, are left out.
        """
        changed = []
        for status in message.status:
            if not status.name.startswith(self._prefix) or status.level not in LEVELS:
                continue
            status.name, status.message = plain(status.name), plain(status.message)
            before = self._entries.get(status.name)
            if before is None and len(self._entries) == MOST_ENTRIES:
                continue
            if before is None or (before.level, before.message) != (status.level, status.message):
                changed.append(status)
            self._entries[status.name] = status
        return changed

    def worst_first(self) -> list[DiagnosticStatus]:
        """The entries that are not OK."""
        bad = [status for status in self._entries.values() if status.level != DiagnosticStatus.OK]
        return sorted(bad, key=lambda status: -_BADNESS.index(status.level))
