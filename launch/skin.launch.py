# SPDX-License-Identifier: Apache-2.0

"""Starts the driver of one skin patch: `ros2 launch tactile_cdma skin.launch.py sim:=true`.

Without `port`, `sim` or a port in the parameter file the driver runs the simulated skin as well,
and warns of it in its log and in /diagnostics. Beside the arguments below, every parameter of the
driver may be given by its name: `nodes:=64 chip_us:=20`. Any other name is an error.

With `patches`, starts the drivers of a body of many patches and the node that combines their
contacts: `ros2 launch tactile_cdma skin.launch.py patches:=config/body.yaml`. Drivers configure and
activate themselves; `OnStateTransition` of a file that includes this one hears them.

A file that includes this one passes on what is meant for it; what it has of the same name for
others is not taken, and nothing of this file is left behind in it.
"""

import inspect
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import (
    DeclareLaunchArgument,
    GroupAction,
    IncludeLaunchDescription,
    LogInfo,
    OpaqueFunction,
)
from launch.logging import launch_config
from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions
from launch_ros.actions import LifecycleNode, Node
from launch_ros.parameter_descriptions import ParameterValue

from tactile_cdma.base.errors import TactileError
from tactile_cdma.base.named_file import existing
from tactile_cdma.config.arguments import launch_values, true_or_false
from tactile_cdma.config.body_file import NODE_NAME, STALE_AFTER, read_body
from tactile_cdma.config.parameters import (
    BY_NAME,
    DEFAULTS,
    SIMULATION,
    Value,
    Values,
    read_file,
    unknown,
)
from tactile_cdma.config.skin_config import SkinConfig, user_path
from tactile_cdma.ros.rviz_file import body_view, skin_view

SHARE = Path(__file__).parent.parent  # of the installed package, or the checkout
PARAMS = "config/skin.yaml"
RVIZ_TOPICS = ("heatmap", "markers", "points", "pressure_image", "wrench")
FALSE = "false"
VIEWS = TRUE, CURVED, BODY = "true", "curved", "body"
"""Values of `rviz` for which a file is made to measure."""
ARGUMENTS = {
    "params_file": (
        PARAMS,
        "ROS 2 parameter file of the driver; relative to the working folder or to the package",
    ),
    "port": (
        "",
        "pyserial URL of the digitizer; empty: the one in params_file, or, with a warning, the "
        "simulated skin",
    ),
    "sim": (FALSE, "use the simulated skin (port sim://)"),
    "namespace": ("", "namespace of the nodes: left gives /left/skin/tactile"),
    "frame_id": (
        "",
        "tf frame of the skin; empty: the one in params_file, or, in a namespace, left/skin",
    ),
    "rviz": (
        FALSE,
        "show it in rviz2: true, curved (a bent skin, seen in space), body (with patches), or the "
        "path of an rviz file",
    ),
    "patches": (
        "",
        "body file of many patches; it replaces the arguments above, except rviz and namespace; "
        "stale_after_s is then that of the body's node",
    ),
    "only": ("", "patches of the body file to start: left_palm,right_palm; empty: all"),
    "body": (TRUE, "with patches: also start the node that combines their contacts"),
}
"""Defaults and descriptions, by name."""
OWN = {name: default for name, (default, _) in ARGUMENTS.items()}
FOR_BODIES = ("patches", "only", "body", "rviz", "namespace", STALE_AFTER.name)
PUSHED = "ros_namespace"
"""The launch configuration that PushRosNamespace sets."""
RESPAWN_DELAY_S = 2.0


def generate_launch_description() -> LaunchDescription:
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([GroupAction([*declared, OpaqueFunction(function=start)])])


@dataclass(frozen=True)
class Given:
    """What the file was given. get: arguments by name. parameters: by name. pushed: namespace."""

    get: dict[str, str]
    parameters: dict[str, Value]
    pushed: str

    @property
    def namespace(self) -> str:
        """The namespace of the node of a single skin, from the root on; without slashes around."""
        parts = (self.pushed.strip("/"), self.get["namespace"].strip("/"))
        return "/".join(filter(None, parts))

    @property
    def node(self) -> str:
        """The fully qualified name of that node."""
        return "/".join(["", *filter(None, [self.namespace]), NODE_NAME])


