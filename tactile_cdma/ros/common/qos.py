# SPDX-License-Identifier: Apache-2.0

"""How topics are offered, and the standard parameters that say otherwise.

`qos_overrides.<topic>.publisher.<policy>` are names that every ROS 2 node understands. rclpy's own
reading of them ends the node with the middleware's words for a wrong one; these are checked, and
refused, as all other parameters are.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from ...config.parameters import Parameter, Value

LATCHED = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""What does not change from frame to frame: who comes later gets the last one."""
RELIABLE = QoSProfile(depth=10)
"""Small messages, which rviz and controllers may both ask for."""
PICTURE = QoSProfile(depth=2, reliability=ReliabilityPolicy.RELIABLE)
"""What people look at."""
QOS_OVERRIDES = "qos_overrides."
_POLICIES = {
    "history": HistoryPolicy,
    "reliability": ReliabilityPolicy,
    "durability": DurabilityPolicy,
}
_NOT_FOR_PUBLISHERS = {"UNKNOWN", "BEST_AVAILABLE", "KEEP_ALL"}
"""One that keeps all waits for its slowest subscriber, 100 ms per message, and then fails; here
newest data wins."""
_MOST_DEPTH = 1 << 20


def offered(profile: QoSProfile, topic: str, declare: Callable[[Parameter], Value]) -> QoSProfile:
    """A publisher's profile as the parameters have it.

    topic: its full name. declare: makes a parameter that is fixed from the node's start on, and
    returns its value.
    """
    result = copy(profile)
    prefix, text = f"{QOS_OVERRIDES}{topic}.publisher.", f"of the publisher of {topic}"
    for name, policy in _POLICIES.items():
        choices = tuple(p.name.lower() for p in policy if p.name not in _NOT_FOR_PUBLISHERS)
        default = getattr(profile, name).name.lower()
        value = declare(Parameter(prefix + name, default, f"{name} {text}", choices=choices))
        setattr(result, name, policy[str(value).upper()])
    depth = Parameter(prefix + "depth", profile.depth, f"depth {text}", "", (1, _MOST_DEPTH))
    result.depth = declare(depth)
    return result
