# SPDX-License-Identifier: Apache-2.0

"""A driver node and a client of it, in one process, over real DDS."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile

from tactile_cdma.msg import TactileArray, TactileSkinInfo
from tactile_cdma.ros.common.qos import LATCHED, QUEUE
from tactile_cdma.ros.driver.node import SkinNode

from .spinning import N, spinning
from .waiting import PATIENCE_S, holds, wait_for

HURRY_NS = 250_000_000
"""Interval of the reports of a driver that hurries, ns."""


class Client(Node):
    """Subscribes and calls services like any user's node."""

    def __init__(self, asked: str = "/skin") -> None:
        """asked: the node whose services are called."""
        super().__init__("client")
        self._asked = asked
        self.arrays: list[TactileArray] = []
        self.infos: list[TactileSkinInfo] = []
        self.entries: dict[str, list[DiagnosticStatus]] = {}  # of /diagnostics, by last word
        self.diagnostics: list[DiagnosticStatus] = []  # all entries of a report in one
        self.create_subscription(TactileArray, "/skin/tactile", self.arrays.append, QUEUE)
        self.create_subscription(TactileSkinInfo, "/skin/info", self.infos.append, LATCHED)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._diagnosed, 10)

    def _diagnosed(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.entries.setdefault(status.name.rpartition(": ")[2], []).append(status)
        self.diagnostics.append(in_one(message))

    def entry(self, name: str) -> DiagnosticStatus:
        """The newest of an entry, or an empty one."""
        return self.entries.get(name, [DiagnosticStatus()])[-1]

    def value(self, entry: str, key: str) -> str:
        """The newest value of this name in an entry; empty if there is none."""
        return {pair.key: pair.value for pair in self.entry(entry).values}.get(key, "")

    def says(self, text: str) -> bool:
        """Whether /diagnostics have said so."""
        return any(text in status.message for status in self.diagnostics)

    def heard(self, kind: type, topic: str, qos: QoSProfile | int = 10) -> list[Any]:
        """The messages of a topic from now on."""
        messages: list[Any] = []
        self.create_subscription(kind, topic, messages.append, qos)
        return messages

    def unsubscribe(self, topic: str) -> None:
        """Hear no more of a topic; by the executor, which may be waiting for it."""
        for subscription in list(self.subscriptions):
            if subscription.topic_name == topic:
                self.executor.create_task(self.destroy_subscription, subscription)

    def call(self, kind: Any, name: str, request: Any) -> Any:
        client = self.create_client(kind, f"{self._asked}/{name}")
        assert client.wait_for_service(PATIENCE_S), f"no service {name}"
        future = client.call_async(request)
        wait_for(future.done)
        self.destroy_client(client)
        return future.result()

    def change(self, *names: str) -> bool:
        """Ask for these transitions, as far as they are possible; returns whether all were."""
        numbers = (getattr(Transition, f"TRANSITION_{name.upper()}", 222) for name in names)
        requests = (ChangeState.Request(transition=Transition(id=number)) for number in numbers)
        return all(self.call(ChangeState, "change_state", each).success for each in requests)

    def state(self) -> str:
        return str(self.call(GetState, "get_state", GetState.Request()).current_state.label)

    def set(self, **values: Any) -> tuple[bool, str]:
        """Set one parameter; returns whether it was taken and the reason if not."""
        parameters = [Parameter(n, value=v).to_parameter_msg() for n, v in values.items()]
        request = SetParameters.Request(parameters=parameters)
        [result] = self.call(SetParameters, "set_parameters", request).results
        return result.successful, result.reason


def in_one(message: DiagnosticArray) -> DiagnosticStatus:
    """Level and texts of the worst entries, values of all; STALE only where all are."""
    levels = [status.level for status in message.status]
    level = max((level for level in levels if level != DiagnosticStatus.STALE), default=levels[0])
    texts = [status.message for status in message.status if status.level == level]
    values = [pair for status in message.status for pair in status.values]
    return DiagnosticStatus(level=level, message="; ".join(texts), values=values)


def xyz(vector: Any) -> np.ndarray:
    """A Point, Vector3 or the like, (3,)."""
    return np.array([vector.x, vector.y, vector.z])


def wait_sending(sent: Sequence[tuple[Publisher, Any]], condition: Callable[[], object]) -> None:
    """Send messages until the condition holds.

    Discovery goes both ways: a subscriber that is seen may not yet hear.
    """
    next_s = 0.0

    def held() -> bool:
        nonlocal next_s
        if time.monotonic() > next_s:
            for publisher, message in sent:
                publisher.publish(message)
            next_s = time.monotonic() + 0.5
        return holds(condition)

    wait_for(held)


def node_with(make: Callable[..., N], **parameters: Any) -> N:
    """A node with these parameters."""
    overrides = [Parameter(name, value=value) for name, value in parameters.items()]
    return make(parameter_overrides=overrides)


@contextmanager
def running(
    make: Callable[..., SkinNode] = SkinNode, **parameters: Any
) -> Iterator[tuple[SkinNode, Client]]:
    """A driver node and a client, each spinning in a thread of its own."""
    node, client = node_with(make, **parameters), Client()
    with spinning([node], [client]):
        yield node, client


@contextmanager
def hurrying(
    make: Callable[..., SkinNode] = SkinNode, **parameters: Any
) -> Iterator[tuple[SkinNode, Client]]:
    """The same of a driver that reports more often, so that nobody waits for whole seconds."""
    with running(make, **parameters) as (node, client):
        node._diagnostics_timer.timer_period_ns = HURRY_NS
        node._diagnostics_timer.reset()
        yield node, client
