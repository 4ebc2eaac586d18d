# SPDX-License-Identifier: Apache-2.0

"""Subscriptions that exist only while somebody asks for what they bring."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

from .executor import Gate, take_message

Topic = tuple[type, str, Callable[..., None], QoSProfile]
"""Type of the messages, name, callback (see take_message), QoS."""


class Following:
    """Some topics of a node, subscribed to together or not at all.

    is_awaited: executors wait for their messages; else these stay in the middleware until poll().
    Being woken by a message costs more than taking it. raw: callbacks get serialised messages,
    bytes.
    """

    def __init__(
        self, node: Node, *topics: Topic, is_awaited: bool = True, raw: bool = False
    ) -> None:
        self._node, self._topics, self._raw = node, topics, raw
        self._gate = Gate(is_awaited)
        self._subscriptions: list[Subscription] = []

    def __bool__(self) -> bool:
        """Whether the topics are subscribed to."""
        return bool(self._subscriptions)

    @property
    def is_awaited(self) -> bool:
        """Whether executors wait for their messages."""
        return self._gate.is_open

    @is_awaited.setter
    def is_awaited(self, is_awaited: bool) -> None:
        self._gate.is_open = is_awaited

    def follow(self, asked: bool) -> None:
        """Subscribe, or end the subscriptions."""
        if asked == bool(self):
            return
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        topics = self._topics if asked else ()
        self._subscriptions = [
            self._node.create_subscription(*topic, callback_group=self._gate, raw=self._raw)
            for topic in topics
        ]

    def poll(self) -> None:
        """Call back for one message of each topic, if there is one."""
        for subscription in self._subscriptions:
            take_message(subscription)
