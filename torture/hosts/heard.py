# SPDX-License-Identifier: Apache-2.0

"""A message as it arrived at a host."""

from __future__ import annotations

from dataclasses import dataclass, field

BODY = "/body"
ARRAYS, CONTACTS, BODY_CONTACTS, REPORTS = "tactile", "contacts", "body", "reports"
"""Kinds of messages; the first two are topics of the patches' drivers, too."""


@dataclass(frozen=True, slots=True)
class Heard:
    """A message.

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
