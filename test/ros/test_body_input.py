# SPDX-License-Identifier: Apache-2.0

"""The body's node and patches that come, go, change and send nonsense.

The patches are publishers of the test, which can do what no driver does.
"""

import math
import os
import shutil
import subprocess
import sys
import time
from array import array
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from itertools import count
from pathlib import Path

import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Point, Point32, TransformStamped, Vector3
from rclpy.executors import SingleThreadedExecutor
from rclpy.serialization import deserialize_message, serialize_message
from rosgraph_msgs.msg import Clock as RosClock
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

from tactile_cdma.messages.cdr import Heading
from tactile_cdma.msg import TactileArray, TactileContact, TactileContacts, TactileSkinInfo
from tactile_cdma.places.poses import Pose
from tactile_cdma.ros.body.messages import body_contacts
from tactile_cdma.ros.body.node import BodyNode
from tactile_cdma.ros.common.newest import RIVALS_S
from tactile_cdma.ros.common.qos import LATCHED
from tactile_cdma.ros.common.touches import Touches
from tactile_cdma.views.cloud import BODY_POINT
from test.support.skin_client import node_with
from test.support.waiting import PATIENCE_S, wait_for
from torture.hosts.rig import WrongClock

pytestmark = pytest.mark.xdist_group("body input")  # its world is made once
ROOT = Path(__file__).resolve().parents[2]
STALE_AFTER_S = 1.0


class Patch:
    """Publishes whatever it is told, as the driver /<name>/skin."""

    def __init__(self, node: rclpy.node.Node, name: str) -> None:
        self._clock, self.frame_id, self._frames = node.get_clock(), name, count(1)
        self.contacts = node.create_publisher(TactileContacts, f"/{name}/skin/contacts", 10)
        self.arrays = node.create_publisher(TactileArray, f"/{name}/skin/tactile", 10)
        self.infos = node.create_publisher(TactileSkinInfo, f"/{name}/skin/info", LATCHED)

    def header(self, age_s: float = 0.0) -> Header:
        stamp_ns = self._clock.now().nanoseconds - round(age_s * 1e9)
        stamp = Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        return Header(stamp=stamp, frame_id=self.frame_id)

    def describe(self, info_id: int, positions: list[Point32], normals: list[Point32]) -> None:
        info = TactileSkinInfo(info_id=info_id, positions=positions, normals=normals)
        info.height, info.width = 1, len(positions)
        info.area, info.node = [1e-4] * info.width, list(range(1, info.width + 1))
        self.infos.publish(info)

    def press(self, pressure_pa: list[float], info_id: int = 1) -> None:
        values, status = array("f", pressure_pa), array("B", bytes(len(pressure_pa)))
        message = TactileArray(info_id=info_id, pressure=values, status=status)
        message.height, message.width = 1, len(values)
        message.header, message.sequence = self.header(), next(self._frames)
        self.arrays.publish(message)

    def touch(
        self, age_s: float = 0.0, contacts: int = 0, valid: int = 16, sequence: int | None = None
    ) -> None:
        """A frame's contacts, the next one's; valid: taxels with a reading, of 16."""
        message = TactileContacts(header=self.header(age_s), touched=contacts > 0)
        message.sequence = next(self._frames) if sequence is None else sequence
        message.contacts = [TactileContact(patch=self.frame_id)] * contacts
        message.taxels_valid, message.taxels_in_service = valid, 16
        message.untouched = valid == 16 and not contacts
        self.contacts.publish(message)


