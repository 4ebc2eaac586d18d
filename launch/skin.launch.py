# SPDX-License-Identifier: Apache-2.0

"""Starts the driver of one skin patch: `ros2 launch tactile_cdma skin.launch.py sim:=true`.

Without `port`, `sim` or a port in the parameter file the driver runs the simulated skin as well,
and warns of it in its log and in /diagnostics. An argument that does not exist is an error.

With `patches`, starts the drivers of a body of many patches and the node that combines their
contacts: `ros2 launch tactile_cdma skin.launch.py patches:=config/body.yaml`. Drivers configure and
activate themselves, so plain `Node` actions suffice.
"""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from tactile_cdma.base.errors import TactileError
from tactile_cdma.config.arguments import check_launch_arguments, existing_params
from tactile_cdma.config.body_file import NODE_NAME, read_body
from tactile_cdma.config.parameters import Value

SHARE = Path(__file__).parent.parent  # of the installed package, or the checkout
PARAMS = str(SHARE / "config" / "skin.yaml")
RVIZ_TOPICS = ("heatmap", "markers", "points", "pressure_image", "wrench")
OF_ONE_PATCH = ("port", "namespace", "frame_id")
RESPAWN_DELAY_S = 2.0


def generate_launch_description() -> LaunchDescription:
    arguments = [
        DeclareLaunchArgument(
            "params_file",
            default_value=PARAMS,
            description="ROS 2 parameter file of the driver",
        ),
        DeclareLaunchArgument(
            "port",
            default_value="",
            description="pyserial URL of the digitizer; empty: the one in params_file, or, with "
            "a warning, the simulated skin",
        ),
        DeclareLaunchArgument(
            "sim",
            default_value="false",
            choices=["true", "false"],
            description="use the simulated skin (port sim://)",
        ),
        DeclareLaunchArgument(
            "namespace",
            default_value="",
            description="namespace of the node: left gives /left/skin/tactile",
        ),
        DeclareLaunchArgument(
            "frame_id",
            default_value="",
            description="tf frame of the skin; empty: the one in params_file",
        ),
        DeclareLaunchArgument(
            "rviz",
            default_value="false",
            choices=["true", "false"],
            description="show the skin, or the body, in rviz2",
        ),
        DeclareLaunchArgument(
            "patches",
            default_value="",
            description="body file of many patches; it replaces the arguments above, except rviz",
        ),
        DeclareLaunchArgument(
            "only",
            default_value="",
            description="patches of the body file to start: left_palm,right_palm; empty: all",
        ),
        DeclareLaunchArgument(
            "body",
            default_value="true",
            choices=["true", "false"],
            description="with patches: also start the node that combines their contacts",
        ),
    ]
    names = [argument.name for argument in arguments]
    return LaunchDescription([*arguments, OpaqueFunction(function=start, args=[names])])


def start(context: LaunchContext, names: list[str]) -> list[LaunchDescriptionEntity]:
    """Return the nodes that the arguments ask for. names: of all arguments."""
    get = context.launch_configurations
    try:
        # A launch file that includes this one has arguments of its own on the command line.
        if any(Path(word).name == Path(__file__).name for word in sys.argv):
            check_launch_arguments(sys.argv, names)
        actions = whole_body(get) if get["patches"] else one_patch(get)
    except TactileError as error:
        raise RuntimeError(str(error)) from None  # launch prints it and ends
    if get["rviz"] == "true":
        actions.append(rviz(get))
    return actions


def one_patch(get: dict[str, str]) -> list[LaunchDescriptionEntity]:
    """Return the driver of a single patch."""
    if get["only"]:
        raise RuntimeError("only selects patches of a body file: also set patches:=…")
    overrides = {"port": get["port"], "frame_id": get["frame_id"]}
    # options stay, as in port:=sim://?scene=hand
    if get["sim"] == "true" and not overrides["port"].startswith("sim://"):
        overrides["port"] = "sim://"
    parameters = {name: value for name, value in overrides.items() if value}
    params_file = existing_params(Path(get["params_file"]).expanduser())
    return [driver(get["namespace"].strip("/"), params_file, parameters)]


def whole_body(get: dict[str, str]) -> list[LaunchDescriptionEntity]:
    """Return the drivers of a body's patches and the body's node; all are restarted if they die."""
    given = [name for name in OF_ONE_PATCH if get[name]] + ["sim"] * (get["sim"] == "true")
    given += ["params_file"] * (get["params_file"] != PARAMS)
    if given:
        raise RuntimeError(f"{given[0]} is for a single patch; the body file sets it")
    path = Path(get["patches"]).expanduser().absolute()
    patches = read_body(path).only(get["only"])
    actions = [
        driver(patch.name, patch.params_file, patch.parameters, respawn=True) for patch in patches
    ]
    if get["body"] == "true":
        actions.append(
            Node(
                package="tactile_cdma",
                executable="skin_body",
                namespace="",
                name="body",
                parameters=[{"body_file": str(path)}],
                output="screen",
                respawn=True,
                respawn_delay=RESPAWN_DELAY_S,
            )
        )
    return actions


def driver(
    namespace: str, params_file: Path | str | None, parameters: Mapping[str, Value], **options: Any
) -> Node:
    """Return one driver; its parameters override those of the file."""
    overrides = {
        # a str even if the text looks like a number
        name: ParameterValue(value, value_type=str) if isinstance(value, str) else value
        for name, value in parameters.items()
    }
    return Node(
        package="tactile_cdma",
        executable="skin_driver",
        name=NODE_NAME,
        namespace=namespace,
        parameters=[*([str(params_file)] if params_file else []), overrides],
        output="screen",
        respawn_delay=RESPAWN_DELAY_S,
        **options,
    )


def rviz(get: dict[str, str]) -> LaunchDescriptionEntity:
    """Return rviz2 with our displays, or a log message if it is not installed."""
    try:
        get_package_prefix("rviz2")
    except PackageNotFoundError:
        return LogInfo(msg="rviz2 is not installed (apt install ros-$ROS_DISTRO-rviz2): not shown")
    namespace = get["namespace"].strip("/")
    # skin.rviz names the topics of a skin without namespace.
    topics = [f"/{NODE_NAME}/{topic}" for topic in RVIZ_TOPICS] if namespace else []
    displays = "body.rviz" if get["patches"] else "skin.rviz"
    return Node(
        package="rviz2",
        executable="rviz2",
        name="skin_rviz",
        namespace=namespace,
        arguments=["-d", str(SHARE / "config" / displays)],
        remappings=[(topic, f"/{namespace}{topic}") for topic in topics],
    )
