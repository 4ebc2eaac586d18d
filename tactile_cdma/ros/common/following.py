# SPDX-License-Identifier: Apache-2.0

"""Subscriptions that exist only while somebody asks for what they bring."""

from collections.abc import Callable
from typing import NamedTuple

from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

from .executor import Polled, take_message
from .failures import FAILURES


class Topic(NamedTuple):
    """callback: see take_message; raw: it gets serialised messages, bytes."""

    kind: type
    name: str
    callback: Callable[..., None]
    qos: QoSProfile
    raw: bool = False


class Following:
    """Some topics of a node, subscribed to together or not at all.

    is_polled: messages stay in the middleware until poll(); else executors wait for them.
    """

    def __init__(self, node: Node, *topics: Topic, is_polled: bool = False) -> None:
        self._node, self._topics = node, topics
        self._group = Polled() if is_polled else None
        self._subscriptions: list[Subscription] = []

    def __bool__(self) -> bool:
        """Tell whether the topics are subscribed to."""
        return len(self._subscriptions) == len(self._topics)

    def follow(self, asked: bool) -> None:
        """Subscribe, or end the subscriptions."""
        if asked and self:
            return
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions.clear()
        for *topic, raw in self._topics if asked else ():  # one by one: a later one may raise
            self._subscriptions.append(
                self._node.create_subscription(*topic, callback_group=self._group, raw=raw)
            )

    def poll(self) -> None:
        """Call back for one message of each topic, if there is one."""
        for subscription in self._subscriptions:
            FAILURES.survive(take_message, subscription)
