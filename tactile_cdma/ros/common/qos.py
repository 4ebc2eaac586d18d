# SPDX-License-Identifier: Apache-2.0

"""The QoS of topics, and the standard parameters that override it.

Every ROS 2 node knows `qos_overrides.<topic>.publisher.<policy>`. Where rclpy reads them itself, a
wrong one ends the node with an error of the middleware; here they are checked and refused like all
other parameters.
"""

from collections.abc import Callable
from copy import copy

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from ...config.parameters import Parameter, Value

LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
"""For what rarely changes: late subscribers receive the last message."""
RELIABLE = QoSProfile(depth=10)
"""For small messages that rviz and controllers may both subscribe to."""
FRESH = QoSProfile(depth=2, reliability=ReliabilityPolicy.BEST_EFFORT)
"""For whoever acts on contacts: who falls behind goes on with the newest instead of staying late.
With reliable QoS a lost packet would hold up all that follow until it is repeated: on a network
that loses 5 % of them, a body took 20 of 25 frames a second, some 0.4 s late (make torture
ONLY=hosts)."""
PICTURE = QoSProfile(depth=2, reliability=ReliabilityPolicy.RELIABLE)
"""For pictures; the depth is small because only the newest matters."""
QUEUE = QoSProfile(depth=256, reliability=ReliabilityPolicy.BEST_EFFORT)
"""For viewers that count frames: some 3 s of them, at the default rate, may wait. Chosen."""
QOS_OVERRIDES = "qos_overrides."
_POLICIES = {
    "history": HistoryPolicy,
    "reliability": ReliabilityPolicy,
    "durability": DurabilityPolicy,
}
_NOT_FOR_PUBLISHERS = {"UNKNOWN", "BEST_AVAILABLE", "KEEP_ALL"}
"""A publisher with KEEP_ALL waits for its slowest subscriber, 100 ms per message, and then fails;
here the newest data counts."""
_MOST_DEPTH = 1 << 20
"""Greatest depth that is accepted; chosen beyond every use, within what the middleware takes."""


def offered(
    profile: QoSProfile, node: Node, topic: str, declare: Callable[[Parameter], Value]
) -> QoSProfile:
    """Return the profile of a node's publisher with its overrides.

    declare: declares a parameter that cannot change after the node's start; returns its value. Only
    overrides that are given are declared: those of all topics would be half of a node's parameters.
    """
    result, topic = copy(profile), node.resolve_topic_name(topic)
    prefix, text = f"{QOS_OVERRIDES}{topic}.publisher.", f"of the publisher of {topic}"

    def value(parameter: Parameter) -> Value:
        is_given = parameter.name in node._parameter_overrides
        return declare(parameter) if is_given else parameter.default

    for name, policy in _POLICIES.items():
        choices = tuple(p.name.lower() for p in policy if p.name not in _NOT_FOR_PUBLISHERS)
        default = getattr(profile, name).name.lower()
        chosen = value(Parameter(prefix + name, default, f"{name} {text}", choices=choices))
        setattr(result, name, policy[str(chosen).upper()])
    depth = Parameter(prefix + "depth", profile.depth, f"depth {text}", "", (1, _MOST_DEPTH))
    result.depth = value(depth)
    return result
