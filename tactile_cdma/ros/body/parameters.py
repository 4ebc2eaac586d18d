# SPDX-License-Identifier: Apache-2.0

"""The parameters of the body node."""

from dataclasses import replace
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.validate_full_topic_name import validate_full_topic_name

from ...base.errors import ParameterError
from ...config.body_file import STALE_AFTER, read_body
from ...config.parameters import BY_NAME, Parameter, Value, Values
from ...config.skin_config import user_path
from ..common.convert import UNKNOWN_WRENCH

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


def body_setup(node: Node) -> tuple[tuple[str, ...], Values]:
    """Declare and read the parameters, which cannot change later.

    Returns the fully qualified names of the drivers' nodes, and the values of the others. Raises
    ParameterError for a wrong one, BodyError for a body file that cannot be used.
    """
    table = {parameter.name: parameter for parameter in _TABLE}
    values = {"body_file": declared(node, table.pop("body_file"))}
    namespace = node.get_namespace().rstrip("/")
    patches = _names(
        _declare(node, _PATCHES, [""], "names of the drivers' nodes, as /left_palm/skin"),
        namespace,
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
