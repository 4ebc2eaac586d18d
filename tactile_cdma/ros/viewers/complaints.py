# SPDX-License-Identifier: Apache-2.0

"""Keeps a node's entries of /diagnostics, for programs that show them."""

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from ...base.text import plain

LEVELS = {
    DiagnosticStatus.OK: "OK",
    DiagnosticStatus.STALE: "STALE",
    DiagnosticStatus.WARN: "WARN",
    DiagnosticStatus.ERROR: "ERROR",
}
"""Names of the levels, in rising order of severity."""
_BADNESS = list(LEVELS)
MOST_ENTRIES = 32
"""Entries kept of a node, which has a handful: anybody may publish under its name. Chosen."""


class Complaints:
    """The newest version of every entry of one node."""

    def __init__(self, node: str) -> None:
        """node: its name without the leading slash."""
        self._prefix = f"{node}:"
        self._entries: dict[str, DiagnosticStatus] = {}

    def take(self, message: DiagnosticArray) -> list[DiagnosticStatus]:
        """Take the node's entries from a message; returns those whose level or text changed.

        Entries that no driver makes are ignored: of unknown levels, or too many.
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
        """Return the entries that are not OK, the worst first."""
        bad = [status for status in self._entries.values() if status.level != DiagnosticStatus.OK]
        return sorted(bad, key=lambda status: -_BADNESS.index(status.level))

    @property
    def worst(self) -> str:
        """Return the text of the worst entry; empty if all are OK."""
        return next((status.message for status in self.worst_first()), "")
