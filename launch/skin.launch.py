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

import numpy as np
from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction
from launch.logging import launch_config
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from tactile_cdma.base.errors import TactileError
from tactile_cdma.base.named_file import existing
from tactile_cdma.config.arguments import check_launch_arguments
from tactile_cdma.config.body_file import NODE_NAME, read_body
from tactile_cdma.config.parameters import (
    DEFAULTS,
    SIMULATION,
    Value,
    Values,
    read_file,
    unknown,
)
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.ros.rviz_file import body_view, skin_view

SHARE = Path(__file__).parent.parent  # of the installed package, or the checkout
PARAMS = str(SHARE / "config" / "skin.yaml")
RVIZ_TOPICS = ("heatmap", "markers", "points", "pressure_image", "wrench")
OF_ONE_PATCH = ("port", "namespace", "frame_id")
VIEWS = TRUE, CURVED, BODY = "true", "curved", "body"
"""Values of `rviz` for which a file is made to measure."""
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
            description="show it in rviz2: true, curved (a bent skin, seen in space), body (with "
            "patches), or the path of an rviz file",
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
        if get["rviz"] != "false":
            actions.append(rviz(get))
    except TactileError as error:
        raise RuntimeError(str(error)) from None  # launch prints it and ends
    return actions


def one_patch(get: dict[str, str]) -> list[LaunchDescriptionEntity]:
    """Return the driver of a single patch."""
    if get["only"]:
        raise RuntimeError("only selects patches of a body file: also set patches:=…")
    skin_values(get)  # refuses what the driver would not take, or would take nothing from
    return [driver(get["namespace"].strip("/"), params_path(get), overriding(get))]


def overriding(get: dict[str, str]) -> dict[str, Value]:
    """Return the parameters of a single skin that are given as arguments."""
    given = {"port": get["port"], "frame_id": get["frame_id"]}
    # options stay, as in port:=sim://?scene=hand
    if get["sim"] == "true" and not given["port"].startswith(SIMULATION):
        given["port"] = SIMULATION
    return {name: value for name, value in given.items() if value}


def skin_values(get: dict[str, str]) -> Values:
    """Return all parameters of a single skin."""
    return {**DEFAULTS, **read_file(params_path(get), node_of(get)), **overriding(get)}


def params_path(get: dict[str, str]) -> Path:
    """Return the path of its parameter file."""
    return existing(Path(get["params_file"]).expanduser())


def node_of(get: dict[str, str]) -> str:
    """Return the fully qualified name of its node."""
    return "/".join(["", *filter(None, [get["namespace"].strip("/")]), NODE_NAME])


def whole_body(get: dict[str, str]) -> list[LaunchDescriptionEntity]:
    """Return the drivers of a body's patches and the body's node; all are restarted if they die."""
    given = [name for name in OF_ONE_PATCH if get[name]] + ["sim"] * (get["sim"] == "true")
    given += ["params_file"] * (get["params_file"] != PARAMS)
    if given:
        raise RuntimeError(f"{given[0]} is for a single patch; the body file sets it")
    path = existing(Path(get["patches"]).expanduser(), "body file").absolute()
    processes = read_body(path).processes(get["only"])
    actions = [
        driver(patches[0].name, patches[0].params_file, patches[0].parameters, respawn=True)
        if len(patches) == 1
        else Node(
            package="tactile_cdma",
            executable="skin_patches",
            arguments=[str(path), "--only", ",".join(patch.name for patch in patches)],
            output="screen",
            respawn=True,
            respawn_delay=RESPAWN_DELAY_S,
        )
        for patches in processes
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
    """Return rviz2 with the displays asked for, or a log message if it is not installed."""
    frame_id, view = body_displays(get) if get["patches"] else skin_displays(get)
    try:
        get_package_prefix("rviz2")
    except PackageNotFoundError:
        return LogInfo(msg="rviz2 is not installed (apt install ros-$ROS_DISTRO-rviz2): not shown")
    namespace = get["namespace"].strip("/")
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
        namespace=namespace,
        arguments=["-d", str(path), "-f", frame_id],
        remappings=[(topic, f"/{namespace}{topic}") for topic in topics],
    )


def skin_displays(get: dict[str, str]) -> tuple[str, Path | str]:
    """Return the fixed frame of a single skin, and an rviz file: its path or its text."""
    values = skin_values(get)
    frame_id = str(values["frame_id"])
    if get["rviz"] == BODY:
        raise RuntimeError("rviz:=body shows the patches of a body file: also set patches:=…")
    if get["rviz"] not in VIEWS:
        return frame_id, own_displays(get)
    layout = SkinConfig.of(values).layout
    bent = get["rviz"] == CURVED or bool(np.ptp(layout.normals, axis=0).any())
    template = SHARE / "config" / ("curved_skin.rviz" if bent else "skin.rviz")
    return frame_id, skin_view(template, layout, frame_id, node_of(get))


def body_displays(get: dict[str, str]) -> tuple[str, Path | str]:
    """Return the same of a body."""
    body = read_body(Path(get["patches"]).expanduser().absolute())
    if get["rviz"] == CURVED:
        raise RuntimeError("rviz:=curved shows a single skin: leave patches out, or set rviz:=body")
    if get["rviz"] not in VIEWS:
        return body.frame_id, own_displays(get)
    return body.frame_id, body_view(SHARE / "config" / "body.rviz", body)


def own_displays(get: dict[str, str]) -> Path:
    """Return the path of an rviz file of the user's own."""
    path = Path(get["rviz"]).expanduser()
    if not path.is_file():
        text = unknown(get["rviz"], ("false", *VIEWS), "value of rviz")
        raise RuntimeError(f"{text} (there are false, {', '.join(VIEWS)}, or an rviz file's path)")
    return path
