# SPDX-License-Identifier: Apache-2.0

"""Lets read-only parameters be set to the values that they have, as `ros2 param load` does."""

from collections.abc import Sequence

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

TAKEN = SetParametersResult(successful=True)
"""The answer where nothing is to be set."""


def changing(node: Node, parameters: Sequence[Parameter]) -> list[Parameter]:
    """Those to set: all but read-only ones that have their values already."""

    def has_it(parameter: Parameter) -> bool:
        name = parameter.name
        return bool(
            node.has_parameter(name)
            and node.describe_parameter(name).read_only
            and node.get_parameter(name).get_parameter_value() == parameter.get_parameter_value()
        )

    return [parameter for parameter in parameters if not has_it(parameter)]
