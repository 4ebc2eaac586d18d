# SPDX-License-Identifier: Apache-2.0

"""A lifecycle node that mends what rclpy's leaves open."""

from collections.abc import Callable
from functools import wraps
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rclpy._rclpy_pybind11 import RCLError
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from ...base.errors import ParameterError
from ...base.text import plain
from .failures import FAILURES

Transition = Callable[[Any, LifecycleState], TransitionCallbackReturn]


def reported(transition: Transition) -> Transition:
    """Decorate a transition's callback to note its exceptions, which rclpy swallows."""

    @wraps(transition)
    def callback(node: Any, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            return transition(node, state)
        except Exception as error:
            FAILURES.note(transition.__name__, error)
            return TransitionCallbackReturn.ERROR

    return callback


class ManagedNode(LifecycleNode):
    """Refuses impossible transitions, and leaves nothing behind when destroyed.

    is_asked: somebody has requested the transition that is under way. Answers have no room for a
    reason: then a failure has to be logged, even if it is not the first of its kind.
    """

    is_asked = False

    def __init__(self, name: str, **node_options: Any) -> None:
        """Raises ParameterError for an override without a value, or an empty list."""
        try:
            super().__init__(name, **node_options)
        except ValueError as error:
            raise ParameterError(f"a parameter has no value, or an empty list ({error})") from error
        self._change_state = self._service_change_state.callback
        self._service_change_state.callback = self._refuse_impossible

    def _refuse_impossible(
        self, request: ChangeState.Request, response: ChangeState.Response
    ) -> ChangeState.Response:
        """Answer a request; in rclpy one that is impossible in this state ends the executor."""
        self.is_asked = True
        try:
            return self._change_state(request, response)
        except RCLError:
            name = plain(request.transition.label) or request.transition.id
            state = self._state_machine.current_state[1]
            self.get_logger().error(f"transition {name} is not possible: the node is {state}")
            response.success = False
            return response
        finally:
            self.is_asked = False

    def destroy_node(self) -> None:
        """End the lifecycle's services too: rclpy leaves them to the garbage collector."""
        super().destroy_node()
        self._state_machine.destroy_when_not_in_use()