class World:
    """A body's node of the patches a and b, of which a is at its origin; and who asks for it."""

    def __init__(self, **more: object) -> None:
        """more: parameters of the body's node."""
        given = {"patches": ["a/skin", "b/skin"], "stale_after_s": STALE_AFTER_S, **more}
        self.body = node_with(BodyNode, **given)
        self._client = rclpy.create_node("client")
        self.clock = self._client.create_publisher(RosClock, "/clock", 10)
        self.a, self.b = Patch(self._client, "a"), Patch(self._client, "b")
        self.contacts: list[TactileContacts] = []
        self.clouds: list[PointCloud2] = []
        self.named: list[MarkerArray] = []
        self.said: dict[str, str] = {}
        self.ever_said: set[str] = set()
        self._tf = self._client.create_publisher(TFMessage, "/tf", 10)
        for kind, topic, take in (
            (TactileContacts, "/body/contacts", self.contacts.append),
            (PointCloud2, "/body/points", self.clouds.append),
            (MarkerArray, "/body/names", self.named.append),
            (DiagnosticArray, "/diagnostics", self._hear),
        ):
            self._client.create_subscription(kind, topic, take, 100)
        self._executor = SingleThreadedExecutor()
        for node in (self.body, self._client):
            self._executor.add_node(node)

    def second_a(self) -> Patch:
        """Start another driver of the patch a; returns once the body knows of it."""
        second, topic = Patch(self._client, "a"), "/a/skin/contacts"
        wait_for(lambda: self.goes_on() and self.body.count_publishers(topic) == 2)
        return second

    def _hear(self, message: DiagnosticArray) -> None:
        self.said = {value.key: value.value for value in message.status[0].values}
        self.ever_said.update(self.said.values())

    def mount(self, x_m: float, parent: str = "body", child: str = "a") -> None:
        transform = TransformStamped(header=Header(frame_id=parent), child_frame_id=child)
        transform.transform.translation.x = x_m
        self._tf.publish(TFMessage(transforms=[transform]))

    def alone(self, **how: float) -> None:
        """Only the patch a is mounted and delivers a frame; how: what is odd about it."""
        self.mount(0.0)
        self.a.touch(**how)  # type: ignore[arg-type]

    def both(self, **how: float) -> None:
        """Both patches are mounted and deliver a frame; how: what is odd about the one of a."""
        self.mount(0.1, child="b")
        self.b.touch()
        self.alone(**how)

    def absent(self) -> list[str]:
        """Patches that the newest message leaves out."""
        return list(self.contacts[-1].absent)

    def said_of_a(self) -> str:
        """By the latest /diagnostics."""
        return self.said.get("/a/skin", "")

    def goes_on(self) -> bool:
        """For conditions of wait_for: a little of the nodes' life."""
        for _ in range(20):
            self._executor.spin_once(0.001)
        return True

    def wait(
        self, condition: Callable[[], object], again: Callable[[], object] = lambda: None
    ) -> None:
        """Until the condition holds; meanwhile, again and again, do this."""

        def holds() -> object:
            again()
            return self.goes_on() and bool(self.contacts) and condition()

        wait_for(holds)

    def points(self) -> np.ndarray:
        newest = self.clouds[-1].data if self.clouds else b""
        return np.frombuffer(newest, dtype=BODY_POINT)

    def names(self) -> dict[str, tuple[float, float]]:
        """Names in the newest message, and their places in x and y, m."""
        newest = self.named[-1].markers if self.named else []
        return {m.text: (m.pose.position.x, m.pose.position.y) for m in newest}

    def close(self) -> None:
        """End its nodes."""
        self._executor.shutdown()
        self._client.destroy_node()
        self.body.destroy_node()


@pytest.fixture(scope="module")
def world() -> Iterator[World]:
    with closing(World()) as world:
        yield world


TWO = [Point32(x=0.01 * i) for i in range(2)]
UP = [Point32(z=1.0)] * 2


def two_points(world: World) -> None:
    """A patch a of two taxels at the body's origin."""
    world.a.describe(1, TWO, UP)

    def again() -> None:
        world.mount(0.0)
        world.a.press([1e3, 2e3])

    world.wait(lambda: world.points()["pressure"].tolist() == [1e3, 2e3], again)


def test_a_bag_that_is_played_in_a_loop_goes_on_and_no_clock_is_blamed() -> None:
    world = World(use_sim_time=True, stale_after_s=PATIENCE_S)  # however seldom this gets its turn
    message = TactileContacts(untouched=True, taxels_valid=16, taxels_in_service=16)
    frames = count(1)

    def turn_back(sec: int) -> None:
        """Have the body's clock show this time, s."""

        def shows() -> bool:
            world.clock.publish(RosClock(clock=Time(sec=sec)))
            return world.goes_on() and world.body.get_clock().now().nanoseconds == sec * 10**9

        wait_for(shows)

    def play(sec: int) -> None:
        """Messages of this time, s, until the body has taken some."""
        begin = len(world.contacts)

        def taken() -> bool:
            send(sec)
            stamps = world.goes_on() and [m.header.stamp.sec for m in world.contacts[begin:]]
            return sec in stamps

        wait_for(taken)

    def send(sec: int) -> None:
        """Publish a frame of this time, s, of each patch."""
        message.sequence = next(frames)
        for x_m, patch in ((0.0, world.a), (0.1, world.b)):
            world.mount(x_m, child=patch.frame_id)
            stamp = Time(sec=sec, nanosec=message.sequence)
            message.header = Header(stamp=stamp, frame_id=patch.frame_id)
            patch.contacts.publish(message)

    def refused() -> bool:
        send(130)
        return world.goes_on() and all(each.refused for each in newest.values())

    arrivals, newest = world.body.patches.arrivals, world.body.outputs[0].newest
    with closing(world):
        turn_back(130)
        play(130)
        for _ in range(2):
            turn_back(100)
            # The last message of the loop before comes late, and after the first report.
            wait_for(lambda: world.goes_on() and not arrivals["/a/skin"]._settles)
            wait_for(refused)
            turn_back(100)
            play(100)  # before, a patch may be heard twice while the other one is not of now
            begin = len(world.contacts)
            for sec in range(101, 131, 5):
                turn_back(sec)
                play(sec)
            assert [m.absent for m in world.contacts[begin:] if m.absent] == []
        wait_for(lambda: play(126) or " Hz" in world.said["/a/skin"])
    assert not [text for text in world.ever_said if "off this" in text]


