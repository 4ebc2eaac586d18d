# SPDX-License-Identifier: Apache-2.0

"""skin.launch.py: what each argument changes, and a real start with the simulated skin."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import yaml

pytest.importorskip("launch_ros", reason="launch_ros comes with a ROS 2 installation, not PyPI")
import rclpy
from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from launch import LaunchContext
from launch.actions import IncludeLaunchDescription, LogInfo
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch_ros.actions import Node
from launch_ros.utilities import evaluate_parameters

from tactile_cdma.config.arguments import launch_values
from test.support.programs import run_python
from test.support.scripts import loaded
from test.support.waiting import PATIENCE_S

ROOT = Path(__file__).resolve().parents[2]
LAUNCH_FILE = ROOT / "launch" / "skin.launch.py"
PATH = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
"""The executables of the package begin with `env python3`: it has to be this one."""
BODY_FILE = ROOT / "config" / "body.yaml"


def actions(
    within: LaunchContext | None = None, **arguments: str
) -> tuple[list[Any], LaunchContext]:
    """The actions that launch would execute with these arguments; within: what it was before."""
    context, found = within or LaunchContext(), list[Any]()
    source = PythonLaunchDescriptionSource(str(LAUNCH_FILE))

    def visit(entity: Any) -> None:
        for inner in entity.visit(context) or ():
            if isinstance(inner, Node | LogInfo):
                found.append(inner)
            else:
                visit(inner)

    visit(IncludeLaunchDescription(source, launch_arguments=arguments.items()))
    return found, context


def driver(
    within: LaunchContext | None = None, **arguments: str
) -> tuple[Node, Path, dict[str, object]]:
    """The driver's action, its parameter file and the parameters that override it."""
    (node,), context = actions(within, **arguments)
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
        ({"sim": "True", "body": "False"}, {"port": "sim://"}),
        (
            {"nodes": "64", "chip_us": "20", "timing": "gap"},
            {"nodes": 64, "chip_us": 20.0, "timing": "gap"},
        ),
        ({"mount_xyz_m": "[0, 0.1, 1e-2]"}, {"mount_xyz_m": (0.0, 0.1, 0.01)}),
        ({"use_sim_time": "True"}, {"use_sim_time": True}),
        ({"namespace": "left"}, {"frame_id": "left/skin"}),  # not that of the right one
        ({"namespace": "left", "frame_id": "skin"}, {"frame_id": "skin"}),
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


def test_arguments_of_the_file_that_includes_it_neither_leak_in_nor_are_lost() -> None:
    robot = LaunchContext()
    theirs = dict.fromkeys(
        ("params_file", "port", "namespace", "rviz", "sim", "body", "nodes"), "x"
    )
    robot.launch_configurations.update(theirs | {"ros_namespace": "/robot/left"})
    node, params_file, overrides = driver(robot, frame_id="palm")
    assert (params_file.name, overrides) == ("skin.yaml", {"frame_id": "palm"})
    assert node.node_name == "/robot/left/skin"
    own = {name: value for name, value in robot.launch_configurations.items() if name in theirs}
    assert own == theirs
    assert not {"only", "patches"} & robot.launch_configurations.keys()
    node, _, overrides = driver(robot, namespace="hand")
    assert (node.node_name, overrides["frame_id"]) == (
        "/robot/left/hand/skin",
        "robot/left/hand/skin",
    )
    found, context = actions(robot, patches=str(BODY_FILE))
    assert names_of(found, context)[0] == "/robot/left/chest/skin"


def test_a_parameter_file_is_looked_for_in_the_package_too(tmp_path: Path) -> None:
    with contextlib.chdir(tmp_path):
        assert driver(params_file="config/wired_skin.yaml")[1].samefile(
            ROOT / "config" / "wired_skin.yaml"
        )
        (tmp_path / "config").mkdir()
        (tmp_path / "config" / "wired_skin.yaml").write_text("skin: {ros__parameters: {nodes: 9}}")
        assert driver(params_file="config/wired_skin.yaml")[1].is_relative_to(tmp_path)


