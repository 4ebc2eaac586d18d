# SPDX-License-Identifier: Apache-2.0

"""The QoS of a node's topics, and the transform that it publishes."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rcl_interfaces.msg import Log
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo
from tf2_msgs.msg import TFMessage

from tactile_cdma.config.parameters import read_file
from tactile_cdma.msg import TactileArray
from tactile_cdma.places.layout_file import read_layout
from tactile_cdma.places.layout_nodes import Wiring
from tactile_cdma.places.poses import Pose
from tactile_cdma.ros.body.node import BodyNode
from tactile_cdma.ros.common.qos import LATCHED
from tactile_cdma.ros.driver.node import SkinNode
from tactile_cdma.ros.driver.pictures import TOPICS
from test.support.skin_client import Client, running
from test.support.spinning import living
from test.support.waiting import wait_for

PAST = QoSProfile(depth=100, durability=LATCHED.durability)
OVERRIDE = "qos_overrides.{}.publisher.{}"


def offers(client: Client, topic: str, name: str = "skin") -> tuple[str, str]:
    """Of the publisher of the node of this name: DDS may not have forgotten others' yet."""

    def own() -> list[TopicEndpointInfo]:
        found = client.get_publishers_info_by_topic(topic)
        return [publisher for publisher in found if publisher.node_name == name]

    wait_for(lambda: len(own()) == 1)
    qos = own()[0].qos_profile
    return qos.reliability.name, qos.durability.name


def test_qos_of_every_topic_can_be_overridden() -> None:
    topics = {f"/skin/{name}" for name in ("tactile", "info", "contacts", "wrench", *TOPICS)}
    opposite = {"RELIABLE": "BEST_EFFORT", "BEST_EFFORT": "RELIABLE"}
    topics |= {"/diagnostics", "/tf_static"}
    with running(parent_frame="palm") as (_, client):
        wait_for(lambda: client.arrays)
        before = {topic: offers(client, topic) for topic in topics}
    overrides = {
        OVERRIDE.format(topic, "reliability"): opposite[reliability].lower()
        for topic, (reliability, _) in before.items()
    }
    reliable = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
    with running(parent_frame="palm", **overrides) as (_, client):
        arrays = client.heard(TactileArray, "/skin/tactile", reliable)
        wait_for(lambda: arrays)  # a best-effort publisher would give a reliable client nothing
        for topic, (reliability, durability) in before.items():
            assert offers(client, topic) == (opposite[reliability], durability)
        name = OVERRIDE.format("/skin/tactile", "reliability")
        taken, why = client.set(**{name: "best_effort"})
        assert not taken
        assert "only when the node starts" in why


@pytest.mark.parametrize(("topic", "policy"), [("/skin/tactil", "depth"), ("/skin/info", "dept")])
def test_qos_that_nothing_takes_is_warned_of(topic: str, policy: str) -> None:
    name = OVERRIDE.format(topic, policy)
    with running(**{name: 3}) as (_, client):
        logs = client.heard(Log, "/rosout", PAST)
        wait_for(lambda: any(name in log.msg and "no such publisher" in log.msg for log in logs))
        wait_for(lambda: client.arrays)


UNASKED = {"/parameter_events", "/rosout", "/skin/transition_event"}
SKIN = {"nodes": 4, "parent_frame": "palm", "visual_rate_hz": 30.0, "publish_voltage": True}
BODY = {"patches": ["/nobody/skin"], "stale_after_s": 0.2}


@pytest.mark.parametrize(
    ("make", "parameters", "silent"),
    [
        (SkinNode, {**SKIN, "port": "sim://?scene=all&nodes=4"}, set()),
        (SkinNode, {**SKIN, "port": "sim://?nodes=4&dead=1,2,3,4"}, set()),
        (BodyNode, BODY, {"/body/points", "/body/names"}),
    ],
    ids=["a skin that is pressed", "a dead skin", "a body without patches"],
)
def test_every_topic_has_fields_of_the_right_types(
    make: Any, parameters: dict[str, Any], silent: set[str]
) -> None:
    """Messages assert them here (ROS_PYTHON_CHECK_FIELDS), as a plain colcon build does in C.

    With contacts and without, and of a body before it has heard of any patch. silent: topics on
    which there is nothing to publish then.
    """
    with pytest.raises(AssertionError):
        TactileArray(noise_rms=1)
    heard: dict[str, list[Any]] = {}
    with running(make, **parameters) as (node, client):
        for publisher in node.publishers:
            if (topic := publisher.topic_name) not in UNASKED | silent:
                qos = QoSProfile(depth=10, durability=LATCHED.durability)
                if offers(client, topic, node.get_name())[1] != "TRANSIENT_LOCAL":
                    qos = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
                heard[topic] = client.heard(publisher.msg_type, topic, qos)
        assert len(heard) == (4 if make is BodyNode else len(TOPICS) + 6)
        wait_for(lambda: all(heard.values()))


