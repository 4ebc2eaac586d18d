# SPDX-License-Identifier: Apache-2.0

"""Callbacks that raise, and requests that are impossible, are logged, counted, and survived."""

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock

from tactile_cdma.config.body_file import Patch
from tactile_cdma.rest.rest_keeper import RestKeeper
from tactile_cdma.ros.body.node import BodyNode
from tactile_cdma.ros.common import failures
from tactile_cdma.ros.common.failures import FAILED, FAILURES
from tactile_cdma.ros.driver.node import SkinNode
from tactile_cdma.ros.driver.parameters import NodeParameters
from tactile_cdma.ros.driver.patches import PatchesNode
from tactile_cdma.ros.driver.stamps import Stamps
from tactile_cdma.ros.viewers.body_view import BodyViewer
from tactile_cdma.ros.viewers.view import Viewer
from test.support.skin_client import Client, node_with, wait_sending
from test.support.spinning import as_its_process, spinning
from test.support.waiting import wait_for

OFFERED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""What every subscriber may ask for."""


def skin() -> SkinNode:
    return node_with(SkinNode, port="sim://?scene=external", state_folder="/nowhere")


def body() -> BodyNode:
    """Subscribed to all that it needs where everything of it is asked for."""
    node = node_with(BodyNode, patches=["/palm/skin"])
    for output in node.outputs:
        output.following.follow(True)
    node.patches.follow_transforms(True)
    return node


def patches() -> PatchesNode:
    return PatchesNode([Patch("palm", None, {"port": "sim://?scene=external"}, {})])


def rerun_view() -> Node:
    rr = pytest.importorskip("rerun", reason="rerun-sdk is not installed (make view)")
    from tactile_cdma.ros.viewers.rerun_view import RerunView

    node = RerunView(rr.RecordingStream("test"), ["/palm/skin"], 1e5)
    node.create_timer(1.0, node._discover)  # as where no patches are named
    return node


NODES: dict[str, Callable[[], Node]] = {
    "skin_driver": skin,
    "skin_body": body,
    "skin_patches": patches,
    "skin_view": lambda: Viewer("/palm/skin/tactile"),
    "body_view": lambda: BodyViewer("/body"),
    "skin_rerun": rerun_view,
}


def entities(node: Node, kind: str) -> list[Any]:
    """Timers, subscriptions, services or waitables of a node, and of those that it has made."""
    return [one for each in (node, *getattr(node, "_nodes", ())) for one in getattr(each, kind)]


def message(kind: type) -> Any:
    """Any that the client takes, too."""
    return kind(status=[DiagnosticStatus()]) if kind is DiagnosticArray else kind()


def called(client: Node, service: Any) -> Any:
    """The answer to come of a service."""
    caller = client.create_client(service.srv_type, service.service_name)
    assert caller.wait_for_service(60.0)
    return caller.call_async(service.srv_type.Request())


@pytest.mark.parametrize("name", NODES)
def test_whatever_calls_back_may_raise(
    name: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(FAILURES, "_told_s", {})
    monkeypatch.setattr(failures, "COMPLAINT_S", 1e6)
    node, client, raised = NODES[name](), Client(), set[object]()
    subscriptions = partial(entities, node, "subscriptions")

    def fail(entity: object) -> None:
        raised.add(entity)
        raise ArithmeticError("of \x1b[2J the test")

    with spinning([client]), as_its_process(node) as process:
        if name in ("skin_driver", "skin_patches"):
            wait_for(lambda: any(one.topic_name.endswith("objects") for one in subscriptions()))
        timers, services = entities(node, "timers"), entities(node, "services")
        events, before = entities(node, "waitables"), FAILURES.count
        heard = subscriptions()
        every = {*timers, *services, *events, *heard}
        originals = {one: one.callback for one in every}
        for one in every:
            one.callback = lambda *_, one=one: fail(one)
        for timer in timers:
            timer.timer_period_ns = 10_000_000
            timer.reset()
        for event in events:
            event.is_ready, event.take_data = (lambda _: True), (lambda: "an event")
        calls = [called(client, service) for service in services]
        sent = [
            (client.create_publisher(one.msg_type, one.topic_name, OFFERED), message(one.msg_type))
            for one in heard
        ]

        def all_raised() -> bool:
            if isinstance(node, BodyNode):
                node.outputs[-1].following.poll()
            return raised == every

        wait_sending(sent, all_raised)
        wait_for(lambda: all(call.done() for call in calls))  # answered, though emptily
        assert process.is_alive()
        assert FAILURES.count - before >= len(every)
        [said] = [
            one.getMessage() for one in caplog.records if "ArithmeticError" in one.getMessage()
        ]
        assert said.endswith("ArithmeticError: of \\x1b[2J the test")
        for one, callback in originals.items():
            one.callback = callback
        if name in ("skin_driver", "skin_body", "skin_patches"):
            wait_for(lambda: int(client.value("host", FAILED) or 0) >= len(every))


@pytest.mark.parametrize(
    "make, owner, method",
    [
        (skin, NodeParameters, "_on_set"),
        (skin, Stamps, "_note_change"),
        (body, BodyNode, "_step_back"),
    ],
)
def test_so_may_what_hears_of_parameters_and_of_the_clock(
    make: Callable[[], Node], owner: type, method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    original, defective = getattr(owner, method), False

    def called(*arguments: object) -> object:
        if defective:
            raise ArithmeticError("of the test")
        return original(*arguments)

    monkeypatch.setattr(owner, method, called)
    node = make()
    client = Client(node.get_fully_qualified_name())
    with spinning([client]), as_its_process(node) as process:
        defective, before = True, FAILURES.count
        use_clock = Parameter("use_sim_time", value=True).to_parameter_msg()
        client.call(SetParameters, "set_parameters", SetParameters.Request(parameters=[use_clock]))
        clock = client.create_publisher(Clock, "/clock", 1)
        times = [(clock, Clock(clock=Time(sec=seconds))) for seconds in (10, 5)]
        wait_sending(times, lambda: FAILURES.count > before)
        defective = False
        failed = FAILURES.count
        wait_for(lambda: int(client.value("host", FAILED) or 0) >= failed - before)
        assert process.is_alive()


@pytest.mark.parametrize(("name", "make"), [("/skin", skin), ("/body", body)])
def test_impossible_requests_are_answered_and_the_node_goes_on(
    name: str, make: Callable[[], Node]
) -> None:
    client = Client(name)
    with spinning([client]), as_its_process(make()) as process:
        for kind in (10, 99, 255):
            unknown = ParameterMessage(name="frame_id", value=ParameterValue(type=kind))
            before = FAILURES.count
            for service in (SetParameters, SetParametersAtomically):
                topic = "set_parameters" + "_atomically" * (service is SetParametersAtomically)
                answer = client.call(service, topic, service.Request(parameters=[unknown]))
                assert "successful=True" not in repr(answer)
            assert FAILURES.count == before + 2
        assert client.set(use_sim_time=True) == (True, "")
        clock = client.create_publisher(Clock, "/clock", 1)
        before = FAILURES.count
        wait_sending([(clock, Clock(clock=Time(sec=-5)))], lambda: FAILURES.count > before)
        wait_for(lambda: int(client.value("host", "failed callbacks") or 0) > before)
        assert process.is_alive()


def test_state_is_saved_before_anything_of_ros_is_destroyed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Destroying may crash: rclpy did so once, after the process of a subscriber was killed."""
    ended: list[type] = []
    for kind, method in ((RestKeeper, "deactivate"), (Node, "destroy_node")):
        original = getattr(kind, method)
        spy = lambda self, kind=kind, end=original: (ended.append(kind), end(self))  # noqa: E731
        monkeypatch.setattr(kind, method, spy)
    with as_its_process(skin()):
        pass
    assert ended == [RestKeeper, Node]
