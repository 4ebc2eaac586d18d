# SPDX-License-Identifier: Apache-2.0

"""When what many senders bring, each at a pace of its own, goes out as one."""

from __future__ import annotations

import math
from collections.abc import Iterable


class Rounds:
    """News gathered in rounds. A sender that was heard within silent_after_s, s, is present.

    A round is over when everybody who is present has brought news, or when somebody is about to
    bring news for the second time. So every message of the quickest sender is in a round of its
    own, none waits longer than that sender's period, and rounds come about as often.
    """

    def __init__(self, silent_after_s: float) -> None:
        self.silent_after_s = silent_after_s
        self._heard_s: dict[str, float] = {}
        self._news: set[str] = set()

    def is_due_before(self, sender: str) -> bool:
        """Whether the round is over before this sender's next news is taken."""
        return sender in self._news

    def add(self, sender: str, now_s: float) -> bool:
        """Take news of a sender; returns whether the round is over with it."""
        self._heard_s[sender] = now_s
        self._news.add(sender)
        return self._news.issuperset(self.present(self._heard_s, now_s))

    def end(self) -> None:
        """The round is out; the next begins."""
        self._news.clear()

    def present(self, senders: Iterable[str], now_s: float) -> list[str]:
        """Those of the senders that were heard lately, in the same order."""
        return [name for name in senders if self.silence_s(name, now_s) <= self.silent_after_s]

    def silence_s(self, sender: str, now_s: float) -> float:
        """How long a sender has been silent; infinite if it was never heard."""
        return now_s - self._heard_s.get(sender, -math.inf)

    def forget(self) -> None:
        """Nobody was ever heard."""
        self._heard_s.clear()
        self._news.clear()