def test_rviz_is_started_or_its_absence_told() -> None:
    (_, extra), _ = actions(rviz="true", namespace="left")
    try:
        get_package_prefix("rviz2")
    except PackageNotFoundError:
        assert isinstance(extra, LogInfo)
    else:
        assert isinstance(extra, Node)


def displays(**arguments: str) -> tuple[str, Any]:
    """The fixed frame, and what rviz would be given: a path, or the content made for it."""
    launch_file = loaded(LAUNCH_FILE)
    given = launch_file.Given(*launch_values(arguments, launch_file.OWN), "")
    of = launch_file.body_displays if "patches" in arguments else launch_file.skin_displays
    frame_id, view = of(given)
    return frame_id, view if isinstance(view, Path) else yaml.safe_load(view)


def markers_of(view: Any) -> list[str]:
    shown = view["Visualization Manager"]["Displays"]
    return [item["Topic"]["Value"] for item in shown if item["Class"].endswith("/MarkerArray")]


def test_rviz_looks_at_the_frame_of_the_argument_or_of_the_parameter_file(tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    own.write_text("/left/skin: {ros__parameters: {frame_id: palm}}\n")
    for arguments, frame_id in (
        ({}, "skin"),
        ({"frame_id": "thumb"}, "thumb"),
        ({"params_file": str(own), "namespace": "left"}, "palm"),
        ({"params_file": str(own), "namespace": "left", "frame_id": "thumb"}, "thumb"),
    ):
        found, view = displays(rviz="true", **arguments)
        assert found == frame_id
        assert view["Visualization Manager"]["Global Options"]["Fixed Frame"] == frame_id
        namespace = f"/{arguments['namespace']}" if "namespace" in arguments else ""
        assert markers_of(view) == [f"{namespace}/skin/markers"]


def test_rviz_shows_flat_skins_with_a_heatmap_and_bent_ones_in_space(tmp_path: Path) -> None:
    bent = tmp_path / "bent.yaml"
    layout = ROOT / "config" / "layouts" / "cylinder.yaml"
    given = f"nodes: 72, frame_period_ms: 40.0, layout_file: {layout}"
    bent.write_text(f"skin: {{ros__parameters: {{{given}}}}}\n")
    pictures = [
        any(item["Class"].endswith("/Image") for item in view["Visualization Manager"]["Displays"])
        for _, view in (
            displays(rviz="true"),
            displays(rviz="curved"),
            displays(rviz="true", params_file=str(bent)),
        )
    ]
    assert pictures == [True, False, False]


def test_rvizs_view_of_a_body_follows_the_body_file(tmp_path: Path) -> None:
    path = tmp_path / "arm.yaml"
    path.write_text(
        "frame_id: arm\npatches:\n  thumb: {parameters: {mount_xyz_m: [3.0, 0.0, 0.0]}}\n"
        "  palm: {parameters: {mount_xyz_m: [1.0, 0.0, 0.0]}}\n"
    )
    for rviz in ("true", "body"):
        frame_id, view = displays(rviz=rviz, patches=str(path))
        assert frame_id == "arm"
        names, *markers = markers_of(view)
        assert names == "/body/names"
        assert markers == ["/thumb/skin/markers", "/palm/skin/markers"]
        focus = view["Visualization Manager"]["Views"]["Current"]["Focal Point"]
        assert focus == {"X": 2.0, "Y": 0.0, "Z": 0.0}


def test_an_rviz_file_of_the_users_own_is_taken_as_it_is(tmp_path: Path) -> None:
    own = tmp_path / "own.rviz"
    own.write_text("Panels: []\n")
    assert displays(rviz=str(own), frame_id="palm") == ("palm", own)
    assert displays(rviz=str(own), patches=str(BODY_FILE)) == ("body", own)


def test_files_of_launch_may_be_those_of_installed_packages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    share = tmp_path / "share" / "my_hand"
    share.mkdir(parents=True)
    (share / "own.yaml").write_text("skin: {ros__parameters: {frame_id: palm}}")
    (share / "own.rviz").write_text("Panels: []\n")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    own = "package://my_hand/own.yaml"
    assert driver(params_file=own)[1] == share / "own.yaml"
    assert displays(rviz="package://my_hand/own.rviz", params_file=own) == (
        "palm",
        share / "own.rviz",
    )
    with pytest.raises(RuntimeError, match="no package 'my_arm' in AMENT_PREFIX_PATH"):
        actions(patches="package://my_arm/body.yaml")


def test_a_body_is_a_driver_per_patch_and_the_node_that_gathers() -> None:
    found, context = actions(patches=str(BODY_FILE))
    assert names_of(found, context) == [
        "/chest/skin",
        "/left_forearm/skin",
        "/right_forearm/skin",
        "/left_palm/skin",
        "/right_elbow/skin",
        "/body",
    ]
    (file, given) = evaluate_parameters(context, found[3]._Node__parameters)
    assert Path(file) == ROOT / "config" / "skin.yaml"
    assert given == {
        "frame_id": "left_palm",
        "port": "sim://?scene=press",
        "pitch_mm": 15.0,
        "parent_frame": "body",
        "mount_xyz_m": (0.31, 0.15, 0.22),
        "mount_rpy_rad": (3.1416, 0.0, 0.0),
    }
    ((body,),) = [evaluate_parameters(context, found[-1]._Node__parameters)]
    assert body == {"body_file": str(BODY_FILE)}


def names_of(found: list[Any], context: LaunchContext) -> list[str]:
    for node in found:
        node._perform_substitutions(context)
    return [node.node_name for node in found]


def test_a_body_inside_a_namespace_has_its_nodes_and_frames_there(tmp_path: Path) -> None:
    """As inside PushRosNamespace; a process of many patches is told by rcl's own argument."""
    path = tmp_path / "body.yaml"
    patch = "{parameters: {mount_xyz_m: [0.0, 0.0, 0.0]}}"
    text = (
        f"process: {{hand: [palm, thumb]}}\npatches: {{back: {patch}, palm: {patch}, thumb: {{}}}}"
    )
    path.write_text(text)
    robot = LaunchContext()
    robot.launch_configurations["ros_namespace"] = "/r1"
    found, context = actions(robot, patches=str(path), stale_after_s="0.3", rviz=str(path))
    *nodes, _ = found  # rviz, or that it is missing
    assert names_of(nodes, context)[1:] == ["/r1/back/skin", "/r1/body"]
    hand, back, body = nodes
    assert [str(path), "--only", "palm,thumb"] == [
        words[0].text for words in hand._ExecuteLocal__process_description.cmd[1:4]
    ]
    assert hand.expanded_node_namespace == "/r1"
    [given] = evaluate_parameters(context, back._Node__parameters)
    assert (given["frame_id"], given["parent_frame"]) == ("r1/back", "r1/body")
    [given] = evaluate_parameters(context, body._Node__parameters)
    assert given == {"body_file": str(path), "stale_after_s": 0.3}
    found, context = actions(patches=str(path), namespace="r2")
    assert names_of(found, context)[1:] == ["/r2/back/skin", "/r2/body"]
    found, context = actions(robot, patches=str(path), namespace="arm")
    assert names_of(found, context)[1:] == ["/r1/arm/back/skin", "/r1/arm/body"]
    frame_id, view = displays(rviz="true", patches=str(path), namespace="r2")
    assert frame_id == "r2/body"
    topics = {"/r2/body/names", *(f"/r2/{name}/skin/markers" for name in ("back", "palm", "thumb"))}
    assert set(markers_of(view)) == topics


def test_a_computer_may_have_a_share_of_the_body() -> None:
    found, context = actions(patches=str(BODY_FILE), only="left_palm", body="false")
    (node,) = found
    node._perform_substitutions(context)
    assert node.node_name == "/left_palm/skin"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"params_file": "none.yaml"}, "no parameter file .*/none.yaml"),
        ({"params_file": str(ROOT / "config" / "skn.yaml")}, r"did you mean .*config/skin\.yaml\?"),
        ({"params_file": "nowhere/wired_skin.yaml"}, r"did you mean .*config/wired_skin\.yaml\?"),
        ({"prot": "/dev/ttyACM0"}, "unknown launch argument 'prot'; did you mean 'port'"),
        ({"sim": "perhaps"}, "sim is 'perhaps'; it must be true or false"),
        ({"nodes": "many"}, "nodes must be an integer, got 'many'"),
        ({"patches": str(BODY_FILE), "nodes": "9"}, "nodes is for a single patch"),
        ({"patches": str(BODY_FILE), "frame_id": "palm"}, "frame_id is for a single patch"),
        ({"patches": str(BODY_FILE), "stale_after_s": "soon"}, "stale_after_s must be a number"),
        ({"rviz": "tru"}, "unknown value of rviz 'tru'; did you mean 'true'?"),
        ({"rviz": "body"}, "also set patches"),
        ({"rviz": "curved", "patches": str(BODY_FILE)}, "set rviz:=body"),
        ({"patches": "none.yaml"}, "no body file .*/none.yaml"),
        ({"patches": "nowhere/body.yaml"}, r"did you mean .*config/body\.yaml\?"),
        ({"patches": str(BODY_FILE), "only": "nose"}, "no patch 'nose' to start; there are chest"),
        ({"patches": str(BODY_FILE), "port": "/dev/x"}, "port is for a single patch"),
        ({"patches": str(BODY_FILE), "sim": "true"}, "sim is for a single patch"),
        ({"patches": str(BODY_FILE), "params_file": "a.yaml"}, "params_file is for a single patch"),
        ({"only": "left_palm"}, "only selects patches of a body file"),
    ],
)
def test_what_cannot_be_launched_is_one_error(arguments: dict[str, str], message: str) -> None:
    with pytest.raises(RuntimeError, match=message):
        actions(**arguments)


