# SPDX-License-Identifier: Apache-2.0

"""Combines messages of many senders, each at its own rate, into rounds that are published once."""

import math
from collections.abc import Iterable


class Rounds:
    """Messages collected in rounds. A sender heard within the last silent_after_s (s) is present.

    A round ends when every present sender has sent, or when one is about to send a second time. So
    each message of the fastest sender has a round of its own, no message waits longer than that
    sender's period, and rounds come about as often as its messages.
    """

    def __init__(self, silent_after_s: float) -> None:
        self.silent_after_s = silent_after_s
        self._heard_s: dict[str, float] = {}
        self._news: set[str] = set()

    def is_due_before(self, sender: str) -> bool:
        """Tell whether the round ends before this sender's next message is added."""
        return sender in self._news

    def add(self, sender: str, now_s: float) -> bool:
        """Add a sender's message; returns whether this completes the round."""
        self._heard_s[sender] = now_s
        self._news.add(sender)
        return self._news.issuperset(self.present(self._heard_s, now_s))

    def end(self) -> None:
        self._news.clear()

    def present(self, senders: Iterable[str], now_s: float) -> list[str]:
        """Return the senders that are present, in the given order."""
        heard_s = self._heard_s
        return [n for n in senders if now_s - heard_s.get(n, -math.inf) <= self.silent_after_s]

    def forget(self) -> None:
        """Start over, with no sender heard."""
        self._heard_s.clear()
        self._news.clear()
