# SPDX-License-Identifier: Apache-2.0

"""The body node's entry in /diagnostics: the state of its patches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticStatus

from ...base.listing import listed
from ..common.convert import diagnostic

CLOCKS_APART_S = 0.5
"""A message of this age, s, or from so far in the future, means clocks that disagree; chosen above
every delay of transport."""


@dataclass(frozen=True, slots=True)
class PatchState:
    """How one patch is received.

    has_driver: somebody publishes its topics. followed: it is subscribed to. silent_s: time since
    its last message, s. late_s: least age of a message on arrival, s. rate_hz: of its messages.
    fault: why its frame is unknown in the body's; empty: it is known.
    """

    name: str
    has_driver: bool
    followed: bool
    silent_s: float
    late_s: float
    rate_hz: float
    fault: str

    def complaint(self, stale_after_s: float) -> str:
        """What is wrong and what to do; empty if nothing is, or nobody subscribes."""
        if not self.followed:
            return ""
        if self.silent_s > stale_after_s and not self.has_driver:
            return "no driver: does it run, in this ROS domain, on a computer that is discovered?"
        if self.silent_s > stale_after_s:
            return "its driver is there, but silent: its own entries here say why"
        if self.fault:
            return self.fault
        if abs(self.late_s) > CLOCKS_APART_S:
            return (
                f"its stamps are {self.late_s:+.1f} s off this computer's clock: have both "
                "computers follow one time server, or is this one too busy?"
            )
        return ""


def body_status(name: str, patches: Sequence[PatchState], stale_after_s: float) -> DiagnosticStatus:
    """The entry `<node>: patches`. name: fully qualified name of the body node."""
    complaints = {patch.name: patch.complaint(stale_after_s) for patch in patches}
    wrong = [patch for patch, complaint in complaints.items() if complaint]
    level, text = DiagnosticStatus.OK, f"all {len(patches)} patches are there"
    if wrong:
        level = DiagnosticStatus.ERROR if len(wrong) == len(patches) else DiagnosticStatus.WARN
        text = f"{listed(wrong)}: {complaints[wrong[0]]}"
    elif not any(patch.followed for patch in patches):
        text = "nobody subscribes to the body's topics"
    values = {patch.name: complaints[patch.name] or _in_order(patch) for patch in patches}
    return diagnostic(f"{name.lstrip('/')}: patches", level, text, values)


def _in_order(patch: PatchState) -> str:
    if patch.followed:
        return f"{patch.rate_hz:.1f} Hz"
    return "its driver is there" if patch.has_driver else "its driver was not seen yet"
