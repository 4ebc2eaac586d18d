"""skin.launch.py: what each argument changes, and a real start with the simulated skin."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("launch_ros", reason="launch_ros comes with a ROS 2 installation, not PyPI")
rclpy = pytest.importorskip("rclpy")

from launch import LaunchContext, LaunchDescription  # noqa: E402
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction  # noqa: E402
from launch_ros.actions import Node  # noqa: E402
from launch_ros.utilities import evaluate_parameters  # noqa: E402

pytestmark = pytest.mark.ros
LAUNCH_FILE = Path(__file__).resolve().parents[2] / "launch" / "skin.launch.py"


def load() -> Any:
    spec = importlib.util.spec_from_file_location("skin_launch", LAUNCH_FILE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def actions(**arguments: str) -> tuple[list[Any], LaunchContext]:
    """The actions that launch would execute with these arguments."""
    context = LaunchContext()
    context.launch_configurations.update(arguments)
    found: list[Any] = []
    description: LaunchDescription = load().generate_launch_description()
    for entity in description.entities:
        if isinstance(entity, DeclareLaunchArgument):
            entity.execute(context)
        elif isinstance(entity, OpaqueFunction):
            found += entity.execute(context) or []
    return found, context


def driver(**arguments: str) -> tuple[Node, Path, dict[str, object]]:
    """The driver's action, its parameter file and the parameters that override it."""
    (node,), context = actions(**arguments)
    params_file, overrides = evaluate_parameters(context, node._Node__parameters)
    node._perform_substitutions(context)
    return node, Path(params_file), dict(overrides)


def test_without_arguments_the_parameter_file_rules() -> None:
    node, params_file, overrides = driver()
    assert params_file.name == "skin.yaml" and params_file.is_file()
    assert overrides == {}
    assert node.node_name == "/skin"


@pytest.mark.parametrize(
    ("arguments", "overrides"),
    [
        ({"sim": "true"}, {"port": "sim://"}),
        ({"port": "/dev/ttyACM3"}, {"port": "/dev/ttyACM3"}),
        ({"port": "/dev/ttyACM3", "sim": "true"}, {"port": "sim://"}),
        ({"port": "sim://?scene=hand", "sim": "true"}, {"port": "sim://?scene=hand"}),
        ({"port": "7"}, {"port": "7"}),  # a text, though YAML would make a number of it
        ({"frame_id": "left_palm"}, {"frame_id": "left_palm"}),
    ],
)
def test_arguments_override_the_file(arguments: dict[str, str], overrides: dict[str, str]) -> None:
    assert driver(**arguments)[2] == overrides


def test_parameter_file_and_namespace(tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    own.write_text("/**: {ros__parameters: {nodes: 9}}\n")
    node, params_file, _ = driver(params_file=str(own), namespace="/left")
    assert params_file == own
    assert node.node_name == "/left/skin"


def test_arguments_are_checked() -> None:
    with pytest.raises(RuntimeError, match="sim"):
        actions(sim="perhaps")


def test_rviz_is_started_or_its_absence_told() -> None:
    (_, extra), _ = actions(rviz="true", namespace="left")
    assert isinstance(extra, LogInfo if shutil.which("rviz2") is None else Node)


@pytest.mark.slow
@pytest.mark.parametrize("namespace", ["", "left"])
def test_simulated_skin_starts_and_publishes(namespace: str) -> None:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    ros2 = shutil.which("ros2", path=path)
    if ros2 is None:
        pytest.skip("the command ros2 is missing")
    from rclpy.qos import qos_profile_sensor_data

    from tactile_cdma.msg import TactileArray

    command = [ros2, "launch", str(LAUNCH_FILE), "sim:=true"]
    command += [f"namespace:={namespace}"] if namespace else []
    launch = subprocess.Popen(
        command,
        env={**os.environ, "PATH": path},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    received: list[TactileArray] = []
    rclpy.init()
    try:
        listener = rclpy.create_node("listener")
        topic = f"/{namespace}/skin/tactile".replace("//", "/")
        listener.create_subscription(TactileArray, topic, received.append, qos_profile_sensor_data)
        deadline = time.monotonic() + 20
        while len(received) < 10 and time.monotonic() < deadline and launch.poll() is None:
            rclpy.spin_once(listener, timeout_sec=0.1)
    finally:
        rclpy.shutdown()
        launch.send_signal(signal.SIGINT)  # without a terminal, launch passes it on
        try:
            output, _ = launch.communicate(timeout=20)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(launch.pid, signal.SIGKILL)  # what is left of it
    assert len(received) >= 10, output
    assert len(received[-1].pressure) == 16
    assert launch.returncode == 0, output
    assert "Traceback" not in output
