# SPDX-License-Identifier: Apache-2.0

"""The executor that keeps its wait set: everything that is ready is called, and only that."""

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from tactile_cdma.ros.common.executor import LeanExecutor
from tactile_cdma.ros.common.following import Following, Topic
from test.support.spinning import living
from test.support.waiting import PATIENCE_S

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class World:
    """A node under test, and another one in the same executor."""

    def __init__(self) -> None:
        self.node, self.peer = rclpy.create_node("node"), rclpy.create_node("peer")
        self.executor = LeanExecutor()
        for node in (self.node, self.peer):
            assert self.executor.add_node(node)
        self.got: list[str] = []

    def hear(self, message: Header) -> None:
        self.got.append(message.frame_id)

    def until(self, condition: Callable[[], object], seconds: float = 20.0) -> None:
        end_s = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end_s
            self.executor.spin_once(0.05)

    def publisher(self, said: str) -> Any:
        publisher = self.peer.create_publisher(Header, "said", LATCHED)
        publisher.publish(Header(frame_id=said))
        return publisher


@pytest.fixture
def world() -> Iterator[World]:
    world = World()
    yield world
    world.executor.shutdown()
    for node in (world.node, world.peer):
        node.destroy_node()


def test_timers_come_at_their_period_until_cancelled_and_again_after_reset(world: World) -> None:
    times: list[float] = []
    steady = Clock(clock_type=ClockType.STEADY_TIME)
    timer = world.node.create_timer(0.02, lambda: times.append(time.monotonic()), clock=steady)
    world.until(lambda: len(times) == 10)
    assert 0.15 < times[-1] - times[0] < 1.0
    timer.cancel()
    world.executor.spin_once(0.0)
    count = len(times)
    for _ in range(5):
        world.executor.spin_once(0.02)
    assert len(times) == count
    timer.reset()
    world.until(lambda: len(times) > count)


def test_what_is_created_while_it_spins_is_served_and_what_is_destroyed_is_not(
    world: World,
) -> None:
    world.publisher("early")
    once = world.node.create_timer(0.01, lambda: None)

    def subscribe() -> None:
        world.node.destroy_timer(once)
        world.node.create_subscription(Header, "said", world.hear, LATCHED)

    once.callback = subscribe
    world.until(lambda: world.got == ["early"])
    assert once not in list(world.node.timers)


def test_a_callback_may_destroy_what_is_ready_beside_it(world: World) -> None:
    """Both messages wait; whichever comes first ends the other's subscription."""
    subscriptions: list[Any] = []

    def hear(message: Header) -> None:
        world.hear(message)
        for subscription in subscriptions:
            world.node.destroy_subscription(subscription)

    subscriptions += [
        world.node.create_subscription(Header, "said", hear, LATCHED) for _ in range(2)
    ]
    world.publisher("once")
    time.sleep(1.0)
    world.until(lambda: world.got)
    for _ in range(5):
        world.executor.spin_once(0.02)
    assert world.got == ["once"]


def test_who_creates_something_in_every_turn_starves_nobody(world: World) -> None:
    turns: list[str] = []

    def create() -> None:
        turns.append("creates")
        world.node.create_publisher(Header, f"made_{len(turns)}", 1)
        time.sleep(0.01)  # longer than its period: it is ready again at once

    world.node.create_timer(1e-3, create)
    world.node.create_timer(1e-3, lambda: turns.append("other"))
    world.until(lambda: turns.count("creates") == 8)
    assert turns.count("other") >= 7


def test_services_answer(world: World) -> None:
    """A client of another executor."""

    def answer(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.message = "here"
        return response

    world.node.create_service(Trigger, "ask", answer)
    with living(rclpy.create_node("other")) as other:
        client = other.create_client(Trigger, "ask")
        world.until(client.service_is_ready)
        future = client.call_async(Trigger.Request())
        world.until(lambda: rclpy.spin_once(other, timeout_sec=0.0) or future.done())
    assert future.result().message == "here"


def test_publishers_hear_of_subscribers_that_ask_for_more(world: World) -> None:
    """Event handlers are served, as rclpy's warning of incompatible QoS needs."""
    from rclpy.event_handler import PublisherEventCallbacks

    heard: list[object] = []
    world.node.create_publisher(
        Header,
        "said",
        QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT),
        event_callbacks=PublisherEventCallbacks(incompatible_qos=heard.append),
    )
    world.peer.create_subscription(Header, "said", world.hear, 1)
    world.until(lambda: heard)


def test_polled_topics_wake_nobody_and_wait_until_they_are_polled(world: World) -> None:
    topic = Topic(Header, "said", world.hear, LATCHED)
    polled, woken = Following(world.node, topic, is_polled=True), Following(world.peer, topic)
    for following in (polled, woken):
        following.follow(True)
    world.publisher("it")
    world.until(lambda: world.got)
    time.sleep(0.2)
    for _ in range(5):
        world.executor.spin_once(0.02)
    assert world.got == ["it"]
    polled.poll()
    assert world.got == ["it", "it"]
    polled.poll()
    assert world.got == ["it", "it"]


def test_raw_topics_are_bytes(world: World) -> None:
    got: list[Any] = []
    Following(world.node, Topic(Header, "said", got.append, LATCHED, raw=True)).follow(True)
    world.publisher("it")
    world.until(lambda: got)
    assert isinstance(got[0], bytes)
    assert b"it\0" in got[0]


def test_topics_are_followed_together_though_one_has_failed_at_first(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    names, create = ["said", "written"], world.node.create_subscription
    topics = [Topic(Header, name, world.hear, LATCHED) for name in names]
    following = Following(world.node, *topics)

    def fail(kind: type, name: str, *args: Any, **options: Any) -> Any:
        if name == "written":
            raise MemoryError(name)
        return create(kind, name, *args, **options)

    with monkeypatch.context() as patched, pytest.raises(MemoryError):
        patched.setattr(world.node, "create_subscription", fail)
        following.follow(True)
    following.follow(True)
    assert following
    followed = [subscription.topic_name for subscription in world.node.subscriptions]
    assert [name for name in followed if name[1:] in names] == ["/said", "/written"]


def test_a_callback_of_two_arguments_gets_when_a_message_was_sent_and_came(world: World) -> None:
    infos: list[dict[str, int]] = []
    begin_ns = time.time_ns()
    world.node.create_subscription(Header, "said", lambda _, info: infos.append(info), LATCHED)
    world.publisher("one")
    world.until(lambda: infos)
    [info] = infos
    assert begin_ns < info["source_timestamp"] < info["received_timestamp"] < time.time_ns()


def test_another_thread_ends_an_endless_wait(world: World) -> None:
    spinning = threading.Thread(target=world.executor.spin_once)
    for _ in range(3):
        world.executor.spin_once(0.01)  # what the nodes themselves have to say at first
    spinning.start()
    time.sleep(0.1)
    assert spinning.is_alive()
    world.executor.wake()
    spinning.join(PATIENCE_S)
    assert not spinning.is_alive()
