"""A driver node and a client of it, in one process, over real DDS."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image

from tactile_cdma.msg import TactileArray, TactileSkinInfo
from tactile_cdma.ros.node import SkinNode
from tactile_cdma.ros.qos import LATCHED
from tactile_cdma.ros.view import QUEUE


class Client(Node):
    """A subscriber and caller of services, as any user's node would be."""

    def __init__(self) -> None:
        super().__init__("client")
        self.arrays: list[TactileArray] = []
        self.images: list[Image] = []
        self.infos: list[TactileSkinInfo] = []
        self.diagnostics: list[DiagnosticStatus] = []
        self.create_subscription(TactileArray, "/skin/tactile", self.arrays.append, QUEUE)
        self.create_subscription(TactileSkinInfo, "/skin/info", self.infos.append, LATCHED)
        self.create_subscription(
            DiagnosticArray, "/diagnostics", lambda m: self.diagnostics.extend(m.status), 10
        )

    def call(self, kind: Any, name: str, request: Any) -> Any:
        client = self.create_client(kind, f"/skin/{name}")
        assert client.wait_for_service(10), f"no service {name}"
        future = client.call_async(request)
        wait_for(future.done)
        self.destroy_client(client)
        return future.result()

    def change(self, transition: int) -> bool:
        request = ChangeState.Request(transition=Transition(id=transition))
        return bool(self.call(ChangeState, "change_state", request).success)

    def state(self) -> int:
        return int(self.call(GetState, "get_state", GetState.Request()).current_state.id)

    def set(self, **values: Any) -> tuple[bool, str]:
        """Set one parameter; returns whether it was taken and the reason if not."""
        parameters = [Parameter(n, value=v).to_parameter_msg() for n, v in values.items()]
        request = SetParameters.Request(parameters=parameters)
        [result] = self.call(SetParameters, "set_parameters", request).results
        return result.successful, result.reason


def wait_for(condition: Callable[[], object], timeout_s: float = 15.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.01)


@contextmanager
def running(**parameters: Any) -> Iterator[tuple[SkinNode, Client]]:
    """A driver node and a client, each spinning in a thread of its own."""
    overrides = [Parameter(name, value=value) for name, value in parameters.items()]
    node, client = SkinNode(parameter_overrides=overrides), Client()
    executors = [SingleThreadedExecutor(), SingleThreadedExecutor()]
    threads = []
    for executor, member in zip(executors, (node, client), strict=True):
        executor.add_node(member)
        threads.append(threading.Thread(target=executor.spin))
        threads[-1].start()
    try:
        yield node, client
    finally:
        for executor, thread, member in zip(executors, threads, (node, client), strict=True):
            executor.shutdown()
            thread.join()
            member.destroy_node()
