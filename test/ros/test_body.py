# SPDX-License-Identifier: Apache-2.0

"""A body of five patches over DDS: two of the drivers, and the body's node, are processes.

The patches stand upright in a circle, looking outwards; each feels the fingertip of the scene
"press" on its node 6, whose place in the body is worked out by hand here. To save time, three of
the drivers share the test's process.
"""

import math
import re
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TransformStamped, WrenchStamped
from sensor_msgs.msg import PointCloud2
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

from tactile_cdma.base.errors import TactileError
from tactile_cdma.config.body_file import read_body
from tactile_cdma.msg import TactileContact, TactileContacts
from tactile_cdma.ros.body.node import BodyNode
from tactile_cdma.ros.driver.patches import made
from tactile_cdma.views.cloud import BODY_POINT
from test.support.programs import run_python
from test.support.scripts import body_commands
from test.support.skin_client import node_with, xyz
from test.support.spinning import spinning
from test.support.waiting import PATIENCE_S, wait_for

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]
PATCHES, PROCESSES = 5, 2
PERIOD_S, STALE_AFTER_S = 0.2, 3.0
"""Slow and patient: beside other tests a driver may not get its turn for a second."""
RADIUS_M, HEIGHT_M, PITCH_M = 0.2, 0.3, 7e-3
YAW_RAD = 2 * math.pi / PATCHES
NAMES = [f"/p{i}/skin" for i in range(PATCHES)]
LOOSE = 4
"""This patch's driver does not say where it is mounted: somebody else moves it."""


def patch_yaml(index: int, nodes: int) -> str:
    """Pitched by 90°, its x points down and its z to the front; then yawed round the circle."""
    yaw = index * YAW_RAD
    place = [RADIUS_M * math.cos(yaw), RADIUS_M * math.sin(yaw), HEIGHT_M]
    mount = f", mount_xyz_m: {place}, mount_rpy_rad: [0, {math.pi / 2}, {yaw}]"
    return (
        f"  p{index}: {{parameters: {{port: 'sim://?scene=press&heartbeat=5', nodes: {nodes}, "
        f"frame_period_ms: {1e3 * PERIOD_S}, contact_kpa: 5{mount if index != LOOSE else ''}}}}}\n"
    )


def body_file(folder: Path, nodes: int = 16) -> Path:
    path = folder / "body.yaml"
    path.write_text("patches:\n" + "".join(patch_yaml(i, nodes) for i in range(PATCHES)))
    return path


def commands(path: Path) -> list[list[str]]:
    """What `make run PATCHES=…` starts: the drivers, and the body's node."""
    found = body_commands(path)
    assert len(found) == PATCHES + 1
    found[-1] += ["-p", f"stale_after_s:={STALE_AFTER_S}"]
    return found


class Body:
    """Processes and drivers, and a client that keeps what the body publishes."""

    def __init__(self, folder: Path) -> None:
        path = body_file(folder)
        *drivers, gatherer = commands(path)
        self.processes = [subprocess.Popen(command) for command in (*drivers[:PROCESSES], gatherer)]
        self.drivers = [made(patch) for patch in read_body(path).patches[PROCESSES:]]
        self.client = rclpy.create_node("client")
        self.contacts: list[TactileContacts] = []
        self.diagnostics: list[DiagnosticStatus] = []
        self.tf = self.client.create_publisher(TFMessage, "/tf", 10)
        self.client.create_subscription(DiagnosticArray, "/diagnostics", self._take, 10)
        # The client by itself: an executor's time for one message grows with all that its nodes
        # have, and drivers have much; it would hear of things ever later.
        self._ending = ExitStack()
        self._ending.enter_context(spinning([self.client], self.drivers))

    def _take(self, message: DiagnosticArray) -> None:
        self.diagnostics += [s for s in message.status if s.name == "body: patches"]

    def subscribe(self, kind: Any, topic: str, take: Callable[[Any], object]) -> Any:
        # Deep: this process is busy with three drivers. But of points only the latest count.
        depth = 1 if kind is PointCloud2 else 1000
        return self.client.create_subscription(kind, topic, take, depth)

    def unsubscribe(self, subscription: Any) -> None:
        # Not in this thread: the executor may be waiting for it.
        self.client.executor.create_task(self.client.destroy_subscription, subscription)

    def turn_loose_patch(self) -> None:
        """Say where the last patch is: as the others' drivers do, for a moving joint."""
        yaw = LOOSE * YAW_RAD
        joint, mount = TransformStamped(), TransformStamped()
        joint.header.frame_id, joint.child_frame_id = "body", "joint"
        joint.transform.rotation.z, joint.transform.rotation.w = (
            math.sin(yaw / 2),
            math.cos(yaw / 2),
        )
        mount.header.frame_id, mount.child_frame_id = "joint", f"p{LOOSE}"
        mount.transform.translation.x, mount.transform.translation.z = RADIUS_M, HEIGHT_M
        mount.transform.rotation.y = mount.transform.rotation.w = math.sqrt(0.5)
        self.tf.publish(TFMessage(transforms=[mount, joint]))

    def absent(self) -> list[str] | None:
        return list(self.contacts[-1].absent) if self.contacts else None

    def said_of(self, patch: int) -> str:
        """By the latest /diagnostics."""
        values = self.diagnostics[-1].values if self.diagnostics else []
        return {value.key: value.value for value in values}.get(NAMES[patch], "")

    def kill(self, process: int) -> None:
        self.processes[process].kill()
        self.processes[process].wait()
        del self.processes[process]

    def end(self) -> None:
        self._ending.close()
        for process in self.processes:
            process.send_signal(signal.SIGINT)
        codes = [process.wait(PATIENCE_S) for process in self.processes]
        assert codes == [0] * len(codes)


