"""The table of parameters as those of a ROS node: declared, described, refused with reasons."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from ..errors import ParameterError, TactileError
from ..parameters import (
    BY_NAME,
    PARAMETERS,
    STANDARD_PARAMETERS,
    Parameter,
    Value,
    check_values,
    unknown,
)

Change = Callable[[Mapping[str, Value], set[str]], None]
"""Takes all values, and the names of those that are new; raises TactileError to refuse them."""


class NodeParameters:
    """A node's parameters. It was made with automatically_declare_parameters_from_overrides.

    values: what they are at present; the same mapping all along, as quick to read as a dict.
    faults: by name, what keeps the node from being configured.
    """

    def __init__(self, node: Node, change: Change) -> None:
        """change is called before values change, with several new ones at once or not at all."""
        self._node, self._change = node, change
        self.values: dict[str, Value] = {}
        self.faults: dict[str, str] = {}
        self.fixed = False
        self._declare()
        node.add_on_set_parameters_callback(self._on_set)

    def _declare(self) -> None:
        """Declare the table; of a wrong override the fault is kept, and the default taken."""
        given = {name: p.value for name, p in self._node.get_parameters_by_prefix("").items()}
        for name in given:
            if name not in BY_NAME and not name.startswith(STANDARD_PARAMETERS):
                self._fault(name, f"{unknown(name, BY_NAME)} (correct it and start the node again)")
        for parameter in PARAMETERS:
            if parameter.name in given:
                self._node.undeclare_parameter(parameter.name)
            value = parameter.default
            try:
                value = parameter.check(given.get(parameter.name, value))
            except ParameterError as error:
                self._fault(parameter.name, str(error))
            self._node.declare_parameter(
                parameter.name, value, _descriptor(parameter), ignore_override=True
            )
            self.values[parameter.name] = value

    def _fault(self, name: str, text: str) -> None:
        self.faults[name] = text
        self._node.get_logger().error(f"not starting: {text}")

    def _on_set(self, changes: list[RosParameter]) -> SetParametersResult:
        """Refuse what cannot work, saying why; let live parameters take effect at once."""
        given = {change.name: change.value for change in changes if change.name in BY_NAME}
        if not given:  # rclpy's own, as the QoS overrides that every publisher declares
            return SetParametersResult(successful=True)
        before = dict(self.faults)
        try:
            new = check_values(given)
            if self.fixed:
                self._check_fixed(new)
            for name in new:
                self.faults.pop(name, None)
            self._change({**self.values, **new}, set(new))
        except TactileError as error:
            self.faults = before
            return SetParametersResult(successful=False, reason=str(error))
        self.values.update(new)
        return SetParametersResult(successful=True)

    def _check_fixed(self, new: Mapping[str, Value]) -> None:
        """Raises ParameterError for what takes a new configuration."""
        fixed = [n for n, v in new.items() if not BY_NAME[n].live and v != self.values[n]]
        if fixed:
            raise ParameterError(
                f"{', '.join(fixed)} cannot change while configured: deactivate and clean "
                f"up first (ros2 lifecycle set {self._node.get_fully_qualified_name()} "
                "deactivate, then cleanup)"
            )


def _descriptor(parameter: Parameter) -> ParameterDescriptor:
    text = parameter.text + (f" [{parameter.unit}]" if parameter.unit else "")
    descriptor = ParameterDescriptor(description=text)
    if parameter.choices:
        descriptor.additional_constraints = "one of " + ", ".join(map(str, parameter.choices))
    elif not parameter.live:
        descriptor.additional_constraints = "takes effect on configure"
    if parameter.limits:
        low, high = parameter.limits
        if isinstance(parameter.default, float):
            descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
        else:
            descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    descriptor.read_only = parameter.name == "autostart"
    return descriptor
