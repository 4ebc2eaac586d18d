# SPDX-License-Identifier: Apache-2.0

"""The node of a whole body: contacts, taxels, points and names of its patches in one tf frame.

It subscribes only to what its own subscribers need.
"""

import sys
import time
from dataclasses import replace
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.clock import JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.validate_full_topic_name import validate_full_topic_name

from ...base.errors import ParameterError
from ...base.program import program
from ...config.body_file import STALE_AFTER, read_body
from ...config.parameters import BY_NAME, Parameter, Value, Values
from ...config.skin_config import user_path
from ..common.convert import UNKNOWN_WRENCH, report
from ..common.nodes import STEADY, TAKEN, all_or_nothing, changing
from ..common.process import run_node
from ..common.qos import offered
from .outputs import ContactsOutput, PointsOutput, TaxelsOutput
from .patches import Patches, body_report

NODE_NAME = "body"
TICK_S = 0.2
"""Interval of looks at who subscribes, and of names, s; chosen."""
REPORT_S = 1.0
"""Interval of /diagnostics, s, as usual in ROS."""
_TABLE = (
    Parameter("body_file", "", "body file with the patches' names and frame_id; empty: patches"),
    Parameter("frame_id", "body", "tf frame of what is published; a body file's goes before it"),
    STALE_AFTER,
    Parameter("clocks_apart_s", 0.0, "how far patches' clocks may be off", "s", (0.0, 86_400.0)),
    BY_NAME[UNKNOWN_WRENCH],
    BY_NAME["visual_rate_hz"],
    BY_NAME["colour_max_kpa"],
    BY_NAME["colour_gamma"],
)
_PATCHES = "patches"


class BodyNode(Node):
    """Combines what the drivers of a body's patches publish."""

    @all_or_nothing
    def __init__(self, **node_options: Any) -> None:
        """Raises TactileError for wrong parameters."""
        super().__init__(NODE_NAME, **node_options)
        self.patches = Patches(self, *body_setup(self))
        kinds = ContactsOutput, TaxelsOutput, PointsOutput
        self.outputs = [kind(self.patches, self._offer) for kind in kinds]
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        back = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1))
        self._watch = self.get_clock().create_jump_callback(back, post_callback=self._step_back)
        self.create_timer(TICK_S, self._tick, clock=STEADY)
        self.create_timer(REPORT_S, self._report, clock=STEADY)

    def set_parameters_atomically(self, changes: list[RosParameter]) -> SetParametersResult:
        """Take what changes nothing; all else is read when the node starts."""
        changes = changing(self, changes)
        return super().set_parameters_atomically(changes) if changes else TAKEN

    def _offer(self, kind: Any, topic: str, qos: QoSProfile) -> Publisher:
        return self.create_publisher(
            kind, topic, offered(qos, self, topic, partial(declared, self))
        )

    def _tick(self) -> None:
        """Follow what is asked for; publish that patches are absent where nothing comes."""
        asked = [output.tick() for output in self.outputs]
        self.patches.follow_transforms(any(asked))

    def _step_back(self, _: TimeJump) -> None:
        for arrivals in self.patches.arrivals.values():
            arrivals.step_back()

    def _report(self) -> None:
        is_followed = any(output.following for output in self.outputs)
        name = self.get_fully_qualified_name()
        entries = body_report(name, self.patches, is_followed, time.monotonic())
        self._diagnostics.publish(report(self, entries))


def body_setup(node: Node) -> tuple[tuple[str, ...], Values]:
    """Declare and read the parameters, which cannot change later.

    Returns the fully qualified names of the drivers' nodes, and the values of the other parameters.
    Raises ParameterError for a wrong one, BodyError for a body file that cannot be used.
    """
    table = {parameter.name: parameter for parameter in _TABLE}
    values = {"body_file": declared(node, table.pop("body_file"))}
    namespace = node.get_namespace().rstrip("/")
    patches = _names(
        _declare(node, _PATCHES, [""], "names of the drivers' nodes, as /left_palm/skin"), namespace
    )
    body = None
    if values["body_file"]:
        if patches:
            raise ParameterError("body_file and patches are both given: leave one of them out")
        body = read_body(user_path("body_file", values["body_file"]), namespace)
        patches = tuple(patch.node for patch in body.patches)
        table[STALE_AFTER.name] = replace(STALE_AFTER, default=body.stale_after_s)
    values |= {name: declared(node, parameter) for name, parameter in table.items()}
    if body:
        values["frame_id"] = body.frame_id
    if not patches:
        raise ParameterError(
            "no patches to gather: give body_file:=body.yaml or patches:=[/left_palm/skin]"
        )
    return patches, values


def declared(node: Node, parameter: Parameter) -> Any:
    """Declare a parameter that is fixed from the node's start on; raises ParameterError."""
    default = parameter.default
    return parameter.check(_declare(node, parameter.name, default, parameter.description))


def _declare(node: Node, name: str, default: Value | list[str], text: str) -> object:
    """Return the value given, of any type, so that its error message is ours."""
    descriptor = ParameterDescriptor(
        description=text,
        read_only=True,
        dynamic_typing=True,
        additional_constraints="read when the node starts",
    )
    value: object = node.declare_parameter(name, default, descriptor).value
    return value


def _names(value: object, namespace: str) -> tuple[str, ...]:
    """Return full names; those without a slash before them are in the namespace."""
    if not isinstance(value, list) or not all(isinstance(name, str) for name in value):
        raise ParameterError(f"{_PATCHES} is {value!r}; it must be a list of names of nodes")
    full = (name if name.startswith("/") else f"{namespace}/{name}" for name in value if name)
    names = [f"/{name.strip('/')}" for name in full]
    for name in names:
        try:
            validate_full_topic_name(name)
        except InvalidTopicNameException:
            raise ParameterError(
                f"{_PATCHES} has {name!r}, which is not a node's name; names look like "
                "/left_palm/skin"
            ) from None
        if names.count(name) > 1:
            raise ParameterError(f"{_PATCHES} has {name} twice")
    return tuple(names)


@program("skin_body")
def main() -> int:
    """Run the node until interrupted; returns the exit code."""
    return run_node(BodyNode)


if __name__ == "__main__":
    sys.exit(main())