@pytest.fixture
def body(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Body]:
    body = Body(tmp_path_factory.mktemp("body"))
    try:
        yield body
    finally:
        try:
            body.end()
        finally:
            for process in body.processes:
                process.kill()


def outwards(patch: int) -> np.ndarray:
    yaw = patch * YAW_RAD
    return np.array([math.cos(yaw), math.sin(yaw), 0.0])


def pressed_place(patch: int) -> np.ndarray:
    """Node 6 of 4 × 4 is half a pitch left of the middle and above it, in the patch's frame.

    Its x, left, is up in the body; its y, up, is to the left of who looks outwards.
    """
    left = np.array([-math.sin(patch * YAW_RAD), math.cos(patch * YAW_RAD), 0.0])
    above_floor = np.array([0.0, 0.0, HEIGHT_M + PITCH_M / 2])
    return RADIUS_M * outwards(patch) + PITCH_M / 2 * left + above_floor


def a_body_that_is_asked_again_says_nothing_before_it_has_heard_all(body: Body) -> None:
    """Three times, as a patch may really be late on a busy machine."""
    firsts = []
    for _ in range(3):
        for subscription in list(body.client.subscriptions):
            if subscription.topic_name == "/body/contacts":
                body.unsubscribe(subscription)
        wait_for(lambda: not any(body.client.count_subscribers(f"{n}/contacts") for n in NAMES))
        body.contacts = []
        body.subscribe(TactileContacts, "/body/contacts", body.contacts.append)
        wait_for(lambda: body.contacts)
        firsts.append((list(body.contacts[0].absent), body.contacts[0].taxels_in_service))
    assert firsts.count(([], 16 * PATCHES)) >= 2, firsts
    wait_for(lambda: body.absent() == [])


def nothing_is_subscribed_to_that_nobody_asks_for(body: Body) -> None:
    wait_for(lambda: body.client.count_publishers("/body/contacts"))
    wait_for(lambda: all(body.client.count_publishers(f"{name}/tactile") for name in NAMES))
    wait_for(lambda: body.diagnostics and "nobody subscribes" in body.diagnostics[-1].message)
    topics = [f"{name}/{topic}" for name in NAMES for topic in ("contacts", "tactile")]
    assert [topic for topic in topics if body.client.count_subscribers(topic)] == []
    for kind, topic in ((PointCloud2, "/body/points"), (MarkerArray, "/body/names")):
        asked = body.subscribe(kind, topic, lambda message: None)
        wait_for(lambda: all(body.client.count_subscribers(f"{name}/tactile") for name in NAMES))
        assert [name for name in NAMES if body.client.count_subscribers(f"{name}/contacts")] == []
        body.unsubscribe(asked)
        wait_for(lambda: not any(body.client.count_subscribers(topic) for topic in topics))


def a_patch_without_a_transform_is_absent_until_it_gets_one(body: Body) -> None:
    body.subscribe(TactileContacts, "/body/contacts", body.contacts.append)
    wait_for(lambda: body.absent() == [NAMES[LOOSE]])
    wait_for(lambda: body.said_of(LOOSE).startswith("no transform from"))
    assert body.diagnostics[-1].level == DiagnosticStatus.WARN

    def placed() -> bool:
        body.turn_loose_patch()  # again and again, as joints are
        return body.absent() == []

    wait_for(placed)
    wait_for(lambda: body.diagnostics[-1].level == DiagnosticStatus.OK)
    assert {value.key for value in body.diagnostics[-1].values} == set(NAMES)


