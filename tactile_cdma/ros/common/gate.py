# SPDX-License-Identifier: Apache-2.0

"""Subscriptions whose messages stay in the middleware until they are wanted, all at once.

Waiting for what comes next costs rclpy much more than taking it. Who looks at the latest of many
topics now and then is therefore not to be woken by every message.
"""

from __future__ import annotations

from collections.abc import Callable

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node


class Gate(CallbackGroup):
    """The callback group of such subscriptions, of a node in a single-threaded executor."""

    def __init__(self, node: Node, on_taken: Callable[[], None]) -> None:
        """on_taken: called when it was opened, and every message that had come was taken."""
        super().__init__()
        self._is_open, self._on_taken = False, on_taken
        # Executors come to guard conditions after subscriptions.
        self._taken = node.create_guard_condition(self._close)

    def open(self) -> None:
        """Take one message of each subscription as soon as this callback is over."""
        self._is_open = True
        self._taken.trigger()

    def _close(self) -> None:
        self._is_open = False
        self._on_taken()

    def can_execute(self, entity: object) -> bool:
        """Whether the executor may wait for a subscription."""
        return self._is_open

    def beginning_execution(self, entity: object) -> bool:
        """Whether it may call back."""
        return self._is_open

    def ending_execution(self, entity: object) -> None:
        """Nothing is to be done then."""
