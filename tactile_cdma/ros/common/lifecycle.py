# SPDX-License-Identifier: Apache-2.0

"""A lifecycle node that mends what rclpy's leaves open."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from functools import partial, wraps
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rclpy._rclpy_pybind11 import RCLError
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from ...base.errors import ParameterError

Transition = Callable[[Any, LifecycleState], TransitionCallbackReturn]


def reported(transition: Transition) -> Transition:
    """Decorate a transition's callback to log its exceptions, which rclpy swallows."""

    @wraps(transition)
    def callback(node: Any, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            return transition(node, state)
        except Exception:
            node.get_logger().error(
                f"internal error in {transition.__name__}: {traceback.format_exc()}"
            )
            return TransitionCallbackReturn.ERROR

    return callback


class ManagedNode(LifecycleNode):
    """Refuses impossible transitions, and leaves nothing behind when destroyed."""

    def __init__(self, name: str, **node_options: Any) -> None:
        """Raises ParameterError for an override without a value, or an empty list."""
        try:
            super().__init__(name, **node_options)
        except ValueError as error:
            raise ParameterError(f"a parameter has no value, or an empty list ({error})") from error
        # In rclpy a transition that is impossible in the present state ends the executor.
        self._service_change_state.callback = partial(
            _refuse_impossible, self, self._service_change_state.callback
        )

    def destroy_node(self) -> None:
        """End the lifecycle's services too: rclpy leaves them to the garbage collector."""
        super().destroy_node()
        self._state_machine.destroy_when_not_in_use()


def _refuse_impossible(
    node: LifecycleNode,
    change_state: Callable[[ChangeState.Request, ChangeState.Response], ChangeState.Response],
    request: ChangeState.Request,
    response: ChangeState.Response,
) -> ChangeState.Response:
    """Answer a change_state request, with a refusal if the present state does not allow it."""
    try:
        return change_state(request, response)
    except RCLError:
        node.get_logger().error(
            f"transition {request.transition.label or request.transition.id} is not possible now"
        )
        response.success = False
        return response
