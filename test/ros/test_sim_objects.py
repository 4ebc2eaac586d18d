# SPDX-License-Identifier: Apache-2.0

"""~/sim/objects: a ROS program presses on a simulated skin, at its own pace or frame by frame."""

import time

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import Point, Pose
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Header

from tactile_cdma.base.errors import ParameterError
from tactile_cdma.msg import SimObject, SimObjects, TactileContacts
from tactile_cdma.places.layout import Layout
from tactile_cdma.ros.driver.objects import indenter, sim_objects
from tactile_cdma.sim import Box, Cylinder, Foundation, Indenter, Sphere
from test.support.skin_client import Client, running, wait_sending
from test.support.waiting import wait_for

LAYOUT = Layout.grid(16, 4, 4, 7e-3, 7e-3)
COVER = Foundation(LAYOUT.positions_m, LAYOUT.normals, LAYOUT.areas_m2)
BALL = Sphere(radius_m=0.02, position_m=(1e-3, -2e-3, 0.018), stiffness_pa_per_m=2e7)
LSB_PA = 98.0


def publisher(client: Client) -> rclpy.publisher.Publisher:
    found = client.create_publisher(SimObjects, "/skin/sim/objects", 10)
    wait_for(lambda: found.get_subscription_count() and client.infos)
    return found


@pytest.mark.parametrize(
    "thing",
    [
        BALL,
        Cylinder(radius_m=0.01, length_m=0.03, position_m=(0, 0, 0), orientation_xyzw=(1, 0, 0, 1)),
        Box(size_m=(0.01, 0.02, 0.03), position_m=(1, 2, 3)),
    ],
)
def test_an_object_is_the_same_on_both_sides_of_a_topic(thing: Indenter) -> None:
    sent = deserialize_message(serialize_message(sim_objects([thing])), SimObjects)
    back = indenter(sent.objects[0])
    assert type(back) is type(thing)
    assert np.allclose(back.pose.rotation, thing.pose.rotation)
    assert np.array_equal(back.pose.translation_m, thing.pose.translation_m)
    assert back.stiffness_pa_per_m == thing.stiffness_pa_per_m
    for name in ("radius_m", "length_m", "size_m"):
        if hasattr(thing, name):
            assert np.array_equal(getattr(back, name), getattr(thing, name))


def test_a_message_has_a_usual_stiffness_and_is_refused_with_the_reason() -> None:
    ball = SimObject(shape=SimObject.SPHERE, size=[0.01])
    assert indenter(ball).stiffness_pa_per_m == 1e7
    for wrong, reason in (
        (SimObject(shape=9), "shape is 9"),
        (SimObject(shape=SimObject.BOX, size=[0.1]), r"a box has the size \(x, y, z\), not 1"),
        (SimObject(shape=SimObject.SPHERE, size=[-1.0]), "radius_m of Sphere is -1"),
    ):
        with pytest.raises(ParameterError, match=reason):
            indenter(wrong)


def test_what_is_published_is_felt_and_what_cannot_be_is_left() -> None:
    with running(port="sim://?scene=external&threshold=0") as (_, client):
        press = publisher(client)
        wait_for(lambda: not np.isnan(client.arrays[-1].pressure).any())
        assert not np.any(client.arrays[-1].pressure)
        press.publish(sim_objects([BALL]))
        true_pa = COVER.pressure_pa([BALL])

        def felt() -> bool:
            return bool(np.abs(np.array(client.arrays[-1].pressure) - true_pa).max() < LSB_PA)

        wait_for(felt)
        press.publish(SimObjects(objects=[SimObject(shape=9)]))
        press.publish(SimObjects(header=Header(frame_id="world")))
        frames = len(client.arrays)
        wait_for(lambda: len(client.arrays) > frames + 20)
        assert felt(), "neither of them has released it"
        press.publish(SimObjects(header=Header(frame_id="skin")))
        wait_for(lambda: not np.any(client.arrays[-1].pressure))
        # Activated again, the skin is untouched and can be pressed again.
        press.publish(sim_objects([BALL]))
        wait_for(felt)
        assert client.change("deactivate")
        wait_for(lambda: not press.get_subscription_count())
        assert client.change("activate")
        wait_for(lambda: not np.any(client.arrays[-1].pressure) and press.get_subscription_count())
        press.publish(sim_objects([BALL]))
        wait_for(felt)


def test_a_skin_that_is_stepped_publishes_a_frame_per_message() -> None:
    def ball(depth_m: float) -> SimObjects:
        pose = Pose(position=Point(z=0.02 - depth_m))
        return SimObjects(objects=[SimObject(shape=SimObject.SPHERE, size=[0.02], pose=pose)])

    depths_m = np.linspace(0, 3e-3, 40)
    with running(port="sim://?scene=external&speed=0&threshold=0") as (_, client):
        press = client.create_publisher(SimObjects, "/skin/sim/objects", 10)
        found = client.heard(TactileContacts, "/skin/contacts")
        wait_for(
            lambda: press.get_subscription_count() and client.count_publishers("/skin/contacts")
        )
        # What was sent until the first frame was heard may still be on its way.
        wait_sending([(press, SimObjects())], lambda: found)
        press.publish(ball(1e-3))
        wait_for(lambda: found[-1].wrench.force.z < -0.1)
        before = len(found)
        for depth_m in depths_m:
            heard = len(found)
            press.publish(ball(depth_m))
            wait_for(lambda heard=heard: len(found) > heard)
        time.sleep(0.1)
        frames = found[before:]
    assert np.all(np.diff([frame.sequence for frame in frames]) == 1)
    assert len(frames) == len(depths_m)
    forces_n = np.array([-frame.wrench.force.z for frame in frames])
    volumes_m3 = np.pi * depths_m**2 * (0.06 - depths_m) / 3
    assert forces_n[20:] == pytest.approx(1e7 * volumes_m3[20:], abs=0.06)


def test_other_skins_have_no_such_topic() -> None:
    with running(port="sim://?scene=press") as (node, client):
        wait_for(lambda: client.arrays)
        assert node.count_subscribers("/skin/sim/objects") == 0
