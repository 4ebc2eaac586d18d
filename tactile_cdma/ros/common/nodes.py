# SPDX-License-Identifier: Apache-2.0

"""What our nodes need beyond rclpy's, when they are made, change, are set, or end."""

import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache, wraps
from typing import Any, TypeVar, cast

from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import SetParametersResult
from rclpy._rclpy_pybind11 import RCLError
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter

from ...base.errors import ParameterError
from ...base.interrupt import is_told_to_stop
from ...base.text import plain
from .failures import FAILURES

STEADY = Clock(clock_type=ClockType.STEADY_TIME)
"""For timers: it goes on where simulated time stands."""
TAKEN = SetParametersResult(successful=True)
"""The answer where no parameter is to be set."""
DISCOVERY_S = 4.0
"""Longest time from a process's first node to its first transition, s, in a process that launch has
started. Chosen: discovery takes 0.05 s, but Fast DDS repeats an announcement that a busy computer
has lost after 3 s."""
_LOOK_S = 0.01
"""Interval of looks for it, s; chosen."""
_NAMED = "__node:="
"""Beginning of the argument by which launch names a node."""
Transition = Callable[[Any, LifecycleState], TransitionCallbackReturn]
Init = TypeVar("Init", bound=Callable[..., None])


def all_or_nothing(init: Init) -> Init:
    """Decorate a node's __init__: if it raises, it leaves nothing behind.

    Others would see the node for as long as the exception is kept, whose traceback refers to it.
    """

    @wraps(init)
    def construct(node: Node, *args: Any, **options: Any) -> None:
        try:
            init(node, *args, **options)
        except BaseException:
            with suppress(AttributeError):  # rclpy's own constructor has raised: parts are missing
                node.destroy_node()
            with suppress(AttributeError):  # even this one
                node.handle.destroy_when_not_in_use()
            raise

    return cast(Init, construct)


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


@cache
def _began_s() -> float:
    """Return when this was first called, that is the process's first node was made."""
    return time.monotonic()


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
        _began_s()
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

    def await_listener(self) -> None:
        """Wait, where launch has named this node, until somebody listens to its transitions.

        These are published once and not kept: a launch file that starts something else once this
        node is active, would hear nothing before it is discovered. Waits for up to DISCOVERY_S.
        """
        topic = f"{self.get_fully_qualified_name()}/transition_event"
        is_named = any(word.startswith(_NAMED) for word in sys.argv)
        end_s = _began_s() + DISCOVERY_S if is_named else 0.0
        while time.monotonic() < end_s and not is_told_to_stop():
            if self.count_subscribers(topic):
                return
            time.sleep(_LOOK_S)

    def destroy_node(self) -> None:
        """End the lifecycle's services too: rclpy leaves them to the garbage collector."""
        super().destroy_node()
        self._state_machine.destroy_when_not_in_use()


def changing(node: Node, parameters: Sequence[Parameter]) -> list[Parameter]:
    """Return the parameters to set: all but read-only ones that have their values already.

    So `ros2 param load` takes what `ros2 param dump` wrote.
    """

    def has_it(parameter: Parameter) -> bool:
        name = parameter.name
        return bool(
            node.has_parameter(name)
            and node.describe_parameter(name).read_only
            and node.get_parameter(name).get_parameter_value() == parameter.get_parameter_value()
        )

    return [parameter for parameter in parameters if not has_it(parameter)]
