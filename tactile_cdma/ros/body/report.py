# SPDX-License-Identifier: Apache-2.0

"""The body node's entry in /diagnostics: the state of its patches."""

import math
from collections.abc import Mapping

from diagnostic_msgs.msg import DiagnosticStatus

from ...base.text import listed
from ..common.convert import diagnostic
from ..common.failures import FAILED, FAILURES
from .patch_feed import PatchFeed

STAMPS_OFF_S = 0.5
"""A frame whose stamp is off by this, s, is not from now; chosen above what frames take to come."""
AHEAD_S = 5e-3
"""A message that arrives so long before it was sent, s, means a clock that is ahead. Chosen above
what chrony leaves on Wi-Fi; a sound clock cannot do that, however slow the network."""
BEHIND_S = 30e-3
"""A message that takes so long, s, means a clock that is behind or a slow network. Chosen above the
quickest message of a second on a sound Wi-Fi, a few ms."""


def body_report(
    name: str,
    feeds: Mapping[str, PatchFeed],
    faults: Mapping[str, str],
    stale_after_s: float,
    now_s: float,
) -> list[DiagnosticStatus]:
    """The entries `<node>: patches` and `<node>: host`.

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
    prefix, failed = name.lstrip("/"), {FAILED: FAILURES.count}
    return [
        diagnostic(f"{prefix}: patches", level, text, values),
        diagnostic(f"{prefix}: host", DiagnosticStatus.OK, "ok", failed),
    ]


def _judged(feed: PatchFeed, fault: str, stale_after_s: float, now_s: float) -> tuple[str, str]:
    """What is wrong and what to do, empty if nothing is; and what a patch in order shows."""
    if not feed.is_followed:
        return "", "its driver is there" if feed.has_driver else "its driver was not seen yet"
    coverage, rate_hz, underway_s = feed.coverage, feed.rate_hz(now_s), feed.underway_s()
    silent_s, late_s = feed.silent_s(now_s), feed.late_s()
    silent = silent_s > stale_after_s
    since = f" for {silent_s:.0f} s" if silent_s < math.inf else ""
    in_service = coverage.in_service if coverage else 0
    wrongs = (
        (
            silent and not feed.has_driver,
            "no driver: does it run, in this ROS domain, on a computer that is discovered?",
        ),
        (
            silent,
            f"its driver is there, but silent{since}: its own entries here say why; if those stay "
            "away, too, the network to its computer is cut",
        ),
        (bool(fault), fault),
        (
            coverage is not None and not coverage.valid,
            f"none of its {in_service} taxels in service has a valid reading: its own entry "
            "'nodes' here says why",
        ),
        (
            underway_s < -AHEAD_S,
            f"the clock of its computer is ahead of this one's by {-underway_s:.3f} s and the time "
            "that messages take: have both computers follow one time server",
        ),
        (
            underway_s > BEHIND_S,
            f"its messages take {underway_s:.3f} s by the computers' clocks: that of its computer "
            "is behind this one's, or the network is slow (ping tells)",
        ),
        (
            abs(late_s) > STAMPS_OFF_S,
            f"its stamps are {late_s:+.1f} s off this computer's time: is use_sim_time the same "
            "for both, or is a computer too busy?",
        ),
    )
    complaint = next((text for is_wrong, text in wrongs if is_wrong), "")
    state = f"{rate_hz:.1f} Hz"
    if math.isfinite(underway_s):
        state += f", {underway_s * 1e3:.0f} ms on the way"
    if coverage and not coverage.is_whole:
        state += f", {coverage.valid} of {coverage.in_service} taxels valid"
    return complaint, state