def test_a_parameter_file_of_another_node_is_refused(tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    own.write_text("/left/skin: {ros__parameters: {nodes: 9}}\n")
    assert driver(params_file=str(own), namespace="left")[1] == own
    with pytest.raises(RuntimeError, match="for /left/skin, and this node is /right/skin"):
        actions(params_file=str(own), namespace="right")
    own.write_text("/**: {ros__parameters: {node: 9}}\n")
    with pytest.raises(RuntimeError, match="'node'; did you mean 'nodes'"):
        actions(params_file=str(own))


@pytest.mark.slow
@pytest.mark.parametrize("namespace", ["", "left"])
def test_simulated_skin_starts_and_publishes(namespace: str) -> None:
    ros2 = shutil.which("ros2", path=PATH)
    if ros2 is None:
        pytest.skip("the command ros2 is missing")
    from rclpy.qos import qos_profile_sensor_data

    from tactile_cdma.msg import TactileArray

    command = [ros2, "launch", str(LAUNCH_FILE), "sim:=true"]
    command += [f"namespace:={namespace}"] if namespace else []
    launch = subprocess.Popen(
        command,
        env={**os.environ, "PATH": PATH},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    received: list[TactileArray] = []
    listener = rclpy.create_node("listener")
    try:
        topic = f"/{namespace}/skin/tactile".replace("//", "/")
        listener.create_subscription(TactileArray, topic, received.append, qos_profile_sensor_data)
        deadline = time.monotonic() + PATIENCE_S
        while len(received) < 10 and time.monotonic() < deadline and launch.poll() is None:
            rclpy.spin_once(listener, timeout_sec=0.1)
    finally:
        listener.destroy_node()
        launch.send_signal(signal.SIGINT)  # without a terminal, launch passes it on
        try:
            output, _ = launch.communicate(timeout=PATIENCE_S)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(launch.pid, signal.SIGKILL)  # what is left of it
    assert len(received) >= 10, output
    assert len(received[-1].pressure) == 16
    assert launch.returncode == 0, output
    assert "Traceback" not in output
    assert 0 < output.index("opening sim://") < output.index("opened sim://"), "told what it does"


@pytest.mark.slow
def test_the_suite_of_launch_testing_passes() -> None:
    pytest.importorskip("launch_testing", reason="launch_testing comes with a ROS 2 installation")
    suite = ROOT / "test" / "launch" / "skin.test.py"
    command = ("-m", "launch_testing.launch_test", suite)
    done = run_python(*command, env={**os.environ, "PATH": PATH}, timeout=180)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Traceback" not in done.stdout + done.stderr
