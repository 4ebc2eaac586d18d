# SPDX-License-Identifier: Apache-2.0

"""The body node's entry in /diagnostics: the state of its patches."""

import math

from diagnostic_msgs.msg import DiagnosticStatus

from ...base.text import listed
from ..common.convert import diagnostic
from ..common.failures import FAILED, FAILURES
from .patches import Arrivals, Patches

STAMPS_OFF_S = 0.5
"""A frame whose stamp is off by this, s, is not from now; chosen above what frames take to come."""
AHEAD_S = 5e-3
"""A message that arrives so long before it was sent, s, means a clock that is ahead. Chosen above
what chrony leaves on Wi-Fi; a sound clock cannot do that, however slow the network."""
BEHIND_S = 30e-3
"""A message that takes so long, s, means a clock that is behind or a slow network. Chosen above the
quickest message of a second on a sound Wi-Fi, a few ms."""


def body_report(
    name: str, patches: Patches, is_followed: bool, now_s: float
) -> list[DiagnosticStatus]:
    """Make the entries `<node>: patches` and `<node>: host`.

    name: fully qualified name of the body node. is_followed: messages are subscribed to.
    """
    stale_after_s = patches.values["stale_after_s"]
    complaints, values = dict[str, str](), dict[str, str]()
    for patch, arrivals in patches.arrivals.items():
        if is_followed:
            fault = patches.faults.get(patch, "")
            complaint, values[patch] = _judged(arrivals, fault, stale_after_s, now_s)
            if complaint:
                complaints[patch] = values[patch] = complaint
        else:
            seen = "is there" if arrivals.has_driver else "was not seen yet"
            values[patch] = f"its driver {seen}"
    level, text = DiagnosticStatus.OK, f"all {len(values)} patches are there"
    if complaints:
        is_all = len(complaints) == len(values)
        level = DiagnosticStatus.ERROR if is_all else DiagnosticStatus.WARN
        text = f"{listed(list(complaints))}: {next(iter(complaints.values()))}"
    elif not is_followed:
        text = "nobody subscribes to the body's topics"
    prefix, failed = name.lstrip("/"), {FAILED: FAILURES.count}
    return [
        diagnostic(f"{prefix}: patches", level, text, values),
        diagnostic(f"{prefix}: host", DiagnosticStatus.OK, "ok", failed),
    ]


def _judged(arrivals: Arrivals, fault: str, stale_after_s: float, now_s: float) -> tuple[str, str]:
    """Say what is wrong with a patch and what to do, empty if nothing is; and how it arrives.

    fault: why its frame is unknown in the body's.
    """
    silent_s, coverage = arrivals.silent_s(now_s), arrivals.coverage
    late_s, underway_s = arrivals.late_s(), arrivals.underway_s()
    rate_hz = arrivals.rate_hz(now_s)
    state = f"{rate_hz:.1f} Hz"
    if math.isfinite(underway_s):
        state += f", {underway_s * 1e3:.0f} ms on the way"
    if coverage and not coverage.is_whole:
        state += f", {coverage.valid} of {coverage.in_service} taxels valid"
    silent, since = silent_s > stale_after_s, f" for {silent_s:.0f} s" * math.isfinite(silent_s)
    complaints = (
        (
            silent and not arrivals.has_driver,
            "no driver: does it run, in this ROS domain, on a computer that is discovered?",
        ),
        (
            silent,
            f"its driver is there, but silent{since}: its own entries here say why; if those stay "
            "away, too, the network to its computer is cut",
        ),
        (fault, fault),
        (
            coverage and not coverage.valid,
            f"none of its {coverage and coverage.in_service} taxels in service has a valid "
            "reading: its own entry 'nodes' here says why",
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
        (not rate_hz and arrivals.refused, f"what comes is not used: {arrivals.refused}"),
    )
    return next((text for applies, text in complaints if applies), ""), state
