"""Starts the driver of one skin patch: `ros2 launch tactile_cdma skin.launch.py sim:=true`.

The node configures and activates itself, so plain nodes need no help from launch.
"""

from pathlib import Path

from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

SHARE = Path(__file__).parent.parent  # of the installed package, or the checkout
NODE_NAME = "skin"
RVIZ_TOPICS = ("heatmap",)


def generate_launch_description() -> LaunchDescription:
    arguments = [
        DeclareLaunchArgument(
            "params_file",
            default_value=str(SHARE / "config" / "skin.yaml"),
            description="parameters of the driver",
        ),
        DeclareLaunchArgument(
            "port",
            default_value="",
            description="pyserial URL of the digitizer; empty: the one in params_file",
        ),
        DeclareLaunchArgument(
            "sim",
            default_value="false",
            choices=["true", "false"],
            description="use the simulated skin, port sim://",
        ),
        DeclareLaunchArgument(
            "namespace",
            default_value="",
            description="put before the node's name: left gives /left/skin/tactile",
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
            description="show the heatmap in rviz2",
        ),
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=start)])


def start(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    """Return what the arguments ask for."""

    def get(name: str) -> str:
        return LaunchConfiguration(name).perform(context)

    overrides = {"port": get("port"), "frame_id": get("frame_id")}
    # options stay, as in port:=sim://?scene=hand
    if get("sim") == "true" and not overrides["port"].startswith("sim://"):
        overrides["port"] = "sim://"
    namespace = get("namespace").strip("/")
    actions: list[LaunchDescriptionEntity] = [
        Node(
            package="tactile_cdma",
            executable="skin_driver",
            name=NODE_NAME,
            namespace=namespace,
            parameters=[
                get("params_file"),
                # str even where the text looks like a number
                {k: ParameterValue(v, value_type=str) for k, v in overrides.items() if v},
            ],
            output="screen",
        )
    ]
    if get("rviz") == "true":
        actions.append(rviz(namespace))
    return actions


def rviz(namespace: str) -> LaunchDescriptionEntity:
    """Return rviz2 with our displays, or a remark where it is not installed."""
    try:
        get_package_prefix("rviz2")
    except PackageNotFoundError:
        return LogInfo(msg="rviz2 is not installed (apt install ros-$ROS_DISTRO-rviz2): not shown")
    # skin.rviz names the topics of a skin without namespace.
    topics = [f"/{NODE_NAME}/{topic}" for topic in RVIZ_TOPICS] if namespace else []
    return Node(
        package="rviz2",
        executable="rviz2",
        name="skin_rviz",
        namespace=namespace,
        arguments=["-d", str(SHARE / "config" / "skin.rviz")],
        remappings=[(topic, f"/{namespace}{topic}") for topic in topics],
    )
