"""A lifecycle node without the gaps of rclpy's."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rclpy._rclpy_pybind11 import RCLError
from rclpy.lifecycle import LifecycleNode


class ManagedNode(LifecycleNode):
    """Refuses transitions that are impossible, and leaves nothing behind when destroyed."""

    def __init__(self, name: str, **node_options: Any) -> None:
        super().__init__(name, **node_options)
        # rclpy lets a transition that is impossible in the present state end the executor.
        self._service_change_state.callback = partial(
            _refuse_impossible, self, self._service_change_state.callback
        )

    def destroy_node(self) -> None:
        """Also end the lifecycle's services."""
        super().destroy_node()
        # rclpy leaves them in the graph until the garbage collector finds them.
        self._state_machine.destroy_when_not_in_use()


def _refuse_impossible(
    node: LifecycleNode,
    change_state: Callable[[ChangeState.Request, ChangeState.Response], ChangeState.Response],
    request: ChangeState.Request,
    response: ChangeState.Response,
) -> ChangeState.Response:
    """Answer a change_state request, also one that the present state does not allow."""
    try:
        return change_state(request, response)
    except RCLError:
        node.get_logger().error(
            f"transition {request.transition.label or request.transition.id} is not possible now"
        )
        response.success = False
        return response