def test_tf_is_told_where_the_skin_is_from_configure_to_cleanup() -> None:
    mount = {"mount_xyz_m": [0.1, 0.0, -0.2], "mount_rpy_rad": [0.2, -0.4, 0.9]}
    with running(autostart=False, parent_frame="palm", frame_id="pad", **mount) as (_, client):
        told = client.heard(TFMessage, "/tf_static", LATCHED)

        def publishers() -> set[tuple[int, ...]]:
            found = client.get_publishers_info_by_topic("/tf_static")
            return {tuple(publisher.endpoint_gid) for publisher in found}

        others = publishers()  # of earlier tests, which DDS may not have forgotten
        assert client.change("configure")
        wait_for(lambda: told and told[-1].transforms[0].child_frame_id == "pad")
        wait_for(lambda: publishers() - others)
        new = publishers() - others
        [transform] = told[-1].transforms
        assert (transform.header.frame_id, transform.child_frame_id) == ("palm", "pad")
        place, turn = transform.transform.translation, transform.transform.rotation
        assert (place.x, place.y, place.z) == (0.1, 0.0, -0.2)
        turned = Pose.of_quaternion((0, 0, 0), (turn.x, turn.y, turn.z, turn.w))
        expected = Pose.of_rpy((0, 0, 0), mount["mount_rpy_rad"])
        np.testing.assert_allclose(turned.rotation, expected.rotation, atol=1e-12)
        assert client.set(mount_xyz_m=[1, 2, 3]) == (True, "")  # whole numbers will do
        wait_for(lambda: told[-1].transforms[0].transform.translation.z == 3.0)
        assert client.change("cleanup")
        wait_for(lambda: new - publishers())  # its own is gone
        assert client.set(parent_frame="") == (True, "")
        assert client.change("configure")
        wait_for(lambda: told[-1].transforms[0].child_frame_id == "pad_middle")


def test_a_skin_that_is_not_mounted_is_known_to_tf_by_its_middle() -> None:
    file = str(Path(__file__).resolve().parents[2] / "config" / "layouts" / "cylinder.yaml")
    skin = {"nodes": 72, "frame_period_ms": 40.0, "layout_file": file}
    with running(port="sim://?scene=idle", **skin) as (_, client):
        told = client.heard(TFMessage, "/tf_static", LATCHED)
        wait_for(lambda: told)
    [transform] = told[-1].transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("skin", "skin_middle")
    layout, turn = read_layout(Path(file), Wiring(72)), transform.transform.rotation
    place = transform.transform.translation
    here = np.linalg.norm(layout.positions_m - [place.x, place.y, place.z], axis=1)
    assert here.min() < 1e-6  # on a taxel, z along its normal
    pose = Pose.of_quaternion((0, 0, 0), (turn.x, turn.y, turn.z, turn.w))
    np.testing.assert_allclose(pose.rotation[:, 2], layout.normals[here.argmin()], atol=1e-6)
    assert np.linalg.det(pose.rotation) == pytest.approx(1)


def test_several_parameters_are_set_together_or_not_at_all() -> None:
    def set_all(client: Client, **values: Any) -> tuple[bool, str]:
        parameters = [Parameter(name, value=v).to_parameter_msg() for name, v in values.items()]
        request = SetParametersAtomically.Request(parameters=parameters)
        result = client.call(SetParametersAtomically, "set_parameters_atomically", request).result
        return result.successful, result.reason

    with running() as (node, client):
        wait_for(lambda: client.arrays)
        for other, reason in (
            ({"nodes": 17}, "cannot change while configured"),
            ({"release_kpa": 9.0}, "release_kpa"),
            ({"autostart": False}, "only when the node starts"),
            ({"calibration_file": "/nowhere.yaml"}, "nowhere"),
        ):
            taken, why = set_all(client, active_share=0.7, publish_voltage=True, **other)
            assert not taken
            assert reason in why
            assert node._driver.pipeline.config.active_share == 0.5
            assert node.get_parameter("active_share").value == 0.5
        taken = set_all(client, active_share=0.7, publish_voltage=True, visual_rate_hz=5)
        assert taken == (True, "")
        assert node._driver.pipeline.config.active_share == 0.7
        wait_for(lambda: len(client.arrays[-1].voltage) == 16)


def test_a_parameter_file_says_all_of_it(tmp_path: Path) -> None:
    path = tmp_path / "skin.yaml"
    path.write_text(
        """
        /**:
          ros__parameters:
            autostart: false
            parent_frame: palm
            mount_xyz_m: [0, 1, 2]
            qos_overrides: {/skin/tactile: {publisher: {reliability: reliable}}}
        """
    )
    assert read_file(path)["mount_xyz_m"] == (0.0, 1.0, 2.0)  # and no word of QoS
    with living(SkinNode(cli_args=["--ros-args", "--params-file", str(path)])) as node:
        assert node._declared.faults == {}
        assert list(node.get_parameter("mount_xyz_m").value) == [0.0, 1.0, 2.0]
        [offer] = node.get_publishers_info_by_topic("/skin/tactile")
        assert offer.qos_profile.reliability == ReliabilityPolicy.RELIABLE