def test_a_patch_that_falls_silent_is_drawn_no_more_and_then_nothing_is(world: World) -> None:
    two_points(world)
    world.wait(lambda: len(world.points()) == 0)
    drawn = len(world.clouds)
    world.wait(lambda: "silent" in world.said_of_a())
    assert len(world.clouds) == drawn


def test_a_name_moves_with_its_patch_and_stays_where_one_is_missed(world: World) -> None:
    two_points(world)
    world.wait(lambda: world.names() == {"a": pytest.approx((0.005, 0.0))})
    world.wait(lambda: world.names()["a"][0] == pytest.approx(0.255), lambda: world.mount(0.25))
    world.wait(lambda: len(world.points()) == 0)
    world.named.clear()
    world.wait(lambda: world.names() == {"a": pytest.approx((0.255, 0.0))})


@pytest.mark.parametrize("positions", [[], [Point32(x=math.nan), Point32()]])
def test_a_patch_without_a_place_has_no_name(world: World, positions: list[Point32]) -> None:
    two_points(world)
    world.a.describe(1, positions, UP[: len(positions)])
    world.wait(lambda: world.named.clear() is None, lambda: world.a.press([1e3, 2e3]))
    drawn = len(world.clouds)
    world.wait(lambda: len(world.clouds) > drawn + 10, lambda: world.a.press([1e3, 2e3]))
    assert not world.named
    two_points(world)
    world.wait(lambda: world.names())


def test_an_array_is_only_drawn_with_the_layout_that_it_is_of(world: World) -> None:
    two_points(world)
    world.wait(lambda: len(world.points()) == 0, lambda: world.a.press([1e3] * 3, info_id=2))
    world.a.describe(2, [*TWO, Point32(y=0.5)], [*UP, Point32(z=1.0)])
    world.wait(lambda: len(world.points()) == 3, lambda: world.a.press([1e3] * 3, info_id=2))
    assert world.points()["y"].tolist() == [0.0, 0.0, 0.5]


def test_points_have_no_taxels_without_a_number(world: World) -> None:
    two_points(world)
    world.wait(
        lambda: world.points()["taxel"].tolist() == [1],
        lambda: world.a.press([math.nan, 5e3]),
    )
    world.wait(lambda: len(world.points()) == 0, lambda: world.a.press([math.nan, math.nan]))


def test_a_layout_that_contradicts_itself_is_not_drawn_and_the_node_goes_on(world: World) -> None:
    two_points(world)
    world.a.describe(1, TWO, UP[:1])
    world.wait(lambda: len(world.points()) == 0, lambda: world.a.press([1e3, 2e3]))
    two_points(world)


def test_a_transform_that_is_no_number_is_not_taken(world: World) -> None:
    two_points(world)
    world.mount(math.nan)
    world.mount(0.25)
    world.wait(
        lambda: world.points()["x"].tolist() == pytest.approx([0.25, 0.26]),
        lambda: world.a.press([1e3, 2e3]),
    )
    drawn: list[np.ndarray] = []
    world.wait(
        lambda: drawn.append(world.points()) or drawn[-1]["pressure"].tolist() == [3e3, 4e3],
        lambda: (world.mount(math.nan), world.a.press([3e3, 4e3])),
    )
    np.testing.assert_allclose(drawn[-1]["x"], [0.25, 0.26])


