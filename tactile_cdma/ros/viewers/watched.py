# SPDX-License-Identifier: Apache-2.0

"""What viewers keep of a driver they watch: rate, losses and age of messages; its diagnostics."""

from collections import deque

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from ...base.text import plain

RATE_SPAN_S = 3.0
"""Time over which the present rate is taken, s; chosen: steady to read, quick to follow."""


class Tally:
    """Counts messages. Latency is a message's age on arrival, from the middle of its frame on.

    published: frames that the driver counted from the first to the last one received, over all its
    runs.
    """

    def __init__(self) -> None:
        self.received = 0
        self.published = 0
        self.latency_ms: deque[float] = deque(maxlen=100_000)
        self._run: tuple[int, int] | None = None  # info_id and sequence of the last message
        self._arrivals_s: deque[float] = deque(maxlen=512)
        self._begin_s = self._end_s = 0.0
        self._first_age_s = self._least_age_s = 0.0

    def add(self, info_id: int, sequence: int, age_s: float, now_s: float) -> None:
        continues = self._run is not None and self._run[0] == info_id and sequence > self._run[1]
        self.published += sequence - self._run[1] if continues and self._run else 1
        self._run = (info_id, sequence)
        if not self.received:
            self._begin_s, self._first_age_s, self._least_age_s = now_s, age_s, age_s
        self._least_age_s = min(self._least_age_s, age_s)
        self.received += 1
        self.latency_ms.append(age_s * 1e3)
        self._arrivals_s.append(now_s)

    @property
    def lost(self) -> int:
        return self.published - self.received

    def end(self, now_s: float) -> None:
        """End the time that mean_rate_hz is taken over."""
        self._end_s = now_s

    @property
    def mean_rate_hz(self) -> float:
        """Return messages per second from the first one to the end.

        The first often takes longer than the others: time counts from when it could have arrived.
        """
        span_s = self._end_s - self._begin_s + self._first_age_s - self._least_age_s
        return (self.received - 1) / span_s if self.received > 1 else 0.0

    def rate_hz(self, now_s: float) -> float:
        recent = [t for t in self._arrivals_s if now_s - t < RATE_SPAN_S]
        span = now_s - recent[0] if len(recent) > 1 else 0.0
        return (len(recent) - 1) / span if span > 0 else 0.0

    def percentile_ms(self, percent: float, last: int | None = None) -> float:
        """Return a percentile of the latency, ms, over all or the last few messages."""
        values = list(self.latency_ms)[-last:] if last else self.latency_ms
        return float(np.percentile(values, percent)) if values else float("nan")


def summary(tally: Tally) -> str:
    """Return a viewer's last line, `key=value` pairs."""
    return (
        f"published={tally.published} received={tally.received} lost={tally.lost} "
        f"rate_hz={tally.mean_rate_hz:.2f} p50_ms={tally.percentile_ms(50):.2f} "
        f"p99_ms={tally.percentile_ms(99):.2f}"
    )


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
