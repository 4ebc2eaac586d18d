# SPDX-License-Identifier: Apache-2.0

"""The driver as an ordinary user: what it opens, and the permissions that SROS 2 must give it."""

import json
import os
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
import rclpy
from rclpy.node import Node

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.ros.viewers.view import Viewer
from test.support.boards import Board, plugged
from test.support.calibrations import write_calibration
from test.support.programs import run_program, run_python
from test.support.skin_client import running
from test.support.spinning import living
from test.support.users import USER, ordinary
from test.support.waiting import wait_for

ROOT = Path(__file__).resolve().parents[2]
LIFE = ROOT / "test" / "support" / "watched_life.py"
POLICY = ROOT / "config" / "security" / "skin.policy.xml"
GROUP, NO_GROUP = 54_321, 54_322
OPEN_PORT = "import sys; from tactile_cdma.wire.port import Port; Port(sys.argv[1], 9600).close()"


def give_to_group(port: Path) -> None:
    """As udev does with serial ports."""
    if not os.getuid():
        os.chown(port, 0, GROUP)
        port.chmod(0o660)


def environment(home: Path) -> dict[str, str]:
    home.mkdir()
    if not os.getuid():
        os.chown(home, USER, USER)
    own = {"HOME": str(home), "ROS_HOME": str(home), "PYTHONDONTWRITEBYTECODE": "1"}
    return {**os.environ, **own}


def test_an_ordinary_user_s_driver_opens_its_port_and_dds_and_writes_its_state_only(
    tmp_path: Path,
) -> None:
    home, port, calibration = tmp_path / "home", tmp_path / "tty", tmp_path / "palm.yaml"
    config = SkinConfig.of({})
    write_calibration(calibration, config.calibration, config.adc, "", "a test")
    with plugged(Board, port):
        give_to_group(port)
        device = os.path.realpath(port)
        command = (*ordinary(GROUP), sys.executable, LIFE, port, calibration)
        run = run_program(*command, env=environment(home))
    assert run.returncode == 0, run.stderr
    life = json.loads(run.stdout.splitlines()[-1])
    assert 0 not in life["user"]

    state, shared = str(home / "tactile_cdma"), "/dev/shm/fast"
    assert {f"{state}/skin.rest.yaml", f"{state}/skin.calibration.yaml"} <= {*life["changed"]}
    assert all(path.startswith(state) for path in life["changed"])
    assert all(path.startswith((state, str(port))) for path in life["written"])
    logs = str(home / "log")
    assert all(path.startswith((device, shared, logs)) for path in life["open"])
    assert device in life["open"]
    # DDS is all that is to be reached from outside, and nothing was started.
    assert [kind for kind, addresses in life["sockets"].items() if addresses] == ["udp"]
    assert life["others"] == []
    umask = 0o777 & ~os.umask(os.umask(0o022))
    files = [path for path in Path(state).rglob("*") if path.is_file()]
    assert len(files) == 2
    assert all(path.stat().st_mode & 0o777 == 0o666 & umask for path in files)


def test_the_watcher_sees_what_must_not_be(tmp_path: Path) -> None:
    program = (
        "import os, pickle, socket, subprocess, sys\n"
        "import test.support.watched_life as w\n"
        "sys.addaudithook(w.watch)\n"
        "open(sys.argv[1], 'w').close()\n"
        "os.rename(sys.argv[1], sys.argv[1] + '.old')\n"
        "subprocess.run(['true'])\n"
        "pickle.loads(pickle.dumps(os.getcwd))\n"
        "listener = socket.create_server(('127.0.0.1', 0))\n"
        "print(w.written, w.changed, w.others, w.sockets()['tcp'], sep='\\n')\n"
    )
    path = str(tmp_path / "file")
    run = run_python("-c", program, path, env=environment(tmp_path / "home"), check=True)
    written, changed, others, tcp = run.stdout.splitlines()
    assert path in written and f"{path}.old" in changed
    assert all(word in others for word in ("subprocess.Popen", "pickle.find_class", "socket.bind"))
    assert "0100007F" in tcp


@pytest.mark.skipif(os.getuid() != 0, reason="only root can make a port of another group")
def test_a_port_of_a_group_that_one_is_not_in_is_refused_with_what_to_do(tmp_path: Path) -> None:
    with plugged(Board, tmp_path / "tty"):
        give_to_group(tmp_path / "tty")
        command = [sys.executable, "-c", OPEN_PORT, tmp_path / "tty"]
        own, other = (run_program(*ordinary(group), *command) for group in (GROUP, NO_GROUP))
    assert own.returncode == 0, own.stderr
    assert "no permission; add yourself to the port's group" in other.stderr


def allowed(enclave: str, kind: str, qualifier: str, node: str) -> set[str]:
    """Full names of what the policy allows a node."""
    profile = ElementTree.parse(POLICY).find(
        f"enclaves/enclave[@path='{enclave}']/profiles/profile"
    )
    assert profile is not None and (profile.get("ns"), profile.get("node")) == ("/", node)
    names = profile.findall(f"{kind}s[@{qualifier}='ALLOW']/{kind}")
    return {(name.text or "").replace("~", f"/{node}") for name in names}


def used(onlooker: Node, node: str) -> dict[tuple[str, str], set[str]]:
    """What a node really has: names of topics and services."""
    ways = {
        ("topic", "publish"): onlooker.get_publisher_names_and_types_by_node,
        ("topic", "subscribe"): onlooker.get_subscriber_names_and_types_by_node,
        ("service", "reply"): onlooker.get_service_names_and_types_by_node,
        ("service", "request"): onlooker.get_client_names_and_types_by_node,
    }
    return {way: {name for name, _ in look(node, "/")} for way, look in ways.items()}


def assert_policy_is_what_is_used(onlooker: Node, node: str) -> None:
    for (kind, qualifier), names in used(onlooker, node).items():
        policy = allowed(f"/{node}", kind, qualifier, node)
        if qualifier == "reply":  # of newer distributions of ROS 2
            policy -= {f"/{node}/get_type_description"} - names
        assert names == policy


def test_the_policy_gives_the_driver_what_it_has_and_no_more() -> None:
    port = "sim://?scene=external"
    with running(port=port, parent_frame="palm", use_sim_time=True) as (_, client):
        wait_for(lambda: client.get_publishers_info_by_topic("/tf_static"))
        assert_policy_is_what_is_used(client, "skin")


def test_the_policy_gives_the_viewer_what_it_has_and_no_more() -> None:
    with living(Viewer("/skin/tactile")) as viewer:
        viewer.set_parameters([rclpy.parameter.Parameter("use_sim_time", value=True)])
        assert_policy_is_what_is_used(viewer, "skin_view")


def test_without_its_keys_a_driver_that_must_have_them_does_not_start(tmp_path: Path) -> None:
    security = {
        "ROS_SECURITY_ENABLE": "true",
        "ROS_SECURITY_STRATEGY": "Enforce",
        "ROS_SECURITY_KEYSTORE": str(tmp_path),
    }
    (tmp_path / "enclaves" / "skin").mkdir(parents=True)
    command = (ROOT / "scripts" / "skin_driver", "--ros-args", "--enclave", "/skin")
    driver = run_python(*command, env={**os.environ, **security})
    assert driver.returncode == 1
    assert "skin_driver: error creating node" in driver.stderr
    assert "Traceback" not in driver.stderr