def test_frames_that_go_round_are_said_and_come_right_again(world: World) -> None:
    def round_and_round() -> None:
        world.mount(0.0, parent="joint")
        world.mount(0.0, parent="a", child="joint")
        world.a.touch()

    world.wait(lambda: "cycle" in world.said_of_a(), round_and_round)
    world.wait(lambda: "/a/skin" in world.absent(), round_and_round)
    world.wait(lambda: "/a/skin" not in world.absent(), world.alone)


def test_thousands_of_contacts_pass(world: World) -> None:
    world.wait(lambda: world.absent() == ["/b/skin"], world.alone)
    world.a.touch(contacts=3000)
    world.wait(lambda: any(len(message.contacts) == 3000 for message in world.contacts))
    world.contacts.clear()


def test_a_patch_without_a_valid_taxel_is_absent_and_said_to_be_blind(world: World) -> None:
    world.wait(lambda: world.absent() == ["/b/skin"], world.alone)
    world.wait(lambda: world.absent() == ["/a/skin", "/b/skin"], lambda: world.alone(valid=0))
    assert not world.contacts[-1].untouched
    text = "none of its 16 taxels in service has a valid reading"
    world.wait(lambda: world.said_of_a().startswith(text), lambda: world.alone(valid=0))
    world.wait(
        lambda: world.said["/a/skin"].endswith("15 of 16 taxels valid"),
        lambda: world.alone(valid=15),
    )
    assert world.absent() == ["/b/skin"]


AREA_M2 = 0.25


Part = tuple[Pose, TactileContacts]


def patch(valid: int, force_n: float = 0.0, in_service: int = 16) -> Part:
    """What a driver says of its patch, which lies at the body's origin, by TactileContacts.msg."""
    message = TactileContacts(touched=force_n > 0, taxels_valid=valid, taxels_in_service=in_service)
    message.untouched = not force_n and valid == in_service
    has_sums = message.untouched or (force_n > 0 and 2 * valid >= in_service)
    message.area = (AREA_M2 if force_n else 0.0) if has_sums else math.nan
    message.wrench.force.z = -force_n if has_sums else math.nan
    if force_n:
        message.contacts = [TactileContact(force=Vector3(z=-force_n), position=Point(x=1.0))]
    return Pose(np.eye(3), np.zeros(3)), message


def combined(parts: list[Part], absent: list[str]) -> TactileContacts:
    """What the body says of these patches."""
    read = [(pose, Touches.read(serialize_message(message))) for pose, message in parts]
    found = body_contacts(read, absent, Heading(0, "body"), 7)
    return deserialize_message(found.message, TactileContacts)


@pytest.mark.parametrize(
    ("parts", "absent", "touched", "untouched", "force_n"),
    [
        ([patch(16), patch(16)], [], False, True, 0.0),
        ([patch(16), patch(16, 2.0)], [], True, False, 2.0),
        ([patch(16, 1.0), patch(16, 2.0)], [], True, False, 3.0),
        ([patch(16), patch(15)], [], False, False, math.nan),  # of one taxel nothing is known
        ([patch(16, 1.0), patch(15)], [], True, False, 1.0),  # a lower bound
        ([patch(16)], ["/b"], False, False, math.nan),
        ([patch(16, 1.0)], ["/b"], True, False, 1.0),
        ([patch(16, 1.0)], ["/b", "/c"], True, False, math.nan),  # more are absent than are there
        ([patch(16, 1.0), patch(7, 2.0)], [], True, False, math.nan),  # that patch has no sum
        ([patch(16, 1.0), patch(1, in_service=64)], [], True, False, math.nan),  # 17 of 80 taxels
        ([], ["/a"], False, False, math.nan),
    ],
)
def test_a_body_claims_what_its_patches_know(
    parts: list[Part], absent: list[str], touched: bool, untouched: bool, force_n: float
) -> None:
    message = combined(parts, absent)
    assert (message.touched, message.untouched, message.absent) == (touched, untouched, absent)
    assert len(message.contacts) == sum(len(part.contacts) for _, part in parts)
    assert message.taxels_valid == sum(part.taxels_valid for _, part in parts)
    assert message.taxels_in_service == sum(part.taxels_in_service for _, part in parts)
    assert -message.wrench.force.z == pytest.approx(force_n, nan_ok=True)
    assert math.isnan(message.wrench.torque.x) == math.isnan(message.area) == math.isnan(force_n)
    assert math.isnan(message.position.x) == (not touched or math.isnan(force_n))


