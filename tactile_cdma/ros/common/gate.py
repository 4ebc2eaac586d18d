# SPDX-License-Identifier: Apache-2.0

"""Subscriptions whose messages stay in the middleware until all are taken at once.

Being woken by a message costs rclpy much more than taking it. A node that needs the latest message
of many topics only now and then should therefore not be woken by each.
"""

from __future__ import annotations

from collections.abc import Callable

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node


class Gate(CallbackGroup):
    """Callback group of such subscriptions, for a node in a single-threaded executor."""

    def __init__(self, node: Node, on_taken: Callable[[], None]) -> None:
        """on_taken: called after the gate was opened and all waiting messages were taken."""
        super().__init__()
        self._is_open, self._on_taken = False, on_taken
        # Executors handle guard conditions after subscriptions.
        self._taken = node.create_guard_condition(self._close)

    def open(self) -> None:
        """Take one message of each subscription once the present callback has returned."""
        self._is_open = True
        self._taken.trigger()

    def _close(self) -> None:
        self._is_open = False
        self._on_taken()

    def can_execute(self, entity: object) -> bool:
        """Whether the executor may wait for a subscription."""
        return self._is_open

    def beginning_execution(self, entity: object) -> bool:
        """Whether the executor may call back."""
        return self._is_open

    def ending_execution(self, entity: object) -> None:
        """Do nothing: the gate closes when all subscriptions were served."""
