# SPDX-License-Identifier: Apache-2.0

"""Subscriptions that exist only while somebody asks for what they bring."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

Topic = tuple[type, str, Callable[[Any], None], QoSProfile]
"""Type of the messages, name, callback, QoS."""


class Following:
    """Some topics of a node, subscribed to together or not at all."""

    def __init__(self, node: Node, *topics: Topic, group: CallbackGroup | None = None) -> None:
        self._node, self._topics, self._group = node, topics, group
        self._subscriptions: list[Subscription] = []

    def __bool__(self) -> bool:
        """Whether the topics are subscribed to."""
        return bool(self._subscriptions)

    def follow(self, asked: bool) -> None:
        """Subscribe, or end the subscriptions."""
        if asked == bool(self):
            return
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        topics = self._topics if asked else ()
        self._subscriptions = [
            self._node.create_subscription(*topic, callback_group=self._group) for topic in topics
        ]
