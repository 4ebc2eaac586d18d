# SPDX-License-Identifier: Apache-2.0

"""The body node's entry in /diagnostics: the state of its patches."""

from __future__ import annotations

from collections.abc import Mapping

from diagnostic_msgs.msg import DiagnosticStatus

from ...base.listing import listed
from ..common.convert import diagnostic
from .patch_feed import PatchFeed

CLOCKS_APART_S = 0.5
"""A message of this age, s, or from so far in the future, means clocks that disagree; chosen above
every delay of transport."""


def body_status(
    name: str,
    feeds: Mapping[str, PatchFeed],
    faults: Mapping[str, str],
    stale_after_s: float,
    now_s: float,
) -> DiagnosticStatus:
    """The entry `<node>: patches`.

    name: fully qualified name of the body node. faults: why a patch's frame is unknown in the
    body's, by patch.
    """
    judged = {
        patch: _judged(feed, faults.get(patch, ""), stale_after_s, now_s)
        for patch, feed in feeds.items()
    }
    wrong = {patch: complaint for patch, (complaint, _) in judged.items() if complaint}
    level, text = DiagnosticStatus.OK, f"all {len(feeds)} patches are there"
    if wrong:
        level = DiagnosticStatus.ERROR if len(wrong) == len(feeds) else DiagnosticStatus.WARN
        text = f"{listed(list(wrong))}: {next(iter(wrong.values()))}"
    elif not any(feed.is_followed for feed in feeds.values()):
        text = "nobody subscribes to the body's topics"
    values = {patch: complaint or state for patch, (complaint, state) in judged.items()}
    return diagnostic(f"{name.lstrip('/')}: patches", level, text, values)


def _judged(feed: PatchFeed, fault: str, stale_after_s: float, now_s: float) -> tuple[str, str]:
    """What is wrong and what to do, empty if nothing is; and what a patch in order shows."""
    silent, coverage = feed.silent_s(now_s) > stale_after_s, feed.coverage
    late_s, rate_hz = feed.late_s(), feed.rate_hz(now_s)
    if not feed.is_followed:
        return "", "its driver is there" if feed.has_driver else "its driver was not seen yet"
    complaint = fault
    if silent and not feed.has_driver:
        complaint = "no driver: does it run, in this ROS domain, on a computer that is discovered?"
    elif silent:
        complaint = "its driver is there, but silent: its own entries here say why"
    elif not fault and coverage and not coverage.valid:
        complaint = (
            f"none of its {coverage.in_service} taxels in service has a valid reading: its own "
            "entry 'nodes' here says why"
        )
    elif not fault and abs(late_s) > CLOCKS_APART_S:
        complaint = (
            f"its stamps are {late_s:+.1f} s off this computer's clock: have both computers "
            "follow one time server, or is this one too busy?"
        )
    state = f"{rate_hz:.1f} Hz"
    if coverage and not coverage.is_whole:
        state += f", {coverage.valid} of {coverage.in_service} taxels valid"
    return complaint, state
