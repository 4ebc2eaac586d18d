# SPDX-License-Identifier: Apache-2.0

"""Compares what the body said, and what arrived, with what the patches' own hosts heard."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

BODY = "/body"
ARRAYS, CONTACTS, BODY_CONTACTS, REPORTS = "tactile", "contacts", "body", "reports"
"""Kinds of messages; the first two are topics of the patches' drivers, too."""
SLACK_S = 1.0
"""How much older than stale_after_s a body's data may be: it looks every 0.2 s at who is silent,
messages are under way, and on a busy machine they wait for its turn. Chosen above all that."""


@dataclass(frozen=True, slots=True)
class Heard:
    """A message as it arrived at a host.

    kind: ARRAYS, CONTACTS, BODY_CONTACTS or REPORTS. patch: the node of its driver, or the body.
    sent_s: when it was sent, monotonic, the same on all hosts; true if its sender's clock is the
    listener's. sent_ns: that on the sender's clock, by which all listeners know it. age_s: arrival
    minus stamp, on the listener's clock. said: of REPORTS, the body's words on each patch. Others:
    as in the message.
    """

    kind: str
    patch: str
    sent_s: float
    sent_ns: int = 0
    sequence: int = 0
    age_s: float = 0.0
    touched: bool = False
    untouched: bool = False
    absent: list[str] = field(default_factory=list)
    said: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Arrivals:
    """Messages of one kind that arrived, and the losses that their sequence shows.

    disordered: messages that came twice or after a later one.
    """

    arrived: int
    lost: int
    disordered: int
    ages_ms: Sequence[float]

    @property
    def sent(self) -> int:
        """Messages sent, from the first one that arrived to the last one."""
        return self.arrived + self.lost

    def age_ms(self, percent: float) -> float:
        """A percentile of the ages on arrival, ms; NaN without any."""
        return float(np.percentile(self.ages_ms, percent)) if self.ages_ms else math.nan


def arrivals(kind: str, patch: str, heard: Iterable[Heard]) -> Arrivals:
    """What came of the messages of one kind."""
    came = [h for h in heard if (h.kind, h.patch) == (kind, patch)]
    steps = [after.sequence - before.sequence for before, after in pairwise(came)]
    return Arrivals(
        len(came),
        sum(step - 1 for step in steps if step > 0),
        sum(step <= 0 for step in steps),
        [1e3 * h.age_s for h in came],
    )


def untold(patch: str, truth: Iterable[Heard], heard: Iterable[Heard]) -> int:
    """Messages of a patch's contacts that were lost without a gap in the sequence.

    Between any two that arrived, no more may have been sent than the gap between them says. A
    message is known by when it was sent, whatever its number. Fewer are no fault: on a busy
    machine the truth may lack some itself, or not have come yet.
    """
    known = [h.sent_ns for h in truth if (h.kind, h.patch) == (CONTACTS, patch)]
    place = {sent_ns: number for number, sent_ns in enumerate(known)}  # a clock may be set back
    came = [h for h in heard if (h.kind, h.patch) == (CONTACTS, patch)]
    found = 0
    for before, after in pairwise(came):
        if before.sent_ns in place and after.sent_ns in place:
            steps = place[after.sent_ns] - place[before.sent_ns]
            found += max(0, steps - (after.sequence - before.sequence))
    return found


def false_claims(
    truth: Sequence[Heard],
    body: Iterable[Heard],
    patches: Iterable[str],
    oldest_s: float,
) -> list[Heard]:
    """The body's messages that say touched or untouched where it cannot know that.

    It may know what a patch's own host heard within oldest_s (s) before the message. "Untouched"
    needs such a frame of every patch that was untouched, "touched" one of any that was touched.
    """
    frames = [h for h in truth if h.kind == CONTACTS]
    untouched_s = [[f.sent_s for f in frames if f.patch == p and f.untouched] for p in patches]
    touched_s = sorted(f.sent_s for f in frames if f.touched)

    def was(times_s: Sequence[float], t_s: float) -> bool:
        return bisect_left(times_s, t_s - oldest_s) < bisect_right(times_s, t_s)

    return [
        message
        for message in body
        if message.kind == BODY_CONTACTS
        and (
            (message.untouched and not all(was(times_s, message.sent_s) for times_s in untouched_s))
            or (message.touched and not was(touched_s, message.sent_s))
        )
    ]


def deaf_claims(
    body: Iterable[Heard], cut: Iterable[str], begin_s: float, end_s: float, oldest_s: float
) -> list[Heard]:
    """The body's messages in a cut that claim to know of patches behind it.

    They do not list one as absent, or say that nothing touches the body. Those of the first
    oldest_s are excepted: a patch that was just heard is there.
    """
    return [
        message
        for message in body
        if message.kind == BODY_CONTACTS
        and begin_s + oldest_s < message.sent_s < end_s
        and (message.untouched or not set(cut).issubset(message.absent))
    ]
