# SPDX-License-Identifier: Apache-2.0

"""Declares the table of parameters at a ROS node, describes them, and refuses wrong values."""

import sys
from collections.abc import Callable, Sequence
from typing import Any

from rcl_interfaces import msg
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.qos import QoSProfile

from ...base.errors import ParameterError, TactileError
from ...config import parameters as table
from ...config.arguments import check_params_are_for
from ..common.qos import QOS_OVERRIDES, offered

AT_START = {"autostart"}
"""Parameters that are read only once."""
_MOST_OF_A_SLIDER = 2**31 - 1
"""Greatest end of an integer's range that is declared as such: the sliders of Qt take no greater
one, and rqt_reconfigure shows no parameter from there on."""
_RESTART = " (correct it and start the node again)"
Change = Callable[[table.Values, set[str]], None]
"""Called with all values and the names of new ones; raises TactileError to refuse them."""


class NodeParameters:
    """The parameters of a node that was made with automatically_declare_parameters_from_overrides.

    values: of the table's parameters, now; always the same dict. faults: by name, what keeps the
    node from being configured. fixed: whether only live parameters may change.
    """

    def __init__(self, node: Node, change: Change) -> None:
        """change: called before values change, for all that are set at once.

        Raises ParameterError where the command line names parameter files of other nodes.
        """
        check_params_are_for(node.get_fully_qualified_name(), sys.argv)
        self._node, self._change = node, change
        self.faults: dict[str, str] = {}
        self.fixed = False
        self._given = {name: p.value for name, p in node.get_parameters_by_prefix("").items()}
        for name in self._given:
            if name not in table.BY_NAME and not name.startswith(table.STANDARD_PARAMETERS):
                self._fault(name, table.unknown(name, table.BY_NAME) + _RESTART)
        self.values: dict[str, Any] = {
            parameter.name: self._declare(parameter, parameter.name in AT_START)
            for parameter in table.PARAMETERS
        }
        node.add_on_set_parameters_callback(self._on_set)

    def offered(self, profile: QoSProfile, topic: str) -> QoSProfile:
        """Return the QoS of a topic's publisher: the profile, with its qos_overrides."""
        return offered(profile, self._node, topic, lambda p: self._declare(p, True))

    def check_all_taken(self) -> None:
        """Warn of qos_overrides without a publisher; call it when all publishers exist."""
        for name in self._given:
            if name.startswith(QOS_OVERRIDES) and not self._node.describe_parameter(name).read_only:
                self._node.get_logger().warning(
                    f"{name} has no effect: no such publisher or policy"
                )

    def checked(self, changes: Sequence[RosParameter]) -> list[RosParameter]:
        """Changes converted to the types of the table: 50 is taken as 50.0.

        Raises ParameterError with a reason for what rclpy refuses without one.
        """
        result = []
        for change in changes:
            name = change.name
            if not self._node.has_parameter(name):
                raise ParameterError(table.unknown(name, table.BY_NAME))
            if self._node.describe_parameter(name).read_only:
                raise ParameterError(
                    f"{name} counts only when the node starts: set it in the parameter file and "
                    "start the node again"
                )
            if name in table.BY_NAME:
                change = RosParameter(name, value=table.BY_NAME[name].check(change.value))
            result.append(change)
        return result

    def _declare(self, parameter: table.Parameter, read_only: bool) -> table.Value:
        """Declare a parameter; a wrong override becomes a fault, and the default applies."""
        name, value = parameter.name, parameter.default
        if name in self._given:
            self._node.undeclare_parameter(name)
            try:
                value = parameter.check(self._given[name])
            except ParameterError as error:
                self._fault(name, f"{error}{_RESTART if read_only else ''}")
        descriptor = _descriptor(parameter, read_only)
        self._node.declare_parameter(name, value, descriptor, ignore_override=True)
        return value

    def _fault(self, name: str, text: str) -> None:
        self.faults[name] = text
        self._node.get_logger().error(f"not starting: {text}")

    def _on_set(self, changes: list[RosParameter]) -> msg.SetParametersResult:
        given = {change.name: change.value for change in changes if change.name in table.BY_NAME}
        before = dict(self.faults)
        try:
            new = table.check_values(given)
            fixed = [n for n, v in new.items() if not table.BY_NAME[n].live and v != self.values[n]]
            if self.fixed and fixed:
                raise ParameterError(
                    f"{', '.join(fixed)} cannot change while configured: deactivate and clean "
                    f"up first (ros2 lifecycle set {self._node.get_fully_qualified_name()} "
                    "deactivate, then cleanup)"
                )
            for name in new:
                self.faults.pop(name, None)
            if new:
                self._change({**self.values, **new}, set(new))
        except TactileError as error:
            self.faults = before
            return msg.SetParametersResult(successful=False, reason=str(error))
        self.values.update(new)
        return msg.SetParametersResult(successful=True)


def _descriptor(parameter: table.Parameter, read_only: bool) -> msg.ParameterDescriptor:
    descriptor = msg.ParameterDescriptor(
        description=parameter.description, read_only=read_only, dynamic_typing=parameter.pair
    )
    if parameter.choices:
        descriptor.additional_constraints = "one of " + ", ".join(map(str, parameter.choices))
    elif read_only:
        descriptor.additional_constraints = "takes effect when the node starts"
    elif not parameter.live:
        descriptor.additional_constraints = "takes effect on configure"
    if parameter.limits:
        low, high = parameter.limits
        if isinstance(parameter.default, int) and high > _MOST_OF_A_SLIDER:
            descriptor.additional_constraints += f"; {low:.0f} to {high:.0f}"
        elif isinstance(parameter.default, int):
            descriptor.integer_range = [msg.IntegerRange(from_value=int(low), to_value=int(high))]
        else:
            descriptor.floating_point_range = [
                msg.FloatingPointRange(from_value=low, to_value=high)
            ]
    return descriptor