def contacts_are_where_the_simulated_fingers_are(body: Body) -> None:
    wrenches: list[WrenchStamped] = []
    body.subscribe(WrenchStamped, "/body/wrench", wrenches.append)
    begin = len(body.contacts)

    def seen() -> dict[str, TactileContact]:
        messages = body.contacts[begin:]
        return {contact.patch: contact for message in messages for contact in message.contacts}

    def known() -> list[TactileContacts]:
        """In which no patch is late, of which the sums would be unknown."""
        messages = [message for message in body.contacts[begin:] if message.touched]
        return [message for message in messages if not math.isnan(message.wrench.force.x)]

    wait_for(lambda: len(seen()) == PATCHES and len(wrenches) > 5 and len(known()) > 5)
    for i, name in enumerate(NAMES):
        contact = seen()[name]
        np.testing.assert_allclose(xyz(contact.position), pressed_place(i), atol=1e-6)
        np.testing.assert_allclose(xyz(contact.normal), outwards(i), atol=1e-6)
        force_n = contact.pressure_max * PITCH_M**2
        np.testing.assert_allclose(xyz(contact.force), -force_n * outwards(i), atol=1e-4)
        assert list(contact.taxels) == [5]
    for message in known():
        assert (message.header.frame_id, message.info_id) == ("body", 0)
        forces = np.array([xyz(contact.force) for contact in message.contacts])
        places = np.array([xyz(contact.position) for contact in message.contacts])
        sizes = np.linalg.norm(forces, axis=1)
        assert (np.diff(sizes) <= 0).all()
        np.testing.assert_allclose(xyz(message.wrench.force), forces.sum(axis=0), atol=1e-6)
        torque = np.cross(places, forces).sum(axis=0)
        np.testing.assert_allclose(xyz(message.wrench.torque), torque, atol=1e-6)
        np.testing.assert_allclose(xyz(message.position), sizes @ places / sizes.sum(), atol=1e-9)
        assert message.area == pytest.approx(len(forces) * PITCH_M**2, rel=1e-5)
    for wrench in wrenches[1:5]:  # two messages may have the same newest frame
        if math.isnan(wrench.wrench.force.x):
            continue  # a patch was late: NaN equals nothing
        same = [message for message in body.contacts if message.header == wrench.header]
        assert wrench.wrench in [message.wrench for message in same]


def messages_are_as_often_as_a_patchs_frames_and_fewer_than_all_frames(body: Body) -> None:
    """Steady drivers make one per frame; a busy machine brings frames in bursts, or late."""
    begin = len(body.contacts)
    wait_for(lambda: len(body.contacts) > begin + 10)
    messages = body.contacts[begin:]
    sequences = [message.sequence for message in messages]
    assert sequences == list(range(sequences[0], sequences[0] + len(messages)))
    begin_s, end_s = (
        message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
        for message in (messages[0], messages[-1])
    )
    assert PERIOD_S / PATCHES < (end_s - begin_s) / (len(messages) - 1) < 3 * PERIOD_S


def the_viewer_prints_a_line_per_second_and_a_summary(body: Body) -> None:
    done = run_python("-m", "tactile_cdma.ros.viewers.body_view", "--seconds", "6")
    assert (done.returncode, done.stderr) == (0, "")
    *lines, last = done.stdout.splitlines()
    counted = [line for line in lines if line != "nothing yet"]  # from the first message on
    assert 0 < len(counted) <= 6 and len(lines) >= 5, "a busy machine may be late, not silent"
    contact = r"p\d \d+\.\d N \(-?\d+ -?\d+ -?\d+ mm\)"
    known = rf"\d Hz +>?\d+\.\d N  (no contact|{contact})"
    unknown = r"\d Hz +(>\d+\.\d|--) N  .*\d+ of \d+ taxels valid|absent: p\d"  # one was late
    assert re.search(f"{known}|{unknown}", lines[-1])
    values = dict(pair.split("=") for pair in last.split())
    assert values.keys() == {"received", "lost", "absent"}
    assert int(values["received"]) > 0
    assert values["absent"] == "0" or "absent" in "".join(lines)


