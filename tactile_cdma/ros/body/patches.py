# SPDX-License-Identifier: Apache-2.0

"""The patches of a body: where they are, how messages arrive, what /diagnostics say of them."""

import math
import time
from collections.abc import Iterable

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node

from ...base.errors import TransformError
from ...base.text import listed
from ...config.parameters import Values
from ...messages.cdr import Heading, TaxelArray
from ...places.poses import Pose
from ...readings.taxels import Coverage
from ..common.convert import diagnostic
from ..common.failures import FAILED, FAILURES
from ..common.touches import Touches
from ..common.transforms import TransformListener

MessageInfo = dict[str, int]
"""What the middleware knows of a message: source_timestamp, received_timestamp, ns."""


class Arrivals:
    """Measures how the messages of one patch arrive.

    latest: the newest message; None before the first one. refused: why it is not of now; empty if
    it is.
    """

    def __init__(self, node: Node, node_name: str) -> None:
        """node_name: fully qualified name of the patch's driver."""
        self.latest: Touches | TaxelArray | None = None
        self.refused = ""
        self._node, self._node_name = node, node_name
        self._heard_s, self._stamp_ns = -math.inf, 0
        self._late_s = self._underway_s = math.inf
        self._settles = False  # ROS time has just stepped back
        self._counted, self._reported_s = 0, -math.inf

    def add(self, message: Touches | TaxelArray, info: MessageInfo, refused: str) -> None:
        """Take note of a message that has just come. refused: why it is not used, if it is not."""
        self.latest, stamp_ns = message, message.heading.stamp_ns
        self.refused = "" if math.isnan(self._late_s) else refused  # see step_back
        if not refused:
            self._counted += stamp_ns > self._stamp_ns  # once per frame, not per topic
            self._stamp_ns = stamp_ns
        self._heard_s = time.monotonic()
        age_ns = self._node.get_clock().now().nanoseconds - stamp_ns
        self._late_s = min(self._late_s, age_ns * 1e-9)
        sent_ns, received_ns = info["source_timestamp"], info["received_timestamp"]
        if sent_ns and received_ns:  # 0 where the middleware does not tell
            self._underway_s = min(self._underway_s, (received_ns - sent_ns) * 1e-9)

    def silent_s(self, now_s: float) -> float:
        """Return the time since the last message, s; infinite if there was none."""
        return now_s - self._heard_s

    def late_s(self) -> float:
        """Return the least age of a message on arrival since the last call, s; 0 if none arrived.

        The least, because a busy computer takes some messages late, but not all.
        """
        late_s, self._late_s = self._late_s, math.nan if self._settles else math.inf
        self._settles = False
        return late_s if late_s < math.inf else 0.0

    def step_back(self) -> None:
        """ROS time has stepped back, as where a bag begins anew: no stamp counts as off for now.

        Until late_s was asked twice: messages of before may still come after the first time.
        """
        self._late_s, self._stamp_ns, self._settles = math.nan, 0, True

    def underway_s(self) -> float:
        """Return the least time that a message took since the last call, s; NaN if unknown.

        From its sending, by the clock of its driver's computer, to its arrival, by the clock of
        this one: delay of the network plus offset of the clocks. The least, because the network
        delays some messages more than others.
        """
        underway_s, self._underway_s = self._underway_s, math.inf
        return underway_s if underway_s < math.inf else math.nan

    def rate_hz(self, now_s: float) -> float:
        """Return the rate of the frames received since the last call, but for refused ones."""
        rate_hz = self._counted / (now_s - self._reported_s)
        self._counted, self._reported_s = 0, now_s
        return rate_hz

    @property
    def coverage(self) -> Coverage | None:
        """Tell how much of the patch its latest message is of; None without any."""
        if isinstance(self.latest, Touches):
            return Coverage(self.latest.taxels_valid, self.latest.taxels_in_service)
        return self.latest and Coverage.of(self.latest.pressure_pa, self.latest.status)

    @property
    def has_driver(self) -> bool:
        """Tell whether anybody publishes its topics.

        With a discovery server, only topics that are subscribed to are known.
        """
        topics = (f"{self._node_name}/{topic}" for topic in ("contacts", "tactile"))
        return any(map(self._node.count_publishers, topics))


class Patches:
    """The patches of a body, by the fully qualified names of their drivers.

    faults: why a patch's frame is not known in the body's.
    """

    def __init__(self, node: Node, names: Iterable[str], values: Values) -> None:
        self.values = values
        self.arrivals = {name: Arrivals(node, name) for name in names}
        self.faults: dict[str, str] = {}
        self.node, self._transforms = node, TransformListener(node)
        self.follow_transforms = self._transforms.follow

    def pose(self, name: str, message: Touches | TaxelArray | None) -> Pose | None:
        """Find the pose in the body of what a patch sent; None, noting the fault, if unknown."""
        if message is None:
            return None
        try:
            pose = self._transforms.tree.pose(self.values["frame_id"], message.heading.frame_id)
        except TransformError as error:
            self.faults[name] = str(error)
            return None
        self.faults.pop(name, None)
        return pose

    def heading(self, messages: Iterable[Touches | TaxelArray]) -> Heading:
        """Return a heading with the newest stamp; with the present time if there is none."""
        stamps_ns = [message.heading.stamp_ns for message in messages]
        newest_ns = max(stamps_ns) if stamps_ns else self.node.get_clock().now().nanoseconds
        return Heading(newest_ns, self.values["frame_id"])


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
    complaints = {
        "no driver: does it run, in this ROS domain, on a computer that is discovered?": (
            silent and not arrivals.has_driver
        ),
        f"its driver is there, but silent{since}: its own entries here say why; if those stay "
        "away, too, the network to its computer is cut": silent,
        fault: fault,
        f"none of its {coverage and coverage.in_service} taxels in service has a valid "
        "reading: its own entry 'nodes' here says why": coverage and not coverage.valid,
        f"the clock of its computer is ahead of this one's by {-underway_s:.3f} s and the time "
        "that messages take: have both computers follow one time server": underway_s < -AHEAD_S,
        f"its messages take {underway_s:.3f} s by the computers' clocks: that of its computer "
        "is behind this one's, or the network is slow (ping tells)": underway_s > BEHIND_S,
        f"its stamps are {late_s:+.1f} s off this computer's time: is use_sim_time the same "
        "for both, or is a computer too busy?": abs(late_s) > STAMPS_OFF_S,
        f"what comes is not used: {arrivals.refused}": not rate_hz and arrivals.refused,
    }
    return next(filter(complaints.get, complaints), ""), state