def start(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    """Return the nodes that the arguments ask for."""
    configured = context.launch_configurations
    try:
        names = own_names(context)
        get, parameters = launch_values({name: configured[name] for name in names}, OWN)
        given = Given(get, parameters, configured.get(PUSHED, ""))
        actions = whole_body(given, names) if get["patches"] else one_patch(given)
        if get["rviz"].lower() != FALSE:
            actions.append(rviz(given))
    except TactileError as error:
        raise RuntimeError(str(error)) from None  # launch prints it and ends
    return actions


def own_names(context: LaunchContext) -> list[str]:
    """Return the names of the arguments that were given to this file.

    Launch configurations hold those of all files, and say not whose they are. Those that `ros2
    launch`, or a launch file, gives to this one are with the action that includes it.
    """
    for values in stack():
        for value in values:
            if isinstance(value, IncludeLaunchDescription):
                names = (normalize_to_list_of_substitutions(n) for n, _ in value.launch_arguments)
                return [perform_substitutions(context, name) for name in names]
    return [name for name in context.launch_configurations if name in OWN]


def stack() -> Iterator[list[Any]]:
    """Yield what every function that is running has in its variables, the innermost first."""
    frame = inspect.currentframe()
    while frame:
        yield list(frame.f_locals.values())
        frame = frame.f_back


def one_patch(given: Given) -> list[LaunchDescriptionEntity]:
    """Return the driver of a single patch."""
    if given.get["only"]:
        raise RuntimeError("only selects patches of a body file: also set patches:=…")
    own_values(given)  # refuses what the driver would not take, or would take nothing from
    namespace = given.get["namespace"].strip("/")  # below what was pushed, by launch itself
    return [driver(namespace, params_path(given), overriding(given))]


def overriding(given: Given) -> dict[str, Value]:
    """Return the parameters of a single skin that those of its file give way to."""
    over, port, frame_id = dict(given.parameters), given.get["port"], given.get["frame_id"]
    # options stay, as in port:=sim://?scene=hand
    if true_or_false("sim", given.get["sim"]) and not port.startswith(SIMULATION):
        port = SIMULATION
    if not frame_id and given.namespace and own_values(given)["frame_id"] == DEFAULTS["frame_id"]:
        frame_id = f"{given.namespace}/{NODE_NAME}"  # or the skins of two namespaces would share it
    return over | {name: text for name, text in (("port", port), ("frame_id", frame_id)) if text}


def own_values(given: Given) -> Values:
    """Return what a single skin has without arguments."""
    return {**DEFAULTS, **read_file(params_path(given), given.node)}


def skin_values(given: Given) -> Values:
    """Return all parameters of a single skin."""
    return {**own_values(given), **overriding(given)}


def params_path(given: Given) -> Path:
    """Return the path of its parameter file."""
    return found(given.get["params_file"], "parameter file")


def found(text: str, kind: str) -> Path:
    """Return the path of a file, relative to the working folder or to this package."""
    path = user_path(kind, text)
    own = SHARE / path
    return own if own.is_file() and not path.is_file() else existing(path, kind).absolute()


def whole_body(given: Given, names: list[str]) -> list[LaunchDescriptionEntity]:
    """Return the drivers of a body's patches and the body's node; all are restarted if they die."""
    for name in names:
        if name not in FOR_BODIES and given.get.get(name, "") != OWN.get(name):
            raise RuntimeError(f"{name} is for a single patch; the body file sets it")
    path = found(given.get["patches"], "body file")
    body = read_body(path, given.namespace)
    again = {"output": "screen", "respawn": True, "respawn_delay": RESPAWN_DELAY_S}
    actions = [
        driver(patches[0].namespace, patches[0].params_file, patches[0].parameters, respawn=True)
        if len(patches) == 1
        else Node(
            package="tactile_cdma",
            executable="skin_patches",
            namespace=body.within or "/",
            arguments=[str(path), "--only", ",".join(patch.name for patch in patches)],
            **again,
        )
        for patches in body.processes(given.get["only"])
    ]
    if true_or_false("body", given.get["body"]):
        stale = {
            name: value for name, value in given.parameters.items() if name == STALE_AFTER.name
        }
        actions.append(
            Node(
                package="tactile_cdma",
                executable="skin_body",
                namespace=body.within or "/",
                name="body",
                parameters=[{"body_file": str(path), **stale}],
                **again,
            )
        )
    return actions


def driver(
    namespace: str, params_file: Path | str | None, parameters: Mapping[str, Value], **options: Any
) -> Node:
    """Return one driver; its parameters override those of the file.

    As a LifecycleNode, launch listens to its transitions, for who waits for them.
    """
    overrides = {
        # a str even if the text looks like a number
        name: ParameterValue(value, value_type=str) if isinstance(value, str) else value
        for name, value in parameters.items()
    }
    return LifecycleNode(
        package="tactile_cdma",
        executable="skin_driver",
        name=NODE_NAME,
        namespace=namespace,
        parameters=[*([str(params_file)] if params_file else []), overrides],
        output="screen",
        respawn_delay=RESPAWN_DELAY_S,
        **options,
    )


def rviz(given: Given) -> LaunchDescriptionEntity:
    """Return rviz2 with the displays asked for, or a log message if it is not installed."""
    frame_id, view = body_displays(given) if given.get["patches"] else skin_displays(given)
    try:
        get_package_prefix("rviz2")
    except PackageNotFoundError:
        return LogInfo(msg="rviz2 is not installed (apt install ros-$ROS_DISTRO-rviz2): not shown")
    namespace = given.namespace
    if isinstance(view, Path):
        # A file of the user's own may name the topics of a skin without namespace.
        path, topics = view, [f"/{NODE_NAME}/{topic}" for topic in RVIZ_TOPICS if namespace]
    else:
        path, topics = Path(launch_config.log_dir) / "skin.rviz", []
        path.write_text(view)
    return Node(
        package="rviz2",
        executable="rviz2",
        name="skin_rviz",
        namespace=given.get["namespace"].strip("/"),
        arguments=["-d", str(path), "-f", frame_id],
        remappings=[(topic, f"/{namespace}{topic}") for topic in topics],
    )


def skin_displays(given: Given) -> tuple[str, Path | str]:
    """Return the fixed frame of a single skin, and an rviz file: its path or its text."""
    values, asked = skin_values(given), given.get["rviz"].lower()
    frame_id = str(values["frame_id"])
    if asked == BODY:
        raise RuntimeError("rviz:=body shows the patches of a body file: also set patches:=…")
    if asked not in VIEWS:
        return frame_id, own_displays(given)
    layout = SkinConfig.of({name: values[name] for name in BY_NAME}).layout
    bent = asked == CURVED or bool(np.ptp(layout.normals, axis=0).any())
    template = SHARE / "config" / ("curved_skin.rviz" if bent else "skin.rviz")
    return frame_id, skin_view(template, layout, frame_id, given.node)


def body_displays(given: Given) -> tuple[str, Path | str]:
    """Return the same of a body."""
    path, asked = found(given.get["patches"], "body file"), given.get["rviz"].lower()
    body = read_body(path, given.namespace)
    if asked == CURVED:
        raise RuntimeError("rviz:=curved shows a single skin: leave patches out, or set rviz:=body")
    if asked not in VIEWS:
        return body.frame_id, own_displays(given)
    return body.frame_id, body_view(SHARE / "config" / "body.rviz", body)


def own_displays(given: Given) -> Path:
    """Return the path of an rviz file of the user's own."""
    path = user_path("rviz", given.get["rviz"])
    if not path.is_file():
        text = unknown(given.get["rviz"], (FALSE, *VIEWS), "value of rviz")
        raise RuntimeError(
            f"{text} (there are {FALSE}, {', '.join(VIEWS)}, or an rviz file's path)"
        )
    return path