def test_counts_and_areas_beyond_what_a_message_holds_break_nothing() -> None:
    pose, strange = patch(16, 1.0)
    strange.taxels_valid = strange.taxels_in_service = 2**32 - 1
    strange.area = 3e38
    message = combined([(pose, strange)] * 3, [])
    assert message.taxels_valid == 2**32 - 1
    assert math.isinf(message.area)


def test_late_messages_are_no_wrong_clock_but_a_wrong_clock_is_said(world: World) -> None:
    """A busy computer takes some messages late; a wrong clock is wrong of all."""

    def busy() -> None:
        world.alone()
        world.a.touch(age_s=5.0)

    world.wait(lambda: "Hz" in world.said_of_a(), busy)
    for age_s, text in ((5.0, "+5.0 s off"), (-7200.0, "-7200.0 s off")):
        world.wait(
            lambda text=text: text in world.said_of_a(),
            lambda age_s=age_s: world.a.touch(age_s),
        )


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"age_s": 5.0}, "its stamps are +5.0 s off"),
        ({"age_s": -5.0}, "its stamps are -5.0 s off"),
        ({"sequence": 7}, "what comes is not used: frame 7 comes again"),
    ],
)
def test_a_patch_whose_frames_are_not_of_now_is_absent(
    world: World, wrong: dict[str, float], text: str
) -> None:
    """It says that nothing touches it, and its messages come as fast as ever."""
    world.wait(lambda: world.contacts[-1].untouched, world.both)
    assert world.absent() == []
    world.wait(lambda: world.absent() == ["/a/skin"], lambda: world.both(**wrong))
    world.wait(lambda: text in world.said_of_a(), lambda: world.both(**wrong))
    begin = len(world.contacts)
    world.wait(lambda: len(world.contacts) > begin + 10, lambda: world.both(**wrong))
    assert not any(message.untouched for message in world.contacts[begin:])
    world.wait(lambda: world.contacts[-1].untouched, world.both)


def test_a_patch_of_two_drivers_is_absent_until_one_of_them_is_silent(world: World) -> None:
    """One says that nothing touches it, the other one that something does, turn by turn."""

    def all_three() -> None:
        world.both()
        second.touch(contacts=1)

    world.wait(lambda: world.contacts[-1].untouched, world.both)
    second = world.second_a()
    text = "not used: 2 drivers publish /a/skin/contacts: end one"
    world.wait(lambda: world.absent() == ["/a/skin"], all_three)
    world.wait(lambda: text in world.said_of_a(), all_three)
    begin, end_s = len(world.contacts), time.monotonic() + 2 * RIVALS_S
    world.wait(lambda: time.monotonic() > end_s, all_three)
    assert len(world.contacts) > begin + 10
    assert {tuple(message.absent) for message in world.contacts[begin:]} == {("/a/skin",)}
    assert not any(m.touched or m.untouched for m in world.contacts[begin:])
    world.wait(lambda: world.contacts[-1].untouched, world.both)  # though the second is still there


def test_clocks_that_are_told_to_differ_are_allowed_for() -> None:
    with closing(World(clocks_apart_s=6.0)) as world:
        for age_s in (5.0, -5.0):
            used, refused = partial(world.both, age_s=age_s), partial(world.both, age_s=2 * age_s)
            world.wait(lambda: world.contacts[-1].untouched, used)
            world.wait(lambda: world.absent() == ["/a/skin"], refused)


@pytest.mark.skipif(not shutil.which("cc"), reason="no C compiler")
def test_a_driver_on_a_computer_whose_clock_is_off_by_50_ms_is_named(
    world: World, tmp_path: Path
) -> None:
    """A driver whose wall clock is another one's: its frames are as fresh as ever."""
    clock = WrongClock(tmp_path, "driver")
    driver = subprocess.Popen(
        [sys.executable, str(ROOT / "scripts" / "skin_driver"), "--ros-args", "-r", "__ns:=/a"],
        env={**os.environ, **clock.environment},
    )

    def said() -> str:
        world.mount(0.0, child="skin")
        return world.said_of_a()

    try:
        world.wait(lambda: "ms on the way" in said())
        clock.set(0.05)
        world.wait(lambda: "is ahead of this one's by 0.0" in said())
        clock.set(-0.05)
        world.wait(lambda: "its messages take 0.0" in said())
        assert world.absent() == ["/b/skin"]  # it goes on being used
        clock.set(0.0)
        world.wait(lambda: "ms on the way" in said())
    finally:
        driver.terminate()
        driver.wait()