def a_killed_driver_is_absent_and_another_skin_in_its_place_is_back(
    body: Body, tmp_path: Path
) -> None:
    clouds: list[PointCloud2] = []
    body.subscribe(PointCloud2, "/body/points", clouds.append)

    def counts() -> list[int]:
        points = np.frombuffer(clouds[-1].data, dtype=BODY_POINT) if clouds else []
        return np.bincount(points["patch"], minlength=PATCHES).tolist() if len(points) else []

    wait_for(lambda: counts() == [16] * PATCHES)
    points = np.frombuffer(clouds[-1].data, dtype=BODY_POINT)
    assert [field.name for field in clouds[-1].fields] == list(BODY_POINT.names or ())
    for i in range(PATCHES):
        (at,) = points[(points["patch"] == i) & (points["taxel"] == 5)]
        np.testing.assert_allclose([at["x"], at["y"], at["z"]], pressed_place(i), atol=1e-6)

    body.kill(1)
    wait_for(lambda: body.absent() == [NAMES[1]])
    wait_for(lambda: counts() == [16, 0, 16, 16, 16])
    wait_for(lambda: "driver" in body.said_of(1))
    begin = len(body.contacts)
    wait_for(lambda: len(body.contacts) > begin + 10)
    assert all(NAMES[1] in message.absent for message in body.contacts[begin:])

    body.processes.insert(1, subprocess.Popen(commands(body_file(tmp_path, nodes=9))[1]))
    wait_for(lambda: body.absent() == [])
    wait_for(lambda: counts() == [16, 9, 16, 16, 16])


def when_all_are_silent_even_that_is_said(body: Body) -> None:
    *drivers, _ = body.processes
    for process in drivers:
        process.send_signal(signal.SIGSTOP)
    for driver in body.drivers:
        driver.trigger_deactivate()
    try:
        wait_for(lambda: body.absent() == NAMES)
        wait_for(lambda: body.diagnostics[-1].level == DiagnosticStatus.ERROR)
        assert "silent" in body.diagnostics[-1].message
        begin = len(body.contacts)
        wait_for(lambda: len(body.contacts) > begin + 1)
        assert not body.contacts[-1].touched and not body.contacts[-1].untouched
        assert math.isnan(body.contacts[-1].wrench.force.x)
    finally:
        for process in drivers:
            process.send_signal(signal.SIGCONT)
    for driver in body.drivers:
        driver.trigger_activate()
    wait_for(lambda: body.absent() == [])


def test_a_body_of_five_patches(body: Body, tmp_path: Path) -> None:
    """One test, in the order of a body's life: its processes are started once."""
    nothing_is_subscribed_to_that_nobody_asks_for(body)
    a_patch_without_a_transform_is_absent_until_it_gets_one(body)
    a_body_that_is_asked_again_says_nothing_before_it_has_heard_all(body)
    contacts_are_where_the_simulated_fingers_are(body)
    messages_are_as_often_as_a_patchs_frames_and_fewer_than_all_frames(body)
    the_viewer_prints_a_line_per_second_and_a_summary(body)
    a_killed_driver_is_absent_and_another_skin_in_its_place_is_back(body, tmp_path)
    when_all_are_silent_even_that_is_said(body)


def test_overrides_of_qos_count_and_only_those_are_declared() -> None:
    given = "qos_overrides./body/contacts.publisher.depth"
    node = node_with(BodyNode, patches=["a"], **{given: 3})
    try:
        assert list(node.get_parameters_by_prefix("qos_overrides")) == [given.partition(".")[2]]
        [publisher] = [each for each in node.publishers if each.topic_name == "/body/contacts"]
        assert publisher.qos_profile.depth == 3
    finally:
        node.destroy_node()


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({}, "no patches to gather"),
        ({"patches": ["/a/skin", "a/skin"]}, "patches has /a/skin twice"),
        ({"patches": ["a b"]}, "patches has '/a b', which is not a node's name"),
        ({"patches": [1, 2]}, r"patches is \[1, 2\]; it must be a list of names"),
        ({"patches": ["a"], "body_file": "b.yaml"}, "body_file and patches are both given"),
        ({"body_file": "/nowhere.yaml"}, "/nowhere.yaml: No such file"),
        ({"patches": ["a"], "stale_after_s": -1.0}, "stale_after_s is -1 s; it must lie within"),
        ({"patches": ["a"], "visual_rate_hz": "x"}, "visual_rate_hz must be a number, got 'x'"),
        ({"patches": ["a"], "frame_id": "/body"}, "frame_id is .*leading slash"),
        ({"body_file": "package://my_arm/body.yaml"}, "no package 'my_arm' in AMENT_PREFIX_PATH"),
        (
            {"patches": ["a"], "qos_overrides./body/contacts.publisher.reliability": "sure"},
            "reliability is 'sure'; it must be one of",
        ),
    ],
)
def test_wrong_parameters_are_refused(parameters: dict[str, Any], message: str) -> None:
    with pytest.raises(TactileError, match=message):
        node_with(BodyNode, **parameters)
